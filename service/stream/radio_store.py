"""What the narrow radio brought of a scan, until better comes: tiles and poses, in its store."""

from __future__ import annotations

from collections.abc import Iterator

from recon.types import Keyframe
from service.stream.database import Database, blob
from service.stream.radio_messages import unpack_pose, unpack_tile
from service.stream.radio_tiles import keyframe_of
from service.stream.ranges import is_number
from service.stream.records import PoseRecord


class RadioStore:
    """The ``radio`` table of a scan's database."""

    def __init__(self, database: Database) -> None:
        self._db = database

    def add(self, kind: str, number: int, part: int, data: bytes) -> bool:
        """Store a message ("tile" or "pose"), the newest of its number; False if no news."""
        with self._db.lock:
            sql = "SELECT 1 FROM radio WHERE kind = ? AND number = ? AND part = ? AND data = ?"
            if self._db.one(sql, (kind, number, part, data)) is not None:
                return False
            row = (kind, number, part, data)
            self._db.write([("INSERT OR REPLACE INTO radio VALUES (?, ?, ?, ?)", row)])
            return True

    def keyframe(self, seq: int) -> Keyframe | None:
        """The keyframe that its tiles show; None without any."""
        sql = "SELECT data FROM radio WHERE kind = 'tile' AND number = ? ORDER BY part"
        tiles = [unpack_tile(blob(row[0])) for row in self._db.all(sql, (seq,))]
        return keyframe_of([tile[1] for tile in tiles if tile is not None])

    def seqs(self) -> set[int]:
        """Numbers of the keyframes of which there are tiles."""
        sql = f"SELECT DISTINCT number FROM radio WHERE kind = 'tile' AND {is_number('number')}"
        return {row[0] for row in self._db.all(sql)}

    def poses(self) -> Iterator[PoseRecord]:
        """The poses in the order of their numbers."""
        for (data,) in self._db.all("SELECT data FROM radio WHERE kind = 'pose' ORDER BY number"):
            found = unpack_pose(blob(data))
            if found is not None:
                yield found[2]
