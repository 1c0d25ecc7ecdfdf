"""Whatever comes in: nothing raises or hangs, the state stays right, faults are reported once."""

from __future__ import annotations

import contextlib
import math
import os
import random
import socket
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from loopback import until
from rehearsal import RehearsalVehicle

from mavlink.component.control import Phase
from mavlink.telemetry.clock import computer_offset_ns
from mavlink.wire.dialect import dialect
from mavlink.wire.framing import Framer
from mavlink.wire.signing import timestamp_of
from mavlink.wire.tlog import TlogRecorder

REPEATS = 20
STATION = (255, 190)


class Peer:
    """The other end of a UDP link; keeps what it hears."""

    def __init__(self, vehicle: RehearsalVehicle, port: int) -> None:
        self.vehicle = vehicle
        self.texts: Counter[str] = Counter()
        self.acks: list[tuple[int, int]] = []  # command and result
        self.mouths: dict[tuple[int, int], Any] = {}
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))
        self._socket.settimeout(0.05)
        self._framer, self._ear = Framer(), dialect.MAVLink(None)

    def close(self) -> None:
        self._socket.close()

    def packed(self, message: Any, source: tuple[int, int] = STATION) -> bytes:
        return bytes(message.pack(self.mouths.setdefault(source, dialect.MAVLink(None, *source))))

    def send(self, data: bytes) -> None:
        for at in range(0, len(data), 1400):
            self._socket.send(data[at : at + 1400])

    def say(self, message: Any, source: tuple[int, int] = STATION) -> None:
        self.send(self.packed(message, source))

    def beat(self, system: int, component: int = 1, token: int = 0) -> None:
        kind, autopilot = (2, 3) if component == 1 else (18, 8)
        beat = dialect.MAVLink_heartbeat_message(kind, autopilot, 0, token, 4, 3)
        self.say(beat, (system, component))

    def listen(self) -> None:
        with contextlib.suppress(TimeoutError):
            for packet in self._framer.feed(self._socket.recv(65536)):
                message = self._ear.decode(bytearray(packet.data)) if packet.known else None
                if message is not None and message.get_type() == "STATUSTEXT":
                    self.texts[message.text] += 1
                elif message is not None and message.get_type() == "COMMAND_ACK":
                    self.acks.append((message.command, message.result))

    def until(self, done: Callable[[], bool]) -> None:
        def heard() -> bool:
            self.listen()
            return done()

        until(heard, progress=lambda: (len(self.acks), dict(self.texts)))

    def order(self, number: int, component: int, *params: float, system: int = 1) -> None:
        values = [*params, *[0.0] * (7 - len(params))]
        self.say(dialect.MAVLink_command_long_message(system, component, number, 0, *values))

    def works(self) -> None:
        """The companion answers an order, and is scanning by it."""
        self.acks.clear()
        self.order(2500, 100, system=self.vehicle.link.presence.system)
        self.until(lambda: (2500, 0) in self.acks)
        assert self.vehicle.control.state.phase is Phase.SCANNING


@pytest.fixture
def peer() -> Iterator[Peer]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with RehearsalVehicle(f"udpin:127.0.0.1:{port}") as vehicle:
        other = Peer(vehicle, port)
        with contextlib.closing(other):
            yield other


def random_bytes(peer: Peer, k: int) -> None:
    peer.send(os.urandom(1 + 60 * k))


def truncated(peer: Peer, k: int) -> None:
    whole = peer.packed(dialect.MAVLink_command_long_message(1, 100, 2501, 0, *[0.0] * 7))
    peer.send(whole[: k % len(whole)])


def oversized(peer: Peer, k: int) -> None:
    peer.send(b"\xfd\xff\x00\x00" + bytes([k]) + b"\xff\xbe\x4c\x00\x00" + b"\x11" * 1300)


def wrong_crc(peer: Peer, k: int) -> None:
    data = bytearray(peer.packed(dialect.MAVLink_command_long_message(1, 100, 2501, 0, *[0.0] * 7)))
    data[-1 - k % 2] ^= 1 << k % 8
    peer.send(bytes(data))


def unknown_ids(peer: Peer, k: int) -> None:
    number = random.Random(k).randrange(60_000, 2**24).to_bytes(3, "little")
    peer.send(bytes((0xFD, 5, 0, 0, k, 255, 190)) + number + b"12345\xab\xcd")


def other_targets(peer: Peer, k: int) -> None:
    peer.order(2501, (1, 100, 154, 191)[k % 4], system=7)
    peer.order(2501, 154)


def not_a_number(peer: Peer, k: int) -> None:
    nan, component = math.nan, (100, 191)[k % 2]
    peer.order((206, 31010, 2000, 526, 246, 511, 512, 203)[k % 8], component, *[nan] * 7)
    peer.say(dialect.MAVLink_param_set_message(1, 191, b"SR_BASELINE_M", nan, 9))
    peer.say(dialect.MAVLink_attitude_message(1000 + k, nan, nan, nan, nan, nan, nan), (1, 1))


def huge_values(peer: Peer, k: int) -> None:
    huge = (3.4e38, -3.4e38, math.inf)[k % 3]
    peer.order((206, 2000, 511, 512, 526, 31010)[k % 6], (100, 191)[k % 2], *[huge] * 7)
    peer.say(dialect.MAVLink_param_set_message(1, 191, b"SR_BASELINE_M", huge, 9))
    top = 2**31 - 1
    place = dialect.MAVLink_global_position_int_message(2**32 - 1, top, top, top, top, 0, 0, 0, 0)
    peer.say(place, (1, 1))


BAD: dict[str, Callable[[Peer, int], None]] = {
    "random bytes": random_bytes,
    "truncated packets": truncated,
    "oversized packets": oversized,
    "wrong CRC": wrong_crc,
    "unknown ids": unknown_ids,
    "commands to another target": other_targets,
    "NaN": not_a_number,
    "huge values": huge_values,
}


@pytest.mark.parametrize("name", list(BAD))
def test_bad_bytes_change_nothing(peer: Peer, name: str, caplog: pytest.LogCaptureFixture) -> None:
    peer.beat(1)
    for k in range(REPEATS):
        BAD[name](peer, k)
    time.sleep(0.05)
    if name != "NaN":  # a photo by default values is no wrong
        assert "start_scan" not in peer.vehicle.control.asked
    peer.works()
    peer.works()  # twice is once
    assert peer.vehicle.control.asked.count("start_scan") == 1
    assert peer.vehicle.link.parameters()["SR_BASELINE_M"] == 0.0
    answers = ("refused", "unknown action")  # one for each order
    others = [count for text, count in peer.texts.items() if not any(a in text for a in answers)]
    assert all(count == 1 for count in others), peer.texts
    assert sum(peer.texts.values()) <= 2 * REPEATS
    assert "fault while serving" not in caplog.text


def test_stop_without_start_and_start_twice(peer: Peer) -> None:
    for _ in range(3):
        peer.order(2501, 100)
        peer.until(lambda: (2501, 0) in peer.acks)
        peer.acks.clear()
    assert set(peer.vehicle.control.asked) == {"stop_scan"}  # it stops whatever is wanted
    peer.vehicle.control.asked.clear()
    peer.works()
    peer.works()
    assert peer.vehicle.control.asked == ["start_scan"] and not peer.texts


def test_two_autopilots_and_a_second_companion_are_reported_once(peer: Peer) -> None:
    for k in range(REPEATS):
        peer.beat(1)
        peer.beat(2)
        peer.beat(1, 191, token=1000 + k)
    peer.until(lambda: len(peer.texts) >= 3)  # two texts, one of them in two pieces
    for _ in range(REPEATS):
        peer.beat(2)
        peer.beat(1, 191, token=1)
    peer.works()
    assert all(count == 1 for count in peer.texts.values()), peer.texts
    assert any("Several autopilots" in text for text in peer.texts)
    assert any("Another companion" in text for text in peer.texts)


def test_a_reboot_of_the_autopilot_in_mid_scan_is_reported_once(peer: Peer) -> None:
    peer.works()
    peer.beat(1)
    for boot in (900_000, 900_020, 900_040, 1_000, 1_020, 1_040):
        for _ in range(3):
            message = dialect.MAVLink_attitude_message(boot, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0)
            peer.say(message, (1, 1))
    peer.until(lambda: any("Autopilot restarted" in text for text in peer.texts))
    peer.works()
    assert peer.vehicle.control.state.phase is Phase.SCANNING
    assert list(peer.texts.values()) == [1]
    last, history = time.monotonic_ns(), peer.vehicle.link.history
    assert history.last_ns is not None and abs(history.last_ns - last) < 10**10


def test_steps_of_the_clock_tear_neither_the_log_nor_the_telemetry(
    peer: Peer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder, now = TlogRecorder(), time.time_ns()
    recorder.open(tmp_path / "link.tlog", computer_offset_ns())
    recorder.write(b"a" * 12, time.monotonic_ns())
    peer.works()
    peer.beat(1)
    for step_s in (-86_400, 10 * 86_400, -3 * 86_400):
        monkeypatch.setattr(time, "time_ns", lambda step_s=step_s: now + step_s * 10**9)
        recorder.write(b"a" * 12, time.monotonic_ns())
        attitude = dialect.MAVLink_attitude_message(5_000, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0)
        peer.say(attitude, (1, 1))
        peer.works()
    recorder.close()
    data = (tmp_path / "link.tlog").read_bytes()
    stamps = [int.from_bytes(data[at : at + 8], "big") for at in range(0, len(data), 20)]
    assert len(stamps) == 4 and stamps == sorted(stamps)
    assert stamps[-1] - stamps[0] < 60_000_000
    last = peer.vehicle.link.history.last_ns
    assert last is not None and 0 <= time.monotonic_ns() - last < 10**10


def test_replayed_signed_packets_are_ignored(tmp_path: Path) -> None:
    key = bytes(range(32))
    path = tmp_path / "key"
    path.write_bytes(key)
    path.chmod(0o600)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with RehearsalVehicle(f"udpin:127.0.0.1:{port}", signing_key=path) as vehicle:
        peer = Peer(vehicle, port)
        with contextlib.closing(peer):
            mouth = peer.mouths[STATION] = dialect.MAVLink(None, *STATION)
            mouth.signing.secret_key, mouth.signing.sign_outgoing = key, True
            mouth.signing.timestamp = timestamp_of(time.time_ns())
            pause = dialect.MAVLink_command_long_message(1, 191, 31010, 0, 1, *[0.0] * 6)
            recorded = peer.packed(pause)
            peer.works()
            for _ in range(REPEATS):
                peer.send(recorded)  # older than what was heard since
            until(lambda: vehicle.link.report().unverified == REPEATS)
            peer.works()
            assert vehicle.control.asked == ["start_scan"] and not peer.texts
