"""Heartbeats go on while a thread keeps the interpreter's lock, and end with the service."""

from __future__ import annotations

import ctypes
import select
import socket
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil  # type: ignore[import-untyped]
import pytest
from loopback import until
from rehearsal import RehearsalControl

from mavlink.component.presence import Health
from mavlink.component.vehicle import VehicleConfig, VehicleLink
from mavlink.wire.dialect import dialect
from mavlink.wire.first_beat import FirstBeats
from mavlink.wire.framing import Framer, Packet
from mavlink.wire.messages import OutgoingMessage, Packer
from mavlink.wire.signing import Signing
from mavlink.wire.stand_in import Beat, StandIn

SO_TIMESTAMPNS = 35
HELD_S = 3.0
usleep = ctypes.PyDLL(None).usleep  # a PyDLL's call keeps the interpreter's lock


class Ear:
    """Hears heartbeats, with the kernel's time of each."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(20.0)
        self.link = f"udpout:127.0.0.1:{self.socket.getsockname()[1]}"
        self._framer = Framer()

    def heard(self, until_: Callable[[list[tuple[float, Packet]]], bool]) -> list[Packet]:
        """The companion's heartbeats until those satisfy a condition."""
        found: list[tuple[float, Packet]] = []
        while not until_(found):
            data, ((_, _, stamp), *_), _, _ = self.socket.recvmsg(65536, 64)
            seconds, nanoseconds = struct.unpack("@qq", stamp)
            for packet in self._framer.feed(data):
                if (packet.message_id, packet.component) == (0, 191):
                    found.append((seconds + 1e-9 * nanoseconds, packet))
        return [packet for _, packet in found]

    def close(self) -> None:
        self.socket.close()


@pytest.fixture
def ear() -> Iterator[Ear]:
    ear = Ear()
    yield ear
    ear.close()


def heard_while_the_lock_is_held(ear: Ear) -> tuple[list[Packet], list[Packet]]:
    """Those that came meanwhile, and all up to one that came later."""
    during: list[Packet] = []
    ear.heard(lambda found: len(found) > 2)  # the port was open at the second
    usleep(round(1e6 * HELD_S))
    free_s = time.time()

    def is_over(found: list[tuple[float, Packet]]) -> bool:
        during[:] = [packet for at_s, packet in found if at_s < free_s]
        return len(found) > len(during)

    return during, ear.heard(is_over)


@pytest.mark.parametrize("is_signed", [False, True])
def test_heartbeats_go_on_while_a_thread_keeps_the_lock(
    ear: Ear, is_signed: bool, tmp_path: Path
) -> None:
    key = tmp_path / "key"
    key.write_bytes(bytes(range(32)))
    key.chmod(0o600)
    config = VehicleConfig((ear.link,), signing_key=key if is_signed else None, stand_in=True)
    link = VehicleLink(config, RehearsalControl())
    link.set_health(Health.ACTIVE)
    link.start()
    try:
        during, all_ = heard_while_the_lock_is_held(ear)
    finally:
        link.stop()
    assert len(during) > 0
    assert all_[-1].data[4] > during[-1].data[4]  # ours count what it has sent
    if is_signed:
        hearer = Signing(bytes(range(32)))
        assert all(hearer.accepts(packet) for packet in all_)


def test_the_first_heartbeats_go_on_too(ear: Ear) -> None:
    first = FirstBeats((ear.link,), 1, 4711)
    first.start()
    assert until(lambda: first.stand_in is not None)
    try:
        during, all_ = heard_while_the_lock_is_held(ear)
    finally:
        for link in first.hand_over():
            link.stop()
        assert first.stand_in is not None
        first.stand_in.close()
    assert len(during) > 0
    assert all_[-1].data[4] > during[-1].data[4]


def test_a_newer_plan_replaces_one_and_the_process_ends_with_its_owner(ear: Ear) -> None:
    before = set(psutil.Process().children())
    stand_in = StandIn()
    (process,) = set(psutil.Process().children()) - before
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mouth, socket.socketpair()[0] as end:
        to = ("127.0.0.1", int(ear.link.rpartition(":")[2]))
        way = mouth.fileno(), to
        far = time.monotonic() + 600.0
        ways = [way, (-1, to), (end.fileno(), None)]
        beats: list[Beat] = [(0.0, [((-1, to), b"closed"), (way, b"a")]), (far, [(way, b"b")])]
        stand_in.plan(beats, lambda: ways)
        assert until(lambda: stand_in.sent() == 1)
        stand_in.plan([(0.0, [(way, b"c")])], lambda: ways)
        assert until(lambda: stand_in.sent() == 1)
        stand_in.plan([(far, [((end.fileno(), None), b"d")])], lambda: ways)
    heard = [ear.socket.recv(10) for _ in range(2)]
    assert heard == [b"a", b"c"]
    stand_in.close()
    assert not process.is_running()
    stand_in.plan([(0.0, [])], list)  # says nothing: it has ended
    assert stand_in.sent() == 0


def test_a_port_that_was_closed_meanwhile_costs_no_other_file_a_byte(
    ear: Ear, tmp_path: Path
) -> None:
    """Its number was another file's by the time that the process got it."""
    stand_in = StandIn()
    try:
        with (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mouth,
            open(tmp_path / "other", "wb") as other,
        ):
            way = mouth.fileno(), ("127.0.0.1", int(ear.link.rpartition(":")[2]))
            closed = other.fileno(), None
            stand_in.plan([(0.0, [(closed, b"beat"), (way, b"sent")])], lambda: [way])
            assert ear.socket.recv(10) == b"sent"
    finally:
        stand_in.close()
    assert (tmp_path / "other").read_bytes() == b""


def test_it_ends_in_silence_though_its_last_answers_were_not_read(
    capfd: pytest.CaptureFixture[str],
) -> None:
    stand_in = StandIn()
    stand_in.plan([(0.0, [])], list)
    assert select.select([stand_in._channel], [], [], 20.0)[0]
    stand_in.close()
    assert capfd.readouterr() == ("", "")


def test_a_process_that_does_not_start_or_ends_is_said_and_costs_nothing_else(
    caplog: pytest.LogCaptureFixture,
) -> None:
    before = set(psutil.Process().children())
    stand_in = StandIn()
    (process,) = set(psutil.Process().children()) - before
    process.kill()

    def is_said() -> bool:
        stand_in.plan([], list)
        return "has ended with -9" in caplog.text

    assert until(is_said)
    assert not process.is_running() and stand_in.sent() == 0
    stand_in.plan([], list)
    stand_in.close()
    assert len(caplog.records) == 1
    stand_in = StandIn("/nowhere/python")
    stand_in.plan([], list)
    assert "does not start" in caplog.text and stand_in.sent() == 0
    stand_in.close()
    assert len(caplog.records) == 2


def test_a_process_that_is_stopped_does_not_hold_up_the_end() -> None:
    before = set(psutil.Process().children())
    stand_in = StandIn()
    (process,) = set(psutil.Process().children()) - before
    process.suspend()
    stand_in.close()
    assert not process.is_running()


def test_what_the_process_sent_counts_before_our_first_packet_too() -> None:
    packer = Packer(0, None, 7)
    packer.skip(2)
    beat = OutgoingMessage(191, dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 3, 3))
    data = packer.pack(1, beat, 0)
    assert data is not None and data[4] == 9


def test_heartbeats_packed_ahead_are_accepted_while_the_clock_is_behind_the_last_flight() -> None:
    """A computer without a battery for its clock: times of signing go on from the last one."""
    signing, hearer = Signing(bytes(32), 10_000_000), Signing(bytes(32))
    packer = Packer(0, signing)
    beat = OutgoingMessage(191, dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 3, 3))
    sent = [packer.pack(1, beat, 0, ahead) for ahead in (None, 0, 1, 2)]
    packer.skip(3)
    sent.append(packer.pack(1, beat, 0))
    (*packets,) = Framer().feed(b"".join(filter(None, sent)))
    assert len(packets) == 5 and all(hearer.accepts(packet) for packet in packets)
    assert [packet.data[4] for packet in packets] == [0, 1, 2, 3, 4]


def test_a_service_that_stops_planning_falls_silent(ear: Ear) -> None:
    stand_in = StandIn()
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mouth:
            way = mouth.fileno(), ("127.0.0.1", int(ear.link.rpartition(":")[2]))
            stand_in.plan([(0.0, [(way, bytes([n]))]) for n in range(3)], lambda: [way])
            sent = 0
            while sent < 3:
                sent += stand_in.sent()
            mouth.sendto(b"end", way[1])
        assert [ear.socket.recv(10) for _ in range(4)] == [b"\0", b"\1", b"\2", b"end"]
    finally:
        stand_in.close()
