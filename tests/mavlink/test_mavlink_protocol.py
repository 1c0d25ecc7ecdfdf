"""Hostile packets, identity, clocks and rates: nothing raises and the state stays right."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import pytest
from autopilot import attitude, beat, packed
from hypothesis import given, settings
from hypothesis import strategies as st
from rehearsal import RehearsalControl

from mavlink.component.autopilot_link import LOOK_NS, RateKeeper
from mavlink.component.camera import KeyframeReport
from mavlink.component.companion import Companion, CompanionConfig
from mavlink.component.control import Answer, Result
from mavlink.component.parameters import Parameter
from mavlink.component.presence import Health, Presence, PresenceConfig
from mavlink.telemetry.clock import BootClock, BootCounter, TimesyncFilter, fit_boot
from mavlink.telemetry.history import VehicleHistory
from mavlink.wire.dialect import CRC_EXTRA, dialect, x25crc
from mavlink.wire.framing import Framer
from mavlink.wire.messages import Address, OutgoingMessage, Packer

MS = 1_000_000
S = 1_000_000_000


class Station:
    """A companion with a clock of its own that the test moves."""

    def __init__(self, system: int | None = None) -> None:
        self.now_ns = 50 * S
        self.control = RehearsalControl()
        self.presence = Presence(PresenceConfig(system=system), 4711, self.now_ns)
        self.history = VehicleHistory()
        self.companion = Companion(
            CompanionConfig(), self.control, self.presence, self.history, self.now_ns
        )
        self.framer = Framer()
        self.sent: list[OutgoingMessage] = []

    def feed(self, data: bytes, link: int = 0) -> None:
        for packet in self.framer.feed(data):
            self.companion.receive(link, packet, self.now_ns)

    def wait(self, seconds: float) -> list[OutgoingMessage]:
        self.now_ns += round(seconds * S)
        self.companion.tick(self.now_ns)
        out = self.companion.take()
        self.sent += out
        return out

    def texts(self) -> list[str]:
        raw = [o.message.text for o in self.sent if o.message.get_type() == "STATUSTEXT"]
        return [t.decode() if isinstance(t, bytes) else t for t in raw]


# Any bytes


@settings(max_examples=200)
@given(st.lists(st.binary(max_size=300), max_size=8))
def test_any_bytes_are_survived(chunks: list[bytes]) -> None:
    station = Station()
    for chunk in chunks:
        station.feed(chunk)
        station.wait(0.1)
    assert station.control.asked == []


def with_any_payload(message_id: int, payload: bytes, source: tuple[int, int]) -> bytes:
    head = bytes((0xFD, len(payload), 0, 0, 0, *source)) + message_id.to_bytes(3, "little")
    body = head + payload
    crc: int = x25crc(body[1:] + bytes((CRC_EXTRA[message_id],))).crc
    return body + crc.to_bytes(2, "little")


@pytest.mark.parametrize("seed", range(4))
def test_right_checksums_around_any_payload_of_any_message(seed: int) -> None:
    """A hostile or confused sender: every message, random content."""
    rng = random.Random(seed)
    station = Station()
    station.feed(packed(beat()))
    numbers = [n for n in dialect.mavlink_map if n not in (0, 76, 75)]
    for _ in range(2):
        for number in numbers:
            payload = rng.randbytes(rng.choice([0, 1, 8, 40, 255]))
            station.feed(with_any_payload(number, payload, rng.choice([(1, 1), (255, 190)])))
        station.wait(1.0)
        state = station.history.state_at(station.now_ns)
        assert state is None or state.sources
    assert station.framer.skipped_bytes == 0


def test_unknown_messages_are_left() -> None:
    station = Station()
    head = bytes((0xFD, 4, 0, 0, 0, 1, 1)) + (60_000).to_bytes(3, "little")
    station.feed(head + b"abcd" + b"\0\0")
    assert station.companion.take() == []
    station.feed(packed(attitude(1)))
    assert len(station.history) == 1


# Who we are


@pytest.mark.parametrize("system", [1, 7, 42])
def test_we_take_the_id_of_the_one_autopilot(system: int) -> None:
    station = Station()
    assert station.presence.system == 1
    station.feed(packed(beat(), (system, 1)))
    assert station.presence.system == system
    station.wait(4.0)
    station.feed(packed(beat(), (99, 1)))  # another vehicle comes by later
    station.feed(packed(beat(), (99, 1)))
    assert station.presence.system == system and station.presence.autopilot == (system, 1)


def test_two_autopilots_at_once_are_reported_once_and_none_is_taken() -> None:
    station = Station()
    for _ in range(5):
        for system in (5, 6):
            station.feed(packed(beat(), (system, 1)))
        station.wait(1.0)
    assert station.presence.system == 1 and station.presence.autopilot is None
    assert len([t for t in station.texts() if "Several autopilots" in t]) == 1


def test_a_system_that_was_given_stands() -> None:
    station = Station(system=12)
    station.feed(packed(beat(), (5, 1)))
    assert station.presence.system == 12 and station.presence.autopilot is None
    station.feed(packed(beat(armed=True), (12, 1)))
    assert station.presence.autopilot == (12, 1) and station.presence.is_armed


def test_ground_stations_and_gimbals_are_no_autopilots() -> None:
    station = Station()
    gcs = dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    station.feed(packed(gcs, (255, 190)))
    gimbal = dialect.MAVLink_heartbeat_message(26, 8, 0, 0, 4, 3)
    station.feed(packed(gimbal, (3, 154)))
    assert station.presence.system == 1 and station.presence.autopilot is None


def test_a_second_companion_is_reported_once_and_our_own_echo_is_not_one() -> None:
    station = Station()
    station.feed(packed(beat(), (1, 1)))
    own = dialect.MAVLink_heartbeat_message(18, 8, 0, 4711, 4, 3)
    station.feed(packed(own, (1, 191)))
    station.wait(1.0)
    assert station.texts() == []
    other = dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
    for _ in range(10):
        station.feed(packed(other, (1, 191)))
        station.wait(35.0)
        station.presence.confirm(Health.ACTIVE, station.now_ns)
    assert len([t for t in station.texts() if "Another companion" in t]) == 1


def test_a_wrong_configuration_is_refused() -> None:
    with pytest.raises(ValueError, match="1 to 255"):
        PresenceConfig(system=0)
    with pytest.raises(ValueError, match="stale_s"):
        PresenceConfig(stale_s=30.0)
    with pytest.raises(ValueError, match="16 ASCII"):
        Parameter("MUCH_TOO_LONG_A_NAME", 0, 0, 1, "")
    with pytest.raises(ValueError, match="out of range"):
        Parameter("A", 2, 0, 1, "")


# Time


def test_the_boot_counter_knows_wraps_reboots_and_stragglers() -> None:
    counter = BootCounter()
    assert counter.unwrap(2**32 - 100) == 2**32 - 100
    assert counter.unwrap(50) == 2**32 + 50
    assert counter.unwrap(2**32 - 60) == 2**32 - 60  # came late
    assert counter.unwrap(90) == 2**32 + 90 and counter.session == 0
    assert counter.unwrap(10) == 2**32 + 10
    rebooting = BootCounter()
    rebooting.unwrap(500_000)
    assert rebooting.unwrap(1_200) == 1_200 and rebooting.session == 1
    assert rebooting.unwrap(1_100) == 1_100 and rebooting.session == 1


def test_the_offset_of_a_log_follows_drift_and_ignores_delays() -> None:
    rng = np.random.default_rng(0)
    boot_ms = np.arange(0, 600_000, 50.0)
    truth = boot_ms * (1 + 80e-6) * 1e6 + 7e12
    stamps = truth + rng.exponential(40e6, len(boot_ms))
    fit = fit_boot([round(s) for s in stamps], list(boot_ms))
    errors = [fit.from_boot(b * 1e6) - t for b, t in zip(boot_ms, truth, strict=True)]
    assert np.abs(errors).max() < 5e6  # 5 ms of jitter of 40 ms, over 48 ms of drift
    assert fit.is_real_time and fit.from_stamp(12345) == 12345


def test_the_live_clock_never_dates_a_sample_after_its_arrival() -> None:
    rng = random.Random(3)
    clock = BootClock()
    late = []
    for k in range(4000):
        truth = 10 * S + k * 20 * MS
        arrival = truth + round(rng.expovariate(1 / (30 * MS)))
        got = clock.time_of(1000 + k * 20 * (1 - 50e-6), arrival)
        assert got <= arrival
        late.append(got - truth)
    assert abs(np.median(late[500:])) < 2 * MS and max(late[500:]) < 8 * MS


def test_the_attitude_of_a_gimbal_is_not_the_vehicles() -> None:
    station = Station()
    station.feed(packed(beat()))
    for k in range(20):
        station.feed(packed(attitude(1_000 + 50 * k, 0.1)))
        station.feed(packed(attitude(77_000 + 50 * k, -1.0), (1, 154)))
        station.wait(0.05)
    assert {round(q.q_ned_body[1], 3) for q, _ in station.history.attitudes()} == {0.05}


def test_timesync_of_an_autopilot_that_is_up_for_months() -> None:
    clock = BootClock()
    wraps = 3 * 2**32 * MS
    arrival, boot_ns = 900 * S, 5_000 * S + wraps  # the message shows only the lower 32 bits
    assert clock.time_of(boot_ns // MS % 2**32, arrival + 30 * MS) == arrival + 30 * MS
    clock.set_timesync(arrival - boot_ns)
    assert clock.time_of(boot_ns // MS % 2**32 + 100, arrival + 150 * MS) == arrival + 100 * MS


def test_an_autopilot_that_restarts_starts_the_history_over() -> None:
    station = Station()
    station.feed(packed(beat()))
    for k in range(50):
        station.feed(packed(attitude(100_000 + 20 * k)))
        station.wait(0.02)
    before = station.now_ns
    assert station.history.state_at(before - 100 * MS) is not None
    station.wait(2.0)
    for k in range(20):
        station.feed(packed(attitude(800 + 20 * k)))
        station.wait(0.02)
    assert station.history.state_at(before - 100 * MS) is None
    assert station.history.state_at(station.now_ns - 100 * MS) is not None
    assert [t for t in station.texts() if "restarted" in t] == [
        "Autopilot restarted; telemetry starts over"
    ]


def test_a_scan_goes_on_through_a_restart_and_a_loss_of_the_autopilot() -> None:
    station = Station()
    station.feed(packed(beat()))
    start = dialect.MAVLink_command_long_message(1, 100, 2500, 0, 0, 0, 0, 0, 0, 0, 0)
    station.feed(packed(start, (255, 190)))
    station.wait(10.0)
    assert "Telemetry lost" in station.texts()
    station.feed(packed(beat()))
    station.wait(1.0)
    assert "Telemetry recovered" in station.texts()
    assert station.control.state.is_recording
    station.wait(20.0)
    assert station.texts().count("Telemetry lost") == 1  # held back


class Remote:
    """An autopilot's clock behind a link with delays."""

    def __init__(self, rng: random.Random, skew: float, delay_ms: float, jitter_ms: float) -> None:
        self.rng, self.skew = rng, skew
        self.delay_ns, self.jitter_ns = delay_ms * MS, jitter_ms * MS
        self.boot_ns = 30 * S

    def at(self, ours: float) -> int:
        return self.boot_ns + round(ours * (1 + self.skew))

    def leg(self) -> float:
        return self.delay_ns + self.rng.expovariate(1.0) * self.jitter_ns


@pytest.mark.parametrize(("delay_ms", "jitter_ms"), [(0.3, 0.2), (3.0, 2.0), (60.0, 20.0)])
def test_timesync_converges_on_fast_and_slow_links(delay_ms: float, jitter_ms: float) -> None:
    remote = Remote(random.Random(1), 20e-6, delay_ms, jitter_ms)
    sync = TimesyncFilter()
    now = 5 * S
    errors = []
    for _ in range(400):
        now += S
        request: Any = sync.request(now)
        assert request is not None
        there = now + remote.leg()
        back = round(there + remote.leg())
        sync.answer(remote.at(there), request.ts1, back)
        if sync.offset_ns is not None:
            errors.append(abs(sync.offset_ns - (back - remote.at(back))))
        now = back
    assert sync.resets == 0
    assert np.percentile(errors[100:], 95) < (0.3 + 0.4 * jitter_ms) * MS


def test_timesync_takes_only_answers_to_its_own_questions() -> None:
    sync = TimesyncFilter()
    request: Any = sync.request(5 * S)
    assert sync.request(5 * S) is None  # not yet again
    assert not sync.answer(1_000, request.ts1 + 1, 5 * S)
    assert not sync.answer(0, request.ts1, 5 * S)
    assert not sync.answer(1_000, request.ts1, 5 * S + 10 * S)  # far too late
    assert not sync.answer(1_000, request.ts1, 5 * S)  # answered before


def test_timesync_asks_the_autopilot_alone_and_on_its_link() -> None:
    """Bytes 16 and 17 of the payload are target system and component (common.xml)."""
    station = Station()

    def asked() -> list[tuple[int | None, bytes]]:
        out = [o for o in station.wait(1.5) if o.message.get_type() == "TIMESYNC"]
        return [(o.link, packed(o.message)[26:-2]) for o in out]

    station.feed(packed(beat()), link=1)
    assert set(asked()) == {(1, b"\x01\x01")}
    station.feed(packed(beat(), (7, 1)), link=0)  # which of the two is ours?
    assert set(asked()) == {(None, b"")}


def test_a_targeted_question_is_read_by_pymavlink() -> None:
    request: Any = TimesyncFilter().request(5 * S, Address(1, 1))
    (heard,) = dialect.MAVLink(None).parse_buffer(packed(request, (1, 191)))
    assert (heard.get_type(), heard.tc1, heard.ts1) == ("TIMESYNC", 0, 5 * S)
    assert packed(request)[26:-2] == b"\x01\x01"


def test_timesync_starts_over_after_five_contradictions() -> None:
    sync = TimesyncFilter()
    now = 5 * S

    def round_trip(boot_minus_ours_ns: int) -> bool:
        nonlocal now
        now += S
        request: Any = sync.request(now)
        return sync.answer(now + MS // 2 + boot_minus_ours_ns, request.ts1, now + MS)

    for _ in range(30):
        assert round_trip(2 * S)
    assert sync.offset_ns == -2 * S
    for _ in range(5):
        assert not round_trip(900 * S)
    assert sync.resets == 1 and sync.offset_ns is None
    for _ in range(20):
        round_trip(900 * S)
    assert sync.offset_ns == -900 * S


def test_timesync_reaches_the_samples_and_questions_are_answered() -> None:
    station = Station()
    station.feed(packed(beat()))
    boot_offset = station.now_ns - 40 * S  # the autopilot booted 40 s ago
    for _ in range(80):
        for out in station.wait(0.1):
            if out.message.get_type() == "TIMESYNC" and out.message.tc1 == 0:
                reply = dialect.MAVLink_timesync_message(
                    station.now_ns - boot_offset + MS, out.message.ts1
                )
                station.now_ns += 2 * MS
                station.feed(packed(reply))
        boot = (station.now_ns - boot_offset) // MS
        station.now_ns += 35 * MS  # telemetry comes late, and evenly so
        station.feed(packed(attitude(boot)))
        station.feed(packed(beat()))
    offset_ns = station.companion.autopilot.boot_offset_ns
    assert offset_ns is not None and abs(offset_ns - boot_offset) < 2 * MS
    station.companion.take()
    station.feed(packed(dialect.MAVLink_timesync_message(0, 123456)))
    (answer,) = [o.message for o in station.companion.take()]
    assert answer.ts1 == 123456 and answer.tc1 == station.now_ns


# Rates


def test_rates_are_asked_for_and_asked_again_when_they_fade() -> None:
    keeper = RateKeeper({"ATTITUDE_QUATERNION": 50.0, "GPS_RAW_INT": 2.0})
    now = 100 * S
    asked = keeper.tick(1, 1, now)
    assert [(m.command, m.param1, m.param2) for m in asked] == [
        (511, 31, 20000),
        (511, 24, 500000),
    ]
    assert keeper.tick(1, 1, now + S) == []
    for _ in range(480):
        keeper.heard("ATTITUDE_QUATERNION")
    now += LOOK_NS
    assert [m.param1 for m in keeper.tick(1, 1, now)] == [24]
    for _ in range(40):  # a ground station slowed it down
        keeper.heard("ATTITUDE_QUATERNION")
    now += LOOK_NS
    assert [m.param1 for m in keeper.tick(1, 1, now)] == [31, 24]
    count = 0
    for _ in range(24):  # what never comes is asked for only now and then
        now += LOOK_NS
        for _ in range(600):
            keeper.heard("ATTITUDE_QUATERNION")
        count += len(keeper.tick(1, 1, now))
    assert count <= 5
    keeper.restart()
    assert len(keeper.tick(1, 1, now + 1)) == 2


# Sending


def test_values_that_do_not_fit_are_dropped_not_raised() -> None:
    packer = Packer(0)
    bad = dialect.MAVLink_named_value_float_message(-5, b"x", 1e300)
    assert packer.pack(1, OutgoingMessage(191, bad), 0) is None
    station = Station()
    for report in (
        KeyframeReport(10**20, 1e30, -1e30, float("nan"), float("inf"), None, False),
        KeyframeReport(-5, None, None, None, None, (1.0, 0.0, 0.0, 0.0)),
    ):
        station.companion.camera.report(report)
    for out in station.companion.take():
        packer.pack(1, out, 0)
    assert packer.pack(1, OutgoingMessage(191, beat()), 0) is not None


def test_sequence_numbers_count_per_component() -> None:
    packer = Packer(0)
    sequences: dict[int, list[int]] = {191: [], 100: []}
    for k in range(300):
        component = 191 if k % 3 else 100
        data = packer.pack(1, OutgoingMessage(component, beat()), 0)
        assert data is not None
        sequences[component].append(data[4])
    for numbers in sequences.values():
        assert numbers == [k % 256 for k in range(len(numbers))]


def test_the_gimbals_frame_is_tuned_in_flight() -> None:
    station = Station()
    assert station.history.config.yaw_frame == "auto"
    message = dialect.MAVLink_param_set_message(1, 191, b"SR_YAW_FRAME", 3.0, 9)
    station.feed(packed(message, (255, 190)))
    assert station.history.config.yaw_frame == "body"
    refused = dialect.MAVLink_param_set_message(1, 191, b"SR_YAW_FRAME", 17.0, 9)
    station.feed(packed(refused, (255, 190)))
    assert station.history.config.yaw_frame == "body"


def test_kept_parameters_are_reported_to_the_service_and_dropped_when_it_refuses() -> None:
    history, control = VehicleHistory(), RehearsalControl()
    control.answers["SR_LINK_KBIT_S"] = Answer(Result.UNSUPPORTED)
    kept = {"SR_YAW_FRAME": 2.0, "SR_BASELINE_M": 2.5, "SR_LINK_KBIT_S": 5.0, "X": 1.0}
    kept["SR_RESOLUTION_M"] = 1e9  # out of range by now
    presence = Presence(PresenceConfig(), 1, 0)
    companion = Companion(CompanionConfig(), control, presence, history, 0, kept)
    companion.announce_kept()
    assert history.config.yaw_frame == "earth"
    assert "SR_BASELINE_M=2.5" in control.asked
    values = companion.parameters.values()
    assert values["SR_BASELINE_M"] == 2.5 and values["SR_LINK_KBIT_S"] == 1000.0
    assert values["SR_RESOLUTION_M"] == 0.0
