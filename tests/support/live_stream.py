"""Streams of a camera that come when they are due, made in memory."""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Iterator
from fractions import Fraction
from typing import Any

import av
import numpy as np

STEP_S = Fraction(1, 50)


def clip(
    n: int, size_px: tuple[int, int] = (64, 48), moving: bool = True, step_s: Fraction = STEP_S
) -> bytes:
    """``n`` Matroska images of noise; all the same unless ``moving``."""
    data = io.BytesIO()
    with av.open(data, "w", format="matroska") as out:
        stream: Any = out.add_stream("ffv1", rate=1 / step_s)
        stream.width, stream.height = size_px
        stream.pix_fmt = "yuv420p"
        for i in range(n):
            noise = np.random.default_rng(i if moving else 0)
            image = noise.integers(0, 256, (size_px[1], size_px[0], 3), np.uint8)
            frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            frame.pts, frame.time_base = i, step_s
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    return data.getvalue()


def opener(*connections: bytes | Exception) -> Callable[[float], Any]:
    """An opener that gives one connection after the other, the last one again and again."""
    left = list(connections)

    def open_container(stall_s: float) -> Any:
        found = left.pop(0) if len(left) > 1 else left[0]
        if isinstance(found, Exception):
            raise found
        return RealTime(av.open(io.BytesIO(found)))

    return open_container


class RealTime:
    """A container whose packets come when they are due, 20 ms apart."""

    def __init__(self, container: Any) -> None:
        self.streams, self.flags = container.streams, container.flags
        self._container = container
        self.is_open = True

    def demux(self, stream: Any) -> Iterator[Any]:
        due = time.monotonic()
        for packet in self._container.demux(stream):
            time.sleep(max(0.0, due - time.monotonic()))
            due += 0.02
            yield packet

    def close(self) -> None:
        self.is_open = False
        self._container.close()
