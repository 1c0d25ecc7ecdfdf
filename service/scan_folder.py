"""The files of a finished (or still growing) scan, made from its store alone.

Drone and ground hold the same store, so both make the same files: ``cloud.laz``,
``trajectory.tum``, ``trajectory.csv``, ``scan.json``, ``preview.jpg``, ``coverage.png``,
``coverage.json`` and ``report.html``.
Each is written beside its place and then renamed, so a reader never sees half a file.
"""

from __future__ import annotations

import csv
import io
import json
import logging
import math
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from recon import se3
from recon.raster import Raster, grid_over, rasterise
from service.coverage import write_coverage_files
from service.errors import OutsideError
from service.fused_cloud import FusedCloud, fused_cloud
from service.georeference import LocalFrame
from service.inspection import middle_keyframe, stages
from service.las import write_laz
from service.preview import blank_preview, draw_preview
from service.report import report_html
from service.stream.records import PoseRecord, ScanHeader
from service.stream.store import ScanStore

log = logging.getLogger(__name__)

CLOUD, TUM, CSV = "cloud.laz", "trajectory.tum", "trajectory.csv"
SUMMARY, PREVIEW, REPORT = "scan.json", "preview.jpg", "report.html"
PREVIEW_CELLS = 6e6
NO_GEOREFERENCE = (
    "no georeference: coordinates are metres east, north and up of the scan's own origin"
)
CSV_COLUMNS = (
    "time_unix_s",
    "lat_deg",
    "lon_deg",
    "alt_amsl_m",
    "agl_m",
    "roll_deg",
    "pitch_deg",
    "yaw_deg",
    "speed_m_s",
    "distance_m",
    "turn_rate_deg_s",
    "sources",
    "sigma_m",
)


def write_deliverables(
    folder: Path, store: ScanStore, extra: dict[str, Any], voxel_m: float | None = None
) -> dict[str, Any]:
    """Write the scan folder's files from ``store``; returns what scan.json holds.

    Args:
        extra: more figures of the run, kept with those of the store under ``run`` in
            scan.json; nothing here where the files shall be the same at both ends.
        voxel_m: size of the fused voxels; by default ``scan.resolution_m`` of the scan's own
            configuration, else the ground sample distance.

    Raises OutsideError when the folder cannot be written.
    """
    header = store.header
    frame = local_frame(header)
    poses = latest(store.poses())
    fused = fused_cloud(store, voxel_m or _resolution_m(header))
    raster = surface(fused)
    run = (store.summary or {}) | extra
    summary = _summary(header, frame, poses, fused, raster, run, store.finished)
    with writing(folder / CLOUD) as part:
        write_laz(part, fused.cloud, frame, header.started_unix_ns)
    with writing(folder / TUM) as part:
        part.write_text(_tum(poses), encoding="ascii")
    with writing(folder / CSV) as part:
        part.write_text(_csv(poses), encoding="utf-8")
    coverage = write_coverage_files(folder, store)
    summary["coverage"] = None if coverage is None else coverage.figures()
    summary["refinement"] = store.refinement
    preview = _preview(raster, poses, summary)
    with writing(folder / PREVIEW) as part:
        part.write_bytes(preview)
    with writing(folder / REPORT) as part:
        shown = _stages(folder, store)
        page = report_html(summary, poses, fused.cloud, raster, preview, coverage, shown)
        part.write_text(page, encoding="utf-8")
    with writing(folder / SUMMARY) as part:
        part.write_text(json.dumps(summary, indent=2, sort_keys=True) + "\n", encoding="utf-8")
    return summary


def _stages(folder: Path, store: ScanStore) -> bytes | None:
    """JPEG of a keyframe's stages for the report; None for a scan without keyframes."""
    seq = middle_keyframe(folder, store.seqs())
    keyframe = None if seq is None else store.keyframe(seq)
    if keyframe is None:
        return None
    picture, _ = stages(folder, store.header.scan_id, keyframe)
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()


def _resolution_m(header: ScanHeader) -> float | None:
    """``scan.resolution_m`` of the scan's configuration; None when it leaves that open."""
    section = header.configuration.get("scan", {})
    value = section.get("resolution_m") if isinstance(section, dict) else None
    return float(value) if isinstance(value, int | float) and value > 0.0 else None


@contextmanager
def writing(path: Path) -> Iterator[Path]:
    """A path beside ``path`` to write to; renamed onto it when all went well, else removed.

    A failure of the disk becomes an OutsideError.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield part
        with open(part, "rb+") as written:
            os.fsync(written.fileno())
        os.replace(part, path)
    except OSError as error:
        raise OutsideError(
            f"cannot write {path} ({error.strerror or error}); check the disk and its rights"
        ) from error
    finally:
        part.unlink(missing_ok=True)


def local_frame(header: ScanHeader) -> LocalFrame | None:
    """The scan's place on the globe, or None when it has none."""
    lat, lon, alt = header.origin_lat_deg, header.origin_lon_deg, header.origin_alt_amsl_m
    if lat is None or lon is None:
        return None
    return LocalFrame(lat, lon, alt or 0.0)


def latest(poses: Iterator[PoseRecord]) -> list[PoseRecord]:
    """The poses in order of time; where a time was written again, only its last record."""
    return sorted({p.time_unix_ns: p for p in poses}.values(), key=lambda p: p.time_unix_ns)


def surface(fused: FusedCloud, most_cells: float = PREVIEW_CELLS) -> Raster | None:
    """The upper surface in the scan's own ENU metres, or None without points.

    Cells are the voxels, doubled until there are at most ``most_cells`` in the rectangle.
    """
    if not len(fused.cloud):
        return None
    xy = fused.cloud.xyz_m[:, :2].astype(np.float64)
    cell = fused.voxel_m
    span = np.ptp(xy, axis=0)
    while float(np.prod(span / cell + 2.0)) > most_cells:
        cell *= 2.0
    return rasterise(fused.cloud, grid_over(xy, cell, margin_cells=1))


def _tum(poses: Sequence[PoseRecord]) -> str:
    """TUM lines: unix seconds, then T_world_camera as tx ty tz qx qy qz qw."""
    lines = []
    for pose in poses:
        w, x, y, z = se3.quaternion_from_rotation(pose.T_world_camera[:3, :3])
        numbers = " ".join(f"{v:.6f}" for v in pose.T_world_camera[:3, 3])
        lines.append(f"{_seconds(pose.time_unix_ns)} {numbers} {x:.9f} {y:.9f} {z:.9f} {w:.9f}\n")
    return "".join(lines)


def _seconds(time_unix_ns: int) -> str:
    """Seconds with nine decimals, exactly."""
    return f"{time_unix_ns // 10**9}.{time_unix_ns % 10**9:09d}"


def _csv(poses: Sequence[PoseRecord]) -> str:
    """The trajectory as a table; a value that is not known is empty."""
    out = io.StringIO()
    table = csv.writer(out, lineterminator="\n")
    table.writerow(CSV_COLUMNS)
    for p in poses:
        angles = (p.roll_rad, p.pitch_rad, p.yaw_rad)
        table.writerow(
            [
                _seconds(p.time_unix_ns),
                _cell(p.lat_deg, 9),
                _cell(p.lon_deg, 9),
                _cell(p.alt_amsl_m, 3),
                _cell(p.agl_m, 3),
                *(_cell(math.degrees(a), 4) for a in angles),
                _cell(p.speed_m_s, 3),
                _cell(p.distance_m, 3),
                _cell(math.degrees(p.turn_rate_rad_s), 3),
                "+".join(p.sources),
                _cell(p.sigma_m, 4),
            ]
        )
    return out.getvalue()


def _cell(value: float | None, decimals: int) -> str:
    return "" if value is None or not math.isfinite(value) else f"{value:.{decimals}f}"


def _summary(
    header: ScanHeader,
    frame: LocalFrame | None,
    poses: Sequence[PoseRecord],
    fused: FusedCloud,
    raster: Raster | None,
    extra: dict[str, Any],
    finished: bool,
) -> dict[str, Any]:
    """What scan.json holds."""
    notes = list(header.notes) + list(fused.notes)
    if frame is None:
        notes.append(NO_GEOREFERENCE)
    times = [p.time_unix_ns / 1e9 for p in poses]
    origin = None
    if frame is not None:
        origin = {
            "lat_deg": frame.lat_deg,
            "lon_deg": frame.lon_deg,
            "alt_amsl_m": frame.alt_amsl_m,
        }
    return {
        "schema": 1,
        "id": header.scan_id,
        "drone": header.drone,
        "times": {
            "started_unix_s": header.started_unix_ns / 1e9,
            "first_pose_unix_s": times[0] if times else None,
            "last_pose_unix_s": times[-1] if times else None,
        },
        "finished": finished,
        "origin": origin,
        "epsg": None if frame is None else frame.epsg,
        "heights": "metres above mean sea level" if frame else "metres above the scan's origin",
        "georeference": header.georeference,
        "camera": header.camera,
        "configuration": header.configuration,
        "software": header.software,
        "counts": {
            "keyframes": fused.keyframes,
            "points": len(fused.cloud),
            "points_before_fusion": fused.points_in,
            "poses": len(poses),
        },
        "quality": _quality(fused, raster, poses),
        "notes": notes,
        "run": extra,
    }


def _quality(
    fused: FusedCloud, raster: Raster | None, poses: Sequence[PoseRecord]
) -> dict[str, Any]:
    """Figures of the cloud and the track; None where there is nothing to measure."""
    cloud = fused.cloud
    none = not len(cloud)
    return {
        "voxel_m": round(fused.voxel_m, 4),
        "ground_sample_m": None
        if fused.ground_sample_m is None
        else round(fused.ground_sample_m, 4),
        "sigma_median_m": None if none else round(float(np.median(cloud.sigma_m)), 4),
        "sigma_90_percent_m": None if none else round(float(np.percentile(cloud.sigma_m, 90)), 4),
        "views_median": None if none else float(np.median(cloud.views)),
        "seen_once_share": None if none else round(float((cloud.views <= 1).mean()), 4),
        "area_m2": 0.0 if raster is None else round(raster.area_m2, 1),
        "distance_m": round(poses[-1].distance_m, 2) if poses else 0.0,
        "position_sigma_median_m": (
            round(float(np.median([p.sigma_m for p in poses])), 4) if poses else None
        ),
    }


def _preview(raster: Raster | None, poses: Sequence[PoseRecord], summary: dict[str, Any]) -> bytes:
    """preview.jpg."""
    lines = _key_figures(summary)
    if raster is None:
        picture = blank_preview(lines)
    else:
        track = np.array([p.T_world_camera[:3, 3] for p in poses]).reshape(-1, 3)
        zero = summary["origin"]["alt_amsl_m"] if summary["origin"] else 0.0
        picture = draw_preview(raster, track, lines, height_of_zero_m=zero)
    ok, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 90])
    if not ok:
        raise OutsideError("preview.jpg: OpenCV cannot write JPEG on this machine")
    return data.tobytes()


def _key_figures(summary: dict[str, Any]) -> list[str]:
    """Two or three lines of text for the preview (ASCII: OpenCV's letters have no more)."""
    counts, quality, origin = summary["counts"], summary["quality"], summary["origin"]
    place = "no georeference"
    if origin is not None:
        place = f"{origin['lat_deg']:.6f}, {origin['lon_deg']:.6f}  EPSG:{summary['epsg']}"
    figures = [f"{counts['points']} points from {counts['keyframes']} keyframes"]
    if counts["points"]:
        figures += [
            f"{quality['area_m2']:.0f} m2",
            f"sigma {quality['sigma_median_m']:.2f} m",
            f"voxel {quality['voxel_m']:.2f} m",
        ]
    figures.append(f"{quality['distance_m']:.0f} m flown")
    name = summary["id"].encode("ascii", "replace").decode()
    return [f"{name}   {place}", ",  ".join(figures)]
