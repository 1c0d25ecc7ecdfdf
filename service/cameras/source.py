"""What every camera hands over, whatever it is: images with a time and what is known of them;
and readers that take them from the camera on a thread of their own."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from queue import Full, Queue
from threading import Condition, Event, Thread
from typing import Protocol, runtime_checkable

from recon.types import U8


@dataclass(frozen=True, slots=True)
class GeoTag:
    """Where a picture was taken, as the camera itself wrote it (EXIF, XMP)."""

    lat_deg: float
    lon_deg: float
    alt_amsl_m: float | None = None  # as written; consumer cameras drift by tens of metres
    sigma_h_m: float = 5.0  # 1 sigma, horizontal; the default when the tag does not say
    ypr_deg: tuple[float, float, float] | None = None
    """Yaw from true north, pitch, roll of the gimbal head (FRD in NED); pitch -90 looks down."""
    relative_alt_m: float | None = None  # above the take-off point


@dataclass(frozen=True, slots=True, eq=False)
class CameraFrame:
    """One picture as the source gave it."""

    image: U8  # (H, W, 3) BGR
    time_ns: int  # presentation time, ns since the start of the stream
    seq: int  # 0, 1, 2 … of the pictures that came out
    geotag: GeoTag | None
    name: str  # file name of a still, else "frame <seq>"


@runtime_checkable
class CameraSource(Protocol):
    """An open camera: iterate once for its pictures, in order of time, then close it."""

    description: str  # for a log line and scan.json
    size_px: tuple[int, int]  # (W, H)
    epoch_unix_ns: int | None  # UTC of time_ns = 0, when the source tells
    start_monotonic_ns: int | None  # this machine's monotonic clock at time_ns = 0, if live
    fps: float | None  # mean pictures per second, when the source tells
    is_live: bool  # True: pictures that are not fetched in time are lost
    warnings: list[str]  # one line each; grows while pictures are fetched

    def __iter__(self) -> Iterator[CameraFrame]:
        """Yield the pictures, oldest first; ends with the recording."""
        ...

    def close(self) -> None:
        """Let go of the file or device; safe to call twice."""
        ...


_LOOK_S = 0.1
"""How often a full reader looks whether it is still wanted."""


def ahead(source: CameraSource, kept: int = 4) -> Generator[CameraFrame, None, None]:
    """Every picture of ``source`` in order, at most ``kept`` of them decoded in advance.

    Raises what the source raises. A reader whose pictures are no longer fetched ends soon;
    close the iterator before the source.
    """
    queue: Queue[CameraFrame | Exception | None] = Queue(kept)
    unwanted = Event()

    def put(item: CameraFrame | Exception | None) -> bool:
        while not unwanted.is_set():
            try:
                queue.put(item, timeout=_LOOK_S)
                return True
            except Full:
                continue
        return False

    def read() -> None:
        try:
            for frame in source:
                if not put(frame):
                    return
        except Exception as error:  # handed to the thread that iterates
            put(error)
            return
        put(None)

    reader = Thread(target=read, name="decoder", daemon=True)
    reader.start()
    try:
        while (item := queue.get()) is not None:
            if isinstance(item, Exception):
                raise item
            yield item
    finally:
        unwanted.set()
        reader.join()


class Paced:
    """A source that gives each picture when its presentation time has come, as a camera does.

    A live source is not held back: it is only emptied, so that its newest pictures are used.
    At most ``kept`` pictures wait; :attr:`dropped` counts those that were too late.
    """

    def __init__(self, source: CameraSource, kept: int = 2) -> None:
        self._source = source
        self._waiting: deque[CameraFrame] = deque()
        self._kept = kept
        self._news = Condition()
        self._ended = False
        self._closed = Event()
        self._reader: Thread | None = None
        self._fault: Exception | None = None
        self.dropped = 0
        self.description, self.size_px = source.description, source.size_px
        self.epoch_unix_ns, self.fps = source.epoch_unix_ns, source.fps
        self.start_monotonic_ns = source.start_monotonic_ns
        self.is_live = True
        self.warnings = source.warnings

    def __iter__(self) -> Iterator[CameraFrame]:
        self._reader = Thread(target=self._read, name="paced camera", daemon=True)
        self._reader.start()
        while True:
            with self._news:
                self._news.wait_for(lambda: self._waiting or self._ended or self._closed.is_set())
                if not self._waiting or self._closed.is_set():
                    break
                frame = self._waiting.popleft()
            yield frame
        if self._fault is not None:
            raise self._fault
        if self.dropped:
            self.warnings.append(f"{self.dropped} frames came faster than they could be used")

    def close(self) -> None:
        """End the iteration at once, from any thread, and let go of the source.

        A recording is let go by the thread that reads it, not under its hands.
        """
        with self._news:
            self._closed.set()
            self._news.notify_all()
        if self._source.is_live or self._reader is None or not self._reader.is_alive():
            self._source.close()

    def _read(self) -> None:
        start = time.monotonic_ns()
        try:
            for frame in self._source:
                early_s = 1e-9 * (frame.time_ns - (time.monotonic_ns() - start))
                if self._closed.wait(0.0 if self._source.is_live else max(0.0, early_s)):
                    break
                with self._news:
                    self._waiting.append(frame)
                    if len(self._waiting) > self._kept:
                        self._waiting.popleft()
                        self.dropped += 1
                    self._news.notify_all()
        except Exception as error:  # handed to the thread that iterates
            self._fault = error
        finally:
            self._source.close()
            with self._news:
                self._ended = True
                self._news.notify_all()


def paced(source: CameraSource) -> CameraSource:
    """``source`` at its own pace."""
    return Paced(source)
