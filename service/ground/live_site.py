"""The scans in flight aligned with the site, in a lasting process of its own.

It reads the stores below the receiver's folder and writes one small file, from which the portal
takes where each scan is shown. Nothing is sent to an aircraft, and no scan is changed.
"""

from __future__ import annotations

import contextlib
import logging
import select
import sys
import time
from functools import partial
from pathlib import Path

from service.errors import SkyreliefError
from service.ground.foxglove import growing
from service.ground.shown_site import FILE, write_shown
from service.ground.sites import references
from service.offline.site import DRONE
from service.offline.site.live import LiveSite
from service.workers import Worker, guarded, run_process

log = logging.getLogger(__name__)

POLL_S = 0.25
MAX_FLYING, MAX_SCANS = 16, 48
"""Scans in flight, and all that are followed."""

REFUSED_S = 3.0
"""A scan that cannot be followed yet is looked at again after so long."""


def run(store: Path, worker: Worker) -> None:
    """Keep the process until the worker's stop."""
    try:
        run_process(worker, "live site", [sys.executable, "-m", __name__, str(store)])
    finally:
        with contextlib.suppress(OSError):
            (store / FILE).unlink(missing_ok=True)


class Follower:
    """Follows the scans that grow below ``store``, and the finished ones of the same visit and
    of the last one before.

    A scan that ends is followed until none is in flight: others are tied to it.
    """

    def __init__(self, store: Path) -> None:
        self._store = store
        self._site = LiveSite()
        self._refused: dict[Path, float] = {}  # until when

    def turn(self, now_unix_s: float) -> bool:
        """Compare one keyframe of each scan; False when there was none to compare."""
        scans = self._site.scans
        grown = [
            folder
            for folder in growing(self._store, now_unix_s, MAX_FLYING)
            if folder.parent.name != DRONE
        ]
        for folder in grown:
            if folder not in scans and now_unix_s >= self._refused.get(folder, now_unix_s):
                self._begin(folder, now_unix_s)
        flying = [f for f in grown if f in scans and not scans[f].is_finished]
        for folder in list(scans)[: -MAX_SCANS if flying else None]:
            if folder not in flying:
                self._site.remove(folder)
        return self._advance(now_unix_s)

    def _begin(self, folder: Path, now_unix_s: float) -> None:
        """Follow a scan in flight, and the finished ones that it may meet."""
        self._refused[folder] = now_unix_s + REFUSED_S
        if not self._add(folder, compare=True):
            return
        one = self._site.scans[folder]
        if one.is_finished:  # and only looked at
            self._site.remove(folder)
            return
        header = one.store.header
        at = None
        if header.origin_lat_deg is not None and header.origin_lon_deg is not None:
            at = header.origin_lat_deg, header.origin_lon_deg
        known = self._site.scans
        for other in references(self._store, one.started_unix_s, known, at)[-MAX_SCANS:]:
            self._add(other, compare=False)

    def _add(self, folder: Path, compare: bool) -> bool:
        try:
            self._site.add(folder, compare)
        except SkyreliefError as error:  # without georeference, or not yet
            log.debug("%s is not followed: %s", folder, error)
        return folder in self._site.scans

    def _advance(self, now_unix_s: float) -> bool:
        for folder in list(self._site.scans):
            if guarded(f"{folder} in flight", partial(self._site.refresh, folder)):
                self._site.remove(folder)
                self._refused[folder] = now_unix_s + REFUSED_S
        due = [folder for folder, one in self._site.scans.items() if one.due]
        for folder in due:
            guarded(f"{folder} in flight", partial(self._site.compare, folder))
        placed = self._site.place()
        if placed is not None:
            write_shown(self._store, placed)
        return bool(due)


def serve(store: Path) -> None:
    """Follow the scans below ``store`` until standard input ends."""
    follower, is_busy = Follower(store), False
    write_shown(store, [])
    while not select.select([sys.stdin], [], [], 0.0 if is_busy else POLL_S)[0]:
        is_busy = follower.turn(time.time())


if __name__ == "__main__":
    serve(Path(sys.argv[1]))
