"""A recording's clock against its log's."""

from __future__ import annotations

import math

import pytest
from turning_flight import LATE_S, S, Turns, fly, history_of

from mavlink.telemetry.history import VehicleHistory
from mavlink.telemetry.latency import LatencyWatch
from service.commands.recording_clock import RecordingClock
from service.config import CameraConfig
from service.flight.telemetry_check import TelemetryCheck


@pytest.mark.parametrize(
    ("set_ms", "strength", "off_ms"),
    [
        (-130.0, 1.0, 200.0),
        (500.0, 1.0, -430.0),
        (0.0, 1.0, None),
        (-130.0, 0.0, None),
    ],
)
@pytest.mark.slow
def test_stamps_that_are_off_by_more_than_a_latency_show_a_clock(
    set_ms: float, strength: float, off_ms: float | None
) -> None:
    check = TelemetryCheck(CameraConfig(latency_ms=set_ms), history_of("none", strength))
    fly(check, strength)
    found = RecordingClock(check).off_ms()
    assert found == (None if off_ms is None else pytest.approx(off_ms, abs=10.0))


@pytest.mark.slow
def test_a_recording_whose_clock_gains_shows_its_rate() -> None:
    history, rate = history_of("none", 1.0), 0.003
    check = TelemetryCheck(CameraConfig(), history)
    clock = RecordingClock(check)
    fly(check, rate=rate)
    found = clock.rate()
    assert found is not None and found == pytest.approx(rate, abs=3e-4)
    assert clock.rate() is None  # until there are more frames
    again = TelemetryCheck(CameraConfig(), history.at_rate(found, S))
    fly(again, rate=rate)
    assert again.latency is not None and RecordingClock(again).rate(has_ended=True) is None
    assert again.latency.latency_ms == pytest.approx(1e3 * (LATE_S + rate), abs=5.0)


def test_a_clock_that_the_whole_log_does_not_confirm_stays() -> None:
    """Another turn of the flight may look like that of the images."""

    class Longer(VehicleHistory):
        """A log of which those of a minute fit the images, and the whole does not."""

        def bodies(self, since_ns: int = 0, until_ns: float = math.inf) -> Turns:
            turns = super().bodies(since_ns, until_ns)
            return turns if until_ns < math.inf else [(t, turns[0][1]) for t, _ in turns]

    check = TelemetryCheck(CameraConfig(latency_ms=-130.0), history_of("none", 1.0, kind=Longer))
    clock = RecordingClock(check)
    fly(check)
    assert check.latency is not None  # near by
    without = RecordingClock(TelemetryCheck(CameraConfig(), None))
    assert without.off_ms(has_ended=True) is None
    assert clock.off_ms() is None and clock.off_ms(has_ended=True) is None


@pytest.mark.slow
def test_a_search_that_found_nothing_is_repeated_with_all_frames(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    check = TelemetryCheck(CameraConfig(latency_ms=-130.0), history_of("none", 1.0))
    clock = RecordingClock(check)
    fly(check)
    with monkeypatch.context() as early:
        early.setattr(LatencyWatch, "anywhere", lambda watch, attitudes: None)
        assert clock.off_ms() is None
    assert clock.off_ms(has_ended=True) == pytest.approx(200.0, abs=10.0)
