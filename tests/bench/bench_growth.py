"""What a scan costs as it grows: time, memory and files at 10, 100, 1,000 keyframes and an hour.

The flight is made here: parallel legs 60 m above a textured plane at 5 m/s, with a fix of 1 m for
each image. Each length is flown by a process of its own and ends with its files. Times are
processor time without that of making the images; ``docs/growth.py`` draws them.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from threading import Event
from typing import NamedTuple

import cv2
import numpy as np

from recon import se3
from recon.backends.cpu import CpuBackend
from recon.types import F64, U8, Camera
from service.bench import BenchOptions, BenchResult, in_process
from service.bench.pipeline import SIZE, SPEED_M_S, K, resident_mib
from service.cameras.source import CameraFrame, CameraSource, GeoTag
from service.config import load_config
from service.flight.scan import Scan, ScanInputs, create_store
from service.georeference import LocalFrame
from service.scans.folder import write_deliverables

HEIGHT_M, FPS = 60.0, 6
LEG_M, APART_M = 450.0, 40.0
BLOCK_PX, M_PER_PX = 512, 0.06
EPOCH_NS = 1_790_000_000_000_000_000
HOME = LocalFrame(47.3977, 8.5456, 488.0)
FIX_M = 1.0
LENGTHS = {"10 keyframes": 10, "100 keyframes": 100, "1,000 keyframes": 1000, "an hour": 2900}
LAST = 0.2
"""Share of the flight, at its end, whose time counts."""


def run(options: BenchOptions) -> list[BenchResult]:
    """Of each length: time of a keyframe at the end, memory, files, and the time to write them."""
    del options
    results = []
    for name, keyframes in LENGTHS.items():
        flown = in_process(measure, keyframes)
        note = f"{flown.keyframes} keyframes, {flown.hectares:.2g} ha"
        for what, value, unit in (
            ("processor time a keyframe, tracking included", flown.keyframe_ms, "ms"),
            ("memory in flight", flown.flight_mib, "MiB"),
            ("memory after the files", flown.files_mib, "MiB"),
            ("files a keyframe", flown.stored_kib / flown.keyframes, "KiB"),
            ("processor time of the files a keyframe", flown.files_ms / flown.keyframes, "ms"),
        ):
            results.append(BenchResult(f"{name}: {what}", value, unit, note=note))
    return results


class Flown(NamedTuple):
    keyframes: int
    hectares: float
    keyframe_ms: float  # in the last part of the flight
    flight_mib: float  # resident, at most
    files_mib: float
    stored_kib: float
    files_ms: float


def measure(keyframes: int) -> Flown:
    """Fly until there are so many keyframes, and write the scan's files."""
    stop = Event()
    camera = LongFlight()
    seen: list[tuple[float, int, float]] = []  # s, keyframes, MiB

    def watch(scan: Scan) -> None:
        used_s = time.process_time() - camera.own_s
        seen.append((used_s, scan.recorder.keyframes, resident_mib()))
        if scan.recorder.keyframes >= keyframes:
            stop.set()

    with tempfile.TemporaryDirectory(prefix="skyrelief-growth-") as name:
        folder = Path(name)
        config = load_config(None, [])
        lens = Camera(K, np.zeros(5), SIZE)
        inputs = ScanInputs(camera, lens, config, CpuBackend(), folder / "scan", "bench", EPOCH_NS)
        store = create_store(inputs)
        scan = Scan(inputs, store)
        scan.run(stop, watch)
        scan.close()
        done_s, done, _ = seen[-1]
        from_s, before, _ = next(s for s in seen if s[1] >= (1.0 - LAST) * done)
        del scan
        start = time.process_time()
        summary = write_deliverables(folder / "scan", store)
        files_s = time.process_time() - start
        store.close()
        stored = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        return Flown(
            summary["counts"]["keyframes"],
            summary["coverage"]["measured_m2"] / 1e4,
            1e3 * (done_s - from_s) / max(done - before, 1),
            max(mib for _, _, mib in seen),
            resident_mib(),
            stored / 1024,
            1e3 * files_s,
        )


class LongFlight(CameraSource):
    """A camera over an endless plane, whose every block has a texture of its own."""

    size_px = SIZE
    epoch_unix_ns = EPOCH_NS
    fps = float(FPS)

    def __init__(self) -> None:
        super().__init__("parallel legs over a plane")
        self.own_s = 0.0  # processor time of making the images

    def __iter__(self) -> Iterator[CameraFrame]:
        rng = np.random.default_rng(1)
        tilt = np.zeros(3)
        seq = 0
        while True:
            start = time.thread_time()
            tilt = 0.9 * tilt + rng.normal(0, 0.002, 3)
            centre = np.array([*place(SPEED_M_S * seq / FPS), HEIGHT_M])
            image = photograph(se3.compose(se3.so3_exp(tilt) @ np.diag([1.0, -1, -1]), centre))
            lat, lon, alt = HOME.to_geodetic(centre[None] + rng.normal(0, FIX_M, (1, 3)))[
                0
            ].tolist()
            tag = GeoTag(lat, lon, alt, FIX_M, FIX_M, is_sigma_h_stated=True)
            self.own_s += time.thread_time() - start
            yield CameraFrame(image, round(seq * 1e9 / FPS), seq, tag, f"frame {seq}")
            seq += 1


def place(way_m: float) -> tuple[float, float]:
    """East and north in m after ``way_m`` along legs to the east and back, each further north."""
    leg, along = divmod(way_m, LEG_M + APART_M)
    east, north = min(along, LEG_M), leg * APART_M + max(along - LEG_M, 0.0)
    return (east if leg % 2 == 0 else LEG_M - east), north


def photograph(T_world_camera: F64) -> U8:
    """The image of the plane from there."""
    reach_m = HEIGHT_M * np.array(SIZE) / K[0, 0] * 0.5 + 12.0
    low = np.floor((T_world_camera[:2, 3] - reach_m) / (BLOCK_PX * M_PER_PX)).astype(int)
    high = np.floor((T_world_camera[:2, 3] + reach_m) / (BLOCK_PX * M_PER_PX)).astype(int)
    rows = [
        np.hstack([block(x, y) for x in range(low[0], high[0] + 1)])
        for y in range(low[1], high[1] + 1)
    ]
    ground = np.vstack(rows)
    plane = np.diag([M_PER_PX, M_PER_PX, 1.0])
    plane[:2, 2] = low * BLOCK_PX * M_PER_PX
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
    H = K @ R.T @ (np.column_stack([np.eye(3)[:, 0], np.eye(3)[:, 1], -t]) @ plane)
    gray = cv2.warpPerspective(ground, H, SIZE, flags=cv2.INTER_AREA)
    return np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), np.uint8)


@lru_cache(maxsize=64)
def block(x: int, y: int) -> U8:
    """(BLOCK_PX, BLOCK_PX) gray of one block, with detail at all scales."""
    rng = np.random.default_rng((x + 10_000, y + 10_000))
    out = np.zeros((BLOCK_PX, BLOCK_PX), np.float32)
    for cell in (2, 6, 20, 80):
        layer = rng.normal(0, 20, (BLOCK_PX // cell + 2,) * 2).astype(np.float32)
        out += cv2.resize(layer, (BLOCK_PX, BLOCK_PX), interpolation=cv2.INTER_CUBIC)
    return np.clip(out + 120, 0, 255).astype(np.uint8)
