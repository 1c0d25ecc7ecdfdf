"""A damaged scan database made sound again: what can be read is kept, the rest is said."""

from __future__ import annotations

import logging
import sqlite3
from pathlib import Path

from service.errors import InputError
from service.stream.schema import can_write, check_schema, connect

log = logging.getLogger(__name__)

TABLES = ("meta", "chunks", "poses", "reposes", "radio", "held")


def is_sound(path: Path) -> bool:
    """Whether SQLite finds no fault in the file; one that is merely busy counts as sound.

    Raises InputError when its schema is not that of a scan.
    """
    try:
        connection, _ = connect(path, read_only=not can_write(path))
        try:
            check_schema(connection, path)
            return bool(connection.execute("PRAGMA quick_check(1)").fetchone()[0] == "ok")
        finally:
            connection.close()
    except sqlite3.OperationalError:
        return True
    except sqlite3.DatabaseError:
        return False


def rescue(path: Path, schema: str) -> int:
    """Replace the database at ``path`` by one of all rows that can be read; how many.

    The damaged file stays beside it as ``<name>.damaged``. Raises InputError when not even
    the scan's header can be read, and changes nothing then.
    """
    fresh = path.with_name(path.name + ".rescued")
    fresh.unlink(missing_ok=True)
    source = target = None
    try:
        source, _ = connect(path)
        check_schema(source, path)
        target = sqlite3.connect(fresh)
        target.executescript(schema)
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
    log.warning("%s was damaged; %d rows are kept, the old file is beside it", path, kept)
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
