"""Alignment of depth maps and clouds: exact scenes, other libraries, honest uncertainty."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from paths import SHARED
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from recon import se3
from recon.camera_model import rays
from recon.mapping.registration import IcpConfig, register_projective
from recon.types import F64, DepthMap, Registration, Verdict

RGBD = SHARED / "rgbd_five_poses"
K = np.array([[190.7, 0, 159.5], [0, 190.7, 89.5], [0, 0, 1.0]])
NADIR = np.diag([1.0, -1.0, -1.0])


def height(x: F64, y: F64, kind: str) -> F64:
    """Terrain height in m."""
    if kind == "flat":
        return np.zeros_like(x)
    z = 2.0 * np.sin(x / 7 + 1) * np.cos(y / 9) + np.sin(x / 3.1 + y / 4.3)
    if kind == "houses":
        fx, fy = np.mod(x, 18) - 9, np.mod(y, 22) - 11
        roof = (np.abs(fx) < 4) & (np.abs(fy) < 5)
        z = 0.3 * z + np.where(roof, 5 - 0.8 * np.abs(fx), 0.0)
    if kind == "trench":  # looks the same from everywhere along y
        z = 2.5 * np.sin(x / 5)
    return np.asarray(z)


@lru_cache(maxsize=16)
def rendered(kind: str, east_m: float, north_m: float, up_m: float, tilt: float) -> F64:
    """(180, 320) exact depth along z of a camera that looks down, tilted and turned a little."""
    T = camera(east_m, north_m, up_m, tilt)
    v, u = np.mgrid[0:180, 0:320].astype(np.float64)
    directions = rays(K, np.column_stack([u.ravel(), v.ravel()])) @ T[:3, :3].T
    near, far = np.full(len(directions), 0.75 * up_m), np.full(len(directions), 0.75 * up_m)
    open_ = np.ones(len(directions), bool)
    for t in np.linspace(0.75, 1.25, 220) * up_m:  # march, then halve
        p = T[:3, 3] + directions * t
        below = p[:, 2] <= height(p[:, 0], p[:, 1], kind)
        far[open_] = t
        near[open_ & ~below] = t
        open_ &= ~below
    for _ in range(30):
        middle = 0.5 * (near + far)
        p = T[:3, 3] + directions * middle[:, None]
        below = p[:, 2] <= height(p[:, 0], p[:, 1], kind)
        far, near = np.where(below, middle, far), np.where(below, near, middle)
    return np.asarray(far.reshape(180, 320))


def camera(east_m: float, north_m: float, up_m: float, tilt: float) -> F64:
    turn = se3.so3_exp(tilt * np.array([1.0, -1.5, 3.0]))
    return se3.compose(NADIR @ turn, np.array([east_m, north_m, up_m]))


VIEW_A, VIEW_B = (0.0, 0.0, 60.0, 0.0), (4.0, 1.0, 60.5, 0.01)
T_A_B = se3.inverse(camera(*VIEW_A)) @ camera(*VIEW_B)


def depth_map(depth: F64, sigma_m: float, K_: F64 = K) -> DepthMap:
    return DepthMap(
        depth.astype(np.float32),
        np.full(depth.shape, sigma_m, np.float32),
        np.full(depth.shape, 2, np.uint8),
        K_,
        np.eye(4),
    )


def noise(rng: np.random.Generator, sigma_m: float, blur_px: float) -> F64:
    n = rng.normal(size=(180, 320))
    if blur_px > 0:
        n = gaussian_filter(n, blur_px)
        n /= n.std()
    return np.asarray(n * sigma_m)


def pair(kind: str, seed: int, sigma_m: float, blur_px: float = 0.0) -> tuple[DepthMap, DepthMap]:
    """Source (view b) and target (view a), with noise."""
    rng = np.random.default_rng(seed)
    b = rendered(kind, *VIEW_B) + noise(rng, sigma_m, blur_px)
    a = rendered(kind, *VIEW_A) + noise(rng, sigma_m, blur_px)
    return depth_map(b, max(sigma_m, 0.01)), depth_map(a, max(sigma_m, 0.01))


def start(seed: int, T: F64, shift_m: float = 0.27, turn_rad: float = 0.003) -> F64:
    rng = np.random.default_rng(1000 + seed)
    twist = np.concatenate([rng.normal(size=3) * turn_rad, rng.normal(size=3) * shift_m])
    return np.asarray(se3.exp(twist) @ T)


UNKNOWN = 0.05
"""Variances, m2 or rad2, above those of any direction that the surface shows."""


def weak_directions(result: Registration) -> F64:
    """(k, 6) unit rows: motions that the surface does not show."""
    values, vectors = np.linalg.eigh(result.covariance)
    return np.asarray(vectors.T[values > UNKNOWN])


def ground_error(result: Registration, T: F64) -> F64:
    """(3,) m, where the ground below the source's centre ends up too far."""
    point = np.array([[0.0, 0.0, 60.0]])
    moved, true = se3.transform(result.T_target_source, point), se3.transform(T, point)
    return np.asarray((moved - true)[0])


def normalised(result: Registration, T: F64) -> float:
    error = se3.log(result.T_target_source @ se3.inverse(T))
    return float(error @ np.linalg.solve(result.covariance, error))


# ---- depth maps ------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["hills", "houses"])
@pytest.mark.parametrize("shift_m", [0.05, 0.27, 0.6])
@pytest.mark.slow
def test_forward_and_backward_to_a_centimetre(kind: str, shift_m: float) -> None:
    b, a = pair(kind, 0, 0.0)
    forward = register_projective(b, a, start(1, T_A_B, shift_m))
    T_B_A = se3.inverse(T_A_B)
    backward = register_projective(a, b, start(2, T_B_A, shift_m))
    for result, truth in ((forward, T_A_B), (backward, T_B_A)):
        assert result.verdict == "converged"
        assert result.inlier_share > 0.8
        assert np.abs(ground_error(result, truth)).max() < 0.01
        turn = se3.so3_log(result.T_target_source[:3, :3] @ truth[:3, :3].T)
        assert np.degrees(np.linalg.norm(turn)) < 0.01


@pytest.mark.parametrize(
    ("kind", "sigma_m", "blur_px"),
    [
        ("hills", 0.05, 0.0),
        ("hills", 0.15, 2.0),
        pytest.param("houses", 0.05, 0.0, marks=pytest.mark.slow),
        pytest.param("houses", 0.06, 1.5, marks=pytest.mark.slow),
    ],
)
def test_reported_covariance_holds(kind: str, sigma_m: float, blur_px: float) -> None:
    """Also where the noise of neighbours is alike, as in real depth maps."""
    values = []
    for seed in range(16):
        b, a = pair(kind, seed, sigma_m, blur_px)
        result = register_projective(b, a, start(seed, T_A_B))
        if result.verdict == "converged":
            values.append(normalised(result, T_A_B))
    assert len(values) >= 10
    # Chi-square of six degrees of freedom; never more than twice too sure of itself.
    assert 2.0 < np.mean(values) < 13.0


@pytest.mark.parametrize(("sigma_m", "blur_px"), [(0.0, 0.0), (0.15, 0.0), (0.15, 2.0)])
def test_flat_ground_leaves_three_directions_open(sigma_m: float, blur_px: float) -> None:
    for seed in range(4):
        b, a = pair("flat", seed, sigma_m, blur_px)
        guess = start(seed, T_A_B)
        result = register_projective(b, a, guess)
        assert result.verdict == "degenerate"
        assert len(weak_directions(result)) == 3
        # What can be seen is right: height, roll and pitch.
        error = ground_error(result, T_A_B)
        assert abs(error[2]) < 0.03
        # What cannot be seen stays where the start had it, and is said to be unknown.
        begun = ground_error(
            Registration(guess, np.eye(6), Verdict.CONVERGED, 0.0, 0.0), T_A_B
        )  # fmt: skip
        np.testing.assert_allclose(error[:2], begun[:2], atol=0.12)
        lever = np.hstack([-se3.hat(se3.transform(T_A_B, np.array([[0, 0, 60.0]]))[0]), np.eye(3)])
        sigma = np.sqrt(np.diag(lever @ result.covariance @ lever.T))
        assert sigma[0] > 3 and sigma[1] > 3 and sigma[2] < 0.1


@pytest.mark.slow
def test_a_trench_leaves_one_direction_open() -> None:
    b, a = pair("trench", 0, 0.03)
    guess = start(0, T_A_B)
    result = register_projective(b, a, guess)
    assert result.verdict == "degenerate"
    weak = weak_directions(result)
    assert len(weak) == 1
    error = ground_error(result, T_A_B)
    assert abs(error[0]) < 0.03 and abs(error[2]) < 0.03
    along = weak[0, 3:] / np.linalg.norm(weak[0, 3:])
    assert abs(along[1]) > 0.98


def test_a_fifth_of_wild_depths_does_no_harm() -> None:
    rng = np.random.default_rng(3)
    b, a = pair("hills", 0, 0.05)
    wild = b.depth_m.copy()
    patch = rng.random((18, 32)) < 0.2
    wild[np.kron(patch, np.ones((10, 10), bool))] -= rng.uniform(0.5, 2.5)
    result = register_projective(depth_map(wild, 0.05), a, start(0, T_A_B))
    assert result.verdict == "converged"
    assert np.abs(ground_error(result, T_A_B)).max() < 0.05
    assert result.inlier_share < 0.9


def test_holes_are_not_surface() -> None:
    rng = np.random.default_rng(4)
    b, a = pair("hills", 0, 0.02)
    for d in (b.depth_m, a.depth_m):
        d[rng.random(d.shape) < 0.15] = np.nan
        d[40:90, 100:180] = np.nan
    result = register_projective(b, a, start(0, T_A_B))
    assert result.verdict == "converged"
    assert np.abs(ground_error(result, T_A_B)).max() < 0.02


def test_maps_of_other_size_and_camera() -> None:
    b, a = pair("hills", 0, 0.0)
    half = K.copy()
    half[:2] /= 2  # every second pixel, starting with the first
    coarse = DepthMap(
        np.ascontiguousarray(a.depth_m[::2, ::2]), a.sigma_m[::2, ::2], a.views[::2, ::2], half,
        np.eye(4),
    )  # fmt: skip
    result = register_projective(b, coarse, start(5, T_A_B))
    assert result.verdict == "converged"
    assert np.abs(ground_error(result, T_A_B)).max() < 0.03


def rejected(result: Registration) -> bool:
    return result.verdict == "rejected" and not result.converged


@pytest.mark.slow
def test_what_cannot_be_trusted_is_rejected() -> None:
    b, a = pair("hills", 0, 0.02)
    away = se3.compose(np.eye(3), np.array([500.0, 0.0, 0.0]))
    assert rejected(register_projective(b, a, away))
    nothing = depth_map(np.full((180, 320), np.nan), 0.1)
    assert rejected(register_projective(nothing, a, T_A_B))
    assert rejected(register_projective(b, nothing, T_A_B))
    strict = IcpConfig(max_step_share=0.001)
    assert rejected(register_projective(b, a, start(1, T_A_B, 0.6), strict))
    rng = np.random.default_rng(0)
    rubble = depth_map(60 + rng.normal(size=(180, 320)) * 2.0, 0.05)
    assert rejected(register_projective(rubble, a, T_A_B))
    # A different place altogether, with relief of its own.
    other = depth_map(rendered("houses", 70.0, 33.0, 60.5, 0.01), 0.02)
    result = register_projective(other, a, T_A_B)
    assert rejected(result) or normalised(result, T_A_B) > 0


def test_the_same_call_gives_the_same_answer() -> None:
    b, a = pair("houses", 0, 0.05)
    first, second = (register_projective(b, a, start(0, T_A_B)) for _ in range(2))
    np.testing.assert_array_equal(first.T_target_source, second.T_target_source)


def test_wrong_input_is_named() -> None:
    b, a = pair("flat", 0, 0.0)
    with pytest.raises(ValueError, match="T_target_source"):
        register_projective(b, a, np.eye(3))
    with pytest.raises(ValueError, match="T_target_source"):
        register_projective(b, a, np.full((4, 4), np.nan))
    bad = DepthMap(b.depth_m, b.sigma_m[:10], b.views, K, np.eye(4))
    with pytest.raises(ValueError, match="sigma"):
        register_projective(bad, a, np.eye(4))


# ---- other libraries and real data ------------------------------------------------------------


@pytest.mark.parametrize("kind", ["hills", "houses"])
def test_both_ways_of_alignment_agree(kind: str) -> None:
    """Projective ICP and small_gicp share no correspondence and no normal."""
    small_gicp = pytest.importorskip("small_gicp")
    b, a = pair(kind, 2, 0.05)
    ours = register_projective(b, a, start(2, T_A_B))
    v, u = np.mgrid[0:180, 0:320].astype(np.float64)
    directions = rays(K, np.column_stack([u.ravel(), v.ravel()]))
    clouds = [directions * depth.depth_m.reshape(-1, 1) for depth in (a, b)]
    found = small_gicp.align(
        *clouds, start(2, T_A_B), registration_type="GICP", downsampling_resolution=0.5,
        max_correspondence_distance=2.0, max_iterations=40,
    )  # fmt: skip
    theirs = Registration(np.asarray(found.T_target_source), np.eye(6), Verdict.CONVERGED, 0.0, 0.0)
    assert np.abs(ground_error(ours, T_A_B) - ground_error(theirs, T_A_B)).max() < 0.06


@pytest.mark.parametrize(
    ("kind", "sigma_m", "blur_px"), [("houses", 0.05, 0.0), ("hills", 0.15, 2)]
)
def test_closer_than_open3d_from_the_same_start(kind: str, sigma_m: float, blur_px: float) -> None:
    o3d = pytest.importorskip("open3d", exc_type=ImportError)
    ours, theirs = [], []
    for seed in range(5):
        b, a = pair(kind, seed, sigma_m, blur_px)
        guess = start(seed, T_A_B)
        ours.append(np.linalg.norm(ground_error(register_projective(b, a, guess), T_A_B)))
        images = [
            o3d.t.geometry.RGBDImage(
                o3d.t.geometry.Image(np.zeros((180, 320, 3), np.uint8)),
                o3d.t.geometry.Image(d.depth_m[..., None]),
            )
            for d in (b, a)
        ]
        odometry = o3d.t.pipelines.odometry
        found = odometry.rgbd_odometry_multi_scale(
            *images, o3d.core.Tensor(K), o3d.core.Tensor(guess), 1.0, 100.0,
            [odometry.OdometryConvergenceCriteria(n) for n in (6, 4, 2)],
            odometry.Method.PointToPlane, odometry.OdometryLossParams(1.5, 1.0, 0.3),
        )  # fmt: skip
        T = found.transformation.numpy()
        theirs.append(
            np.linalg.norm(
                ground_error(Registration(T, np.eye(6), Verdict.CONVERGED, 0.0, 0.0), T_A_B)
            )
        )
    assert np.mean(ours) <= np.mean(theirs)


def real_frame(folder: Path, number: int) -> tuple[DepthMap, F64]:
    """A depth map in m and its T_world_camera."""
    raw = cv2.imread(str(folder / "depth" / f"{number}.pgm"), cv2.IMREAD_UNCHANGED)
    depth = np.asarray(raw, np.float64) / 1000.0
    depth[depth == 0] = np.nan
    row = np.loadtxt(folder / "pose.txt")[number - 1]
    T = se3.compose(Rotation.from_quat(row[3:]).as_matrix(), row[:3])
    K_ = np.array([[518.0, 0, 325.5], [0, 519.0, 253.5], [0, 0, 1.0]])
    return depth_map(depth, 0.01, K_), T


@pytest.mark.skipif(not RGBD.is_dir(), reason="rgbd_five_poses is not here")
@pytest.mark.parametrize(("source", "target"), [(3, 2), (4, 5), (5, 4)])
def test_real_rooms(source: int, target: int) -> None:
    (b, T_w_b), (a, T_w_a) = (real_frame(RGBD, n) for n in (source, target))
    truth = se3.inverse(T_w_a) @ T_w_b
    config = IcpConfig(max_step_share=0.2)
    result = register_projective(b, a, start(source, truth, 0.02, 0.01), config)
    assert result.converged
    point = np.array([[0.0, 0.0, 2.0]])
    ours, given = (se3.transform(T, point)[0] for T in (result.T_target_source, truth))
    # The poses given are of a visual odometry themselves: good to a few centimetres.
    assert np.linalg.norm(ours - given) < 0.06
