"""The gate between camera and scan: passes frames, or only stores them on disk.

Frames not reconstructed in flight can be reconstructed later from the stored images and the scan's
.tlog.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Event

from service.cameras.source import CameraFrame, CameraSource, Relayed
from service.daemon.load_shedding import STRIDE, Level
from service.daemon.stored_image import image_name, store_image

log = logging.getLogger(__name__)

KEEP_EVERY_NS = 200_000_000  # interval between stored images; 2 m of flight at 10 m/s


class FrameGate(Relayed):
    """Passes the camera's frames as the current load level permits."""

    def __init__(
        self,
        source: CameraSource,
        folder: Path,
        zero_unix_ns: int,
        alive: Callable[[], None],
        paused: Event,
    ) -> None:
        """Stored images go to ``folder``; ``zero_unix_ns`` is the unix time of time 0.

        ``alive`` is called for every frame that ends here, so that the scan does not count as hung.
        Nothing is stored while ``paused`` is set.
        """
        super().__init__(source)
        self._folder = folder
        self._zero_unix_ns, self._alive, self._paused = zero_unix_ns, alive, paused
        self.level = Level.FULL
        self.frames = self.kept = self.lost = 0
        self.age_s = 0.0  # age of the newest frame when it left the camera's queue
        self._taken_s: float | None = None  # when the current frame was passed on
        self._kept_ns = -KEEP_EVERY_NS
        self._faulty = False

    def __iter__(self) -> Iterator[CameraFrame]:
        try:
            yield from self._passing()
        finally:
            if self.kept:
                self.warnings.append(
                    f"{self.kept} images were only stored in {self._folder.name}/, "
                    "for a later replay"
                )

    def _passing(self) -> Iterator[CameraFrame]:
        for frame in self._source:
            self.frames += 1
            if self.start_monotonic_ns is not None:
                shown_ns = self.start_monotonic_ns + frame.time_ns
                self.age_s = max(0.0, 1e-9 * (time.monotonic_ns() - shown_ns))
            level = self.level
            if level is Level.RECORD_ONLY:
                self._keep(frame)
            elif level is Level.FULL or self.frames % STRIDE == 0:
                self._taken_s = time.monotonic()
                yield frame
                self._taken_s = None
                continue
            self._alive()

    @property
    def busy_s(self) -> float:
        taken_s = self._taken_s
        return 0.0 if taken_s is None else time.monotonic() - taken_s

    def _keep(self, frame: CameraFrame) -> None:
        """Store the image if one is due and the disk has room."""
        if self._paused.is_set() or frame.time_ns - self._kept_ns < KEEP_EVERY_NS:
            return
        self._kept_ns = frame.time_ns
        try:
            name = image_name(self._zero_unix_ns + frame.time_ns)
            store_image(self._folder / name, frame.image)
        except OSError as error:
            self.lost += 1
            if not self._faulty:
                log.error("images cannot be stored in %s: %s", self._folder, error.strerror)
            self._faulty = True
        else:
            self.kept += 1
            self._faulty = False
