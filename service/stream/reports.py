"""What ground stations say they hold: the newest report of each waits, the best one is kept."""

from __future__ import annotations

import logging

from service.errors import OutsideError
from service.stream.messages import Numbers, missing
from service.stream.naming import NAME
from service.stream.outbox import MAX_STATIONS, Outbox
from service.stream.store import ScanStore

log = logging.getLogger(__name__)

TAKE_S = 0.2
"""From one look at the reports to the next."""
KEEP_S = 10.0
"""How often a scan's store notes what its best supplied ground station holds, at most."""


class Reports:
    """Reports that wait for the datalink's next turn. :meth:`put` is safe from any thread.

    However many come, from however many stations, a few are looked at in a turn.
    """

    def __init__(self, outbox: Outbox) -> None:
        self._outbox = outbox
        self._waiting: dict[tuple[str, str], bytes] = {}  # by scan and station
        self._taken_at = 0.0

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def put(self, key: str, payload: bytes) -> bool:
        """Keep the newest report of a key; whether it is the first one that waits."""
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
        """Scan, station and report of those that wait, every :data:`TAKE_S`."""
        if not self._waiting or now - self._taken_at < TAKE_S:
            return []
        self._taken_at = now
        waiting, self._waiting = self._waiting, {}
        return [(scan, peer, payload) for (scan, peer), payload in list(waiting.items())]


class HeldNotes:
    """Notes in each scan's store what its best supplied ground station holds, now and then."""

    def __init__(self, outbox: Outbox) -> None:
        self._outbox = outbox
        self._kept: dict[str, tuple[float, str, Numbers]] = {}  # by scan

    def keep(self, store: ScanStore, now: float, is_last: bool = False) -> None:
        """Write the note if it is due: at once for a finished scan that is whole there, which
        is not offered again, and with ``is_last``."""
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
