"""The scan on disk: one SQLite file, identical onboard and on the ground.

Everything is committed here before it is offered to the link. Write-ahead logging with full
synchronisation: a killed process loses at most the current transaction. Chunks are coded layers,
keyed by keyframe and layer; poses and re-poses keep the drone's numbers, so that both ends can
name missing items.
"""

from __future__ import annotations

import json
import os
import time
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import Any

from recon.types import Keyframe
from service.errors import InputError, refusing
from service.stream import codec
from service.stream.database import (
    SCHEMA_VERSION,
    Database,
    Inventory,
    Listener,
    Statement,
    blob,
    can_write,
    chunk_kind,
    is_number,
    is_sound,
    json_object,
    json_value,
    peek_meta,
    rescue,
)
from service.stream.radio_tiles import RadioStore
from service.stream.ranges import MAX_NUMBER, RangeSet, ranges_from_pairs
from service.stream.records import (
    PoseRecord,
    Repose,
    ScanHeader,
    header_from_json,
    pack_pose,
    pack_repose,
    read_header,
    unpack_pose,
    unpack_repose,
)
from service.stream.validity import summary_from_json

_NOT_TOO_LARGE = f"LENGTH(data) <= {codec.MAX_LAYER_BYTES}"
_IS_LAYER = f"typeof(layer) = 'integer' AND layer BETWEEN 0 AND {codec.MAX_LAYERS - 1}"
HELD_BYTES = 500_000_000  # decoded keyframes that are held
DECODED_BYTES = 13  # a pixel of a keyframe: depth, sigma, views, colour, mask
MAX_HELD_PEERS = 8  # maximum ground stations whose items are noted


class ScanStore:
    """One scan's database. Safe for one writer and several readers, in threads.

    Above ``quota_bytes`` keyframes are stored coarse only; :attr:`refused` counts layers not
    stored. A full disk raises OutsideError and leaves the file intact.
    """

    def __init__(
        self,
        path: Path,
        header: ScanHeader | None,
        quota_bytes: int | None,
        read_only: bool = False,
    ) -> None:
        self.path = path
        self.quota_bytes = quota_bytes
        self.refused = 0
        self.database = Database(path, read_only)
        self._lock = self.database.lock
        if header is not None:
            self.database.set("schema", str(SCHEMA_VERSION))
            self.database.set("header", header.to_json().decode())
        self._header = self._read_header()
        total = self.database.one("SELECT TOTAL(LENGTH(data)) FROM chunks")
        self.chunk_bytes = int(total[0]) if total else 0
        self._inventory = Inventory(self.database)
        self.radio = RadioStore(self.database)
        self._first = -1, b""  # number and coarse layer of the newest first depth
        self._held: dict[tuple[int, int], Keyframe] = {}  # by number and layer
        self._held_room: int | None = None  # bytes; None: nothing is held
        self._holding = Lock()
        self._decoding: dict[tuple[int, int], Lock] = {}
        self._only: frozenset[int] | None = None  # keyframes that a reader is restricted to

    @classmethod
    def create(
        cls, path: Path | str, header: ScanHeader, quota_bytes: int | None = None
    ) -> ScanStore:
        """A new store; raises InputError when ``path`` exists or cannot be created."""
        path = Path(path)
        if os.path.exists(path):
            raise InputError(f"{path} exists; open it or choose another folder")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"cannot make {path.parent} ({error.strerror})") from error
        return cls(path, header, quota_bytes)

    @classmethod
    def open(
        cls, path: Path | str, quota_bytes: int | None = None, read_only: bool = False
    ) -> ScanStore:
        """An existing store, also after a crash; valid data is kept.

        With ``read_only`` nothing is written, and a damaged file is refused. Raises InputError
        when there is no such file or it contains no scan, OutsideError when the disk fails.
        """
        path = Path(path)
        if not path.is_file():
            raise InputError(f"{path} does not exist; it should be a scan.db")
        if not is_sound(path):
            if read_only or not can_write(path):
                raise InputError(f"{path} is damaged; copy its folder where it can be repaired")
            rescue(path)
        return cls(path, None, quota_bytes, read_only)

    @classmethod
    def peek(cls, path: Path) -> ScanStore:
        """An existing store, read without looking for damage, which reads the whole file. Raises
        InputError when it contains no scan, OutsideError when it cannot be read."""
        return cls(path, None, None, read_only=True)

    def close(self) -> None:
        """Merge the write-ahead log into the file and close it."""
        self.database.close()

    def __enter__(self) -> ScanStore:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # Header and summary

    @property
    def header(self) -> ScanHeader:
        return self._header

    def update_header(self, **fields: Any) -> None:
        """Replace fields of the header, such as the origin once it is known."""
        self.put_header(replace(self._header, **fields))

    def put_header(self, header: ScanHeader) -> None:
        with self._lock:
            self._set_whole("header", header.to_json(), header)

    @property
    def summary(self) -> dict[str, Any] | None:
        """The argument of :meth:`finish`; None for a scan in progress."""
        text = self.database.get("summary")
        return None if text is None else summary_from_json(text.encode()) or {}

    @property
    def refinement(self) -> dict[str, Any] | None:
        note = json_object(self.database.get("refinement"))
        figures = note.get("figures")
        return figures if isinstance(figures, dict) and not figures.get("undone") else None

    @property
    def finished(self) -> bool:
        return self.database.get("summary") is not None

    def finish(self, summary: dict[str, Any]) -> None:
        """Close the scan with its ``summary`` of plain values; non-finite numbers become null.
        Raises ValueError for a summary that receivers would reject."""
        strict = json.loads(json.dumps(summary), parse_constant=lambda _: None)
        data = json.dumps(strict, sort_keys=True).encode()
        if summary_from_json(data) is None:
            raise ValueError(f"no summary of a scan: {data[:200]!r}")
        self._set_whole("summary", data, self._header)

    # Chunks

    def add_keyframe(self, seq: int, layers: Sequence[bytes], image: bytes | None = None) -> int:
        """Store the coded ``layers`` of keyframe ``seq`` and its ``image``, a JPEG, at once;
        returns the number of new ones.

        Over the quota only the coarse layer is kept. Raises ValueError for bytes that are no
        layer or image of this keyframe, OutsideError when the disk is full.
        """
        rows = [_chunk_row(data) for data in layers]
        if image is not None:
            rows.append(_image_row(seq, image))
        sound = [row for row in rows if row is not None and row[0] == seq]
        if len(sound) < len(rows):
            raise ValueError(f"not the layers or image of keyframe {seq}")
        with self._lock:
            kept = sound if self._room(sum(map(len, layers))) else sound[:1]
            self.refused += len(sound) - len(kept)
            return self._put_chunks(kept)

    def _put_chunks(self, rows: Sequence[tuple[Any, ...]]) -> int:
        sql = "INSERT OR IGNORE INTO chunks VALUES (?, ?, ?, ?, ?, ?, ?)"
        fresh = [row for row in rows if row[0] not in self._inventory.of(chunk_kind(row[1]))]
        self.database.write([(sql, row) for row in fresh])
        for row in fresh:
            self.chunk_bytes += len(row[-1])
            self._inventory.note(chunk_kind(row[1]), row[0])
        return len(fresh)

    def offer_first(self, seq: int, layer: bytes) -> None:
        """Report a keyframe's first depth, a coarse layer, to the listeners. It is in memory only,
        until the next one or the keyframe's own layers come."""
        with self._lock:
            self._first = seq, layer
            self._inventory.tell("first", seq)

    def _put_first(self, seq: int, data: bytes) -> bool:
        """Show a first depth from the other end until its keyframe comes, another first depth, or
        the end of the scan; False when it is no coarse layer of this keyframe."""
        head = codec.peek(data)
        if head is None or (head.layer, head.seq) != (0, seq):
            return False
        with self._lock:
            if not self.finished and seq not in self._inventory.of("k0"):
                self.radio.put_first(seq, data)
        return True

    def chunk(self, seq: int, number: int) -> bytes | None:
        """The coded layer ``number`` of keyframe ``seq``."""
        sql = f"SELECT data FROM chunks WHERE seq = ? AND layer = ? AND {_NOT_TOO_LARGE}"
        row = self.database.one(sql, (seq, number))
        return None if row is None else blob(row[0])

    def image(self, seq: int) -> bytes | None:
        """The JPEG of the whole keyframe ``seq``; None in scans without."""
        data = self.chunk(seq, codec.IMAGE_LAYER)
        return data if data is not None and codec.is_image(data) else None

    def keyframe(self, seq: int) -> Keyframe | None:
        """Keyframe ``seq`` at its finest stored layer, with the newest re-pose applied. Without a
        layer, the tiles of the narrow radio or the first depth are used."""
        decoded = self.keyframe_as_sent(seq)
        repose = self.repose(seq)
        return decoded if decoded is None or repose is None else repose.applied_to(decoded)

    def keyframe_as_sent(self, seq: int) -> Keyframe | None:
        """As :meth:`keyframe`, without the re-pose."""
        sql = f"SELECT layer FROM chunks WHERE seq = ? AND {_IS_LAYER} ORDER BY layer DESC"
        for (number,) in self.database.all(sql, (seq,)):
            decoded = self._decoded(seq, number)
            if decoded is not None and decoded.seq == seq:
                return decoded
        return self.radio.keyframe(seq)

    def hold_decoded(self) -> None:
        """Hold decoded layers in memory, for who reads all keyframes several times; they must not
        be written into."""
        self._held_room = HELD_BYTES

    def _decoded(self, seq: int, number: int) -> Keyframe | None:
        """A layer's keyframe, as it was sent."""
        if self._held_room is None:
            return codec.decode([self.chunk(seq, number) or b""])
        key = seq, number
        with self._holding:
            decoding = self._decoding.setdefault(key, Lock())
        with decoding:  # a second thread takes what the first has decoded
            found = self._held.get(key)
            if found is None:
                found = codec.decode([self.chunk(seq, number) or b""])
                size = 0 if found is None else DECODED_BYTES * found.fresh.size
                with self._holding:
                    if found is not None and size <= self._held_room:
                        self._held_room -= size
                        self._held[key] = found
            return found

    def keyframes(self) -> Iterator[Keyframe]:
        """All keyframes in order of their number, as :meth:`keyframe` gives them."""
        for seq in self.seqs():
            found = self.keyframe(seq)
            if found is not None:
                yield found

    def only(self, seqs: Iterable[int]) -> None:
        """From now on :meth:`seqs` gives these keyframes only."""
        self._only = frozenset(seqs)

    def seqs(self) -> list[int]:
        if self._only is not None:
            return sorted(self._only)
        sql = f"SELECT DISTINCT seq FROM chunks WHERE {is_number('seq')} AND {_IS_LAYER}"
        stored = {row[0] for row in self.database.all(sql)}
        return sorted(stored | self.radio.seqs())

    def states(self) -> dict[int, tuple[int, int]]:
        """Each keyframe's finest stored layer, -1 for tiles of the narrow radio alone, -2 for a
        first depth alone, and the revision of its newest re-pose, -1 without one."""
        tiles = "SELECT number, -1 FROM radio WHERE kind = 'tile'"
        radio = f"{tiles} UNION SELECT number, -2 FROM radio WHERE kind = 'first'"
        chunks = f"SELECT seq, layer FROM chunks WHERE {_IS_LAYER}"
        finest = f"SELECT seq, MAX(layer) FROM ({chunks} UNION {radio}) WHERE {is_number('seq')}"
        layers = self.database.all(f"{finest} GROUP BY seq ORDER BY seq")
        newest = f"SELECT seq, MAX(revision) FROM reposes WHERE {is_number('revision')}"
        revisions = dict(self.database.all(f"{newest} GROUP BY seq"))
        return {seq: (layer, revisions.get(seq, -1)) for seq, layer in layers}

    # Poses and re-poses

    def add_pose(self, pose: PoseRecord) -> int:
        return self.add_poses([pose])

    def add_poses(self, poses: Sequence[PoseRecord]) -> int:
        """Store several poses in one transaction; returns the first number. Those that receivers
        would reject are left out."""
        packed = [(pose, pack_pose(pose)) for pose in poses]
        packed = [row for row in packed if unpack_pose(row[1]) is not None]
        with self._lock:
            first = self.next_id("poses")
            self._insert([(first + i, *row) for i, row in enumerate(packed)])
            return first

    def _insert(self, rows: Sequence[tuple[int, PoseRecord | Repose, bytes]]) -> None:
        """Store poses or re-poses in one transaction: number, record, and its bytes."""
        statements: list[Statement] = [
            ("INSERT INTO poses VALUES (?, ?, ?)", (number, record.time_unix_ns, data))
            if isinstance(record, PoseRecord)
            else ("INSERT INTO reposes VALUES (?, ?, ?, ?)",
                  (number, record.seq, record.revision, data))
            for number, record, data in rows
        ]  # fmt: skip
        self.database.write(statements)
        for number, record, _ in rows:
            if isinstance(record, PoseRecord):
                self._inventory.note("pose", number)
            else:
                self._inventory.note_repose(number, record.seq, record.revision)

    def poses(self) -> list[PoseRecord]:
        """All poses in order of time; of several at one time only the newest."""
        newest = "SELECT MAX(id) FROM poses GROUP BY time_unix_ns"
        rows = self.database.all(f"SELECT data FROM poses WHERE id IN ({newest}) ORDER BY id")
        poses = [pose for row in rows if (pose := unpack_pose(blob(row[0]))) is not None]
        if not self._inventory.of("pose"):
            poses = self.radio.poses()
        newest_at = {pose.time_unix_ns: pose for pose in poses}
        return sorted(newest_at.values(), key=lambda pose: pose.time_unix_ns)

    def poses_beside(self, known: RangeSet) -> Iterator[tuple[int, PoseRecord]]:
        """Number and pose of those whose numbers are not ``known``; adds them to it. Of the gaps in
        ``known``, the newest MAX_RANGES are read."""
        sql = "SELECT id, data FROM poses WHERE id BETWEEN ? AND ?"
        for gap in (RangeSet([(0, MAX_NUMBER)]) - known).pairs():
            for number, data in self.database.all(sql, gap):
                known.add(number)
                pose = unpack_pose(blob(data))
                if pose is not None:
                    yield number, pose

    def add_reposes(self, reposes: Sequence[Repose]) -> None:
        """Store several re-poses in one transaction, under the next numbers."""
        with self._lock:
            first = self.next_id("reposes")
            self._insert([(first + i, r, pack_repose(r)) for i, r in enumerate(reposes)])

    def repose(self, seq: int, below: int = 1 << 32) -> Repose | None:
        """The newest re-pose of keyframe ``seq``, of the revisions ``below`` a number."""
        of = "SELECT data FROM reposes WHERE seq = ? AND revision < ?"
        row = self.database.one(f"{of} ORDER BY revision DESC, id DESC LIMIT 1", (seq, below))
        return None if row is None else unpack_repose(blob(row[0]))

    # For the link

    def record(self, kind: str, number: int) -> bytes | None:
        """The stored bytes of item ``number`` of a kind of :mod:`service.stream.messages`. Header
        and summary are numbered by the CRC-32 of their JSON, so that changes are visible."""
        if kind in ("header", "summary"):
            text = self.database.get(kind)
            data = b"" if text is None else text.encode()
            return data if zlib.crc32(data) == number else None
        if kind.startswith("k"):
            return self.chunk(number, int(kind[1:]))
        if kind == "first":
            seq, layer = self._first
            return layer if seq == number and number not in self._inventory.of("k0") else None
        if kind == "image":
            return self.image(number)
        table = {"pose": "poses", "repose": "reposes"}[kind]
        row = self.database.one(f"SELECT data FROM {table} WHERE id = ?", (number,))
        return None if row is None else blob(row[0])

    def put_record(self, kind: str, number: int, data: bytes) -> bool:
        """Store a record from the other end; False if it is not this item, invalid, already known,
        or above the quota."""
        if kind in ("header", "summary"):
            return self._put_whole(kind, number, data)
        if kind == "first":
            return self._put_first(number, data)
        if kind in ("pose", "repose"):
            record = unpack_pose(data) if kind == "pose" else unpack_repose(data)
            with self._lock:
                if record is None or number in self._inventory.stored(kind):
                    return False
                self._insert([(number, record, data)])
                return True
        row = _image_row(number, data) if kind == "image" else _chunk_row(data)
        if row is None or (row[0], chunk_kind(row[1])) != (number, kind):
            return False
        with self._lock:
            if row[1] > 0 and not self._room(len(row[-1])):
                self.refused += 1
                return False
            return self._put_chunks([row]) > 0

    def _put_whole(self, kind: str, number: int, data: bytes) -> bool:
        with self._lock:
            if number in self._inventory.of(kind) or zlib.crc32(data) != number:
                return False
            header = header_from_json(data) if kind == "header" else self._header
            if header is None or header.identity != self._header.identity:
                return False
            if kind == "summary" and summary_from_json(data) is None:
                return False
            self._set_whole(kind, data, header)
            return True

    def numbers(self) -> dict[str, RangeSet]:
        """Kind to the numbers of stored items; only re-poses in force are listed."""
        return self._inventory.all()

    def follow(self) -> None:
        """Take in the header and :meth:`numbers` that another connection has written since."""
        with self._lock:
            if self._inventory.follow():
                self._header = self._read_header()

    def numbers_of(self, kind: str) -> RangeSet:
        """The numbers of the stored items of one kind; do not modify."""
        return self._inventory.of(kind)

    def listen(self, listener: Listener) -> None:
        """Call ``listener(kind, number)`` after each new item, on the writing thread."""
        with self._lock:
            self._inventory.listeners.append(listener)

    def unlisten(self, listener: Listener) -> None:
        with self._lock:
            self._inventory.listeners.remove(listener)

    def _set_whole(self, kind: str, data: bytes, header: ScanHeader) -> None:
        with self._lock:
            if kind == "summary":
                self.radio.drop_first()
            self.database.set(kind, data.decode())
            self._header = header
            self._inventory.note_whole(kind, data)

    def set_held(self, peer: str, numbers: dict[str, RangeSet]) -> None:
        """Note the items that ``peer`` reports; beyond the maximum the oldest notes are deleted."""
        sql = "INSERT OR REPLACE INTO held VALUES (?, ?, ?)"
        rows = [(peer, kind, json.dumps(ranges.pairs())) for kind, ranges in numbers.items()]
        newest = "SELECT peer FROM held GROUP BY peer ORDER BY MAX(rowid) DESC LIMIT ?"
        forget = (f"DELETE FROM held WHERE peer NOT IN ({newest})", (MAX_HELD_PEERS,))
        self.database.write([*((sql, row) for row in rows), forget])

    def held(self) -> dict[str, dict[str, RangeSet]]:
        """Peer to its reported items."""
        out: dict[str, dict[str, RangeSet]] = {}
        for peer, kind, text in self.database.all("SELECT peer, kind, ranges FROM held"):
            ranges = ranges_from_pairs(json_value(text))
            if ranges is not None:
                out.setdefault(str(peer), {})[str(kind)] = ranges
        return out

    # SQL

    def _room(self, size: int) -> bool:
        return self.quota_bytes is None or self.chunk_bytes + size <= self.quota_bytes

    def _read_header(self) -> ScanHeader:
        text = self.database.get("header")
        schema = self.database.get("schema")
        if text is None or schema is None or not (schema.isdecimal() and len(schema) < 9):
            raise InputError(f"{self.path} contains no scan header; it is not a scan database")
        if int(schema) > SCHEMA_VERSION:
            raise InputError(f"{self.path} was written by a newer version; update skyrelief")
        with refusing(f"{self.path}: the scan's header is not valid"):
            return read_header(text.encode())

    def next_id(self, table: str) -> int:
        row = self.database.one(f"SELECT MAX(id) FROM {table} WHERE {is_number('id')}")
        return 1 if row is None or row[0] is None else int(row[0]) + 1


def header_of(path: Path) -> ScanHeader | None:
    """The header of a store, also while it is open elsewhere; None when it cannot be read."""
    text = peek_meta(path, "header")
    return None if text is None else header_from_json(text.encode())


def _chunk_row(data: bytes) -> tuple[Any, ...] | None:
    """The row of a coded layer; None for invalid bytes."""
    head = codec.peek(data)
    if head is None:
        return None
    place = (head.seq, head.layer, head.layers, head.time_unix_ns)
    return *place, zlib.crc32(data), time.time_ns(), data


def _image_row(seq: int, data: bytes) -> tuple[Any, ...] | None:
    """A keyframe's image in the table of layers, which states its time; None for invalid bytes."""
    if not codec.is_image(data):
        return None
    return seq, codec.IMAGE_LAYER, 0, 0, zlib.crc32(data), time.time_ns(), data
