"""The whole onboard path: H.264 at 1280x720 in, coded chunks in the store out.

The flight is made here: a camera 60 m above a textured plane at 5 m/s, 30 frames a second.
Every stage does its full work on it. The peer is the same path with OpenCV's SGBM in the
place of belief propagation.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from threading import Event
from typing import Any

import cv2
import numpy as np
import psutil  # type: ignore[import-untyped]

from recon import se3
from recon.backends import Backend
from recon.backends.cpu import CpuBackend
from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.types import F32, F64, U8, Camera, DisparityMap
from service.bench import BenchOptions, BenchResult
from service.flight.scan import Scan, ScanInputs, create_store

SIZE = (1280, 720)
K: F64 = np.array([[960.0, 0, 639.5], [0, 960.0, 359.5], [0, 0, 1.0]])
FPS, SPEED_M_S, HEIGHT_M = 30, 5.0, 60.0
M_PER_PX = 0.06


def run(options: BenchOptions) -> list[BenchResult]:
    """Clouds (stereo pairs reconstructed) a second, with and without upsampling."""
    seconds = max(2.0, options.rounds / 3.0)
    results = []
    with tempfile.TemporaryDirectory() as folder:
        video = Path(folder) / "flight.mp4"
        make_video(video, int(seconds * FPS))
        fly(video, Path(folder) / "warm", [], CpuBackend())
        for upsample, words in (("false", "320x180"), ("true", "320x180, with JBU")):
            flags = [f"compute.upsample={upsample}", "compute.pairs=30"]
            ours, ours_s = fly(video, Path(folder) / f"ours-{upsample}", flags, CpuBackend())
            note = f"{ours['frames'] / ours_s:.1f} frames/s, {resident_mib():.0f} MiB"
            theirs, theirs_s = fly(video, Path(folder) / f"sgbm-{upsample}", flags, SgbmBackend())
            peer = "with OpenCV SGBM"
            results.append(
                BenchResult(
                    f"whole path, {words}", ours["clouds"] / ours_s, "clouds/s",
                    peer=peer, peer_value=theirs["clouds"] / theirs_s, note=note,
                )
            )  # fmt: skip
            results += [
                BenchResult(
                    f"a call of {stage} in it", ms, "ms",
                    peer=peer, peer_value=theirs["stage_ms"].get(stage),
                )
                for stage, ms in ours["stage_ms"].items()  # wall time, among all the threads
            ]  # fmt: skip
    return results


def make_video(path: Path, frames: int) -> None:
    """An H.264 flight over a plane with detail at all scales."""
    import av

    ground = _ground(int(np.ceil((frames / FPS * SPEED_M_S + 140.0) / M_PER_PX)))
    rng = np.random.default_rng(1)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS, options={"crf": "20"})
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        tilt = np.zeros(3)
        for i in range(frames):
            tilt = 0.98 * tilt + rng.normal(0, 0.001, 3)
            centre = np.array([60.0 + SPEED_M_S * i / FPS, 50.0, HEIGHT_M])
            R = se3.so3_exp(tilt) @ np.diag([1.0, -1, -1])
            plane = np.column_stack([M_PER_PX * np.eye(3, 2), -centre])  # of a pixel of the ground
            image = cv2.warpPerspective(ground, K @ R.T @ plane, SIZE, flags=cv2.INTER_AREA)
            frame = av.VideoFrame.from_ndarray(np.asarray(image, np.uint8), format="bgr24")
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode(None):
            container.mux(packet)


def _ground(length_px: int) -> U8:
    rng = np.random.default_rng(0)
    size = (length_px, int(100.0 / M_PER_PX))
    out = np.zeros((size[1], size[0]), np.float32)
    for cell in (2, 6, 20, 80, 300):
        shape = (size[1] // cell + 2, size[0] // cell + 2)
        layer = rng.normal(0, 1, shape).astype(np.float32)
        out += cv2.resize(layer, size, interpolation=cv2.INTER_CUBIC)
    out = (out - out.mean()) / out.std() * 40 + 120
    gray = np.clip(out, 0, 255).astype(np.uint8)
    return np.stack([gray, gray, gray], axis=-1)


def fly(
    video: Path,
    folder: Path,
    flags: list[str],
    backend: Backend,
    watch: Callable[[Scan], None] | None = None,
) -> tuple[dict[str, Any], float]:
    """The summary of one scan, and its seconds."""
    from service.cameras import open_camera
    from service.config import load_config

    config = load_config(None, [*flags, "scan.assumed_agl_m=60"])
    source = open_camera(str(video))
    inputs = ScanInputs(source, Camera(K, np.zeros(5), SIZE), config, backend, folder, "bench", 0)
    store = create_store(inputs)
    start = time.perf_counter()
    scan = Scan(inputs, store)
    scan.run(Event(), watch)
    summary = scan.close()
    elapsed = time.perf_counter() - start
    source.close()
    store.close()
    return summary, elapsed


def resident_mib() -> float:
    return float(psutil.Process().memory_info().rss) / 2**20


class SgbmBackend(CpuBackend):
    """OpenCV's SGBM behind the backend's protocol; the rest is ours."""

    name = "sgbm"

    def belief_propagation(
        self, left: U8, right: U8, labels: int, config: BeliefPropagationConfig
    ) -> DisparityMap:
        """Semi-global matching; the name is the protocol's."""
        matcher = cv2.StereoSGBM.create(0, -(-labels // 16) * 16, 3, 72, 288)
        px: F32 = matcher.compute(left, right).astype(np.float32) / np.float32(16)
        px[px < 0] = np.nan
        return DisparityMap(px, np.where(np.isfinite(px), 1.0, 0.0).astype(np.float32))
