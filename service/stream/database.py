"""The SQLite file of a scan: tables, one connection for all threads, repair, and the items in it.

A store may come from an untrusted source, and SQLite runs what the file's schema contains: a view
in place of a table may never end, a trigger writes. So functions in the schema are not trusted,
values have a maximum length, statements have a deadline, and a schema that is not exactly ours is
refused before anything is read.
"""

from __future__ import annotations

import json
import logging
import os
import sqlite3
import sys
import threading
import time
import zlib
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack, closing
from functools import cache
from pathlib import Path
from typing import Any

from service.errors import InputError, OutsideError, SkyreliefError, outside
from service.stream.codec import IMAGE_LAYER
from service.stream.ranges import MAX_NUMBER, RangeSet

log = logging.getLogger(__name__)

SCHEMA_VERSION = 1
SCHEMA = """
CREATE TABLE IF NOT EXISTS meta (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS chunks (
    seq INTEGER NOT NULL, layer INTEGER NOT NULL, layers INTEGER NOT NULL,
    time_unix_ns INTEGER NOT NULL, crc INTEGER NOT NULL, stored_unix_ns INTEGER NOT NULL,
    data BLOB NOT NULL, PRIMARY KEY (seq, layer));
CREATE TABLE IF NOT EXISTS poses (
    id INTEGER PRIMARY KEY, time_unix_ns INTEGER NOT NULL, data BLOB NOT NULL);
CREATE TABLE IF NOT EXISTS reposes (
    id INTEGER PRIMARY KEY, seq INTEGER NOT NULL, revision INTEGER NOT NULL,
    data BLOB NOT NULL);
CREATE INDEX IF NOT EXISTS reposes_by_seq ON reposes (seq, revision);
CREATE TABLE IF NOT EXISTS radio (
    kind TEXT NOT NULL, number INTEGER NOT NULL, part INTEGER NOT NULL, data BLOB NOT NULL,
    PRIMARY KEY (kind, number, part));
CREATE TABLE IF NOT EXISTS held (
    peer TEXT NOT NULL, kind TEXT NOT NULL, ranges TEXT NOT NULL, PRIMARY KEY (peer, kind));
"""

MAX_VALUE_BYTES = 1 << 25  # maximum length of a text or blob; the largest record has half of that
MAX_OBJECTS = 64
STATEMENT_S = 60.0
SLOWEST_BYTES_S = 1e6
"""A statement may take STATEMENT_S, and longer where a slow card has that much to read."""
STEPS = 100_000
"""Steps of SQLite's virtual machine between two clock checks; a statement takes some hundred."""

OUTSIDE = (
    "readonly", "read-only", "unable to open", "disk i/o", "disk is full", "is locked",
    "authorization denied",
)  # fmt: skip
"""Words in SQLite's messages that indicate a disk failure, not a damaged file."""


def connect(
    path: Path, read_only: bool = False, statement_s: float = STATEMENT_S
) -> tuple[sqlite3.Connection, Callable[[], None]]:
    """A connection that trusts nothing in the file, and what starts the time limit of its next
    statement. Raises sqlite3.Error."""
    mode = "ro" if read_only else "rwc"
    try:
        connection = _opened(path, f"mode={mode}")
    except sqlite3.OperationalError:
        wal = path.with_name(path.name + "-wal")
        if not read_only or (wal.exists() and wal.stat().st_size > 0):  # it holds data
            raise
        connection = _opened(path, "immutable=1")  # a disk that cannot even hold locks
    allowed_s = statement_s + (path.stat().st_size if path.exists() else 0) / SLOWEST_BYTES_S
    end_s = 0.0

    def start() -> None:
        nonlocal end_s
        end_s = time.monotonic() + allowed_s

    start()
    connection.set_progress_handler(lambda: time.monotonic() > end_s, STEPS)
    return connection, start


def _opened(path: Path, how: str) -> sqlite3.Connection:
    uri = f"{path.absolute().as_uri()}?{how}"
    connection = sqlite3.connect(uri, uri=True, check_same_thread=False, timeout=10.0)
    try:
        connection.text_factory = lambda data: data.decode("utf-8", "replace")
        connection.execute("PRAGMA trusted_schema=OFF")
        connection.execute("PRAGMA cell_size_check=ON")
        if sys.version_info >= (3, 11):  # before, a table's values are as long as the file at most
            connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_VALUE_BYTES)
            connection.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
            connection.setlimit(sqlite3.SQLITE_LIMIT_TRIGGER_DEPTH, 1)
        connection.execute("SELECT COUNT(*) FROM sqlite_master")  # opens the file
    except BaseException as error:
        connection.close()
        if isinstance(error, UnicodeDecodeError):  # SQLite's own message quotes the file
            raise sqlite3.DatabaseError("its schema is damaged") from error
        raise
    return connection


def can_write(path: Path) -> bool:
    """Whether a store at ``path`` can be changed: its file and its folder."""
    return os.access(path.parent, os.W_OK) and (not path.exists() or os.access(path, os.W_OK))


def check_schema(connection: sqlite3.Connection, path: Path) -> None:
    """Raise InputError unless the file holds our tables and nothing else; sqlite3.Error when
    that cannot be read."""
    sql = f"SELECT name, type, tbl_name, sql FROM sqlite_master LIMIT {MAX_OBJECTS + 1}"
    rows = connection.execute(sql).fetchall()
    for name, kind, table, text in rows:
        if kind == "index" and text is None and str(name).startswith("sqlite_autoindex_"):
            continue
        if _ours().get(str(name)) != (kind, table, _plain(text)):
            if name != "meta" and _version(connection) > SCHEMA_VERSION:
                raise InputError(f"{path} was written by a newer version; update skyrelief")
            raise InputError(f"{path} is not a scan database (it has a foreign {kind}, {name!r})")


def _version(connection: sqlite3.Connection) -> int:
    """Schema version in the file; 0 when its meta table is not ours."""
    found = "SELECT type, tbl_name, sql FROM sqlite_master WHERE name = 'meta'"
    row = connection.execute(found).fetchone()
    if row is None or _ours()["meta"] != (row[0], row[1], _plain(row[2])):
        return 0
    value = connection.execute("SELECT value FROM meta WHERE key = 'schema'").fetchone()
    text = str(value[0]) if value is not None else ""
    return int(text) if text.isascii() and text.isdigit() and len(text) < 9 else 0


@cache
def _ours() -> dict[str, tuple[str, str, str]]:
    """Name to kind, table and SQL of everything that belongs in the file."""
    with closing(sqlite3.connect(":memory:")) as connection:
        connection.executescript(SCHEMA)
        rows = connection.execute("SELECT name, type, tbl_name, sql FROM sqlite_master").fetchall()
    return {name: (kind, table, _plain(text)) for name, kind, table, text in rows}


def _plain(text: object) -> str:
    return " ".join(str(text).split())


def as_error(path: Path, error: sqlite3.Error) -> InputError | OutsideError:
    """The error to report for a failure to open a store."""
    text = str(error)
    if text == "interrupted":
        return InputError(f"{path} takes too long to read; it is not a valid scan database")
    if any(word in text.lower() for word in OUTSIDE):
        return OutsideError(
            f"{path} cannot be opened ({text}); where its disk cannot be written, copy the scan's "
            "folder to one that can"
        )
    return InputError(f"{path} is not a scan database ({text})")


Statement = tuple[str, tuple[Any, ...]]


def blob(value: object) -> bytes:
    """The bytes in a column; empty when the file has something else there."""
    return value if isinstance(value, bytes) else b""


def json_value(text: object) -> Any:
    """The value of a JSON text in the file; None for anything else."""
    try:
        return json.loads(text) if isinstance(text, str) else None
    except (ValueError, RecursionError):
        return None


def json_object(text: object) -> dict[str, Any]:
    """The JSON object in a text of the file; empty when there is none."""
    value = json_value(text)
    return value if isinstance(value, dict) else {}


class Database:
    """A connection in write-ahead mode with full synchronisation, safe between threads.

    With ``read_only``, or on a disk that cannot be written, the file stays unchanged.
    Raises InputError when the file is not such a database, OutsideError when the disk fails.
    """

    def __init__(
        self, path: Path, read_only: bool = False, statement_s: float = STATEMENT_S
    ) -> None:
        self.path = path
        self.uses: Counter[int] = Counter()  # completed queries, by thread
        self.lock = threading.RLock()
        self.read_only = read_only or not can_write(path)
        try:
            with outside(f"{path} cannot be opened"), ExitStack() as on_fault:
                self._connection, self._start = connect(path, self.read_only, statement_s)
                on_fault.callback(self._connection.close)
                check_schema(self._connection, path)
                if not self.read_only:
                    self._connection.execute("PRAGMA journal_mode=WAL")
                    self._connection.execute("PRAGMA synchronous=FULL")
                    self._connection.executescript(SCHEMA)
                on_fault.pop_all()
        except sqlite3.Error as error:
            raise as_error(path, error) from error

    def one(self, sql: str, values: tuple[Any, ...] = ()) -> tuple[Any, ...] | None:
        rows = self.all(sql, values)
        return rows[0] if rows else None

    def all(self, sql: str, values: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
        """All rows of a query. Raises OutsideError when the file cannot be read."""
        try:
            with self.lock:
                self._start()
                rows = self._connection.execute(sql, values).fetchall()
                self.uses[threading.get_ident()] += 1
                return rows
        except sqlite3.Error as error:
            raise OutsideError(f"cannot read {self.path} ({error}); check the disk") from error

    def version(self) -> tuple[int, int]:
        """Differs from an earlier one when this connection or another has written since."""
        row = self.one("PRAGMA data_version")
        return 0 if row is None else int(row[0]), self._connection.total_changes

    def write(self, statements: list[Statement]) -> int:
        """Run statements in one transaction; returns the number of changed rows. Raises
        OutsideError when the disk is full or fails; then nothing is changed."""
        with self.lock:
            self._start()
            before = self._connection.total_changes
            if not os.path.exists(self.path):  # SQLite goes on with a file that has no name
                raise OutsideError(f"cannot write {self.path} (the file is gone); check the disk")
            try:
                with self._connection:
                    for sql, values in statements:
                        self._connection.execute(sql, values)
            except sqlite3.Error as error:
                raise OutsideError(
                    f"cannot write {self.path} ({error}); free some space or check the disk"
                ) from error
            self.uses[threading.get_ident()] += 1
            return self._connection.total_changes - before

    def get(self, key: str) -> str | None:
        row = self.one("SELECT value FROM meta WHERE key = ?", (key,))
        return None if row is None else str(row[0])

    def set(self, key: str, value: str) -> None:
        self.write([("INSERT OR REPLACE INTO meta VALUES (?, ?)", (key, value))])

    def close(self) -> None:
        """Merge the write-ahead log into the file and close it."""
        with self.lock:
            try:
                self._start()
                if not self.read_only:
                    self._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            except sqlite3.Error as error:
                log.debug("no checkpoint of %s: %s", self.path, error)
            self._connection.close()


def peek_meta(path: Path, key: str) -> str | None:
    """A text of the meta table, also while the file is open elsewhere; None without one."""
    try:
        with closing(Database(path, read_only=True)) as database:
            return database.get(key)
    except SkyreliefError as error:
        log.debug("%s", error)
        return None


TABLES = ("meta", "chunks", "poses", "reposes", "radio", "held")


def is_sound(path: Path) -> bool:
    """Whether SQLite finds no fault in the file; a busy file counts as sound. Raises InputError
    when its schema is not that of a scan."""
    try:
        with closing(connect(path, read_only=not can_write(path))[0]) as connection:
            check_schema(connection, path)
            return bool(connection.execute("PRAGMA quick_check(1)").fetchone()[0] == "ok")
    except sqlite3.OperationalError:
        return True
    except sqlite3.DatabaseError:
        return False


def rescue(path: Path) -> int:
    """Replace the database at ``path`` by one with all readable rows; returns their number.

    The damaged file is kept as ``<name>.damaged``. Raises InputError and changes nothing when the
    scan's header cannot be read.
    """
    fresh = path.with_name(path.name + ".rescued")
    fresh.unlink(missing_ok=True)
    source = target = None
    try:
        source, _ = connect(path)
        check_schema(source, path)
        target = sqlite3.connect(fresh)
        target.executescript(SCHEMA)
        kept = sum(_copy(source, target, table) for table in TABLES)
        header = target.execute("SELECT 1 FROM meta WHERE key = 'header'").fetchone()
        target.commit()
    except sqlite3.Error as error:
        raise InputError(f"{path} is not a scan database ({error})") from error
    finally:
        for connection in (source, target):
            if connection is not None:
                connection.close()
    if header is None:
        fresh.unlink(missing_ok=True)
        raise InputError(f"{path} is damaged and its scan header is lost")
    for suffix in ("-wal", "-shm"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)
    path.replace(path.with_name(path.name + ".damaged"))
    fresh.replace(path)
    log.warning(
        "%s was damaged; %d rows are recovered, the old file is kept as .damaged", path, kept
    )
    return kept


def _copy(source: sqlite3.Connection, target: sqlite3.Connection, table: str) -> int:
    """Copy the readable rows of a table one by one, from both ends towards the damage."""
    kept = 0
    for order in ("ASC", "DESC"):
        try:
            rows = source.execute(f"SELECT * FROM {table} ORDER BY rowid {order}")
            for row in rows:
                marks = ", ".join("?" * len(row))
                cursor = target.execute(f"INSERT OR IGNORE INTO {table} VALUES ({marks})", row)
                kept += cursor.rowcount
            return kept
        except sqlite3.DatabaseError as error:
            log.debug("%s: %s", table, error)
    return kept


def is_number(column: str) -> str:
    return f"typeof({column}) = 'integer' AND {column} BETWEEN 0 AND {MAX_NUMBER}"


def chunk_kind(layer: int) -> str:
    """The kind of item that the store holds as this layer of a keyframe."""
    return "image" if layer == IMAGE_LAYER else f"k{layer}"


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
        self.listeners: list[Listener] = []
        self._numbers: dict[str, RangeSet] = {}
        self._reposes = RangeSet()  # stored, in force or not
        self._database = database
        self._version = database.version()[0]
        self._load(database)

    def follow(self) -> bool:
        """Take in what other connections have written, if anything; listeners are not called."""
        with self._lock:
            before, self._version = self._version, self._database.version()[0]
            if self._version == before:
                return False
            self._numbers.clear()
            self._load(self._database)
            return True

    def _load(self, database: Database) -> None:
        self._numbers["pose"] = _ids(database, "poses")
        self._numbers["repose"] = RangeSet.of(row[0] for row in database.all(_IN_FORCE))
        self._reposes = _ids(database, "reposes")
        for kind in ("header", "summary"):
            text = database.get(kind)
            if text is not None:
                self._numbers[kind] = RangeSet.of([zlib.crc32(text.encode())])
        sql = f"SELECT seq, layer FROM chunks WHERE {is_number('seq')} ORDER BY layer, seq"
        for seq, layer in database.all(sql):
            if layer in range(IMAGE_LAYER + 1):
                self._numbers.setdefault(chunk_kind(layer), RangeSet()).add(seq)

    def all(self) -> dict[str, RangeSet]:
        """Kind to numbers; kinds without any are left out."""
        with self._lock:
            return {kind: ranges.copy() for kind, ranges in self._numbers.items() if ranges}

    def of(self, kind: str) -> RangeSet:
        """The numbers of one kind; do not modify."""
        return self._numbers.setdefault(kind, RangeSet())

    def stored(self, kind: str) -> RangeSet:
        """As :meth:`of`; with the re-poses that are no longer in force."""
        return self._reposes if kind == "repose" else self.of(kind)

    def note(self, kind: str, number: int) -> None:
        self.of(kind).add(number)
        self.tell(kind, number)

    def tell(self, kind: str, number: int) -> None:
        for listener in self.listeners:
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
            self.of("repose").discard(before[1])
        self.note("repose", number)


def _ids(database: Database, table: str) -> RangeSet:
    return RangeSet.of(
        row[0] for row in database.all(f"SELECT id FROM {table} WHERE {is_number('id')}")
    )
