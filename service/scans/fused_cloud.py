"""The fused cloud of a scan, from the keyframes in its store; LAS and LAZ output.

Files are LAS 1.4, point format 7, with sigma_m and views per point. A point's GPS time is that of
the keyframe that knows it best.
"""

from __future__ import annotations

import datetime as dt
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from recon.mapping.cloud_fusion import (
    cloud_of,
    fuse_strips,
    without,
    without_contradicted,
)
from recon.mapping.free_space import seen_through, spread
from recon.mapping.voxel_map import ground_sample_m
from recon.parallel import run_parallel, threads
from recon.surface.raster import bounds_of
from recon.types import F64, I64, U8, Keyframe, PointCloud
from service.georeference import LocalFrame, map_crs
from service.memory import release_memory
from service.progress import Progress
from service.scans.main_piece import Keyframes, main_keyframes
from service.scans.trust import SharedSigma

if TYPE_CHECKING:
    import laspy

MIN_STRIP_POINTS, STRIP_POINTS = 100_000, 4_000_000
"""Points that a core fuses at once; the sums of a strip take some hundred bytes each."""

STRIPS_PER_CORE = 4  # the sums of one strip per core are in memory at a time

LARGEST_POINTS = 60_000_000
"""Maximum points before fusion; a scan with more gets larger voxels, and a note."""

SMALLEST_VOXEL_M = 1e-3
DEFAULT_VOXEL_M = 0.25

Box = tuple[float, float, float, float]  # west, south, east, north, m

EVERYWHERE: Box = (-np.inf, -np.inf, np.inf, np.inf)


@dataclass(frozen=True, slots=True, eq=False)
class FusedCloud:
    """A scan's fused cloud in its own ENU metres, and its statistics."""

    cloud: PointCloud
    voxel_m: float
    ground_sample_m: float | None  # median over keyframes
    keyframes: int
    points_in: int
    notes: tuple[str, ...] = ()
    points_out: int | None = None  # where ``cloud`` is only a sample of them


@dataclass(frozen=True, slots=True, eq=False)
class Extent:
    """Ground that one keyframe covers, and how finely."""

    seq: int
    points: int
    ground_sample_m: float
    box: Box


def fused_cloud(
    store: Keyframes,
    voxel_m: float | None = None,
    progress: Progress | None = None,
    box: Box = EVERYWHERE,
    strip_points: int = STRIP_POINTS,
    largest_points: int = LARGEST_POINTS,
    min_strip_points: int = MIN_STRIP_POINTS,
) -> FusedCloud:
    """The main piece of ``store`` fused; voxels of the ground sample distance by default.

    Of the points only those in ``box`` (ENU m) count.

    Points that other keyframes see through are removed. A long scan is read several times, so that
    memory holds only the fused points and the sums of one strip of the site per core.
    """
    progress = progress or Progress()
    with progress.part("reading the keyframes", 0.2):
        extents, held = extents_of(store, progress, box, strip_points)
    points = sum(e.points for e in extents)
    sample = float(np.median([e.ground_sample_m for e in extents])) if extents else None
    size = max(voxel_m or sample or DEFAULT_VOXEL_M, SMALLEST_VOXEL_M)
    notes: tuple[str, ...] = ()
    if points > largest_points:
        size *= float(np.sqrt(points / largest_points))
        notes = (f"{points} points before fusion: voxels enlarged to {size:.3f} m",)
    share = points // (STRIPS_PER_CORE * threads())
    edges = strip_edges(extents, min(strip_points, max(share, min_strip_points)))
    with progress.part("fusing the cloud", 0.5):
        say = partial(progress.counting(len(extents)), progress.text)
        within = [_inside(extents, *ends) for ends in pairwise(edges)]
        uses = Counter(extent.seq for inside in within for extent in inside)
        shares = {seq: uses[seq] * [held.pop(seq)] for seq in [*held]}
        strips = [partial(_strip, store, inside, shares, box, say) for inside in within]
        keys, means = fuse_strips(strips, edges, size)
        release_memory()  # of the strips, before the whole is looked at
        cloud = without_contradicted(keys, means)
        del keys, means
    release_memory()
    if len(cloud):
        with progress.part("removing points that other images see through"):
            keyframes = progress.over(_decoded(store, extents), len(extents))
            cloud = without(cloud, seen_through(cloud, (k.depth for k in keyframes if k)))
    return FusedCloud(cloud, size, sample, len(extents), points, notes)


def extents_of(
    store: Keyframes, progress: Progress, box: Box = EVERYWHERE, room: int = 0
) -> tuple[list[Extent], dict[int, PointCloud]]:
    """The keyframes of the main piece with points, and the clouds of the first ``room`` points."""
    out: list[Extent] = []
    held: dict[int, PointCloud] = {}
    for keyframe in progress.over(main_keyframes(store), len(store.seqs())):
        sample = ground_sample_m(keyframe.depth)
        cloud = _points(keyframe, box)
        if sample is not None and len(cloud):
            around = bounds_of(cloud.xyz_m[:, :2])
            out.append(Extent(keyframe.seq, len(cloud), sample, around))
            room -= len(cloud)
            if room >= 0:
                held[keyframe.seq] = cloud
    return out, held


def _decoded(store: Keyframes, extents: Sequence[Extent]) -> Iterator[Keyframe | None]:
    """The keyframes, spread over the flight, decoded by all cores."""
    calls = [partial(store.keyframe, seq) for seq in spread([e.seq for e in extents])]
    for at in range(0, len(calls), threads()):
        yield from run_parallel(*calls[at : at + threads()])


def _points(keyframe: Keyframe, box: Box) -> PointCloud:
    cloud = cloud_of(keyframe.depth, keyframe.bgr, keyframe.fresh, keyframe.time_ns)
    if box == EVERYWHERE:
        return cloud
    x, y = cloud.xyz_m[:, 0], cloud.xyz_m[:, 1]
    return without(cloud, (x < box[0]) | (x > box[2]) | (y < box[1]) | (y > box[3]))


def strip_edges(extents: Iterable[Extent], max_points: int) -> list[float]:
    """Edges in x, from -inf to inf, of strips with at most about ``max_points`` each. A keyframe's
    points are assumed to be evenly spread over its width."""
    widths = [(e.box[0], e.box[2], e.points) for e in extents]
    ends = [(west, points / max(east - west, 1e-3)) for west, east, points in widths]
    ends += [(east, -points / max(east - west, 1e-3)) for west, east, points in widths]
    if not ends:
        return [-np.inf, np.inf]
    table: F64 = np.array(sorted(ends))
    x, density = table[:, 0], np.cumsum(table[:, 1])
    held = np.concatenate([[0.0], np.cumsum(density[:-1] * np.diff(x))])
    count = max(1, int(np.ceil(held[-1] / max_points)))
    inner = np.interp(held[-1] * np.arange(1, count) / count, held, x)
    return [-np.inf, *(float(v) for v in inner), np.inf]


def _inside(extents: Iterable[Extent], low_m: float, high_m: float) -> list[Extent]:
    margin = 1.0  # edges are moved by up to a voxel
    return [e for e in extents if e.box[2] >= low_m - margin and e.box[0] <= high_m + margin]


def _strip(
    store: Keyframes,
    inside: Iterable[Extent],
    shares: Mapping[int, list[PointCloud]],
    box: Box,
    say: Callable[[], None],
) -> Iterator[PointCloud]:
    """The clouds of the keyframes of a strip, read on demand, or one of the ``shares`` that each
    strip has in those that are held."""
    for extent in inside:
        say()
        if extent.seq in shares:
            yield shares[extent.seq].pop()
        elif (keyframe := store.keyframe(extent.seq)) is not None:
            yield _points(keyframe, box)


SCALE_M = 0.001
CHUNK_POINTS = 50_000
"""Points that are converted at a time; float64 and LAS records take ten times their size."""


def placed(cloud: PointCloud, frame: LocalFrame | None) -> F64:
    """(N, 3) UTM metres with AMSL height of the cloud's ENU metres; unchanged without a frame."""
    enu = cloud.xyz_m.astype(np.float64)
    return enu if frame is None or not len(enu) else frame.to_utm(enu)


def las_wkt(epsg: int, vertical: str | None) -> str:
    """What :func:`service.georeference.map_crs` gives, as LAS 1.4 asks for it: in WKT 1. Only
    ellipsoidal heights are in WKT 2, as WKT 1 has none on a map."""
    version = "WKT2_2019" if vertical == "ellipsoid" else "WKT1_GDAL"
    return map_crs(epsg, vertical).to_wkt(version)


def las_header(
    xyz_m: F64, frame: LocalFrame | None, started_unix_ns: int, vertical: str | None = None
) -> laspy.LasHeader:
    """The header for points near ``xyz_m``; its dates come from the scan, not from the clock.
    ``vertical`` is what :func:`service.georeference.map_crs` takes."""
    import laspy

    header = laspy.LasHeader(version="1.4", point_format=7)
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams("sigma_m", np.float32, "1 sigma within the map, m"),
            laspy.ExtraBytesParams("sigma_absolute_m", np.float32, "of the height in the world"),
            laspy.ExtraBytesParams("views", np.uint8, "stereo pairs that agree"),
        ]
    )
    header.scales = np.full(3, SCALE_M)
    header.offsets = np.floor(xyz_m[0]) if len(xyz_m) else np.zeros(3)
    header.generating_software = "skyrelief"
    header.system_identifier = "camera stereo"
    when = dt.datetime.fromtimestamp(started_unix_ns / 1e9, dt.timezone.utc)
    header.creation_date = when.date()
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.global_encoding.wkt = True  # LAS 1.4 requires it with this format, even without a CRS
    if frame is not None:
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(las_wkt(frame.epsg, vertical)))
    return header


LazPart = tuple[PointCloud, F64 | None, U8 | None]
"""Points, their places (N, 3) in UTM where known, and their classes of LAS 1.4 where classified."""


@dataclass(frozen=True, slots=True, eq=False)
class TiledCloud:
    """A fused cloud that is read tile by tile, and its statistics as in :class:`FusedCloud`."""

    parts: Iterable[LazPart]
    voxel_m: float
    ground_sample_m: float
    keyframes: int
    points_in: int
    bounds: Box  # of the site, m


def thinned(cloud: PointCloud, cell_m: float) -> PointCloud:
    """The highest point of each cell of the ground plan."""
    col, row = np.floor(cloud.xyz_m[:, :2] / cell_m).astype(np.int64).T
    order = np.lexsort((-cloud.xyz_m[:, 2], row, col))
    is_lower = np.zeros(len(cloud), np.bool_)
    is_lower[order[1:]] = (np.diff(col[order]) == 0) & (np.diff(row[order]) == 0)
    return without(cloud, is_lower)


def write_laz(
    path: Path,
    parts: Iterable[LazPart],
    frame: LocalFrame | None,
    started_unix_ns: int,
    laz: bool = True,
    vertical: str | None = None,
    shared: SharedSigma | None = None,
) -> None:
    """Write clouds, at least one, to ``path``, in UTM with AMSL heights when there is a frame.

    They are in ENU metres; ``shared`` is of their points. RGB are 16 bits as the format requires
    (8-bit value times 257). Raises OSError when the disk is full.
    """
    import laspy
    from lazrs import LazrsError

    rest = iter(parts)
    start = next(rest)
    header = las_header(
        placed(_cut(start[0], slice(0, 1)), frame), frame, started_unix_ns, vertical
    )
    kind: dict[str, Any] = {"do_compress": laz, "closefd": False}
    try:
        with open(path, "wb") as file, laspy.open(file, "w", header=header, **kind) as out:
            for cloud, xyz_m, classes in chain([start], rest):
                for at in range(0, len(cloud), CHUNK_POINTS):
                    cut = slice(at, at + CHUNK_POINTS)
                    part = _cut(cloud, cut)
                    places = placed(part, frame) if xyz_m is None else xyz_m[cut]
                    record = point_record(header, places, part, shared)
                    if classes is not None:
                        record["classification"] = classes[cut]
                    out.write_points(record)
    except LazrsError as error:  # its compressor's, of any failure to write
        raise OSError(str(error)) from error


def _cut(cloud: PointCloud, cut: slice) -> PointCloud:
    time_ns = None if cloud.time_ns is None else cloud.time_ns[cut]
    return PointCloud(
        cloud.xyz_m[cut], cloud.rgb[cut], cloud.sigma_m[cut], cloud.views[cut], time_ns=time_ns
    )


def point_record(
    header: laspy.LasHeader, xyz_m: F64, cloud: PointCloud, shared: SharedSigma | None
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
    record["sigma_absolute_m"] = (
        np.full(len(cloud), np.nan)
        if shared is None
        else shared.absolute_m(cloud.sigma_m, cloud.xyz_m)
    )
    record["views"] = cloud.views
    if cloud.time_ns is not None:
        record["gps_time"] = adjusted_gps_s(cloud.time_ns)
    return record


GPS_EPOCH_UNIX_S = 315_964_800
LEAP_UNIX_S = (
    362_793_600, 394_329_600, 425_865_600, 489_024_000, 567_993_600, 631_152_000, 662_688_000,
    709_948_800, 741_484_800, 773_020_800, 820_454_400, 867_715_200, 915_148_800, 1_136_073_600,
    1_230_768_000, 1_341_100_800, 1_435_708_800, 1_483_228_800,
)  # fmt: skip
"""Unix times at which GPS time gained a second on UTC (IERS Bulletin C, none since 2017)."""

GPS_SHIFT_S = 1e9


def adjusted_gps_s(unix_ns: I64) -> F64:
    """(N,) adjusted standard GPS time of LAS 1.4: GPS seconds less 1e9."""
    leaps = np.searchsorted(np.array(LEAP_UNIX_S) * 1_000_000_000, unix_ns, side="right")
    return (unix_ns - GPS_EPOCH_UNIX_S * 1_000_000_000) / 1e9 + leaps - GPS_SHIFT_S
