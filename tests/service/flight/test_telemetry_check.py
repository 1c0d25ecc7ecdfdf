"""Telemetry checked against the images, from tracked frames to the operator's words."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Literal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from turning_flight import LATE_S, S, Turns, body, fly, history_of, quaternion_of, seen

from mavlink.telemetry.history import VehicleHistory
from mavlink.telemetry.samples import AttitudeSample, GimbalFrame
from recon.frames import R_GIMBAL_CAMERA
from recon.tracking.frame import Tracking
from service.config import CameraConfig
from service.flight.telemetry_check import AHEAD_NS, TelemetryCheck


@pytest.mark.parametrize("gimbal", ["none", "honest"])
def test_the_latency_is_shown_and_not_applied_unless_asked(gimbal: str) -> None:
    reported: list[str] = []
    check = TelemetryCheck(CameraConfig(), history_of(gimbal, 1.0), reported.append)
    exposed = fly(check, gap=True)
    assert exposed[-1] == round((1.0 + 599 / 15 + LATE_S) * S)
    latency = check.summary()["camera_latency"]
    assert latency["applied_ms"] == 0.0
    assert latency["estimate_ms"] == pytest.approx(70.0, abs=10.0)
    assert abs(latency["estimate_ms"] - 70.0) < 3.0 * latency["sigma_ms"]
    assert len(reported) == 1 and reported[0].endswith("by the images, 0 ms is set")
    assert check.is_clock_sure


@pytest.mark.parametrize("gimbal", ["none", "honest"])
@pytest.mark.parametrize("turned_deg", [90.0, 180.0, 270.0])
def test_images_that_are_turned_by_quarters_are_found(gimbal: str, turned_deg: float) -> None:
    reported: list[str] = []
    camera = CameraConfig(mount_pitch_deg=-60.0)
    check = TelemetryCheck(camera, history_of(gimbal, 1.0), reported.append)
    fly(check, noise_rad=2e-3, image_roll_deg=turned_deg)
    assert check.image_roll_deg == turned_deg
    of_roll = [text for text in reported if "turned clockwise" in text]
    assert len(of_roll) == 1 and of_roll[0].endswith(f"camera.image_roll_deg = {turned_deg:.0f}")
    assert check.frame is None or not check.frame.refuted  # nothing is blamed on the gimbal


@pytest.mark.parametrize(
    ("stated", "turned_deg", "strength"),
    [("auto", 0.0, 1.0), ("auto", 45.0, 1.0), ("auto", 90.0, 0.0), (0.0, 90.0, 1.0)],
)
def test_a_roll_that_is_stated_or_not_shown_stays(
    stated: float | Literal["auto"], turned_deg: float, strength: float
) -> None:
    camera = CameraConfig(mount_pitch_deg=-60.0, image_roll_deg=stated)
    check = TelemetryCheck(camera, history_of("none", strength))
    fly(check, strength, image_roll_deg=turned_deg)
    assert check.image_roll_deg == 0.0


def test_a_roll_that_is_stated_is_that_of_the_images() -> None:
    camera = CameraConfig(mount_pitch_deg=-60.0, image_roll_deg=90.0)
    reported: list[str] = []
    check = TelemetryCheck(camera, history_of("wrong", 1.0), reported.append)
    fly(check, image_roll_deg=90.0)
    assert check.frame is not None and check.frame.frame is GimbalFrame.BODY


def test_a_flight_without_turns_leaves_its_clock_open() -> None:
    check = TelemetryCheck(CameraConfig(), history_of("none", 0.0))
    fly(check, 0.0, hz=2.0)
    assert not check.is_clock_sure


def test_stills_show_a_latency_too() -> None:
    """A still every other second, turned to 0.4 degrees: enough to report, not to apply."""
    reported: list[str] = []
    check = TelemetryCheck(CameraConfig(latency="auto"), history_of("none", 1.0), reported.append)
    fly(check, noise_rad=0.005, hz=0.5)
    found = check.summary()["camera_latency"]
    assert abs(found["estimate_ms"] - 70.0) < 3.0 * found["sigma_ms"] < 25.0
    assert not found["is_settled"] and found["applied_ms"] == 0.0
    assert len(reported) == 1 and reported[0].endswith("by the images, 0 ms is set")


def test_a_scan_that_ends_in_its_first_frame_has_no_latency() -> None:
    reported: list[str] = []
    check = TelemetryCheck(CameraConfig(latency="auto"), history_of("none", 1.0), reported.append)
    check.exposed_ns(S)
    check.finish()
    assert check.latency is None and reported == []


def test_auto_applies_what_was_found_and_keeps_the_frames_in_order() -> None:
    reported: list[str] = []
    check = TelemetryCheck(CameraConfig(latency="auto"), history_of("none", 1.0), reported.append)
    exposed = fly(check)
    assert all(b > a for a, b in pairwise(exposed))
    assert check.applied_ms == pytest.approx(70.0, abs=10.0)
    assert exposed[-1] == pytest.approx((1.0 + 599 / 15) * S, abs=0.01 * S)
    assert len(reported) == 1 and reported[0].endswith("applied")
    again = TelemetryCheck(CameraConfig(latency="auto"), None, reported.append, 70.0)
    assert again.exposed_ns(S) == S - 70_000_000  # what the last scan found serves at once


@pytest.mark.slow
def test_a_right_setting_needs_no_words_and_can_change_in_flight() -> None:
    reported: list[str] = []
    check = TelemetryCheck(
        CameraConfig(latency_ms=68.0), history_of("honest", 1.0), reported.append
    )
    assert fly(check)[0] == round((1.0 + LATE_S) * S) - 68_000_000
    assert reported == []
    check.set_camera(CameraConfig(latency_ms=20.0))
    before = check.exposed_ns(60 * S)
    check.set_camera(CameraConfig(latency_ms=500.0))
    after = check.exposed_ns(60 * S + S // 15)
    assert check.applied_ms == pytest.approx(20.0 + 100.0 / 15, abs=0.1) and after > before


@pytest.mark.slow
def test_a_calm_flight_is_given_no_latency() -> None:
    reported: list[str] = []
    check = TelemetryCheck(CameraConfig(latency="auto"), history_of("none", 0.0), reported.append)
    fly(check, 0.0)
    assert check.latency is None and reported == [] and check.applied_ms == 0.0
    assert check.summary()["camera_latency"] == {"applied_ms": 0.0}
    silent = TelemetryCheck(CameraConfig(), None, reported.append)
    fly(silent)
    assert silent.summary() == {} and reported == []


def test_a_gimbal_that_claims_the_wrong_frame_is_corrected_and_reported_once() -> None:
    reported: list[str] = []
    history = history_of("wrong", 1.0)
    check = TelemetryCheck(CameraConfig(), history, reported.append)
    fly(check)
    assert history.gimbal_frame() in (GimbalFrame.BODY, GimbalFrame.SERVO)
    frame = check.summary()["gimbal_frame"]
    assert frame["by_pictures"] in ("body", "servo") and frame["used"] == frame["by_pictures"]
    assert sum(text.startswith("Gimbal angles refer to") for text in reported) == 1
    state = history.state_at(30 * S)
    assert state is not None and state.q_ned_gimbal_wxyz is not None
    w, x, y, z = state.q_ned_gimbal_wxyz
    truth = body(30.0) * Rotation.from_euler("Y", -math.pi / 3)
    assert (truth.inv() * Rotation.from_quat([x, y, z, w])).magnitude() < 0.01


@pytest.mark.parametrize(
    ("mount", "held", "is_found"),
    [("auto", 1.0, True), ("auto", 0.0, False), ("auto", 0.3, False), ("fixed", 1.0, False)],
)
def test_a_camera_on_a_gimbal_that_sends_nothing_is_found(
    mount: Literal["auto", "fixed"], held: float, is_found: bool
) -> None:
    """Of the vehicle's tilt the gimbal takes out a share, ``held``."""
    reported: list[str] = []
    history = VehicleHistory()
    check = TelemetryCheck(CameraConfig(mount=mount), history, reported.append)

    def tilted(t: float, share: float) -> Rotation:
        angles = [0.12 * math.sin(1.9 * t), 0.15 * math.sin(1.3 * t)]
        return Rotation.from_euler("ZYX", [0.01 * t, *(share * a for a in angles)])

    for k in range(30 * 25):
        t = k / 25
        history.add(AttitudeSample(None, quaternion_of(tilted(t, 1.0))), k * S // 25)
        T = np.eye(4)
        T[:3, :3] = tilted(t, 1.0 - held).as_matrix() @ R_GIMBAL_CAMERA
        check.add(k * S // 25 + 150_000_000, seen(Tracking.TRACKED, T))
    assert check.is_stabilised == is_found
    assert sum("hold still while the vehicle tilts" in text for text in reported) == is_found


def test_a_frame_that_was_configured_stands_against_the_images() -> None:
    reported: list[str] = []
    history = history_of("wrong", 1.0, "earth")
    fly(TelemetryCheck(CameraConfig(), history, reported.append))
    assert history.gimbal_frame() is GimbalFrame.EARTH
    (text,) = [text for text in reported if "Gimbal" in text]
    assert text.endswith("; earth is set")


def test_an_honest_gimbal_is_left_alone() -> None:
    reported: list[str] = []
    history = history_of("honest", 1.0)
    fly(TelemetryCheck(CameraConfig(), history, reported.append))
    assert history.gimbal_frame() is GimbalFrame.EARTH
    assert not any("Gimbal" in text for text in reported)


@pytest.mark.slow
def test_skipped_frames_do_not_interrupt_the_turns_of_the_others() -> None:
    """Frames that were not tracked come between those that were."""
    check = TelemetryCheck(CameraConfig(), history_of("honest", 1.0))
    mount = Rotation.from_euler("Y", -math.pi / 3)
    for k in range(40 * 30):
        T = np.eye(4)
        T[:3, :3] = (body(k / 30) * mount).as_matrix() @ R_GIMBAL_CAMERA
        tracked = seen(Tracking.SKIPPED) if k % 3 else seen(Tracking.TRACKED, T)
        check.add(round(k * S / 30 + LATE_S * S), tracked)
    check.finish()
    assert check.latency is not None
    assert abs(check.latency.latency_ms - 1e3 * LATE_S) < 5.0


@pytest.mark.parametrize("gimbal", ["none", "honest"])
def test_the_rest_of_a_long_log_is_not_read_for_each_look(gimbal: str) -> None:
    until: list[float] = []

    class Watched(VehicleHistory):
        def bodies(self, since_ns: int = 0, until_ns: float = math.inf) -> Turns:
            until.append(until_ns)
            return super().bodies(since_ns, until_ns)

        def heads(self, since_ns: int = 0, until_ns: float = math.inf) -> Turns:
            until.append(until_ns)
            return super().heads(since_ns, until_ns)

    camera = CameraConfig(mount="fixed") if gimbal == "none" else CameraConfig()
    check = TelemetryCheck(camera, history_of(gimbal, 1.0, kind=Watched))
    for second in range(1, 13):
        check.add(second * S, seen(Tracking.LOST))
    assert until == [11 * S + AHEAD_NS]
