"""The mesh of a scan that has ended is made unasked, once no scan grows."""

from __future__ import annotations

import os
import shutil
import threading
import time
import zipfile
from pathlib import Path
from typing import Any

import pytest
from command_line import skyrelief
from house_flight import HouseFlight
from loopback import until
from portal_client import TOKEN, flown_store

from service.ground.due import MESH
from service.ground.library import Library
from service.ground.portal import Portal, PortalConfig
from service.ground.scan_facts import is_current
from service.ground.upload import unpack
from service.scans.folder import write_deliverables
from service.stream.store import ScanStore

pytest.importorskip("open3d", exc_type=ImportError)


@pytest.fixture
def folder(tmp_path: Path, house: HouseFlight) -> Path:
    """A finished scan in a library."""
    folder = flown_store(tmp_path / "scans", house) / "drone-1/test-1"
    with ScanStore.open(folder / "scan.db") as store:
        store.finish({})
        write_deliverables(folder, store)
    return folder


def portal_of(folder: Path, growing: list[dict[str, Any]], **options: Any) -> Portal:
    config = PortalConfig(folder.parents[1], port=0, token=TOKEN, **options)
    return Portal(config, lambda: growing)


@pytest.mark.slow
def test_a_scan_that_has_ended_gets_its_mesh_when_no_other_grows(folder: Path) -> None:
    other = {"drone": "drone-2", "scan": "b", "finished": False, "heard_unix_s": time.time() + 60}
    growing = [other]
    portal = portal_of(folder, growing, meshes=True)
    try:
        portal.ended(folder)
        portal.ended(folder)
        time.sleep(1.2)
        assert portal.jobs.of(folder)[0]["state"] == "waiting"
        growing.clear()
        assert until(lambda: portal.jobs.of(folder)[0]["state"] != "waiting", 10)
        assert until(lambda: not portal.jobs.busy(folder), 60)
        (job,) = portal.jobs.of(folder)
        assert (job["state"], job["file"]) == ("done", "mesh.glb")
        assert portal.state.library.entry("drone-1", "test-1")["meshed"]
        portal.ended(folder)  # it has one
        assert len(portal.jobs.of(folder)) == 1
        later = time.time() + 5
        os.utime(folder / "scan.json", (later, later))  # the scan has changed
        assert not portal.state.library.entry("drone-1", "test-1")["meshed"]
        growing.append(other)
        portal.ended(folder)
        assert [job["state"] for job in portal.jobs.of(folder)] == ["done", "waiting"]
    finally:
        portal.close()


def test_nothing_is_made_where_nobody_wants_it_or_it_does_not_fit(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = portal_of(folder, [])
    plain.ended(folder)
    assert not plain.jobs.of(folder)
    portal = portal_of(folder, [], meshes=True)
    for name, value in (
        ("MAX_POINTS", 10),
        ("BASE_BYTES", 1 << 50),
        ("obstacle", lambda *_: "needs the package open3d"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(f"service.ground.meshing.{name}", value)
            portal.ended(folder)
        assert not portal.jobs.of(folder)
    monkeypatch.setattr("shutil.disk_usage", lambda _: FullDisk())
    portal.ended(folder)
    assert not portal.jobs.of(folder)


@pytest.mark.slow
def test_meshes_that_did_not_fit_or_were_cut_off_are_made_later(
    folder: Path, tmp_path: Path, house: HouseFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the next portal, or once another has ended; also of scans that ended before a portal."""
    growing = [{"drone": "drone-2", "scan": "b", "finished": False, "heard_unix_s": 1e12}]
    monkeypatch.setattr("service.ground.state.MAX_WAITING_JOBS", 1)
    other = folder.with_name("test-0")
    shutil.copytree(folder, other)
    first = portal_of(folder, growing, meshes=True)
    for one in (folder, other):
        first.ended(one)
    assert len(first.jobs.listed()) == 1
    first.close()
    MESH.begin(folder)  # as by a kill
    second = portal_of(folder, growing, meshes=True)
    try:
        second.start()
        assert [job["state"] for job in second.jobs.of(folder)] == ["waiting"]
        assert not second.jobs.of(other)
        second.jobs.cancel(second.jobs.of(folder)[0]["number"])  # by a person: it is not wanted
        assert [job["state"] for job in second.jobs.of(other)] == ["waiting"]
        growing.clear()
        assert until(lambda: second.jobs.of(other)[0]["state"] == "done", 60)
        assert until(lambda: not MESH.folders(tmp_path / "scans"))
        assert not (folder / "mesh.glb").exists()
    finally:
        second.close()


@pytest.mark.slow
def test_a_scan_that_ended_without_a_portal_gets_its_mesh_by_a_later_one(
    folder: Path, tmp_path: Path
) -> None:
    pytest.importorskip("zenoh")
    for options, due in (
        ("--no-meshes", []),
        ("--meshes", [tmp_path / "kept/drones/drone-1/test-1"]),
    ):
        store = tmp_path / ("kept" if due else "none")
        ended = skyrelief(
            "ground", "--listen", "tcp/127.0.0.1:0", "--store", store, "--no-sites", options,
            "--take", folder, "--idle-exit-s", "0",
        )  # fmt: skip
        assert ended.returncode == 0, ended.stderr
        assert MESH.folders(store) == due


def test_a_mesh_stays_that_of_its_scan_when_it_is_imported(folder: Path, tmp_path: Path) -> None:
    for name, age_s in (("scan.json", 60), ("mesh.glb", 20)):
        (folder / name).touch()
        then = time.time() - age_s
        os.utime(folder / name, (then, then))
    copied = Library(tmp_path / "copied")
    assert copied.entry(*copied.take(folder))["meshed"]
    with zipfile.ZipFile(tmp_path / "scan.zip", "w") as archive:
        for name in ("mesh.glb", "scan.json", "scan.db"):
            archive.write(folder / name, name)
    (tmp_path / "unpacked").mkdir()
    unpack(tmp_path / "scan.zip", tmp_path / "unpacked")
    assert is_current(tmp_path / "unpacked/mesh.glb")
    os.utime(folder / "mesh.glb", (0, 0))
    older = Library(tmp_path / "older")
    assert not older.entry(*older.take(folder))["meshed"]


def test_a_mesh_that_is_deleted_while_the_library_is_read_is_none(tmp_path: Path) -> None:
    mesh, ended = tmp_path / "mesh.glb", threading.Event()
    (tmp_path / "scan.json").touch()
    assert not is_current(mesh)

    def come_and_go() -> None:
        while not ended.is_set():
            mesh.touch()
            mesh.unlink()

    coming = threading.Thread(target=come_and_go)
    coming.start()
    try:
        assert {is_current(mesh) for _ in range(2000)} <= {True, False}
    finally:
        ended.set()
        coming.join()
    (tmp_path / "other.glb").touch()
    mesh.symlink_to("other.glb")
    assert not is_current(mesh)


class FullDisk:
    free, total = 1000, 10**12
