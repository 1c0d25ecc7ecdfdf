"""The fused cloud as PLY and as LAZ."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from service.exports.view import ExportOptions, ScanView
from service.scans.las import write_laz
from service.scans.writing import writing

PLY_TYPES = [
    ("x", "<f8", "double"),
    ("y", "<f8", "double"),
    ("z", "<f8", "double"),
    ("red", "u1", "uchar"),
    ("green", "u1", "uchar"),
    ("blue", "u1", "uchar"),
    ("sigma_m", "<f4", "float"),
    ("views", "u1", "uchar"),
]


def write_ply(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """Binary PLY in UTM metres (doubles: single precision steps by half a metre there)."""
    cloud = scan.fused.cloud
    rows = np.zeros(len(cloud), np.dtype([(name, kind) for name, kind, _ in PLY_TYPES]))
    rows["x"], rows["y"], rows["z"] = scan.xyz_m.T
    rows["red"], rows["green"], rows["blue"] = cloud.rgb.T
    rows["sigma_m"], rows["views"] = cloud.sigma_m, cloud.views
    crs = "local ENU metres" if scan.frame is None else f"EPSG:{scan.frame.epsg}, AMSL metres"
    head = ["ply", "format binary_little_endian 1.0", f"comment {crs}"]
    head += [f"element vertex {len(cloud)}"]
    head += [f"property {kind} {name}" for name, _, kind in PLY_TYPES]
    head += ["end_header", ""]
    with writing(out) as part, open(part, "wb") as file:
        file.write("\n".join(head).encode("ascii"))
        file.write(rows.tobytes())


def write_laz_file(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """LAZ, or plain LAS where the name ends so."""
    laz = out.suffix.lower() != ".las"
    with writing(out) as part:
        write_laz(part, scan.fused.cloud, scan.frame, scan.store.header.started_unix_ns, laz)
