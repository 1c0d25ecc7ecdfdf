"""Scans imported from a stranger's card."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from portal_client import ONE, Client, client, store

from service.errors import OutsideError
from service.ground.library import ConflictError, Library
from service.ground.storage import check_room, copy_files

if TYPE_CHECKING:
    from house_flight import HouseFlight

__all__ = ["client", "store"]  # the fixtures


@pytest.fixture
def card(tmp_path: Path, house: HouseFlight) -> Path:
    """A stranger's card: a sound scan with traps around it."""
    card = tmp_path / "card"
    house.flown(card).close()
    (card / "scan.json").write_text("{}")
    (card / "report.html").symlink_to("/etc/passwd")
    (card / "cloud.laz").symlink_to("/dev/zero")
    os.mkfifo(card / "preview.jpg")
    (card / "3dtiles").symlink_to("/etc")
    (card / "run.sh").write_text("#!/bin/sh\n")
    (card / "mesh.glb").mkdir()
    return card


def test_an_import_takes_regular_files_of_known_names_only(
    client: Client, store: Path, card: Path
) -> None:
    client.ask(ONE, "DELETE")
    before = sorted(path.name for path in card.iterdir())
    assert client.ask("/api/import", "POST", {"folder": str(card)})[0] == 201
    assert {p.name for p in (store / "drones/drone-1/test-1").iterdir()} == {"scan.db", "scan.json"}
    assert sorted(path.name for path in card.iterdir()) == before
    assert not list(store.glob(".taking-*"))


@pytest.mark.parametrize("what", ["link", "link to a folder", "fifo", "nothing", "junk"])
def test_a_card_without_a_sound_scan_is_refused(
    client: Client, store: Path, card: Path, what: str
) -> None:
    client.ask(ONE, "DELETE")
    folder = card
    if what == "link to a folder":
        folder = card.with_name("linked")
        folder.symlink_to(card)
    else:
        (card / "scan.db").rename(card / "real.db")
    if what == "link":
        (card / "scan.db").symlink_to(card / "real.db")
    elif what == "fifo":
        os.mkfifo(card / "scan.db")
    elif what == "junk":
        (card / "scan.db").write_bytes(b"no database" * 1000)
    status, answer, _ = client.ask("/api/import", "POST", {"folder": str(folder)})
    assert status == 400 and "\n" not in answer["error"] and ".taking" not in answer["error"]
    assert client.ask("/api/scans")[1] == [] and not list(store.glob(".taking-*"))


def test_a_recording_that_is_a_link_or_a_pipe_is_refused(client: Client, tmp_path: Path) -> None:
    (tmp_path / "a.mcap").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "b.mcap")
    for name in ("a.mcap", "b.mcap"):
        status, answer, _ = client.ask("/api/import", "POST", {"folder": str(tmp_path / name)})
        assert status == 400 and name in answer["error"]


def test_an_import_fits_the_room_or_is_refused(tmp_path: Path, card: Path) -> None:
    names = ("scan.db", "cloud.ply")
    with open(card / "cloud.ply", "wb") as file:
        file.truncate(10**12)  # a sparse file costs its maker nothing
    out = tmp_path / "out"
    out.mkdir()
    with pytest.raises(OutsideError, match="room for"):
        copy_files(card, out, names)
    assert not list(out.iterdir())
    (card / "cloud.ply").unlink()
    size = (card / "scan.db").stat().st_size
    with pytest.raises(OutsideError, match="room for"):
        check_room(size, out, size - 1)
    check_room(size, out, size)
    assert copy_files(card, out, names) == {"scan.db"}


def test_an_import_holds_no_lock_of_the_library(
    store: Path, card: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    library = Library(store)
    library.delete("drone-1", "test-1")
    begun, go_on = threading.Event(), threading.Event()

    def slow(source: Path, target: Path, names: Iterable[str]) -> set[str]:
        begun.set()
        assert go_on.wait(60)
        return copy_files(source, target, names)

    def bring_in() -> None:
        with library.importing():
            library.take(card)

    monkeypatch.setattr("service.ground.library.copy_files", slow)
    importing = threading.Thread(target=bring_in)
    importing.start()
    try:
        assert begun.wait(60)
        with pytest.raises(ConflictError, match="another import"):
            bring_in()
        name = library.bin()[0]
        library.restore(name)
        library.label("drone-1", "test-1", "meanwhile", None, None)
        library.delete("drone-1", "test-1")
    finally:
        go_on.set()
        importing.join()
    assert [e["scan"] for e in library.scans()] == ["test-1"]


def test_what_a_killed_import_left_goes_at_the_next_start(store: Path) -> None:
    (store / ".taking-x").mkdir()
    (store / ".taking-x/scan.db").write_bytes(b"half")
    Library(store)
    assert not (store / ".taking-x").exists()
