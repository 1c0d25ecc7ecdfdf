"""Cloud-optimised LAZ (COPC 1.0): an octree whose upper levels are thinned samples."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from recon.types import F64
from service.exports.view import ExportOptions, ScanView
from service.scans.las import SCALE_M, las_header, point_record
from service.scans.writing import writing

if TYPE_CHECKING:
    import copclib
    import laspy

I64 = npt.NDArray[np.int64]

SAMPLES_PER_SIDE = 128
"""A node above the leaves holds at most one point in each of its 128^3 cells."""

LEAF_POINTS = 20_000
DEEPEST = 16


def write_copc(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """The fused cloud as COPC, with sigma_m and views and the EPSG code as WKT."""
    import copclib

    header = las_header(scan.xyz_m, scan.frame, scan.store.header.started_unix_ns)
    record = point_record(header, scan.xyz_m, scan.fused.cloud)
    raw = np.frombuffer(record.memoryview(), np.int8).reshape(len(record), -1)
    xyz = np.column_stack([record.x, record.y, record.z])
    centre, half = _cube(xyz)
    with writing(out) as part:
        writer = copclib.FileWriter(str(part), _config(header, scan, xyz, centre, half))
        for key, rows in octree(xyz, centre - half, 2.0 * half):
            data = copclib.VectorChar(raw[rows].ravel())
            writer.AddNode(copclib.VoxelKey(*key), data)
        writer.Close()


def _cube(xyz: F64) -> tuple[F64, float]:
    """Centre and half side of a cube around the points, a little larger than them."""
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    return 0.5 * (low + high), float(0.5 * (high - low).max() * 1.001 + 0.01)


def _config(
    header: laspy.LasHeader, scan: ScanView, xyz: F64, centre: F64, half: float
) -> copclib.CopcConfigWriter:
    """COPC's header for these points."""
    import copclib
    from pyproj import CRS

    extra = _extra_bytes(header)
    vector = copclib.Vector3
    wkt = "" if scan.frame is None else CRS.from_epsg(scan.frame.epsg).to_wkt("WKT1_GDAL")
    config = copclib.CopcConfigWriter(
        7, vector([SCALE_M] * 3), vector(list(map(float, header.offsets))), wkt, extra, False
    )
    config.las_header.min = vector(list(map(float, xyz.min(axis=0))))
    config.las_header.max = vector(list(map(float, xyz.max(axis=0))))
    config.las_header.generating_software = "skyrelief"
    info = config.copc_info
    info.center_x, info.center_y, info.center_z = map(float, centre)
    info.halfsize = half
    info.spacing = 2.0 * half / SAMPLES_PER_SIDE
    return config


def _extra_bytes(header: laspy.LasHeader) -> copclib.EbVlr:
    """The description of the extra dimensions; copclib can read it but not build it."""
    import copclib
    import laspy

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "one_point.laz"
        laspy.LasData(header, laspy.ScaleAwarePointRecord.zeros(1, header=header)).write(str(path))
        return copclib.LazReader(str(path)).laz_config.extra_bytes_vlr


def octree(xyz: F64, low: F64, side: float) -> Iterator[tuple[tuple[int, int, int, int], I64]]:
    """(depth, x, y, z) of each node and the rows of its points; every row comes once."""
    rows = np.arange(len(xyz))
    unit = (xyz - low) / side
    for depth in range(DEEPEST + 1):
        if not len(rows):
            return
        node = np.floor(unit[rows] * 2**depth).astype(np.int64)
        key = (node[:, 0] << 40) | (node[:, 1] << 20) | node[:, 2]
        _, which, count = np.unique(key, return_inverse=True, return_counts=True)
        stays = count[which] <= LEAF_POINTS
        if depth == DEEPEST:
            stays[:] = True
        cell = np.floor(unit[rows] * 2**depth * SAMPLES_PER_SIDE).astype(np.int64)
        packed = (cell[:, 0] << 42) ^ (cell[:, 1] << 21) ^ cell[:, 2]
        _, first = np.unique(packed, return_index=True)
        stays[first] = True
        yield from _nodes(depth, node[stays], key[stays], rows[stays])
        rows = rows[~stays]


def _nodes(
    depth: int, node: I64, key: I64, rows: I64
) -> Iterator[tuple[tuple[int, int, int, int], I64]]:
    """The rows of each node of one level."""
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(key[order]) != 0])
    for part in np.split(order, starts[1:]):
        x, y, z = (int(v) for v in node[part[0]])
        yield (depth, x, y, z), rows[part]
