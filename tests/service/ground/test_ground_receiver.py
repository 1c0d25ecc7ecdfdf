"""Drone and ground over a real link on this machine: the two scan folders end equal."""

from __future__ import annotations

import json
import socket
import threading
import time
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loopback import until

from recon import se3
from recon.types import DepthMap, Keyframe, Pose
from service.config import DatalinkConfig
from service.errors import InputError, OutsideError
from service.ground.receiver import Receiver, ReceiverConfig
from service.ground.storage import DroneLimits, scan_folder
from service.stream import codec
from service.stream.link import DatalinkSender
from service.stream.records import PoseRecord, Repose, ScanHeader
from service.stream.session import SessionConfig, open_session, zenoh_config
from service.stream.store import ScanStore, header_of

pytest.importorskip("zenoh")


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def keyframe(seq: int) -> Keyframe:
    w, h = 160, 90
    rng = np.random.default_rng(seq)
    T = se3.exp(rng.normal(0, 0.3, 6))
    depth = DepthMap(
        rng.uniform(40, 60, (h, w)).astype(np.float32),
        rng.uniform(0.1, 0.2, (h, w)).astype(np.float32),
        np.full((h, w), 3, np.uint8),
        np.array([[130.0, 0, 79.5], [0, 130.0, 44.5], [0, 0, 1]]),
        T,
    )
    bgr = rng.integers(0, 255, (h, w, 3), np.uint8)
    return Keyframe(
        seq, 5, depth, bgr, Pose(T, np.eye(6) * 1e-4, ("vision",)), np.ones((h, w), bool)
    )


def new_store(folder: Path, drone: str = "drone-a", scan_id: str = "scan-1") -> ScanStore:
    return ScanStore.create(folder / "scan.db", ScanHeader(scan_id, drone, 1, notes=("hello",)))


def fly(store: ScanStore, first: int, last: int) -> None:
    for seq in range(first, last):
        store.add_keyframe(seq, codec.encode(keyframe(seq), seq))
        store.add_pose(PoseRecord(1000 * seq, np.eye(4), np.eye(6), keyframe_seq=seq))


WRITTEN: list[Path] = []


def note(folder: Path) -> None:
    """Instead of writing the deliverables, which are another module's matter."""
    WRITTEN.append(folder)


def start_ground(folder: Path, endpoint: str, name: str = "") -> Receiver:
    session = SessionConfig(mode="router", listen=(endpoint,))
    ground = Receiver(ReceiverConfig(folder, session, name=name), deliver=note)
    ground.start()
    return ground


def assert_equal(onboard: ScanStore, path: Path) -> None:
    with ScanStore.open(path) as ground:
        assert ground.numbers() == onboard.numbers()
        assert ground.header == onboard.header and ground.summary == onboard.summary
        for a, b in zip(onboard.keyframes(), ground.keyframes(), strict=True):
            np.testing.assert_array_equal(a.depth.depth_m, b.depth.depth_m)
            np.testing.assert_array_equal(a.bgr, b.bgr)
            np.testing.assert_array_equal(a.depth.T_world_camera, b.depth.T_world_camera)


@pytest.fixture(autouse=True)
def written() -> list[Path]:
    """The folders whose deliverables were asked for."""
    WRITTEN.clear()
    return WRITTEN


def fast(endpoint: str) -> DatalinkConfig:
    return DatalinkConfig(connect=(endpoint,), budget_kbit_s=100_000.0)


def test_what_grows_while_it_is_written_is_written_at_the_end(tmp_path: Path) -> None:
    endpoint, release = free_endpoint(), threading.Event()
    seen: list[int] = []

    def deliver(folder: Path) -> None:
        with ScanStore.peek(folder / "scan.db") as received:
            seen.append(len(received.seqs()))
        release.wait(30.0)

    session = SessionConfig(mode="router", listen=(endpoint,))
    limits = DroneLimits(refresh_s=0.1)
    ground = Receiver(ReceiverConfig(tmp_path / "ground", session, limits), deliver=deliver)
    ground.start()
    store = new_store(tmp_path / "air")
    fly(store, 0, 1)
    with closing(DatalinkSender(store, fast(endpoint))):
        until(lambda: bool(seen), 30.0)
        fly(store, 1, 2)
        until(lambda: ground.progress()[0]["held"].get("k0") == 2, 30.0)
    threading.Timer(0.5, release.set).start()
    ground.close()
    store.close()
    assert len(seen) == 2 and seen[-1] == 2


def test_two_runs_of_one_time_stay_two_scans(tmp_path: Path, written: list[Path]) -> None:
    endpoint = free_endpoint()
    runs = []
    for n, run_id in enumerate(("0f" * 16, "e1" * 16)):
        header = ScanHeader("scan-1", "drone-a", 1, run_id=run_id)
        runs.append(ScanStore.create(tmp_path / f"air-{n}" / "scan.db", header))
    fly(runs[0], 0, 4)
    fly(runs[1], 2, 9)  # numbers 2 and 3 are in both
    for store in runs:
        store.finish({"points": len(store.seqs())})
    ground = start_ground(tmp_path / "ground", endpoint)
    links = [DatalinkSender(store, fast(endpoint)) for store in runs]
    try:
        until(lambda: [e["complete"] for e in ground.progress()] == [True, True], 60.0)
        assert sorted(e["scan"] for e in ground.progress()) == ["scan-1", "scan-1-2"]
    finally:
        for link in links:
            link.close()
        ground.close()
    folders = [tmp_path / "ground" / "drones" / "drone-a" / name for name in ("scan-1", "scan-1-2")]
    headers = [header_of(folder / "scan.db") for folder in folders]
    by_run = {
        header.run_id: folder for header, folder in zip(headers, folders, strict=True) if header
    }
    for store in runs:
        assert_equal(store, by_run[store.header.run_id] / "scan.db")
        store.close()
    # The receiver that is started again finds each run's folder.
    place = partial(scan_folder, tmp_path / "ground", "drone-a")
    for store in runs:
        assert place(store.header.name) == by_run[store.header.run_id]
    assert place("scan-1." + "2" * 32).name == "scan-1-3"
    assert place("scan-1").name == "scan-1-3"  # of a drone that gives no run


def test_a_scan_arrives_whole_with_its_corrections(tmp_path: Path, written: list[Path]) -> None:
    endpoint = free_endpoint()
    onboard = new_store(tmp_path / "air")
    link = DatalinkSender(onboard, fast(endpoint))
    ground = start_ground(tmp_path / "ground", endpoint)
    try:
        fly(onboard, 0, 12)
        onboard.update_header(epsg=32632)
        onboard.add_reposes([Repose(3, 1, se3.exp(np.full(6, 0.1)), 1.01, np.eye(6))])
        onboard.finish({"points": 12})
        assert link.drain(20.0)
        folder = scan_folder(tmp_path / "ground", "drone-a", "scan-1")
        until(lambda: folder in written)
        until(lambda: all(entry["complete"] for entry in ground.progress()))
        (entry,) = ground.progress()
        assert not entry["missing"]
    finally:
        link.close()
        ground.close()
    assert_equal(onboard, folder / "scan.db")
    onboard.close()


def test_what_was_flown_before_the_ground_came_is_fetched_once(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    onboard = new_store(tmp_path / "air")
    fly(onboard, 0, 20)
    onboard.finish({})
    link = DatalinkSender(onboard, fast(endpoint))
    ground = start_ground(tmp_path / "ground", endpoint)
    try:
        assert link.drain(20.0)
        (entry,) = ground.progress()
        assert entry["duplicates"] == 0
    finally:
        link.close()
        ground.close()
    assert_equal(onboard, tmp_path / "ground" / "drones" / "drone-a" / "scan-1" / "scan.db")
    onboard.close()


def test_both_ends_may_restart(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    config = fast(endpoint)
    onboard = new_store(tmp_path / "air")
    link = DatalinkSender(onboard, config)
    ground = start_ground(tmp_path / "ground", endpoint)
    fly(onboard, 0, 5)
    until(lambda: link.progress.complete)
    ground.close()
    fly(onboard, 5, 10)
    ground = start_ground(tmp_path / "ground", endpoint)
    fly(onboard, 10, 12)
    link.close()
    onboard.close()
    onboard = ScanStore.open(tmp_path / "air" / "scan.db")
    link = DatalinkSender(onboard, config)
    try:
        fly(onboard, onboard.seqs()[-1] + 1, 15)
        onboard.finish({"points": 1})
        assert link.drain(30.0)
    finally:
        link.close()
        ground.close()
    assert_equal(onboard, tmp_path / "ground" / "drones" / "drone-a" / "scan-1" / "scan.db")
    onboard.close()


@pytest.mark.slow
def test_a_session_on_which_stations_fell_silent_is_opened_again(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    opened: list[float] = []

    def counted(config: SessionConfig) -> Any:
        opened.append(time.monotonic())
        return open_session(config)

    onboard = new_store(tmp_path / "air")
    ground = start_ground(tmp_path / "ground", endpoint)
    link = DatalinkSender(onboard, fast(endpoint), opener=counted)
    link.silence_s = 0.4  # less than between two reports
    try:
        until(lambda: len(opened) >= 3)
        fly(onboard, 0, 5)
        onboard.finish({})
        link.silence_s = 5.0
        assert link.drain(20.0)
    finally:
        link.close()
        ground.close()
    assert_equal(onboard, scan_folder(tmp_path / "ground", "drone-a", "scan-1") / "scan.db")
    onboard.close()


@pytest.mark.slow
def test_a_router_between_them_may_restart(tmp_path: Path) -> None:
    """Drone and ground are both clients of a fleet's router, which dies in mid-flight."""
    endpoint = free_endpoint()
    router_config = SessionConfig(mode="router", listen=(endpoint,))
    router = open_session(router_config)
    onboard = new_store(tmp_path / "air")
    ground = Receiver(
        ReceiverConfig(tmp_path / "ground", SessionConfig(connect=(endpoint,))), deliver=note
    )
    ground.start()
    link = DatalinkSender(onboard, fast(endpoint))
    try:
        fly(onboard, 0, 2)
        until(lambda: any(e["held"].get("k1") == 2 for e in ground.progress()))
        router.close()
        fly(onboard, 2, 4)
        time.sleep(0.3)
        router = open_session(router_config)
        fly(onboard, 4, 6)
        onboard.finish({})
        assert link.drain(30.0)
    finally:
        link.close()
        ground.close()
        router.close()
    assert_equal(onboard, scan_folder(tmp_path / "ground", "drone-a", "scan-1") / "scan.db")
    onboard.close()


def test_clocks_hours_apart_change_nothing(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    ahead_ns = time.time_ns() + 7 * 3_600_000_000_000
    header = ScanHeader("scan-1", "drone-a", ahead_ns)
    onboard = ScanStore.create(tmp_path / "air" / "scan.db", header)
    ground = start_ground(tmp_path / "ground", endpoint)
    link = DatalinkSender(onboard, fast(endpoint))
    try:
        for seq in range(3):
            at_ns = ahead_ns + seq if seq else 1  # and it is set right, or wrong, on the way
            onboard.add_keyframe(seq, codec.encode(keyframe(seq), at_ns))
            onboard.add_pose(PoseRecord(at_ns, np.eye(4), np.eye(6), keyframe_seq=seq))
        onboard.finish({})
        assert link.drain(20.0)
        (entry,) = ground.progress()
        assert all(0 <= lag_s < 20 for lag_s in entry["lag_s"].values())
    finally:
        link.close()
        ground.close()
    assert_equal(onboard, scan_folder(tmp_path / "ground", "drone-a", "scan-1") / "scan.db")
    onboard.close()


def test_two_drones_with_the_same_scan_id_and_a_late_second_ground(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    stores = [new_store(tmp_path / name, name) for name in ("red", "blue")]
    links = [DatalinkSender(s, fast(endpoint)) for s in stores]
    ground = start_ground(tmp_path / "ground", endpoint, "first")
    for k, store in enumerate(stores):
        fly(store, 0, 4 + k)
        store.finish({})
    late_session = SessionConfig(mode="client", connect=(endpoint,))
    late = Receiver(ReceiverConfig(tmp_path / "late", late_session, name="second"), deliver=note)
    try:
        assert all(link.drain(20.0) for link in links)
        late.start()
        until(lambda: len(late.progress()) == 2)
        until(lambda: all(e["complete"] for e in late.progress()))
    finally:
        for link in links:
            link.close()
        late.close()
        ground.close()
    for store in stores:
        for folder in ("ground", "late"):
            assert_equal(
                store, tmp_path / folder / "drones" / store.header.drone / "scan-1" / "scan.db"
            )
        store.close()


def test_over_the_quota_the_ground_keeps_coarse_layers_and_says_so(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    onboard = new_store(tmp_path / "air")
    fly(onboard, 0, 6)
    onboard.finish({})
    session = SessionConfig(mode="router", listen=(endpoint,))
    ground = Receiver(
        ReceiverConfig(tmp_path / "ground", session, DroneLimits(120_000)), deliver=note
    )
    ground.start()
    link = DatalinkSender(onboard, fast(endpoint))
    try:
        until(lambda: any(e["complete"] for e in ground.progress()))
        (entry,) = ground.progress()
        assert entry["held"]["k0"] == 6 and 0 < entry["refused"] < 6
        assert entry["held"].get("k1", 0) + entry["refused"] == 6
    finally:
        link.close()
        ground.close()
        onboard.close()


@pytest.mark.parametrize(("rate", "size"), [(0.0, 16_384), (81_250.0, 16_384), (1e6, 200_000)])
def test_the_send_buffer_is_small_and_covers_a_round_trip(rate: float, size: int) -> None:
    config = SessionConfig(connect=("tls/10.0.0.1:7447",), rate_bytes_s=rate)
    endpoints = json.loads(zenoh_config(config).get_json("connect/endpoints"))
    assert endpoints == [f"tls/10.0.0.1:7447#so_sndbuf={size}"]


def test_no_endpoint_opens_nothing(tmp_path: Path) -> None:
    onboard = new_store(tmp_path / "air")
    link = DatalinkSender(onboard, DatalinkConfig())
    assert not link.drain(0.0) and not link.progress.connected
    link.close()
    onboard.close()


def test_plain_endpoints_beyond_this_machine_need_a_word(tmp_path: Path) -> None:
    onboard = new_store(tmp_path / "air")
    for endpoint in ("tcp/192.168.144.11:7447", "tcp/nonsense", "tls/192.168.144.11:7447"):
        with pytest.raises(InputError) as caught:
            DatalinkSender(onboard, DatalinkConfig(connect=(endpoint,)))
        assert "\n" not in str(caught.value)
    onboard.close()


def test_a_busy_port_is_said_at_once(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    ground = start_ground(tmp_path / "a", endpoint)
    try:
        with pytest.raises(OutsideError, match="does not open"):
            start_ground(tmp_path / "b", endpoint)
    finally:
        ground.close()
