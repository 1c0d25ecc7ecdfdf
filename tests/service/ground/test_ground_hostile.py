"""One peer of the ground station misbehaves; the others' scans arrive whole."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loopback import free_port, until
from paths import ROOT

from service.config import DatalinkConfig
from service.ground.drone import Answered, DroneReceiver, Item, ReceivedScan
from service.ground.receiver import (
    MAX_HEADS,
    MAX_ITEM_BYTES,
    MAX_ITEMS,
    DroneMailbox,
    Receiver,
    ReceiverConfig,
)
from service.ground.storage import DroneLimits
from service.stream.link import DatalinkSender
from service.stream.messages import split
from service.stream.records import PoseRecord, ScanHeader
from service.stream.session import SessionConfig, open_session
from service.stream.store import ScanStore
from service.workers import Workers

zenoh = pytest.importorskip("zenoh")

WHOLE = os.environ.get("SKYRELIEF_TRIALS") == "whole"


@contextlib.contextmanager
def serving(
    folder: Path,
    limits: DroneLimits | None = None,
    deliver: Callable[[Path], None] = lambda _: None,
    opened: Callable[[ReceivedScan], None] = lambda _: None,
    workers: Workers | None = None,
    ended: Callable[[Path], None] = lambda _: None,
) -> Iterator[tuple[Receiver, str]]:
    """A ground station and where it listens."""
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    session = SessionConfig(mode="router", listen=(endpoint,))
    config = ReceiverConfig(folder, session, limits or DroneLimits(), "base")
    ground = Receiver(config, workers, deliver, opened, ended)
    ground.start()
    try:
        yield ground, endpoint
    finally:
        ground.close()


@contextlib.contextmanager
def hostile(endpoint: str) -> Iterator[Any]:
    """A session of a peer that puts what it likes."""
    session = open_session(SessionConfig(connect=(endpoint,)))
    try:
        yield session
    finally:
        session.close()


def scan_of(folder: Path, drone: str, scan_id: str = "scan-1", poses: int = 20) -> ScanStore:
    store = ScanStore.create(folder / f"{drone}-{scan_id}.db", ScanHeader(scan_id, drone, 1))
    for k in range(poses):
        store.add_pose(PoseRecord(k, np.eye(4), np.eye(6)))
    store.finish({"points": 1})
    return store


def arrives(folder: Path, endpoint: str, drone: str = "honest") -> bool:
    """Whether a scan of a drone that behaves is received whole."""
    store = scan_of(folder, drone)
    link = DatalinkSender(store, DatalinkConfig(connect=(endpoint,), budget_kbit_s=50_000.0))
    try:
        return link.drain(20.0)
    finally:
        link.close()
        store.close()


def head(kind: str, first: int, last: int) -> bytes:
    document = {"v": 1, "numbers": {kind: [[first, last]]}, "live": {}, "finished": False}
    return json.dumps(document).encode()


def introduce(session: Any, drone: str, scan_id: str) -> None:
    """Put the head of a scan with a valid header, and the header."""
    record = ScanHeader(scan_id, drone, 1).to_json()
    number = zlib.crc32(record)
    session.put(f"skyrelief/{drone}/{scan_id}/head", head("header", number, number))
    (part,) = split("header", number, record, 1 << 16)
    session.put(f"skyrelief/{drone}/{scan_id}/item/header/{number}", part.pack())


@pytest.mark.parametrize("last", [(1 << 32) - 1, (1 << 24) - 1])
def test_a_head_that_names_billions_stops_nothing(tmp_path: Path, last: int) -> None:
    with serving(tmp_path / "ground") as (ground, endpoint), hostile(endpoint) as session:
        for scan_id in ("a", "b"):
            until(partial(_introduced, ground, session, "evil", scan_id))
            for kind in ("k0", "k1", "k2", "pose"):
                session.put(f"skyrelief/evil/{scan_id}/head", head(kind, 0, last))
        assert arrives(tmp_path, endpoint)


def _introduced(ground: Receiver, session: Any, drone: str, scan_id: str) -> bool:
    introduce(session, drone, scan_id)
    places = [(entry["drone"], entry["scan"]) for entry in ground.progress()]
    return (drone, scan_id) in places


def test_a_fault_of_ours_in_one_drones_work_is_reported_and_stops_no_other(tmp_path: Path) -> None:
    def fails(scan: ReceivedScan) -> None:
        if scan.drone == "evil":
            raise UnicodeDecodeError("utf-16", b"", 0, 1, "made up")

    with (
        serving(tmp_path / "ground", opened=fails) as (ground, endpoint),
        hostile(endpoint) as session,
    ):

        def failed() -> bool:
            introduce(session, "evil", "scan-1")
            report = ground.workers.report()
            return any(w["name"] == "drone evil" and w["restarts"] for w in report)

        assert until(failed)
        assert arrives(tmp_path, endpoint)
        assert not ground.workers.failed


@pytest.mark.slow
def test_a_drone_that_answers_no_request_gets_few_threads(tmp_path: Path) -> None:
    """It names ever new scans, for whose headers it is asked."""
    kept: list[Any] = []
    names = itertools.count()

    with (
        serving(tmp_path / "ground", DroneLimits(requests=20)) as (ground, endpoint),
        hostile(endpoint) as session,
    ):
        queryable = session.declare_queryable("skyrelief/evil/**", kept.append)

        def is_full() -> bool:
            for _ in range(20):
                session.put(f"skyrelief/evil/scan-{next(names)}/head", head("header", 1, 1))
            names_now = [one["name"] for one in ground.workers.report()]
            most.append(sum(name.startswith("messages ") for name in names_now))
            return next(names) > 2000

        most: list[int] = []
        assert until(is_full)
        assert 10 < max(most) <= 2 + 20  # two take what is not asked for
        assert arrives(tmp_path, endpoint)
        assert not ground.workers.failed
        queryable.undeclare()


def test_what_takes_items_no_more_is_told_whatever_is_asked_afterwards(tmp_path: Path) -> None:
    with (
        serving(tmp_path, workers=Workers(max_restarts=0)) as (ground, endpoint),
        hostile(endpoint) as session,
    ):
        assert until(lambda: _introduced(ground, session, "red", "scan-1"))
        take = ground._take

        def fails(key: str, payload: bytes) -> None:
            if "/item/" in key:
                raise KeyError("made up")
            take(key, payload)

        ground._take = fails  # type: ignore[method-assign]

        def failed() -> bool:
            introduce(session, "red", "scan-1")
            return bool(ground.workers.failed)

        assert until(failed)
        asked: list[Any] = []
        queryable = session.declare_queryable("skyrelief/red/**", asked.append)
        session.put("skyrelief/red/scan-2/head", head("header", 1, 1))
        assert until(lambda: asked)
        assert [worker.name for worker in ground.workers.failed] == ["messages item/*/*"]
        queryable.undeclare()


def test_the_files_of_a_drone_whose_worker_has_failed_are_written_at_the_end(
    tmp_path: Path,
) -> None:
    written: list[Path] = []

    def fails(_: ReceivedScan) -> None:
        raise KeyError("made up")

    with (
        serving(tmp_path, None, written.append, fails, Workers(max_restarts=0)) as (
            ground,
            endpoint,
        ),
        hostile(endpoint) as session,
    ):

        def failed() -> bool:
            introduce(session, "evil", "scan-1")
            return any(worker.has_failed for worker in ground.workers.table())

        assert until(failed)
    assert tmp_path / "drones" / "evil" / "scan-1" in written


def test_deliverables_that_fail_are_said_and_stop_no_others(tmp_path: Path) -> None:
    written = []

    def deliver(folder: Path) -> None:
        if folder.parent.name == "evil":
            raise KeyError("made up")
        written.append(folder.parent.name)

    with serving(tmp_path / "ground", deliver=deliver) as (ground, endpoint):
        assert arrives(tmp_path, endpoint, "evil")
        entry = until(lambda: next((e for e in ground.progress() if e["trouble"]), None))
        assert entry["drone"] == "evil" and "KeyError" in entry["trouble"]
        assert arrives(tmp_path, endpoint)
        assert until(lambda: written == ["honest"])


def test_a_fault_in_what_follows_the_end_of_a_scan_stops_nothing(tmp_path: Path) -> None:
    """Its alignment and its mesh."""
    ends = list[str]()

    def ended(folder: Path) -> None:
        ends.append(folder.parent.name)
        if folder.parent.name == "evil":
            raise RuntimeError("can't start new thread")

    with serving(tmp_path / "ground", ended=ended) as (ground, endpoint):
        for drone in ("evil", "honest"):
            assert arrives(tmp_path, endpoint, drone)
            assert until(lambda: drone in ends)  # noqa: B023
        (writer,) = [w for w in ground.workers.report() if w["name"] == "deliverables"]
        assert ends == ["evil", "honest"] and not writer["restarts"]


def test_junk_makes_no_folder(tmp_path: Path) -> None:
    store = tmp_path / "ground"
    record = ScanHeader("other", "evil", 1).to_json()
    number = zlib.crc32(record)
    (foreign,) = split("header", number, record, 1 << 16)
    broken = split("header", 7, b'{"scan_id":', 1 << 16)[0]
    with serving(store) as (ground, endpoint), hostile(endpoint) as session:
        base = "skyrelief/evil"
        session.put(f"{base}/items-only/item/k0/1", split("k0", 1, b"junk", 100)[0].pack())
        session.put(f"{base}/headless/item/header/{number}", foreign.pack())
        session.put(f"{base}/foreign/head", head("header", number, number))
        session.put(f"{base}/foreign/item/header/{number}", foreign.pack())
        session.put(f"{base}/broken/head", head("header", 7, 7))
        session.put(f"{base}/broken/item/header/7", broken.pack())
        session.put(f"{base}/../item/k0/1", b"SK")
        assert until(lambda: _introduced(ground, session, "evil", "valid"))
        assert arrives(tmp_path, endpoint)
        names = sorted(path.parent.name for path in store.glob("drones/*/*/scan.db"))
        folders = sorted(path.name for path in store.glob("drones/*/*") if path.is_dir())
        assert names == folders == ["scan-1", "valid"]
        assert ground.dropped >= 2


def test_scans_are_open_only_while_they_are_used(tmp_path: Path) -> None:
    most = 0
    with serving(tmp_path / "ground", DroneLimits(open_scans=3)) as (ground, endpoint):
        stores = [scan_of(tmp_path, "red", f"scan-{k}") for k in range(10)]
        config = DatalinkConfig(connect=(endpoint,), budget_kbit_s=50_000.0)
        link = DatalinkSender(None, config, "red")
        for store in stores:
            link.add(store)

        def all_whole() -> bool:
            nonlocal most
            entries = ground.progress()
            most = max(most, sum(entry["open"] for entry in entries))
            return [entry["complete"] for entry in entries] == [True] * len(stores)

        try:
            assert until(all_whole, 60.0)
        finally:
            link.close()
            for store in stores:
                store.close()
        held = [os.readlink(f"/proc/self/fd/{fd}") for fd in _descriptors()]
    assert most == 3
    assert sum("/ground/red/" in path for path in held) <= 3 * 3
    for k in range(10):
        with ScanStore.open(
            tmp_path / "ground" / "drones" / "red" / f"scan-{k}" / "scan.db"
        ) as received:
            assert received.finished and len(list(received.poses())) == 20


def _descriptors() -> list[str]:
    out = []
    for name in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):
            os.readlink(f"/proc/self/fd/{name}")
            out.append(name)
    return out


def test_a_drone_over_its_share_of_the_disk_is_refused_and_another_is_not(tmp_path: Path) -> None:
    total = os.statvfs(tmp_path).f_blocks * os.statvfs(tmp_path).f_frsize
    store = tmp_path / "ground"
    (store / "drones" / "greedy" / "earlier").mkdir(parents=True)
    with (store / "drones" / "greedy" / "earlier" / "cloud.laz").open("wb") as file:
        file.truncate(2_000_000)
    limits = DroneLimits(None, 2_000_000 / total, 0, full_disk_rest_s=0.5)
    greedy = scan_of(tmp_path, "greedy")
    with serving(store, limits) as (ground, endpoint):
        config = DatalinkConfig(connect=(endpoint,), budget_kbit_s=50_000.0)
        link = DatalinkSender(greedy, config)
        try:
            assert arrives(tmp_path, endpoint)
            assert not link.progress.complete
            assert not (store / "drones" / "greedy" / "scan-1").exists()
            (store / "drones" / "greedy" / "earlier" / "cloud.laz").unlink()
        finally:
            link.close()
            greedy.close()
        assert {entry["drone"] for entry in ground.progress()} == {"honest"}


def test_poses_stop_at_the_reserve_and_go_on_when_there_is_room(tmp_path: Path) -> None:
    """Poses and coarse layers count too, and a scan in the making says why it does not grow."""
    free = [1_000_000]
    limits = DroneLimits(full_disk_rest_s=0.3, look_s=0.0, usage=lambda _: (10_000_000, 0, free[0]))
    onboard = ScanStore.create(tmp_path / "a.db", ScanHeader("scan-1", "red", 1))
    with serving(tmp_path / "ground", limits) as (ground, endpoint):
        config = DatalinkConfig(connect=(endpoint,), budget_kbit_s=50_000.0)
        link = DatalinkSender(onboard, config)
        try:
            assert until(lambda: any(entry["held"] for entry in ground.progress()))
            free[0] = 400_000  # the reserve is 5 % of the disk
            onboard.add_pose(PoseRecord(1, np.eye(4), np.eye(6)))
            trouble = until(lambda: ground.progress()[0]["trouble"])
            assert "reserve" in trouble and "pose" not in ground.progress()[0]["held"]
            free[0] = 1_000_000
            assert link.drain(20.0)
            assert until(lambda: ground.progress()[0]["held"].get("pose") == 1)
            assert ground.progress()[0]["trouble"] is None
        finally:
            link.close()
            onboard.close()


def test_a_scan_that_is_deleted_while_it_comes_in_is_received_anew(tmp_path: Path) -> None:
    onboard = ScanStore.create(tmp_path / "a.db", ScanHeader("scan-1", "red", 1))
    place = tmp_path / "ground" / "drones" / "red" / "scan-1"
    with serving(tmp_path / "ground") as (ground, endpoint):
        link = DatalinkSender(onboard, DatalinkConfig(connect=(endpoint,), budget_kbit_s=50_000.0))
        try:
            onboard.add_pose(PoseRecord(1, np.eye(4), np.eye(6)))
            until(lambda: any("pose" in entry["held"] for entry in ground.progress()))
            shutil.rmtree(place)
            onboard.add_pose(PoseRecord(2, np.eye(4), np.eye(6)))
            assert until(lambda: place.exists() and link.drain(0.1))
            with ScanStore.open(place / "scan.db", read_only=True) as received:
                assert [pose.time_unix_ns for pose in received.poses()] == [1, 2]
        finally:
            link.close()
            onboard.close()


def test_an_inbox_holds_no_more_than_its_bounds(tmp_path: Path) -> None:
    inbox = DroneMailbox(DroneReceiver("red", tmp_path, "base", DroneLimits(), 0.0))
    for k in range(MAX_HEADS):
        inbox.put_head(f"scan-{k}", b"first")
    assert inbox.dropped == 0
    inbox.put_head("one-more", b"")
    inbox.put_head("scan-0", b"second")
    inbox.put(Item("scan-0", bytes(MAX_ITEM_BYTES - 1000)))
    assert inbox.dropped == 1
    inbox.put(Item("scan-0", bytes(1000)))
    inbox.put(Answered("scan-0", 0, 1))  # of our own: always
    assert inbox.dropped == 2
    heads, events = inbox.take(0.0)
    assert heads["scan-0"] == b"second" and len(heads) == MAX_HEADS
    assert [type(event) for event in events] == [Item, Answered]
    for _ in range(2 * MAX_ITEMS):
        inbox.put(Item("scan-0", b""))
    assert len(inbox.take(0.0)[1]) == MAX_ITEMS and inbox.dropped == 2 + MAX_ITEMS


def test_many_drones_share_the_station_and_one_more_is_refused(tmp_path: Path) -> None:
    with (
        serving(tmp_path / "ground", DroneLimits(drones=3)) as (ground, endpoint),
        hostile(endpoint) as session,
    ):
        for name in ("a", "b", "c"):
            assert until(partial(_introduced, ground, session, name, "scan-1"))
        for k in range(50):
            introduce(session, f"invented-{k}", "scan-1")
        assert until(lambda: ground.dropped >= 50)
        assert {entry["drone"] for entry in ground.progress()} == {"a", "b", "c"}
        assert not list((tmp_path / "ground").glob("invented-*"))


def test_a_silent_drone_that_brought_min_makes_way_for_another(tmp_path: Path) -> None:
    """Invented drones with a scan each fill the table; who comes later is received all the same."""
    limits = DroneLimits(drones=3, silent_s=0.5, refresh_s=0.2)
    station = serving(tmp_path / "ground", limits)
    with station as (ground, endpoint), hostile(endpoint) as session:
        for name in ("ghost-1", "ghost-2"):
            assert until(partial(_introduced, ground, session, name, "scan-1"))
        assert arrives(tmp_path, endpoint, "first")
        assert arrives(tmp_path, endpoint, "late")
        assert "drone late" in {worker["name"] for worker in _running(ground)}
        assert len({entry["drone"] for entry in ground.progress()}) == 4


@pytest.mark.slow
def test_a_silent_drone_has_no_worker_and_its_scans_stay_listed(tmp_path: Path) -> None:
    written: list[str] = []
    limits = DroneLimits(silent_s=0.5, close_whole_s=0.0)

    def deliver(folder: Path) -> None:
        written.append(folder.name)

    with serving(tmp_path / "ground", limits, deliver=deliver) as (ground, endpoint):
        for scan_id in ("first", "second"):
            store = scan_of(tmp_path, "red", scan_id)
            link = DatalinkSender(store, DatalinkConfig(connect=(endpoint,)))
            assert link.drain(20.0)
            until(lambda: all(entry["complete"] for entry in ground.progress()))
            link.close()
            store.close()
            until(lambda: not any(w["name"] == "drone red" for w in _running(ground)))
        entries = ground.progress()
        assert [(entry["scan"], entry["open"]) for entry in entries] == [
            ("first", False),
            ("second", False),
        ]
        assert written == ["first", "second"]


def _running(ground: Receiver) -> list[dict[str, object]]:
    return [worker for worker in ground.workers.report() if worker["state"] == "running"]


@pytest.mark.timeout(3600 if WHOLE else 300)
@pytest.mark.slow
def test_ground_ends_with_zero_each_time(tmp_path: Path) -> None:
    """Threads of the session that outlive the interpreter abort the process."""
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    command = [sys.executable, "-m", "service.cli", "ground", "--listen", endpoint]
    command += ["--store", str(tmp_path / "ground")]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    for k in range(50 if WHOLE else 5):
        with subprocess.Popen(
            command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, env=environment, text=True
        ) as process:
            assert process.stderr is not None
            assert "ground station at" in process.stderr.readline()
            process.send_signal(signal.SIGINT if k % 2 else signal.SIGTERM)
            assert process.wait(60) == 0, process.stderr.read()
