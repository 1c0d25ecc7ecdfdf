"""Stills far apart over a painted ground whose images are exact: what turns, zooms and jumps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from mapper_events import keyframes_of
from painted_ground import CAMERA, DOWN, FOOTPRINT_M, HEIGHT_M, SIZE, pose, still
from tracked_frame import undistorted

from recon.backends import load_backend
from recon.camera_model import scaled
from recon.pipeline.mapper import Event, FramePosed
from recon.rolling_shutter import RowTrack
from recon.tracking.frame import Frame, Tracking
from recon.tracking.localisation import Localiser, Located, Start
from recon.tracking.odometry import Odometry
from recon.tracking.pnp import PnpResult
from recon.tracking.prediction import ConstantVelocity
from recon.types import F64, U8, PosePrior, Shutter
from service.config import load_config
from service.flight.pipeline import Pipeline

PLACED = ("started", "tracked", "keyframe")
OFF = 0.1


def followed(
    images: list[U8], sigma_yaw_rad: float = 3.0, step_ns: int = 2_000_000_000
) -> list[list[Frame]]:
    """The odometry over stills two seconds apart, each said to look down, its top to the north.

    By default only the nominal mount is known, and no heading.
    """
    odometry = Odometry(CAMERA)
    prior = PosePrior(DOWN, 0.1, sigma_yaw_rad, agl_m=HEIGHT_M)
    return [
        odometry.track(undistorted(image, i, i * step_ns, prior)) for i, image in enumerate(images)
    ]


def flown(
    images: list[U8], sigma_yaw_rad: float = 3.0, step_ns: int = 2_000_000_000
) -> list[Frame]:
    """Each still as it was when it came."""
    return [found[-1] for found in followed(images, sigma_yaw_rad, step_ns)]


def off_m(track: list[F64], found: list[Frame]) -> float:
    """RMS distance of the places after the best similarity."""
    pairs = [
        (f.T_odom_camera[:3, 3], T[:3, 3]) for f, T in zip(found, track, strict=True) if f.is_placed
    ]
    a, b = (np.array(x) for x in zip(*pairs, strict=True))
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    U, S, Vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1, 1, np.linalg.det(U @ Vt)])
    scale = np.trace(np.diag(S) @ flip) / np.sum(a**2)
    return float(np.sqrt(np.mean(np.sum((scale * a @ (U @ flip @ Vt).T - b) ** 2, axis=1))))


def assert_one_piece(track: list[F64], found: list[Frame], share_of_height: float) -> None:
    assert [f.state in PLACED for f in found] == [True] * len(found), [f.reason for f in found]
    assert {f.segment for f in found} == {0}
    assert off_m(track, found) < share_of_height * HEIGHT_M


@pytest.mark.parametrize("yaw_deg", [0.0, 90.0])
@pytest.mark.slow
def test_stills_at_60_percent_overlap_are_one_piece(yaw_deg: float) -> None:
    """Straight on, and with a quarter turn before every shot."""
    step = 0.4 * FOOTPRINT_M * (1.0 if yaw_deg == 0.0 else 0.75)
    track = [pose(step * (i - 4), yaw_deg * i, seed=i) for i in range(9)]
    assert_one_piece(track, flown([still(T) for T in track]), 0.02)


@pytest.mark.slow
def test_a_time_lapse_is_one_piece() -> None:
    """Video of a tenth of a second a frame that jumps and turns as stills do."""
    track = [pose(0.3 * FOOTPRINT_M * (i - 2), 60.0 * (i % 3), seed=i) for i in range(5)]
    found = flown([still(T) for T in track], step_ns=100_000_000)
    assert_one_piece(track, found, 0.02)


@pytest.mark.slow
def test_headings_that_are_wrong_do_not_part_the_flight() -> None:
    """Tags that say north to five degrees while the camera turns by 40 at every shot."""
    track = [pose(0.3 * FOOTPRINT_M * (i - 3), 40.0 * i, seed=i) for i in range(7)]
    assert_one_piece(track, flown([still(T) for T in track], sigma_yaw_rad=0.09), 0.02)


@pytest.mark.slow
def test_a_camera_that_climbs_and_sinks_is_followed() -> None:
    heights = [40.0, 42.0, 44.0, 66.0, 68.0, 45.0, 43.0]
    track = [
        pose(0.3 * FOOTPRINT_M * (i - 3), 25.0 * i, height, seed=i)
        for i, height in enumerate(heights)
    ]
    assert_one_piece(track, flown([still(T) for T in track]), 0.03)


@pytest.mark.slow
def test_a_still_that_shows_nothing_does_not_part_the_flight() -> None:
    """The one after it is found in an earlier one than the last keyframe, turned around."""
    track = [pose(0.25 * FOOTPRINT_M * (i - 4), 0.0, seed=i) for i in range(5)]
    track += [pose(0.25 * FOOTPRINT_M * (i - 4), 180.0, seed=10 + i) for i in (2, 1)]
    images = [still(T) for T in track]
    images.insert(5, np.full(SIZE[::-1], 120, np.uint8))
    found = flown(images)
    assert found.pop(5).state == "lost"
    assert_one_piece(track, found, 0.02)


@pytest.mark.slow
def test_two_views_bridge_what_has_no_landmarks() -> None:
    """Forty percent overlap: hardly anything is seen three times."""
    track = [pose(0.2 * FOOTPRINT_M * i - 60.0, seed=i) for i in range(3)]
    track += [pose(track[2][0, 3] + 0.6 * FOOTPRINT_M * i, seed=5 + i) for i in (1, 2, 3)]
    assert_one_piece(track, flown([still(T) for T in track]), 0.03)


@pytest.mark.slow
def test_stills_whose_corners_differ_are_tied_by_their_features() -> None:
    """Treetops: each still has leaves of its own on the masses that it shares."""
    camera = scaled(CAMERA, (960, 720))
    odometry, prior = Odometry(camera), PosePrior(DOWN, 0.1, 3.0, agl_m=HEIGHT_M)
    track, found = [pose(0.3 * FOOTPRINT_M * (i - 2), seed=i) for i in range(4)], list[Frame]()
    for i, T in enumerate(track):
        key = odometry.keyframes[-1] if i else None
        count = 0 if key is None else len(key.uv)
        new = undistorted(with_leaves(still(T, camera), i), i, i * 2_000_000_000, prior)
        found += odometry.track(new)
        assert key is None or len(key.uv) - count > 80
    assert_one_piece(track, found, 0.005)
    assert key is not None
    localiser, before = Localiser(camera, RowTrack(camera)), key.uv
    there = localiser.with_features(new, key, key.uv, np.zeros(len(key.uv), np.bool_))
    assert there is not None and there[1].sum() > 80
    np.testing.assert_array_equal(key.uv, before)  # a place that is there is not added again
    again = localiser.with_features(new, key, *there)
    assert again is not None
    np.testing.assert_array_equal(again[1], there[1])


def with_leaves(image: U8, seed: int) -> U8:
    """The image under corners of its own."""
    noise = np.random.default_rng(seed).normal(size=image.shape)
    leaves = np.asarray(cv2.GaussianBlur(noise, (0, 0), 0.7))
    return np.asarray(np.clip(image + 20.0 * leaves / leaves.std(), 0, 255), np.uint8)


def test_frames_that_wait_are_placed_though_features_follow_the_corners_since() -> None:
    """A camera with a known readout hovers under a canopy, and comes again as a still."""
    camera = replace(scaled(CAMERA, (960, 720)), shutter=Shutter(0.02))
    odometry, prior = Odometry(camera, camera), PosePrior(DOWN, 0.1, 3.0, agl_m=HEIGHT_M)
    shots = [(0.0, 0, 0), (0.1, 0, 40_000_000), (0.3 * FOOTPRINT_M, 1, 2_000_000_000)]
    found = list[Frame]()
    for i, (east_m, leaves, time_ns) in enumerate(shots):
        image = with_leaves(still(pose(east_m), camera), leaves)
        found += odometry.track(undistorted(image, i, time_ns, prior))
    assert [one.state for one in found] == ["started", "waiting", "keyframe"]
    assert len(odometry.keyframes[0].uv) > len(found[0].uv)


@pytest.mark.slow
def test_rows_of_a_field_are_not_taken_for_one_another() -> None:
    """Rows every 10 px hide the little that differs between them from a wide search."""
    rng = np.random.default_rng(3)

    def layer(size: int) -> F64:
        image = rng.normal(0.0, 1.0, (size, size)).astype(np.float32)
        return np.asarray(cv2.resize(image, (2400, 2400), interpolation=cv2.INTER_CUBIC))

    rows = np.cos(np.pi / 2 * (np.arange(2400)[:, None] + layer(40)))
    ground = np.clip(128 + 30 * rows + 5 * layer(1200), 0, 255).astype(np.uint8)
    camera = scaled(CAMERA, (1280, 960))
    track = [pose(0.45 * FOOTPRINT_M * i, 3.0 * i, seed=i) for i in range(3)]
    odometry, prior = Odometry(camera), PosePrior(DOWN, 0.1, 3.0, agl_m=HEIGHT_M)
    found = [
        odometry.track(undistorted(still(T, camera, ground), i, i * 2_000_000_000, prior))[-1]
        for i, T in enumerate(track)
    ]
    assert_one_piece(track, found, 0.02)


@pytest.mark.slow
def test_stills_of_other_places_are_not_joined() -> None:
    here = [pose(0.3 * FOOTPRINT_M * i - 90.0, seed=i) for i in range(3)]
    there = [pose(0.3 * FOOTPRINT_M * i + 30.0, seed=5 + i) for i in range(3)]
    each = followed([still(T) for T in here + there])
    found = [one[-1] for one in each]
    assert found[3].state == "lost"
    assert [f.state for f in found[4:]] == ["keyframe"] * 2
    assert {f.segment for f in found[4:]} == {1}
    first = each[4][0]  # the segment begins with the still that was lost when it came
    assert first.seq == 3 and first.state == "keyframe" and first.segment == 1
    assert first.reason == found[3].reason
    assert np.linalg.norm((first.T_odom_camera - found[4].T_odom_camera)[:3, 3]) > 1.0
    assert [len(one) for one in each] == [1, 1, 1, 1, 2, 1]


@pytest.mark.slow
def test_the_first_still_of_a_segment_is_placed_and_reconstructed() -> None:
    """It is lost when it comes, as nothing before shows its ground; the next one proves it."""
    track = [pose(0.3 * FOOTPRINT_M * i - 100.0, seed=i) for i in range(3)]
    track += [pose(0.3 * FOOTPRINT_M * i + 10.0, seed=5 + i) for i in range(3)]
    config = load_config(None, ["compute.upsample=false", "compute.stereo_width=240"])
    pipeline = Pipeline(CAMERA, config, load_backend("cpu"), Path("/dev/null/pages"))
    events: list[Event] = []
    for i, T in enumerate(track):
        prior = PosePrior(
            DOWN, 0.1, 0.1, T[:3, 3], np.full(3, 0.5), agl_m=HEIGHT_M, sigma_agl_m=2.0
        )
        image = np.repeat(still(T)[..., None], 3, axis=2)
        events += pipeline.mapper.track(Frame(image, i * 2_000_000_000, i, prior))
    events += pipeline.mapper.finish()
    posed = [event for event in events if isinstance(event, FramePosed)]
    assert [event.frame.seq for event in posed] == [0, 1, 2, 3, 3, 4, 5]
    lost, late = posed[3:5]
    assert lost.frame.state is Tracking.LOST and late.is_view
    assert late.frame.is_placed and late.frame.seq == 3 and late.pose is not None
    np.testing.assert_allclose(late.pose.T_world_camera[:3, 3], track[3][:3, 3], atol=2.0)
    keyframes = [keyframe.seq for keyframe in keyframes_of(events)]
    assert keyframes == list(range(6))
    assert pipeline.mapper.refusals().total() == 0


class TwoStarts(Localiser):
    """Of two starts in one keyframe the first is matched by more corners, the second explained by
    more landmarks."""

    def starts(self, new: Frame, keyframes: Sequence[Frame], *_: object) -> Iterator[Start]:
        for share in (OFF, 2.0 * OFF):
            yield keyframes[-1], np.eye(4), share, False

    def pose_from(
        self, key: Frame, new: Frame, T_camera_odom: F64, share: float, *_: object
    ) -> Located:
        is_off = share == OFF
        explained = np.arange(90) < (30 if is_off else 80)
        solved = PnpResult(T_camera_odom, np.eye(6), explained)
        return Located(key, solved, np.zeros((90, 2)), explained | is_off, 1.0, share)


def test_corners_without_a_landmark_do_not_choose_the_pose() -> None:
    """Of two starts the one whose pose explains more landmarks wins, however many corners match."""
    nowhere = undistorted(np.zeros(SIZE[::-1], np.uint8), 0, 0, PosePrior())
    motion = ConstantVelocity(0, np.eye(4), PosePrior())
    localiser = TwoStarts(CAMERA, RowTrack(CAMERA))
    found = localiser.locate(nowhere, [nowhere], motion, low_frame_rate=True, lost=False)
    assert isinstance(found, Located) and found.found_share != OFF and found.explained == 80
    first = localiser.locate(nowhere, [nowhere], motion, low_frame_rate=False, lost=False)
    assert isinstance(first, Located) and first.found_share == OFF  # of video it is taken at once
