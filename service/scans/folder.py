"""The files of a finished or growing scan, made from its store alone.

Drone and ground hold the same store, so both make the same files: ``cloud.laz``,
``trajectory.tum``, ``trajectory.csv``, ``scan.json``, ``preview.jpg``,
``thumbnail.webp``, ``coverage.png``, ``coverage.json`` and ``report.html``; ``piece-1.laz``
and so on of what is not tied to the rest.
Each is written to a temporary file and then renamed, so a reader never sees a partial file.
"""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from recon.mapping.cloud_fusion import joined
from recon.parallel import run_parallel
from recon.surface.raster import Raster, bounds_of, grid_over, rasterise
from recon.types import U8, PointCloud
from service.errors import OutsideError, SkyreliefError
from service.memory import release_memory
from service.progress import CancelledError, Progress
from service.redaction import public_configuration, redacted
from service.scans import drawing, track
from service.scans.coverage import IMAGE as COVERAGE
from service.scans.coverage import Coverage, LiveCoverage, write_coverage_files
from service.scans.fused_cloud import (
    DEFAULT_VOXEL_M,
    Box,
    FusedCloud,
    LazPart,
    TiledCloud,
    fused_cloud,
    thinned,
    write_laz,
)
from service.scans.main_piece import in_words, main_poses, main_seqs, pieces_apart, stretches_apart
from service.scans.report import maps_of, report_html
from service.scans.trust import (
    SharedSigma,
    lacks_altitude,
    scale_sigma,
    shared_sigma,
    slope_deg,
    trust_of,
)
from service.scans.writing import SUMMARY, final, write_whole, writing
from service.stream.records import PoseRecord, ScanHeader
from service.stream.store import ScanStore

log = logging.getLogger(__name__)

CLOUD, TUM, CSV = "cloud.laz", "trajectory.tum", "trajectory.csv"
PREVIEW, REPORT = "preview.jpg", "report.html"
THUMBNAIL = "thumbnail.webp"
WEBP = (cv2.IMWRITE_WEBP_QUALITY, 80)
PREVIEW_CELLS = 6e6
LONGEST_REASON = 500
MIN_VOXEL_M, MAX_VOXEL_M = 0.01, 100.0  # permitted voxel sizes in a scan's own configuration
NOTHING = FusedCloud(
    PointCloud(
        np.zeros((0, 3), np.float32),
        np.zeros((0, 3), np.uint8),
        np.zeros(0, np.float32),
        np.zeros(0, np.uint8),
    ),
    DEFAULT_VOXEL_M,
    None,
    0,
    0,
)
"""Replaces a cloud that could not be fused."""
PIECE = "piece-{}.laz"
PIECES = (
    "{}: what is left out, each in metres about its first camera; scale and heading are its own"
)
NO_GEOREFERENCE = (
    "no georeference: coordinates are metres east, north and up of the scan's own origin"
)


def write_deliverables(
    folder: Path,
    store: ScanStore,
    tiled: TiledCloud | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write the scan folder's files from ``store``; returns the content of scan.json.

    ``tiled`` is the cloud, where it is too large for memory.

    A file that cannot be made is listed under ``failed``, with the reason, and logged; the others
    are written. Raises OutsideError, at the end, when the folder cannot be written.
    """
    progress = progress or Progress()
    files = _Files(folder, store, tiled)
    files.write_trajectory()
    with progress.part("reading the keyframes", 0.7):
        run_parallel(partial(files.fuse, progress), files.cover)
    release_memory()
    files.write_pieces()
    progress("writing the files")
    _, summary = run_parallel(files.write_cloud, files.draw)
    assert summary is not None
    failures = files.failures
    summary["failed"], summary["files_due"] = failures.why, failures.of_the_disk is not None
    write_whole(folder / SUMMARY, json.dumps(summary, indent=2, sort_keys=True) + "\n")
    if failures.of_the_disk is not None:
        raise failures.of_the_disk
    return summary


class _Files:
    """The parts of a scan's files, while they are made."""

    def __init__(self, folder: Path, store: ScanStore, tiled: TiledCloud | None) -> None:
        self._folder, self._store, self._tiled = folder, store, tiled
        self._voxel_m = resolution_m(store.header)
        self.failures = Failures(folder)
        self._frame, self._poses = track.local_frame(store.header), store.poses()
        self._left_out, self._shared = in_words(store), shared_sigma(store)
        self._fused = NOTHING
        self._raster: Raster | None = None
        self._cell_m: float | None = None
        self._coverage: Coverage | None = None
        self._pieces: list[str] = []

    def write_trajectory(self) -> None:
        with self.failures.noted(TUM):
            write_whole(self._folder / TUM, track.tum_lines(self._poses))
        with self.failures.noted(CSV):
            write_whole(self._folder / CSV, track.csv_table(self._poses))

    def fuse(self, progress: Progress) -> None:
        with self.failures.noted(CLOUD):
            if self._tiled is None:
                self._fused = fused_cloud(self._store, self._voxel_m, progress)
            else:
                self._cell_m = preview_cell_m(self._tiled.bounds, self._tiled.voxel_m)
                self._fused = self._written(self._tiled, self._cell_m)

    def _written(self, tiled: TiledCloud, cell_m: float) -> FusedCloud:
        """Write the cloud tile by tile; of its points those that the preview shows."""
        kept, count = [], 0

        def parts() -> Iterator[LazPart]:
            nonlocal count
            for part in tiled.parts:
                kept.append(thinned(part[0], cell_m))
                count += len(part[0])
                yield part

        self._write_laz(parts())
        return FusedCloud(
            joined(kept), tiled.voxel_m, tiled.ground_sample_m, tiled.keyframes, tiled.points_in,
            points_out=count,
        )  # fmt: skip

    def _write_laz(self, parts: Iterable[LazPart]) -> None:
        header = self._store.header
        with writing(self._folder / CLOUD) as part:
            write_laz(
                part, parts, self._frame, header.started_unix_ns,
                vertical=track.flown_datum(header), shared=self._shared,
            )  # fmt: skip

    def write_pieces(self) -> None:
        """Write each unconnected stretch as a cloud about its first camera."""
        for n, piece in enumerate(pieces_apart(self._store), 1):
            name = PIECE.format(n)
            with self.failures.noted(name):
                fused = fused_cloud(piece, self._voxel_m).cloud
                first = piece.keyframe(piece.own[0])
                if first is None or not len(fused):
                    continue
                centre_m = first.depth.T_world_camera[:3, 3].astype(np.float32)
                cloud = replace(fused, xyz_m=fused.xyz_m - centre_m)
                with writing(self._folder / name) as part:
                    write_laz(part, [(cloud, None, None)], None, self._store.header.started_unix_ns)
                self._pieces.append(name)
        for old in self._folder.glob(PIECE.format("*")):  # of an earlier state of the scan
            if old.name not in self._pieces:
                old.unlink(missing_ok=True)

    def cover(self) -> None:
        with self.failures.noted(COVERAGE):
            self._coverage = write_coverage_files(self._folder, LiveCoverage(self._store))

    def summary(self) -> dict[str, Any]:
        store, frame, fused = self._store, self._frame, self._fused
        header, run = store.header, store.summary or {}
        notes, origin = [*header.notes, *fused.notes], None
        if frame is None:
            notes.append(NO_GEOREFERENCE)
        else:
            origin = {
                "lat_deg": frame.lat_deg,
                "lon_deg": frame.lon_deg,
                "alt_amsl_m": frame.alt_amsl_m,
            }
        if self._left_out:
            notes.append(self._left_out)
        if self._pieces:
            notes.append(PIECES.format(", ".join(self._pieces)))
        times = [p.time_unix_ns / 1e9 for p in self._poses]
        quality = _quality(fused, self._raster, self._poses)
        return {
            "schema": 1,
            "id": header.scan_id,
            "run_id": header.run_id,
            "drone": header.drone,
            "times": {
                "started_unix_s": header.started_unix_ns / 1e9,
                "first_pose_unix_s": times[0] if times else None,
                "last_pose_unix_s": times[-1] if times else None,
            },
            "finished": store.finished,
            "origin": origin,
            "epsg": None if frame is None else frame.epsg,
            "heights": track.heights_above(frame, track.flown_datum(header), lacks_altitude(store)),
            "georeference": header.georeference,
            "camera": header.camera,
            "configuration": public_configuration(header.configuration),
            "software": header.software,
            "counts": {
                "keyframes": fused.keyframes,
                "points": len(fused.cloud) if fused.points_out is None else fused.points_out,
                "points_before_fusion": fused.points_in,
                "poses": len(self._poses),
            },
            "quality": quality
            | {
                "sigma_absolute_median_m": _absolute_m(fused.cloud, self._shared),
                "scale_sigma": scale_sigma(run, header.georeference),
                "trust": trust_of(run, header.georeference, slope_deg(fused.cloud.xyz_m), quality),
            },
            "notes": notes,
            "coverage": None if self._coverage is None else self._coverage.figures(),
            "refinement": store.refinement,
            "run": redacted(run),
        }

    def write_cloud(self) -> None:
        if self._fused is not NOTHING and self._tiled is None:
            with self.failures.noted(CLOUD):
                self._write_laz([(self._fused.cloud, None, None)])

    def draw(self) -> dict[str, Any]:
        """Write preview, thumbnail and report; returns the content of scan.json."""
        with self.failures.noted(PREVIEW):
            self._raster = surface(self._fused, self._cell_m)
        release_memory()  # so that what a step leaves does not add to the next
        summary = self.summary()
        poses = main_poses(self._poses, stretches_apart(self._store))
        maps = None
        with self.failures.noted(PREVIEW):
            if self._raster is not None:
                maps = maps_of(summary, poses, self._raster)
            release_memory()
            lines = [*key_figures(summary), *filter(None, [self._left_out])]
            self._write_image(
                PREVIEW,
                drawing.blank_preview(lines) if maps is None else drawing.side_by_side(maps, lines),
                [cv2.IMWRITE_JPEG_QUALITY, 90],
            )
        if self._raster is not None:
            with self.failures.noted(THUMBNAIL):
                grid = self._raster.grid if self._coverage is None else self._coverage.layer.grid
                image = drawing.draw_thumbnail(self._raster, grid.bounds)
                self._write_image(THUMBNAIL, image, WEBP)
        with self.failures.noted(REPORT):
            shown = middle_stages(self._folder, self._store)
            cloud, coverage = self._fused.cloud, self._coverage
            page = report_html(summary, poses, cloud, self._raster, coverage, shown, maps)
            write_whole(self._folder / REPORT, page)
        return summary

    def _write_image(self, name: str, image: U8, options: Sequence[int]) -> None:
        path = self._folder / name
        write_whole(path, cv2.imencode(path.suffix, image, options)[1].tobytes())


class Failures:
    """The files of a scan that could not be made, and why. A failure affects one file only."""

    def __init__(self, folder: Path, level: int = logging.ERROR) -> None:
        """``level`` is that of the log's line about a failure; of a fault it is an error."""
        self._folder, self._level = folder, level
        self.why: dict[str, str] = {}
        self.of_the_disk: OutsideError | None = None  # the first one; it justifies another attempt
        self.first: SkyreliefError | None = None

    @contextmanager
    def noted(self, name: str) -> Iterator[None]:
        """Run the block that makes the file ``name``; note its exception."""
        try:
            yield
        except CancelledError:
            raise
        except Exception as error:  # a corrupt scan must not stop the other files
            if isinstance(error.__cause__, KeyboardInterrupt):  # during a kernel of numba
                raise
            if isinstance(error, OutsideError) and self.of_the_disk is None:
                self.of_the_disk = error
            first, *_ = str(error).strip().splitlines() or [""]
            known = isinstance(error, SkyreliefError)
            why = first if known else f"{type(error).__name__}: {first}"
            as_said = (
                error if isinstance(error, SkyreliefError) else SkyreliefError(f"{name}: {why}")
            )
            self.first = self.first or as_said
            self.why.setdefault(name, why[:LONGEST_REASON])
            level = self._level if known else logging.ERROR
            path = final(self._folder / name)
            log.log(level, "%s is not written: %s", path, why, exc_info=not known)


def middle_stages(folder: Path, store: ScanStore) -> U8 | None:
    """Image of a keyframe's stages for the report; None for a scan without keyframes."""
    seq = drawing.middle_keyframe(folder, store, main_seqs(store))
    keyframe = None if seq is None else store.keyframe(seq)
    if keyframe is None:
        return None
    return drawing.stages(folder, store.header.scan_id, keyframe)[0]


def resolution_m(header: ScanHeader) -> float | None:
    """``scan.resolution_m`` of the scan's configuration; None when it is automatic."""
    section = header.configuration.get("scan", {})
    value = section.get("resolution_m") if isinstance(section, dict) else None
    if not isinstance(value, int | float) or not MIN_VOXEL_M <= value <= MAX_VOXEL_M:
        return None
    return float(value)


def surface(fused: FusedCloud, cell_m: float | None = None) -> Raster | None:
    """The upper surface in the scan's own ENU metres, or None without points. Cells are by default
    as of :func:`preview_cell_m`."""
    if not len(fused.cloud):
        return None
    xy = fused.cloud.xyz_m[:, :2]
    cell_m = cell_m or preview_cell_m(bounds_of(xy), fused.voxel_m)
    return rasterise(fused.cloud, grid_over(xy, cell_m, margin_cells=1))


def preview_cell_m(bounds: Box, voxel_m: float) -> float:
    """The voxel, doubled until at most PREVIEW_CELLS cover the rectangle."""
    west, south, east, north = bounds
    while ((east - west) / voxel_m + 2.0) * ((north - south) / voxel_m + 2.0) > PREVIEW_CELLS:
        voxel_m *= 2.0
    return voxel_m


def _quality(
    fused: FusedCloud, raster: Raster | None, poses: Sequence[PoseRecord]
) -> dict[str, Any]:
    """Figures of the cloud and the track; None where there is no data."""
    cloud = fused.cloud
    none = not len(cloud)
    names = ("position_sigma_median_m", "position_sigma_h_median_m", "position_sigma_v_median_m")
    sigmas: dict[str, float | None] = dict.fromkeys(names)  # in all directions, across and up
    if poses:
        medians = np.median([(p.sigma_m, *p.sigma_h_v_m) for p in poses], axis=0)
        sigmas = dict(zip(names, medians.round(4).tolist(), strict=True))
    return sigmas | {
        "voxel_m": round(fused.voxel_m, 4),
        "ground_sample_m": None
        if fused.ground_sample_m is None
        else round(fused.ground_sample_m, 4),
        "sigma_median_m": None if none else round(float(np.median(cloud.sigma_m)), 4),
        "sigma_90_percent_m": None if none else round(float(np.percentile(cloud.sigma_m, 90)), 4),
        "views_median": None if none else float(np.median(cloud.views)),
        "seen_once_share": None if none else round(float((cloud.views <= 1).mean()), 4),
        "area_m2": 0.0 if raster is None else round(raster.area_m2, 1),
        "distance_m": round(float(track.flown_m(poses)[-1]), 2) if poses else 0.0,
    }


def _absolute_m(cloud: PointCloud, shared: SharedSigma | None) -> float | None:
    """Median sigma of the heights in the world, of up to some hundred thousand points."""
    if shared is None or not len(cloud):
        return None
    some = slice(None, None, 1 + len(cloud) // 200_000)
    return round(float(np.median(shared.absolute_m(cloud.sigma_m[some], cloud.xyz_m[some]))), 4)


def key_figures(summary: dict[str, Any]) -> list[str]:
    """Three lines of text for the preview (ASCII: OpenCV's fonts have no more)."""
    counts, quality, origin = summary["counts"], summary["quality"], summary["origin"]
    place = "no georeference"
    if origin is not None:
        place = f"{origin['lat_deg']:.6f}, {origin['lon_deg']:.6f}, EPSG:{summary['epsg']}"
    figures = [f"{counts['points']} points from {counts['keyframes']} keyframes"]
    if counts["points"]:
        figures += [
            f"{quality['area_m2']:,.0f} m2",
            f"sigma {quality['sigma_median_m']:.2f} m",
            f"voxel {quality['voxel_m']:.2f} m",
        ]
    figures.append(f"{quality['distance_m']:.0f} m flown")
    name = summary["id"].encode("ascii", "replace").decode()
    trust = quality["trust"]
    reasons = "; ".join(trust["reasons"])
    words = f"{trust['level']}: {reasons}" if reasons else trust["level"]
    return [f"{name}, {place}", ", ".join(figures), words]


if __name__ == "__main__":
    try:
        with ScanStore.open(Path(sys.argv[1]) / "scan.db") as opened:
            write_deliverables(Path(sys.argv[1]), opened)
    except SkyreliefError as error:
        sys.exit(str(error))
