"""Every command and every result, two ends joined in memory: no socket, no clock."""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
from held import held_bytes
from rehearsal import RehearsalControl

from mavlink.component.camera import KeyframeReport
from mavlink.component.command_desk import Command
from mavlink.component.commands import COMMANDS
from mavlink.component.companion import IDLE_TICK_S, TICK_S, Companion, CompanionConfig
from mavlink.component.control import Answer, CameraView, Phase, Result, Work
from mavlink.component.metadata import VERSION
from mavlink.component.parameters import PARAMETERS
from mavlink.component.presence import Health, Presence, PresenceConfig
from mavlink.component.status import ComputerLoad
from mavlink.telemetry.history import VehicleHistory
from mavlink.wire.dialect import COMMAND_CANCEL, dialect, x25crc
from mavlink.wire.framing import Framer
from mavlink.wire.messages import Address, Packer

S = 1_000_000_000
MS = 1_000_000
STATION = (255, 190)
NAN = math.nan
ACCEPTED, BUSY, DENIED, UNSUPPORTED, FAILED, RUNNING, CANCELLED = range(7)


class Ends:
    """Our companion on one side, pymavlink as ground station and autopilot on the other."""

    def __init__(self) -> None:
        self.now_ns = 100 * S
        self.control = RehearsalControl()
        self.presence = Presence(PresenceConfig(), 77, self.now_ns)
        self.history = VehicleHistory()
        config = CompanionConfig(motion_every_s=1000.0)
        self.companion = Companion(config, self.control, self.presence, self.history, self.now_ns)
        self.packer = Packer(0)
        self.ears = dialect.MAVLink(None)
        self.ears.robust_parsing = True
        self.mouths: dict[tuple[int, int], Any] = {}
        self.heard: list[Any] = []
        self.framer = Framer()
        self.hear()

    def pass_time(self, seconds: float, step: float = 0.05) -> list[Any]:
        """Let time go by; what the companion sent meanwhile."""
        start = len(self.heard)
        for _ in range(max(1, round(seconds / step))):
            self.now_ns += round(step * S)
            self.companion.tick(self.now_ns)
            self.hear()
        return self.heard[start:]

    def hear(self) -> None:
        for outgoing in self.companion.take():
            data = self.packer.pack(self.presence.system, outgoing, 0)
            assert data is not None, outgoing.message
            self.heard += self.ears.parse_buffer(data) or []

    def say(self, message: Any, source: tuple[int, int] = STATION, link: int = 0) -> list[Any]:
        """Send a message to the companion; its answers."""
        mouth = self.mouths.setdefault(source, dialect.MAVLink(None, *source))
        return self.say_bytes(bytes(message.pack(mouth)), link)

    def say_bytes(self, data: bytes, link: int = 0) -> list[Any]:
        start = len(self.heard)
        for packet in self.framer.feed(data):
            self.companion.receive(link, packet, self.now_ns)
        self.companion.tick(self.now_ns)
        self.hear()
        return self.heard[start:]

    def command(
        self,
        number: int,
        component: int,
        *params: float,
        source: tuple[int, int] = STATION,
        system: int = 1,
        confirmation: int = 0,
        as_int: bool = False,
    ) -> list[int]:
        """Send a command; the results acknowledged, in order."""
        p = [*params, *[0.0] * (7 - len(params))]
        if as_int:
            x, y = (0x7FFFFFFF if math.isnan(v) else int(v) for v in p[4:6])
            message = dialect.MAVLink_command_int_message(
                system, component, 0, number, 0, 0, *p[:4], x, y, p[6]
            )
        else:
            message = dialect.MAVLink_command_long_message(
                system, component, number, confirmation, *p
            )
        answers = self.say(message, source)
        acks = [m for m in answers if m.get_type() == "COMMAND_ACK" and m.command == number]
        for ack in acks:
            assert (ack.target_system, ack.target_component) == source
            if component:
                assert ack.get_srcComponent() == component
            assert ack.get_srcSystem() == self.presence.system
        return [ack.result for ack in acks]

    def arm(self, armed: bool = True, system: int = 1) -> list[Any]:
        """The autopilot's report; what the companion sent then."""
        beat = dialect.MAVLink_heartbeat_message(2, 3, 128 if armed else 0, 0, 4, 3)
        return self.say(beat, (system, 1))

    def disarm(self) -> None:
        """Be disarmed for long enough that it is certainly our autopilot that says so."""
        for _ in range(5):
            self.arm(False)
            self.pass_time(1.0)

    def texts(self) -> list[str]:
        return [m.text for m in self.heard if m.get_type() == "STATUSTEXT"]


def results(messages: Iterable[Any], number: int) -> list[int]:
    """The acknowledgements of a command, in order."""
    acks = [m for m in messages if m.get_type() == "COMMAND_ACK" and m.command == number]
    return [ack.result for ack in acks]


def kinds(messages: Iterable[Any]) -> list[str]:
    return [m.get_type() for m in messages]


@pytest.fixture
def ends() -> Ends:
    return Ends()


# The table


@pytest.mark.parametrize("command", COMMANDS.values())
def test_every_line_of_the_table_keeps_the_contract(command: Command) -> None:
    assert command.components and not command.components - {100, 191}
    assert command.window_s >= 0.0
    assert command.handle.__doc__


@pytest.mark.parametrize("number", sorted(COMMANDS))
def test_no_command_falls_over_any_parameters(number: int) -> None:
    ends = Ends()
    values = [NAN, math.inf, -math.inf, 0.0, -1.0, 1.0, 2.0, 7.5, 1e30, -1e30, 3.4e38]
    rng = random.Random(number)
    for _ in range(60):
        params = [rng.choice(values) for _ in range(7)]
        component = rng.choice([100, 191])
        results = ends.command(number, component, *params)
        assert len(results) >= 1 and results[-1] in (0, 1, 2, 3, 5)
        ends.pass_time(rng.choice([0.1, 4.0]), 1.0)


# Scanning


@pytest.mark.parametrize("as_int", [False, True])
def test_start_and_stop(ends: Ends, as_int: bool) -> None:
    assert ends.command(2500, 100, as_int=as_int) == [ACCEPTED]
    assert ends.control.state.phase is Phase.SCANNING
    status = [m for m in ends.heard if m.get_type() == "CAMERA_CAPTURE_STATUS"][-1]
    assert status.video_status == 1
    assert ends.command(2501, 100, as_int=as_int) == [ACCEPTED]
    assert ends.control.asked == ["start_scan", "stop_scan"]
    status = [m for m in ends.heard if m.get_type() == "CAMERA_CAPTURE_STATUS"][-1]
    assert status.video_status == 0


STOPS = [(2501, 100, ()), (200, 100, (0, 0, 0, 0)), (31010, 191, (8,)), (31010, 191, (5,))]


@pytest.mark.parametrize(("number", "component", "params"), STOPS)
@pytest.mark.parametrize("phase", list(Phase))
def test_every_stop_reaches_the_service_whatever_it_does(
    ends: Ends, phase: Phase, number: int, component: int, params: tuple[float, ...]
) -> None:
    ends.command(2000, 100, 0, 1.0, 0)  # a series of keyframes
    ends.control.state, ends.control.asked = replace(ends.control.state, phase=phase), []
    assert ends.command(number, component, *params) == [ACCEPTED]
    assert ends.control.asked == ["finalise" if params == (5,) else "stop_scan"]
    assert ends.control.state.phase is Phase.IDLE
    ends.pass_time(5.0)
    assert len(ends.control.asked) == 1  # the series ends, too


@pytest.mark.parametrize(("number", "component", "params"), STOPS)
def test_a_stop_repeated_at_once_stops_what_started_meanwhile(
    ends: Ends, number: int, component: int, params: tuple[float, ...]
) -> None:
    ends.command(number, component, *params)
    ends.control.asked.clear()
    ends.control.start_scan()  # by arming
    assert ends.command(number, component, *params) == [ACCEPTED]
    assert ends.control.asked == ["start_scan", "finalise" if params == (5,) else "stop_scan"]


@pytest.mark.parametrize("stop", STOPS)
def test_a_start_after_a_stop_by_another_component_starts(
    ends: Ends, stop: tuple[int, int, tuple[float, ...]]
) -> None:
    number, component, params = stop
    ends.command(2500, 100)
    ends.command(number, component, *params)
    ends.command(2500, 100)
    assert ends.control.asked.count("start_scan") == 2


def test_a_stop_does_not_wait_for_other_work(ends: Ends) -> None:
    ends.control.works["finalise"] = Work()
    assert ends.command(31010, 191, 5) == [RUNNING]
    assert ends.command(2500, 100) == [ACCEPTED]  # the next scan
    assert ends.command(31010, 191, 8) == [ACCEPTED]
    assert ends.control.asked == ["finalise", "start_scan", "stop_scan"]


def test_a_stop_of_what_started_while_files_are_written_is_not_called_rejected(ends: Ends) -> None:
    """Both come from one station, as commands of one number."""
    writes = ends.control.works["finalise"] = Work()
    ends.command(31010, 191, 5)
    stops = ends.control.works["stop_scan"] = Work(is_brief=True)
    assert ends.command(31010, 191, 8) == []
    stops.finish()
    assert results(ends.pass_time(0.1), 31010) == [ACCEPTED]
    writes.finish(Answer(Result.FAILED))
    assert results(ends.pass_time(0.1), 31010) == [FAILED]


def test_a_start_ends_a_pause_and_goes_before_the_next_attempt(ends: Ends) -> None:
    for phase in (Phase.PAUSED, Phase.WAITING):
        ends.pass_time(5.0)
        ends.control.state = replace(ends.control.state, phase=phase)
        assert ends.command(2500, 100) == [ACCEPTED]
        assert ends.control.state.phase is Phase.SCANNING


def test_starting_twice_is_one_start_and_stop_without_start_is_fine(ends: Ends) -> None:
    assert ends.command(2501, 100) == [ACCEPTED]
    ends.control.asked.clear()
    assert ends.command(2500, 100) == [ACCEPTED]
    ends.pass_time(5.0)
    assert ends.command(2500, 100) == [ACCEPTED]
    assert ends.control.asked == ["start_scan"]


def test_start_stop_start_within_the_window_starts_again(ends: Ends) -> None:
    for number in (2500, 2501, 2500):
        assert ends.command(number, 100) == [ACCEPTED]
    assert ends.control.asked == ["start_scan", "stop_scan", "start_scan"]


def test_start_while_the_last_scan_is_closed_is_passed_on(ends: Ends) -> None:
    ends.control.state = replace(ends.control.state, phase=Phase.FINALISING)
    assert ends.command(2500, 100) == [ACCEPTED]
    assert ends.control.asked == ["start_scan"]


def test_start_passes_on_refusals(ends: Ends) -> None:
    for result in (Result.DENIED, Result.FAILED, Result.TEMPORARILY_REJECTED):
        ends.pass_time(5.0)
        ends.control.answers["start_scan"] = Answer(result, f"no camera {result}")
        assert ends.command(2500, 100) == [int(result)]
        assert ends.control.state.phase is Phase.IDLE
    assert any("no camera" in text for text in ends.texts())


def test_recording_status_is_streamed_at_the_rate_asked_for(ends: Ends) -> None:
    ends.command(2500, 100, 0, 2.0)
    heard = kinds(ends.pass_time(5.0)).count("CAMERA_CAPTURE_STATUS")
    assert 9 <= heard <= 11
    ends.command(2501, 100)
    assert "CAMERA_CAPTURE_STATUS" not in kinds(ends.pass_time(3.0))


@pytest.mark.parametrize("other", [(2501, 100, ()), (2500, 100, (0, NAN)), (31010, 191, (7,))])
def test_another_station_leaves_a_stations_stream_alone(
    ends: Ends, other: tuple[int, int, tuple[float, ...]]
) -> None:
    ends.command(511, 100, 262, 1e6)
    number, component, params = other
    ends.command(number, component, *params, source=(254, 190))
    ends.command(511, 100, 262, -1, source=(253, 190))
    ends.pass_time(1.0)
    assert len(statuses(ends.pass_time(6.0))) == 6
    ends.command(511, 100, 262, -1)
    assert statuses(ends.pass_time(3.0)) == []


def test_the_rate_of_a_start_is_the_starters_own_and_ends_with_the_scan(ends: Ends) -> None:
    ends.command(2500, 100, 0, 1.0)
    ends.command(2500, 100, 0, 0, source=(254, 190))
    ends.pass_time(1.0)
    assert len(statuses(ends.pass_time(6.0))) == 6
    ends.command(2500, 100, 0, 0)  # the same station wants none
    assert statuses(ends.pass_time(3.0)) == []
    ends.command(2500, 100, 0, 1.0)
    ends.control.state = replace(ends.control.state, phase=Phase.IDLE)  # closed after landing
    ends.pass_time(0.1)
    assert statuses(ends.pass_time(5.0)) == []


def test_a_start_that_is_refused_streams_nothing(ends: Ends) -> None:
    ends.control.answers["start_scan"] = Answer(Result.TEMPORARILY_REJECTED, "still starting")
    ends.command(2500, 100, 0, 1.0)
    assert statuses(ends.pass_time(5.0)) == []


def test_the_status_is_sent_whenever_it_changes(ends: Ends) -> None:
    """By arming, after landing, by a fault: ground stations ask only while they see a recording."""
    seen = []
    for phase in (
        Phase.SCANNING, Phase.PAUSED, Phase.WAITING, Phase.FINALISING, Phase.IDLE, Phase.WAITING,
    ):  # fmt: skip
        ends.control.state = replace(ends.control.state, phase=phase)
        seen += [m.video_status for m in statuses(ends.pass_time(2.0))]
    assert seen == [1, 0, 1]


def test_the_end_of_a_scan_ends_what_was_asked_of_it(ends: Ends) -> None:
    ends.command(2500, 100)
    ends.command(2000, 100, 0, 30.0, 0)  # a series
    assert statuses(ends.heard)[-1].image_status == 3
    ends.control.state = replace(ends.control.state, phase=Phase.IDLE)
    heard = ends.pass_time(0.1)
    assert [m.capture_result for m in heard if hasattr(m, "capture_result")] == [0]
    assert (statuses(heard)[-1].image_status, statuses(heard)[-1].image_interval) == (0, 0.0)
    assert "photo failed: the scan has ended" in ends.texts()
    ends.control.state = replace(ends.control.state, phase=Phase.SCANNING)
    ends.pass_time(40.0, 1.0)
    assert ends.control.asked == ["start_scan", "capture_keyframe"]


def test_old_control_video_is_an_alias(ends: Ends) -> None:
    assert ends.command(200, 100, 0, 0, 0, 1) == [ACCEPTED]
    assert ends.command(200, 100, 0, 0, 0, 0) == [ACCEPTED]
    assert ends.control.asked == ["start_scan", "stop_scan"]
    assert ends.command(200, 100, 0, 0, 0, 9) == [DENIED]
    assert ends.command(200, 100, 0, 0, 0, NAN) == [DENIED]


# Keyframes


PHOTO = KeyframeReport(1_700_000_000_000_000, 47.3, 8.5, 512.25, 80.5, file="photos/1.jpg")


def shot(ends: Ends) -> list[Any]:
    """The service has taken the photo; what is sent then."""
    ends.companion.camera.report(PHOTO)
    return ends.pass_time(0.05)


def statuses(heard: Iterable[Any]) -> list[Any]:
    return [m for m in heard if m.get_type() == "CAMERA_CAPTURE_STATUS"]


def test_one_photo_from_button_to_report(ends: Ends) -> None:
    assert ends.command(2000, 100, 0, 0, 1) == [ACCEPTED]
    before = [m for m in ends.heard if m.get_type() == "CAMERA_CAPTURE_STATUS"][-1]
    assert before.image_status == 1
    captured, after = shot(ends)
    assert captured.get_type() == "CAMERA_IMAGE_CAPTURED" and captured.capture_result == 1
    assert (captured.lat, captured.lon) == (473000000, 85000000)
    assert (captured.alt, captured.relative_alt, captured.image_index) == (512250, 80500, 0)
    assert captured.time_utc == 1_700_000_000_000_000 and captured.file_url == "photos/1.jpg"
    assert after.image_status == 0 and after.image_count == 1


def test_a_numbered_shot_is_taken_once_however_often_it_comes(ends: Ends) -> None:
    for k in range(4):  # MAVSDK repeats with confirmation 0 every half second
        assert ends.command(2000, 100, 0, 0, 1, 17, confirmation=k) == [ACCEPTED]
        ends.pass_time(0.5)
    assert ends.control.asked == ["capture_keyframe"]
    assert ends.command(2000, 100, 0, 0, 1, 18) == [ACCEPTED]
    assert ends.control.asked == ["capture_keyframe"] * 2


def test_numbers_that_start_over_are_new_shots(ends: Ends) -> None:
    """Mission Planner numbers from 1 on every connection, ArduPilot after every boot."""
    for _ in range(2):
        for number in (1, 2, 3):
            assert ends.command(2000, 100, 0, 0, 1, number) == [ACCEPTED]
            ends.pass_time(1.0)
    assert ends.control.asked == ["capture_keyframe"] * 6
    assert ends.command(2000, 100, 0, 0, 1, 3) == [ACCEPTED]  # another sender is heard meanwhile
    assert ends.command(2000, 100, 0, 0, 1, 3, source=(1, 1)) == [ACCEPTED]
    ends.pass_time(5.0)
    assert ends.command(2000, 100, 0, 0, 1, 3) == [ACCEPTED]  # one photo in each session
    assert ends.control.asked == ["capture_keyframe"] * 8


def test_a_numbered_shot_that_was_refused_is_not_taken_for_taken(ends: Ends) -> None:
    ends.control.answers["capture_keyframe"] = Answer(Result.TEMPORARILY_REJECTED, "no scan")
    assert ends.command(2000, 100, 0, 0, 1, 7) == [BUSY]
    ends.pass_time(1.0)
    assert ends.command(2000, 100, 0, 0, 1, 7) == [BUSY]
    ends.control.answers.clear()
    ends.pass_time(1.0)
    assert ends.command(2000, 100, 0, 0, 1, 7) == [ACCEPTED]


def test_shots_of_any_number_of_senders_take_bounded_memory(ends: Ends) -> None:
    def held() -> int:
        ends.control.asked.clear()
        return held_bytes([ends.companion.camera, ends.companion.streams[100, 262]])

    before = 0
    for component in range(1, 100):
        if component == 20:
            before = held()
        ends.command(2000, 100, 0, 0, 1, 7, source=(255, component))
        ends.command(511, 100, 262, 1e6, source=(255, component))
    assert held() < before + 8000


def test_only_a_scan_and_fast_streams_need_a_short_pause(ends: Ends) -> None:
    assert ends.companion.pause_s == IDLE_TICK_S
    ends.command(511, 100, 262, 1e5)
    assert ends.companion.pause_s == TICK_S
    ends.command(511, 100, 262, -1)
    assert ends.companion.pause_s == IDLE_TICK_S
    ends.command(2500, 100)
    ends.pass_time(2.0)
    assert ends.companion.pause_s == TICK_S


@pytest.mark.parametrize(
    ("number", "params", "result"),
    [
        (2000, (0, 0, 1, 3), BUSY),
        (2000, (0, 0.01, 5), DENIED),
        (2000, (0, -1, 1), DENIED),
        (203, (0, 0, 0, 0, 1), BUSY),
        (203, (0, 1), UNSUPPORTED),
    ],
)
def test_a_refused_photo_frees_the_button(
    ends: Ends, number: int, params: tuple[float, ...], result: int
) -> None:
    ends.control.answers["capture_keyframe"] = Answer(Result.TEMPORARILY_REJECTED, "no scan")
    start = len(ends.heard)
    assert ends.command(number, 100, *params) == [result]
    said = kinds(ends.heard[start:])
    assert said.index("COMMAND_ACK") < said.index("CAMERA_CAPTURE_STATUS")
    assert [m.image_status for m in statuses(ends.heard[start:])] == [0]


def test_an_unnumbered_shot_heard_on_two_links_is_one(ends: Ends) -> None:
    message = dialect.MAVLink_command_long_message(0, 0, 203, 0, 0, 0, 0, 0, 1, 0, 0)
    for link in (0, 1):
        answers = ends.say(message, (1, 1), link)
        assert "COMMAND_ACK" in kinds(answers)
    assert ends.control.asked == ["capture_keyframe"]
    ends.pass_time(1.0)
    ends.say(message, (1, 1))
    assert ends.control.asked == ["capture_keyframe"] * 2


def test_digicam_without_a_shot_is_not_ours(ends: Ends) -> None:
    assert ends.command(203, 100, 0, 0, 0, 0, 0) == [UNSUPPORTED]
    assert ends.command(203, 100, 0, 0, 0, 0, 1) == [ACCEPTED]


def test_a_series_counts_down_and_can_be_stopped(ends: Ends) -> None:
    assert ends.command(2000, 100, 0, 1.0, 3) == [ACCEPTED]
    ends.pass_time(5.0)
    assert ends.control.asked == ["capture_keyframe"] * 3
    assert ends.command(2000, 100, 0, 0.5, 0) == [ACCEPTED]
    status = [m for m in ends.heard if m.get_type() == "CAMERA_CAPTURE_STATUS"][-1]
    assert ends.companion.camera.message(262, 0) is not None
    ends.pass_time(2.0)
    assert ends.command(2001, 100) == [ACCEPTED]
    assert ends.control.asked.count("capture_keyframe") in (7, 8)
    ends.pass_time(3.0)
    assert ends.control.asked.count("capture_keyframe") in (7, 8)
    status = [m for m in ends.heard if m.get_type() == "CAMERA_CAPTURE_STATUS"][-1]
    assert status.image_interval == 0.0


@pytest.mark.parametrize("params", [(0, -1, 5), (0, 1e9, 5), (0, 1, -2), (0, 1, 1e9), (0, 0.01, 5)])
def test_a_senseless_series_is_denied(ends: Ends, params: tuple[float, ...]) -> None:
    assert ends.command(2000, 100, *params) == [DENIED]
    assert ends.control.asked == []


def test_a_shot_that_never_comes_is_reported_as_failed(ends: Ends) -> None:
    ends.command(2000, 100, 0, 0, 1)
    heard = ends.pass_time(11.0)
    failed = [m for m in heard if m.get_type() == "CAMERA_IMAGE_CAPTURED"]
    assert [(m.capture_result, m.image_index) for m in failed] == [(0, 0)]
    assert statuses(heard)[-1].image_status == 0
    assert "photo failed: no image for 10 s" in ends.texts()
    (captured,) = shot(ends)
    assert captured.image_index == 1  # an index is used once


def test_a_keyframe_that_nobody_asked_for_answers_no_request(ends: Ends) -> None:
    ends.command(2000, 100, 0, 0, 1)
    ends.companion.camera.report(replace(PHOTO, file=""))
    heard = ends.pass_time(0.1)
    assert kinds(heard) == ["CAMERA_IMAGE_CAPTURED"]
    assert statuses(shot(ends))[-1].image_status == 0


def test_photos_are_passed_on_refusals_too(ends: Ends) -> None:
    ends.control.answers["capture_keyframe"] = Answer(Result.TEMPORARILY_REJECTED, "no frames")
    assert ends.command(2000, 100, 0, 0, 1) == [BUSY]
    assert ends.command(2000, 100, 0, 2.0, 5) == [BUSY]
    ends.pass_time(5.0)
    assert ends.control.asked == ["capture_keyframe"] * 2


def test_captured_keyframes_can_be_asked_for_again(ends: Ends) -> None:
    for _ in range(3):
        shot(ends)
    answers = ends.say(dialect.MAVLink_command_long_message(1, 100, 512, 0, 263, 1, 0, 0, 0, 0, 0))
    assert [m.image_index for m in answers if m.get_type() == "CAMERA_IMAGE_CAPTURED"] == [1]
    assert ends.command(512, 100, 263, 99) == [UNSUPPORTED]


# Baseline and the onboard computer


@pytest.mark.parametrize("component", [100, 191])
def test_baseline(ends: Ends, component: int) -> None:
    assert ends.command(206, component, 2.5) == [ACCEPTED]
    assert ends.companion.parameters["SR_BASELINE_M"] == 2.5
    assert ends.command(206, component, 0) == [ACCEPTED]
    assert ends.companion.parameters["SR_BASELINE_M"] == 0.0
    for bad in (-1.0, 1e6):
        assert ends.command(206, component, bad) == [DENIED]
    assert ends.companion.parameters["SR_BASELINE_M"] == 0.0
    assert ends.command(206, component, 3.0, 0, 1) == [ACCEPTED]
    assert ends.control.asked[-1] == "capture_keyframe"


def test_user_actions(ends: Ends) -> None:
    assert ends.command(31010, 191, 1) == [BUSY]  # pause without a scan
    assert ends.command(31010, 191, 2) == [BUSY]
    assert ends.command(31010, 191, 7) == [ACCEPTED]
    assert ends.command(31010, 191, 1) == [ACCEPTED]
    assert ends.command(31010, 191, 2) == [ACCEPTED]
    assert ends.control.asked == ["start_scan", "pause", "resume"]
    assert ends.command(31010, 191, 6) == [BUSY]  # no self-test while scanning
    assert ends.command(31010, 191, 3) == [ACCEPTED]
    assert ends.command(31010, 191, 4, 1.5) == [ACCEPTED]
    assert ends.companion.parameters["SR_BASELINE_M"] == 1.5
    assert ends.command(31010, 191, 8) == [ACCEPTED]
    assert ends.command(31010, 191, 6) == [ACCEPTED]
    assert ends.command(31010, 191, 5) == [ACCEPTED]
    for bad in (0, 9, 1.5, -3, NAN):
        assert ends.command(31010, 191, bad) == [DENIED]
    assert ends.command(31010, 100, 1) == [UNSUPPORTED]


@pytest.mark.parametrize(
    ("params", "asked"),
    [((0, 1), "reboot"), ((0, 2), "shut down"), ((0, 0, 1, 191), "restart service")],
)
def test_power_is_refused_while_armed(ends: Ends, params: tuple[float, ...], asked: str) -> None:
    ends.arm()
    assert ends.command(246, 191, *params) == [BUSY]
    assert ends.control.asked == []
    assert any("while armed" in text for text in ends.texts())
    ends.disarm()
    assert ends.command(246, 191, *params) == [RUNNING]
    assert results(ends.pass_time(4.0), 246)[-1] == BUSY  # silence is not disarmed
    assert any("armed state unknown" in text for text in ends.texts())
    ends.disarm()
    assert ends.command(246, 191, *params) == [RUNNING]
    ends.pass_time(0.5)
    assert ends.control.asked == []
    assert results(ends.arm(False), 246) == [ACCEPTED]
    assert ends.control.asked == [f"power: {asked}"]


def test_the_last_heartbeat_before_arming_permits_nothing(ends: Ends) -> None:
    """A second passes between heartbeats: an order within it finds the motors running."""
    ends.disarm()
    assert ends.command(246, 191, 0, 1) == [RUNNING]
    assert ends.command(526, 100, 1, 1) == [RUNNING]
    ends.pass_time(0.3)
    heard = ends.arm()
    assert results(heard, 246) == results(heard, 526) == [BUSY]
    assert ends.control.asked == []


def test_a_scan_that_starts_meanwhile_is_not_erased(ends: Ends) -> None:
    ends.disarm()
    assert ends.command(526, 100, 1, 1) == [RUNNING]
    ends.command(2500, 100)
    ends.pass_time(0.5)
    assert results(ends.arm(False), 526) == [BUSY]
    assert ends.control.asked == ["start_scan"]


def test_a_reboot_of_the_autopilot_is_not_ours(ends: Ends) -> None:
    assert ends.command(246, 191, 1) == [DENIED]
    assert ends.command(246, 0, 1) == []
    assert ends.control.asked == []


def test_erase(ends: Ends) -> None:
    shot(ends)
    assert ends.command(526, 100, 1, 0) == [DENIED]
    assert ends.command(526, 100, 5, 1) == [DENIED]
    ends.command(2500, 100)
    assert ends.command(526, 100, 1, 1) == [BUSY]
    assert any("refused while scanning" in text for text in ends.texts())
    ends.command(2501, 100)
    assert ends.command(526, 100, 1, 1, 0, 1) == [RUNNING]
    assert results(ends.pass_time(4.0), 526)[-1] == BUSY  # nothing says that it is disarmed
    ends.arm()
    assert ends.command(526, 100, 1, 1, 0, 2) == [BUSY]
    for reset, images in ((0, 1), (1, 0)):
        ends.disarm()
        assert ends.command(526, 100, 1, 1, reset) == [RUNNING]
        ends.pass_time(0.5)
        assert results(ends.arm(False), 526) == [ACCEPTED]
        status = ends.companion.camera.message(262, 0)
        assert isinstance(status, dialect.MAVLink_message) and status.image_count == images
    assert ends.control.asked == ["start_scan", "stop_scan", "erase_scans", "erase_scans"]


def test_the_mode_is_video_in_which_photos_are_taken(ends: Ends) -> None:
    assert ends.command(530, 100, 0, 1) == [ACCEPTED]
    assert ends.command(530, 100, 0, 0) == ends.command(530, 100, 0, NAN) == [DENIED]


def test_reset_of_the_settings(ends: Ends) -> None:
    ends.companion.parameters.change("SR_BASELINE_M", 4.0)
    assert ends.command(529, 100, 0) == [DENIED]
    ends.command(2500, 100)
    assert ends.command(529, 100, 1) == [BUSY]
    ends.command(2501, 100)
    assert ends.command(529, 100, 1) == [ACCEPTED]
    assert ends.companion.parameters["SR_BASELINE_M"] == 0.0


# Work that takes a while


def test_work_reports_progress_and_ends(ends: Ends) -> None:
    work = ends.control.works["finalise"] = Work()
    assert ends.command(31010, 191, 5) == [RUNNING]
    work.report(0.4)
    heard = [m for m in ends.pass_time(1.1) if m.get_type() == "COMMAND_ACK"]
    assert [(m.result, m.progress) for m in heard] == [(RUNNING, 40)] * 2
    assert ends.command(31010, 191, 5) == [RUNNING]  # the same again: how it goes
    assert ends.command(31010, 191, 6, source=(255, 191)) == [BUSY]  # another one
    work.report(7.0)
    work.finish()
    work.finish(Answer(Result.FAILED))  # the first word stands
    acks = [m for m in ends.pass_time(0.1) if m.get_type() == "COMMAND_ACK"]
    assert [m.result for m in acks] == [ACCEPTED]
    assert ends.command(31010, 191, 5) == [ACCEPTED]  # the end was not heard: said again
    assert ends.control.asked == ["finalise"] * 3  # a stop is carried out every time
    assert "COMMAND_ACK" not in kinds(ends.pass_time(5.0))


def test_work_that_is_done_at_once_needs_no_progress(ends: Ends) -> None:
    work = ends.control.works["self_test"] = Work()
    work.finish(Answer(Result.FAILED, "Self-test: no camera"))
    assert ends.command(31010, 191, 6) == [FAILED]
    assert "Self-test: no camera" in ends.texts()


def test_brief_work_reports_progress_only_if_it_is_slow(ends: Ends) -> None:
    work = ends.control.works["stop_scan"] = Work(is_brief=True)
    assert ends.command(2501, 100) == []
    assert results(ends.pass_time(0.6), 2501) == [RUNNING]
    work.finish()
    assert results(ends.pass_time(0.1), 2501) == [ACCEPTED]


def cancel_message(number: int, source: tuple[int, int] = STATION) -> bytes:
    payload = struct.pack("<HBB", number, 1, 191)
    head = bytes((0xFD, len(payload), 0, 0, 0, *source, COMMAND_CANCEL, 0, 0))
    crc = x25crc(head[1:] + payload + bytes((14,))).crc
    return head + payload + struct.pack("<H", crc)


def test_work_can_be_cancelled(ends: Ends) -> None:
    work = ends.control.works["finalise"] = Work()
    ends.command(31010, 191, 5)
    ends.say_bytes(cancel_message(2500))  # some other command
    assert not work.cancelled
    ends.say_bytes(cancel_message(31010))
    assert work.cancelled
    work.finish()
    acks = [m for m in ends.pass_time(0.1) if m.get_type() == "COMMAND_ACK"]
    assert [m.result for m in acks] == [CANCELLED]


def test_a_stop_that_takes_effect_cannot_be_cancelled(ends: Ends) -> None:
    work = ends.control.works["stop_scan"] = Work(is_brief=True)
    ends.command(2501, 100)
    ends.say_bytes(cancel_message(2501))
    work.finish()
    assert results(ends.pass_time(0.1), 2501) == [ACCEPTED]


def test_work_without_end_fails(ends: Ends) -> None:
    work = ends.control.works["finalise"] = Work()
    ends.command(31010, 191, 5)
    acks = [m for m in ends.pass_time(185.0, 1.0) if m.get_type() == "COMMAND_ACK"]
    assert acks[-1].result == FAILED and work.cancelled


# Questions


CAMERA_MESSAGES = [
    (259, "CAMERA_INFORMATION"),
    (260, "CAMERA_SETTINGS"),
    (261, "STORAGE_INFORMATION"),
    (262, "CAMERA_CAPTURE_STATUS"),
    (271, "CAMERA_FOV_STATUS"),
]
LEGACY = {259: (521, 1), 260: (522, 1), 261: (525, 0, 1), 262: (527, 1)}


@pytest.mark.parametrize(("number", "name"), CAMERA_MESSAGES)
def test_camera_messages_on_request_old_and_new(ends: Ends, number: int, name: str) -> None:
    for command, *params in ((512, number), LEGACY.get(number, (512, number))):
        start = len(ends.heard)
        assert ends.command(command, 100, *params) == [ACCEPTED]
        assert name in kinds(ends.heard[start:])
    start = len(ends.heard)
    assert ends.command(512, 0, number) == [ACCEPTED]  # to all: the camera answers alone
    assert name in kinds(ends.heard[start:])
    assert ends.command(512, 191, number) == [UNSUPPORTED]


def test_the_field_of_view_is_sent_as_far_as_it_is_known(ends: Ends) -> None:
    def sent() -> Any:
        assert ends.command(512, 100, 271) == [ACCEPTED]
        return [m for m in ends.heard if m.get_type() == "CAMERA_FOV_STATUS"][-1]

    unknown = sent()
    assert {unknown.lat_camera, unknown.alt_camera, unknown.lat_image} == {2**31 - 1}
    assert math.isnan(unknown.hfov) and math.isnan(unknown.q[0])
    head = 0.5, 0.5, 0.5, 0.5
    ends.control.sees = CameraView((47.3, 8.5, 512.25), (47.301, 8.5, 412.25), head, 70.0, 50.0)
    known = sent()
    assert (known.lat_camera, known.lon_camera) == (473000000, 85000000)
    assert (known.lat_image, known.alt_camera, known.alt_image) == (473010000, 512250, 412250)
    assert (known.hfov, known.vfov, tuple(known.q)) == (70.0, 50.0, head)


def test_what_the_camera_says_of_itself(ends: Ends) -> None:
    ends.command(512, 100, 259)
    ends.command(512, 100, 261)
    ends.command(512, 100, 260)
    info = next(m for m in ends.heard if m.get_type() == "CAMERA_INFORMATION")
    assert bytes(info.vendor_name).rstrip(b"\0") == b"skyrelief"
    assert info.flags == 1 | 2 | 8 | 16
    major, minor, _ = VERSION
    assert list(info.firmware_version.to_bytes(4, "little"))[:2] == [major, minor]  # ArduPilot
    assert list(info.firmware_version.to_bytes(4, "big"))[:2] == [major, minor]  # QGroundControl
    storage = next(m for m in ends.heard if m.get_type() == "STORAGE_INFORMATION")
    assert (storage.total_capacity, storage.used_capacity) == (1000.0, 250.0)
    assert storage.status == 2
    settings = next(m for m in ends.heard if m.get_type() == "CAMERA_SETTINGS")
    assert settings.mode_id == 1


def test_no_video_stream_is_offered(ends: Ends) -> None:
    assert ends.command(512, 100, 269) == [UNSUPPORTED]
    assert ends.command(2504, 100, 0) == [UNSUPPORTED]
    assert ends.command(512, 100, 270) == [UNSUPPORTED]
    assert ends.command(2505, 100, 0) == [UNSUPPORTED]


@pytest.mark.parametrize(("number", "name"), CAMERA_MESSAGES)
def test_mission_planner_finds_the_camera_by_any_of_its_ways(
    ends: Ends, number: int, name: str
) -> None:
    """It asks for an interval of 30 s and for its confirmation; earlier, by param 1 = 0."""
    assert ends.command(511, 100, number, 30e6) == [ACCEPTED]
    assert ends.command(510, 100, number) == [ACCEPTED]
    confirmed = [m for m in ends.heard if m.get_type() == "MESSAGE_INTERVAL"][-1]
    assert (confirmed.message_id, confirmed.interval_us) == (number, 30_000_000)
    assert kinds(ends.heard).count(name) == 1
    assert kinds(ends.pass_time(61.0, 0.5)).count(name) == 2
    if number in LEGACY:
        start = len(ends.heard)
        assert ends.command(LEGACY[number][0], 100, 0) == [ACCEPTED]
        assert name in kinds(ends.heard[start:])


def test_message_intervals(ends: Ends) -> None:
    assert ends.command(511, 100, 262, 100_000) == [ACCEPTED]
    assert 9 <= kinds(ends.pass_time(1.0)).count("CAMERA_CAPTURE_STATUS") <= 11
    assert ends.command(510, 100, 262) == [ACCEPTED]
    interval = [m for m in ends.heard if m.get_type() == "MESSAGE_INTERVAL"][-1]
    assert (interval.message_id, interval.interval_us) == (262, 100_000)
    assert ends.command(511, 100, 262, -1) == [ACCEPTED]
    assert "CAMERA_CAPTURE_STATUS" not in kinds(ends.pass_time(1.0))
    for params in ((262, 10), (262, 1e12)):
        assert ends.command(511, 100, *params) == [DENIED]
    assert ends.command(511, 100, 30, 1e5) == [UNSUPPORTED]
    assert ends.command(511, 0, 262, 1e5) == []  # to all: not ours alone to take


# Who is meant


def test_unknown_commands_are_refused_at_once_and_only_by_the_one_asked(ends: Ends) -> None:
    for component in (100, 191):
        assert ends.command(400, component, 1) == [UNSUPPORTED]
        assert ends.command(65535, component) == [UNSUPPORTED]
    assert ends.command(400, 0, 1) == []
    assert ends.command(531, 0, 0, 1) == []


def test_commands_to_others_are_left_alone(ends: Ends) -> None:
    assert ends.command(2500, 1) == []
    assert ends.command(2500, 101) == []
    assert ends.command(2500, 100, system=2) == []
    assert ends.control.asked == []


def test_broadcasts_of_the_autopilot_reach_the_camera(ends: Ends) -> None:
    for system, component in ((0, 0), (1, 0), (0, 100)):
        answers = ends.command(2500, component, system=system, source=(1, 1))
        assert answers == [ACCEPTED]
        ends.command(2501, component, system=system, source=(1, 1))
    assert ends.control.asked == ["start_scan", "stop_scan"] * 3


def test_retransmissions_are_answered_again_but_not_carried_out_again(ends: Ends) -> None:
    ends.control.answers["clear_map"] = Answer(Result.FAILED, "no")
    for _ in range(3):
        assert ends.command(31010, 191, 3, NAN, NAN) == [FAILED]
        ends.pass_time(0.5)
    assert ends.control.asked == ["clear_map"]
    assert ends.command(31010, 191, 3, NAN, NAN, source=(254, 1)) == [FAILED]
    assert ends.control.asked == ["clear_map"] * 2  # another asker
    ends.pass_time(4.0)
    ends.command(31010, 191, 3, NAN, NAN)
    assert ends.control.asked == ["clear_map"] * 3  # later: meant again


def test_a_refusal_is_not_remembered_beyond_its_moment(ends: Ends) -> None:
    ends.control.answers["start_scan"] = Answer(Result.TEMPORARILY_REJECTED, "still starting")
    assert ends.command(2500, 100) == [BUSY]
    assert ends.command(2500, 100) == [BUSY]  # the same call on another link
    assert ends.control.asked == ["start_scan"]
    ends.control.answers.clear()
    ends.pass_time(1.0)
    assert ends.command(2500, 100) == [ACCEPTED]
    assert ends.control.state.phase is Phase.SCANNING


def test_not_a_number_means_default(ends: Ends) -> None:
    assert ends.command(2500, 100, *[NAN] * 7) == [ACCEPTED]
    assert ends.command(2000, 100, *[NAN] * 7) == [ACCEPTED]
    assert ends.control.asked == ["start_scan", "capture_keyframe"]
    assert ends.command(206, 100, NAN, as_int=True) == [ACCEPTED]
    assert ends.companion.parameters["SR_BASELINE_M"] == 0.0


# Parameters


def test_parameters_are_listed_read_set_and_refused(ends: Ends) -> None:
    listed = ends.say(dialect.MAVLink_param_request_list_message(1, 0))
    assert [m.param_id for m in listed] == [p.name for p in PARAMETERS]
    assert {m.param_count for m in listed} == {len(PARAMETERS)}
    assert {m.param_type for m in listed} == {9}
    for by_name, by_index in ((b"SR_LINK_KBIT_S", -1), (b"", 2)):
        message = dialect.MAVLink_param_request_read_message(1, 191, by_name, by_index)
        (value,) = ends.say(message)
        assert (value.param_id, value.param_value) == ("SR_LINK_KBIT_S", 1000.0)
    for name, index in ((b"NONE", -1), (b"", 99), (b"", -2)):
        assert ends.say(dialect.MAVLink_param_request_read_message(1, 191, name, index)) == []

    def put(name: bytes, value: float) -> list[Any]:
        return ends.say(dialect.MAVLink_param_set_message(1, 191, name, value, 9))

    (value,) = put(b"SR_BASELINE_M", 2.5)
    assert value.param_value == 2.5 and ends.control.asked == ["SR_BASELINE_M=2.5"]
    for bad in (-1.0, 1e9, NAN, math.inf):
        answers = put(b"SR_BASELINE_M", bad)
        assert [m.param_value for m in answers if m.get_type() == "PARAM_VALUE"] == [2.5]
    assert any("SR_BASELINE_M refused" in text for text in ends.texts())
    assert [m.param_value for m in put(b"SR_YAW_FRAME", 1.5) if hasattr(m, "param_value")] == [0]
    ends.control.answers["SR_LINK_KBIT_S"] = Answer(Result.DENIED, "not now")
    answers = put(b"SR_LINK_KBIT_S", 500.0)
    assert [m.param_value for m in answers if hasattr(m, "param_value")] == [1000.0]
    assert put(b"CAM_MODE", 0.0)[0].param_value == 1.0  # it only describes the camera
    assert put(b"UNKNOWN", 1.0) == [] or "no parameter UNKNOWN" in ends.texts()
    assert ends.say(dialect.MAVLink_param_set_message(2, 191, b"SR_BASELINE_M", 9.0, 9)) == []
    assert ends.say(dialect.MAVLink_param_set_message(1, 1, b"SR_BASELINE_M", 9.0, 9)) == []
    assert ends.companion.parameters["SR_BASELINE_M"] == 2.5


# What the operator sees


def test_texts_are_spaced_and_not_repeated(ends: Ends) -> None:
    for k in range(10):
        ends.companion.say(4, f"text {k % 5}")
    heard = ends.pass_time(1.0)
    assert len(ends.texts()) in (3, 4)
    ends.pass_time(10.0)

    def ours() -> list[str]:
        return sorted(text for text in ends.texts() if text.startswith("text"))

    assert ours() == [f"text {k}" for k in range(5)]
    ends.companion.say(4, "text 1")
    ends.pass_time(1.0)
    assert len(ours()) == 5
    ends.pass_time(40.0, 1.0)
    ends.companion.say(4, "text 1")
    ends.pass_time(1.0)
    assert len(ours()) == 6 and heard is not None


def test_an_answer_is_sent_however_often_it_was_sent_before(ends: Ends) -> None:
    ends.control.answers["capture_keyframe"] = Answer(Result.TEMPORARILY_REJECTED, "start first")
    ends.companion.say(4, "start first")
    for k in range(5):
        ends.pass_time(2.0)
        assert ends.texts().count("start first") == k + 1
        assert ends.command(2000, 100, 0, 0, 1, k + 1) == [BUSY]
    ends.companion.say(4, "start first")  # no answer: held back
    ends.pass_time(10.0)
    assert ends.texts().count("start first") == 6


def test_a_flood_of_answers_neither_grows_nor_silences_the_rest(ends: Ends) -> None:
    for k in range(1000):
        ends.companion.say(4, f"answer {k}", is_answer=True)
    assert len(ends.companion.texts._said) <= 100
    ends.pass_time(25.0)
    ends.companion.say(2, "camera gone")
    ends.pass_time(2.0)
    assert "camera gone" in ends.texts()
    for k in range(1000, 1100):
        ends.companion.say(4, f"answer {k}", is_answer=True)
        if k == 1050:
            ends.companion.say(2, "disk full")
    ends.pass_time(2.0)
    assert "disk full" in ends.texts()


def test_a_long_text_comes_in_chunks(ends: Ends) -> None:
    text = "".join(chr(65 + k % 26) for k in range(120))
    ends.companion.say(4, text)
    ends.pass_time(0.1)
    chunks = [m for m in ends.heard if m.get_type() == "STATUSTEXT"]
    assert "".join(m.text for m in chunks) == text
    assert [m.chunk_seq for m in chunks] == [0, 1, 2] and chunks[0].id > 0
    assert len({m.id for m in chunks}) == 1


def test_speed_and_distance_without_gps_are_reported() -> None:
    ends = Ends()
    ends.companion.streams[191, 251].set_interval(Address(*STATION), 1_000_000)
    ends.control.state = replace(
        ends.control.state, speed_m_s=5.5, distance_m=120.0, turn_rate_rad_s=math.nan
    )
    named = [m for m in ends.pass_time(1.5) if m.get_type() == "NAMED_VALUE_FLOAT"]
    assert {m.name: m.value for m in named} == {"SR_SPEED": 5.5, "SR_DIST": 120.0}


def test_the_companions_load_is_reported_once_it_is_known(ends: Ends) -> None:
    assert ends.command(512, 191, 390) == [UNSUPPORTED]
    ends.companion.load = ComputerLoad(
        (50, 100), 71, 900, 4000, 2000, 64_000, throttled=True, disk_full=True
    )
    assert ends.command(512, 191, 390) == [ACCEPTED]
    reported = [m for m in ends.pass_time(4.0) if m.get_type() == "ONBOARD_COMPUTER_STATUS"]
    assert len(reported) in (2, 3)
    m = reported[-1]
    assert list(m.cpu_cores[:3]) == [50, 100, 255] and m.cpu_combined[0] == 75
    assert (m.gpu_cores[0], m.temperature_board) == (255, 71)
    assert (m.ram_usage, m.ram_total) == (900, 4000)
    assert (m.storage_usage[0], m.storage_total[0]) == (2000, 64_000)
    assert (m.link_tx_rate[0], m.status_flags) == (0xFFFFFFFF, 4 | 8)
    ends.companion.load = ComputerLoad((900,) * 20, temperature_c=5000, ram_used_mib=-5)
    m = [m for m in ends.pass_time(3.0) if m.get_type() == "ONBOARD_COMPUTER_STATUS"][-1]
    assert set(m.cpu_cores) == {100} and m.temperature_board == 126 and m.ram_usage == 0


def test_a_text_of_whole_chunks_is_closed_by_an_empty_one(ends: Ends) -> None:
    ends.companion.say(4, "x" * 100)
    ends.pass_time(0.1)
    chunks = [m for m in ends.heard if m.get_type() == "STATUSTEXT"]
    assert [len(m.text) for m in chunks] == [50, 50, 0]
    for k in range(300):  # a flood is cut off, not stored
        ends.companion.say(4, f"flood {k}")
    ends.pass_time(60.0, 1.0)
    assert len(ends.texts()) < 30


def test_health_is_confirmed_or_it_is_not_reported() -> None:
    presence = Presence(PresenceConfig(stale_s=5, dead_s=20, boot_s=60), 1, 0)
    first = presence.due(0)
    assert [o.component for o in first] == [191, 100]
    assert [o.message.type for o in first] == [18, 30]
    assert all(o.message.system_status == 1 and o.message.autopilot == 8 for o in first)
    assert presence.due(int(0.5 * S)) == [] and len(presence.due(S)) == 2
    presence.confirm(Health.ACTIVE, 2 * S)
    assert presence.due(2 * S)[0].message.system_status == 4
    assert presence.due(8 * S)[0].message.system_status == 5  # nothing confirmed it
    assert presence.due(23 * S) == []  # dead: silent
    presence.confirm(Health.STANDBY, 24 * S)
    assert presence.due(24 * S)[0].message.system_status == 3
    assert Presence(PresenceConfig(boot_s=60), 1, 0).due(61 * S) == []


def test_the_heartbeat_keeps_its_beat_when_called_a_little_late() -> None:
    presence = Presence(PresenceConfig(boot_s=1000), 1, 0)
    sent = [t for t in range(0, 20 * S, 7 * MS) if presence.due(t)]
    assert len(sent) == 20
    assert all(0.98 * S < b - a < 1.02 * S for a, b in pairwise(sent))
