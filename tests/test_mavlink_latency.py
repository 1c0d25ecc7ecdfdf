"""Camera latency from rotation, and odometry for the autopilot."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mavlink import quaternion
from mavlink.framing import Decoder, Framer
from mavlink.history import VehicleHistory
from mavlink.latency import LatencyWatch
from mavlink.messages import Outgoing
from mavlink.odometry import Odometry, odometry_message
from mavlink.packer import Packer
from mavlink.quaternion import Quaternion
from mavlink.samples import AttitudeSample, GimbalFrame, GimbalSample

S = 1_000_000_000


def attitude(t: float, strength: float = 1.0) -> Quaternion:
    return quaternion.from_rpy(
        strength * (0.12 * math.sin(2.9 * t) + 0.05 * math.sin(7.1 * t + 1.0)),
        strength * 0.1 * math.sin(1.7 * t + 0.5),
        strength * 0.4 * math.sin(0.6 * t),
    )


def watch_flight(latency_s: float, noise_rad: float, strength: float, hz: float) -> LatencyWatch:
    """What a camera with a latency sees; its mount does not matter."""
    rng = np.random.default_rng(7)
    watch = LatencyWatch()
    mount = quaternion.from_rpy(0.1, -1.3, 0.4)
    step = 1.0 / hz
    for k in range(round(40 * hz)):
        t = 2.0 + k * step
        heads = [quaternion.multiply(attitude(x, strength), mount) for x in (t, t + step)]
        seen = quaternion.angle_between(*heads) + float(rng.normal(0.0, noise_rad))
        stamp = round((t + latency_s) * S)
        watch.add(stamp, stamp + round(step * S), seen)
    return watch


def attitudes(hz: float, strength: float = 1.0) -> list[tuple[int, Quaternion]]:
    return [(round(k / hz * S), attitude(k / hz, strength)) for k in range(round(45 * hz))]


@pytest.mark.parametrize("latency_s", [-0.08, 0.0, 0.12, 0.333])
@pytest.mark.parametrize(("camera_hz", "telemetry_hz"), [(15.0, 50.0), (30.0, 20.0)])
def test_the_latency_is_found(latency_s: float, camera_hz: float, telemetry_hz: float) -> None:
    watch = watch_flight(latency_s, 5e-4, 1.0, camera_hz)
    found = watch.estimate(attitudes(telemetry_hz))
    assert found is not None and found.correlation > 0.9
    assert found.latency_ms == pytest.approx(1e3 * latency_s, abs=5.0)
    assert abs(found.latency_ms - 1e3 * latency_s) < 4.0 * found.sigma_ms
    assert found.sigma_ms < 15.0


def test_a_calm_flight_and_too_few_frames_say_nothing() -> None:
    assert watch_flight(0.1, 5e-4, 0.01, 15.0).estimate(attitudes(50.0, 0.01)) is None
    watch = LatencyWatch()
    assert watch.estimate(attitudes(50.0)) is None
    watch.add(S, S, 0.1)
    watch.add(S, 2 * S, math.nan)
    assert watch.estimate(attitudes(50.0)) is None
    with pytest.raises(ValueError, match="upwards"):
        LatencyWatch((100.0, 100.0))


def test_pictures_that_do_not_fit_the_flight_say_nothing() -> None:
    rng = np.random.default_rng(1)
    watch = LatencyWatch()
    for k in range(600):
        watch.add(2 * S + k * S // 15, 2 * S + (k + 1) * S // 15, abs(float(rng.normal(0, 0.02))))
    assert watch.estimate(attitudes(50.0)) is None


def test_the_head_is_compared_when_there_is_a_gimbal() -> None:
    history = VehicleHistory()
    for k in range(100):
        history.add(AttitudeSample(None, attitude(k / 20)), k * S // 20)
    assert history.heads() == [(k * S // 20, attitude(k / 20)) for k in range(100)]
    for k in range(100):
        level = quaternion.from_rpy(0.0, -1.0, 0.0)
        history.add(GimbalSample(None, level, GimbalFrame.EARTH, 154, 0), k * S // 20)
    assert {q for _, q in history.heads()} == {quaternion.from_rpy(0.0, -1.0, 0.0)}


def test_odometry_goes_out_as_meant() -> None:
    covariance = [[float(10 * min(i, j) + max(i, j)) for j in range(6)] for i in range(6)]
    q = quaternion.from_rpy(0.1, 0.2, 0.3)
    odometry = Odometry((1.0, 2.0, -3.0), q, (4.0, 0.5, -0.25), covariance, 258, 250)
    data = Packer(0).pack(1, Outgoing(191, odometry_message(odometry, 5_000_000)), 0)
    assert data is not None
    (packet,) = Framer().feed(data)
    message = Decoder().message(packet)
    assert message is not None and message.get_type() == "ODOMETRY"
    assert (message.time_usec, message.frame_id, message.child_frame_id) == (5_000_000, 1, 12)
    assert (message.x, message.y, message.z) == (1.0, 2.0, -3.0)
    w, x, y, z = message.q
    assert Rotation.from_quat([x, y, z, w]).as_euler("ZYX") == pytest.approx([0.3, 0.2, 0.1])
    upper = np.array(covariance)[np.triu_indices(6)]
    assert message.pose_covariance == pytest.approx(list(upper))
    assert (message.reset_counter, message.quality, message.estimator_type) == (2, 100, 2)
    with pytest.raises(ValueError, match="6 x 6"):
        odometry_message(Odometry((0, 0, 0), q, (0, 0, 0), [[1.0]], 0, 100), 0)
