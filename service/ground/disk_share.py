"""Quotas of the store's disk: a share for each drone, and a reserve that stays free for all."""

from __future__ import annotations

import logging
import os
import shutil
import time
from pathlib import Path

from service.errors import OutsideError

log = logging.getLogger(__name__)

DRONE_SHARE = 0.5
"""Of the disk, for the folder of one drone."""
RESERVE_SHARE, MAX_RESERVE_BYTES = 0.05, 2 << 30
"""What stays free by default: this share of the disk, at most so much."""
MEASURE_S = 60.0
LOOK_S = 1.0


class QuotaError(OutsideError):
    """A drone's share, or the disk without its reserve, is full; nothing was written."""


class DiskShare:
    """What one drone may still write; use from one thread.

    Everything in the drone's folder counts: coarse layers, poses and deliverables too.
    """

    def __init__(self, folder: Path, share: float, reserve_bytes: int | None) -> None:
        self._folder = folder
        self._share, self._reserve_bytes = share, reserve_bytes
        self._used_bytes, self._measured_at = 0, -1e9
        self._total_bytes, self._free_bytes, self._looked_at = 0, 0, -1e9

    def check(self, size_bytes: int, now: float | None = None) -> None:
        """Count ``size_bytes`` that are about to be written.

        Raises QuotaError when they do not fit into the share, or would take from the reserve.
        """
        now = time.monotonic() if now is None else now
        self._look(now)
        if self._used_bytes + size_bytes > self._share * self._total_bytes:
            raise QuotaError(
                f"{self._folder} has reached its share, {100 * self._share:g} % of the disk; "
                "delete scans or give --drone-share"
            )
        if self._free_bytes - size_bytes < self._reserve():
            raise QuotaError(
                f"the disk of {self._folder} is full but for its reserve of "
                f"{self._reserve() / 1e6:.0f} MB; free some space or give --reserve-mb"
            )
        self._used_bytes += size_bytes
        self._free_bytes -= size_bytes

    def _reserve(self) -> float:
        if self._reserve_bytes is not None:
            return self._reserve_bytes
        return min(RESERVE_SHARE * self._total_bytes, MAX_RESERVE_BYTES)

    def _look(self, now: float) -> None:
        """Measure the disk every second, and the folder now and then: others write there too."""
        if now - self._looked_at >= LOOK_S:
            self._looked_at = now
            try:
                usage = shutil.disk_usage(_existing(self._folder))
            except OSError as error:
                raise OutsideError(f"cannot read the disk of {self._folder} ({error})") from error
            self._total_bytes, self._free_bytes = usage.total, usage.free
        if now - self._measured_at >= MEASURE_S:
            self._measured_at = now
            self._used_bytes = folder_bytes(self._folder)


def folder_bytes(folder: Path) -> int:
    """Bytes of the files below ``folder``; links are not followed."""
    total, waiting = 0, [str(folder)]
    while waiting:
        try:
            with os.scandir(waiting.pop()) as entries:
                for entry in entries:
                    if entry.is_dir(follow_symlinks=False):
                        waiting.append(entry.path)
                    else:
                        total += entry.stat(follow_symlinks=False).st_size
        except OSError as error:
            log.debug("not measured: %s", error)
    return total


def _existing(folder: Path) -> Path:
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder
