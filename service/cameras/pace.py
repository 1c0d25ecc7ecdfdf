"""Pictures when they are due: what comes faster than it is taken is dropped, oldest first."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from threading import Condition, Thread

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
        self._fault: Exception | None = None
        self.dropped = 0
        self.description, self.size_px = source.description, source.size_px
        self.epoch_unix_ns, self.fps = source.epoch_unix_ns, source.fps
        self.start_monotonic_ns = source.start_monotonic_ns
        self.is_live = True
        self.warnings = source.warnings

    def __iter__(self) -> Iterator[CameraFrame]:
        Thread(target=self._read, name="paced camera", daemon=True).start()
        while True:
            with self._news:
                self._news.wait_for(lambda: self._waiting or self._ended)
                if not self._waiting:
                    break
                frame = self._waiting.popleft()
            yield frame
        if self._fault is not None:
            raise self._fault
        if self.dropped:
            self.warnings.append(f"{self.dropped} frames came faster than they could be used")

    def close(self) -> None:
        """Let go of the source."""
        self._source.close()

    def _read(self) -> None:
        start = time.monotonic_ns()
        try:
            for frame in self._source:
                wait_ns = frame.time_ns - (time.monotonic_ns() - start)
                if wait_ns > 0 and not self._source.is_live:
                    time.sleep(wait_ns * 1e-9)
                with self._news:
                    self._waiting.append(frame)
                    if len(self._waiting) > self._kept:
                        self._waiting.popleft()
                        self.dropped += 1
                    self._news.notify_all()
        except Exception as error:  # handed to the thread that iterates
            self._fault = error
        finally:
            with self._news:
                self._ended = True
                self._news.notify_all()


def paced(source: CameraSource) -> CameraSource:
    """``source`` at its own pace."""
    return Paced(source)
