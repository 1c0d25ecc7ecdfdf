"""Corners and patch search in torch against the compiled kernels, on ``--device``.

Tolerances: corners equal on 99 % of the cells (sums in another order break near ties); places
found to 0.02 px and scores to 2e-3 on 98 % of the points (templates are sampled in fixed point
by the compiled kernel, in float32 here).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from recon.tracking import patch_search
from recon.tracking.matching import MatchingConfig, harris_grid
from recon.types import F64, U8

torch = pytest.importorskip("torch")

CONFIG = MatchingConfig()


@pytest.fixture
def device(request: pytest.FixtureRequest) -> str:
    """Where the torch code runs."""
    return str(request.config.getoption("--device"))


def picture(seed: int, height: int = 150, width: int = 211) -> U8:
    """Texture of several scales with a blank strip."""
    rng = np.random.default_rng(seed)
    image = sum(
        cv2.GaussianBlur(rng.normal(0, 60 * s, (height, width)), (0, 0), s) for s in (1, 2, 4)
    )
    image = np.clip(np.asarray(image) + 128, 0, 255)
    image[:, 30:60] = 100
    return np.asarray(image, np.uint8)


def on(device: str, *arrays: Any) -> Any:
    """The arrays on the device."""
    return [torch.from_numpy(np.ascontiguousarray(a)).to(device) for a in arrays]


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("grid", [7, 30])
def test_corners_are_those_of_the_compiled_kernel(device: str, grid: int, masked: bool) -> None:
    """Cells that do not divide the picture, a blank strip and a mask."""
    from recon.backends.torch_matching import harris_cells

    config = MatchingConfig(grid=grid)
    image = picture(1)
    mask = np.full(image.shape, 255, np.uint8)
    if masked:
        cv2.circle(mask, (120, 80), 25, 0, -1)
    want = harris_grid(image, config, mask)
    given, hole = on(device, image, mask)
    cells = harris_cells(given, config, hole if masked else None).cpu().numpy().reshape(-1, 3)
    got = cells[cells[:, 2] > config.min_response]
    theirs = {(u, v): r for (u, v), r in zip(want.uv_px.tolist(), want.response, strict=True)}
    both = [(r, theirs[(u, v)]) for u, v, r in got.tolist() if (u, v) in theirs]
    assert len(theirs) >= 0.3 * grid**2
    assert len(both) >= 0.99 * max(len(theirs), len(got))
    assert all(abs(a - b) <= 1e-3 * b for a, b in both)


def warped_pair() -> tuple[U8, U8, F64, F64, F64]:
    """Two views by an affine motion: images, points of a, their true places, inverse warps."""
    a = picture(2)
    A = np.array([[1.03, 0.05], [-0.04, 0.97]])
    t = np.array([3.3, -2.6])
    b = cv2.warpAffine(a, np.column_stack([A, t]), (a.shape[1], a.shape[0]), flags=cv2.INTER_CUBIC)
    rng = np.random.default_rng(4)
    corners = harris_grid(a, CONFIG).uv_px.astype(np.float64)
    border = rng.uniform((-5, -5), (215, 155), (40, 2))  # some at and beyond the border
    uv = np.vstack([corners, border])
    inverse = np.tile(np.linalg.inv(A).reshape(1, 4), (len(uv), 1))
    return a, np.asarray(b, np.uint8), uv, uv @ A.T + t, inverse


@pytest.mark.parametrize("reach", [4, 8])
def test_search_finds_what_the_compiled_kernel_finds(device: str, reach: int) -> None:
    """Place, score, the next separate peak and contrast; the same points have no answer."""
    from recon.backends.torch_matching import search

    a, b, uv, truth, inverse = warped_pair()
    guess = truth + np.random.default_rng(5).uniform(-3, 3, truth.shape)
    active = np.arange(len(uv)) % 17 != 0
    N = len(uv)
    found, score, second, contrast = guess.copy(), np.empty(N), np.empty(N), np.empty(N)
    patch_search.search(
        a, b, uv, guess.copy(), inverse, active, reach, 5, 2.0, found, score, second, contrast
    )
    ga, gb, guv, gguess, gw, gactive = on(device, a, b, uv, guess, inverse, active)
    got = search(ga, gb, guv, gguess, gw, gactive, reach, 5, 2.0)
    none = score == patch_search.NO_SCORE
    assert 0.02 < none.mean() < 0.5
    assert ((got.score.cpu().numpy() == patch_search.NO_SCORE) == none).mean() > 0.99
    alike = np.abs(got.uv.cpu().numpy() - found).max(axis=1) < 0.02
    alike &= np.abs(got.score.cpu().numpy() - score) < 2e-3
    alike &= np.abs(got.contrast.cpu().numpy() - contrast) < 0.1
    assert alike.mean() > 0.98
    assert (np.abs(got.second.cpu().numpy() - second) < 5e-3).mean() > 0.98
    off = np.linalg.norm(got.uv.cpu().numpy() - truth, axis=1)[~none & (score > 0.9)]
    assert np.median(off) < 0.3


def test_refinement_ends_where_the_compiled_one_does(device: str) -> None:
    """Sub-pixel places, scores and contrasts; strays and borders have no answer in both."""
    from recon.backends.torch_matching import refine

    a, b, uv, truth, inverse = warped_pair()
    start = truth + np.random.default_rng(6).uniform(-0.8, 0.8, truth.shape)
    N = len(uv)
    active = np.arange(N) % 17 != 0
    want, score, contrast_a, contrast_b = start.copy(), np.empty(N), np.empty(N), np.empty(N)
    patch_search.refine(a, b, uv, inverse, active, 5, 6, want, score, contrast_a, contrast_b)
    ga, gb, guv, gstart, gw, gactive = on(device, a, b, uv, start, inverse, active)
    got = refine(ga, gb, guv, gstart, gw, gactive, 5, 6)
    lost = score == patch_search.NO_SCORE
    assert 0.02 < lost.mean() < 0.5
    assert ((got.score.cpu().numpy() == patch_search.NO_SCORE) == lost).mean() > 0.98
    near = np.abs(got.uv.cpu().numpy() - want).max(axis=1) < 0.02
    near &= np.abs(got.score.cpu().numpy() - score) < 2e-3
    near &= np.abs(got.contrast_b.cpu().numpy() - contrast_b) < 0.1
    assert near[~lost].mean() > 0.98
    assert np.median(np.linalg.norm(got.uv.cpu().numpy() - truth, axis=1)[~lost]) < 0.05


def large_picture(seed: int, height: int = 300, width: int = 420) -> U8:
    """Texture that survives three halvings, and a patch that repeats."""
    rng = np.random.default_rng(seed)
    image = sum(
        cv2.GaussianBlur(rng.normal(0, 50 * s, (height, width)), (0, 0), s) for s in (1, 3, 7)
    )
    image = np.clip(np.asarray(image) + 128, 0, 255)
    tile = rng.integers(60, 200, (9, 9))
    image[200:263, 300:363] = np.tile(tile, (7, 7))
    return np.asarray(image, np.uint8)


@pytest.mark.parametrize(
    ("radius_px", "shift", "zoom"), [(6.0, 2.4, 1.0), (14.0, 8.3, 1.02), (50.0, 31.7, 0.96)]
)
def test_matching_on_the_device_is_that_of_the_host(
    device: str, radius_px: float, shift: float, zoom: float
) -> None:
    """From one level, two and four: the same points, at the same places to 0.02 px."""
    from recon.backends.torch_tracking import TorchMatcher
    from recon.tracking.matching import HostMatcher, Matcher

    A = np.array([[zoom, 0.02], [-0.02, zoom]])
    t = np.array([shift, -0.6 * shift])
    a = large_picture(7)
    moved = cv2.warpAffine(a, np.column_stack([A, t]), a.shape[::-1], flags=cv2.INTER_CUBIC)
    b = np.clip(0.9 * np.asarray(moved, np.float64) + 12, 0, 255).astype(np.uint8)
    mask = np.full(a.shape, 255, np.uint8)
    mask[:, :20] = 0
    matchers: list[Matcher] = [HostMatcher(), TorchMatcher(device)]
    levels = [(m.pyramid(a, 5), m.pyramid(b, 5)) for m in matchers]
    corners, found = [], []
    for matcher, (first, _) in zip(matchers, levels, strict=True):
        corners.append({tuple(uv) for uv in matcher.corners(first, CONFIG, mask).uv_px.tolist()})
    assert len(corners[0] & corners[1]) >= 0.99 * len(corners[0] | corners[1])
    uv = np.array(sorted(corners[0]))
    guess = uv @ A.T + t + np.random.default_rng(1).uniform(-2, 2, uv.shape)
    guess[::23] = np.nan
    for matcher, (first, second) in zip(matchers, levels, strict=True):
        found.append(matcher.match(first, uv, second, guess, radius_px, A, CONFIG))
    want, got = found
    assert 0.5 < want.ok.mean() < 1.0
    assert (want.ok == got.ok).mean() >= 0.98
    both = want.ok & got.ok
    assert (np.abs(want.uv_px - got.uv_px)[both].max(axis=1) < 0.02).mean() >= 0.98
    assert (np.abs(want.zssd - got.zssd)[both] < 4e-3).mean() >= 0.98
    truth = uv @ A.T + t
    assert np.median(np.linalg.norm(got.uv_px - truth, axis=1)[got.ok]) < 0.1


def test_what_the_matcher_is_given_is_checked(device: str) -> None:
    """Shapes, sizes and radius; no points are no matches; a pyramid of another maker will do."""
    from recon.backends.torch_tracking import TorchMatcher
    from recon.tracking.matching import Pyramid

    own = TorchMatcher(device)
    a = own.pyramid(picture(1), 5)
    with pytest.raises(ValueError, match="differ"):
        own.corners(a, CONFIG, np.ones((3, 3), np.uint8))
    with pytest.raises(ValueError, match="radius_px must be positive"):
        own.match(a, [[50.0, 50.0]], a, [[50.0, 50.0]], 0.0, None, CONFIG)
    with pytest.raises(ValueError, match="pyramids"):
        smaller = Pyramid.build(picture(1)[:100])
        own.match(a, [[50.0, 50.0]], smaller, [[50.0, 50.0]], 4.0, None, CONFIG)
    nothing = own.match(a, np.zeros((0, 2)), a, np.zeros((0, 2)), 4.0, None, CONFIG)
    assert nothing.uv_px.shape == (0, 2) and nothing.ok.shape == (0,)
    uv = own.corners(a, CONFIG, None).uv_px
    same = own.match(Pyramid.build(picture(1)), uv, a, uv + 1.0, 4.0, None, CONFIG)
    assert same.ok.mean() > 0.8
    assert np.abs(same.uv_px - uv)[same.ok].max() < 0.02
