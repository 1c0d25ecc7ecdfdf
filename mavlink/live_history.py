"""A vehicle history for frames that are newer than telemetry: it waits a moment for it.

A frame is here before the attitude that was sampled after it, and nothing is carried on
further than 20 ms. So the state of a fresh frame is given when the samples on its far side
have come, or when patience is over.
"""

from __future__ import annotations

import threading
import time

from mavlink.history import HistoryConfig, VehicleHistory
from mavlink.samples import Sample
from mavlink.state import VehicleState

PATIENCE_S = 0.3  # a little more than the 3.5 Hz of a slow telemetry radio


class LiveHistory(VehicleHistory):
    """A VehicleHistory on the monotonic clock; ``state_at`` may wait for ``patience_s``."""

    def __init__(self, config: HistoryConfig | None = None, patience_s: float = PATIENCE_S) -> None:
        super().__init__(config)
        self.patience_s = patience_s
        self._news = threading.Condition()
        self._waiting = 0  # readers

    def add(self, sample: Sample, time_ns: int) -> None:
        """Put a sample in at its time and wake whoever waits for it."""
        super().add(sample, time_ns)
        if self._waiting:
            with self._news:
                self._news.notify_all()

    def state_at(self, time_ns: int) -> VehicleState | None:
        """The state at ``time_ns``, as soon as every stream that flows has come past it."""
        now_s = time.monotonic()
        end_s = now_s + self.patience_s
        if time_ns * 1e-9 < end_s:  # what lies further ahead cannot come in time
            with self._news:
                self._waiting += 1  # before looking, so that nothing new goes unnoticed
                while not self.covers(time_ns) and now_s < end_s:
                    self._news.wait(end_s - now_s)
                    now_s = time.monotonic()
                self._waiting -= 1
        return super().state_at(time_ns)
