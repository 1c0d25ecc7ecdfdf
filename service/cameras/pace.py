"""Pictures when they are due: what comes faster than it is taken is dropped, oldest first."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from threading import Condition, Event, Thread

from service.cameras.source import CameraFrame, CameraSource


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
