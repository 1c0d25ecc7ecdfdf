"""LAS and LAZ files of a fused cloud: LAS 1.4, point format 7, sigma_m and views per point."""

from __future__ import annotations

import datetime as dt
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from recon.types import F64, PointCloud
from service.georeference import LocalFrame

if TYPE_CHECKING:
    import laspy

SCALE_M = 0.001
CHUNK_POINTS = 1_000_000


def placed(cloud: PointCloud, frame: LocalFrame | None) -> F64:
    """(N, 3) UTM metres with AMSL height of the cloud's ENU metres; those without a frame."""
    enu = cloud.xyz_m.astype(np.float64)
    return enu if frame is None or not len(enu) else frame.to_utm(enu)


def las_header(xyz_m: F64, frame: LocalFrame | None, started_unix_ns: int) -> laspy.LasHeader:
    """The header for points about ``xyz_m``; its dates come from the scan, not from the clock."""
    import laspy
    from pyproj import CRS

    header = laspy.LasHeader(version="1.4", point_format=7)
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams("sigma_m", np.float32, "1 sigma of the position, m"),
            laspy.ExtraBytesParams("views", np.uint8, "stereo pairs that agree"),
        ]
    )
    header.scales = np.full(3, SCALE_M)
    header.offsets = np.floor(xyz_m[0]) if len(xyz_m) else np.zeros(3)
    header.generating_software = "skyrelief"
    header.system_identifier = "camera stereo"
    when = dt.datetime.fromtimestamp(started_unix_ns / 1e9, dt.timezone.utc)
    header.creation_date = when.date()
    header.global_encoding.wkt = True  # LAS 1.4 asks for it with this format, also without a CRS
    if frame is not None:
        header.add_crs(CRS.from_epsg(frame.epsg))
    return header


def write_laz(
    path: Path, cloud: PointCloud, frame: LocalFrame | None, started_unix_ns: int, laz: bool = True
) -> None:
    """Write ``cloud`` (ENU metres) to ``path``, in UTM with AMSL heights when there is a frame.

    RGB are 16 bits as the format wants them (8-bit value times 257).
    """
    import laspy

    header = las_header(placed(_cut(cloud, slice(0, 1)), frame), frame, started_unix_ns)
    kind: dict[str, Any] = {"do_compress": laz, "closefd": False}
    with open(path, "wb") as file, laspy.open(file, "w", header=header, **kind) as out:
        for at in range(0, len(cloud), CHUNK_POINTS):
            part = _cut(cloud, slice(at, at + CHUNK_POINTS))
            out.write_points(point_record(header, placed(part, frame), part))


def _cut(cloud: PointCloud, cut: slice) -> PointCloud:
    return PointCloud(cloud.xyz_m[cut], cloud.rgb[cut], cloud.sigma_m[cut], cloud.views[cut])


def point_record(
    header: laspy.LasHeader, xyz_m: F64, cloud: PointCloud
) -> laspy.ScaleAwarePointRecord:
    """The cloud's points as LAS records, at the places ``xyz_m`` (N, 3)."""
    import laspy

    record = laspy.ScaleAwarePointRecord.zeros(len(xyz_m), header=header)
    record.x, record.y, record.z = xyz_m.T
    for channel, name in enumerate(("red", "green", "blue")):
        setattr(record, name, cloud.rgb[:, channel].astype(np.uint16) * 257)
    record["return_number"] = np.ones(len(record), np.uint8)
    record["number_of_returns"] = np.ones(len(record), np.uint8)
    record["sigma_m"] = cloud.sigma_m
    record["views"] = cloud.views
    return record
