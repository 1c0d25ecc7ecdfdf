"""The fused cloud as PLY, LAZ, COPC and 3D Tiles.

COPC 1.0 is an octree in a LAZ file whose upper levels are thinned samples. 3D Tiles are placed on
the globe for Cesium and three.js viewers.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from recon.mapping.cloud_fusion import without
from recon.types import F64, I64, U8
from service.errors import InputError
from service.georeference import map_crs
from service.offline.exports.flight import writing_folder
from service.offline.exports.rasters import GROUND_MARGIN_M
from service.offline.exports.surface import bare_ground, surface_model
from service.offline.exports.view import ExportOptions, ProductJob, ScanView
from service.offline.tiles import run_tiles
from service.progress import Progress
from service.scans.fused_cloud import SCALE_M, LazPart, las_header, point_record, write_laz
from service.scans.writing import writing

if TYPE_CHECKING:
    import copclib
    import laspy

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
    crs = "local ENU metres"
    if scan.frame is not None:
        heights = "AMSL metres" if options.to_datum is None else f"metres {options.above}"
        crs = f"EPSG:{scan.frame.epsg}, {heights}"
    head = ["ply", "format binary_little_endian 1.0", f"comment {crs}"]
    head += [f"element vertex {len(cloud)}"]
    head += [f"property {kind} {name}" for name, _, kind in PLY_TYPES]
    head += ["end_header", ""]
    with writing(out) as part, open(part, "wb") as file:
        file.write("\n".join(head).encode("ascii"))
        file.write(rows.tobytes())


def write_laz_file(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """LAZ, or plain LAS where the name ends so; points of the bare ground have class 2."""
    laz = out.suffix.lower() != ".las"
    started_ns = scan.store.header.started_unix_ns
    cut = scan.tiling(options, GROUND_MARGIN_M)
    if len(cut.tiles) == 1:
        parts: Iterator[LazPart] = iter([(scan.fused.cloud, scan.xyz_m, classes(scan))])
    else:
        fixed = scan.for_tiles(options, cut)
        jobs = [ProductJob(tile, "laz", replace(fixed, cell_m=None)) for tile in cut.tiles]
        made = run_tiles(make_points, jobs, options.scheduler, scan.progress)
        parts = (part for part in made if part is not None)
    first = next(parts, None)
    if first is None:
        raise InputError(f"{scan.folder} contains no points yet; nothing to export")
    with writing(out) as file:
        write_laz(file, chain([first], parts), scan.frame, started_ns, laz, options.datum)


def make_points(job: ProductJob, progress: Progress | None = None) -> LazPart | None:
    """The points of one tile; None without any."""
    with ScanView(Path(job.tile.folder), job.options.voxel_m, progress, job.tile) as view:
        if not view.has_points:
            return None
        scan = view.converted(job.options)
        west, south, east, north = job.tile.box
        x, y = scan.xyz_m[:, 0], scan.xyz_m[:, 1]
        outside = (x < west) | (x >= east) | (y < south) | (y >= north)
        if outside.all():
            return None
        return without(scan.fused.cloud, outside), scan.xyz_m[~outside], classes(scan)[~outside]


UNCLASSIFIED, GROUND = 1, 2
GROUND_WITHIN_M = 0.3


def classes(scan: ScanView) -> U8:
    """(N,) class of each point of the fused cloud after LAS 1.4: bare ground, or unclassified."""
    raster = surface_model(scan, None).raster
    height = bare_ground(scan, None).everywhere_m
    below = height[raster.grid.cells(scan.xyz_m[:, :2])]
    is_ground = np.abs(scan.xyz_m[:, 2] - below) <= GROUND_WITHIN_M
    return np.where(is_ground, GROUND, UNCLASSIFIED).astype(np.uint8)


SAMPLES_PER_SIDE = 128
"""A node above the leaves holds at most one point in each of its 128^3 cells."""

LEAF_POINTS = 20_000
DEEPEST = 16
LEGACY_COUNTS_AT, FIRST_RETURNS_AT = 107, 255
"""In the header of LAS 1.4: numbers of points for older readers, zero with point format 7; number
of first returns, which all points are."""


def write_copc(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """The fused cloud as COPC, with sigma_m and views and the EPSG code as WKT."""
    import copclib

    vertical = options.datum
    header = las_header(scan.xyz_m, scan.frame, scan.store.header.started_unix_ns, vertical)
    record = point_record(header, scan.xyz_m, scan.fused.cloud)
    record["classification"] = classes(scan)
    raw = np.frombuffer(record.memoryview(), np.int8).reshape(len(record), -1)
    xyz = np.column_stack([record.x, record.y, record.z])
    centre, half = _cube(xyz)
    with writing(out) as part:
        writer = copclib.FileWriter(str(part), _config(header, scan, xyz, centre, half, vertical))
        for key, rows in octree(xyz, centre - half, 2.0 * half):
            data = copclib.VectorChar(raw[rows].ravel())
            writer.AddNode(copclib.VoxelKey(*key), data)
        writer.Close()
        with open(part, "r+b") as file:  # copclib fills the first and leaves out the second
            file.seek(LEGACY_COUNTS_AT)
            file.write(bytes(24))
            file.seek(FIRST_RETURNS_AT)
            file.write(len(record).to_bytes(8, "little"))


def _cube(xyz: F64) -> tuple[F64, float]:
    """Centre and half side of a cube around the points, a little larger than them."""
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    return 0.5 * (low + high), float(0.5 * (high - low).max() * 1.001 + 0.01)


def _config(
    header: laspy.LasHeader,
    scan: ScanView,
    xyz: F64,
    centre: F64,
    half: float,
    vertical: str | None,
) -> copclib.CopcConfigWriter:
    """COPC's header for these points."""
    import copclib

    extra = _extra_bytes(header)
    vector = copclib.Vector3
    wkt = ""
    if scan.frame is not None:  # WKT1 knows no ellipsoidal heights of a map
        version = "WKT2_2019" if vertical == "ellipsoid" else "WKT1_GDAL"
        wkt = map_crs(scan.frame.epsg, vertical).to_wkt(version)
    config = copclib.CopcConfigWriter(
        7, vector([SCALE_M] * 3), vector(list(map(float, header.offsets))), wkt, extra, False
    )
    config.las_header.min = vector(list(map(float, xyz.min(axis=0))))
    config.las_header.max = vector(list(map(float, xyz.max(axis=0))))
    config.las_header.generating_software = "skyrelief"
    config.las_header.SetGpsTimeBit()  # standard time
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
    """(depth, x, y, z) of each node and the rows of its points; every row appears once."""
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


EARTH_CENTRED = 4978


def write_tiles(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """A folder with ``tileset.json`` and its point tiles, in earth-centred metres.

    Heights go in as they are. Unless they are converted to the ellipsoid, a globe with ellipsoidal
    terrain shows the cloud lower or higher by the geoid's height.
    """
    from py3dtiles.convert import convert
    from pyproj import CRS

    frame = scan.needs_place("3D Tiles")
    with writing_folder(out) as part, tempfile.TemporaryDirectory() as work:
        las = Path(work) / "cloud.las"
        write_laz(
            las,
            [(scan.fused.cloud, None, None)],
            frame,
            scan.store.header.started_unix_ns,
            laz=False,
        )
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
