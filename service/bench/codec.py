"""``skyrelief bench codec``: time of the chunk codec next to LAZ, on one core.

Both code the same synthetic keyframes (depth 50 to 95 m, noise 2 cm white and 8 cm
correlated). Ours carries mask, sigma, views and a coarse layer too.
"""

from __future__ import annotations

import contextlib
import io
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import cv2
import laspy
import numpy as np

from recon.mapping.cloud_fusion import cloud_of
from recon.types import F32, U8, Keyframe
from service.bench import BenchOptions, BenchResult
from service.bench.keyframes import make_keyframe, strip
from service.stream import codec

SIZE_PX = (320, 180)
REPEATS = 30
LAZ = "LAZ 1 cm"


def run(options: BenchOptions) -> list[BenchResult]:
    """Milliseconds to encode a keyframe and its fresh part, and to decode it."""
    whole = make_keyframe(0, SIZE_PX, seed=1)
    part = replace(whole, fresh=strip(SIZE_PX, 20))
    coded, xyz, rgb = codec.encode(whole, 0), *points(whole)
    with one_core():
        ours, theirs, new, decoded = map(
            median_ms,
            (
                lambda: codec.encode(whole, 0), lambda: encode_laz(xyz, rgb),
                lambda: codec.encode(part, 0), lambda: codec.decode(coded[-1:]),
            ),
        )  # fmt: skip
    what = "encode 320x180, both layers, one core"
    return [
        BenchResult(what, ours, "ms", peer=LAZ, peer_value=theirs),
        BenchResult("encode its fresh part at 80 % overlap", new, "ms"),
        BenchResult("decode a whole keyframe", decoded, "ms"),
    ]


def median_ms(work: Callable[[], object]) -> float:
    """Milliseconds of one core: processor time of this thread, so a busy machine counts less."""
    work()
    times = []
    for _ in range(REPEATS):
        began = time.thread_time()
        work()
        times.append(time.thread_time() - began)
    return float(np.median(times)) * 1e3


@contextlib.contextmanager
def one_core() -> Iterator[None]:
    """OpenCV without threads of its own."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)


def points(frame: Keyframe) -> tuple[F32, U8]:
    cloud = cloud_of(replace(frame.depth, T_world_camera=np.eye(4)), frame.bgr, frame.fresh)
    return cloud.xyz_m.astype(np.float32), np.ascontiguousarray(cloud.rgb)


def encode_laz(xyz: F32, rgb: U8) -> bytes:
    """LAZ, point format 7, 1 cm."""
    las = laspy.create(point_format=7, file_version="1.4")
    las.header.scales = np.full(3, 0.01)
    las.x, las.y, las.z = xyz[:, 0], xyz[:, 1], xyz[:, 2]
    las.red, las.green, las.blue = (rgb[:, k].astype(np.uint16) * 257 for k in range(3))
    out = io.BytesIO()
    las.write(out, do_compress=True, laz_backend=laspy.LazBackend.Lazrs)
    return out.getvalue()
