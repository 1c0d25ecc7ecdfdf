"""Hostile scan folders: a sound one, mutated by bytes, by meaning, by schema."""

from __future__ import annotations

import json
import os
import random
import shutil
import sqlite3
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from hostile_records import (
    BIG,
    damaged,
    hostile_headers,
    hostile_json,
    hostile_layers,
    hostile_poses,
    hostile_reposes,
)

from service.stream import codec

Change = Callable[[Path], None]

ROW = "INSERT OR REPLACE INTO %s VALUES (%s)"
ENDLESS = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n)"
SCHEMAS: dict[str, str] = {
    "endless view of chunks": "DROP TABLE chunks; CREATE VIEW chunks AS "
    f"{ENDLESS} SELECT x AS seq, 0 AS layer, 1 AS layers, 1 AS time_unix_ns, 1 AS crc, "
    "1 AS stored_unix_ns, x'00' AS data FROM n",
    "endless view that gives nothing": "DROP TABLE chunks; CREATE VIEW chunks AS "
    f"{ENDLESS} SELECT x AS seq, 0 AS layer, 1 AS layers, 1 AS time_unix_ns, 1 AS crc, "
    "1 AS stored_unix_ns, x'00' AS data FROM n WHERE x < 0",
    "view of a huge blob": "DROP TABLE chunks; CREATE VIEW chunks AS SELECT 0 AS seq, 0 AS layer, "
    "1 AS layers, 1 AS time_unix_ns, 1 AS crc, 1 AS stored_unix_ns, zeroblob(999999999) AS data",
    "view of huge poses": "DROP TABLE poses; CREATE VIEW poses AS "
    "SELECT 1 AS id, 1 AS time_unix_ns, zeroblob(999999999) AS data",
    "meta is a view": "ALTER TABLE meta RENAME TO m; CREATE VIEW meta AS SELECT * FROM m",
    "meta grows": "ALTER TABLE meta RENAME TO m; CREATE VIEW meta AS SELECT key, "
    "value || hex(zeroblob(400000000)) AS value FROM m",
    "huge header": "UPDATE meta SET value = hex(zeroblob(50000000)) WHERE key = 'header'",
    "huge chunk": "UPDATE chunks SET data = zeroblob(300000000) WHERE seq + layer = 0",
    "huge pose": "UPDATE poses SET data = zeroblob(300000000) WHERE id = 1",
    "trigger that adds": "CREATE TRIGGER t AFTER INSERT ON held BEGIN "
    f"INSERT INTO meta {ENDLESS} SELECT x, x FROM n; END; CREATE TRIGGER u AFTER INSERT ON meta "
    "BEGIN DELETE FROM chunks; END; CREATE TRIGGER v AFTER UPDATE ON meta BEGIN "
    "DELETE FROM poses; END; CREATE TRIGGER w AFTER INSERT ON reposes BEGIN DELETE FROM meta; END",
    "index on a slow expression": "CREATE INDEX i ON poses (length(hex(zeroblob(1000 + id))))",
    "generated column": "ALTER TABLE poses ADD COLUMN g AS (zeroblob(900000000))",
    "no such columns": "DROP TABLE poses; CREATE TABLE poses (a, b)",
    "text keys": "DROP TABLE poses; CREATE TABLE poses (id TEXT, time_unix_ns TEXT, data TEXT); "
    "INSERT INTO poses VALUES ('x', 'y', 'z')",
    "held of many": "INSERT INTO held WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 "
    "FROM n LIMIT 200000) SELECT 'peer' || x, 'k0', '[[0,4294967295]]' FROM n",
    "many poses of nothing": "INSERT OR REPLACE INTO poses WITH RECURSIVE n(x) AS (SELECT 1 UNION "
    "ALL SELECT x + 1 FROM n LIMIT 100000) SELECT x * 7, x, x'00' FROM n",
    "many keyframes of nothing": "INSERT OR REPLACE INTO chunks WITH RECURSIVE n(x) AS (SELECT 1 "
    "UNION ALL SELECT x + 1 FROM n LIMIT 100000) SELECT x * 3, 0, 1, 1, 1, 1, x'00' FROM n",
    "virtual table": "CREATE VIRTUAL TABLE f USING fts5(x); DROP TABLE radio; "
    "CREATE VIRTUAL TABLE radio USING fts5(kind, number, part, data)",
    "view of itself": "DROP TABLE held; CREATE VIEW held AS SELECT * FROM held",
    "newer schema": "UPDATE meta SET value = '99999' WHERE key = 'schema'",
    "schema is not a number": "UPDATE meta SET value = 'x' WHERE key = 'schema'",
    "schema of 5000 digits": f"UPDATE meta SET value = '{'9' * 5000}' WHERE key = 'schema'",
    "schema is a blob": "UPDATE meta SET value = x'ff' WHERE key = 'schema'",
    "header is a blob": "UPDATE meta SET value = CAST(value AS BLOB) WHERE key = 'header'",
    "no header": "DELETE FROM meta WHERE key = 'header'",
    "broken schema text": "PRAGMA writable_schema=ON; "
    "UPDATE sqlite_master SET sql = 'CREATE TABLE x(' WHERE name = 'chunks'",
    "wrong root page": "PRAGMA writable_schema=ON; "
    "UPDATE sqlite_master SET rootpage = 1 WHERE name = 'chunks'",
    "far root page": "PRAGMA writable_schema=ON; "
    "UPDATE sqlite_master SET rootpage = 99999999 WHERE name = 'poses'",
    "text that is none": "UPDATE meta SET value = CAST(x'fffe0000' AS TEXT)",
}
CHUNKS: dict[str, str] = {
    "negative keyframe": "UPDATE chunks SET seq = -1 - seq",
    "keyframe beyond 32 bits": "UPDATE chunks SET seq = seq + 4294967296",
    "keyframe beyond 63 bits": "UPDATE chunks SET seq = 9223372036854775807 - seq",
    "layer 99": "UPDATE chunks SET layer = layer + 99",
    "layer -1": "UPDATE chunks SET layer = -1 - layer",
    "time is a text": "UPDATE chunks SET time_unix_ns = 'noon', stored_unix_ns = 'never'",
    "chunk is a text": "UPDATE chunks SET data = 'text'",
    "chunk is empty": "UPDATE chunks SET data = x''",
    "keyframe is a text": "UPDATE chunks SET seq = 'x' || seq",
    "layer is a real": "UPDATE chunks SET layer = layer + 0.5",
    "pose is a text": "UPDATE poses SET data = 'text'",
    "pose is a number": "UPDATE poses SET data = 7",
    "pose id negative": "UPDATE poses SET id = -id, time_unix_ns = -time_unix_ns",
    "pose id far": "UPDATE poses SET id = id + 9223372036854770000",
    "pose time a text": "UPDATE poses SET time_unix_ns = 'x' || id",
    "held is not JSON": "INSERT INTO held VALUES ('p', 'k0', '[[')",
    "held is deep": f"INSERT INTO held VALUES ('p', 'k0', '{'[' * 9999}')",
    "held is wide": f"INSERT INTO held VALUES ('p', 'k0', '[[0,{BIG}],[-1,{10**30}]]')",
    "radio is noise": "INSERT INTO radio VALUES ('tile', 0, 0, randomblob(127)), "
    "('tile', -5, 'x', 'y'), ('pose', 1, 1, randomblob(60)), ('z', 1, 1, x'')",
}


def _sql(script: str) -> Change:
    def change(folder: Path) -> None:
        db = sqlite3.connect(folder / "scan.db")
        try:
            db.executescript(script)
            db.commit()
        finally:
            db.close()

    return change


def _meta(key: str, text: bytes) -> Change:
    return _row("meta", key, text.decode("utf-8", "surrogateescape").encode("utf-8", "replace"))


def _row(table: str, *values: Any) -> Change:
    def change(folder: Path) -> None:
        db = sqlite3.connect(folder / "scan.db")
        marks = ["CAST(? AS TEXT)" if table == "meta" else "?"] * len(values)
        with db:
            db.execute(ROW % (table, ", ".join(marks)), values)
        db.close()

    return change


def _chunk(data: bytes) -> Change:
    """Every keyframe of the scan replaced by this layer, under its own numbers and times."""

    def change(folder: Path) -> None:
        db = sqlite3.connect(folder / "scan.db")
        with db:
            db.execute("DELETE FROM chunks")
            for seq in range(3):
                own = data[:8] + seq.to_bytes(4, "little") + data[12:218]
                seal = zlib.crc32(data[222:], zlib.crc32(own))
                whole = own + seal.to_bytes(4, "little") + data[222:]
                row = (seq, data[5], data[6], 1, zlib.crc32(whole), 1, whole)
                db.execute(ROW % ("chunks", "?, ?, ?, ?, ?, ?, ?"), row)
        db.close()

    return change


def _spread(change: Callable[[Any, int], Any]) -> Change:
    """The scan's own layers, each with its header changed by ``change(head, seq)``."""

    def apply(folder: Path) -> None:
        db = sqlite3.connect(folder / "scan.db")
        with db:
            for seq, k, data in db.execute("SELECT seq, layer, data FROM chunks").fetchall():
                opened = codec.unpack(data)
                assert opened is not None
                whole = codec.pack(change(opened[0], seq), opened[1])
                db.execute(
                    "UPDATE chunks SET data = ?, crc = ? WHERE seq = ? AND layer = ?",
                    (whole, zlib.crc32(whole), seq, k),
                )
        db.close()

    return apply


def _at(far_m: float, up_m: float = 0.0) -> Callable[[Any, int], Any]:
    """Cameras so far from each other, every other one on the other side."""

    def change(head: Any, seq: int) -> Any:
        T = head.T_world_camera.copy()
        side = 1 - 2 * (seq % 2)
        T[:3, 3] = far_m * side, far_m * seq / 5, T[2, 3] + up_m * side
        return replace(head, T_world_camera=T)

    return change


def _lens(f_px: float, ratio: float = 1.0) -> Callable[[Any, int], Any]:
    K = [[f_px, 0.0, 79.5], [0.0, f_px * ratio, 44.5], [0.0, 0.0, 1.0]]
    return lambda head, _: replace(head, K=np.array(K))


def _depths(low: float, step: float) -> Callable[[Any, int], Any]:
    return lambda head, _: replace(head, inverse_min=low, inverse_step=step)


SPREADS: dict[str, Callable[[Any, int], Any]] = {
    **{f"cameras {far} m apart": _at(far) for far in (1e3, 1e4, 1e5, 9.9e5)},
    **{f"cameras {up} m above each other": _at(5.0, up) for up in (1e3, 1e5, 9.9e5)},
    **{f"lens of {f} px": _lens(f) for f in (1.5, 2.0, 5.0, 20.0, 1e4, 1e5)},
    "lens of 30 x 149 px": _lens(30.0, 4.9),
    **{f"depths from {1 / low:g} m": _depths(low, 1e-9) for low in (1.01e-5, 1e-4, 1.0, 900.0)},
    "depths all over": _depths(1.01e-5, 0.01),
    "one instant": lambda head, _: replace(head, time_unix_ns=7),
    "backward in time": lambda head, seq: replace(head, time_unix_ns=(1 << 62) - seq * 10**18),
}
"""Records that a decoder takes one by one, and that no flight ever brought."""


def _file(name: str, make: Callable[[Path], object]) -> Change:
    def change(folder: Path) -> None:
        path = folder / name
        path.unlink(missing_ok=True)
        make(path)

    return change


def _holds(name: str, data: bytes) -> Change:
    return _file(name, lambda path: path.write_bytes(data))


def _sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.write(b"SQLite format 3\0")
        file.truncate(1 << 40)


def by_file(base: Path) -> Iterator[tuple[str, Change]]:
    """Other files in the place of the database, or next to it."""
    data = (base / "scan.db").read_bytes()
    noise = random.Random(3).randbytes(40_000)
    yield "empty file", _holds("scan.db", b"")
    yield "noise", _holds("scan.db", noise)
    yield "no end", _file("scan.db", lambda p: p.symlink_to("/dev/zero"))
    yield "a pipe", _file("scan.db", os.mkfifo)
    yield "a folder", _file("scan.db", Path.mkdir)
    yield "one terabyte of zeros", _file("scan.db", _sparse)
    other = data[:16] + b"\0\1" + data[18:]
    yield "another page size", _holds("scan.db", other)
    yield "log of noise", _holds("scan.db-wal", noise)
    yield "log is a folder", _file("scan.db-wal", Path.mkdir)
    yield "log without end", _file("scan.db-wal", lambda p: p.symlink_to("/dev/zero"))
    yield "journal of noise", _holds("scan.db-journal", noise)
    for name in ("scan.json", "library.json"):
        for what, text in hostile_json({"format": "skyrelief scan 1", "title": "x", "tags": []}):
            yield f"{name}: {what}", _holds(name, text)
        yield f"{name} without end", _file(name, lambda p: p.symlink_to("/dev/zero"))
        yield f"{name} is a pipe", _file(name, os.mkfifo)
        yield f"{name} elsewhere", _file(name, lambda p: p.symlink_to("/etc/passwd"))
    for name in ("link.tlog", "cloud.laz", "preview.png", "trajectory.csv"):
        yield f"{name} of noise", _holds(name, noise)


def by_meaning() -> Iterator[tuple[str, Change]]:
    """Rows that SQLite finds sound."""
    for what, script in CHUNKS.items():
        yield what, _sql(script)
    for what, spread in SPREADS.items():
        yield what, _spread(spread)
    for what, data in hostile_layers():
        yield what, _chunk(data)
    for k, (what, data) in enumerate(hostile_poses()):
        yield what, _row("poses", 100 + k, 1 << 60, data)
    for what, data in hostile_reposes():
        yield what, _row("reposes", 99, 0, BIG, data)
    for what, text in hostile_headers("test-1"):
        yield f"header: {what}", _meta("header", text)
    for what, text in hostile_json({"keyframes": 3, "points": 9}):
        yield f"summary: {what}", _meta("summary", text)
    for what, text in hostile_json({"figures": {"a": 1}, "before": []}):
        yield f"refinement: {what}", _meta("refinement", text)


def by_bytes(base: Path, seed: int) -> Iterator[tuple[str, Change]]:
    """Bytes of the file changed, without end."""
    rng = random.Random(seed)
    data = (base / "scan.db").read_bytes()
    for number in range(1 << 30):
        rest = data
        for _ in range(rng.choice((1, 3, 20))):  # pages of the schema are few: hit them as often
            at = rng.choice((0, 0, rng.randrange(len(data))))
            size = 4096 if at == 0 else 600
            piece = damaged(rest[at : at + size], rng)
            rest = rest[:at] + piece + rest[at + size :]
        yield f"bytes {number}", _holds("scan.db", rest)


def hostile_stores(base: Path, folder: Path, count: int, seed: int) -> Iterator[tuple[str, Path]]:
    """``count`` mutated copies of the scan folder ``base``: what each is, and where.

    A third each by schema and file, by meaning, by bytes; the same ones for the same seed.
    """
    rng = random.Random(seed)
    schemas = [(what, _sql(script)) for what, script in SCHEMAS.items()]
    classes = [[*schemas, *by_file(base)], list(by_meaning())]
    for some in classes:
        rng.shuffle(some)
    noise = by_bytes(base, seed)
    known = [some[: count // 3] for some in classes]
    rest = count - sum(map(len, known))
    for number, (what, change) in enumerate(chain(*known, (next(noise) for _ in range(rest)))):
        copy = folder / f"scan-{number}"
        shutil.copytree(base, copy)
        try:
            change(copy)
        except sqlite3.Error as error:
            raise AssertionError(f"{what}: {error}") from error
        yield what, copy


def numbered(folder: Path, number: int) -> None:
    """Give the scan in ``folder`` an id of its own, where it still has a sound header."""
    try:
        db = sqlite3.connect(folder / "scan.db")
        (text,) = db.execute("SELECT value FROM meta WHERE key = 'header'").fetchone()
        header = {**json.loads(text), "scan_id": f"scan-{number}"}
        _meta("header", json.dumps(header).encode())(folder)
        db.close()
    except (sqlite3.Error, ValueError, TypeError):
        return
