"""Rows of a rolling shutter against a brute-force projection by each row's own pose."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from some_views import keyframe_at
from tracked_frame import undistorted

from recon import se3
from recon.camera_model import project, rays
from recon.rolling_shutter import RowClock, Rows, RowTrack, depth_share, row_times_s
from recon.stereo.posed_image import PosedImage, VirtualStereoConfig
from recon.stereo.virtual_stereo import at_middle_row, rectify
from recon.tracking import readout_search
from recon.tracking.odometry import Odometry
from recon.tracking.prediction import inverse_depth_plane
from recon.tracking.readout_search import ReadoutSearch
from recon.types import DIRECTIONS, F64, U8, Camera, PosePrior, Shutter, StereoPair
from service.config import Config
from service.flight.scan import Scan, ScanInputs

K = np.array([[400.0, 0, 239.5], [0, 400.0, 179.5], [0, 0, 1]])
W, H = 480, 360
PLAIN = Camera(K, np.zeros(5), (W, H))
LENS = replace(PLAIN, distortion=np.array([-0.2, 0.05, 0.001, -0.002, 0.01]))
RATE = np.array([0.4, -0.5, 0.2, 6.0, -5.0, 1.0])
CHANGE = np.array([-3.0, 2.0, 1.0, 0.5, 0.3, 0.1])


def rows_of(camera: Camera, readout_s: float = 0.03, direction: str = "down") -> Rows:
    return Rows(RowClock(replace(camera, shutter=Shutter(readout_s, direction))), RATE, CHANGE)


def seen(points: F64, rate: F64, change: F64, readout_s: float, axis: int = 1) -> F64:
    """(N, 2) where rows exposed from the top down, or columns from the left (``axis`` 0), see
    points (N, 3) of the middle row's camera."""
    out = project(K, points)
    for i, X in enumerate(points):
        for _ in range(8):  # each step errs by a fiftieth of the one before
            t = readout_s * ((out[i, axis] + 0.5) / (W, H)[axis] - 0.5)
            T = se3.exp(t * rate + 0.5 * t * t * change)
            out[i] = project(K, se3.transform(T, X[None]))[0]
    return out


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_the_clock_counts_rows_of_the_distorted_image(direction: str) -> None:
    lens = replace(LENS, shutter=Shutter(0.02, direction))
    xy = np.random.default_rng(0).uniform(-0.4, 0.4, (50, 2))
    ray = np.c_[xy, np.ones(50)]
    uv = cv2.projectPoints(ray, np.zeros(3), np.zeros(3), K, LENS.distortion)[0][:, 0]
    axis = 0 if direction in ("right", "left") else 1
    times = row_times_s(lens)
    expected = np.interp(uv[:, axis], np.arange(len(times)), times)
    np.testing.assert_allclose(RowClock(lens).seconds(ray), expected, atol=2e-5)
    assert (times[0] < 0) == (direction in ("down", "right"))


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_a_negative_readout_is_that_of_the_opposite_direction(direction: str) -> None:
    there = replace(LENS, shutter=Shutter(0.02, direction))
    back = replace(LENS, shutter=Shutter(0.0, direction).reading(-0.02))
    assert back.shutter.readout_s == 0.02
    np.testing.assert_allclose(row_times_s(back), -row_times_s(there))
    assert there.shutter.reading(0.03) == Shutter(0.03, direction)


def test_pixels_go_to_the_middle_row_and_back() -> None:
    rng = np.random.default_rng(1)
    uv = rng.uniform([10, 10], [W - 10, H - 10], (200, 2))
    depth = rng.uniform(40, 70, 200)
    points = rays(K, uv) * depth[:, None]
    there = seen(points, RATE, CHANGE, 0.03)
    rows = rows_of(PLAIN)
    assert np.linalg.norm(there - uv, axis=1).max() > 3.0
    np.testing.assert_allclose(rows.at_rows(K, uv, 1 / depth), there, atol=0.01)
    np.testing.assert_allclose(rows.at_middle(K, there, 1 / depth), uv, atol=0.02)


def each_swinging(t: F64) -> F64:
    """(N, 4, 4) T_camera_world, at (N,) times, of a head that swings at 1 Hz and up to 30 degrees
    per second."""
    turn = 0.083 * np.stack([np.sin(2 * np.pi * t), np.sin(5.6 * t + 1.0), 0.0 * t], axis=1)
    R = se3.so3_exp(np.array([0.0, 0.0, 0.4])) @ np.diag([1.0, -1, -1]) @ se3.each_so3_exp(turn)
    out = np.tile(np.eye(4), (len(t), 1, 1))
    out[:, :3, :3], out[:, :3, 3] = R, np.stack([8.0 * t - 20, t, 60.0 + 0.0 * t], axis=1)
    return se3.each_inverse(out)


def swinging(t: float) -> F64:
    """(4, 4) of one time."""
    return np.asarray(each_swinging(np.array([t]))[0])


def derivative(t: float) -> F64:
    step = 1e-4
    there, back = swinging(t + step), swinging(t - step)
    return se3.log(there @ se3.inverse(back)) / (2 * step)


def test_neighbours_tell_how_the_rows_moved() -> None:
    track = RowTrack(replace(PLAIN, shutter=Shutter(0.03)))
    frames = []
    for i in range(12):
        frame = track.expect(int(i * 1e9 / 15), PosePrior(), swinging(i / 15))
        track.add(frame, swinging(i / 15))
        frames.append(frame)
    assert [f.is_settled for f in frames] == [True] * 9 + [False] * 3
    assert [f.is_awaited for f in frames] == [False] * 9 + [True] * 3
    for i in (3, 6, 8):
        rows = frames[i].rows
        assert rows is not None
        np.testing.assert_allclose(rows.rate[:3], derivative(i / 15)[:3], atol=0.006)
        np.testing.assert_allclose(rows.rate[3:], derivative(i / 15)[3:], atol=0.35)


def test_rows_asked_for_late_are_those_of_their_own_segment() -> None:
    def rates(ends_first: bool) -> list[F64]:
        track = RowTrack(replace(PLAIN, shutter=Shutter(0.03)))
        frames = [track.expect(0, PosePrior(), swinging(0.0))]
        for i in range(6):
            frames.append(track.expect(int(i * 1e9 / 15), PosePrior(), swinging(i / 15)))
            track.add(frames[-1], swinging(i / 15))
        if ends_first:
            track.begin()
            track.add(track.expect(int(6e9 / 15), PosePrior(), swinging(9.0)), swinging(9.0))
        return [frame.rows.rate for frame in frames if frame.rows is not None]

    asked_late, asked_before = rates(ends_first=True), rates(ends_first=False)
    assert len(asked_late) == 7
    np.testing.assert_array_equal(asked_late, asked_before)


def test_telemetry_speaks_for_frames_far_apart() -> None:
    turn, velocity = np.array([0.1, 0.2, -0.3]), np.array([8.0, 1.0, 0.0])
    prior = PosePrior(velocity_m_s=velocity, turn_rad_s=turn)
    track = RowTrack(replace(PLAIN, shutter=Shutter(0.03)))
    for i in range(4):
        frame = track.expect(i * 2_000_000_000, prior, swinging(2.0 * i))
        track.add(frame, swinging(2.0 * i))
        assert frame.rows is not None
        moved = se3.exp(0.01 * frame.rows.rate) @ swinging(2.0 * i)
        centre = se3.inverse(moved)[:3, 3] - se3.inverse(swinging(2.0 * i))[:3, 3]
        np.testing.assert_allclose(centre, 0.01 * velocity, atol=2e-4)
        turned = swinging(2.0 * i)[:3, :3] @ moved[:3, :3].T
        np.testing.assert_allclose(se3.so3_log(turned), 0.01 * turn, atol=1e-9)


def test_telemetry_is_asked_where_frames_say_too_little() -> None:
    track = RowTrack(replace(PLAIN, shutter=Shutter(0.03)))
    asked = []
    for i in range(4):
        time_ns = int(i * 1e9 / 15)
        asked.append(track.needs_telemetry(time_ns))
        track.add(track.expect(time_ns, PosePrior(), swinging(i / 15)), swinging(i / 15))
    assert asked == [True, True, False, False]
    assert track.needs_telemetry(2_000_000_000)
    track.stop()
    assert not track.needs_telemetry(2_000_000_000)
    assert not RowTrack(LENS).needs_telemetry(0)


def test_a_global_shutter_has_no_rows() -> None:
    track = RowTrack(LENS)
    frame = track.expect(0, PosePrior(turn_rad_s=np.ones(3)), swinging(0.0))
    track.add(frame, swinging(0.0))
    uv = np.array([[3.0, 4.0]])
    assert frame.rows is None and frame.is_settled and frame.at_middle(K, uv, np.ones(1)) is uv


@cache
def texture() -> U8:
    rng = np.random.default_rng(0)
    out = np.zeros((2000, 2000), np.float32)
    for size in (8, 25, 80, 250, 1000, 2000):
        layer = rng.normal(0, 1, (size, size)).astype(np.float32)
        out += cv2.resize(layer, (2000, 2000), interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.clip((out - out.mean()) / out.std() * 45 + 128, 0, 255), np.uint8)


def photograph(ground: U8, t: float, readout_s: float) -> U8:
    """(H, W) level ground of 0.12 m a pixel, each row by its own pose, downwards."""
    T = se3.each_inverse(each_swinging(t + readout_s * ((np.arange(H) + 0.5) / H - 0.5)))
    x, y = (np.arange(W) - K[0, 2]) / K[0, 0], (np.arange(H) - K[1, 2]) / K[1, 1]
    of_row = y[:, None] * T[:, :3, 1] + T[:, :3, 2]
    east, north, up = (x * T[:, k, :1] + of_row[:, k, None] for k in range(3))
    far = -T[:, 2, 3:] / up
    at = [(T[:, k, 3:] + far * d + 120.0) / 0.12 for k, d in enumerate((east, north))]
    columns, rows = (a.astype(np.float32) for a in at)
    return np.asarray(cv2.remap(ground, columns, rows, cv2.INTER_LINEAR), np.uint8)


@pytest.fixture(scope="module")
def flown() -> list[U8]:
    ground = texture()
    return [photograph(ground, i / 15, 0.03) for i in range(40)]


def height_errors(flown: list[U8], shutter: Shutter) -> F64:
    """(N,) metres that the landmarks of the odometry's keyframes lie off the level ground."""
    odometry = Odometry(PLAIN, lens=replace(PLAIN, shutter=shutter))
    for i, image in enumerate(flown):
        T = se3.inverse(swinging(i / 15))
        turn = -derivative(i / 15)[:3]
        prior = PosePrior(
            T[:3, :3], 0.01, 0.03, T[:3, 3], np.full(3, 0.5), 60.0, 1.0,
            velocity_m_s=np.array([8.0, 1.0, 0.0]), turn_rad_s=turn,
        )  # fmt: skip
        assert odometry.track(undistorted(image, i, int(i * 1e9 / 15), prior))[-1].state != "lost"
    off = []
    for key in odometry.keyframes:
        points = key.landmarks[key.landmark[key.landmarks.known(key.landmark)]]
        off.append(points[:, 2] - np.median(points[:, 2]))
    return np.concatenate(off)


@pytest.mark.slow
def test_the_odometry_sees_level_ground_through_a_rolling_shutter(flown: list[U8]) -> None:
    known = np.median(np.abs(height_errors(flown, Shutter(0.03))))
    ignored = np.median(np.abs(height_errors(flown, Shutter())))
    assert known < 0.12 and ignored > 4 * known


@pytest.mark.slow
def test_frames_after_the_first_tell_how_its_rows_moved(flown: list[U8]) -> None:
    """Telemetry's turn is a tenth of a second late."""
    rolling = replace(PLAIN, shutter=Shutter(0.03))
    odometry = Odometry(PLAIN, lens=rolling)
    for i, image in enumerate(flown[:16]):
        T, turn = se3.inverse(swinging(i / 15)), -derivative(i / 15 - 0.1)[:3]
        prior = PosePrior(
            T[:3, :3], 0.01, 0.03, T[:3, 3], np.full(3, 0.5), 60.0, 1.0,
            velocity_m_s=np.array([8.0, 1.0, 0.0]), turn_rad_s=turn, sigma_turn_rad_s=0.2,
        )  # fmt: skip
        odometry.track(undistorted(image, i, int(i * 1e9 / 15), prior))
    first = odometry.keyframes[0].row_motion
    assert first.time_ns == 0 and first.is_measured and first.rows is not None
    off = first.rows.rate[:3] - derivative(0.0)[:3]
    late = derivative(-0.1)[:3] - derivative(0.0)[:3]
    assert np.linalg.norm(off) < 0.7 * np.linalg.norm(late)


def pair_of(rolling: bool) -> tuple[PosedImage, PosedImage, F64]:
    """Two views 6 m apart and points (N, 3) of rough ground in the left one's camera.

    The shutter moves with the flight, from the left to the right.
    """
    rng = np.random.default_rng(4)
    world = np.c_[rng.uniform([-39, -18], [11, 18], (300, 2)), rng.uniform(0, 12, 300)]
    clock = RowClock(replace(PLAIN, shutter=Shutter(0.03, "right")))
    views = []
    for t in (0.4, 1.15):
        rows = Rows(clock, derivative(t), np.zeros(6)) if rolling else None
        scene = inverse_depth_plane(se3.transform(swinging(t), world))
        blank = np.zeros((H, W), np.uint8)
        views.append(PosedImage(None, blank, K, se3.inverse(swinging(t)), rows=rows, scene=scene))
    return views[0], views[1], se3.transform(swinging(0.4), world)


def test_stereo_measures_along_the_baseline_between_the_rows() -> None:
    """Points above the ground keep their depth though their rows stood elsewhere."""
    left, right, points = pair_of(rolling=True)
    pair = rectify(left, right, points, VirtualStereoConfig(width_px=160, guided=False))
    assert isinstance(pair, StereoPair) and left.scene is not None and right.scene is not None
    T_right_left = se3.inverse(right.T_odom_camera) @ left.T_odom_camera
    R_right = pair.R_left_keyframe @ T_right_left[:3, :3].T
    x = []
    for view, X, R in (
        (left, points, pair.R_left_keyframe), (right, se3.transform(T_right_left, points), R_right),
    ):  # fmt: skip
        assert view.rows is not None and view.scene is not None
        there = seen(X, view.rows.rate, view.rows.change, 0.03, axis=0)
        flat = view.rows.at_middle(K, there, rays(K, project(K, X)) @ view.scene)
        x.append(project(pair.K, rays(K, flat) @ R.T))
    disparity = x[0][:, 0] - x[1][:, 0]
    at = np.c_[x[0], np.ones(len(points))]
    z = (points @ pair.R_left_keyframe.T)[:, 2]
    ground = rays(pair.K, x[0]) @ (pair.R_left_keyframe @ left.scene)
    # What the pair adds to the disparity of the shifted images is the same for all labels.
    base = float(np.linalg.norm(T_right_left[:3, 3]))
    shift = pair.K[0, 0] * (pair.baseline_m - base) * ground
    corrected = pair.K[0, 0] * pair.baseline_m / (disparity + shift)
    plain = pair.K[0, 0] * base / disparity
    assert np.median(np.abs(plain / z - 1)) > 3 * np.median(np.abs(corrected / z - 1))
    assert np.median(np.abs(corrected / z - 1)) < 2e-4
    global_pair = rectify(
        *pair_of(rolling=False)[:2], points, VirtualStereoConfig(width_px=160, guided=False)
    )
    assert isinstance(global_pair, StereoPair)
    np.testing.assert_allclose((pair.plane - global_pair.plane) @ at.T, shift, atol=1e-9)


def test_the_image_becomes_that_of_the_middle_row() -> None:
    ground = texture()
    T = swinging(0.5)
    rows = Rows(RowClock(replace(PLAIN, shutter=Shutter(0.03))), derivative(0.5), np.zeros(6))
    corners = rays(K, np.array([[0.0, 0], [W, 0], [0, H], [W, H]]))
    down = corners @ T[:3, :3]
    scene = inverse_depth_plane(corners * (-60.0 / down[:, 2])[:, None])
    image = photograph(ground, 0.5, 0.03)
    view = PosedImage(None, image, K, se3.inverse(T), rows=rows, scene=scene)
    middle, pinhole = at_middle_row(view, image), photograph(ground, 0.5, 0.0)
    inside = (slice(8, -8), slice(8, -8))
    images = [
        cv2.GaussianBlur(i[inside].astype(float), (0, 0), 3) for i in (middle, image, pinhole)
    ]
    off = [np.abs(i - images[2]).mean() for i in images[:2]]
    assert off[0] < 0.2 * off[1]
    assert at_middle_row(replace(view, rows=None), image) is image


def found_by_images(readout_s: float, sigma_s: float, windows: int) -> ReadoutSearch:
    """A search of which so many windows show a readout."""
    search = ReadoutSearch(RowClock(PLAIN), PLAIN.K)
    search.readout_s, search.sigma_s, search.windows = readout_s, sigma_s, windows
    return search


@pytest.mark.parametrize(("readout_s", "way", "expected"), [
    (0.02, "down", Shutter(0.02, "down")),
    (-0.02, "right", Shutter(0.02, "left")),
])  # fmt: skip
def test_a_sure_readout_names_a_shutter(readout_s: float, way: str, expected: Shutter) -> None:
    def found(sigma_s: float) -> Shutter | None:
        scan = Mock(Scan, mapper=Mock(), inputs=Mock(ScanInputs))
        scan.mapper.odometry.readout = found_by_images(readout_s, sigma_s, 3)
        config = Config()
        scan.inputs.config = replace(config, camera=replace(config.camera, readout_ms="auto"))
        scan.inputs.camera = replace(PLAIN, shutter=Shutter(0.0, way))
        return Scan.found_shutter(scan)

    assert found(0.001) == expected
    assert found(0.01) is None


def searched(readout_s: float, frames: int) -> tuple[ReadoutSearch, float | None]:
    """The readout that the odometry finds, from nothing, and the one it uses then; None: global."""
    ground = texture()
    odometry = Odometry(PLAIN, lens=PLAIN, seeks_readout=True)
    for i in range(frames):
        T = se3.inverse(swinging(i / 15))
        prior = PosePrior(T[:3, :3], 0.01, 0.03, T[:3, 3], np.full(3, 0.5), 60.0, 1.0)
        odometry.track(
            undistorted(photograph(ground, i / 15, readout_s), i, int(i * 1e9 / 15), prior)
        )
    assert odometry.readout is not None and odometry.readout.windows
    rows = odometry.keyframes[-1].row_motion.rows
    return odometry.readout, None if rows is None else rows.clock.readout_s


@pytest.mark.parametrize(("readout_s", "frames"), [(0.02, 260), (-0.015, 140)])
@pytest.mark.slow
def test_the_readout_is_found_from_the_images(readout_s: float, frames: int) -> None:
    found, used = searched(readout_s, frames)
    assert found.is_sure and used == found.readout_s
    assert found.readout_s == pytest.approx(readout_s, abs=5e-4)
    assert found.sigma_s < 5e-4


@pytest.mark.slow
def test_three_keyframes_show_the_readout_first() -> None:
    """Later ones are bent more by what was not known."""
    found, used = searched(0.03, 40)
    assert found.windows == 1 and used == found.readout_s
    assert found.readout_s == pytest.approx(0.03, abs=1e-3)


@pytest.mark.parametrize(("sharpness", "expected"), [(1e-3, 0.03), (1e6, 0.012)])
def test_a_known_readout_gives_way_to_sharp_images_alone(
    sharpness: float, expected: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = RowClock(replace(PLAIN, shutter=Shutter(0.03)))

    def cost(window: object, tried_s: float, K: F64) -> tuple[float, int]:
        return 100.0 + sharpness * (1e3 * (tried_s - 0.012)) ** 2, 400

    monkeypatch.setattr(readout_search, "window_cost", cost)
    search = ReadoutSearch(clock, PLAIN.K)
    for first in range(0, 40, 10):
        search.update([keyframe_at(first + k, np.eye(4), is_measured=True) for k in range(5)])
    assert clock.readout_s == pytest.approx(expected)


@pytest.mark.slow
def test_a_global_shutter_is_not_taken_for_a_rolling_one() -> None:
    found, used = searched(0.0, 140)
    assert not found.is_sure and abs(found.readout_s) < 3e-4
    assert found.is_none and used is None  # frames to come are tracked as those of a global one


@pytest.mark.parametrize("t", [0.0, 0.3, 0.8])
def test_the_share_of_depth_is_what_the_rows_do_to_it(t: float) -> None:
    at = (t, t + 0.75)
    poses = [swinging(s) for s in at]
    rates = [se3.log(swinging(s + 1e-3) @ se3.inverse(swinging(s - 1e-3))) / 2e-3 for s in at]
    view, partner = (Rows(RowClock(PLAIN), rate, np.zeros(6)) for rate in rates)
    step = poses[1] @ se3.inverse(poses[0])
    uv = np.random.default_rng(0).uniform([60, 50], [W - 60, H - 50], (300, 2))
    up = poses[0][:3, 2]
    plane = -up / 60.0  # the ground is 60 m below
    points = rays(K, uv) / (rays(K, uv) @ plane)[:, None]
    there = se3.transform(step, points)
    left = rays(K, seen(points, rates[0], np.zeros(6), 0.02))
    right = rays(K, seen(there, rates[1], np.zeros(6), 0.02))
    ahead = left @ step[:3, :3].T  # triangulated as if each image were of one moment
    flow = step[:2, 3] - step[2, 3] * right[:, :2]
    off = right[:, :2] * ahead[:, 2:] - ahead[:, :2]
    depth = (flow**2).sum(axis=1) / (flow * off).sum(axis=1)
    error = depth / points[:, 2] - 1.0
    share = depth_share(view, partner, step, points, 0.02)
    assert share == pytest.approx(float(np.sqrt(np.mean(error**2))), rel=0.2)
    assert share == pytest.approx(2.0 * depth_share(view, partner, step, points, 0.01), rel=0.05)
    steady = Rows(RowClock(PLAIN), np.zeros(6), np.zeros(6))
    assert depth_share(steady, steady, step, points, 0.02) == 0.0


def test_the_doubt_about_a_readout_ends_when_it_is_found() -> None:
    search = ReadoutSearch(RowClock(PLAIN), PLAIN.K)
    assert search.is_open and search.doubt_s == readout_search.USUAL_S
    search = found_by_images(0.012, 0.003, 1)  # and not yet in use
    assert not search.is_open and search.doubt_s == pytest.approx(np.hypot(0.012, 0.003))
    assert found_by_images(0.001, 0.2, 1).doubt_s == readout_search.USUAL_S
    assert found_by_images(1e-4, 2e-4, 3).doubt_s < 3e-4
    known = ReadoutSearch(RowClock(replace(PLAIN, shutter=Shutter(0.03))), PLAIN.K)
    assert known.doubt_s == 0.0 and not known.is_open
