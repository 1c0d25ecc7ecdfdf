"""The batch adjustment with ground control points against known truth."""

from __future__ import annotations

import numpy as np
import pytest

from recon import se3
from recon.posegraph.records import Loop
from recon.posegraph.smoother import State
from recon.similarity import umeyama
from recon.survey import ground_control
from recon.survey.ground_control import KeyframeTrack, Mark, adjust, map_position
from recon.types import F64, PosePrior

DOWN = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])


def true_poses(n: int = 40) -> F64:
    """Two legs 30 m apart at 60 m, there and back."""
    half = n // 2
    out = np.tile(np.eye(4), (n, 1, 1))
    for k in range(n):
        east = 5.0 * k if k < half else 5.0 * (n - 1 - k)
        out[k] = se3.compose(DOWN, np.array([east, 0.0 if k < half else 30.0, 60.0]))
    return out


def drifted(truth: F64, seed: int = 0, scale: float = 1.0) -> F64:
    """The track as vision alone would have it: small errors of each step, chained."""
    rng = np.random.default_rng(seed)
    out = np.array(truth)
    for k in range(1, len(truth)):
        step = se3.inverse(truth[k - 1]) @ truth[k]
        step[:3, 3] *= scale
        noise = np.r_[rng.normal(0, 3e-4, 3), rng.normal(0, 0.01, 3)]
        out[k] = out[k - 1] @ se3.exp(noise) @ step
    return out


def moved(poses: F64, shift: F64, turn: F64) -> F64:
    T = se3.compose(se3.so3_exp(turn), shift)
    return np.array([T @ P for P in poses])


def loose(n: int) -> F64:
    return np.tile(np.diag([0.01**2] * 3 + [1.5**2] * 3), (n, 1, 1))


def marks_of(
    truth: F64, points: F64, seed: int = 1, depth_scale: float = 1.0, with_depth: bool = True
) -> list[Mark]:
    """Marks in all keyframes that look at the points, half a pixel off."""
    rng = np.random.default_rng(seed)
    out = []
    for i, P in enumerate(points):
        for k, T in enumerate(truth):
            p = se3.transform(se3.inverse(T), P[None])[0]
            ray = p / p[2]
            if abs(ray[0]) < 0.6 and abs(ray[1]) < 0.35 and (k + i) % 3 == 0:
                ray = ray + np.r_[rng.normal(0, 7e-4, 2), 0.0]
                depth = (p[2] + rng.normal(0, 0.05)) / depth_scale if with_depth else None
                out.append(Mark(i, k, ray, 1e-3, depth, 0.08))
    return out


SPOTS = np.array(
    [[5.0, 2.0, 0.0], [90.0, -5.0, 1.0], [50.0, 16.0, 3.0], [10.0, 35.0, 0.5], [85.0, 33.0, -1.0]]
)
CHECKS = np.array([[30.0, 5.0, 2.0], [70.0, 28.0, 0.0], [48.0, 0.0, 1.0]])
TIMES: F64 = np.arange(40.0, dtype=np.float64)
SURVEY = np.array([0.02, 0.02, 0.03])


def rms(poses: F64, truth: F64) -> float:
    return float(np.sqrt(np.mean(np.sum((poses - truth)[:, :3, 3] ** 2, axis=1))))


@pytest.mark.parametrize("with_depth", [True, False])
def test_five_control_points_bring_the_map_to_its_place(with_depth: bool) -> None:
    truth = true_poses()
    before = moved(drifted(truth), np.array([1.2, -0.8, 2.0]), np.array([0.004, -0.003, 0.01]))
    track = KeyframeTrack(before, TIMES, loose(40))
    survey = SPOTS, np.tile(SURVEY, (len(SPOTS), 1))
    marks = marks_of(truth, SPOTS, with_depth=with_depth)
    found = adjust(track, survey, marks)
    assert rms(before, truth) > 2.0
    assert rms(found.poses, truth) < 0.25
    checks = marks_of(truth, CHECKS, seed=5)
    for k, P in enumerate(CHECKS):
        where = map_position(found.poses, found.scales, [m for m in checks if m.point == k])
        assert where is not None
        assert np.linalg.norm(where[0] - P) < 0.15


def test_a_wrong_scale_is_found() -> None:
    truth = true_poses()
    before = drifted(truth, scale=1 / 1.03)
    track = KeyframeTrack(before, TIMES, loose(40))
    survey = SPOTS, np.tile(SURVEY, (len(SPOTS), 1))
    marks = marks_of(truth, SPOTS, depth_scale=1.03)
    found = adjust(track, survey, marks)
    assert found.scales == pytest.approx(1.03, abs=0.004)
    assert rms(found.poses, truth) < 0.25


def test_covariances_cover_the_errors() -> None:
    truth = true_poses()
    whitened = []
    for seed in range(8):
        rng = np.random.default_rng(100 + seed)
        shift = rng.normal(0, 1.5, 3)
        before = moved(drifted(truth, seed), shift, rng.normal(0, 0.01, 3))
        places = SPOTS + rng.normal(size=SPOTS.shape) * SURVEY
        survey = places, np.tile(SURVEY, (len(SPOTS), 1))
        track = KeyframeTrack(before, TIMES, loose(40))
        found = adjust(track, survey, marks_of(truth, SPOTS, seed))
        for k in range(0, 40, 5):
            error = se3.log(truth[k] @ se3.inverse(found.poses[k]))
            whitened.append(error @ np.linalg.solve(found.covariances[k], error))
    # Normalised error squared of six degrees of freedom: mean 6 where sigmas are honest.
    assert 2.0 < np.mean(whitened) < 9.0


def test_marks_between_keyframes_count_alike() -> None:
    truth = true_poses()
    before = moved(drifted(truth), np.array([1.0, 1.0, -1.0]), np.zeros(3))
    nearby = se3.compose(se3.so3_exp(np.array([0.0, 0.02, 0.01])), np.array([1.5, 0.4, 0.1]))
    marks = []
    for m in marks_of(np.array([T @ nearby for T in truth]), SPOTS, with_depth=False):
        marks.append(Mark(m.point, m.keyframe, m.ray, m.sigma, None, 1.0, nearby))
    survey = SPOTS, np.tile(SURVEY, (len(SPOTS), 1))
    found = adjust(KeyframeTrack(before, TIMES, loose(40)), survey, marks)
    assert rms(found.poses, truth) < 0.25


def test_loops_straighten_a_track_and_false_ones_are_left_out() -> None:
    truth = true_poses()
    before = drifted(truth, seed=4)
    before[20:] = moved(before[20:], np.array([0.6, 0.4, -0.5]), np.zeros(3))
    spread = np.diag([1e-3**2] * 3 + [0.03**2] * 3)
    pairs = [(2, 37), (8, 31), (14, 25)]
    loops = [Loop(a, b, se3.inverse(truth[a]) @ truth[b], spread) for a, b in pairs]
    wrong = se3.inverse(truth[5]) @ truth[34]
    wrong[:3, 3] += [15.0, 0.0, 0.0]
    times: F64 = np.r_[np.arange(20.0), 40.0 + np.arange(20.0)]  # vision was lost between the legs
    still = KeyframeTrack(before, times, loose(40), (), [*loops, Loop(5, 34, wrong, spread)])
    found = adjust(still)
    assert found.loops_refused == (3,)
    assert len(ground_control.supported(still.loops, still.poses)) == 3
    steps = [se3.inverse(found.poses[a]) @ found.poses[b] for a, b in pairs]
    for (a, b), step in zip(pairs, steps, strict=True):
        expected = se3.inverse(truth[a]) @ truth[b]
        assert np.linalg.norm((step - expected)[:3, 3]) < 0.1
    assert set(found.residuals) >= {"vision", "link", "loop", "placing", "scale"}


def test_telemetry_places_a_track_and_a_wild_fix_does_not_move_it() -> None:
    truth = true_poses()
    rng = np.random.default_rng(2)
    before = moved(drifted(truth), np.array([3.0, -2.0, 1.0]), np.array([0.0, 0.0, 0.02]))
    sigma = np.array([0.5, 0.5, 0.8])
    priors = [
        PosePrior(T[:3, :3], 0.01, 0.03, T[:3, 3] + rng.normal(0, 0.2, 3), sigma) for T in truth
    ]
    priors[10] = PosePrior(None, position_m=truth[10][:3, 3] + 40.0, sigma_position_m=sigma)
    found = adjust(KeyframeTrack(before, TIMES, loose(40), priors))
    assert rms(found.poses, truth) < 0.4
    assert np.linalg.norm((found.poses[10] - truth[10])[:3, 3]) < 0.6
    worst = np.argmax(np.sum(found.residuals["position"] ** 2, axis=1))
    assert worst == 10


def test_readings_are_known_where_telemetry_is_and_count_as_independent_ones() -> None:
    sigma = np.array([0.5, 0.5, 0.8])
    priors = [PosePrior() for _ in range(40)]
    priors[7] = PosePrior(DOWN, 0.01, 2.0, np.array([1.0, 2.0, 3.0]), sigma)
    rows = KeyframeTrack(true_poses(), TIMES, loose(40), priors).readings()
    _, sigma_fixes, _, sigma_attitudes = rows
    assert all(np.flatnonzero(np.isfinite(r).reshape(40, -1).any(axis=1)) == [7] for r in rows)
    assert sigma_fixes[7] == pytest.approx(sigma * np.sqrt(120.0))
    turn = np.array([0.01, 0.01, 10.0])
    assert sigma_attitudes[7] == pytest.approx(turn * np.sqrt(80.0))


def test_the_derivatives_of_a_mark_are_those_of_differences() -> None:
    rng = np.random.default_rng(0)
    side = se3.exp(rng.normal(0, 0.2, 6))
    T = se3.exp(rng.normal(0, 0.3, 6))
    row = (0, 1, 1, [0.1, -0.2, 1.0], 12.0, side[:3, :3].T, side[:3, 3], [100.0, 100.0, 3.0])
    rows = np.array([row], ground_control.MARK)
    places = np.array([T[:3, 3], [1.0, 2.0, 14.0]])
    at = State(np.array([T[:3, :3], np.eye(3)]), places, np.array([0.0, 0.07]))
    error, J, columns = ground_control.of_marks(rows, at)
    assert error.shape == (1, 3) and J.shape == (1, 3, 10)
    h = 1e-6
    for k, column in enumerate(columns[0]):
        step = h * (np.arange(14) == column)
        ahead, back = (ground_control.of_marks(rows, at.moved(s))[0] for s in (step, -step))
        assert np.allclose(J[0, :, k], (ahead - back)[0] / (2 * h), rtol=1e-4, atol=1e-4)


def test_points_that_contradict_the_others_are_named() -> None:
    rng = np.random.default_rng(3)
    mapped = rng.uniform(0, 100, (6, 3))
    surveyed = mapped + np.array([1.5, -2.0, 3.0]) + rng.normal(0, 0.03, (6, 3))
    surveyed[4] += [0.0, 0.0, -48.0]  # height above the ellipsoid
    agree = ground_control.consenting(surveyed, mapped, np.full(6, 0.05))
    assert agree.tolist() == [True, True, True, True, False, True]


def test_a_similarity_from_three_points_or_none() -> None:
    rng = np.random.default_rng(5)
    a = rng.uniform(-30, 30, (4, 3))
    R = se3.so3_exp(np.array([0.1, -0.2, 2.0]))
    b = 1.7 * a @ R.T + [100.0, 20.0, -4.0]
    found = umeyama(a, b)
    assert found is not None
    assert found.scale == pytest.approx(1.7) and np.allclose(found.R, R)
    assert np.allclose(found.t, [100.0, 20.0, -4.0])
    line = np.arange(4.0)[:, None] * np.array([1.0, 2.0, 0.1])
    assert umeyama(line, line) is None
    assert umeyama(a[:2], b[:2]) is None and umeyama(a[:0], b[:0]) is None
    assert umeyama(np.ones((4, 3)), b) is None


def test_wrong_shapes_are_refused() -> None:
    one = np.eye(4)[None]
    with pytest.raises(ValueError, match="two poses"):
        adjust(KeyframeTrack(one, np.zeros(1), loose(1)))
