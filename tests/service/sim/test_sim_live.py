"""A flight played in real time over the loopback, to a socket and to a pipe of FFmpeg's."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from pymavlink.dialects.v20 import common  # type: ignore[import-untyped]
from typer.testing import CliRunner

from service.cli import app
from service.errors import InputError
from service.sim.live import play


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("live") / "flight"
    arguments = [
        "simulate", "--out", str(folder), "--size", "320x180", "--fps", "5", "--duration-s", "2",
        "--height-m", "40", "--depth-frames", "0",
    ]  # fmt: skip
    result = CliRunner().invoke(app, arguments)
    if result.exception is not None:
        raise result.exception
    return folder


class GroundEnd(threading.Thread):
    """Hears MAVLink on a UDP port and asks for the time now and then."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(0.2)
        self.port = int(self.socket.getsockname()[1])
        self.messages: list[Any] = []
        self.stop = threading.Event()

    def run(self) -> None:
        reader = common.MAVLink(None)
        sender = common.MAVLink(None, srcSystem=1, srcComponent=191)
        while not self.stop.is_set():
            try:
                data, peer = self.socket.recvfrom(2048)
            except TimeoutError:
                continue
            self.messages += reader.parse_buffer(data) or []
            if len(self.messages) % 20 == 0:
                request = common.MAVLink_timesync_message(0, time.monotonic_ns())
                self.socket.sendto(bytes(request.pack(sender)), peer)


@pytest.mark.slow
def test_flight_is_played_with_its_telemetry(flight: Path, tmp_path: Path) -> None:
    ground = GroundEnd()
    ground.start()
    out = tmp_path / "received.ts"
    counts = play(flight, str(out), f"127.0.0.1:{ground.port}")
    time.sleep(0.3)
    ground.stop.set()
    ground.join()
    assert counts["frames"] == 10
    by_kind: dict[str, list[Any]] = {}
    for message in ground.messages:
        by_kind.setdefault(message.get_type(), []).append(message)
    assert len(by_kind["ATTITUDE"]) > 0.9 * 350  # loopback may drop a little under load
    boots = [m.time_boot_ms for m in by_kind["ATTITUDE"]]
    assert boots == sorted(boots)
    assert abs(by_kind["SYSTEM_TIME"][-1].time_unix_usec / 1e6 - time.time()) < 60.0  # renewed
    assert counts["timesync_answers"] >= 3
    answers = by_kind["TIMESYNC"]
    assert all(m.tc1 > 100e9 and m.ts1 > 0 for m in answers)
    offsets = np.array([m.tc1 - m.ts1 for m in answers]) / 1e9
    assert np.ptp(offsets) < 1.0  # one boot clock
    starts = [out.read_bytes()[at : at + 188] for at in range(0, out.stat().st_size, 188)]
    lengths = [p[p.index(b"\0\0\1\xe0") + 4 :][:2] for p in starts if b"\0\0\1\xe0" in p]
    assert len(lengths) == 10 and b"\0\0" not in lengths  # each image ends where it says
    with av.open(str(out)) as container:
        received = [f.to_ndarray() for f in container.decode(video=0)]
    with av.open(str(flight / "flight.mp4")) as container:
        sent = [f.to_ndarray() for f in container.decode(video=0)]
    assert len(received) == len(sent)
    np.testing.assert_array_equal(received[-1], sent[-1])


@pytest.mark.slow
def test_live_command_pipes_the_video(flight: Path) -> None:
    command = [
        sys.executable, "-m", "service.cli", "simulate", "--out", str(flight), "--live",
        "--video-to", "pipe:1", "--mavlink-to", "127.0.0.1:9", "--json",
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout[:1] == b"\x47" and len(done.stdout) % 188 == 0  # MPEG-TS and nothing else
    assert json.loads(done.stderr.decode().strip().splitlines()[-1])["frames"] == 10


@pytest.mark.slow
@pytest.mark.parametrize("address", ["nowhere", "127.0.0.1:0", "127.0.0.1:http", ":14550"])
def test_wrong_addresses_are_refused(address: str, flight: Path) -> None:
    arguments = ["simulate", "--out", str(flight), "--live", "--mavlink-to", address]
    result = CliRunner().invoke(app, arguments)
    assert isinstance(result.exception, InputError) and "host:port" in str(result.exception)


def test_empty_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no flight"):
        play(tmp_path, "pipe:1", "127.0.0.1:14550")


def test_a_video_without_a_time_is_refused(flight: Path, tmp_path: Path) -> None:
    """Its log could not be played at the right moment."""
    out = tmp_path / "flight.mp4"
    with av.open(str(flight / "flight.mp4")) as source, av.open(str(out), "w") as sink:
        stream = sink.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                sink.mux(packet)
    with pytest.raises(InputError, match="creation time"):
        play(tmp_path, str(tmp_path / "out.ts"), "127.0.0.1:14550")
