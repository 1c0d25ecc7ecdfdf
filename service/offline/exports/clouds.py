"""The fused cloud as PLY, LAZ, COPC and 3D Tiles.

COPC 1.0 is an octree in a LAZ file whose upper levels are thinned samples. 3D Tiles are placed on
the globe for Cesium and three.js viewers.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from recon.mapping.cloud_fusion import without
from recon.types import F64, I64, U8, Array, PointCloud
from service.offline.exports.rasters import GROUND_MARGIN_M
from service.offline.exports.surface import bare_ground
from service.offline.exports.view import ExportOptions, ScanView, in_parts
from service.scans.fused_cloud import CHUNK_POINTS, SCALE_M, Box, las_wkt, write_laz
from service.scans.writing import writing, writing_folder

if TYPE_CHECKING:
    import copclib
    import laspy

PlacedPart = tuple[PointCloud, F64, U8 | None]
"""Points, their places (N, 3) in UTM, and their classes of LAS 1.4 where classified."""

VOXELS_MARGIN_M = 2.0
"""Around a tile: points next to it contradict those at its border."""

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
    crs = "local ENU metres"
    if scan.frame is not None:
        crs = f"EPSG:{scan.frame.epsg}, metres {scan.above(options)}"
    count = 0
    with writing(out) as part, open(part, "wb") as file:
        file.write(_ply_head(crs, count))
        for cloud, xyz_m, _ in points_of(scan, options, is_classified=False):
            rows = np.zeros(len(cloud), np.dtype([(name, kind) for name, kind, _ in PLY_TYPES]))
            rows["x"], rows["y"], rows["z"] = xyz_m.T
            rows["red"], rows["green"], rows["blue"] = cloud.rgb.T
            rows["sigma_m"], rows["views"] = cloud.sigma_m, cloud.views
            file.write(rows.data)
            count += len(rows)
        file.seek(0)
        file.write(_ply_head(crs, count))


def _ply_head(crs: str, count: int) -> bytes:
    """The header for ``count`` points, of one length for any: the comment is padded."""
    fields = [(kind, name) for name, _, kind in PLY_TYPES]
    return ply_head(crs.ljust(100 - len(str(count))), count, fields)


def ply_head(comment: str, count: int, fields: Iterable[tuple[str, str]]) -> bytes:
    """The header of a binary PLY of ``count`` vertices; ``fields`` are types and names."""
    head = ["ply", "format binary_little_endian 1.0", f"comment {comment}"]
    head += [f"element vertex {count}", *(f"property {kind} {name}" for kind, name in fields)]
    return "\n".join([*head, "end_header", ""]).encode("ascii")


def write_laz_file(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """LAZ, or plain LAS where the name ends so; points of the bare ground have class 2."""
    with writing(out) as file:
        _write_las(scan, file, options, laz=out.suffix.lower() != ".las")


def _write_las(scan: ScanView, path: Path, options: ExportOptions, laz: bool) -> None:
    parts, started_ns = points_of(scan, options), scan.store.header.started_unix_ns
    write_laz(path, parts, scan.frame, started_ns, laz, options.datum, scan.shared_sigma)


def points_of(
    scan: ScanView, options: ExportOptions, is_classified: bool = True
) -> Iterator[PlacedPart]:
    """The fused cloud, tile by tile where there are more points than one may have.

    Raises InputError, at the first, when there is not a single point.
    """
    margin_m = GROUND_MARGIN_M if is_classified else VOXELS_MARGIN_M
    return in_parts(scan, partial(_placed, is_classified=is_classified), options, margin_m)


def _placed(scan: ScanView, _: ExportOptions, box: Box, is_classified: bool) -> PlacedPart | None:
    """The points in the box; None without any."""
    kinds = classes(scan) if is_classified else None
    west, south, east, north = box
    x, y = scan.xyz_m[:, 0], scan.xyz_m[:, 1]
    outside = (x < west) | (x >= east) | (y < south) | (y >= north)
    if outside.all():
        return None
    if not outside.any():
        return scan.fused.cloud, scan.xyz_m, kinds
    kept = None if kinds is None else kinds[~outside]
    return without(scan.fused.cloud, outside), scan.xyz_m[~outside], kept


UNCLASSIFIED, GROUND = 1, 2
GROUND_WITHIN_M = 0.3


def classes(scan: ScanView) -> U8:
    """(N,) class of each point of the fused cloud after LAS 1.4: bare ground, or unclassified."""
    height = bare_ground(scan, None).everywhere_m
    below = height[scan.grid(None).cells(scan.xyz_m[:, :2])]
    is_ground = np.abs(scan.xyz_m[:, 2] - below) <= GROUND_WITHIN_M
    return np.where(is_ground, GROUND, UNCLASSIFIED).astype(np.uint8)


SAMPLES_PER_SIDE = 128
"""A node above the leaves holds at most one point in each of its 128^3 cells."""

LEAF_POINTS = 20_000
DEEPEST = 16
MASK = (1 << 21) - 1  # of one axis in the number of a cell
MAX_SHARED_LEVELS = 5
"""Above nodes that are made by themselves: the cells taken there are held, at most millions."""
LEGACY_COUNTS_AT, FIRST_RETURNS_AT = 107, 255
"""In the header of LAS 1.4: numbers of points for older readers, zero with point format 7; number
of first returns, which all points are."""


def write_copc(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """The fused cloud as COPC, with sigma_m and views and the EPSG code as WKT.

    The points wait in a file beside ``out``: the upper levels of the octree are of all tiles.
    """
    import copclib
    import laspy

    with writing(out) as part, tempfile.TemporaryDirectory(dir=out.parent) as work:
        las = Path(work) / "points.las"
        _write_las(scan, las, options, laz=False)
        with laspy.open(las) as points:
            header = points.header
        sizes = header.point_count, header.point_format.size
        raw = np.memmap(las, np.int8, "r", header.offset_to_point_data, sizes)
        xyz = raw[:, :12].view("<i4")  # in units of SCALE_M
        half_m = 0.5 * float((header.maxs - header.mins).max()) * 1.001 + 0.01
        config = _config(las, header, scan, half_m, options.datum)
        writer = copclib.FileWriter(str(part), config)
        low = (0.5 * (header.mins + header.maxs) - half_m - header.offsets) / SCALE_M
        side = 2.0 * half_m / SCALE_M
        for key, rows in octree_in_parts(xyz, low, side, options.tile_points):
            data = copclib.VectorChar(raw[rows].ravel())
            writer.AddNode(copclib.VoxelKey(*key), data)
        writer.Close()
        with open(part, "r+b") as file:  # copclib fills the first and leaves out the second
            file.seek(LEGACY_COUNTS_AT)
            file.write(bytes(24))
            file.seek(FIRST_RETURNS_AT)
            file.write(len(raw).to_bytes(8, "little"))


def _config(
    las: Path, header: laspy.LasHeader, scan: ScanView, half_m: float, vertical: str | None
) -> copclib.CopcConfigWriter:
    import copclib

    # Extra dimensions: copclib can read their description but not build it.
    extra = copclib.LazReader(str(las)).laz_config.extra_bytes_vlr
    vector = copclib.Vector3
    wkt = "" if scan.frame is None else las_wkt(scan.frame.epsg, vertical)
    config = copclib.CopcConfigWriter(
        7, vector([SCALE_M] * 3), vector(list(map(float, header.offsets))), wkt, extra, False
    )
    config.las_header.min = vector(list(map(float, header.mins)))
    config.las_header.max = vector(list(map(float, header.maxs)))
    for name in ("generating_software", "system_identifier"):
        setattr(config.las_header, name, getattr(header, name))
    flown = header.creation_date.timetuple()
    config.las_header.creation_year, config.las_header.creation_day = flown.tm_year, flown.tm_yday
    config.las_header.SetGpsTimeBit()  # standard time
    info = config.copc_info
    info.center_x, info.center_y, info.center_z = map(float, 0.5 * (header.mins + header.maxs))
    info.halfsize = half_m
    info.spacing = 2.0 * half_m / SAMPLES_PER_SIDE
    return config


Node = tuple[int, int, int, int]


def octree_in_parts(
    xyz: Array, low: F64, side: float, max_points: int
) -> Iterator[tuple[Node, I64]]:
    """As :func:`octree`, but below the first levels each node by itself.

    The first levels are as many as leave about ``max_points`` to each node below, if points are
    spread evenly over ground.
    """
    levels = min(max(0, math.ceil(0.5 * math.log2(len(xyz) / max_points))), MAX_SHARED_LEVELS)
    level = np.full(len(xyz), levels, np.uint8)
    node = np.empty(len(xyz), np.uint16)  # below the first levels
    taken = [np.zeros(0, np.int64)] * levels  # sorted cells of each level
    for at in range(0, len(xyz), CHUNK_POINTS):
        some = slice(at, at + CHUNK_POINTS)
        unit = (xyz[some] - low) / side
        level[some] = _sampled(unit, taken)
        node[some] = _packed(unit, 2**levels, MAX_SHARED_LEVELS)
    for depth in range(levels):
        rows = np.flatnonzero(level == depth)
        yield from _nodes(depth, _packed((xyz[rows] - low) / side, 2**depth), rows)
    lower = level == levels
    for one in np.unique(node[lower]):
        yield from octree(xyz, low, side, np.flatnonzero(lower & (node == one)), levels)


def _sampled(unit: F64, taken: list[I64]) -> U8:
    """(N,) level of each place: the first in a cell that is not ``taken`` there, else the one below
    all. Cells become taken."""
    level = np.full(len(unit), len(taken), np.uint8)
    rows = np.arange(len(unit))
    for depth, known in enumerate(taken):
        cells, first = np.unique(
            _packed(unit[rows], 2**depth * SAMPLES_PER_SIDE), return_index=True
        )
        new = ~np.isin(cells, known, assume_unique=True)
        taken[depth] = np.union1d(known, cells[new])
        level[rows[first[new]]] = depth
        rows = np.delete(rows, first[new])
    return level


def _packed(unit: F64, count: int, bits: int = 21) -> I64:
    """The number of each place's cell, of ``count`` along each side of the cube."""
    cell = np.floor(unit * count).astype(np.int64)
    return (cell[:, 0] << 2 * bits) | (cell[:, 1] << bits) | cell[:, 2]


def octree(
    xyz: Array, low: F64, side: float, rows: I64 | None = None, first_depth: int = 0
) -> Iterator[tuple[Node, I64]]:
    """(depth, x, y, z) of each node and the rows of its points; every row appears once."""
    rows = np.arange(len(xyz)) if rows is None else rows
    unit = (xyz[rows] - low) / side
    for depth in range(first_depth, DEEPEST + 1):
        if not len(rows):
            return
        key = _packed(unit, 2**depth)
        _, which, count = np.unique(key, return_inverse=True, return_counts=True)
        stays = count[which] <= LEAF_POINTS
        if depth == DEEPEST:
            stays[:] = True
        _, first = np.unique(_packed(unit, 2**depth * SAMPLES_PER_SIDE), return_index=True)
        stays[first] = True
        yield from _nodes(depth, key[stays], rows[stays])
        rows, unit = rows[~stays], unit[~stays]


def _nodes(depth: int, key: I64, rows: I64) -> Iterator[tuple[Node, I64]]:
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(key[order]) != 0])
    for part in np.split(order, starts[1:]):
        cell = int(key[part[0]])
        yield (depth, cell >> 42, cell >> 21 & MASK, cell & MASK), rows[part]


EARTH_CENTRED = 4978


def write_tiles(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """A folder with ``tileset.json`` and its point tiles, in earth-centred metres.

    Heights go in as they are. Unless they are converted to the ellipsoid, a globe with ellipsoidal
    terrain shows the cloud lower or higher by the geoid's height.
    """
    from py3dtiles.convert import convert
    from py3dtiles.exceptions import WorkerException
    from pyproj import CRS

    frame = scan.needs_place("3D Tiles")
    with writing_folder(out) as part, tempfile.TemporaryDirectory() as work:
        las = Path(work) / "cloud.las"
        parts = points_of(scan, options, is_classified=False)
        started_ns = scan.store.header.started_unix_ns
        write_laz(las, parts, frame, started_ns, laz=False, shared=scan.shared_sigma)
        try:
            convert(
                las,
                outfolder=part,
                overwrite=True,
                jobs=1,
                crs_in=CRS.from_epsg(frame.epsg),
                crs_out=CRS.from_epsg(EARTH_CENTRED),
                force_crs_in=True,
                pyproj_always_xy=True,
                rgb=True,
            )
        except WorkerException as error:  # its process has no memory, or no room on the disk
            raise OSError(str(error)) from error
