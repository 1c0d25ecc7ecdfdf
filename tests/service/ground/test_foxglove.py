"""``skyrelief ground --foxglove``: a real client of its WebSocket, beside hostile ones."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from loopback import free_port, until
from paths import ROOT
from ros2_scene import DOWN, START_NS, camera_at, in_map, keyframe, matrix, nanoseconds

from recon import se3
from service.config import DatalinkConfig
from service.errors import InputError, OutsideError
from service.ground import foxglove
from service.ground.foxglove import FoxgloveServer
from service.stream import codec
from service.stream.link import DatalinkSender
from service.stream.records import PoseRecord, Repose, ScanHeader
from service.stream.store import ScanStore
from service.workers import Workers

pytest.importorskip("foxglove")
pytest.importorskip("rosbags")
pytest.importorskip("zenoh")
client = pytest.importorskip("websockets.sync.client")
decoder = pytest.importorskip("mcap_ros2.decoder")
records = pytest.importorskip("mcap.records")

MESSAGE = struct.Struct("<BIQ")


@dataclass
class Viewer:
    """A client that subscribes to all that is advertised, with a CDR decoder of its own."""

    socket: Any
    decoders: dict[int, tuple[str, Any]] = field(default_factory=dict)
    heard: dict[str, list[tuple[int, Any]]] = field(default_factory=dict)

    def take(self) -> None:
        """Take in what has come."""
        with contextlib.suppress(TimeoutError):
            while True:
                data = self.socket.recv(timeout=0.05)
                if isinstance(data, bytes):
                    self._message(data)
                elif (said := json.loads(data))["op"] == "advertise":
                    self._subscribe(said["channels"])

    def _subscribe(self, channels: list[dict[str, Any]]) -> None:
        for channel in channels:
            schema = records.Schema(
                channel["id"], channel["schema"].encode(), "ros2msg", channel["schemaName"]
            )
            assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
            decode = decoder.DecoderFactory().decoder_for("cdr", schema)
            self.decoders[channel["id"]] = channel["topic"], decode
        wanted = [{"id": c["id"], "channelId": c["id"]} for c in channels]
        self.socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def _message(self, data: bytes) -> None:
        kind, subscription, time_ns = MESSAGE.unpack_from(data)
        assert kind == 1
        topic, decode = self.decoders[subscription]
        self.heard.setdefault(topic, []).append((time_ns, decode(data[MESSAGE.size :])))

    def until_quiet(self, topic: str) -> int:
        """How many messages of a topic there are when none comes for a second."""
        count, quiet = -1, 0
        while quiet < 20:
            self.take()
            now = len(self.heard.get(topic, ()))
            count, quiet = now, quiet + 1 if now == count else 0
        return count

    def until_heard(self, topic: str, count: int) -> list[tuple[int, Any]]:
        """The messages of a topic once there are so many."""

        def enough() -> bool:
            self.take()
            return len(self.heard.get(topic, ())) >= count

        until(enough, 60.0)
        return self.heard[topic]


@contextlib.contextmanager
def viewer(port: int) -> Iterator[Viewer]:
    with connected(port) as one:
        yield Viewer(one)


def connected(port: int) -> Any:
    def connect() -> Any:
        with contextlib.suppress(OSError, EOFError, TimeoutError):
            return client.connect(
                f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], max_size=None,
                open_timeout=5.0,
            )  # fmt: skip

    return until(connect, 60.0)


@dataclass
class Flight:
    """A ground station, and a drone that sends it a scan."""

    port: int
    store: ScanStore
    received: Path

    def fly(self, seq: int) -> None:
        """One more keyframe."""
        T, time_ns = camera_at(5.0 * seq), START_NS + seq * 10**9
        self.store.add_keyframe(seq, codec.encode(keyframe(seq, T), time_ns))
        self.store.add_pose(PoseRecord(time_ns, T, np.eye(6), 47.0, 8.0, 450.0))

    def seqs(self) -> list[int]:
        """Keyframes that the ground has."""
        path = self.received / "scan.db"
        if not path.exists():
            return []
        with ScanStore.open(path) as store:
            return store.seqs()


@pytest.fixture
def flight(tmp_path: Path) -> Iterator[Flight]:
    port = free_port(socket.SOCK_STREAM)
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    command = [sys.executable, "-m", "service.cli", "ground", "--store", str(tmp_path / "g")]
    command += ["--listen", endpoint, "--foxglove", f"127.0.0.1:{port}"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    link = DatalinkConfig(connect=(endpoint,), budget_kbit_s=100_000.0)
    header = ScanHeader("s", "red", START_NS, 47.0, 8.0, 400.0)
    with (
        subprocess.Popen(command, env=environment) as ground,
        ScanStore.create(tmp_path / "air" / "scan.db", header) as store,
    ):
        sender = DatalinkSender(store, link)
        try:
            yield Flight(port, store, tmp_path / "g" / "red" / "s")
        finally:
            sender.close()
            ground.send_signal(signal.SIGINT)
            assert ground.wait(60.0) == 0
    with socket.socket() as probe:  # the process of the server ended with the station
        assert probe.connect_ex(("127.0.0.1", port)) != 0


def test_keyframes_come_live_and_corrections_move_them(flight: Flight) -> None:
    flight.fly(0)
    with viewer(flight.port) as one:
        one.until_heard("/red/camera/points", 1)
        flight.fly(1)
        time_ns, cloud = one.until_heard("/red/camera/points", 2)[-1]
        assert time_ns == nanoseconds(cloud.header.stamp) == START_NS + 10**9
        assert cloud.header.frame_id == "red/camera_optical"
        for kind in ("image/compressed", "camera_info", "fix"):
            assert one.until_heard(f"/red/camera/{kind}", 2)[-1][0] == time_ns

        def east_m() -> float:
            one.take()
            of_it = [m.transforms[0] for at, m in one.heard["/tf"] if at == time_ns]
            assert {t.header.frame_id for t in of_it} == {"red/map"}
            return float(np.mean(in_map(cloud, matrix(of_it[-1].transform))[0][:, 0]))

        sent = one.until_quiet("/red/camera/points")  # also the finer layers
        before_m = east_m()
        moved = camera_at(5.0)
        moved[0, 3] += 20.0
        flight.store.add_reposes([Repose(1, 1, moved, 1.0, np.eye(6))])
        until(lambda: abs(east_m() - before_m - 20.0) < 0.01, 30.0)
        assert one.until_quiet("/red/camera/points") == sent  # the points are not sent again
        larger = se3.compose(DOWN, np.array([0.0, 0.0, 55.0]))
        flight.store.add_reposes([Repose(0, 1, larger, 1.1, np.eye(6))])
        _, cloud = one.until_heard("/red/camera/points", sent + 1)[-1]
        assert nanoseconds(cloud.header.stamp) == START_NS
        assert np.median(in_map(cloud, np.eye(4))[0][:, 2]) == pytest.approx(55.0, abs=0.1)
    with viewer(flight.port) as late:  # gets the scan from its start
        assert {at for at, _ in late.until_heard("/red/camera/points", 2)} == {
            START_NS,
            START_NS + 10**9,
        }


def test_hostile_clients_stop_neither_the_receiver_nor_the_server(flight: Flight) -> None:
    flight.fly(0)
    with contextlib.ExitStack() as stack:
        deaf = Viewer(stack.enter_context(connected(flight.port)))
        deaf.until_heard("/red/camera/points", 1)  # subscribed; from now on it reads nothing
        rude = stack.enter_context(connected(flight.port))
        for text in ("", "{", "[]", '{"op": "subscribe", "subscriptions": 7}', '{"op": []}'):
            rude.send(text)
        rude.send(os.urandom(1000))
        for _ in range(200):  # more than the process may have open, half of them in mid-request
            one = socket.socket()
            stack.enter_context(one)
            one.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                one.connect(("127.0.0.1", flight.port))
            with contextlib.suppress(OSError):
                one.send(b"GET / HTTP/1.1\r\nHost: x\r\n")
        for seq in range(1, 40):
            flight.fly(seq)
        until(lambda: len(flight.seqs()) == 40, 60.0, lambda: len(flight.seqs()))
    with viewer(flight.port) as good:
        good.until_heard("/red/camera/points", 20)


def test_a_viewer_that_asks_again_and_again_holds_up_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[int] = []
    channels = SimpleNamespace(
        log_keyframe=lambda one: seen.append(one.seq), log_transform=print, log_fix=print
    )
    monkeypatch.setattr(foxglove, "Ros2Channels", lambda *_: channels)
    path = tmp_path / "scan.db"
    with ScanStore.create(path, ScanHeader("s", "red", START_NS)) as store:
        for seq in range(3 * foxglove.AT_ONCE):
            store.add_keyframe(seq, codec.encode(keyframe(seq, camera_at(5.0)), START_NS))
    with contextlib.closing(foxglove.LiveScan(None, tmp_path)) as scan:
        for _ in range(8):
            scan.again()
            scan.refresh()
    assert seen[: 3 * foxglove.AT_ONCE] == list(range(3 * foxglove.AT_ONCE))
    assert seen[3 * foxglove.AT_ONCE] == 0  # then for the one that asked


def test_addresses_that_cannot_be(tmp_path: Path) -> None:
    workers = Workers()
    with pytest.raises(InputError, match="--plain"):
        FoxgloveServer("0.0.0.0:8765", tmp_path, False, workers)
    with pytest.raises(InputError, match="HOST:PORT"):
        FoxgloveServer("8765", tmp_path, False, workers)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(OutsideError, match="cannot listen"):
            FoxgloveServer(address, tmp_path, False, workers).start()
    assert not workers.table()
