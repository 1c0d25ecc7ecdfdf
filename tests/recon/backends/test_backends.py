"""The contract of every backend against the NumPy references.

Tolerances: beliefs are integers and equal in every backend, so labels agree to 1e-3 px and
unknown pixels exactly (rounding of the sub-pixel division is all that differs); upsampling
agrees to 0.01 px (the compiled kernel's exponential is good to 8e-5), in torch on 97 % of the
pixels, since a mean of the guide half way between two levels may round the other way; ICP
agrees within a twentieth of its own sigma. ``--device cuda`` runs the torch backend on a GPU.
"""

from __future__ import annotations

import cv2
import dense_reference as reference
import numpy as np
import pytest

from recon import se3
from recon.backends import BACKENDS, Backend, load_backend
from recon.mapping.registration import IcpConfig
from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.stereo.matching_cost import matching_cost
from recon.types import F64, U8, DepthMap, DisparityMap

ACCEPT_ALL = BeliefPropagationConfig(
    min_evidence=0, min_contrast=0, occlusion_tolerance=-1, speckle_px=0
)


SLOW = {"torch": [pytest.mark.slow]}  # its import takes seconds


@pytest.fixture(params=[pytest.param(n, marks=SLOW.get(n, ())) for n in sorted(BACKENDS)])
def backend(request: pytest.FixtureRequest) -> Backend:
    """Each backend of the table; torch's kernels have tests of their own for the interpreter."""
    name, device = str(request.param), str(request.config.getoption("--device"))
    if name == "torch":
        pytest.importorskip("torch")
    backend = load_backend(name)
    if device == "cuda" and backend.device != "cuda":
        pytest.skip(f"{name} does not run on {device} here")
    return backend


def pair(height: int, width: int, labels: int, first: int = 0) -> tuple[U8, U8]:
    """A textured pair with a step of disparity within the window of labels."""
    rng = np.random.default_rng(height + width)
    canvas = cv2.GaussianBlur(rng.normal(128, 90, (height, width + 240)), (0, 0), 1.1)
    canvas = np.clip(canvas, 0, 255).astype(np.uint8)
    v, u = np.mgrid[0:height, 0:width]
    d = first + np.where((u > width // 2) & (v > height // 3), labels - 2, labels // 3)
    left = canvas[v, u - d + 120]
    return np.ascontiguousarray(left), np.ascontiguousarray(canvas[:, 120 : 120 + width])


@pytest.mark.parametrize(
    ("height", "width", "labels", "settings"),
    [
        (36, 64, 16, {}),
        (45, 83, 7, {"iterations": 4, "levels": 3}),
        (24, 70, 33, {"min_disparity": -3}),
        (30, 61, 5, {"min_disparity": 4, "smoothness_truncation": 1.5}),
        (9, 40, 2, {"iterations": 1, "levels": 1, "edge_floor": 1.0}),
        (8, 8, 12, {}),
    ],
)
def test_labels_minimise_the_reference_beliefs(
    backend: Backend, height: int, width: int, labels: int, settings: dict[str, float]
) -> None:
    """Every size, label count, border and smoothness: the winner is the reference's."""
    config = BeliefPropagationConfig(
        **{  # type: ignore[arg-type]
            "min_evidence": 0, "min_contrast": 0, "occlusion_tolerance": -1, "speckle_px": 0,
            **settings,
        }
    )  # fmt: skip
    left, right = pair(height, width, labels, config.min_disparity)
    above, _ = matching_cost(left, right, labels, config.min_disparity)
    cost = np.empty((height, labels, width), np.int16)
    for parity in range(2):
        cost[:, :, parity::2] = above[:, parity, :, : (width + 1 - parity) // 2]
    belief = reference.beliefs(cost, left, config.iterations, config.levels, config.smoothness)
    winner = belief.argmin(axis=2)
    low = belief.min(axis=2)
    clear = (belief == low[..., None]).sum(axis=2) == 1
    column = np.arange(width)[None, :]
    partner = column - winner - config.min_disparity
    inside = (partner >= 0) & (partner < width)
    found = backend.belief_propagation(left, right, labels, config)
    assert found.px.shape == found.confidence.shape == (height, width)
    assert np.isnan(found.px[~inside]).all()
    known = np.isfinite(found.px)
    assert (known <= inside).all()
    # rounding halves: an offset of exactly half a label lies between two winners
    assert (np.abs(found.px - winner) <= 0.5 + 1e-4)[known & clear].all()
    assert known[inside & clear].mean() > 0.9 or labels == 2


@pytest.mark.parametrize("fill", [False, True])
def test_disparity_equals_the_compiled_backend(backend: Backend, fill: bool) -> None:
    left, right = pair(72, 128, 16)
    config = BeliefPropagationConfig(fill_occluded=fill)
    want = load_backend("cpu").belief_propagation(left, right, 16, config)
    got = backend.belief_propagation(left, right, 16, config)
    np.testing.assert_array_equal(np.isnan(got.px), np.isnan(want.px))
    np.testing.assert_allclose(got.px, want.px, atol=1e-3)
    np.testing.assert_allclose(got.confidence, want.confidence, atol=1e-4)
    again = backend.belief_propagation(right, right, 16, config)  # the same shapes, new images
    np.testing.assert_allclose(
        again.px, load_backend("cpu").belief_propagation(right, right, 16, config).px, atol=1e-3
    )
    np.testing.assert_array_equal(got.px, backend.belief_propagation(left, right, 16, config).px)


def test_a_pair_as_in_flight_within_a_quarter_of_a_pixel(backend: Backend) -> None:
    """Size and labels that do not fill their arrays: 99 % of the valid pixels."""
    left, right = pair(89, 155, 18)
    config = BeliefPropagationConfig()
    want = load_backend("cpu").belief_propagation(left, right, 18, config)
    got = backend.belief_propagation(left, right, 18, config)
    valid = np.isfinite(want.px)
    assert valid.mean() > 0.8
    assert (np.abs(got.px - want.px)[valid] < 0.25).mean() >= 0.99
    assert (np.isfinite(got.px) == valid).mean() >= 0.99


def test_pairs_of_nearly_one_size_share_what_is_built(backend: Backend) -> None:
    """A graph or a session for each of a flight's pairs would take longer than the flight."""
    built: dict[object, object] = next(
        (v for n, v in vars(backend).items() if n in ("_plans", "_sessions")), {}
    )
    rng = np.random.default_rng(0)
    for height, width, labels in ((60, 100, 17), (57, 97, 20), (64, 127, 24), (58, 110, 18)):
        image = rng.integers(0, 256, (height, width), np.uint8)
        guide = rng.integers(0, 256, (round(1.5 * height), round(1.5 * width), 3), np.uint8)
        found = backend.belief_propagation(image, image, labels, ACCEPT_ALL)
        assert found.px.shape == (height, width)
        assert backend.upsample(found, guide).px.shape == guide.shape[:2]
    assert len(built) <= 3  # the guide of the widest has a larger array


def test_blank_images_stay_unknown(backend: Backend) -> None:
    blank = np.full((40, 60), 128, np.uint8)
    found = backend.belief_propagation(blank, blank, 8, BeliefPropagationConfig())
    assert np.isnan(found.px).all()
    assert (found.confidence == 0).all()


@pytest.mark.parametrize(
    ("coarse", "fine", "holes"),
    [((18, 32), (72, 128), 0.2), ((18, 32), (76, 135), 0.0), ((7, 9), (30, 31), 0.5)],
)
def test_upsampling_equals_the_reference(
    backend: Backend, coarse: tuple[int, int], fine: tuple[int, int], holes: float
) -> None:
    rng = np.random.default_rng(1)
    px = rng.uniform(0, 16, coarse).astype(np.float32)
    px[rng.random(coarse) < holes] = np.nan
    confidence = np.where(np.isnan(px), 0, rng.random(coarse)).astype(np.float32)
    patches = rng.integers(0, 256, (5, 7, 3), np.uint8)
    guide = np.asarray(cv2.resize(patches, (fine[1], fine[0])), np.uint8)
    given = DisparityMap(px, confidence)
    got, want = backend.upsample(given, guide), reference.upsample(given, guide)
    assert got.px.shape == fine
    assert (np.isnan(got.px) != np.isnan(want.px)).mean() < 2e-3
    both = np.isfinite(got.px) & np.isfinite(want.px)
    off = np.abs(got.px - want.px)[both]
    share, trust = (0.97, 5e-3) if backend.name == "torch" else (1.0, 1e-3)
    assert (off < 0.01).mean() >= share and off.max() < (0.2 if share < 1 else 0.01)
    np.testing.assert_allclose(got.confidence[both], want.confidence[both], atol=trust)


def hills(T_world_camera: F64, seed: int) -> DepthMap:
    """A depth image of rolling ground, cast ray by ray, with noise of 2 cm."""
    K = np.array([[100.0, 0, 79.5], [0, 100.0, 44.5], [0, 0, 1]])
    v, u = np.mgrid[0:90, 0:160]
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)], axis=-1)
    direction = rays @ T_world_camera[:3, :3].T
    z = np.full(u.shape, 40.0)
    for _ in range(60):
        p = T_world_camera[:3, 3] + direction * z[..., None]
        ground = 3 * np.sin(p[..., 0] / 5) * np.cos(p[..., 1] / 6) + 0.02 * p[..., 0] ** 2
        z += 0.7 * (p[..., 2] - ground)
    z = z + np.random.default_rng(seed).normal(0, 0.02, z.shape)
    sigma = np.full(z.shape, 0.02, np.float32)
    return DepthMap(z.astype(np.float32), sigma, np.ones(z.shape, np.uint8), K, T_world_camera)


def test_icp_finds_the_motion_and_agrees_with_the_compiled_one(backend: Backend) -> None:
    down = np.diag([1.0, -1.0, -1.0])
    T_a = se3.compose(down, np.array([0.0, 0.0, 40.0]))
    turn = cv2.Rodrigues(np.array([0.01, -0.015, 0.02]))[0].astype(np.float64)
    T_b = se3.compose(down @ turn, np.array([1.2, -0.8, 40.5]))
    source, target = hills(T_b, 1), hills(T_a, 2)
    truth = se3.inverse(T_a) @ T_b
    start = se3.compose(np.eye(3), np.array([0.4, 0.3, -0.3])) @ truth
    got = backend.register(source, target, start, IcpConfig())
    assert got.verdict == "converged"
    off = se3.inverse(truth) @ got.T_target_source
    assert np.linalg.norm(off[:3, 3]) < 0.02
    assert np.linalg.norm(se3.so3_log(off[:3, :3])) < 1e-3
    want = load_backend("cpu").register(source, target, start, IcpConfig())
    between = se3.inverse(want.T_target_source) @ got.T_target_source
    assert np.linalg.norm(between[:3, 3]) < 0.005
    np.testing.assert_allclose(got.inlier_share, want.inlier_share, atol=0.02)
    far = se3.compose(np.eye(3), np.array([500.0, 0, 0]))
    assert backend.register(source, target, far, IcpConfig()).verdict == "rejected"


def test_bad_input_is_named(backend: Backend) -> None:
    image = np.zeros((20, 30), np.uint8)
    with pytest.raises(ValueError, match="one size"):
        backend.belief_propagation(image, image[:, :-1], 16, ACCEPT_ALL)
    given = DisparityMap(np.zeros((20, 30), np.float32), np.ones((20, 30), np.float32))
    with pytest.raises(ValueError, match="smaller"):
        backend.upsample(given, np.zeros((10, 10, 3), np.uint8))


def test_unknown_backend_is_named() -> None:
    with pytest.raises(ValueError, match="there are cpu"):
        load_backend("abacus")
