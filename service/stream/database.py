"""The SQLite file of a scan: one connection for all threads, errors in one line."""

from __future__ import annotations

import json
import logging
import sqlite3
import threading
from collections import Counter
from pathlib import Path
from typing import Any

from service.errors import InputError, OutsideError
from service.stream.schema import SCHEMA, as_error, can_write, check_schema, connect

log = logging.getLogger(__name__)

Statement = tuple[str, tuple[Any, ...]]


def blob(value: object) -> bytes:
    """The bytes in a column; none when the file has something else there."""
    return value if isinstance(value, bytes) else b""


def json_value(text: object) -> Any:
    """What a text of the file says; None unless it is JSON."""
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

    With ``read_only``, or where the disk cannot be written, nothing in the file is changed.
    Raises InputError when the file is no database of this kind, OutsideError when the disk fails.
    """

    def __init__(self, path: Path, read_only: bool = False) -> None:
        self.path = path
        self.uses: Counter[int] = Counter()  # queries that came back, by thread
        self.lock = threading.RLock()
        self.read_only = read_only or not can_write(path)
        try:
            self._connection, self._deadline = connect(path, self.read_only)
        except (sqlite3.Error, OSError) as error:
            raise self._cannot_open(error) from error
        try:
            check_schema(self._connection, path)
            if not self.read_only:
                self._connection.execute("PRAGMA journal_mode=WAL")
                self._connection.execute("PRAGMA synchronous=FULL")
                self._connection.executescript(SCHEMA)
        except BaseException as error:
            self._connection.close()
            if isinstance(error, sqlite3.Error):
                raise self._cannot_open(error) from error
            raise

    def _cannot_open(self, error: sqlite3.Error | OSError) -> InputError | OutsideError:
        if isinstance(error, OSError):
            return OutsideError(f"{self.path} cannot be opened ({error.strerror or error})")
        return as_error(self.path, error)

    def one(self, sql: str, values: tuple[Any, ...] = ()) -> tuple[Any, ...] | None:
        """The first row of a query."""
        rows = self.all(sql, values)
        return rows[0] if rows else None

    def all(self, sql: str, values: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
        """All rows of a query. Raises OutsideError when the file cannot be read."""
        try:
            with self.lock:
                self._deadline.start()
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
            self._deadline.start()
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
                self._deadline.start()
                if not self.read_only:
                    self._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            except sqlite3.Error as error:
                log.debug("no checkpoint of %s: %s", self.path, error)
            self._connection.close()
