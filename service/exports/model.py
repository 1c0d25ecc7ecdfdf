"""The textured mesh of a scan as binary glTF."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from recon.cloud_fusion import cloud_of
from recon.meshing import Mesh, height_mesh, poisson_mesh
from recon.raster import Raster, fill_holes, smoothed
from recon.types import F64, U8
from service.errors import InputError
from service.exports.glb import glb
from service.exports.view import ExportOptions, ScanView
from service.scan_folder import surface, writing

MESH_CELLS = 16e6
METHODS = ("auto", "height", "poisson")
OBLIQUE_SHARE = 0.25
"""Above this share of keyframes that look more than 30 degrees off nadir, auto is Poisson."""


def write_glb(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """The mesh that ``skyrelief mesh`` makes by default."""
    write_mesh(scan, out, "auto", 400_000, options)


def write_mesh(
    scan: ScanView, out: Path, method: str, largest_faces: int, options: ExportOptions
) -> dict[str, Any]:
    """Mesh the scan and write it in local ENU metres; figures of the mesh.

    ``height`` is one sheet over the ground, textured with the orthophoto; ``poisson`` is a
    surface through all points, with colours at its vertices; ``auto`` takes ``height``
    unless many keyframes look sideways. Raises InputError when there is too little surface.
    """
    if method not in METHODS:
        raise InputError(f"mesh by {method!r}: there are {', '.join(METHODS)}")
    if method == "auto":
        method = "poisson" if _oblique_share(scan) > OBLIQUE_SHARE else "height"
    try:
        mesh, texture = (
            _height(scan, largest_faces, options)
            if method == "height"
            else (
                _poisson(scan, options),
                None,
            )
        )
    except ValueError as error:
        raise InputError(f"{scan.folder}: cannot be meshed, {error}") from error
    options.progress(f"writing {len(mesh.faces)} triangles")
    figures = {"method": method, "faces": len(mesh.faces), "vertices": len(mesh.vertices_m)}
    with writing(out) as part:
        part.write_bytes(glb(mesh, texture, _extras(scan) | figures))
    return figures


def _height(scan: ScanView, largest_faces: int, options: ExportOptions) -> tuple[Mesh, U8 | None]:
    options.progress("fusing the cloud")
    raster = surface(scan.fused, MESH_CELLS)
    if raster is None:
        raise ValueError("it has no points")
    options.progress("filling and smoothing the surface")
    raster = fill_holes(raster, largest_cells=8)
    options.progress("triangles")
    return height_mesh(smoothed(raster), largest_faces), _spread(raster)


def _spread(raster: Raster) -> U8:
    """The orthophoto with its colours carried past its edge, so that no texel there is black."""
    import cv2

    known = raster.known.astype(np.uint8)
    rgb: U8 = raster.rgb.copy()
    for _ in range(4):
        wider = cv2.dilate(rgb, np.ones((3, 3), np.uint8))
        rgb = np.asarray(np.where(known[..., None] > 0, rgb, wider), np.uint8)
    return rgb


def _poisson(scan: ScanView, options: ExportOptions) -> Mesh:
    options.progress("fusing the cloud")
    fused = scan.fused
    options.progress("Poisson surface")
    return poisson_mesh(fused.cloud, _seen_from(scan), fused.voxel_m)


def _seen_from(scan: ScanView) -> F64:
    """(N, 3) the camera that looked at each fused point: that of the nearest stored point."""
    from scipy.spatial import cKDTree

    places, cameras = [], []
    for keyframe in scan.store.keyframes():
        step = keyframe.fresh.copy()
        step[1::3] = step[2::3] = False
        step[:, 1::3] = step[:, 2::3] = False
        cloud = cloud_of(keyframe.depth, keyframe.bgr, step)
        places.append(cloud.xyz_m)
        cameras.append(np.tile(keyframe.depth.T_world_camera[:3, 3], (len(cloud), 1)))
    nearest = cKDTree(np.concatenate(places)).query(scan.fused.cloud.xyz_m, workers=-1)[1]
    return np.asarray(np.concatenate(cameras)[nearest])


def _oblique_share(scan: ScanView) -> float:
    """Share of the keyframes whose optical axis is more than 30 degrees off straight down."""
    down = [-k.depth.T_world_camera[2, 2] for k in scan.store.keyframes()]
    return float(np.mean(np.array(down) < np.cos(np.radians(30.0)))) if down else 0.0


def _extras(scan: ScanView) -> dict[str, Any]:
    """Where the mesh stands: its x is east, y up, -z north of this origin."""
    frame = scan.frame
    if frame is None:
        return {"scan": scan.store.header.scan_id, "origin": None}
    origin = [frame.lat_deg, frame.lon_deg, frame.alt_amsl_m]
    return {"scan": scan.store.header.scan_id, "origin_lat_lon_amsl": origin}
