"""The SQLite file of a scan: schema, one connection for all threads, errors in one line."""

from __future__ import annotations

import logging
import sqlite3
import threading
from collections import Counter
from pathlib import Path
from typing import Any

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

Statement = tuple[str, tuple[Any, ...]]


def peek_meta(path: Path, key: str) -> str | None:
    """A text of the meta table of a file that may be open elsewhere; None when there is none."""
    try:
        connection = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True, timeout=10.0)
        try:
            row = connection.execute("SELECT value FROM meta WHERE key = ?", (key,)).fetchone()
        finally:
            connection.close()
    except (sqlite3.Error, OSError) as error:
        log.debug("%s: %s", path, error)
        return None
    return row[0] if row is not None and isinstance(row[0], str) else None


class Database:
    """A connection in write-ahead mode with full synchronisation, safe between threads.

    Raises InputError when the file is no database of this kind.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.uses: Counter[int] = Counter()  # queries that came back, by thread
        self.lock = threading.RLock()
        try:
            self._connection = sqlite3.connect(path, check_same_thread=False, timeout=10.0)
            self._connection.execute("PRAGMA journal_mode=WAL")
            self._connection.execute("PRAGMA synchronous=FULL")
            self._connection.executescript(SCHEMA)
        except sqlite3.Error as error:
            raise InputError(f"{path} is not a scan database ({error})") from error

    def one(self, sql: str, values: tuple[Any, ...] = ()) -> tuple[Any, ...] | None:
        """The first row of a query."""
        rows = self.all(sql, values)
        return rows[0] if rows else None

    def all(self, sql: str, values: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
        """All rows of a query. Raises OutsideError when the file cannot be read."""
        try:
            with self.lock:
                rows = self._connection.execute(sql, values).fetchall()
                self.uses[threading.get_ident()] += 1
                return rows
        except sqlite3.Error as error:
            raise OutsideError(f"cannot read {self.path} ({error}); check the disk") from error

    def write(self, statements: list[Statement]) -> int:
        """Run statements in one transaction; how many rows changed.

        Raises OutsideError when the disk is full or fails; nothing is changed then.
        """
        with self.lock:
            before = self._connection.total_changes
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
        """A text of the meta table."""
        row = self.one("SELECT value FROM meta WHERE key = ?", (key,))
        return None if row is None else str(row[0])

    def set(self, key: str, value: str) -> None:
        """Write a text of the meta table."""
        self.write([("INSERT OR REPLACE INTO meta VALUES (?, ?)", (key, value))])

    def close(self) -> None:
        """Fold the write-ahead log into the file and close it."""
        with self.lock:
            try:
                self._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            except sqlite3.Error as error:
                log.debug("no checkpoint of %s: %s", self.path, error)
            self._connection.close()
