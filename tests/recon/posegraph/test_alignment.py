"""The similarity from the odometry's frame to the world."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from flown_track import node

from recon import se3
from recon.camera_model import rays
from recon.posegraph import alignment
from recon.posegraph.alignment import fit, scales
from recon.posegraph.ground import height_above, height_below
from recon.posegraph.records import Node
from recon.types import F32, F64, DepthMap, PosePrior, Travel


def track(n: int = 30) -> list[F64]:
    """Camera poses of a bent flight, looking down."""
    out = []
    for i in range(n):
        R = se3.so3_exp(np.array([0.02 * math.sin(i), 0.02 * math.cos(2 * i), 0.05 * i]))
        out.append(se3.compose(R @ np.diag([1.0, -1, -1]), np.array([4.0 * i, 0.02 * i * i, 60.0])))
    return out


def noisy_nodes(
    R: F64, scale: float, t: F64, seed: int, gnss_m: float = 1.0, yaw_bias: float = 0.0
) -> list[Node]:
    """Noisy priors of a track that the odometry sees turned, shrunk and moved."""
    rng = np.random.default_rng(seed)
    out = []
    for i, T in enumerate(track()):
        odom = se3.compose(R.T @ T[:3, :3], R.T @ (T[:3, 3] - t) / scale)
        noise = np.r_[rng.normal(0, 0.01, 2), rng.normal(yaw_bias, 0.05)]
        prior = PosePrior(
            se3.so3_exp(noise) @ T[:3, :3],
            0.01,
            0.05,
            T[:3, 3] + rng.normal(0, gnss_m, 3),
            np.full(3, gnss_m),
            60.0 + rng.normal(0, 2.0),
            3.0,
        )
        out.append(node(odom, prior, 60.0 / scale, time_s=float(i)))
    return out


@pytest.mark.parametrize("scale", [0.2, 1.0, 7.0])
@pytest.mark.parametrize("yaw", [0.0, 1.2, 3.0, -2.0])
def test_any_turn_and_scale_is_found(scale: float, yaw: float) -> None:
    R = se3.so3_exp(np.array([0.05, -0.03, yaw]))
    t = np.array([10.0, -20.0, 5.0])
    found = fit(noisy_nodes(R, scale, t, seed=1))
    assert found is not None
    assert found.scale == pytest.approx(scale, rel=0.03)
    assert np.linalg.norm(se3.so3_log(found.R @ R.T)) < 0.03
    assert found.sources == ("attitude", "altitude", "gnss")


def test_one_wild_fix_does_not_move_the_map() -> None:
    good = noisy_nodes(np.eye(3), 1.0, np.zeros(3), seed=2)
    wild = list(good)
    prior = wild[10].prior
    assert prior.position_m is not None
    moved = PosePrior(
        prior.R_world_camera,
        prior.sigma_tilt_rad,
        prior.sigma_yaw_rad,
        prior.position_m + np.array([30.0, 0, 0]),
        prior.sigma_position_m,
    )
    wild[10] = node(wild[10].T_odom_camera, moved, None)
    a, b = fit(good), fit(wild)
    assert a is not None and b is not None
    shift = a.pose(good[15].T_odom_camera)[:3, 3] - b.pose(good[15].T_odom_camera)[:3, 3]
    assert np.linalg.norm(shift) < 0.4


@pytest.mark.parametrize("off_m", [0.0, 8.0])
def test_a_fit_ends_within_a_hundredth_of_its_sigma(
    monkeypatch: pytest.MonkeyPatch, off_m: float
) -> None:
    """Against a fit that goes on until rounding, also with fixes that lose weight."""
    some = noisy_nodes(se3.so3_exp(np.array([0.05, -0.03, 1.2])), 2.0, np.ones(3), seed=6)
    for i in range(0, 30, 5):
        p = some[i].prior
        assert p.position_m is not None
        moved = replace(p, position_m=p.position_m + np.array([off_m, 0.0, 0.0]))
        some[i] = replace(some[i], prior=moved)
    soon = fit(some)
    for name, value in (("SETTLED", 1e-12), ("SETTLED_START", 1e-12), ("ITERATIONS", 200)):
        monkeypatch.setattr(alignment, name, value)
    late = fit(some)
    assert soon is not None and late is not None
    step = np.r_[se3.so3_log(soon.R @ late.R.T), soon.t - late.t, np.log(soon.scale / late.scale)]
    assert 0.0 < step @ np.linalg.solve(late.covariance, step) < 0.01**2


def test_heading_comes_from_the_track_when_no_compass_tells_it() -> None:
    R = se3.so3_exp(np.array([0.0, 0.0, 2.5]))
    blind = []
    for a in noisy_nodes(R, 2.0, np.array([1.0, 2.0, 3.0]), seed=3, gnss_m=2.0):
        p = a.prior
        nominal = np.diag([1.0, -1, -1])
        prior = PosePrior(nominal, 0.1, 3.0, p.position_m, p.sigma_position_m)
        blind.append(node(a.T_odom_camera, prior, None))
    found = fit(blind)
    assert found is not None
    assert found.scale == pytest.approx(2.0, rel=0.05)
    turn = se3.so3_log(found.R @ R.T)
    assert abs(turn[2]) < 0.05
    assert "attitude" not in found.sources


def test_scale_rests_on_the_height_without_gnss() -> None:
    some = []
    for a in noisy_nodes(np.eye(3), 3.0, np.zeros(3), seed=4):
        p = a.prior
        prior = PosePrior(p.R_world_camera, 0.01, 0.05, None, None, p.agl_m, 3.0)
        some.append(node(a.T_odom_camera, prior, a.height))
    found = fit(some)
    assert found is not None
    assert found.scale == pytest.approx(3.0, rel=0.03)
    assert found.sources == ("attitude", "altitude")


def assumed(prior: PosePrior) -> PosePrior:
    """As with ``fusion.altitude=false``; the true height is 120 m."""
    return replace(prior, agl_m=50.0, sigma_agl_m=25.0, is_agl_measured=False)


@pytest.mark.parametrize("by", ["fixes", "velocities"])
def test_an_assumed_height_has_no_part_in_a_scale_that_is_measured(by: str) -> None:
    some, metres = [], np.zeros(3)
    flight = noisy_nodes(np.eye(3), 1.0, np.zeros(3), seed=6, gnss_m=2.0)
    for i, (a, T) in enumerate(zip(flight, track(), strict=True)):
        metres = metres + (T[:3, 3] - track()[i - 1][:3, 3] if i else np.zeros(3))
        prior = assumed(a.prior)
        if by == "velocities":
            travel = Travel(metres, float(i), 0)
            prior = replace(prior, position_m=None, sigma_position_m=None, travel=travel)
        some.append(node(a.T_odom_camera, prior, 120.0, time_s=float(i)))
    found = fit(some)
    without = fit([replace(a, height=None) for a in some])
    assert found is not None and without is not None
    assert found.scale == pytest.approx(1.0, abs=0.03)
    assert abs(math.log(found.scale / without.scale)) < 0.1 * without.sigma_scale
    assert "altitude" not in found.sources


def test_an_assumed_height_does_not_pull_a_scale_that_fixes_know_to_a_quarter() -> None:
    """A camera carried at 1.5 m, where 50 m are assumed."""
    off = []
    for seed in range(8):
        some = []
        for a in noisy_nodes(np.eye(3), 1.0, np.zeros(3), seed, gnss_m=20.0)[::3]:
            some.append(replace(a, prior=assumed(a.prior), height=1.5))
        found = fit(some)
        assert found is not None and 0.1 < found.sigma_scale < 0.5
        off.append(math.log(found.scale) / found.sigma_scale)
    assert abs(np.mean(off)) < 1.0


def test_an_assumed_height_is_no_source_of_the_scale() -> None:
    some = [
        node(a.T_odom_camera, assumed(replace(a.prior, position_m=None)), 120.0)
        for a in noisy_nodes(np.eye(3), 1.0, np.zeros(3), seed=7)
    ]
    found = fit(some)
    assert found is not None and found.scale == pytest.approx(50.0 / 120.0, rel=0.01)
    assert found.sources == ("attitude",) and found.sigma_scale > 0.3


def test_without_any_prior_there_is_no_alignment() -> None:
    assert fit([node(T, PosePrior(), None) for T in track()]) is None


@pytest.mark.slow
def test_covariance_of_the_scale_covers_its_error() -> None:
    ratios = []
    for seed in range(40):
        found = fit(noisy_nodes(np.eye(3), 1.0, np.zeros(3), seed=10 + seed))
        assert found is not None
        ratios.append(abs(math.log(found.scale)) / found.sigma_scale)
    assert np.mean(np.array(ratios) < 1.0) > 0.6
    assert max(ratios) < 4.0


def test_height_is_that_of_the_ground_max_nearly_below() -> None:
    """A camera leaning forward over ground that rises ahead: the height is that of its foot."""
    rng = np.random.default_rng(0)
    xy = rng.uniform([-30, 5], [30, 90], (600, 2))
    ground = np.c_[xy, 0.2 * xy[:, 1]]
    lean = se3.so3_exp(np.array([math.radians(-65 + 180), 0.0, 0.0]))  # view 65 degrees down
    T = se3.compose(lean, np.array([0.0, 0.0, 60.0]))
    points = se3.transform(se3.inverse(T), ground)
    found = height_above(points, T[2, :3])
    assert found is not None
    assert found[0] == pytest.approx(60.0 - 0.2 * 12.0, abs=1.5)
    assert 0.0 < found[1] < 0.1
    assert height_above(points[:5], T[2, :3]) is None


def test_a_compass_wrong_by_half_a_turn_yields_to_the_fixes() -> None:
    half = se3.so3_exp(np.array([0.0, 0.0, math.pi]))
    wrong = []
    for a in noisy_nodes(np.eye(3), 1.5, np.zeros(3), seed=5):
        p = a.prior
        assert p.R_world_camera is not None
        prior = replace(p, R_world_camera=half @ p.R_world_camera)
        wrong.append(replace(a, prior=prior))
    found = fit(wrong)
    assert found is not None
    assert np.linalg.norm(se3.so3_log(found.R)) < 0.1
    assert found.scale == pytest.approx(1.5, rel=0.05)


@pytest.mark.parametrize("jumped, max_m", [(range(10, 20), 1.0), (range(17, 30), 2.0)])
def test_fixes_that_jump_for_two_fifths_of_the_flight_do_not_shift_it(
    jumped: range, max_m: float
) -> None:
    """By 37 m; without the last ones the end is carried on."""
    good = noisy_nodes(np.eye(3), 1.0, np.zeros(3), seed=6)
    bad = list(good)
    for i in jumped:
        p = bad[i].prior
        assert p.position_m is not None
        moved = p.position_m + np.array([30.0, -20.0, 8.0])
        bad[i] = replace(bad[i], prior=replace(p, position_m=moved))
    a, b = fit(good), fit(bad)
    assert a is not None and b is not None
    for i in (0, 15, 29):
        apart = a.pose(good[i].T_odom_camera) - b.pose(good[i].T_odom_camera)
        assert np.linalg.norm(apart[:3, 3]) < max_m


@pytest.mark.parametrize("wrong", [1.0, 1.2])
def test_scales_by_fixes_and_by_heights_are_distinguished(wrong: float) -> None:
    """Ten runs each: agreeing readings are within three sigmas, a fifth more height is not."""
    for seed in range(10):
        some = []
        for a in noisy_nodes(np.eye(3), 1.4, np.zeros(3), seed=seed, gnss_m=0.5):
            p = a.prior
            assert p.agl_m is not None
            some.append(replace(a, prior=replace(p, agl_m=wrong * p.agl_m, sigma_agl_m=2.0)))
        found = fit(some)
        assert found is not None
        by_fixes, by_heights = scales(some, found)
        assert by_fixes is not None and by_heights is not None
        assert by_fixes[0] == pytest.approx(1.4, rel=0.05)
        apart = abs(math.log(by_fixes[0] / by_heights[0]))
        spread = math.hypot(by_fixes[1], by_heights[1])
        assert (apart < 3 * spread) == (wrong == 1.0)


def test_the_scale_by_fixes_is_that_of_those_that_agree() -> None:
    """Most fixes jump aside and count for nothing: neither do their places."""
    some = noisy_nodes(np.eye(3), 1.4, np.zeros(3), seed=1, gnss_m=0.2)
    found = fit(some)
    assert found is not None
    off = [
        replace(a, prior=replace(a.prior, position_m=a.prior.position_m + 40.0))
        if i >= 8 and a.prior.position_m is not None
        else a
        for i, a in enumerate(some)
    ]
    by_fixes, _ = scales(off, found)
    assert by_fixes is not None and by_fixes[0] == pytest.approx(1.4, rel=0.05)


def test_the_height_exactly_below_is_read_from_the_depth_map() -> None:
    """A camera leaning over a slope: only the point below gives the height, and edges do not."""
    K = np.array([[300.0, 0, 159.5], [0, 300.0, 89.5], [0, 0, 1]])
    lean = se3.so3_exp(np.array([math.pi + 0.15, 0.0, 0.0]))
    T = se3.compose(lean, np.array([0.0, 0.0, 50.0]))
    v, u = np.mgrid[0:180, 0:320].astype(np.float64)
    directions = rays(K, np.column_stack([u.ravel(), v.ravel()])) @ T[:3, :3].T
    slope = 0.2  # ground z = slope * y, which is 0 straight below
    depth = 50.0 / (slope * directions[:, 1] - directions[:, 2])
    image = depth.reshape(180, 320).astype(np.float32)
    ones = np.ones_like(image)

    def below(depth_m: F32) -> float | None:
        seen = DepthMap(depth_m, 0.1 * ones, 3 * ones.astype(np.uint8), K, T)
        return height_below(seen, T[2, :3])

    assert below(image) == pytest.approx(50.0, abs=0.3)
    stepped = image.copy()
    stepped[: int(89.5 + 300 * math.tan(0.15)), :] -= 6.0
    stepped[:, :160] -= 6.0
    assert below(stepped) is None
    assert below(np.full_like(image, np.nan)) is None
    assert height_below(DepthMap(image, ones, ones.astype(np.uint8), K, T), np.eye(3)[0]) is None


def test_heights_exactly_below_count_alone() -> None:
    some = []
    for i, a in enumerate(noisy_nodes(np.eye(3), 3.0, np.zeros(3), seed=4)):
        p = a.prior
        prior = PosePrior(p.R_world_camera, 0.01, 0.05, None, None, 60.0, 2.0)
        slant, error = (0.0, 1.0) if i % 3 == 0 else (0.02, 1.1)
        some.append(node(a.T_odom_camera, prior, 20.0 * error, slant))
    found = fit(some)
    assert found is not None
    assert found.scale == pytest.approx(3.0, rel=0.001)


def test_a_rangefinder_that_meets_trees_does_not_move_the_scale() -> None:
    rng = np.random.default_rng(3)
    some = []
    for i, a in enumerate(noisy_nodes(np.eye(3), 2.0, np.zeros(3), seed=4)):
        agl_m = 60.0 * (1 + 0.003 * rng.normal()) - (9.0 if i % 4 == 0 else 0.0)
        prior = PosePrior(a.prior.R_world_camera, 0.01, 0.05, None, None, agl_m, 1.8)
        some.append(node(a.T_odom_camera, prior, 30.0))
    found = fit(some)
    assert found is not None
    assert found.scale == pytest.approx(2.0, rel=0.004)


@pytest.mark.slow
def test_fixes_that_err_by_more_than_they_claim_leave_the_scale_as_unsure_as_they_scatter() -> None:
    """Ten are too few to measure their noise by."""
    off = []
    for seed in range(20):
        some = noisy_nodes(np.eye(3), 2.0, np.zeros(3), seed=seed, gnss_m=4.0)[:20:2]
        some = [
            replace(a, height=None, prior=replace(a.prior, sigma_position_m=np.full(3, 0.8)))
            for a in some
        ]
        found = fit(some)
        assert found is not None
        off.append(math.log(found.scale / 2.0) / found.sigma_scale)
    assert 0.5 < math.sqrt(np.mean(np.square(off))) < 1.8


def test_the_track_lies_in_the_mean_of_fixes_that_wander() -> None:
    """What is best for a wander's slope would lay it between the first fix and the last."""
    rng, wander = np.random.default_rng(3), np.zeros(3)
    some, fixes = [], []
    for a in noisy_nodes(np.eye(3), 2.0, np.zeros(3), seed=3, gnss_m=0.2):
        wander = 0.95 * wander + rng.normal(0, 0.4, 3)
        assert a.prior.position_m is not None
        fixes.append(a.prior.position_m + wander)
        prior = replace(a.prior, position_m=fixes[-1], sigma_position_m=np.full(3, 2.0))
        some.append(replace(a, prior=prior))
    found = fit(some)
    assert found is not None and found.noise is not None and found.noise.fixes is not None
    assert found.noise.fixes[0].bias > 2.0 * found.noise.fixes[0].white
    middle = found.points(np.mean([a.place_of_fix for a in some], axis=0))
    np.testing.assert_allclose(middle, np.mean(fixes, axis=0), atol=0.05)
