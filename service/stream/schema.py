"""The tables of a scan's SQLite file, and connections that a hostile file cannot turn on us.

A store may come from a stranger's card. SQLite then runs whatever the file's schema says: a view
instead of a table may never end, a trigger writes. So functions in the schema are not trusted,
values have a largest length, a statement has a deadline, and a schema that is not exactly ours
is refused before anything is read.
"""

from __future__ import annotations

import logging
import os
import sqlite3
import sys
import time
from functools import cache
from pathlib import Path

from service.errors import InputError, OutsideError

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

MAX_VALUE_BYTES = 1 << 25
"""Of a text or blob; the largest record has half of that."""
MAX_OBJECTS = 64
STATEMENT_S = 60.0
SLOWEST_BYTES_S = 1e6
"""A statement may take STATEMENT_S, and longer where a slow card has that much to read."""
STEPS = 100_000
"""Of SQLite's machine between two looks at the clock; a statement of a scan has some hundred."""

OUTSIDE = (
    "readonly", "read-only", "unable to open", "disk i/o", "disk is full", "is locked",
    "authorization denied",
)  # fmt: skip
"""Words in SQLite's messages that speak of the disk, not of the file."""


class Deadline:
    """Ends statements of one connection that take too long."""

    def __init__(self, connection: sqlite3.Connection, size_bytes: int) -> None:
        self._allowed_s = STATEMENT_S + size_bytes / SLOWEST_BYTES_S
        self._end_s = time.monotonic() + self._allowed_s
        connection.set_progress_handler(self._is_over, STEPS)

    def start(self) -> None:
        """Give the next statement its time."""
        self._end_s = time.monotonic() + self._allowed_s

    def _is_over(self) -> bool:
        return time.monotonic() > self._end_s


def connect(path: Path, read_only: bool = False) -> tuple[sqlite3.Connection, Deadline]:
    """A connection that trusts nothing in the file. Raises sqlite3.Error."""
    mode = "ro" if read_only else "rwc"
    try:
        connection = _opened(path, f"mode={mode}")
    except sqlite3.OperationalError:
        if not read_only or _has_log(path):
            raise
        connection = _opened(path, "immutable=1")  # a disk on which not even locks can be written
    size_bytes = path.stat().st_size if path.exists() else 0
    return connection, Deadline(connection, size_bytes)


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
    except UnicodeDecodeError as error:  # of SQLite's own message, which quotes the file
        connection.close()
        raise sqlite3.DatabaseError("its schema is damaged") from error
    except BaseException:
        connection.close()
        raise
    return connection


def _has_log(path: Path) -> bool:
    """Whether part of the data is still in the write-ahead log."""
    wal = path.with_name(path.name + "-wal")
    return wal.exists() and wal.stat().st_size > 0


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
    """Of the schema, as the file says; 0 when its meta table is not ours."""
    found = "SELECT type, tbl_name, sql FROM sqlite_master WHERE name = 'meta'"
    row = connection.execute(found).fetchone()
    if row is None or _ours()["meta"] != (row[0], row[1], _plain(row[2])):
        return 0
    value = connection.execute("SELECT value FROM meta WHERE key = 'schema'").fetchone()
    text = str(value[0]) if value is not None else ""
    return int(text) if text.isascii() and text.isdigit() and len(text) < 9 else 0


@cache
def _ours() -> dict[str, tuple[str, str, str]]:
    """Name to kind, table and text of what belongs in the file."""
    connection = sqlite3.connect(":memory:")
    try:
        connection.executescript(SCHEMA)
        rows = connection.execute("SELECT name, type, tbl_name, sql FROM sqlite_master").fetchall()
    finally:
        connection.close()
    return {name: (kind, table, _plain(text)) for name, kind, table, text in rows}


def _plain(text: object) -> str:
    return " ".join(str(text).split())


def as_error(path: Path, error: sqlite3.Error) -> InputError | OutsideError:
    """What a failure to open a store means to a person."""
    text = str(error)
    if text == "interrupted":
        return InputError(f"{path} takes too long to read; it is no scan database of ours")
    if any(word in text.lower() for word in OUTSIDE):
        return OutsideError(
            f"{path} cannot be opened ({text}); where its disk cannot be written, copy the scan's "
            "folder to one that can"
        )
    return InputError(f"{path} is not a scan database ({text})")


def peek_meta(path: Path, key: str) -> str | None:
    """A text of the meta table of a file that may be open elsewhere; None when there is none."""
    try:
        connection, _ = connect(path, read_only=True)
        try:
            check_schema(connection, path)
            sql = "SELECT value FROM meta WHERE key = ?"
            row = connection.execute(sql, (key,)).fetchone()
        finally:
            connection.close()
    except (sqlite3.Error, OSError, InputError) as error:
        log.debug("%s: %s", path, error)
        return None
    return row[0] if row is not None and isinstance(row[0], str) else None
