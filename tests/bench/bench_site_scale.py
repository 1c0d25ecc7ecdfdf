"""A site of many scans: memory and processor time of each product, here and on Dask workers.

One place of the simulator is flown at two dates, and the two scans are set down side by side until
there are ``--scans``, each with errors of position of its own. Depth is the true one with noise, so
no image is matched. Each product is made by a process of its own, whose peak memory is measured.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from bench_options import DataOptions

from recon import se3
from recon.camera_model import rays
from recon.types import F32, F64, U8, DepthMap, Keyframe, Pose
from service.bench import BenchResult, in_process
from service.georeference import LocalFrame
from service.offline.site.gather import Member, gather
from service.progress import Progress
from service.sim.flight import FlightPlan
from service.sim.recording import EPOCH_UNIX_S, ORIGIN, Simulation, SimulationOptions, prepare
from service.sim.truth import heights_below
from service.stream.codec import encode
from service.stream.records import ScanHeader
from service.stream.store import ScanStore

SPACING_M, HEIGHT_M, CHANGES = 110.0, 60.0, 6
SIZE_PX = (160, 90)
SIGMA_M, PLACING_M = 0.05, 0.03
TILE_POINTS = 1_000_000
FOUND = "found.json"
FILES = "files"
"""Those that ``site align`` leaves in the site's folder."""

KINDS = ("dsm", "ortho", "laz", "ply", "copc", "3dtiles", "contours", "change", FILES)
WORKERS = (1, 2, 4)
"""Of a Dask cluster, for the first kind."""


def run(
    options: DataOptions, kinds: Sequence[str] = KINDS, cluster: Sequence[int] = WORKERS
) -> list[BenchResult]:
    """Peak memory and time per tile of each product of a site of ``options.scans`` scans."""
    with tempfile.TemporaryDirectory(prefix="skyrelief-scale-") as name:
        folder = Path(name)
        dates = [_place(date) for date in (1, 2)]
        members = site_of(dates, folder, options.scans)
        results = []
        for kind in kinds:
            workers = cluster if kind == kinds[0] else ()
            results += _results(kind, folder / "site", members, options, workers)
        results.append(_height_error(folder / "site" / "dsm.tif", dates, options.scans))
        results.append(_changes_found(folder / "site" / FOUND, options.scans))
    return results


def _place(date: int) -> Simulation:
    plan = FlightPlan("hover", 1.0, height_m=HEIGHT_M)
    return prepare(
        SimulationOptions(
            plan, seed=3, size_px=SIZE_PX, site_m=SPACING_M + 60.0, changes=CHANGES, date=date,
            distortion=(0.0, 0.0, 0.0, 0.0, 0.0), depth_frames=0,
        )
    )  # fmt: skip


def site_of(dates: list[Simulation], folder: Path, scans: int) -> list[Member]:
    """A site of half the ``scans`` at one date and half at the other, in ``folder``/site."""
    rng = np.random.default_rng(scans)
    paths = []
    for date, simulation in enumerate(dates):
        views = [(T, *_view(simulation, T, k)) for k, T in enumerate(_poses())]
        K = simulation.options.camera.K
        for n in range(scans // 2):
            paths.append(folder / f"scan-{date}-{n}")
            _write(paths[-1], views, K, _offset(n, scans), (date, n), rng)
    (folder / "site").mkdir()
    members, _ = gather(paths, folder / "site" / "scan.db", "site")
    return members


def _offset(n: int, scans: int) -> F64:
    """(3,) where place ``n`` lies, m east and north."""
    across = int(np.ceil(np.sqrt(scans / 2)))
    return SPACING_M * np.array([n % across, n // across, 0.0])


def _poses() -> list[F64]:
    """Cameras that look straight down, three legs of eight."""
    R = np.diag([1.0, -1.0, -1.0])
    return [
        se3.compose(R, np.array([x, y, HEIGHT_M]))
        for y in (-30.0, 0.0, 30.0)
        for x in np.linspace(-42.0, 42.0, 8)
    ]


def _view(simulation: Simulation, T: F64, index: int) -> tuple[Any, Any]:
    """Image and true depth at a pose; NaN beyond the place, which its neighbours continue."""
    image = simulation.renderer.frame(T, index, simulation.options.look)
    depth = simulation.renderer.depth(T)
    h, w = depth.shape
    u, v = np.meshgrid(np.arange(w, dtype=np.float64), np.arange(h, dtype=np.float64))
    ways = rays(simulation.options.camera.K, np.column_stack([u.ravel(), v.ravel()]))
    there = se3.transform(T, ways * depth.reshape(-1, 1).astype(np.float64))
    beyond = np.abs(there[:, :2]).max(axis=1) > 0.5 * SPACING_M
    depth[beyond.reshape(h, w)] = np.nan
    return image, depth


def _write(
    folder: Path, views: list[tuple[F64, Any, Any]], K: F64, offset: F64, which: tuple[int, int],
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """One scan with errors of its own; its frame's origin is that of its place."""
    lat, lon, alt = (float(v) for v in ORIGIN.to_geodetic(offset[None])[0])
    own = LocalFrame(lat, lon, alt)
    date, n = which
    start = int(EPOCH_UNIX_S * 1e9) + (86_400 * date + 100 * n) * 10**9
    header = ScanHeader(
        folder.name, "drone", start, run_id=f"{date * 1000 + n:032x}", origin_lat_deg=own.lat_deg,
        origin_lon_deg=own.lon_deg, origin_alt_amsl_m=own.alt_amsl_m, epsg=ORIGIN.epsg,
        georeference="gnss",
    )  # fmt: skip
    wrong = se3.compose(np.eye(3), rng.normal(size=3) * PLACING_M)
    with ScanStore.create(folder / "scan.db", header) as store:
        for seq, (T, image, depth) in enumerate(views):
            pose = Pose(wrong @ T, np.eye(6) * 1e-3, ("vision", "gnss"))
            store.add_keyframe(seq, noisy(seq, start + seq * 10**9, image, depth, K, pose, rng))
        store.finish({"frames": len(views)})


def noisy(
    seq: int, time_ns: int, image: U8, depth: F32, K: F64, pose: Pose, rng: np.random.Generator
) -> list[bytes]:
    """The coded keyframe of a view: its true depth (h, w) with noise of SIGMA_M."""
    one = DepthMap(
        (depth + rng.normal(size=depth.shape) * SIGMA_M).astype(np.float32),
        np.full(depth.shape, SIGMA_M, np.float32), np.full(depth.shape, 3, np.uint8), K,
        pose.T_world_camera,
    )  # fmt: skip
    fresh = np.ones(depth.shape, np.bool_)
    return list(encode(Keyframe(seq, time_ns, one, image, pose, fresh), time_ns))


# ---- measuring -------------------------------------------------------------------------------


def _results(
    kind: str, site: Path, members: list[Member], options: DataOptions, cluster: Sequence[int]
) -> list[BenchResult]:
    half = len(members) // 2
    parts = (members[0].first, members[half - 1].last), (members[half].first, members[-1].last)
    alone = in_process(made, kind, site, parts, None)
    scans = f"{len(members)} scans, {len(alone.tile_s)} tiles"
    low, usual, high = np.quantile(alone.tile_s, [0.1, 0.5, 0.9])
    what = f"{kind}: processor time of a tile, median"
    out = [
        BenchResult(f"{kind}: peak memory", alone.peak_mib, "MiB", note=scans),
        BenchResult(what, float(usual), "s", float(high - low), note=scans),
    ]
    for workers in cluster:
        out += _on_workers(kind, site, parts, workers)
    return out


def _on_workers(kind: str, site: Path, parts: Any, workers: int) -> list[BenchResult]:
    """Elapsed time and the largest worker's memory, of so many Dask workers of one thread."""
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        return []
    alone = {"NUMBA_NUM_THREADS": "1"}
    with (
        LocalCluster(
            n_workers=workers, threads_per_worker=1, dashboard_address=None, env=alone,
            memory_limit=None,
        ) as cluster,
        Client(cluster) as client,
    ):  # fmt: skip
        done = in_process(made, kind, site, parts, cluster.scheduler_address)
        peak = max(client.run(peak_mib).values())
    return [
        BenchResult(f"{kind}: with {workers} worker(s), elapsed", done.elapsed_s, "s",
                    note=f"largest worker {peak:.0f} MiB"),
    ]  # fmt: skip


@dataclass(frozen=True, slots=True)
class ProductCost:
    """What one product took."""

    peak_mib: float
    elapsed_s: float
    tile_s: list[float]  # processor time of each tile


def made(kind: str, site: Path, parts: Any, scheduler: str | None) -> ProductCost:
    """Make one product in this process, and measure it."""
    ticks: list[float] = []
    texts: list[str] = []

    def noted(now: Progress) -> None:
        if now.text.startswith("tile ") and now.text not in texts:
            texts.append(now.text)
            ticks.append(time.process_time())

    begun = time.monotonic()
    _make(kind, site, parts, scheduler, Progress(noted))
    ticks.append(time.process_time())
    return ProductCost(peak_mib(), time.monotonic() - begun, np.diff(ticks).tolist())


def _make(kind: str, site: Path, parts: Any, scheduler: str | None, progress: Progress) -> None:
    from service.offline.exports.view import ExportOptions, ScanView, export
    from service.offline.site.alignment import write_files
    from service.offline.site.compare import changes

    options = ExportOptions(stored=True, tile_points=TILE_POINTS, scheduler=scheduler)
    if kind == FILES:
        write_files(site, options, progress)
        return
    with ScanView(site, None, progress) as view:
        if kind == "change":
            count = len(changes(view, site, parts, options).objects)
            (site / FOUND).write_text(json.dumps(count), encoding="utf-8")
        else:
            export(view, kind, None, options)


def peak_mib() -> float:
    """Most memory that this process has held."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(float(line.split()[1]) / 1024.0 for line in lines if line.startswith("VmHWM"))


# ---- truth -----------------------------------------------------------------------------------


def _height_error(path: Path, dates: list[Simulation], scans: int) -> BenchResult:
    """Error of the surface model against the place, where it stands alike at both dates."""
    import rasterio

    grid, errors = [s.scene.grid for s in dates], []
    with rasterio.open(path) as image:
        for _, window in image.block_windows(1):
            height = image.read(1, window=window).astype(np.float64)
            row, col = np.nonzero(height != image.nodata)
            if not len(row):
                continue
            x, y = image.xy(row + window.row_off, col + window.col_off)
            enu = ORIGIN.from_utm(np.column_stack([x, y, height[row, col]]))
            inside = np.mod(enu[:, :2] + 0.5 * SPACING_M, SPACING_M) - 0.5 * SPACING_M
            here = (np.abs(inside) < 0.5 * SPACING_M - 2.0).all(axis=1)
            one, two = (heights_below(g, inside[here]) for g in grid)
            errors.append((enu[here, 2] - one)[np.abs(one - two) < 0.01])
    every = np.abs(np.concatenate(errors))
    return BenchResult(
        "dsm: error of height, median", float(np.median(every)), "m",
        note=f"{scans} scans; 90 %: {np.quantile(every, 0.9):.3f} m",
    )  # fmt: skip


def _changes_found(path: Path, scans: int) -> BenchResult:
    placed = CHANGES * (scans // 2)
    count = json.loads(path.read_text(encoding="utf-8"))
    return BenchResult("change: objects", float(count), "", note=f"{placed} boxes placed")
