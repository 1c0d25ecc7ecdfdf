"""Georeference, camera and trajectory of a stored scan, also as tables."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Sequence

import numpy as np

from recon import se3
from recon.types import F64, Camera
from service.cameras.camera_file import shutter_of
from service.errors import InputError
from service.georeference import LocalFrame, vertical_code
from service.stream.records import PoseRecord, ScanHeader


def local_frame(header: ScanHeader) -> LocalFrame | None:
    """The scan's georeference, or None when it has none."""
    lat, lon, alt = header.origin_lat_deg, header.origin_lon_deg, header.origin_alt_amsl_m
    if lat is None or lon is None:
        return None
    return LocalFrame(lat, lon, alt or 0.0)


def flown_datum(header: ScanHeader) -> str | None:
    """The datum of heights as flown, as for ``vertical_code``, where the scan states it."""
    try:
        vertical_code(header.vertical_datum)
    except ValueError:
        return None
    return header.vertical_datum


def heights_above(frame: LocalFrame | None, datum: str | None, lacks_altitude: bool) -> str:
    """What heights are above, in words."""
    if frame is None or lacks_altitude:
        return "metres above the scan's origin"
    return f"metres above {datum or 'mean sea level'}"


def camera_of(header: ScanHeader) -> Camera:
    """The camera that a scan was flown with. Raises InputError when the header names none."""
    c = header.camera
    try:
        K = np.array(c["K"], np.float64).reshape(3, 3)
        distortion = np.array(c["distortion"], np.float64).reshape(5)
        shutter = shutter_of(c.get("readout_ms", 0), c.get("readout_direction", "down"))
        return Camera(K, distortion, (int(c["width"]), int(c["height"])), shutter)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"scan {header.scan_id} contains no camera model") from error


def flown_m(poses: Sequence[PoseRecord]) -> F64:
    """(N,) way along the poses as they are now; their own was summed before later corrections."""
    places = np.array([p.T_world_camera[:3, 3] for p in poses]).reshape(-1, 3)
    return np.cumsum(np.linalg.norm(np.diff(places, axis=0, prepend=places[:1]), axis=1))


def tum_lines(poses: Sequence[PoseRecord]) -> str:
    """TUM lines: unix seconds, then T_world_camera as tx ty tz qx qy qz qw."""
    lines = []
    for pose in poses:
        w, x, y, z = se3.quaternion_from_rotation(pose.T_world_camera[:3, :3])
        numbers = " ".join(f"{v:.6f}" for v in pose.T_world_camera[:3, 3])
        lines.append(
            f"{seconds_text(pose.time_unix_ns)} {numbers} {x:.9f} {y:.9f} {z:.9f} {w:.9f}\n"
        )
    return "".join(lines)


def seconds_text(time_unix_ns: int) -> str:
    return f"{time_unix_ns // 10**9}.{time_unix_ns % 10**9:09d}"


def csv_table(poses: Sequence[PoseRecord]) -> str:
    """The trajectory as a table; unknown values are empty."""
    distances_m = iter(flown_m(poses))
    columns: dict[str, Callable[[PoseRecord], str]] = {
        "time_unix_s": lambda p: seconds_text(p.time_unix_ns),
        "lat_deg": lambda p: cell(p.lat_deg, 9),
        "lon_deg": lambda p: cell(p.lon_deg, 9),
        "alt_amsl_m": lambda p: cell(p.alt_amsl_m, 3),
        "agl_m": lambda p: cell(p.agl_m, 3),
        "roll_deg": lambda p: cell(math.degrees(p.roll_rad), 4),
        "pitch_deg": lambda p: cell(math.degrees(p.pitch_rad), 4),
        "yaw_deg": lambda p: cell(math.degrees(p.yaw_rad), 4),
        "speed_m_s": lambda p: cell(p.speed_m_s, 3),
        "distance_m": lambda _: cell(next(distances_m), 3),
        "turn_rate_deg_s": lambda p: cell(math.degrees(p.turn_rate_rad_s), 3),
        "sources": lambda p: "+".join(p.sources),
        "sigma_m": lambda p: cell(p.sigma_m, 4),
    }
    out = io.StringIO()
    table = csv.writer(out, lineterminator="\n")
    table.writerow(columns)
    table.writerows([text(p) for text in columns.values()] for p in poses)
    return out.getvalue()


def cell(value: float | None, decimals: int) -> str:
    return "" if value is None or not math.isfinite(value) else f"{value:.{decimals}f}"
