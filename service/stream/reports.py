"""Reports of ground stations about their items: queues the newest of each, stores the best one.

They determine which earlier scans no ground station holds completely yet.
"""

from __future__ import annotations

import logging
from pathlib import Path

from service.errors import OutsideError, SkyreliefError
from service.stream.messages import Numbers, missing
from service.stream.naming import NAME
from service.stream.outbox import MAX_STATIONS, Outbox
from service.stream.store import ScanStore

log = logging.getLogger(__name__)

MAX_OFFERED = 20  # maximum scans offered at once, the newest first


def delivered(store: ScanStore) -> bool:
    """Whether some ground station has reported that it holds everything."""
    numbers = store.numbers()
    return any(not missing(numbers, held) for held in store.held().values())


def open_undelivered(scans: Path) -> list[ScanStore]:
    """The newest undelivered scans under ``scans`` (a folder of scan folders).

    A scan that a crash cut short is closed with ``{"interrupted": true}``, so that the ground knows
    that it is complete. Unreadable scans are skipped with a warning.
    """
    out: list[ScanStore] = []
    for path in sorted(scans.glob("*/scan.db"), key=_changed, reverse=True):
        if len(out) >= MAX_OFFERED:
            break
        try:
            if _was_delivered(path):
                continue
            store = ScanStore.open(path)
            if not store.finished:
                store.finish({"interrupted": True})
        except SkyreliefError as error:
            log.warning("%s", error)
            continue
        out.append(store)
    return out


def _was_delivered(path: Path) -> bool:
    """Whether the scan is finished and delivered, without reading the whole file for damage."""
    try:
        with ScanStore.peek(path) as store:
            return store.finished and delivered(store)
    except SkyreliefError:
        return False  # it is then opened and checked


def _changed(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


TAKE_S = 0.2  # interval between two evaluations of the reports
KEEP_S = 10.0
"""Minimum interval between two notes in a scan's store about the best supplied ground station."""


class Reports:
    """Reports queued for the datalink's next turn. :meth:`put` is thread-safe. However many arrive,
    only a few are processed per turn."""

    def __init__(self, outbox: Outbox) -> None:
        self._outbox = outbox
        self._waiting: dict[tuple[str, str], bytes] = {}  # by scan and station
        self._taken_at = 0.0

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def put(self, key: str, payload: bytes) -> bool:
        """Queue the newest report of a key; whether it is the first one queued."""
        parts = key.split("/")
        if len(parts) != 5 or not (self._outbox.offers(parts[2]) and NAME.fullmatch(parts[4])):
            return False
        waiting, place = self._waiting, (parts[2], parts[4])
        if place not in waiting and not self._outbox.serves(parts[4]):
            strangers = sum(not self._outbox.serves(peer) for _, peer in list(waiting))
            if strangers >= MAX_STATIONS:
                return False
        is_first = not waiting
        waiting[place] = payload
        return is_first

    def take(self, now: float) -> list[tuple[str, str, bytes]]:
        """Scan, station and report of queued reports, every :data:`TAKE_S`."""
        if not self._waiting or now - self._taken_at < TAKE_S:
            return []
        self._taken_at = now
        waiting, self._waiting = self._waiting, {}
        return [(scan, peer, payload) for (scan, peer), payload in list(waiting.items())]


class HeldNotes:
    """Periodically notes in each scan's store what its best supplied ground station holds."""

    def __init__(self, outbox: Outbox) -> None:
        self._outbox = outbox
        self._kept: dict[str, tuple[float, str, Numbers]] = {}  # by scan

    def keep(self, store: ScanStore, now: float, is_last: bool = False) -> None:
        """Write the note if it is due: at once with ``is_last``, and for a finished scan that is
        complete at the ground, which is then not offered again."""
        name = store.header.name
        best = self._outbox.best(name) if self._outbox.offers(name) else None
        if best is None:
            return
        kept_at, *kept = self._kept.get(name, (-KEEP_S, "", {}))
        if kept == list(best) or not (
            is_last or now - kept_at >= KEEP_S or self._is_newly_whole(store, best[1])
        ):
            return
        self._kept[name] = (now, *best)
        try:
            store.set_held(*best)
        except OutsideError as error:
            log.warning("%s", error)

    def _is_newly_whole(self, store: ScanStore, held: Numbers) -> bool:
        if not store.finished:
            return False
        numbers = store.numbers()
        noted = self._kept[store.header.name][2]
        return bool(missing(numbers, noted)) and not missing(numbers, held)
