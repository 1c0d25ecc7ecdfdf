"""The items of a store, by kind and number, in memory; notifies listeners of new ones."""

from __future__ import annotations

import zlib
from collections.abc import Callable

from service.stream.codec import MAX_LAYERS
from service.stream.database import Database
from service.stream.ranges import RangeSet, is_number

Listener = Callable[[str, int], None]

_IN_FORCE = f"""
SELECT id FROM reposes one WHERE {is_number("one.id")} AND NOT EXISTS (
    SELECT 1 FROM reposes other WHERE other.seq = one.seq
    AND (other.revision, other.id) > (one.revision, one.id))
"""


class Inventory:
    """The numbers of the items of one scan; guarded by the database's lock.

    Header and summary are numbered by the CRC-32 of their JSON, so that changes are visible.
    Only the re-pose in force of each keyframe counts.
    """

    def __init__(self, database: Database) -> None:
        self._lock = database.lock
        self._listeners: list[Listener] = []
        self._numbers = {kind: RangeSet() for kind in ("header", "summary", "pose", "repose")}
        self._reposes = RangeSet()
        self._database = database
        self._load(database)

    def _load(self, database: Database) -> None:
        self._numbers["pose"] = _ids(database, "poses")
        self._numbers["repose"] = RangeSet.of(row[0] for row in database.all(_IN_FORCE))
        self._reposes = _ids(database, "reposes")
        for kind in ("header", "summary"):
            text = database.get(kind)
            if text is not None:
                self.note_whole(kind, text.encode())
        sql = f"SELECT seq, layer FROM chunks WHERE {is_number('seq')} ORDER BY layer, seq"
        for seq, layer in database.all(sql):
            if layer not in range(MAX_LAYERS):
                continue
            self._numbers.setdefault(f"k{layer}", RangeSet()).add(seq)

    def all(self) -> dict[str, RangeSet]:
        """Kind to numbers; kinds without any are left out."""
        with self._lock:
            return {kind: ranges.copy() for kind, ranges in self._numbers.items() if ranges}

    def of(self, kind: str) -> RangeSet:
        """The numbers of one kind; do not modify."""
        return self._numbers.setdefault(kind, RangeSet())

    def has_repose(self, number: int) -> bool:
        """Whether this re-pose is stored, in force or not."""
        return number in self._reposes

    def note(self, kind: str, number: int) -> None:
        """Add an item and notify the listeners."""
        self.of(kind).add(number)
        for listener in self._listeners:
            listener(kind, number)

    def note_whole(self, kind: str, data: bytes) -> None:
        """Set a new header or summary, which replaces the previous one."""
        self._numbers[kind] = RangeSet()
        self.note(kind, zlib.crc32(data))

    def note_repose(self, number: int, seq: int, revision: int) -> None:
        """Add a stored re-pose; the highest revision, then the highest number, is in force."""
        self._reposes.add(number)
        sql = "SELECT revision, id FROM reposes WHERE seq = ? AND id != ? ORDER BY 1 DESC, 2 DESC"
        before = self._database.one(f"{sql} LIMIT 1", (seq, number))
        if before is not None:
            if (before[0], before[1]) > (revision, number):
                return
            self._numbers["repose"].discard(before[1])
        self.note("repose", number)

    def listen(self, listener: Listener) -> None:
        """Call ``listener(kind, number)`` after each new item, on the writing thread."""
        with self._lock:
            self._listeners.append(listener)

    def unlisten(self, listener: Listener) -> None:
        """Remove a listener."""
        with self._lock:
            self._listeners.remove(listener)


def _ids(database: Database, table: str) -> RangeSet:
    return RangeSet.of(
        row[0] for row in database.all(f"SELECT id FROM {table} WHERE {is_number('id')}")
    )
