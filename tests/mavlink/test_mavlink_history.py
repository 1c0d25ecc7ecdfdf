"""Interpolation of the vehicle's past against SciPy and closed forms."""

from __future__ import annotations

import math
import threading
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from mavlink.telemetry import quaternion
from mavlink.telemetry.gimbal import (
    frame_by_images,
    frame_of_flags,
    steadiest_frame,
    to_earth,
)
from mavlink.telemetry.history import M_PER_DEG, SIGMA_TILT_RAD, HistoryConfig, VehicleHistory
from mavlink.telemetry.latency import LatencyWatch
from mavlink.telemetry.quaternion import Quaternion
from mavlink.telemetry.samples import (
    F64,
    AccuracySample,
    AttitudeSample,
    GimbalFrame,
    GimbalSample,
    PositionSample,
    RangeSample,
    Sample,
    TerrainSample,
    TimeSeries,
)

MS = 1_000_000
S = 1_000_000_000
IDENTITY = (1.0, 0.0, 0.0, 0.0)
T0 = 1_700_000_000 * S


def scipy_of(q: Quaternion | F64) -> Rotation:
    w, x, y, z = q
    return Rotation.from_quat([x, y, z, w])


def of_scipy(r: Rotation) -> Quaternion:
    x, y, z, w = r.as_quat()
    return (float(w), float(x), float(y), float(z))


def angle(a: Quaternion | F64, b: Quaternion | F64) -> float:
    return float((scipy_of(a).inv() * scipy_of(b)).magnitude())


def position(
    lat: float, lon: float, alt: float, v: tuple[float, float, float] | None
) -> PositionSample:
    return PositionSample(None, lat, lon, alt, alt - 500.0, v)


# Quaternions


def test_quaternion_algebra_agrees_with_scipy() -> None:
    rotations = Rotation.random(50, random_state=1)
    for a, b in zip(rotations[:25], rotations[25:], strict=True):
        qa, qb = of_scipy(a), of_scipy(b)
        assert angle(quaternion.multiply(qa, qb), of_scipy(a * b)) < 1e-7
        assert quaternion.angle_between(qa, qb) == pytest.approx((a.inv() * b).magnitude())
        yaw, pitch, roll = a.as_euler("ZYX")
        assert np.allclose(quaternion.to_rpy(qa), (roll, pitch, yaw), atol=1e-9)
        assert angle(quaternion.from_rpy(roll, pitch, yaw), qa) < 1e-7
        assert quaternion.down_component(qa) == pytest.approx(a.as_matrix()[2, 2])
        for u in (0.0, 0.25, 0.9, 1.0):
            truth = Slerp([0, 1], Rotation.concatenate([a, b]))(u)
            assert angle(quaternion.slerp(qa, qb, u), of_scipy(truth)) < 1e-7


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_rpy_at_the_pole_carries_the_whole_turn_in_yaw(sign: float) -> None:
    q = quaternion.from_rpy(0.0, sign * math.pi / 2, 0.7)
    roll, pitch, yaw = quaternion.to_rpy(q)
    assert roll == 0.0
    assert pitch == pytest.approx(sign * math.pi / 2)
    assert yaw == pytest.approx(0.7)
    assert angle(quaternion.from_rpy(roll, pitch, yaw), q) < 1e-6


def test_normalised_refuses_what_is_no_rotation() -> None:
    assert quaternion.normalised([0.0, 0.0, 0.0, 0.0]) is None
    assert quaternion.normalised([math.nan, 0.0, 0.0, 1.0]) is None
    assert quaternion.normalised([math.inf, 0.0, 0.0, 1.0]) is None
    assert quaternion.normalised([1.0, 0.0]) is None
    assert quaternion.normalised([1.01, 0.0, 0.0, 0.0]) == (1.0, 0.0, 0.0, 0.0)


# Tracks


def test_track_sorts_replaces_and_forgets() -> None:
    track = TimeSeries[tuple[float]]()
    for t in (30, 10, 20, 10):
        track.add(t * MS, (float(t),))
    assert [t for t, _ in track.items()] == [10 * MS, 20 * MS, 30 * MS]
    for t in range(40, 400):
        track.add(t * MS, (0.0,))
    track.forget_before(399 * MS)
    assert track.first_ns == 399 * MS


def test_track_extrapolates_twenty_milliseconds_and_no_more() -> None:
    track = TimeSeries[tuple[float]]()
    track.add(0, (0.0,))
    track.add(100 * MS, (1.0,))
    at = track.around(120 * MS)
    assert at is not None and at.fraction == pytest.approx(1.2)
    assert track.around(120 * MS + 1) is None
    before = track.around(-20 * MS)
    assert before is not None and before.fraction == pytest.approx(-0.2)
    assert track.around(-20 * MS - 1) is None


def test_extrapolation_does_not_magnify_two_close_samples() -> None:
    track = TimeSeries[tuple[float]]()
    for t in (0, 99 * MS, 100 * MS):
        track.add(t, (float(t),))
    at = track.around(115 * MS)
    assert at is not None and at.before_ns == 0 and at.after_ns == 100 * MS


def test_track_leaves_gaps_of_over_a_second_open() -> None:
    track = TimeSeries[tuple[float]]()
    track.add(0, (0.0,))
    track.add(1001 * MS, (1.0,))
    assert track.around(500 * MS) is None
    near = track.around(15 * MS)
    assert near is not None and near.before == near.after == (0.0,)
    track.add(1000 * MS, (1.0,))
    assert track.around(500 * MS) is not None


# Attitude


def test_attitude_is_interpolated_along_the_shorter_arc_and_covered_by_its_sigma() -> None:
    def truth(t: float) -> Quaternion:
        return quaternion.from_rpy(
            0.15 * math.sin(2.0 * t), 0.1 * math.cos(1.5 * t), 3.0 + 0.8 * math.sin(0.7 * t)
        )

    for rate_hz in (50.0, 10.0, 3.5):
        history = VehicleHistory()
        for k in range(int(10 * rate_hz)):
            t = k / rate_hz
            q = truth(t)
            flip = -1.0 if k % 2 else 1.0  # both signs mean the same rotation
            sample = AttitudeSample(None, (flip * q[0], flip * q[1], flip * q[2], flip * q[3]))
            history.add(sample, T0 + round(t * S))
        ratios = []
        for t in np.linspace(0.3, 9.0, 200):
            state = history.state_at(T0 + round(float(t) * S))
            assert state is not None and state.q_ned_body_wxyz is not None
            assert state.sigma_attitude_rad is not None
            error = angle(state.q_ned_body_wxyz, truth(float(t)))
            ratios.append(error / state.sigma_attitude_rad)
            assert state.sources == ("attitude",)
        assert max(ratios) < 1.0  # this smooth a flight bends less than the sigma allows for


@pytest.mark.parametrize("gap_s", [0.1, 0.3])
def test_rates_at_both_ends_bend_the_way_between_two_attitudes(gap_s: float) -> None:
    """A quadrotor rocks in gusts, its radio is slow."""

    def truth(t: float) -> Rotation:
        rocking = 0.12 * math.sin(5.0 * t), 0.05 * math.sin(3.3 * t + 1.0)
        return Rotation.from_euler("ZYX", (0.9 * t, rocking[1], rocking[0]))

    def rates(t: float) -> tuple[float, float, float]:
        x, y, z = (truth(t - 1e-4).inv() * truth(t + 1e-4)).as_rotvec() / 2e-4
        return (float(x), float(y), float(z))

    errors, sigmas = [], []
    for known in (False, True):
        history = VehicleHistory()
        for t in np.arange(0.0, 8.0, gap_s).tolist():
            sample = AttitudeSample(None, of_scipy(truth(t)), rates(t) if known else None)
            history.add(sample, T0 + round(t * S))
        off = []
        for t in np.linspace(0.5, 7.0, 200).tolist():
            state = history.state_at(T0 + round(t * S))
            assert state is not None and state.q_ned_body_wxyz is not None
            off.append(angle(state.q_ned_body_wxyz, of_scipy(truth(t))))
        errors.append(np.sqrt(np.mean(np.square(off))))
        between = history.state_at(T0 + round((1.0 + gap_s / 2) * S))
        assert between is not None and between.sigma_attitude_rad is not None
        sigmas.append(between.sigma_attitude_rad)
        bodies = history.bodies(T0 + S)
        gaps_ms = np.diff([t for t, _ in bodies]) / MS
        np.testing.assert_allclose(gaps_ms, 100.0 if known else 1e3 * gap_s, atol=1e-3)
        seen = [angle(q, of_scipy(truth((t - T0) / S))) for t, q in bodies]
        assert max(seen) < (sigmas[-1] if known else 1e-6)
    assert errors[1] < 0.2 * errors[0] and max(off) < sigmas[1] < sigmas[0]
    past = history.state_at((history.last_ns or 0) + 15 * MS)
    assert past is not None and past.q_ned_body_wxyz is not None
    t = ((history.last_ns or 0) - T0) / S + 0.015
    assert angle(past.q_ned_body_wxyz, of_scipy(truth(t))) < 0.01


def test_attitude_sigma_grows_with_the_gap() -> None:
    sigmas = []
    for gap_ms in (20, 200, 400, 800, 1000):
        history = VehicleHistory()
        for k in range(3):
            history.add(AttitudeSample(None, IDENTITY), T0 + k * gap_ms * MS)
        state = history.state_at(T0 + gap_ms * MS * 3 // 2)
        assert state is not None and state.sigma_attitude_rad and state.sigma_yaw_rad
        sigmas.append(state.sigma_attitude_rad)
        assert state.sigma_yaw_rad > state.sigma_attitude_rad
        assert state.age_ms["attitude"] == pytest.approx(gap_ms / 2)
    assert sigmas[0] == pytest.approx(SIGMA_TILT_RAD, rel=0.01)
    assert sigmas == sorted(sigmas) and sigmas[4] > 5 * sigmas[1]


def test_nothing_is_known_of_an_empty_history_or_another_time() -> None:
    history = VehicleHistory()
    assert history.state_at(T0) is None
    assert history.first_ns is None and history.last_ns is None
    history.add(AttitudeSample(None, IDENTITY), T0)
    assert history.state_at(T0 + 21 * MS) is None
    assert history.state_at(T0 - 21 * MS) is None
    assert history.state_at(T0 + 20 * MS) is not None
    history.clear()
    assert history.state_at(T0) is None


# Position


def test_position_follows_a_curve_exactly_and_crosses_the_date_line() -> None:
    # A parabola is a cubic: Hermite interpolation is exact up to the local plane's curvature.
    lat0, lon0, acceleration = -35.0, 179.99999, 3.0
    per_lon = M_PER_DEG * math.cos(math.radians(lat0))

    def truth(t: float) -> tuple[float, float, float]:
        return 12.0 * t, 5.0 * t + 0.5 * acceleration * t * t, 600.0 + 2.0 * t - t * t

    history = VehicleHistory()
    for k in range(8):
        t = 0.5 * k
        north, east, alt = truth(t)
        lon = (lon0 + east / per_lon + 180.0) % 360.0 - 180.0
        v = (12.0, 5.0 + acceleration * t, -(2.0 - 2.0 * t))
        history.add(position(lat0 + north / M_PER_DEG, lon, alt, v), T0 + round(t * S))
    for t in np.linspace(0.0, 3.5, 71):
        state = history.state_at(T0 + round(float(t) * S))
        assert state is not None and state.lat_deg is not None and state.lon_deg is not None
        north, east, alt = truth(float(t))
        assert (state.lat_deg - lat0) * M_PER_DEG == pytest.approx(north, abs=0.01)
        d_lon = (state.lon_deg - lon0 + 180.0) % 360.0 - 180.0
        assert d_lon * per_lon == pytest.approx(east, abs=0.01)
        assert state.alt_amsl_m == pytest.approx(alt, abs=0.01)
        assert state.v_ned_m_s is not None
        assert state.v_ned_m_s[1] == pytest.approx(5.0 + acceleration * float(t), abs=1e-6)


def test_positions_once_a_second_hold_at_every_time() -> None:
    """They never come exactly on time."""
    history = VehicleHistory()
    for k in range(5):
        history.add(position(50.0 + 1e-5 * 1.05 * k, 8.0, 600.0, None), T0 + k * 1050 * MS)
    for t in range(0, 4200, 100):
        state = history.state_at(T0 + t * MS)
        assert state is not None and state.lat_deg == pytest.approx(50.0 + 1e-8 * t, abs=1e-10)
        assert state.alt_agl_m is not None and state.sigma_h_m is not None
    history.add(position(50.0, 8.0, 600.0, None), T0 + 7300 * MS)
    assert history.state_at(T0 + 5 * S) is None  # 3.1 s without any


def test_position_is_straight_when_velocity_contradicts_the_way() -> None:
    history = VehicleHistory()
    history.add(position(50.0, 8.0, 600.0, (80.0, 0.0, 0.0)), T0)
    history.add(position(50.0001, 8.0, 600.0, (-80.0, 0.0, 0.0)), T0 + S // 2)
    history.add(position(50.0002, 8.0, 600.0, (-80.0, 0.0, 0.0)), T0 + S)
    state = history.state_at(T0 + S * 3 // 4)
    assert state is not None and state.lat_deg == pytest.approx(50.00015, abs=1e-9)


def test_receiver_accuracy_becomes_the_sigma_and_no_fix_no_position() -> None:
    history = VehicleHistory()
    for k in range(40):
        history.add(position(50.0, 8.0, 580.0, (0.0, 0.0, 0.0)), T0 + k * 100 * MS)
    state = history.state_at(T0 + 5 * MS)
    assert state is not None and state.sigma_h_m == pytest.approx(2.1, rel=1e-3)
    history.add(AccuracySample(None, True, 0.02, 0.03), T0 + 100 * MS)
    state = history.state_at(T0 + 100 * MS)
    assert state is not None and state.sigma_h_m == pytest.approx(0.02)
    assert state.sigma_v_m == pytest.approx(0.03)
    history.add(AccuracySample(None, False, 50.0, 50.0), T0 + 2 * S)
    state = history.state_at(T0 + 2 * S)
    assert state is not None and state.lat_deg is None and "gnss" not in state.sources
    assert state.alt_agl_m == pytest.approx(80.0)  # above home by the barometer still stands


# Height above ground


def test_height_above_ground_comes_from_the_best_source_there_is() -> None:
    history = VehicleHistory()
    tilt = math.radians(20.0)
    for k in range(30):
        t = T0 + k * 100 * MS
        history.add(position(50.0, 8.0, 580.0, (0.0, 0.0, 0.0)), t)
        history.add(AttitudeSample(None, quaternion.from_rpy(tilt, 0.0, 1.0)), t)
        if k < 20:
            history.add(TerrainSample(None, 75.0, 5.0), t)
        if k < 10:
            history.add(RangeSample(None, 70.0), t)

    def agl(k: int) -> tuple[str, float]:
        state = history.state_at(T0 + k * 100 * MS)
        assert state is not None and state.alt_agl_m is not None and state.sigma_agl_m
        return state.sources[-1], state.alt_agl_m

    for k, source, height in (
        (5, "rangefinder", 70.0 * math.cos(tilt)),
        (15, "terrain", 75.0),
        (25, "relative", 80.0),
    ):
        assert agl(k)[0] == source
        assert agl(k)[1] == pytest.approx(height)


@pytest.mark.parametrize("absurd", [RangeSample(None, 3e38), TerrainSample(None, 1e20, 5.0)])
def test_heights_that_nothing_flies_at_are_left_out(absurd: Sample) -> None:
    history = VehicleHistory()
    history.add(AttitudeSample(None, quaternion.from_rpy(0.0, 0.0, 1.0)), T0)
    history.add(absurd, T0)
    history.add(PositionSample(None, 50.0, 8.0, 480.0, 2.1e6, None), T0)
    state = history.state_at(T0)
    assert state is not None and state.alt_agl_m is None
    history.add(PositionSample(None, 50.0, 8.0, 480.0, 80.0, None), T0)
    state = history.state_at(T0)
    assert state is not None and state.alt_agl_m == 80.0


def test_height_below_home_is_left_out() -> None:
    history = VehicleHistory()
    history.add(PositionSample(None, 50.0, 8.0, 480.0, -20.0, None), T0)
    state = history.state_at(T0)
    assert state is not None and state.alt_agl_m is None and state.alt_amsl_m == 480.0
    assert state.v_ned_m_s is None


# Gimbals


def test_flags_say_what_the_quaternion_refers_to() -> None:
    assert frame_of_flags(64) is GimbalFrame.EARTH
    assert frame_of_flags(32) is GimbalFrame.VEHICLE
    assert frame_of_flags(16) is GimbalFrame.EARTH
    assert frame_of_flags(0) is GimbalFrame.VEHICLE
    assert frame_of_flags(32 | 16) is GimbalFrame.VEHICLE
    assert frame_of_flags(44) is GimbalFrame.VEHICLE
    assert frame_of_flags(28) is GimbalFrame.EARTH


def test_every_gimbal_frame_leads_to_the_same_attitude() -> None:
    rng = np.random.default_rng(3)
    for _ in range(50):
        roll, pitch, yaw = rng.uniform(-0.4, 0.4), rng.uniform(-0.4, 0.4), rng.uniform(-3, 3)
        body = Rotation.from_euler("ZYX", [yaw, pitch, roll])
        pan, tilt = rng.uniform(-1.0, 1.0), rng.uniform(-1.5, 0.3)
        head = Rotation.from_euler("ZYX", [yaw + pan, tilt, 0.0])
        sent = {
            GimbalFrame.EARTH: head,
            GimbalFrame.VEHICLE: Rotation.from_euler("ZYX", [pan, tilt, 0.0]),
            GimbalFrame.BODY: body.inv() * head,
        }
        for frame, rotation in sent.items():
            earth = to_earth(of_scipy(rotation), frame, of_scipy(body))
            assert angle(earth, of_scipy(head)) < 1e-6, frame


@pytest.mark.parametrize("tilt_deg", [-30.0, -89.0, -90.0, -95.0, 89.0, 90.0])
def test_servo_angles_are_composed_in_the_order_of_the_servos(tilt_deg: float) -> None:
    roll, tilt = 0.2, math.radians(tilt_deg)
    sent = quaternion.from_rpy(roll, tilt, 0.0)  # as ArduPilot encodes servo angles
    truth = Rotation.from_euler("X", roll) * Rotation.from_euler("Y", tilt)
    got = to_earth(sent, GimbalFrame.SERVO, IDENTITY)
    assert angle(got, of_scipy(truth)) < 1e-5


def sway(k: int) -> Quaternion:
    return quaternion.from_rpy(0.1 * math.sin(0.03 * k), 0.08 * math.cos(0.02 * k), 0.5)


def gimbal_history(
    frame: GimbalFrame, yaw_frame: str = "auto", turn_rad: float = 0.0
) -> VehicleHistory:
    """A head at 60 degrees down by a mount that really keeps the horizon, sent in a frame; the
    vehicle turns by ``turn_rad`` from sample to sample."""
    history = VehicleHistory(HistoryConfig(yaw_frame=yaw_frame))
    for k in range(400):
        body = quaternion.multiply(quaternion.from_rpy(0.0, 0.0, turn_rad * k), sway(k))
        q = head = quaternion.from_rpy(0.0, -1.0, 0.5 + turn_rad * k)
        if frame is GimbalFrame.BODY:
            q = quaternion.multiply(quaternion.conjugate(body), head)
        elif frame is GimbalFrame.VEHICLE:
            q = quaternion.from_rpy(0.0, -1.0, 0.0)
        history.add(AttitudeSample(None, body), T0 + k * 100 * MS)
        claimed = GimbalFrame.EARTH if frame is GimbalFrame.EARTH else GimbalFrame.VEHICLE
        history.add(GimbalSample(None, q, claimed, 1, 0), T0 + k * 100 * MS)
    return history


@pytest.mark.parametrize("turn_rad", [0.0, 0.05])
@pytest.mark.parametrize("frame", [GimbalFrame.EARTH, GimbalFrame.VEHICLE, GimbalFrame.BODY])
def test_auto_sees_through_a_wrong_claim(frame: GimbalFrame, turn_rad: float) -> None:
    history = gimbal_history(frame, turn_rad=turn_rad)
    for k in (50, 155, 333):
        state = history.state_at(T0 + k * 100 * MS + 40 * MS)
        assert state is not None and state.q_ned_gimbal_wxyz is not None
        truth = quaternion.from_rpy(0.0, -1.0, 0.5 + turn_rad * (k + 0.4))
        assert angle(state.q_ned_gimbal_wxyz, truth) < 2e-3
        assert "gimbal" in state.sources


def test_configuration_overrides_every_claim() -> None:
    history = gimbal_history(GimbalFrame.BODY, "vehicle")
    state = history.state_at(T0 + 5 * S)
    assert state is not None and state.q_ned_gimbal_wxyz is not None
    wrong = to_earth(
        quaternion.multiply(quaternion.conjugate(sway(50)), quaternion.from_rpy(0.0, -1.0, 0.5)),
        GimbalFrame.VEHICLE,
        sway(50),
    )
    assert angle(state.q_ned_gimbal_wxyz, wrong) < 1e-6
    with pytest.raises(ValueError, match="yaw_frame"):
        HistoryConfig(yaw_frame="north")


def test_too_little_sway_decides_nothing() -> None:
    level = [IDENTITY] * 200
    assert steadiest_frame(level, level) is None


def test_the_gimbal_itself_is_accepted_before_its_relay_and_before_older_messages() -> None:
    history = VehicleHistory()
    for t in (T0, T0 + 100 * MS):
        history.add(AttitudeSample(None, IDENTITY), t)
        for component, rank, pitch in ((1, 0, -0.1), (154, 0, -0.2), (154, 1, -0.3)):
            q = quaternion.from_rpy(0.0, pitch, 0.0)
            history.add(GimbalSample(None, q, GimbalFrame.EARTH, component, rank), t)
    state = history.state_at(T0 + 50 * MS)
    assert state is not None and state.q_ned_gimbal_wxyz is not None
    truth = quaternion.from_rpy(0.0, -0.2, 0.0)
    assert angle(state.q_ned_gimbal_wxyz, truth) < 1e-7


def test_the_images_decide_between_frames() -> None:
    rng = np.random.default_rng(5)
    bodies = [
        Rotation.from_euler("ZYX", [0.02 * k, 0.1 * math.sin(k), 0.1 * math.cos(2 * k)])
        for k in range(260)
    ]
    # A camera fixed to the body, whose "gimbal" reports a constant body-relative attitude.
    mount = Rotation.from_euler("Y", -1.2)
    heads = [body * mount for body in bodies]
    noise = [Rotation.from_rotvec(rng.normal(0, 1e-3, 3)) for _ in heads]
    watch, history = LatencyWatch(), VehicleHistory()
    assert history.gimbal_frame() is None
    for k, body in enumerate(bodies):
        history.add(AttitudeSample(None, of_scipy(body)), T0 + k * 100 * MS)
        claimed = GimbalSample(None, of_scipy(mount), GimbalFrame.VEHICLE, 154, 0)
        history.add(claimed, T0 + k * 100 * MS)
    for k in range(259):
        if k == 150:
            # Too few turns of a second.
            assert frame_by_images(watch.long_turns, history.claimed_at) is None
        step = of_scipy(heads[k].inv() * heads[k + 1] * noise[k])
        # The camera's stamps are 30 ms late.
        watch.add(T0 + (100 * k + 30) * MS, T0 + (100 * k + 130) * MS, step)
    verdict = frame_by_images(watch.long_turns, history.claimed_at, 30.0)
    assert verdict is not None and verdict.decided
    assert verdict.frame in (GimbalFrame.BODY, GimbalFrame.SERVO)
    assert set(verdict.refuted) == {GimbalFrame.EARTH, GimbalFrame.VEHICLE}
    history.trust_images(GimbalFrame.EARTH)
    assert history.gimbal_frame() is GimbalFrame.EARTH
    history.set_yaw_frame("servo")
    assert history.gimbal_frame() is GimbalFrame.SERVO  # the configuration stands


def test_a_head_that_stands_still_decides_nothing() -> None:
    turns = [(k * S, (k + 1) * S, IDENTITY) for k in range(20)]
    assert frame_by_images([], lambda _: (IDENTITY, IDENTITY)) is None
    assert frame_by_images(turns, lambda _: None) is None
    still = frame_by_images(turns, lambda _: (IDENTITY, IDENTITY))
    assert still is not None and not still.decided


@pytest.mark.parametrize(("step_deg", "decides"), [(0.02, False), (0.2, True)])
def test_turns_as_small_as_their_noise_decide_nothing(step_deg: float, decides: bool) -> None:
    """A camera on a body that leans steadily: each frame puts it elsewhere and turns it alike."""
    lean = quaternion.from_rpy(math.radians(2.0), 0.0, 0.0)
    seen = quaternion.from_rpy(math.radians(step_deg), 0.0, 0.0)
    bodies = {0: lean, S: quaternion.multiply(lean, seen)}
    verdict = frame_by_images([(0, S, seen)] * 40, lambda t: (IDENTITY, bodies[t]))
    assert verdict is not None and verdict.decided is decides
    assert set(verdict.refuted) == ({GimbalFrame.EARTH, GimbalFrame.VEHICLE} if decides else set())


def test_a_live_history_waits_for_the_far_side_of_a_frame() -> None:
    history = VehicleHistory(patience_s=5.0)
    now = time.monotonic_ns()
    for k in range(10):
        history.add(AttitudeSample(None, IDENTITY), now - (600 - 50 * k) * MS)
    frame = now - 90 * MS  # the newest attitude is 60 ms older than the frame
    late = AttitudeSample(None, quaternion.from_rpy(0.0, 0.0, 0.3))
    timer = threading.Timer(0.05, lambda: history.add(late, now - 50 * MS))
    timer.start()
    state = history.state_at(frame)
    timer.join()
    assert state is not None and state.q_ned_body_wxyz is not None
    # 60 of the 100 ms between the attitudes have passed.
    assert angle(state.q_ned_body_wxyz, quaternion.from_rpy(0.0, 0.0, 0.18)) < 1e-6


def test_a_live_history_waits_for_no_sample_beyond_one_just_before_the_frame() -> None:
    waits = list[float]()
    history = VehicleHistory(patience_s=5.0, wait=waits.append)
    now = time.monotonic_ns()
    for k in range(10):  # 0.01 rad in 20 ms; the newest is 10 ms older than the frame
        turned = AttitudeSample(None, quaternion.from_rpy(0.0, 0.0, 0.01 * k))
        history.add(turned, now - (190 - 20 * k) * MS)
    history.add(position(50.0, 8.0, 580.0, (0.0, 0.0, 0.0)), now - 101 * MS)
    history.add(position(50.0, 8.0, 580.0, (0.0, 0.0, 0.0)), now - 1 * MS)  # the next: in 99 ms
    state = history.state_at(now)
    assert not waits
    assert state is not None and state.q_ned_body_wxyz is not None and state.lat_deg is not None
    assert angle(state.q_ned_body_wxyz, quaternion.from_rpy(0.0, 0.0, 0.095)) < 1e-6


def test_a_live_history_does_not_wait_in_vain() -> None:
    impatient = VehicleHistory(patience_s=0.01)
    now = time.monotonic_ns()
    impatient.add(AttitudeSample(None, IDENTITY), now - 100 * MS)
    assert impatient.state_at(now - 20 * MS) is None  # nothing comes
    history = VehicleHistory(patience_s=1000.0)  # would stand still for ever if it waited
    history.add(AttitudeSample(None, IDENTITY), now)
    assert history.state_at(now) is not None  # there already
    assert history.state_at(now + 2000 * S) is None  # far ahead
    assert history.state_at(now - 3 * S) is None  # long past
    history.add(position(50.0, 8.0, 580.0, (0.0, 0.0, 0.0)), now - 5 * S)
    assert history.state_at(now) is not None  # a stream that has dried up


def test_a_position_that_is_due_later_is_not_waited_for() -> None:
    waits = list[float]()
    history = VehicleHistory(patience_s=0.3, wait=waits.append)
    now = time.monotonic_ns()
    history.add(AttitudeSample(None, IDENTITY), now)
    for late_ms in (1400, 400):  # once a second
        history.add(position(50.0, 8.0, 580.0, (0.0, 0.0, 0.0)), now - late_ms * MS)
    assert history.state_at(now) is not None and not waits  # the next one is due in 0.6 s
    history.add(position(50.0, 8.0, 580.0, (0.0, 0.0, 0.0)), now - 50 * MS)
    history.state_at(now)
    assert waits  # in 0.3 s


def test_a_slow_relay_of_the_gimbal_is_not_waited_for() -> None:
    history = VehicleHistory(patience_s=1000.0)  # would stand still for ever if it waited
    now = time.monotonic_ns()
    history.add(AttitudeSample(None, IDENTITY), now)
    history.add(GimbalSample(None, IDENTITY, GimbalFrame.EARTH, 154, 0), now)
    history.add(GimbalSample(None, IDENTITY, GimbalFrame.EARTH, 1, 1), now - 500 * MS)
    state = history.state_at(now - 10 * MS)
    assert state is not None and state.q_ned_gimbal_wxyz is not None


def test_a_live_history_waits_once_for_a_frame() -> None:
    waits = list[float]()
    history = VehicleHistory(patience_s=0.03, wait=waits.append)
    now = time.monotonic_ns()
    history.add(AttitudeSample(None, IDENTITY), now - 500 * MS)
    history.state_at(now)
    assert waits
    waits.clear()
    for apart_ms in (-20, 0, 20):  # the camera's turn about the exposure
        history.state_at(now + apart_ms * MS)
    assert not waits
    history.state_at(now + 25 * MS)
    assert waits


def test_a_live_history_forgets() -> None:
    history = VehicleHistory(HistoryConfig(keep_s=2.0))
    for k in range(2000):
        history.add(AttitudeSample(None, IDENTITY), T0 + k * 10 * MS)
    assert len(history) < 700
    before = len(history)
    history.add(PositionSample(None, 47.4, 8.5, 550.0, 100.0, None), T0 + 20 * S)
    assert len(history) == before + 1  # samples of all kinds
    assert history.state_at(T0 + 19 * S) is not None
