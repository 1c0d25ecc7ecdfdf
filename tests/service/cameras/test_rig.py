"""Vehicle states and image tags as priors on the camera's pose."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from mavlink.telemetry.samples import VehicleState
from recon.frames import rotation_from_rpy, rpy_from_rotation
from recon.se3 import quaternion_from_rotation
from recon.types import F64
from service.cameras.rig import ASSUMED_AGL_M, Rig, attitude_of
from service.cameras.source import GeoTag
from service.config import CameraConfig, FusionConfig, ScanConfig


def rig(camera: CameraConfig | None = None, fusion: FusionConfig | None = None) -> Rig:
    return Rig(camera or CameraConfig(), ScanConfig(), fusion or FusionConfig())


def q(roll: float, pitch: float, yaw: float) -> F64:
    degrees = (math.radians(a) for a in (roll, pitch, yaw))
    return quaternion_from_rotation(rotation_from_rpy(*degrees))


def up_and_right(R_world_camera: F64 | None) -> tuple[F64, F64, F64]:
    """Where the image's right, its top, and the view point to, in ENU."""
    assert R_world_camera is not None
    return R_world_camera[:, 0], -R_world_camera[:, 1], R_world_camera[:, 2]


def test_a_nadir_camera_of_a_vehicle_heading_east() -> None:
    """The image's top points where the nose does, the view straight down."""
    prior = rig().prior(VehicleState(0, q_ned_body_wxyz=q(0, 0, 90), sigma_yaw_rad=0.1), None)
    right, top, view = up_and_right(prior.R_world_camera)
    np.testing.assert_allclose(view, [0, 0, -1], atol=1e-9)
    np.testing.assert_allclose(top, [1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(right, [0, -1, 0], atol=1e-9)


@pytest.mark.parametrize("q_gimbal", [None, q(0, -90, 0)])
def test_images_turned_clockwise_by_a_quarter_have_the_head_s_top_on_their_right(
    q_gimbal: F64 | None,
) -> None:
    state = VehicleState(
        0, q_ned_body_wxyz=q(0, 0, 0), q_ned_gimbal_wxyz=q_gimbal, sigma_yaw_rad=0.1
    )
    stated, found = rig(CameraConfig(image_roll_deg=90.0)), rig()
    found.turn_images(90.0)
    for one in stated, found:
        right, top, view = up_and_right(one.prior(state, None).R_world_camera)
        np.testing.assert_allclose(view, [0, 0, -1], atol=1e-9)
        np.testing.assert_allclose(right, [0, 1, 0], atol=1e-9)
        np.testing.assert_allclose(top, [-1, 0, 0], atol=1e-9)


def test_roll_to_the_right_looks_to_the_left() -> None:
    state = VehicleState(0, q_ned_body_wxyz=q(10, 0, 0), sigma_yaw_rad=0.1)
    _, _, view = up_and_right(rig().prior(state, None).R_world_camera)
    assert view[0] == pytest.approx(-math.sin(math.radians(10)))


def test_the_gimbal_counts_before_the_body_unless_the_mount_is_fixed() -> None:
    state = VehicleState(
        0, q_ned_body_wxyz=q(5, 5, 0), q_ned_gimbal_wxyz=q(0, -90, 0), sigma_yaw_rad=0.1
    )
    _, top, view = up_and_right(rig().prior(state, None).R_world_camera)
    np.testing.assert_allclose(view, [0, 0, -1], atol=1e-9)
    np.testing.assert_allclose(top, [0, 1, 0], atol=1e-9)
    fixed = rig(CameraConfig(mount="fixed")).prior(state, None)
    assert fixed.R_world_camera is not None and abs(fixed.R_world_camera[0, 2]) > 0.05


@pytest.mark.parametrize(
    ("speed_m_s", "agl_m", "at_rest"),
    [(0.0, 0.1, True), (0.02, 1.5, True), (0.0, 60.0, False), (5.0, 0.1, False)],
)
def test_only_a_vehicle_on_the_ground_is_at_rest(
    speed_m_s: float, agl_m: float, at_rest: bool
) -> None:
    velocity = np.array([speed_m_s, 0.0, 0.0])
    state = VehicleState(0, lat_deg=47.0, lon_deg=8.0, alt_agl_m=agl_m, v_ned_m_s=velocity)
    assert rig().prior(state, None).is_at_rest is at_rest
    assert not rig().prior(VehicleState(0, alt_agl_m=agl_m), None).is_at_rest  # not known


def test_the_first_position_is_the_origin() -> None:
    some = rig()
    state = VehicleState(0, lat_deg=47.0, lon_deg=8.0, alt_amsl_m=500.0, sigma_h_m=1.0)
    first = some.prior(state, None)
    assert first.position_m is not None
    np.testing.assert_allclose(first.position_m, 0.0, atol=1e-6)
    north = VehicleState(0, lat_deg=47.001, lon_deg=8.0, alt_amsl_m=510.0, sigma_h_m=1.0)
    second = some.prior(north, None)
    assert second.position_m is not None and some.georeference == "gnss"
    np.testing.assert_allclose(second.position_m, [0.0, 111.2, 10.0], atol=0.2)


def test_the_camera_is_mounted_off_the_vehicles_position() -> None:
    """Half a metre ahead, 0.2 to the right and 0.1 below, of a vehicle heading east."""
    hung = rig(CameraConfig(lever_forward_m=0.5, lever_right_m=0.2, lever_down_m=0.1))
    state = VehicleState(
        0, q_ned_body_wxyz=q(0, 0, 90), lat_deg=47.0, lon_deg=8.0, alt_amsl_m=500.0,
        alt_agl_m=60.0, sigma_h_m=1.0, sigma_v_m=1.5,
    )  # fmt: skip
    prior = hung.prior(state, None)
    assert prior.position_m is not None
    np.testing.assert_allclose(prior.position_m, [0.5, -0.2, -0.1], atol=1e-6)
    assert prior.agl_m == pytest.approx(59.9)
    assumed = hung.prior(VehicleState(0, q_ned_body_wxyz=q(0, 0, 90)), None)
    assert assumed.agl_m == ASSUMED_AGL_M
    blind = rig(CameraConfig(lever_down_m=0.1), FusionConfig(gnss=False)).prior(state, None)
    assert blind.altitude_m == pytest.approx(499.9)


def test_a_image_tag_serves_when_there_is_no_telemetry() -> None:
    some = rig()
    tag = GeoTag(30.0, -98.0, 300.0, ypr_deg=(90.0, -90.0, 0.0), relative_alt_m=80.0)
    prior = some.prior(None, tag)
    assert some.georeference == "exif" and prior.agl_m == 80.0
    assert some.is_altitude_assumed and not rig().is_altitude_assumed
    assert not some.is_pressure_altitude
    some.prior(None, replace(tag, is_pressure_altitude=True))
    assert some.is_altitude_assumed and some.is_pressure_altitude
    some.prior(None, replace(tag, sigma_v_m=3.4))
    assert not some.is_altitude_assumed
    for missing in (None, 0.0):
        some = rig()
        some.prior(None, replace(tag, alt_amsl_m=missing, sigma_v_m=3.4))
        assert some.is_altitude_missing and not rig().is_altitude_missing
        some.prior(None, tag)
        assert some.is_altitude_assumed and not some.is_altitude_missing
    bare = rig().prior(None, replace(tag, relative_alt_m=None))
    assert prior.sigma_position_m is not None and bare.sigma_position_m is not None
    assert prior.sigma_position_m[2] < 10.0 < bare.sigma_position_m[2]  # a drone's barometer
    stated = rig().prior(None, replace(tag, relative_alt_m=None, sigma_v_m=3.4))
    assert stated.sigma_position_m is not None and stated.sigma_position_m[2] == 3.4
    assert stated.is_sigma_claimed and not bare.is_sigma_claimed
    flat = rig().prior(None, replace(tag, alt_amsl_m=None))  # no altitude: nothing to measure
    assert flat.sigma_position_m is not None and flat.sigma_position_m[2] > 500.0
    assert flat.is_sigma_claimed
    assert not prior.is_view_assumed and prior.sigma_yaw_rad < 0.1
    assert rig().prior(None, replace(tag, is_yaw_known=False)).sigma_yaw_rad > 1.0
    assert rig().prior(None, replace(tag, ypr_deg=None)).is_view_assumed
    _, top, view = up_and_right(prior.R_world_camera)
    np.testing.assert_allclose(view, [0, 0, -1], atol=1e-9)
    np.testing.assert_allclose(top, [1, 0, 0], atol=1e-9)


@pytest.mark.parametrize("altitude_m", [math.nan, math.inf, 1e30])
def test_a_tag_that_cannot_be_true_gives_a_sound_prior(altitude_m: float) -> None:
    """One such still would leave the pose graph without a solution."""
    prior = rig().prior(None, GeoTag(30.0, -98.0, altitude_m, sigma_h_m=1e-12))
    assert prior.position_m is not None and np.isfinite(prior.position_m).all()
    assert prior.sigma_position_m is not None and prior.sigma_position_m.min() >= 0.005


def test_without_anything_the_prior_says_how_little_it_knows() -> None:
    some = rig()
    prior = some.prior(None, None)
    assert prior.position_m is None and prior.agl_m == ASSUMED_AGL_M
    assert prior.sigma_yaw_rad > 1.0 and prior.sigma_tilt_rad > 0.05
    assert some.prior(None, None).is_agl_assumed


def test_each_part_of_the_telemetry_can_be_switched_off() -> None:
    state = VehicleState(
        0, q_ned_body_wxyz=q(20, 0, 0), lat_deg=47.0, lon_deg=8.0, alt_amsl_m=500.0,
        alt_agl_m=70.0, sigma_yaw_rad=0.1,
    )  # fmt: skip
    blind = rig(fusion=FusionConfig(gnss=False, attitude=False, altitude=False))
    prior = blind.prior(state, None)
    assert prior.position_m is None and prior.sigma_yaw_rad > 1.0
    assert prior.agl_m == ASSUMED_AGL_M
    assert rig().prior(state, None).agl_m == 70.0


def test_a_tags_height_can_be_switched_off() -> None:
    tag = GeoTag(30.0, -98.0, 300.0, ypr_deg=(90.0, -90.0, 0.0), relative_alt_m=80.0)
    without = rig(fusion=FusionConfig(altitude=False))
    assert without.prior(None, tag).agl_m == ASSUMED_AGL_M
    assert without.prior(None, tag).is_agl_assumed


def test_attitude_of_a_pose_is_that_of_the_head() -> None:
    prior = rig().prior(VehicleState(0, q_ned_gimbal_wxyz=q(3, -60, 120)), None)
    assert prior.R_world_camera is not None
    T = np.eye(4)
    T[:3, :3] = prior.R_world_camera
    np.testing.assert_allclose(np.degrees(attitude_of(T)), [3, -60, 120], atol=1e-6)


@pytest.mark.parametrize("rpy", [(0.1, 0.2, 0.3), (-0.5, 1.2, -3.0), (0.0, -math.pi / 2, 1.0)])
def test_angles_and_rotations_undo_each_other(rpy: tuple[float, float, float]) -> None:
    np.testing.assert_allclose(rpy_from_rotation(rotation_from_rpy(*rpy)), rpy, atol=1e-7)


def test_a_height_above_the_take_off_point_is_not_measured() -> None:
    state = VehicleState(0, alt_agl_m=40.0, sigma_agl_m=5.0, sources=("relative",))
    below = replace(state, sources=("rangefinder",))
    above, measured = rig().prior(state, None), rig().prior(below, None)
    assert above.agl_m == 40.0 and not above.is_agl_measured and above.sigma_agl_m >= 10.0
    assert measured.is_agl_measured and measured.sigma_agl_m == 5.0
    without = rig(fusion=FusionConfig(altitude=False)).prior(below, None)
    assert not without.is_agl_measured


def test_a_height_set_by_the_operator_is_known_whatever_it_is() -> None:
    fifty = Rig(CameraConfig(), ScanConfig(assumed_agl_m=50.0), FusionConfig())
    assert not fifty.prior(None, None).is_agl_assumed
    assert fifty.prior(None, None).is_agl_measured
    assert rig().prior(None, None).is_agl_assumed


def test_the_turn_of_the_camera_is_in_its_own_frame() -> None:
    """Looking down with the nose above: yaw turns about the view, roll about the nose."""
    level = VehicleState(0, q_ned_body_wxyz=q(0, 0, 0), sigma_yaw_rad=0.1)
    for after, axis in ((q(0, 0, 2), [0, 0, 1]), (q(2, 0, 0), [0, -1, 0]), (q(0, 2, 0), [1, 0, 0])):
        later = replace(level, time_ns=40_000_000, q_ned_body_wxyz=after)
        found = rig().turn(level, later)
        assert found is not None
        np.testing.assert_allclose(found, math.radians(50.0) * np.array(axis), atol=1e-9)


def test_the_turn_is_known_where_telemetry_begins_and_ends() -> None:
    def at(time_ns: int) -> VehicleState | None:
        if not 0 <= time_ns <= 1_000_000_000:
            return None
        yaw = q(0, 0, 30.0 * time_ns * 1e-9)
        return VehicleState(time_ns, q_ned_body_wxyz=yaw, sigma_yaw_rad=0.1)

    for time_ns in (0, 10_000_000, 500_000_000, 1_000_000_000):
        found = rig().turn_at(at, time_ns)
        assert found is not None
        np.testing.assert_allclose(found, [0, 0, math.radians(30.0)], atol=1e-9)
    assert rig().turn_at(at, 2_000_000_000) is None


def test_without_attitude_or_time_the_turn_is_unknown() -> None:
    state = VehicleState(0, q_ned_body_wxyz=q(0, 0, 0), sigma_yaw_rad=0.1)
    assert rig().turn(state, state) is None
    assert rig().turn(None, state) is None
    assert rig().turn(state, VehicleState(1_000_000)) is None


def test_an_altitude_without_accuracy_is_as_good_as_its_position_allows() -> None:
    """A fix known to 2 cm across is not off by metres in height; one of a phone may be."""
    for sigma_h_m, relative_m, sigma_v_m in (
        (0.02, None, 0.05), (0.4, None, 1.0), (4.0, None, 10.0), (100.0, None, 50.0),
        (4.0, 30.0, 5.0),
    ):  # fmt: skip
        tag = GeoTag(
            30.0, -98.0, 300.0, sigma_h_m, is_sigma_h_stated=True, relative_alt_m=relative_m
        )
        prior = rig().prior(None, tag)
        assert prior.sigma_position_m is not None
        assert prior.is_sigma_claimed == (sigma_h_m < 0.1)  # no height of RTK wanders
        assert prior.sigma_position_m[2] == pytest.approx(sigma_v_m)
    guessed = rig().prior(None, GeoTag(30.0, -98.0, 300.0, 0.02))
    assert guessed.sigma_position_m is not None and guessed.sigma_position_m[2] == 50.0
