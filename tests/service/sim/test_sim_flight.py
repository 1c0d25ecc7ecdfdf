"""The simulated motion: axes, patterns, sensors; against the definitions, not our own code."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon.types import F64
from service.sim.flight import PATTERNS, FlightPlan, SensorNoise, Sensors, fly


def seconds(last: float, step: float) -> F64:
    """Times from zero to before ``last``."""
    return np.asarray(np.arange(0.0, last, step), np.float64)


def still(**changes: object) -> FlightPlan:
    """A flight without wobble or sway."""
    values: dict[str, object] = {"wobble_deg": 0.0, "sway_m": 0.0, "duration_s": 20.0}
    return FlightPlan(**(values | changes))  # type: ignore[arg-type]


def test_nadir_camera_flying_north_has_east_to_the_right() -> None:
    T = fly(still(heading_deg=0.0), 1).T_world_camera(np.array([10.0]))[0]
    np.testing.assert_allclose(T[:3, 0], [1, 0, 0], atol=1e-9)  # image right is east
    np.testing.assert_allclose(T[:3, 1], [0, -1, 0], atol=1e-9)  # image down is south
    np.testing.assert_allclose(T[:3, 2], [0, 0, -1], atol=1e-9)  # the axis looks down
    np.testing.assert_allclose(T[:3, 3], [0, 50, 60], atol=1e-6)  # 5 m/s for 10 s, 60 m up


def test_oblique_camera_looks_ahead_and_down() -> None:
    plan = still(pattern="oblique", heading_deg=90.0, duration_s=60.0)
    T = fly(plan, 1).T_world_camera(np.array([10.0]))[0]
    down = np.radians(65.0)
    np.testing.assert_allclose(T[:3, 2], [np.cos(down), 0, -np.sin(down)], atol=1e-6)
    np.testing.assert_allclose(T[:3, 0], [0, -1, 0], atol=1e-6)  # right of east is south


def test_orbit_keeps_the_centre_in_the_middle() -> None:
    flight = fly(still(pattern="orbit"), 1)
    for T in flight.T_world_camera(seconds(20.0, 3.0)):
        reach = -T[2, 3] / T[2, 2]
        np.testing.assert_allclose(T[:3, 3] + reach * T[:3, 2], 0.0, atol=1e-6)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_motion_is_smooth_and_of_the_asked_speed(pattern: str) -> None:
    plan = FlightPlan(pattern, duration_s=60.0, speed_m_s=5.0)
    flight = fly(plan, 2)
    t = seconds(60.0, 0.02)
    v = flight.velocity(t)
    np.testing.assert_allclose(np.gradient(flight.position(t), t, axis=0)[1:-1], v[1:-1], atol=0.02)
    speed = np.linalg.norm(v[:, :2], axis=1)
    assert speed.max() < 6.0
    if pattern != "hover":
        assert np.median(speed) == pytest.approx(5.0, rel=0.08)
    acceleration = np.gradient(v, t, axis=0)
    assert np.abs(acceleration).max() < 6.0
    assert np.abs(np.gradient(flight.course(t), t)).max() < np.radians(120)


def test_a_climb_ends_as_much_higher() -> None:
    flight = fly(FlightPlan(duration_s=20.0, height_m=40.0, climb_m=-15.0, sway_m=0.0), 1)
    height = flight.position(np.array([0.0, 10.0, 20.0]))[:, 2]
    np.testing.assert_allclose(height, [40.0, 32.5, 25.0], atol=0.6)
    assert flight.plan.lowest_m == 25.0 and flight.plan.highest_m == 40.0
    with pytest.raises(ValueError, match="climb"):
        FlightPlan(height_m=10.0, climb_m=-9.0)


def test_legs_are_parallel_and_spaced() -> None:
    plan = still(pattern="legs", legs=3, spacing_m=20.0, duration_s=90.0, heading_deg=0.0)
    x = fly(plan, 1).position(seconds(90.0, 0.1))[:, 0]
    for leg in (0.0, 20.0, 40.0):
        assert (np.abs(x - leg) < 0.1).mean() > 0.2


def test_wobble_has_the_asked_size() -> None:
    t = seconds(600.0, 0.1)
    flight = fly(FlightPlan(duration_s=600.0, wobble_deg=1.5, sway_m=0.2, speed_m_s=0.5), 3)
    axis = flight.T_world_camera(t)[:, :3, 2]
    tilt = np.degrees(np.arccos(np.clip(-axis[:, 2], -1, 1)))
    assert np.sqrt(np.mean(tilt**2) / 2) == pytest.approx(1.5, rel=0.25)
    assert flight.position(t)[:, 2].std() == pytest.approx(0.2, rel=0.3)


def test_same_seed_same_flight() -> None:
    t = seconds(10.0, 2.0)
    plan = FlightPlan()
    first, again, other = (fly(plan, seed).T_world_camera(t) for seed in (4, 4, 5))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-3


def test_sensor_errors_have_the_asked_size_and_wander_slowly() -> None:
    noise = SensorNoise(gps_m=1.0, gps_white_m=0.0, baro_m=0.5, attitude_deg=0.4, yaw_deg=1.0)
    flight = fly(still(duration_s=3000.0, speed_m_s=0.1), 1)
    sensors = Sensors(flight, noise, np.random.default_rng(0))
    t = seconds(3000.0, 0.5)
    error = sensors.gps(t) - flight.position(t)
    assert error[:, :2].std() == pytest.approx(1.0, rel=0.3)
    assert np.abs(np.diff(error[:, 0])).max() < 0.3  # no jumps
    height = sensors.estimate(t)[:, 2] - flight.position(t)[:, 2]
    assert height.std() == pytest.approx(0.5, rel=0.4)
    tilt = sensors.vehicle_rpy(t) - flight.vehicle_rpy(t)
    assert np.degrees(tilt[:, :2].std()) == pytest.approx(0.4, rel=0.3)
    turn = sensors.R_ned_gimbal(t) @ flight.R_ned_gimbal(t).transpose(0, 2, 1)
    angles = np.degrees(Rotation.from_matrix(turn).as_rotvec())
    assert angles[:, 2].std() == pytest.approx(1.0, rel=0.3)
    assert angles[:, :2].std() == pytest.approx(0.4, rel=0.3)


def test_silent_sensors_are_exact() -> None:
    noise = SensorNoise(0, 0, 0, 0, 0, 0, 0)
    flight = fly(FlightPlan(), 1)
    sensors = Sensors(flight, noise, np.random.default_rng(0))
    t = seconds(30.0, 0.7)
    np.testing.assert_allclose(sensors.gps(t), flight.position(t), atol=1e-12)
    np.testing.assert_allclose(sensors.estimate(t), flight.position(t), atol=1e-12)
    np.testing.assert_allclose(sensors.R_ned_gimbal(t), flight.R_ned_gimbal(t), atol=1e-12)


@pytest.mark.parametrize(("word", "slow", "white"), [("wander", 1.0, 0.0), ("white", 0.0, 1.0)])
def test_gnss_errs_slowly_or_in_each_fix(word: str, slow: float, white: float) -> None:
    noise = SensorNoise.of(word, SensorNoise(gps_m=1.0, gps_white_m=0.0))
    flight = fly(still(duration_s=3000.0, speed_m_s=0.1), 1)
    t = seconds(3000.0, 0.2)
    error = Sensors(flight, noise, np.random.default_rng(0)).gps(t) - flight.position(t)
    assert error[:, :2].std() == pytest.approx(1.0, rel=0.3)
    step = np.diff(error[:, 0]).std() / np.sqrt(2)  # what differs from fix to fix
    assert step == pytest.approx(white, abs=0.1) and noise.gps_m == slow


def test_exact_gnss_makes_every_sensor_exact() -> None:
    noise = SensorNoise.of("exact", SensorNoise())
    assert not any(getattr(noise, name) for name in noise.__slots__)
    with pytest.raises(ValueError, match="'pink'"):
        SensorNoise.of("pink", SensorNoise())


@pytest.mark.parametrize(
    "changes",
    [
        {"pattern": "zigzag"},
        {"duration_s": 0.0},
        {"height_m": -5.0},
        {"speed_m_s": float("nan")},
        {"legs": 0},
        {"spacing_m": -1.0},
        {"camera_pitch_deg": 45.0},
        {"wobble_deg": -1.0},
    ],
)
def test_nonsense_plans_are_refused(changes: dict[str, object]) -> None:
    with pytest.raises(ValueError):
        FlightPlan(**changes)  # type: ignore[arg-type]


def test_nonsense_noise_is_refused() -> None:
    with pytest.raises(ValueError, match="gps_m"):
        SensorNoise(gps_m=-1.0)
