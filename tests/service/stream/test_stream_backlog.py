"""Earlier scans that the ground lacks are found after a crash and sent between flights."""

from __future__ import annotations

import dataclasses
import socket
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from loopback import until
from onboard import HeardVehicle
from rehearsal import RehearsalControl

from mavlink.component.control import NoScans
from mavlink.component.vehicle import VehicleConfig, VehicleLink
from service.config import Config
from service.daemon.datalink import DaemonLink, open_backlog
from service.ground.receiver import Receiver, ReceiverConfig
from service.stream.link import DatalinkSender, LinkProgress
from service.stream.records import PoseRecord, ScanHeader
from service.stream.reports import delivered, open_undelivered
from service.stream.session import SessionConfig
from service.stream.store import ScanStore
from service.workers import running

pytest.importorskip("zenoh")


def make_scan(scans: Path, name: str, finished: bool = True, held: bool = False) -> None:
    with ScanStore.create(scans / name / "scan.db", ScanHeader(name, "red", 1)) as store:
        for k in range(5):
            store.add_pose(PoseRecord(k, np.eye(4), np.eye(6)))
        if finished:
            store.finish({"points": 1})
        if held:
            store.set_held("base", store.numbers())


class FakeSender:
    """A sender to a ground station that fetches one item a look, unless it is silent."""

    def __init__(self, lacking: int, listened: bool = True) -> None:
        self.lacking, self.listened, self.closed = lacking, listened, False

    @property
    def progress(self) -> LinkProgress:
        return LinkProgress(True, self.listened, 9, {"k1": self.lacking} if self.lacking else {})

    def drain(self, _: float) -> bool:
        self.lacking -= self.listened
        return not self.lacking

    def close(self) -> None:
        self.closed = True


@pytest.mark.parametrize(
    ("sender", "left"), [(FakeSender(3), 0), (FakeSender(3, False), 3), (FakeSender(10**9), None)]
)
def test_at_the_end_the_ground_gets_the_rest_or_what_it_lacks_is_said(
    sender: FakeSender, left: int | None, caplog: pytest.LogCaptureFixture
) -> None:
    datalink = dataclasses.replace(Config().datalink, connect=("tcp/10.0.0.1:1",), drain_s=0.05)
    link = DaemonLink()
    link.sender = cast(DatalinkSender, sender)
    link.end_scan(dataclasses.replace(Config(), datalink=datalink), is_last=True)
    assert sender.closed and left in (None, sender.lacking)
    said = f"the ground lacks {sender.lacking} items; the next start sends them"
    assert [r.message for r in caplog.records] == ([said] if sender.lacking else [])


@pytest.mark.parametrize("drone", ["red", "r" * 60])
def test_a_datalink_that_cannot_be_used_stops_no_scan(tmp_path: Path, drone: str) -> None:
    """Its certificates are not there; the names are too long for the radio."""
    vehicle = HeardVehicle(VehicleConfig(), NoScans())
    connect = ("tls/10.0.0.1:7447",) if drone == "red" else ("tcp/127.0.0.1:1",)
    config = dataclasses.replace(Config().datalink, connect=connect, radio="mavlink")
    header = ScanHeader("one", drone, 1, run_id="0" * 32)
    with ScanStore.create(tmp_path / "scan.db", header) as store:
        link = DaemonLink()
        link.begin_scan(store, dataclasses.replace(Config(), datalink=config), vehicle)
        assert link.sender is None and vehicle.said[0].startswith("Scan is only stored: ")
        assert not [w for w in running() if w["name"].startswith(("datalink", "radio"))]


def test_only_what_was_not_delivered_is_offered(tmp_path: Path) -> None:
    make_scan(tmp_path, "done", held=True)
    make_scan(tmp_path, "open")
    make_scan(tmp_path, "crashed", finished=False)
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "scan.db").write_text("no database " * 100)
    stores = open_undelivered(tmp_path)
    try:
        assert {s.header.scan_id for s in stores} == {"open", "crashed"}
        assert all(s.finished and not delivered(s) for s in stores)
    finally:
        for store in stores:
            store.close()


def test_the_backlog_reaches_the_ground_and_is_then_empty(tmp_path: Path) -> None:
    scans = tmp_path / "scans"
    make_scan(scans, "one")
    make_scan(scans, "two", finished=False)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    base = Config()
    config = dataclasses.replace(
        base,
        scan=dataclasses.replace(base.scan, folder=str(scans), drone="red"),
        datalink=dataclasses.replace(base.datalink, connect=(endpoint,)),
    )
    ground = Receiver(
        ReceiverConfig(tmp_path / "ground", SessionConfig(mode="router", listen=(endpoint,))),
        deliver=lambda _: None,
    )
    ground.start()
    link = open_backlog(config)
    assert link is not None
    try:
        assert link.drain(15.0)
    finally:
        link.close()
        ground.close()
    assert open_backlog(config) is None
    with ScanStore.open(tmp_path / "ground" / "drones" / "red" / "two" / "scan.db") as two:
        assert two.summary == {"interrupted": True} and len(list(two.poses())) == 5


def test_the_daemon_offers_earlier_scans_between_flights(tmp_path: Path) -> None:
    scans = tmp_path / "scans"
    make_scan(scans, "one")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    base = Config()
    config = dataclasses.replace(
        base,
        scan=dataclasses.replace(base.scan, folder=str(scans), drone="red"),
        datalink=dataclasses.replace(base.datalink, connect=(endpoint,)),
    )
    session = SessionConfig(mode="router", listen=(endpoint,))
    ground = Receiver(ReceiverConfig(tmp_path / "ground", session), deliver=lambda _: None)
    ground.start()
    vehicle = VehicleLink(VehicleConfig(), RehearsalControl())
    link = DaemonLink()

    def complete(scan_id: str) -> bool:
        return bool(
            until(lambda: scan_id in {e["scan"] for e in ground.progress() if e["complete"]})
        )

    try:
        link.offer_backlog(config, lambda: False)
        link.offer_backlog(config)
        assert complete("one")
        flown = ScanStore.create(scans / "two" / "scan.db", ScanHeader("two", "red", 1))
        link.begin_scan(flown, config, vehicle)
        assert link.sender is not None and link.backlog is None
        changed = dataclasses.replace(config.datalink, budget_kbit_s=123.0, share=0.5)
        link.configure(dataclasses.replace(config, datalink=changed))
        assert isinstance(link.sender, DatalinkSender)
        sender = link.sender
        until(lambda: sender.progress.rate_kbit_s == 61.5)
        flown.add_pose(PoseRecord(1, np.eye(4), np.eye(6)))
        flown.finish({})
        link.end_scan(config)  # at once: the ground cannot have everything yet
        flown.close()
        link.offer_backlog(config)
        assert complete("two")
        link.end_backlog()
        flown = ScanStore.create(scans / "three" / "scan.db", ScanHeader("three", "red", 1))
        link.begin_scan(flown, config, vehicle)
        flown.add_pose(PoseRecord(1, np.eye(4), np.eye(6)))
        flown.finish({})
        link.end_scan(config, is_last=True)  # waits: no backlog will follow
        assert delivered(flown)
        flown.close()
    finally:
        link.end_backlog()
        ground.close()
