"""Loops between rendered views of one place, and none between views of different places."""

from __future__ import annotations

import itertools
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import pytest
import scipy.ndimage as ndi
from spied import spied

from recon import se3
from recon.camera_model import rays, scaled_K
from recon.posegraph import loop_closure
from recon.posegraph.loop_closure import LoopEnd, LoopSearch, candidates, ground_seen, verify
from recon.posegraph.pose_graph import PoseGraph
from recon.posegraph.records import Loop, Node
from recon.posegraph.trajectory import Trajectory
from recon.types import F64, DepthMap, PosePrior

SIZE = (640, 360)
K = np.array([[450.0, 0, 319.5], [0, 450.0, 179.5], [0, 0, 1.0]])
NADIR = np.diag([1.0, -1.0, -1.0])
METRES_PER_TEXEL = 0.12


@lru_cache(maxsize=2)
def texture(seed: int) -> F64:
    """(1600, 1600) ground of 192 m a side."""
    rng = np.random.default_rng(seed)
    total = np.zeros((1600, 1600))
    for k in range(7):
        small = ndi.gaussian_filter(rng.normal(size=((1600 >> k) + 4, (1600 >> k) + 4)), 1.2)
        layer = cv2.resize(small, None, fx=2.0**k, fy=2.0**k, interpolation=cv2.INTER_CUBIC)
        total += 2 ** (0.3 * k) * layer[:1600, :1600]
    return np.asarray(128 + 50 * (total - total.mean()) / total.std())


def height(x: F64, y: F64) -> F64:
    return np.asarray(1.5 * np.sin(x / 7 + 1) * np.cos(y / 9) + 0.7 * np.sin(x / 3.1 + y / 4.3))


def camera(x: float, y: float, z: float, yaw: float) -> F64:
    turn = se3.so3_exp(np.array([0.01, -0.02, yaw]))
    return se3.compose(NADIR @ turn, np.array([x, y, z]))


def view(T: F64, seed: int = 0, ground: int = 1, sigma_m: float = 0.08) -> LoopEnd:
    """An image with noise and a depth map at half its size with noise."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0 : SIZE[1], 0 : SIZE[0]].astype(np.float64)
    directions = rays(K, np.column_stack([u.ravel(), v.ravel()])) @ T[:3, :3].T
    t = np.full(len(directions), T[2, 3])
    for _ in range(12):  # gentle hills: the fixed point converges
        p = T[:3, 3] + directions * t[:, None]
        off = (p[:, 2] - height(p[:, 0], p[:, 1])) / -directions[:, 2]
        t += off
        if np.abs(off).max() < 1e-4:
            break
    p = (T[:3, 3] + directions * t[:, None]).reshape(SIZE[1], SIZE[0], 3)
    places = (p[..., :2] / METRES_PER_TEXEL + 800).astype(np.float32)
    colour = cv2.remap(
        texture(ground).astype(np.float32), places[..., 0], places[..., 1], cv2.INTER_CUBIC
    )
    gray = np.clip(np.round(colour + rng.normal(size=colour.shape) * 2), 0, 255).astype(np.uint8)
    depth = t.reshape(SIZE[1], SIZE[0])
    small = cv2.resize(depth, (320, 180), interpolation=cv2.INTER_AREA)
    small = small + rng.normal(size=small.shape) * sigma_m
    return LoopEnd(
        gray, K,
        DepthMap(
            small.astype(np.float32), np.full(small.shape, sigma_m, np.float32),
            np.full(small.shape, 2, np.uint8), scaled_K(K, 0.5, 0.5), np.eye(4),
        ),
    )  # fmt: skip


A = camera(0.0, 0.0, 40.0, 0.0)
LEVEL = np.array([[x, y, 40.0] for x in np.linspace(-28, 28, 9) for y in np.linspace(-15, 15, 7)])


@pytest.mark.slow
@pytest.mark.parametrize("yaw", [0.1, 1.6, 3.1])
def test_a_place_seen_again_is_found_from_any_side(yaw: float) -> None:
    B = camera(5.0, -3.0, 41.0, yaw)
    truth = se3.inverse(A) @ B
    guess = se3.exp(np.array([0.01, -0.01, 0.03, 1.2, -0.9, 0.6])) @ truth
    loop = verify(view(A, 1), view(B, 2), guess)
    assert loop is not None
    T_a_b, covariance, _ = loop
    error = se3.log(T_a_b @ se3.inverse(truth))
    below = np.array([[0.0, 0.0, 40.0]])
    miss = se3.transform(T_a_b, below) - se3.transform(truth, below)
    assert np.linalg.norm(miss) < 0.08
    assert error @ np.linalg.solve(covariance, error) < 30


def oblique(x: float, y: float, yaw: float) -> F64:
    """A camera 40 m up that looks 25 degrees ahead of straight down, along ``yaw``."""
    ahead = se3.so3_exp(np.array([np.radians(25.0), 0.0, 0.0]))
    turn = se3.so3_exp(np.array([0.0, 0.0, -yaw]))
    return se3.compose(turn.T @ NADIR @ ahead, np.array([x, y, 40.0]))


@pytest.mark.parametrize("across_m", [0.0, 12.0])
def test_oblique_views_from_opposite_sides_are_one_place(across_m: float) -> None:
    """50 degrees between the rays, images turned by half a circle."""
    near = 40.0 * np.tan(np.radians(25.0))
    A, B = oblique(0.0, -near, 0.0), oblique(across_m, near, np.pi)
    assert np.allclose((A[:3, 3] + A[:3, 2] * 40.0 / -A[2, 2])[:2], [0, 0], atol=0.1)
    assert np.allclose((B[:3, 3] + B[:3, 2] * 40.0 / -B[2, 2])[:2], [across_m, 0], atol=0.1)
    a, b = view(A, 1), view(B, 2)
    found = dict(candidates({0: A, 1: B}, K, SIZE, ground_seen(b.depth), 0.35))
    assert found[0] > 0.5
    truth = se3.inverse(A) @ B
    guess = se3.exp(np.array([0.01, -0.01, 0.02, 0.8, -0.5, 0.4])) @ truth
    loop = verify(a, b, guess)
    assert loop is not None
    middle = np.array([[0.0, 0.0, 44.0]])
    miss = se3.transform(loop[0], middle) - se3.transform(truth, middle)
    assert np.linalg.norm(miss) < 0.12


def test_what_is_seen_goes_on_where_nothing_was_measured() -> None:
    whole = view(oblique(0.0, 0.0, 0.4), 1).depth
    z = whole.depth_m.copy()
    z[:, 160:] = np.nan
    part = ground_seen(DepthMap(z, whole.sigma_m, whole.views, whole.K, whole.T_world_camera))
    full = ground_seen(whole)
    assert len(part) == len(full) == 17 * 11
    assert np.abs(part[:, 2] / full[:, 2] - 1.0).max() < 0.25
    z[:] = np.nan
    none = DepthMap(z, whole.sigma_m, whole.views, whole.K, whole.T_world_camera)
    assert len(ground_seen(none)) == 0


def test_a_guess_far_off_is_helped_by_the_images() -> None:
    B = camera(4.0, 2.0, 40.0, 0.8)
    truth = se3.inverse(A) @ B
    guess = se3.exp(np.array([0.0, 0.0, 1.0, 14.0, -9.0, 0.0])) @ truth
    loop = verify(view(A, 1), view(B, 2), guess)
    assert loop is not None
    miss = se3.transform(loop[0] @ se3.inverse(truth), np.array([[0.0, 0.0, 40.0]]))
    assert np.linalg.norm(miss - [[0.0, 0.0, 40.0]]) < 0.1


def test_rows_that_repeat_are_found_near_the_features(monkeypatch: pytest.MonkeyPatch) -> None:
    """Furrows 0.8 m apart over weak texture: a wide search takes one for another."""
    furrows = 45.0 * np.cos(2.0 * np.pi / 0.8 * METRES_PER_TEXEL * np.mgrid[:1600, :1600][0])
    weak = 0.3 * (texture(1) - 128.0)
    monkeypatch.setitem(globals(), "texture", lambda _: 128.0 + furrows + weak)
    B = camera(6.0, 4.0, 40.0, 0.0)
    truth = se3.inverse(A) @ B
    guess = se3.exp(np.array([0.0, 0.0, 0.0, 12.0, 9.0, 0.0])) @ truth
    loop = verify(view(A, 1), view(B, 2), guess)
    assert loop is not None
    miss = se3.transform(loop[0] @ se3.inverse(truth), np.array([[0.0, 0.0, 40.0]]))
    assert np.linalg.norm(miss - [[0.0, 0.0, 40.0]]) < 0.1


@pytest.mark.slow
def test_another_place_is_no_loop() -> None:
    B = camera(3.0, 2.0, 40.0, 0.2)
    guess = se3.inverse(A) @ B
    assert verify(view(A, 1), view(B, 2, ground=3), guess) is None
    assert verify(view(A, 1), view(camera(60.0, 55.0, 40.0, 0.2), 2), guess) is None


def test_the_same_image_over_another_relief_is_no_loop() -> None:
    """Perfect matches whose depths contradict: the ground moved, or an image repeats."""
    B = camera(3.0, 2.0, 40.0, 0.2)
    a, b = view(A, 1), view(B, 2)
    v, u = np.mgrid[0:180, 0:320]
    bent = b.depth.depth_m + 2.5 * np.sin(u / 20.0) * np.cos(v / 25.0)
    other = DepthMap(
        bent.astype(np.float32), b.depth.sigma_m, b.depth.views, b.depth.K, b.depth.T_world_camera
    )
    assert verify(a, LoopEnd(b.gray, K, other), se3.inverse(A) @ B) is None


def test_without_texture_or_depth_there_is_no_loop() -> None:
    B = camera(3.0, 2.0, 40.0, 0.2)
    a, b, guess = view(A, 1), view(B, 2), se3.inverse(A) @ B
    blank = LoopEnd(np.full_like(a.gray, 120), K, a.depth)
    hollow = DepthMap(
        np.full_like(a.depth.depth_m, np.nan), a.depth.sigma_m, a.depth.views, a.depth.K, np.eye(4)
    )
    assert verify(blank, b, guess) is None
    assert verify(a, blank, guess) is None
    assert verify(LoopEnd(a.gray, K, hollow), b, guess) is None


def lawnmower() -> dict[int, F64]:
    """Two legs of thirty keyframes, 12 m apart, flown there and back."""
    out = {i: camera(4.0 * i, 0.0, 40.0, 0.0) for i in range(30)}
    return out | {30 + i: camera(4.0 * (29 - i), 12.0, 40.0, np.pi) for i in range(30)}


def test_candidates_are_the_earlier_views_of_the_same_ground() -> None:
    poses = {i: T for i, T in lawnmower().items() if i <= 45 or i == 55}
    found = candidates(poses, K, SIZE, LEVEL, 0.35)
    assert found and all(seq <= 45 for seq, _ in found)
    shares = [share for _, share in found]
    assert shares == sorted(shares, reverse=True) and shares[-1] >= 0.35
    # Keyframe 55 is over x = 16 m: the first leg passed there at keyframe 4.
    assert abs(found[0][0] - 4) <= 1
    assert candidates({0: poses[0], 10: poses[10]}, K, SIZE, LEVEL, 0.35) == []


def test_two_verified_loops_close_the_map() -> None:
    """The whole way: views that overlap, verification, and the graph's own doubt."""
    poses = lawnmower()
    rng = np.random.default_rng(0)
    graph = PoseGraph()
    odom = poses[0]
    covariance = np.diag([1e-3**2] * 3 + [0.04**2] * 3)
    last = poses[0]
    for i, T in poses.items():
        if i:
            noise = se3.exp(rng.multivariate_normal(np.zeros(6), covariance))
            odom = odom @ noise @ se3.inverse(last) @ T
        last = T
        graph.add_keyframe(Node(i, i * 10**9, 0, odom, covariance, PosePrior()))
    flown = graph.poses()
    before = np.linalg.norm(
        (se3.inverse(flown[4]) @ flown[55] - se3.inverse(poses[4]) @ poses[55])[:3, 3]
    )
    bent = []
    for a, b in ((4, 55), (6, 53)):
        guess = se3.inverse(flown[a]) @ flown[b]
        loop = verify(view(poses[a], a), view(poses[b], b), guess)
        assert loop is not None
        bent.append(graph.add_loop(Loop(a, b, *loop[:2])))
    assert bent == [False, True]
    closed = graph.poses()
    after = np.linalg.norm(
        (se3.inverse(closed[4]) @ closed[55] - se3.inverse(poses[4]) @ poses[55])[:3, 3]
    )
    assert after < 0.15 < before


DRIFT = 1.02


def test_lengths_that_are_all_as_unsure_leave_the_scale_as_it_is() -> None:
    """Steps of noisy images scatter by 1 %; keyframes after another share one scale."""
    rng, graph = np.random.default_rng(5), PoseGraph()
    covariance = np.diag([1e-4**2] * 3 + [0.05**2] * 3)
    for i, T in lawnmower().items():
        fix = T[:3, 3] + rng.normal(0.0, 1.0, 3)
        prior = PosePrior(T[:3, :3], 0.02, 0.1, fix, np.full(3, 1.0))
        graph.add_keyframe(Node(i, i * 10**9, 0, T, covariance, prior))
    assert len({graph.scale(i) for i in range(len(graph))}) <= 5


def test_a_loop_joins_the_scales_of_its_ends() -> None:
    """In the turn vision takes a step of unsure length for 2 % longer and all after it for larger,
    which fixes of 3 m do not show; depths at two loops do."""
    rng = np.random.default_rng(3)
    poses, graph = lawnmower(), PoseGraph()
    turn = poses[30][:3, 3]
    covariance = np.diag([1e-4**2] * 3 + [4e-3**2] * 3)
    for i, T in poses.items():
        odom = T.copy()
        odom[:3, 3] = turn + (DRIFT if i >= 30 else 1.0) * (T[:3, 3] - turn)
        fix = T[:3, 3] + rng.normal(0.0, 3.0, 3)
        prior = PosePrior(T[:3, :3], 0.02, 0.1, fix, np.full(3, 3.0))
        unsure = 20.0 if i == 30 else 1.0
        graph.add_keyframe(Node(i, i * 10**9, 0, odom, unsure**2 * covariance, prior))
    assert abs(graph.scale(55) / graph.scale(4) * DRIFT - 1.0) > 0.01
    for a, b in ((4, 55), (9, 50)):
        T_a_b = se3.inverse(poses[a]) @ poses[b]
        T_a_b[:3, 3] *= graph.scale(a)
        growth = graph.scale(a) / graph.scale(b) / DRIFT
        graph.add_loop(Loop(a, b, T_a_b, np.diag([1e-3**2] * 3 + [0.03**2] * 3), growth))
    assert abs(graph.scale(55) / graph.scale(4) * DRIFT - 1.0) < 0.003


@pytest.mark.slow
def test_a_segment_that_loops_shrink_tells_by_how_much() -> None:
    """Fixes to centimetres lay the first ten keyframes into 0.9 of their size; two loops hand that
    on to all others, whose own fixes of 3 m give 1."""
    rng = np.random.default_rng(5)
    poses, graph = lawnmower(), PoseGraph()
    covariance = np.diag([1e-4**2] * 3 + [4e-3**2] * 3)
    start = poses[0][:3, 3]
    for i, T in poses.items():
        is_first = i < 10
        fix = start + 0.9 * (T[:3, 3] - start) if is_first else T[:3, 3] + rng.normal(0.0, 3.0, 3)
        sigma = np.full(3, 0.02 if is_first else 3.0)
        prior = PosePrior(T[:3, :3], 0.02, 0.1, fix, sigma)
        graph.add_keyframe(Node(i, i * 10**9, int(not is_first), T, covariance, prior))
    graph.solve()
    assert abs(graph.largest_growth()) < 0.03
    for a, b in ((4, 55), (6, 53)):
        T_a_b = se3.inverse(poses[a]) @ poses[b]
        T_a_b[:3, 3] *= graph.scale(a)
        growth = graph.scale(a) / graph.scale(b)
        graph.add_loop(Loop(a, b, T_a_b, np.diag([1e-3**2] * 3 + [0.03**2] * 3), growth))
    found = graph.segments.largest()
    assert found is not None and found.to_world.sigma_scale < 0.03
    assert graph.largest_growth() == pytest.approx(np.log(0.9), abs=0.03)


def search_along(poses: list[F64], chain: list[F64], segment: list[int]) -> LoopSearch:
    """The search fed as the reconstruction feeds it, without telemetry."""
    trajectory = Trajectory()
    search = LoopSearch(trajectory, min_gap=5)
    covariance = np.diag([4e-3**2] * 3 + [0.1**2] * 3)
    for i, (T, odom) in enumerate(zip(poses, chain, strict=True)):
        trajectory.add(Node(i, i * 10**9, segment[i], odom, covariance, PosePrior()))
        seen = view(T, i)
        search.add(i, segment[i], seen.gray, K, seen.depth)
    return search


def apart_m(search: LoopSearch, poses: list[F64], a: int, b: int) -> float:
    moved = search.trajectory.step_between(a, b)
    return float(np.linalg.norm((moved - se3.inverse(poses[a]) @ poses[b])[:3, 3]))


@pytest.mark.slow
def test_the_search_closes_two_legs_of_a_drifting_chain() -> None:
    there = [camera(8.0 * i, 0.0, 40.0, 0.0) for i in range(5)]
    poses = [*there, *(camera(8.0 * (4 - i), 9.0, 40.0, np.pi) for i in range(5))]
    chain = [poses[0]]
    for a, b in itertools.pairwise(poses):
        drift = se3.exp(np.array([0.0, 0.0, 0.004, 0.05, -0.03, 0.12]))
        chain.append(chain[-1] @ drift @ se3.inverse(a) @ b)
    before = np.linalg.norm(
        (se3.inverse(chain[1]) @ chain[8] - se3.inverse(poses[1]) @ poses[8])[:3, 3]
    )
    search = search_along(poses, chain, [0] * 10)
    taken = search.trajectory.graph.loops
    assert taken
    assert before > 0.6
    assert all(apart_m(search, poses, e.a, e.b) < 0.15 for e in taken)
    assert apart_m(search, poses, 1, 8) < 0.5 * before


@pytest.mark.slow
def test_a_lost_stretch_is_found_again_from_the_images() -> None:
    """Over the same ground after a gap, in a frame of another origin, heading and scale."""
    poses = [camera(6.0 * i, 0.0, 40.0, 0.0) for i in range(4)]
    poses += [camera(6.0 * i + 3.0, 4.0, 40.0, 0.3) for i in range(4)]
    other = se3.exp(np.array([0.0, 0.0, 0.1, 15.0, 4.0, 0.0]))
    chain = [*poses[:4], *(other @ T for T in poses[4:])]
    search = search_along(poses, chain, [0] * 4 + [1] * 4)
    assert search.trajectory.graph.segments[1].is_tied
    assert apart_m(search, poses, 1, 6) < 0.2


@pytest.mark.slow
def test_a_lost_stretch_is_found_by_its_look_among_many() -> None:
    """Three keyframes over ground seen long ago, in a frame that says nothing of the place."""
    poses = [camera(9.0 * i - 50.0, 0.0, 40.0, 0.0) for i in range(12)]
    poses += [camera(9.0 * i - 40.0, 3.0, 40.0, 2.0) for i in range(3)]
    other = se3.exp(np.array([0.0, 0.0, 1.2, 150.0, 90.0, 0.0]))
    chain = [*poses[:12], *(other @ T for T in poses[12:])]
    search = search_along(poses, chain, [0] * 12 + [1] * 3)
    assert search.trajectory.graph.segments[1].is_tied
    assert apart_m(search, poses, 2, 13) < 0.3


def test_after_a_loop_the_search_waits_until_the_view_has_moved_on() -> None:
    """For a quarter of the view's diagonal, or three keyframes."""
    seen, trajectory, searched = view(A, 1), Trajectory(), list[int]()

    class TakesALoop(LoopSearch):
        def _search(self, new: Any) -> None:
            searched.append(new.seq)
            self._tied = new

    search = TakesALoop(trajectory)
    H, W = seen.gray.shape
    diagonal_m = float(np.nanmedian(seen.depth.depth_m)) * float(np.hypot(W, H)) / K[0, 0]
    for i, share in enumerate((0.0, 0.1, 0.2, 0.3, 0.31, 0.32, 0.33, 0.34)):
        T = camera(share * diagonal_m, 0.0, 40.0, 0.0)
        trajectory.add(Node(i, i * 10**9, 0, T, np.eye(6) * 1e-4, PosePrior()))
        search.add(i, 0, seen.gray, K, seen.depth)
    assert searched == [0, 3, 7]


def test_the_search_keeps_a_bounded_number_of_views(monkeypatch: pytest.MonkeyPatch) -> None:
    seen, verified = view(A, 1), spied(monkeypatch, loop_closure, "verify")
    trajectory = Trajectory()
    search = LoopSearch(trajectory, max_views=6)
    rng = np.random.default_rng(4)
    for i in range(20):
        T = camera(300.0 * i, 0.0, 40.0, 0.0)
        trajectory.add(Node(i, i * 10**9, 0, T, np.eye(6) * 1e-4, PosePrior()))
        search.add(i, 0, rng.integers(0, 255, seen.gray.shape, np.uint8), K, seen.depth)
        assert len(search) <= 6
    assert not verified.called
