"""Both ends are killed and started again in one flight; the two scan folders end equal."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from house_flight import HouseFlight
from paths import ROOT

from service.errors import OutsideError
from service.ground.due import FILES, deliver, write_files
from service.ground.receiver import Receiver, ReceiverConfig
from service.scans.folder import CLOUD, CSV, PREVIEW, TUM, write_deliverables
from service.stream.session import SessionConfig
from service.stream.store import ScanStore

pytest.importorskip("zenoh")


DRONE = """
import sys, time
from pathlib import Path
import numpy as np
from recon.types import DepthMap, Keyframe, Pose
from service.config import DatalinkConfig
from service.stream import codec
from service.stream.link import DatalinkSender
from service.stream.records import PoseRecord, ScanHeader
from service.stream.store import ScanStore

path, endpoint, last = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
header = ScanHeader("scan-1", "drone-a", 1)
store = ScanStore.open(path) if path.exists() else ScanStore.create(path, header)
config = DatalinkConfig(connect=(endpoint,), budget_kbit_s=4000)
link = DatalinkSender(store, config)
print("up", flush=True)
for seq in range(max(store.seqs(), default=-1) + 1, last):
    rng = np.random.default_rng(seq)
    depth = DepthMap(rng.uniform(40, 60, (90, 160)).astype(np.float32),
        np.full((90, 160), 0.1, np.float32), np.full((90, 160), 3, np.uint8),
        np.array([[130.0, 0, 79.5], [0, 130.0, 44.5], [0, 0, 1]]), np.eye(4))
    frame = Keyframe(seq, 0, depth, rng.integers(0, 255, (90, 160, 3), np.uint8),
        Pose(np.eye(4), np.eye(6)), np.ones((90, 160), bool))
    store.add_keyframe(seq, codec.encode(frame, seq))
    store.add_pose(PoseRecord(seq, np.eye(4), np.eye(6), keyframe_seq=seq))
    time.sleep(0.1)
store.finish({"keyframes": last})
print("drained", link.drain(60.0), flush=True)
link.close()
store.close()
"""

GROUND = """
import sys, time
from pathlib import Path
from service.ground import receiver
from service.ground.receiver import Receiver, ReceiverConfig
from service.stream.session import SessionConfig

receiver.deliver = lambda _: None
session = SessionConfig(mode="router", listen=(sys.argv[2],))
station = Receiver(ReceiverConfig(Path(sys.argv[1]), session))
station.start()
print("up", flush=True)
while True:
    time.sleep(1)
"""


def start(program: str, *arguments: str) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", program, *arguments],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "up\n"
    return process


def kill(process: subprocess.Popen[str]) -> None:
    process.send_signal(signal.SIGKILL)
    process.wait()


@pytest.mark.slow
def test_killed_and_restarted_on_both_sides(tmp_path: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    onboard = tmp_path / "scan.db"
    drone = start(DRONE, str(onboard), endpoint, "30")
    ground = start(GROUND, str(tmp_path / "ground"), endpoint)
    try:
        time.sleep(1.5)
        kill(ground)
        time.sleep(0.7)
        ground = start(GROUND, str(tmp_path / "ground"), endpoint)
        time.sleep(0.5)
        kill(drone)
        drone = start(DRONE, str(onboard), endpoint, "30")
        assert drone.stdout is not None
        assert drone.stdout.readline() == "drained True\n"
    finally:
        kill(drone)
        kill(ground)
    received = tmp_path / "ground" / "drones" / "drone-a" / "scan-1" / "scan.db"
    with ScanStore.open(onboard) as a, ScanStore.open(received) as b:
        assert a.seqs() == list(range(30))
        assert a.numbers() == b.numbers()
        for left, right in zip(a.keyframes(), b.keyframes(), strict=True):
            np.testing.assert_array_equal(left.depth.depth_m, right.depth.depth_m)
            np.testing.assert_array_equal(left.bgr, right.bgr)
        write_deliverables(tmp_path, a)
        write_deliverables(received.parent, b)
    for name in (CLOUD, TUM, CSV, PREVIEW):
        assert (tmp_path / name).read_bytes() == (received.parent / name).read_bytes(), name


@pytest.mark.parametrize("killed", ["while receiving", "while writing"])
def test_files_that_a_killed_station_left_are_written_at_the_next_start(
    tmp_path: Path, house: HouseFlight, killed: str
) -> None:
    folder = tmp_path / "drone-1" / "test-1"
    house.flown(folder).close()
    FILES.mark(folder)
    if killed == "while writing":
        FILES.begin(folder)
    assert FILES.folders(tmp_path) == [folder]
    station = Receiver(ReceiverConfig(tmp_path, SessionConfig(mode="peer")))
    station.start()
    try:
        for _ in range(1200):
            if not FILES.folders(tmp_path):
                break
            time.sleep(0.1)
    finally:
        station.close()
    assert FILES.folders(tmp_path) == []
    names = {path.name for path in folder.iterdir()}
    assert {CLOUD, TUM, CSV, PREVIEW, "scan.json", "report.html"} <= names
    assert not {".files-due", ".files-begun"} & names


def test_what_comes_while_files_are_written_is_due_again(
    tmp_path: Path, house: HouseFlight
) -> None:
    folder = tmp_path / "drone-1" / "test-1"
    FILES.mark(folder)  # of a folder that is gone: nothing happens
    house.flown(folder).close()

    def grows_meanwhile(folder: Path) -> None:
        assert FILES.folders(tmp_path) == [folder]
        FILES.mark(folder)
        deliver(folder)

    FILES.mark(folder)
    assert write_files(folder, grows_meanwhile) == ("", False)
    assert FILES.folders(tmp_path) == [folder]
    assert write_files(folder) == ("", False)
    assert FILES.folders(tmp_path) == []


@pytest.mark.parametrize("error", [OutsideError("disk full"), OSError("disk full"), ValueError()])
def test_only_files_that_the_disk_refused_are_written_again(
    error: Exception, tmp_path: Path, house: HouseFlight
) -> None:
    """Also where scan.json is of an earlier state; a fault of the scan would come at each time."""

    def fail(_: Path) -> None:
        raise error

    folder = tmp_path / "drone-1" / "test-1"
    house.flown(folder).close()
    for is_written in (False, True):
        if is_written:
            deliver(folder)
        FILES.mark(folder)
        trouble, is_due = write_files(folder, fail)
        assert trouble and is_due == (not isinstance(error, ValueError))
        assert (FILES.folders(tmp_path) == [folder]) == (is_due or not is_written)
