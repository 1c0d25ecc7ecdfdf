"""The textured mesh of a scan as binary glTF."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from service.errors import InputError
from service.exports.glb import glb
from service.exports.mesh_tiles import TileJob, footprints, run_tiles, tile_boxes
from service.exports.pictures import recording_of
from service.exports.view import ExportOptions, ScanView
from service.scans.writing import writing

METHODS = ("auto", "height", "poisson")
TILE_POINTS = 20_000_000
LARGEST_ATLAS_PX = 8192
TILED_ATLAS_PX = 4096


@dataclass(frozen=True, slots=True)
class MeshOptions:
    """How a mesh is made; see ``skyrelief mesh --help``."""

    method: str = "auto"
    largest_faces: int = 400_000
    tile_points: int = TILE_POINTS
    scheduler: str | None = None
    video: Path | None = None  # None: the scan's recording, when it is still there
    recording: bool = True  # False: never look for the recording
    video_epoch_ns: int | None = None


def write_glb(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """The mesh that ``skyrelief mesh`` makes by default."""
    write_mesh(scan, out, MeshOptions(), options)


def write_mesh(
    scan: ScanView, out: Path, how: MeshOptions, options: ExportOptions
) -> dict[str, Any]:
    """Mesh and texture the scan, and write it in local ENU metres; figures of the mesh.

    ``height`` is one sheet over the ground; ``poisson`` a surface through all points; ``auto``
    takes ``height`` unless many keyframes look sideways. Raises InputError when there is too
    little surface, OutsideError when a cluster was named and does not answer.
    """
    if how.method not in METHODS:
        raise InputError(f"mesh by {how.method!r}: there are {', '.join(METHODS)}")
    method = how.method
    if method == "auto":
        method = "poisson" if scan.oblique else "height"
    prints = footprints(scan.store)
    if not prints:
        raise InputError(f"{scan.folder} holds no points yet; nothing to mesh")
    voxel_m = options.voxel_m or float(np.median([p.sample_m for p in prints]))
    video = how.video
    if video is None and how.recording:
        recording = recording_of(scan.folder, scan.store.header)
        options.progress(recording.words)
        video = recording.path
    boxes = tile_boxes(prints, how.tile_points)
    jobs = [
        TileJob(
            str(scan.folder.resolve()),
            box,
            voxel_m,
            method,
            max(1000, how.largest_faces // len(boxes)),
            LARGEST_ATLAS_PX if len(boxes) == 1 else TILED_ATLAS_PX,
            None if video is None else str(video.resolve()),
            how.video_epoch_ns,
            how.video is not None,
        )
        for box in boxes
    ]
    parts = run_tiles(jobs, how.scheduler, options.progress)
    if not parts:
        raise InputError(f"{scan.folder}: cannot be meshed, there is too little surface")
    figures = {
        "method": method,
        "tiles": len(parts),
        "faces": sum(p.figures["faces"] for p in parts),
        "vertices": sum(p.figures["vertices"] for p in parts),
        "seen": float(
            np.average(
                [p.figures["seen"] for p in parts], weights=[p.figures["faces"] for p in parts]
            )
        ),
        "pictures": "store" if video is None else str(video),
        "texture_px": [p.figures["texture_px"] for p in parts],
    }
    options.progress(f"writing {figures['faces']} triangles")
    with writing(out) as part:
        part.write_bytes(glb([(p.mesh, p.picture) for p in parts], _extras(scan) | figures))
    return figures


def _extras(scan: ScanView) -> dict[str, Any]:
    """Where the mesh stands: its x is east, y up, -z north of this origin."""
    frame = scan.frame
    if frame is None:
        return {"scan": scan.store.header.scan_id, "origin": None}
    origin = [frame.lat_deg, frame.lon_deg, frame.alt_amsl_m]
    return {"scan": scan.store.header.scan_id, "origin_lat_lon_amsl": origin}
