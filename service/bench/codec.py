"""``skyrelief bench codec``: time of the chunk codec next to LAZ, on one core.

Both code the same synthetic keyframes (depth 50 to 95 m, noise 2 cm white and 8 cm
correlated). Ours carries mask, sigma, views and a coarse layer too.
"""

from __future__ import annotations

import io
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial

import cv2
import laspy
import numpy as np

from recon.mapping.cloud_fusion import cloud_of
from recon.types import F32, U8, Keyframe
from service.bench import BenchOptions, BenchResult, compare
from service.bench.keyframes import make_keyframe, strip
from service.stream import codec

SIZE_PX = (320, 180)
LAZ = "LAZ 1 cm"


def run(options: BenchOptions) -> list[BenchResult]:
    """Milliseconds to encode a keyframe and its fresh part, and to decode it."""
    whole = make_keyframe(0, SIZE_PX, seed=1)
    part = replace(whole, fresh=strip(SIZE_PX, 20))
    last_layer = codec.encode(whole, 0)[-1:]
    encode = "encode 320x180, both layers, one core"
    laz = partial(encode_laz, *points(whole))
    fresh = "encode its fresh part at 80 % overlap"
    with one_core():
        return [
            by_thread(encode, partial(codec.encode, whole, 0), options, LAZ, laz),
            by_thread(fresh, partial(codec.encode, part, 0), options),
            by_thread("decode a whole keyframe", partial(codec.decode, last_layer), options),
        ]


by_thread = partial(compare, clock=time.thread_time)
"""By the processor time of this thread, so a busy machine counts less."""


@contextmanager
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
