"""The odometry over a flat, textured ground whose images are exact homographies."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import pytest
from tracked_frame import undistorted

from recon import se3
from recon.rolling_shutter import RowTrack
from recon.tracking import matching
from recon.tracking.frame import NO_IMAGE, Frame, Tracking
from recon.tracking.localisation import MIN_TRACKS, SEARCH_SHARE, TRACKED_LANDMARKS, Localiser
from recon.tracking.odometry import Odometry
from recon.types import F64, U8, Bool, Camera, PosePrior, Shutter
from service.config import ScanConfig

K = np.array([[400.0, 0, 239.5], [0, 400.0, 179.5], [0, 0, 1]])
CAMERA = Camera(K, np.zeros(5), (480, 360))
M_PER_PX = 0.12
DOWN = np.diag([1.0, -1, -1])


@pytest.fixture(scope="module")
def ground() -> U8:
    """A texture with detail at all scales, 240 m across."""
    rng = np.random.default_rng(0)
    out = np.zeros((2000, 2000), np.float32)
    for size in (8, 25, 80, 250, 1000, 2000):
        layer = rng.normal(0, 1, (size, size)).astype(np.float32)
        out += cv2.resize(layer, (2000, 2000), interpolation=cv2.INTER_CUBIC)
    out = (out - out.mean()) / out.std() * 45 + 128
    return np.asarray(np.clip(out, 0, 255).astype(np.uint8))


def photograph(ground: U8, T_world_camera: F64) -> U8:
    """The image of the plane z = 0."""
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
    plane = np.array([[M_PER_PX, 0, -120.0], [0, M_PER_PX, -120.0], [0, 0, 1]])
    H = K @ R.T @ (np.c_[np.eye(3)[:, :2], -t] @ plane)
    return np.asarray(cv2.warpPerspective(ground, H, (480, 360), flags=cv2.INTER_AREA), np.uint8)


def poses(n: int, step_m: float = 1.5, wobble: float = 0.02, seed: int = 1) -> list[F64]:
    rng = np.random.default_rng(seed)
    out = []
    for i in range(n):
        R = se3.so3_exp(np.r_[rng.normal(0, wobble, 2), 0.4 + rng.normal(0, wobble)]) @ DOWN
        out.append(se3.compose(R, np.array([step_m * i - 50.0, 0.3 * step_m * i - 20, 60.0])))
    return out


def prior_of(T: F64, rng: np.random.Generator) -> PosePrior:
    """Telemetry with an attitude good to half a degree, a fix to 0.3 m and a height to 1 m."""
    R = se3.so3_exp(rng.normal(0, 0.008, 3)) @ T[:3, :3]
    position = T[:3, 3] + rng.normal(0, 0.3, 3)
    return PosePrior(R, 0.01, 0.03, position, np.full(3, 0.5), 60.0 + rng.normal(0, 1.0), 2.0)


def fly(
    ground: U8, track: list[F64], telemetry: bool, images: dict[int, U8] | None = None
) -> tuple[Odometry, list[Frame]]:
    """Run the odometry at 5 Hz; ``images`` replaces some of the frames."""
    rng = np.random.default_rng(2)
    odometry, out = Odometry(CAMERA), []
    for i, T in enumerate(track):
        image = photograph(ground, T)
        image = (images or {}).get(i, image)
        prior = prior_of(T, rng) if telemetry else PosePrior(DOWN, 0.1, 3.0, agl_m=60.0)
        out += odometry.track(undistorted(image, i, i * 200_000_000, prior))
    return odometry, out


def drift(track: list[F64], found: list[Frame]) -> float:
    """RMS distance after the best similarity, in metres."""
    pairs = [
        (f.T_odom_camera[:3, 3], T[:3, 3]) for f, T in zip(found, track, strict=True) if f.is_placed
    ]
    a, b = (np.array(x) for x in zip(*pairs, strict=True))
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    U, S, Vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1, 1, np.linalg.det(U @ Vt)])
    scale = np.trace(np.diag(S) @ flip) / np.sum(a**2)
    return float(np.sqrt(np.mean(np.sum((scale * a @ (U @ flip @ Vt).T - b) ** 2, axis=1))))


@pytest.mark.parametrize("telemetry", [True, False])
def test_flat_ground_is_followed_without_loss(ground: U8, telemetry: bool) -> None:
    track = poses(40)
    odometry, found = fly(ground, track, telemetry)
    assert odometry.segment == 0
    assert sum(f.state in ("tracked", "keyframe") for f in found) >= 34
    assert drift(track, found) < 0.006 * 60.0


def test_an_attitude_that_contradicts_the_images_steadily_loses_against_them(ground: U8) -> None:
    """That of a vehicle which leans into its flight; a gimbal holds the camera still."""
    track, rng, odometry = poses(60, step_m=1.0), np.random.default_rng(2), Odometry(CAMERA)
    found = list[Frame]()
    for i, T in enumerate(track):
        lean = 0.35 * (1.0 - np.exp(-i / 3.0)) + 0.1 * np.sin(0.5 * i)
        R = se3.so3_exp(np.array([lean, 0.0, 0.0])) @ T[:3, :3]
        prior = prior_of(se3.compose(R, T[:3, 3]), rng)
        found += odometry.track(undistorted(photograph(ground, T), i, i * 100_000_000, prior))
    assert odometry.segment == 0
    assert all(f.is_placed for f in found[20:])
    assert drift(track, found) < 0.006 * 60.0


def test_blank_frames_are_bridged_and_named(ground: U8) -> None:
    track = poses(30)
    blank = np.full((360, 480), 120, np.uint8)
    _, found = fly(ground, track, True, {15: blank, 16: blank})
    assert found[15].state == found[16].state == "lost" and found[15].reason
    assert found[17].state in ("tracked", "keyframe") and found[17].segment == 0
    assert drift(track, found) < 0.006 * 60.0


def test_a_sudden_change_of_exposure_is_survived(ground: U8) -> None:
    track = poses(20)
    dark = {
        i: np.asarray(photograph(ground, T) * 0.5 + 10, np.uint8)
        for i, T in enumerate(track)
        if i >= 10
    }
    _, found = fly(ground, track, True, dark)
    assert all(f.state in ("tracked", "keyframe") for f in found[9:])


def test_hovering_makes_no_surface(ground: U8) -> None:
    track = poses(15, step_m=0.0, wobble=0.01)
    _, found = fly(ground, track, True)
    assert not any(f.state == "keyframe" for f in found)
    assert {f.state for f in found[1:]} == {"waiting"}


def test_pure_rotation_makes_no_surface(ground: U8) -> None:
    turned = [
        se3.compose(se3.so3_exp(np.array([0.0, 0.0, 0.05 * i])) @ DOWN, np.array([0.0, 0, 60]))
        for i in range(15)
    ]
    _, found = fly(ground, turned, True)
    assert not any(f.state == "keyframe" for f in found)


def circling(angles_rad: Iterable[float]) -> list[F64]:
    """Poses 60 m from a place that stays in the middle of the image."""
    out = []
    for angle in angles_rad:
        R = se3.so3_exp(np.array([0.0, angle, 0.0])) @ DOWN
        out.append(se3.compose(R, -60.0 * R[:, 2]))
    return out


@pytest.mark.slow
@pytest.mark.parametrize("step_rad", [0.02, 0.12], ids=["video", "stills"])
def test_a_camera_that_circles_a_place_moves(ground: U8, step_rad: float) -> None:
    """Its image stays where it is, and no attitude says that it turned."""
    track = circling(np.arange(-0.36, 0.37, step_rad))
    odometry, found = Odometry(CAMERA), []
    for i, T in enumerate(track):
        prior = PosePrior(DOWN, 0.4, 3.0, agl_m=60.0)
        time_ns = round(i * step_rad * 1e10)
        found += odometry.track(undistorted(photograph(ground, T), i, time_ns, prior))
    placed = [f.state in ("tracked", "keyframe") for f in found]
    assert odometry.segment == 0 and sum(placed) > 0.6 * len(placed)
    assert drift(track, found) < 0.02 * 60.0


@pytest.mark.parametrize("focal_px", [400.0, 330.0])
def test_a_turn_on_the_spot_without_attitude_makes_no_surface(ground: U8, focal_px: float) -> None:
    """Not even with a lens that is not the camera's own."""
    lens = replace(CAMERA, K=np.array([[focal_px, 0, 239.5], [0, focal_px, 179.5], [0, 0, 1]]))
    odometry = Odometry(lens)
    for i in range(15):
        R = se3.so3_exp(np.array([0.004 * i, 0.0, 0.1 * i])) @ DOWN
        image = photograph(ground, se3.compose(R, np.array([0.0, 0.0, 60.0])))
        (found,) = odometry.track(
            undistorted(image, i, 200_000_000 * i, PosePrior(DOWN, 0.4, 3.0, agl_m=60.0))
        )
        assert found.state in ("started", "waiting")


@pytest.mark.slow
def test_another_place_begins_a_new_segment(ground: U8) -> None:
    """A jump to where nothing of the map is seen is a loss, then a fresh start."""
    track = poses(12)
    far = [T.copy() for T in poses(24, seed=5)]
    for T in far:
        T[:3, 3] += [70.0, 60.0, 0.0]
    odometry, found = fly(ground, track + far, True)
    after = found[12:]
    assert after[0].state == "lost"
    assert odometry.segment == 1
    assert any(f.state == "keyframe" and f.segment == 1 for f in after)


def test_noise_is_not_followed() -> None:
    rng = np.random.default_rng(3)
    odometry = Odometry(CAMERA)
    states = [
        odometry.track(
            undistorted(
                rng.integers(0, 255, (360, 480), dtype=np.uint8), i, i * 200_000_000, PosePrior()
            )
        )[0].state
        for i in range(12)
    ]
    assert "keyframe" not in states and "tracked" not in states


def skipping(
    ground: U8,
    track: list[F64],
    fps: float,
    lens: Camera | None = None,
    seeks: bool = False,
    attitude: bool = True,
) -> list[Frame]:
    """Run the odometry with telemetry of constant error, without the frames that it can skip."""
    odometry, out = Odometry(CAMERA, lens, seeks_readout=seeks), []
    for i, T in enumerate(track):
        time_ns, prior = round(i * 1e9 / fps), prior_of(T, np.random.default_rng(2))
        prior = prior if attitude else replace(prior, R_world_camera=None)
        if odometry.can_skip(time_ns, prior, frames_per_step=6.0):
            out.append(Frame(NO_IMAGE, time_ns, i, prior, segment=odometry.segment))
        else:
            out += odometry.track(undistorted(photograph(ground, T), i, time_ns, prior))
    return out


def test_frames_that_hardly_differ_are_skipped_and_cost_no_accuracy(ground: U8) -> None:
    track = poses(90, step_m=0.2, wobble=0.001)
    found = skipping(ground, track, fps=30.0)
    after = found[next(i for i, f in enumerate(found) if f.state == "keyframe") :]
    followed = [i for i, f in enumerate(after) if f.state != "skipped"]
    assert max(np.diff(followed)) == 5, "six frames a second are followed"
    assert len(followed) < 0.5 * len(after)
    assert sum(f.state == "keyframe" for f in after) >= 2
    assert drift(track, found) < 0.05


@pytest.mark.slow
def test_no_frame_of_a_fast_turn_or_a_fast_flight_is_skipped(ground: U8) -> None:
    swung = poses(40, step_m=0.2, wobble=0.05)
    fast = poses(40, step_m=1.5, wobble=0.001)
    for track in (swung, fast):
        found = skipping(ground, track, fps=30.0)
        metric = next(i for i, f in enumerate(found) if f.state == "keyframe")
        assert np.mean([f.state == "skipped" for f in found[metric:]]) < 0.15


@pytest.mark.slow
def test_a_turn_that_telemetry_shows_is_followed_by_parts_of_a_keyframes_turn(ground: U8) -> None:
    """A frame turns twice as far as it moves; what telemetry does not show counts as motion."""
    track = poses(90, step_m=0.2, wobble=0.0)
    for i, T in enumerate(track):
        T[:3, :3] = se3.so3_exp(np.array([0.0, 0.0, 0.006 * i])) @ T[:3, :3]
    for attitude, apart in ((True, 5), (False, 2)):
        found = skipping(ground, track, 30.0, attitude=attitude)
        metric = next(i for i, f in enumerate(found) if f.state == "keyframe")
        followed = [i for i, f in enumerate(found[metric:]) if f.state != "skipped"]
        assert np.median(np.diff(followed)) == apart
        assert drift(track, found) < 0.05


@pytest.mark.parametrize(("readout_s", "seeks", "apart"), [(1e-6, False, 2), (0.0, True, 3)])
def test_a_rolling_shutter_skips_less(
    ground: U8, readout_s: float, seeks: bool, apart: int
) -> None:
    lens = replace(CAMERA, shutter=Shutter(readout_s))
    found = skipping(ground, poses(60, step_m=0.2, wobble=0.001), 30.0, lens, seeks)
    followed = [i for i, f in enumerate(found) if f.state in ("tracked", "keyframe")]
    assert max(np.diff(followed)) == apart


def test_it_takes_what_the_configuration_may_ask_for() -> None:
    """A smaller step passed the configuration once, and stopped the scan."""
    for step in (0.03, 1.0):
        ScanConfig(base_to_height=step)
        Odometry(CAMERA, base_to_height=step)
    for step in (0.02, 1.1):
        with pytest.raises(ValueError, match="base_to_height"):
            ScanConfig(base_to_height=step)
        with pytest.raises(ValueError, match="base_to_height"):
            Odometry(CAMERA, base_to_height=step)


def test_each_landmark_is_searched_once(ground: U8) -> None:
    """In two keyframes, for the pose of a frame between keyframes."""
    searched: list[set[int]] = []

    class Watched(Localiser):
        def search(self, key: Frame, *rest: Any) -> Any:
            found = super().search(key, *rest)
            searched.append(set(key.landmark[found[2]].tolist()))
            return found

    track = poses(24, step_m=0.8)
    odometry, out = fly(ground, track, telemetry=True)
    localiser, pairs = Watched(CAMERA, RowTrack(CAMERA)), 0
    for left, key in pairwise(odometry.keyframes):
        for n in range(key.seq + 1, min(key.seq + 4, len(track))):
            new = undistorted(photograph(ground, track[n]), n, out[n].time_ns, out[n].prior)
            start = se3.inverse(out[n].T_odom_camera)
            searched.clear()
            found = localiser.pose_from(
                key, new, start, SEARCH_SHARE, MIN_TRACKS, TRACKED_LANDMARKS, left
            )
            assert not isinstance(found, str)
            a, b = searched
            pairs += 1
            assert a and b and not a & b
            assert len(a | b) < 2 * TRACKED_LANDMARKS  # every other one at most is left out
    assert pairs > 5


def test_a_frame_that_shows_a_few_of_the_landmarks_is_not_placed_by_them(ground: U8) -> None:
    """More than a pose takes, and of those in view too few."""
    track, elsewhere = poses(8), photograph(ground, poses(40)[39])
    odometry, out = fly(ground, track, telemetry=True)
    key, last, localiser = odometry.keyframes[-1], out[-1], Localiser(CAMERA, RowTrack(CAMERA))
    start, radius_px = se3.inverse(last.T_odom_camera), SEARCH_SHARE * CAMERA.size_px[0]
    for shown_px, is_placed in ((480, True), (96, False)):
        image = photograph(ground, track[-1])
        image[:, shown_px:] = elsewhere[:, shown_px:]
        new = undistorted(image, 9, last.time_ns, last.prior)
        assert localiser.search(key, new, start, radius_px, None)[1].sum() > 2 * MIN_TRACKS
        found = localiser.pose_from(key, new, start, SEARCH_SHARE, MIN_TRACKS)
        assert (found == "too few matches") != is_placed


def test_a_few_landmarks_show_where_the_others_are(
    ground: U8, monkeypatch: pytest.MonkeyPatch
) -> None:
    at, searched = matching.Search.at, list[int]()

    def counted(self: Any, level: int, uv_b: F64, active: Bool, reach: int) -> Any:
        searched[-1] += int(active.sum())
        return at(self, level, uv_b, active, reach)

    monkeypatch.setattr(matching.Search, "at", counted)
    odometry, rng, out = Odometry(CAMERA), np.random.default_rng(2), list[Frame]()
    for i, T in enumerate(poses(20)):
        searched.append(0)
        out += odometry.track(
            undistorted(photograph(ground, T), i, i * 200_000_000, prior_of(T, rng))
        )
    between = [n for n, one in zip(searched, out, strict=True) if one.state is Tracking.TRACKED]
    assert len(between) > 8
    assert max(between) < 300  # of 450, on up to five levels


def test_motions_between_keyframes_are_as_good_as_claimed(ground: U8) -> None:
    """Their errors are about their sigmas, and the first baseline is the unit of length."""
    track = poses(40)
    odometry, _ = fly(ground, track[:8], True)
    first, second = odometry.keyframes[:2]
    along = (second.T_camera_odom @ first.T_odom_camera)[:3, 3]
    along /= np.linalg.norm(along)
    assert along @ second.covariance[3:, 3:] @ along < 1e-12 < np.trace(second.covariance[3:, 3:])
    odometry, _ = fly(ground, track, True)
    seen, true, sigmas = [], [], []
    for a, b in pairwise(odometry.keyframes[2:]):
        seen.append(b.T_camera_odom @ a.T_odom_camera)
        true.append(se3.inverse(track[b.seq]) @ track[a.seq])
        sigmas.append(np.sqrt(np.diag(b.covariance)))
    scale = np.median([np.linalg.norm(t[:3, 3]) / np.linalg.norm(s[:3, 3])
                       for s, t in zip(seen, true, strict=True)])  # fmt: skip
    errors = []
    for s, t, sigma in zip(seen, true, sigmas, strict=True):
        s[:3, 3] *= scale
        errors.append(se3.log(s @ se3.inverse(t)) / sigma)
    assert 0.3 < np.sqrt(np.mean(np.square(errors))) < 3.0
