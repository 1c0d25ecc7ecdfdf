"""Scan databases from a stranger's card: refused or survived, never endless, never a traceback."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
from file_modes import bound_by_modes
from house_flight import HouseFlight

from service.errors import InputError, OutsideError
from service.stream import database as database_module
from service.stream.database import Database
from service.stream.records import ScanHeader
from service.stream.store import ScanStore, header_of

HEADER = ScanHeader("scan-1", "red", 1)
ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"


@pytest.fixture
def path(tmp_path: Path, house: HouseFlight) -> Path:
    """A sound store of five keyframes."""
    with house.flown(tmp_path) as store:
        store.finish({"points": 1})
    return tmp_path / "scan.db"


def changed(path: Path, *statements: str) -> None:
    db = sqlite3.connect(path)
    for sql in statements:
        db.execute(sql)
    db.commit()
    db.close()


@pytest.mark.parametrize("statements", [
    ("ALTER TABLE chunks RENAME TO kept", "CREATE VIEW chunks AS SELECT * FROM kept"),
    ("DROP TABLE poses", f"CREATE VIEW poses AS {ENDLESS} SELECT i AS id, i AS time_unix_ns, "
     "zeroblob(900000000) AS data FROM n"),
    ("CREATE TRIGGER more AFTER INSERT ON poses BEGIN DELETE FROM chunks; END",),
    ("CREATE INDEX odd ON poses (abs(time_unix_ns))",),
    ("CREATE TABLE more (x)",),
    ("DROP TABLE poses", "CREATE TABLE poses (id INTEGER PRIMARY KEY, time_unix_ns INTEGER NOT "
     "NULL, data BLOB AS (zeroblob(900000000)))"),
    ("DROP TABLE held", "CREATE TABLE held (peer TEXT CHECK (abs(1) > 0))"),
    ("DROP TABLE held", "CREATE VIRTUAL TABLE held USING fts5(peer, kind, ranges)"),
])  # fmt: skip
def test_a_schema_that_is_not_ours_is_refused(path: Path, statements: tuple[str, ...]) -> None:
    changed(path, *statements)
    for read_only in (False, True):
        with pytest.raises(InputError, match="is not a scan database"):
            ScanStore.open(path, read_only=read_only)
    assert header_of(path) is None


def test_an_endless_view_does_not_hang_the_command(path: Path, tmp_path: Path) -> None:
    """On a process of its own: without the check it never ends."""
    view = (
        f"CREATE VIEW chunks AS {ENDLESS} SELECT i AS seq, 0 AS layer, 1 AS layers, 0 AS "
        "time_unix_ns, 0 AS crc, 0 AS stored_unix_ns, zeroblob(100000000) AS data FROM n"
    )
    changed(path, "DROP TABLE chunks", view)
    command = [sys.executable, "-m", "service.cli", "inspect", str(tmp_path)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert ended.returncode == 2 and ended.stderr.count("\n") == 1
    assert "foreign view" in ended.stderr


def test_a_newer_schema_asks_for_an_update(path: Path) -> None:
    changed(path, "CREATE TABLE more (x)", "UPDATE meta SET value = '2' WHERE key = 'schema'")
    with pytest.raises(InputError, match="update skyrelief"):
        ScanStore.open(path)


def test_a_statement_has_a_deadline(path: Path) -> None:
    database = Database(path, read_only=True, statement_s=-1.0)
    with pytest.raises(OutsideError, match="interrupted"):
        database.all(f"{ENDLESS} SELECT COUNT(*) FROM n")
    assert database.one("SELECT COUNT(*) FROM poses") == (5,)  # short ones are let through
    database.close()


def test_values_of_another_kind_are_passed_over(path: Path, house: HouseFlight) -> None:
    changed(
        path,
        "UPDATE chunks SET data = 900000000000 WHERE seq = 0",
        "UPDATE chunks SET data = 'text' WHERE seq = 1",
        "UPDATE chunks SET data = zeroblob(20000000) WHERE seq = 2",
        "UPDATE chunks SET layer = 'x' WHERE seq = 3 AND layer = 1",
        "UPDATE chunks SET seq = -7 WHERE seq = 4",
        "INSERT INTO chunks VALUES (1e18, 9, 1, 0, 0, 0, x'00')",
        "INSERT INTO chunks VALUES (99999999999, 0, 1, 0, 0, 0, x'00')",
        "INSERT INTO chunks VALUES (7, 77, 1, 0, 0, 0, x'00')",
        "INSERT INTO poses VALUES (-5, 'x', 123456789012)",
        "INSERT INTO poses VALUES (99999999999, 0, 'x')",
        "INSERT INTO reposes VALUES (1, 'x', x'00', 5)",
        "INSERT INTO reposes VALUES (-1, 3, 1, x'00')",
        "INSERT INTO radio VALUES ('tile', 'x', 0, 12345678901)",
        "INSERT INTO radio VALUES ('pose', 1, 0, 12345678901)",
        "INSERT INTO held VALUES ('p', 'k0', '[[0,')",
        "INSERT INTO held VALUES ('p', 'k1', '[[5, 1]]')",
        "INSERT INTO meta VALUES ('refinement', '[]')",
    )
    with ScanStore.open(path) as store:
        assert [k.seq for k in store.keyframes()] == [3]  # its coarse layer
        assert len(list(store.poses())) == 5
        assert store.held() == {} and store.refinement is None
        assert store.seqs()[-1] == 3  # no layer has the number 77
        assert store.add_pose(house.record(9, 1.0)) == 6
        assert all(store.record("pose", n) is not None for n in range(1, 7))


def test_a_keyframe_under_another_number_is_not_shown(path: Path) -> None:
    changed(path, "DELETE FROM chunks WHERE seq = 1", "UPDATE chunks SET seq = 1 WHERE seq = 0")
    with ScanStore.open(path) as store:
        assert store.keyframe(1) is None


def test_a_scan_on_a_disk_that_cannot_be_written_is_read(path: Path) -> None:
    def read() -> None:
        with ScanStore.open(path) as store:
            assert len(list(store.keyframes())) == 5 and store.finished
            with pytest.raises(OutsideError, match="readonly"):
                store.finish({})

    before = path.read_bytes()
    path.chmod(0o400)
    path.parent.chmod(0o500)
    try:
        bound_by_modes(read)
    finally:
        path.parent.chmod(0o700)
    assert path.read_bytes() == before


def test_a_disk_that_refuses_is_not_called_a_wrong_file(path: Path) -> None:
    for text in ("attempt to write a readonly database", "unable to open database file"):
        error = database_module.as_error(path, sqlite3.OperationalError(text))
        assert isinstance(error, OutsideError) and "not a scan database" not in str(error)
    wrong = database_module.as_error(path, sqlite3.DatabaseError("file is not a database"))
    assert isinstance(wrong, InputError) and "not a scan database" in str(wrong)
