"""Camera latency from rotation, and odometry for the autopilot."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mavlink.component.status import BodyOdometry, odometry_message
from mavlink.telemetry import latency, quaternion
from mavlink.telemetry.history import VehicleHistory
from mavlink.telemetry.latency import LatencyWatch
from mavlink.telemetry.quaternion import Quaternion
from mavlink.telemetry.samples import AttitudeSample, GimbalFrame, GimbalSample
from mavlink.wire.framing import Decoder, Framer
from mavlink.wire.messages import OutgoingMessage, Packer

S = 1_000_000_000


def attitude(t: float, strength: float = 1.0) -> Quaternion:
    return quaternion.from_rpy(
        strength * (0.12 * math.sin(2.9 * t) + 0.05 * math.sin(7.1 * t + 1.0)),
        strength * 0.1 * math.sin(1.7 * t + 0.5),
        strength * 0.4 * math.sin(0.6 * t),
    )


def watch_flight(
    latency_s: float, noise_rad: float, strength: float, hz: float, seconds: float = 40.0,
    rate: float = 0.0,
) -> LatencyWatch:  # fmt: skip
    """The view of a camera with a latency, and a clock that gains ``rate``; any mount will do."""
    rng = np.random.default_rng(7)
    watch = LatencyWatch()
    mount = Rotation.from_euler("ZYX", [0.4, -1.3, 0.1])
    step = 1.0 / hz
    for k in range(round(seconds * hz)):
        t = 2.0 + k * step
        first, second = (of_scipy_head(attitude(x, strength), mount) for x in (t, t + step))
        seen = first.inv() * second * Rotation.from_rotvec(rng.normal(0.0, noise_rad, 3))
        x, y, z, w = map(float, seen.as_quat())
        late, later = (round((at + latency_s + rate * at) * S) for at in (t, t + step))
        watch.add(late, later, (w, x, y, z))
    return watch


def of_scipy_head(q: Quaternion, mount: Rotation) -> Rotation:
    return Rotation.from_quat([q[1], q[2], q[3], q[0]]) * mount


def attitudes(
    hz: float, strength: float = 1.0, noise_rad: float = 0.0, seed: int = 11
) -> list[tuple[int, Quaternion]]:
    rng = np.random.default_rng(seed)
    samples = []
    for k in range(round(45 * hz)):
        a, b, c = map(float, rng.normal(0.0, 0.5 * noise_rad, 3))
        q = quaternion.multiply(attitude(k / hz, strength), (1.0, a, b, c))
        samples.append((round(k / hz * S), q))
    return samples


@pytest.mark.parametrize("latency_s", [-2.5, -0.08, 0.0, 0.07, 0.333])
@pytest.mark.parametrize(
    ("camera_hz", "telemetry_hz"), [(15.0, 50.0), (30.0, 20.0), (25.0, 10.0), (15.0, 3.3)]
)
@pytest.mark.slow
def test_the_latency_is_found(latency_s: float, camera_hz: float, telemetry_hz: float) -> None:
    found = watch_flight(latency_s, 5e-4, 1.0, camera_hz).estimate(
        attitudes(telemetry_hz, noise_rad=1e-3)
    )
    assert found is not None and found.correlation > 0.9 and found.is_settled
    assert found.latency_ms == pytest.approx(1e3 * latency_s, abs=10.0)
    assert abs(found.latency_ms - 1e3 * latency_s) < 4.0 * found.sigma_ms


@pytest.mark.parametrize("hz", [2, 10, 50])
def test_the_long_turns_are_those_of_two_minutes_at_any_rate(hz: int) -> None:
    watch, period_ns = LatencyWatch(), S // hz
    for k in range(130 * hz):
        gap_ns = S if k >= 65 * hz else 0  # between two runs
        step = quaternion.from_rpy(0.0, 0.0, 0.1 / hz)  # 0.1 rad/s
        watch.add(k * period_ns + gap_ns, (k + 1) * period_ns + gap_ns, step)
    assert len(watch.long_turns) == 120
    assert watch.long_turns[0][0] == 10 * S and watch.long_turns[-1][1] == 131 * S
    for start_ns, end_ns, turn in watch.long_turns:
        assert end_ns - start_ns == S
        assert turn == pytest.approx(quaternion.from_rpy(0.0, 0.0, 0.1), abs=1e-12)


@pytest.mark.parametrize("rate", [0.0, 0.003, -0.01])
def test_a_clock_that_gains_is_found(rate: float) -> None:
    found = watch_flight(0.05, 5e-4, 1.0, 15.0, rate=rate).rate(attitudes(20.0, noise_rad=1e-3))
    assert found is not None and found[1] < 1e-3
    assert abs(found[0] - rate) < 4.0 * found[1]


def test_a_rate_needs_turns_in_both_halves() -> None:
    assert LatencyWatch().rate(attitudes(20.0)) is None
    assert watch_flight(0.0, 5e-4, 1.0, 15.0, seconds=15.0).rate(attitudes(20.0)) is None
    assert watch_flight(0.0, 5e-4, 0.0, 15.0).rate(attitudes(20.0, 0.0, 1e-3)) is None


def test_a_recording_is_found_anywhere_in_its_log() -> None:
    recording = watch_flight(100.0, 5e-4, 1.0, 15.0, seconds=35.0)
    assert recording.estimate(attitudes(20.0, noise_rad=1e-3)) is None
    found = recording.anywhere(attitudes(20.0, noise_rad=1e-3))
    assert found is not None and found.is_settled
    assert found.latency_ms == pytest.approx(100e3, abs=10.0)
    assert recording.anywhere(attitudes(20.0, 0.0, 1e-3)) is None
    assert recording.anywhere([]) is None


def legs(t: float) -> Quaternion:
    """Legs of 25 s with a half turn after each, left and right in turn, in calm air."""
    n, rest = divmod(t, 29.0)
    share = 0.5 - 0.5 * math.cos(math.pi * min(max(rest - 25.0, 0.0) / 4.0, 1.0))
    yaw = math.pi * (share if n % 2 == 0 else 1.0 - share)
    air = 0.003 * math.sin(1.3 * t + 0.01 * t * t), 0.003 * math.sin(0.9 * t + 0.02 * t * t)
    return quaternion.from_rpy(*air, yaw)


@pytest.mark.parametrize("first_s", [150.0, 20.0])
def test_a_turn_that_looks_like_another_places_no_recording(first_s: float) -> None:
    """The recording is of 90 to 120 s; the log, of 35 s, holds a turn of the same kind or it."""
    rng = np.random.default_rng(5)
    watch = LatencyWatch()
    for k in range(300):
        t = 90.0 + 0.1 * k
        step = quaternion.multiply(quaternion.conjugate(legs(t)), legs(t + 0.1))
        a, b, c = map(float, rng.normal(0.0, 1e-4, 3))
        seen = quaternion.multiply(step, (1.0, a, b, c))
        watch.add(round(t * S), round((t + 0.1) * S), seen)
    for start_s, is_found in ((first_s, False), (88.0, True)):
        times = start_s + np.arange(350) / 10
        log = [(round((t - 100.0) * S), legs(float(t))) for t in times]
        found = watch.anywhere(log)
        assert (found is not None) == is_found
        assert found is None or found.latency_ms == pytest.approx(100e3, abs=20.0)


@pytest.mark.parametrize(("late_s", "is_found"), [(3.0, True), (30.0, False)])
def test_a_turn_alone_shows_a_clock_that_is_off_by_seconds_but_no_minute(
    late_s: float, is_found: bool
) -> None:
    """A gimbal holds the head still between turns."""
    rng = np.random.default_rng(6)

    def head(t: float) -> Quaternion:
        return quaternion.from_rpy(0.0, 0.0, 1.5 / (1.0 + math.exp(-3.0 * (t - 60.0))))

    watch = LatencyWatch()
    for k in range(300):
        t = 45.0 + 0.1 * k
        step = quaternion.multiply(quaternion.conjugate(head(t)), head(t + 0.1))
        a, b, c = map(float, rng.normal(0.0, 1e-4, 3))
        first_ns, second_ns = (round((x + late_s) * S) for x in (t, t + 0.1))
        watch.add(first_ns, second_ns, quaternion.multiply(step, (1.0, a, b, c)))
    log = []
    for k in range(1200):
        a, b, c = map(float, rng.normal(0.0, 5e-4, 3))
        log.append((k * S // 10, quaternion.multiply(head(0.1 * k), (1.0, a, b, c))))
    found = watch.anywhere(log)
    assert (found is not None) == is_found
    assert found is None or found.latency_ms == pytest.approx(1e3 * late_s, abs=20.0)


def test_a_gimbal_that_only_trembles_is_enough() -> None:
    # Half a degree of unsteadiness, seen and measured with errors a tenth of that.
    found = watch_flight(0.07, 2e-4, 0.08, 30.0).estimate(attitudes(20.0, 0.08, 9e-4))
    assert found is not None
    assert abs(found.latency_ms - 70.0) < 3.0 * found.sigma_ms < 40.0


@pytest.mark.slow
def test_images_in_step_with_telemetry_do_not_draw_the_latency_between_its_samples() -> None:
    ratios = []
    for seed in range(6):
        found = watch_flight(0.0, 2e-4, 0.08, 10.0).estimate(attitudes(20.0, 0.08, 1e-3, seed))
        assert found is not None
        ratios.append(found.latency_ms / found.sigma_ms)
    assert np.sqrt(np.mean(np.square(ratios))) < 2.0


def test_a_calm_flight_and_too_few_frames_say_nothing() -> None:
    assert watch_flight(0.1, 5e-4, 0.0, 15.0).estimate(attitudes(50.0, 0.0)) is None
    assert watch_flight(0.1, 5e-4, 0.0, 15.0).estimate(attitudes(50.0, 0.0, 1e-3)) is None
    assert watch_flight(0.1, 5e-4, 1.0, 15.0, seconds=6.0).estimate(attitudes(50.0)) is None
    watch = LatencyWatch()
    assert watch.estimate(attitudes(50.0)) is None
    assert watch.estimate([]) is None
    watch.add(S, S, (1.0, 0.0, 0.0, 0.0))
    watch.add(S, 2 * S, (math.nan, 0.0, 0.0, 0.0))
    assert watch.estimate(attitudes(50.0)) is None


def test_attitudes_too_far_apart_say_nothing() -> None:
    assert watch_flight(0.07, 5e-4, 1.0, 30.0).estimate(attitudes(2.0)) is None


@pytest.mark.slow
def test_one_turn_in_a_calm_flight_is_not_enough_for_a_wrong_answer() -> None:
    for seed in range(8):
        rng = np.random.default_rng(seed)
        watch = LatencyWatch()
        for k in range(1200):
            x, y, z = (float(v) for v in rng.normal(0.0, 2.5e-4, 3))
            watch.add(2 * S + k * S // 30, 2 * S + (k + 1) * S // 30, (1.0, x, y, z))
        assert watch.estimate(attitudes(20.0, 0.0, 1e-3)) is None


def test_a_steady_swing_has_two_answers_and_gets_none() -> None:
    watch = LatencyWatch()

    def swing(t: float) -> Quaternion:
        return quaternion.from_rpy(0.2 * math.sin(2 * math.pi * t / 0.6), 0.0, 0.0)

    for k in range(1200):
        t = 2.0 + k / 30
        step = quaternion.multiply(quaternion.conjugate(swing(t)), swing(t + 1 / 30))
        watch.add(round(t * S) + S // 10, round((t + 1 / 30) * S) + S // 10, step)
    assert watch.estimate([(round(k / 50 * S), swing(k / 50)) for k in range(2200)]) is None


def test_images_that_do_not_fit_the_flight_say_nothing() -> None:
    rng = np.random.default_rng(1)
    watch = LatencyWatch()
    for k in range(600):
        x, y, z = (float(v) for v in rng.normal(0, 0.01, 3))
        watch.add(2 * S + k * S // 15, 2 * S + (k + 1) * S // 15, (1.0, x, y, z))
    assert watch.estimate(attitudes(50.0)) is None


def test_turns_are_in_the_axes_at_their_start() -> None:
    rng = np.random.default_rng(3)
    a, b = (Rotation.random(50, random_state=seed) for seed in (1, 2))
    q = [r.as_quat()[:, [3, 0, 1, 2]] for r in (a, b)]
    assert latency.rotation_vectors(q[0], q[1]) == pytest.approx(
        (a.inv() * b).as_rotvec(), abs=1e-9
    )
    source = rng.normal(size=(40, 3))
    found = latency.best_rotation(source, a[0].apply(source))
    assert found == pytest.approx(a[0].as_matrix(), abs=1e-9)
    track = latency.Attitudes(attitudes(20.0))
    start, end = np.array([1.013, 2.5, 44.0, -1.0]), np.array([1.213, 2.9, 50.0, 1.0])
    turned, known = track.turns(start, end)
    assert known.tolist() == [True, True, False, False]
    for k in range(2):
        first, second = (
            of_scipy_head(attitude(t), Rotation.identity()) for t in (start[k], end[k])
        )
        assert turned[k] == pytest.approx((first.inv() * second).as_rotvec(), abs=2e-3)


def test_a_log_whose_clock_was_set_costs_no_memory_for_the_years_between() -> None:
    early = attitudes(20.0)
    years_ns = 5 * 365 * 86_400 * S
    track = latency.Attitudes(early + [(t + years_ns, q) for t, q in early])
    alone = latency.Attitudes(early)
    start = np.array([1.013, 2.5, 30.0, 44.9, 50.0])
    for offset_s in (0.0, years_ns / S):
        turned, known = track.turns(offset_s + start, offset_s + start + 0.2)
        wanted, there = alone.turns(start, start + 0.2)
        assert known.tolist() == there.tolist() == [True, True, True, False, False]
        assert turned[known] == pytest.approx(wanted[there], abs=1e-4)
    _, known = track.turns(np.array([1e6]), np.array([1e6 + 0.2]))
    assert not known.any()


def test_the_head_is_compared_when_there_is_a_gimbal() -> None:
    history = VehicleHistory()
    for k in range(100):
        history.add(AttitudeSample(None, attitude(k / 20)), k * S // 20)
    times, heads = zip(*history.heads(), strict=True)
    assert list(times) == [k * S // 20 for k in range(100)]
    np.testing.assert_allclose(heads, [attitude(k / 20) for k in range(100)], atol=1e-12)
    for k in range(100):
        level = quaternion.from_rpy(0.0, -1.0, 0.0)
        history.add(GimbalSample(None, level, GimbalFrame.EARTH, 154, 0), k * S // 20)
    assert {q for _, q in history.heads()} == {quaternion.from_rpy(0.0, -1.0, 0.0)}


def test_odometry_goes_out_as_meant() -> None:
    covariance = [[float(10 * min(i, j) + max(i, j)) for j in range(6)] for i in range(6)]
    q = quaternion.from_rpy(0.1, 0.2, 0.3)
    odometry = BodyOdometry((1.0, 2.0, -3.0), q, (4.0, 0.5, -0.25), covariance, 258, 250)
    data = Packer(0).pack(1, OutgoingMessage(191, odometry_message(odometry, 5_000_000)), 0)
    assert data is not None
    (packet,) = Framer().feed(data)
    message = Decoder().message(packet)
    assert message is not None and message.get_type() == "ODOMETRY"
    assert (message.time_usec, message.frame_id, message.child_frame_id) == (5_000_000, 20, 12)
    assert (message.x, message.y, message.z) == (1.0, 2.0, -3.0)
    w, x, y, z = message.q
    assert Rotation.from_quat([x, y, z, w]).as_euler("ZYX") == pytest.approx([0.3, 0.2, 0.1])
    upper = np.array(covariance)[np.triu_indices(6)]
    assert message.pose_covariance == pytest.approx(list(upper))
    assert (message.reset_counter, message.quality, message.estimator_type) == (2, 100, 2)
