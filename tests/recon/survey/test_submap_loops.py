"""Loops among stored keyframes: masked views are filled, verified, and hold legs together."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import scipy.ndimage as ndi

from recon import se3
from recon.camera_model import rays
from recon.posegraph.loop_closure import LoopEnd
from recon.posegraph.records import Loop
from recon.survey.ground_control import KeyframeTrack, adjust, supported
from recon.survey.submap_loops import filled, verify_surfaces
from recon.types import F64, DepthMap, Keyframe, Pose
from service.offline.refine.stored_loops import steps_m, stored_loops

SIZE = (320, 180)
K = np.array([[240.0, 0.0, 159.5], [0.0, 240.0, 89.5], [0.0, 0.0, 1.0]])
HEIGHT_M, SIGMA_M, METRES = 60.0, 0.06, 0.22


@cache
def _texture(seed: int) -> F64:
    rng = np.random.default_rng(seed)
    layers = [ndi.gaussian_filter(rng.normal(size=(900, 900)), 1.3 * 2.0**k) for k in range(5)]
    total = np.asarray(sum(2.0**k * layer / layer.std() for k, layer in enumerate(layers)))
    return np.asarray(128 + 45 * (total - total.mean()) / total.std())


def _height(x: F64, y: F64) -> F64:
    return np.asarray(1.5 * np.sin(x / 9.0) * np.cos(y / 11.0))


def _oblique(along: float, across: float, back: bool) -> F64:
    """60 m up, looking 25 degrees ahead of straight down, along +y or, on the way back, -y."""
    ahead = se3.so3_exp(np.array([np.radians(25.0), 0.0, 0.0]))
    R = np.diag([1.0, -1.0, -1.0]) @ ahead
    turn = np.diag([-1.0, -1.0, 1.0]) if back else np.eye(3)
    return se3.compose(turn @ R, np.array([across, along, HEIGHT_M]))


def _keyframe(seq: int, T: F64, texture: F64 | None = None) -> Keyframe:
    """A view of the ground with noise in gray and depth."""
    rng = np.random.default_rng(seq)
    texture = _texture(1) if texture is None else texture
    w, h = SIZE
    v, u = np.mgrid[0:h, 0:w].astype(np.float64)
    ways = rays(K, np.column_stack([u.ravel(), v.ravel()])) @ T[:3, :3].T
    z = np.full(len(ways), HEIGHT_M)
    for _ in range(15):
        p = T[:3, 3] + ways * z[:, None]
        z += (p[:, 2] - _height(p[:, 0], p[:, 1])) / -ways[:, 2]
    p = (T[:3, 3] + ways * z[:, None])[:, :2] / METRES + 450
    gray = ndi.map_coordinates(texture, p.T, order=1, mode="reflect").reshape(h, w)
    gray = np.clip(gray + rng.normal(size=gray.shape) * 2, 0, 255).astype(np.uint8)
    depth = z.reshape(h, w) + ndi.gaussian_filter(rng.normal(size=(h, w)), 1.5) * 4 * SIGMA_M
    known = np.full((h, w), 3, np.uint8)
    return Keyframe(
        seq, seq * 10**9,
        DepthMap(depth.astype(np.float32), np.full((h, w), SIGMA_M, np.float32), known, K, T),
        np.repeat(gray[..., None], 3, axis=2),
        Pose(T, np.eye(6) * 1e-4, ("vision",)), np.ones((h, w), np.bool_),
    )  # fmt: skip


def _masked(whole: Keyframe, rows: slice) -> Keyframe:
    """Only some rows kept, as of a keyframe that brought little that was new."""
    z, bgr = np.full_like(whole.depth.depth_m, np.nan), np.full_like(whole.bgr, 90)
    z[rows], bgr[rows] = whole.depth.depth_m[rows], whole.bgr[rows]
    d = whole.depth
    kept = DepthMap(z, d.sigma_m, d.views, d.K, d.T_world_camera)
    return Keyframe(whole.seq, whole.time_ns, kept, bgr, whole.pose, np.isfinite(z))


def _legs() -> list[F64]:
    """Two oblique legs in opposite directions; five keyframes each."""
    there = [_oblique(7.0 * k - 40.0, 0.0, False) for k in range(5)]
    return there + [_oblique(40.0 - 7.0 * k, 12.0, True) for k in range(5)]


def _view(one: Keyframe) -> LoopEnd:
    return LoopEnd(one.bgr[..., 0], one.depth.K, one.depth)


def test_a_view_is_filled_with_what_its_neighbours_measured() -> None:
    whole = _keyframe(1, _oblique(0.0, 0.0, False))
    own = _masked(whole, slice(0, 60))
    nearby = _keyframe(2, _oblique(5.0, 1.0, False))
    behind = _keyframe(3, _oblique(-9.0, -1.0, False))
    found = filled(own, [nearby, behind])
    z = found.depth.depth_m
    assert np.isfinite(z).mean() > 0.97 and np.isfinite(own.depth.depth_m).mean() < 0.4
    np.testing.assert_array_equal(z[:60], own.depth.depth_m[:60])
    off = np.abs(z - whole.depth.depth_m)
    assert np.nanmedian(off[60:]) < 3 * SIGMA_M
    known = np.isfinite(z)
    alike = np.corrcoef(found.bgr[known, 0].astype(float), whole.bgr[known, 0].astype(float))
    assert alike[0, 1] > 0.9
    assert np.array_equal(filled(own, []).depth.depth_m, own.depth.depth_m, equal_nan=True)


@pytest.mark.parametrize("off_m", [0.5, 3.0])
def test_opposite_oblique_views_agree_within_their_covariance(off_m: float) -> None:
    poses = _legs()
    a, b = _keyframe(1, poses[1]), _keyframe(2, poses[6])
    truth = se3.inverse(poses[1]) @ poses[6]
    guess = se3.exp(np.array([0.004, -0.003, 0.006, off_m, -0.6 * off_m, 0.3])) @ truth
    loop = verify_surfaces(_view(a), _view(b), guess)
    assert loop is not None
    T_a_b, covariance, _ = loop
    error = se3.log(T_a_b @ se3.inverse(truth))
    assert error @ np.linalg.solve(covariance, error) < 22.5
    ahead = np.array([[0.0, 0.0, 66.0]])
    miss = se3.transform(T_a_b, ahead) - se3.transform(truth, ahead)
    assert np.linalg.norm(miss) < 0.15


def test_another_ground_and_views_without_any_are_no_loop() -> None:
    poses = _legs()
    a, b = _keyframe(1, poses[1]), _keyframe(2, poses[6], _texture(2))
    guess = se3.inverse(poses[1]) @ poses[6]
    assert verify_surfaces(_view(a), _view(b), guess) is None
    assert verify_surfaces(_view(a), _view(_masked(b, slice(0, 0))), guess) is None
    assert verify_surfaces(_view(_masked(a, slice(0, 0))), _view(b), guess) is None


def test_a_repeated_texture_is_no_loop_at_the_wrong_place() -> None:
    """Every eight metres the same: a track that has slipped by as much finds perfect matches."""
    period = round(8.0 / METRES)
    tiled = np.tile(_texture(1)[:period, :period], (900 // period + 1,) * 2)[:900, :900]
    poses = _legs()
    slip = se3.compose(np.eye(3), np.array([period * METRES, 0.0, 0.0]))
    loops = []
    for a, b in ((1, 8), (2, 7), (2, 8)):
        one, two = (_view(_keyframe(k, poses[k], tiled)) for k in (a, b))
        guess = se3.inverse(poses[a]) @ slip @ poses[b]
        found = verify_surfaces(one, two, guess)
        if found is not None:
            loops.append(Loop(a, b, *found[:2]))
    truth: F64 = np.array(poses)
    spread = np.array([np.diag([0.01**2] * 3 + [0.3**2] * 3)] * 10)
    track = KeyframeTrack(truth, np.linspace(0.0, 45.0, 10), spread, (), supported(loops, truth))
    held = adjust(track)
    assert np.abs(held.poses[:, :3, 3] - truth[:, :3, 3]).max() < 0.1


@pytest.mark.slow
def test_stored_keyframes_alone_bring_two_oblique_legs_together() -> None:
    """Each keeps a part of its view; the second leg has slipped against the first."""
    truth = _legs()
    slip = se3.compose(se3.so3_exp(np.array([0.0, 0.0, 0.004])), np.array([0.7, -0.5, 0.3]))
    flown = np.array([T if k < 5 else slip @ T for k, T in enumerate(truth)])
    parts = [slice(0, 180), slice(0, 70), slice(60, 120), slice(0, 90), slice(90, 180)] * 2
    stored = []
    for k, T in enumerate(truth):
        one = _masked(_keyframe(k, T), parts[k])
        d = one.depth
        kept = DepthMap(d.depth_m, d.sigma_m, d.views, d.K, flown[k])
        stored.append(Keyframe(k, one.time_ns, kept, one.bgr, one.pose, one.fresh))
    spread = np.array([np.diag([0.01**2] * 3 + [1.0] * 3)] * 10)
    track = KeyframeTrack(flown, np.arange(10) * 5.0 + 40.0 * (np.arange(10) >= 5), spread)
    found = supported(stored_loops(track, stored.__getitem__, min_gap=5), flown)
    assert len(found) >= 3
    for loop in found:
        true = se3.inverse(truth[loop.a]) @ truth[loop.b]
        error = se3.log(loop.T_a_b @ se3.inverse(true))
        assert error @ np.linalg.solve(loop.covariance, error) < 22.5
    ones = np.ones(10)
    assert np.median(steps_m(found, flown, ones, 66.0)) > 0.6
    after = adjust(KeyframeTrack(track.poses, track.times_s, spread, (), found))
    assert np.median(steps_m(found, after.poses, after.scales, 66.0)) < 0.2
    left = se3.inverse(after.poses[2]) @ after.poses[7]
    true = se3.inverse(truth[2]) @ truth[7]
    ahead = np.array([[0.0, 0.0, 66.0]])
    assert np.linalg.norm(se3.transform(left, ahead) - se3.transform(true, ahead)) < 0.2
