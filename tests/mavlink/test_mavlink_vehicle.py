"""The vehicle link as the service sees it."""

from __future__ import annotations

import contextlib
import math
import os
import socket
import threading
import time
from collections import Counter
from pathlib import Path

import pytest
from loopback import free_port, until
from paths import DATA
from rehearsal import RehearsalVehicle

from mavlink.component.control import Answer
from mavlink.component.vehicle import VehicleConfig
from mavlink.telemetry.logs import load_telemetry
from mavlink.wire.dialect import dialect
from mavlink.wire.link import LinkSpec, parse_link
from mavlink.wire.ports import MAX_PEERS, PORTS, READ_S, TcpPort, UdpPort
from mavlink.wire.tlog import TlogRecorder, packets

S = 1_000_000_000


def test_parameters_are_kept_over_a_restart(tmp_path: Path) -> None:
    port = free_port()
    for value in (2.5, 4.0):
        with (
            RehearsalVehicle(f"udpin:127.0.0.1:{port}", state_dir=tmp_path) as daemon,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer,
        ):
            peer.connect(("127.0.0.1", port))
            if value == 4.0:
                assert daemon.link.parameters()["SR_BASELINE_M"] == 2.5
            message = dialect.MAVLink_param_set_message(1, 191, b"SR_BASELINE_M", value, 9)
            peer.send(bytes(message.pack(dialect.MAVLink(None, 255, 190))))
            until(lambda: daemon.link.parameters()["SR_BASELINE_M"] == value)  # noqa: B023
    (tmp_path / "mavlink.json").write_text("{ torn")
    with RehearsalVehicle(state_dir=tmp_path) as daemon:
        assert daemon.link.parameters()["SR_BASELINE_M"] == 0.0


def test_a_fault_in_the_service_does_not_cost_the_link(caplog: pytest.LogCaptureFixture) -> None:
    port = free_port()
    with (
        RehearsalVehicle(f"udpin:127.0.0.1:{port}") as daemon,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer,
    ):
        peer.connect(("127.0.0.1", port))

        def broken() -> Answer:
            raise RuntimeError("a bug")

        daemon.control.start_scan = broken  # type: ignore[method-assign]
        mouth = dialect.MAVLink(None, 255, 190)
        start = dialect.MAVLink_command_long_message(1, 100, 2500, 0, 0, 0, 0, 0, 0, 0, 0)
        stop = dialect.MAVLink_command_long_message(1, 191, 31010, 0, 3, 0, 0, 0, 0, 0, 0)
        peer.send(bytes(start.pack(mouth)))
        until(lambda: "fault while serving MAVLink" in caplog.text)
        peer.send(bytes(stop.pack(mouth)))
        until(lambda: daemon.control.asked == ["clear_map"])


@pytest.mark.parametrize(
    ("text", "spec"),
    [
        ("udp:0.0.0.0:14550", LinkSpec("udpin", "0.0.0.0", 14550)),
        ("udpout:10.0.0.1:14550", LinkSpec("udpout", "10.0.0.1", 14550)),
        ("tcp:host:5760", LinkSpec("tcp", "host", 5760)),
        ("serial:/dev/ttyTHS1:921600", LinkSpec("serial", "/dev/ttyTHS1", 921600)),
        ("serial:/dev/ttyACM0", LinkSpec("serial", "/dev/ttyACM0", 57600)),
        ("/dev/ttyACM0,115200", LinkSpec("serial", "/dev/ttyACM0", 115200)),
        ("serial:/dev/ttyACM0,115200", LinkSpec("serial", "/dev/ttyACM0", 115200)),
        ("serial:///dev/ttyACM0:115200", LinkSpec("serial", "/dev/ttyACM0", 115200)),
        ("udpin://0.0.0.0:14540", LinkSpec("udpin", "0.0.0.0", 14540)),
        ("tcpout://10.0.0.1:5760", LinkSpec("tcp", "10.0.0.1", 5760)),
    ],
)
def test_links_are_named_as_pymavlink_and_mavsdk_do(text: str, spec: LinkSpec) -> None:
    assert parse_link(text) == spec


@pytest.mark.parametrize(
    "text", ["", "udp", "udpin:14550", "foo:1:2", "udpin:h:0", "udpin:h:99999", "tcp:h:x"]
)
def test_senseless_links_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="link"):
        VehicleConfig(links=(text,))


def test_the_newest_peers_of_a_port_are_answered() -> None:
    at = LinkSpec("udpin", "127.0.0.1", free_port())
    with contextlib.closing(UdpPort(at)) as port, contextlib.ExitStack() as stack:
        peers = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(MAX_PEERS + 2)]
        for peer in map(stack.enter_context, peers):
            peer.sendto(b"x", (at.place, at.number))
            assert port.read() == b"x"
            port.write(b"y")
            peer.settimeout(10.0)
            assert peer.recv(16) == b"y"


def test_a_connection_that_a_stand_in_still_holds_ends_for_the_other_end_too() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = TcpPort(LinkSpec("tcp", "127.0.0.1", server.getsockname()[1]))
        peer, _ = server.accept()
        with peer:
            ((number, _),) = port.ways
            held = os.dup(number)
            port.close()
            peer.settimeout(20.0)
            assert peer.recv(1) == b""
            os.close(held)


def test_a_client_that_is_dropped_while_others_are_read_ends_nothing() -> None:
    at = LinkSpec("tcpin", "127.0.0.1", free_port(socket.SOCK_STREAM))
    with (
        contextlib.closing(TcpPort(at)) as port,
        socket.create_connection((at.place, at.number)) as client,
    ):
        until(lambda: port.read() or port.ways)
        gone = socket.socket()
        gone.close()  # as the writing thread closes one
        port._peers.append(gone)
        client.sendall(b"x")
        assert until(port.read) == b"x"


def test_the_last_word_is_said() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        peer.settimeout(10.0)
        with RehearsalVehicle(f"udpout:127.0.0.1:{peer.getsockname()[1]}") as daemon:
            assert peer.recv(4096)
            daemon.link.statustext("Service stops")
        peer.setblocking(False)
        heard = b""
        with contextlib.suppress(BlockingIOError):
            while True:
                heard += peer.recv(4096)
        assert b"Service stops" in heard


def test_neither_heartbeats_nor_answers_wait_for_the_disk_of_the_log(tmp_path: Path) -> None:
    log = tmp_path / "link.tlog"
    os.mkfifo(log)
    disk = os.open(log, os.O_RDONLY | os.O_NONBLOCK)  # takes 64 KiB, then nothing
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        peer.settimeout(10.0)
        with RehearsalVehicle(f"udpout:127.0.0.1:{peer.getsockname()[1]}") as daemon:
            link = daemon.link
            link.record(log, 0)

            def fill() -> None:
                for _ in range(1000):
                    link.recorder.write(bytes(250), 0)

            fills = threading.Thread(target=fill)
            fills.start()
            written = -1
            while written != (written := link.recorder.packets):
                time.sleep(0.1)
            try:
                assert fills.is_alive()
                peer.setblocking(False)
                with contextlib.suppress(BlockingIOError):
                    while peer.recv(4096):
                        pass
                peer.settimeout(10.0)
                beats = 0
                while beats < 5:  # of two components
                    data, us = peer.recvfrom(4096)
                    beats += data[7:10] == b"\0\0\0"
                mouth = dialect.MAVLink(None, 255, 190)
                ask = dialect.MAVLink_param_request_read_message(1, 191, b"SR_BASELINE_M", -1)
                for _ in range(5):  # each is logged before it is answered
                    peer.sendto(bytes(ask.pack(mouth)), us)
                    while peer.recv(4096)[7:10] != b"\x16\0\0":  # PARAM_VALUE
                        pass
                assert fills.is_alive()
            finally:
                os.close(disk)  # who waits for it gets an error


def test_a_log_ends_although_the_disk_had_no_room_for_its_packets(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port, reached, stall = free_port(), threading.Event(), threading.Event()
    with (
        RehearsalVehicle(f"udpin:127.0.0.1:{port}", backlog=10, close_s=0.0) as daemon,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer,
    ):
        recorder = daemon.link.recorder
        write = recorder.write

        def stalled(packet: bytes, now_ns: int) -> None:
            reached.set()
            stall.wait(20.0)
            write(packet, now_ns)

        monkeypatch.setattr(recorder, "write", stalled)
        daemon.link.record(tmp_path / "link.tlog", 0)
        peer.connect(("127.0.0.1", port))
        mouth = dialect.MAVLink(None, 255, 190)
        beat = bytes(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(mouth))
        peer.send(beat)
        assert reached.wait(20.0)
        for _ in range(100):
            peer.send(beat)
        until(lambda: daemon.link.report().links[0].received_bytes > 100 * len(beat))
        daemon.link.record(None)
        stall.set()

        def is_closed() -> bool:
            before = recorder.packets
            write(beat, 0)
            return recorder.packets == before

        until(is_closed)


class LogPort:
    """A recorded .tlog as a serial line: replayed at its pace; sent data is discarded."""

    is_quick = True

    def __init__(self, spec: LinkSpec) -> None:
        self._file = open(spec.place, "rb")  # noqa: SIM115 - closed by close()
        self._packets = packets(self._file, Counter())
        self._next = next(self._packets)
        self._ahead_ns = time.monotonic_ns() - self._next[0]

    def read(self) -> bytes:
        """The next packet when it is due."""
        wait_s = (self._next[0] + self._ahead_ns - time.monotonic_ns()) * 1e-9
        time.sleep(min(max(wait_s, 0.0), READ_S))
        if wait_s > READ_S:
            return b""
        data = self._next[1].data
        self._next = next(self._packets)
        return data

    def write(self, data: bytes) -> None:
        """Discard."""

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def test_a_recorded_flight_comes_in_as_if_it_flew_now(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(PORTS, "serial", LogPort)
    turn = DATA / "mavlink" / "arducopter_turn.tlog"
    recorded = load_telemetry(turn).history
    began = (recorded.first_ns or 0) + 2 * S
    with RehearsalVehicle(f"serial:{turn}") as daemon:
        history = daemon.link.history
        until(lambda: (history.last_ns or 0) - (history.first_ns or 0) > 3 * S)
        start = history.first_ns
        assert start is not None and daemon.link.report().autopilot == (1, 1)
        live = history.state_at(start + 2 * S)
    kept = recorded.state_at(began)
    assert live is not None and kept is not None
    assert live.alt_agl_m == pytest.approx(kept.alt_agl_m, abs=0.1)
    assert live.q_ned_body_wxyz is not None and kept.q_ned_body_wxyz is not None
    assert abs(float(live.q_ned_body_wxyz @ kept.q_ned_body_wxyz)) > 0.9999
    with RehearsalVehicle(f"serial:{tmp_path / 'none.tlog'}") as daemon:
        until(lambda: "No such file" in daemon.link.report().links[0].last_error)


def test_a_full_disk_ends_the_log_and_nothing_else(caplog: pytest.LogCaptureFixture) -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("no /dev/full here")
    recorder = TlogRecorder()
    recorder.open(full, 0)
    for k in range(3000):
        recorder.write(bytes(40), k)
    recorder.close()
    assert "telemetry log" in caplog.text


def test_a_log_is_written_through_while_it_grows(tmp_path: Path) -> None:
    """So that a power cut costs its last seconds only."""
    port, log = free_port(), tmp_path / "link.tlog"
    with (
        RehearsalVehicle(f"udpin:127.0.0.1:{port}") as daemon,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer,
    ):
        daemon.link.record(log, 0)
        peer.connect(("127.0.0.1", port))
        beat = dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(
            dialect.MAVLink(None, 255, 1)
        )
        peer.send(bytes(beat))
        until(lambda: bytes(beat) in log.read_bytes())


def test_odometry_time_is_the_autopilots(tmp_path: Path) -> None:
    with RehearsalVehicle() as daemon:
        assert daemon.link.boot_time_us(time.monotonic_ns()) is None
    assert math.isnan(daemon.control.state.speed_m_s)
