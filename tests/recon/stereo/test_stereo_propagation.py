"""Belief propagation: exact against plain NumPy, and right on surfaces that are known."""

from __future__ import annotations

from dataclasses import replace

import cv2
import dense_reference as reference
import numpy as np
import pytest

from recon import parallel
from recon.stereo import matching_cost as costs
from recon.stereo import message_passing
from recon.stereo.belief_propagation import BeliefPropagationConfig, belief_propagation
from recon.stereo.lanes import cells_of
from recon.stereo.matching_cost import (
    BIT_COST,
    CENSUS_OFFSETS,
    COST_UNIT,
    LEVEL_COST,
    MAX_BITS,
    MAX_LEVELS,
    UNSEEN_COST,
    Workspace,
    census_row,
    columns_apart,
    matching_cost,
)
from recon.stereo.message_passing import Smoothness, propagate, pyramid_of
from recon.types import F64, I16, U8, Array

ACCEPT_ALL = BeliefPropagationConfig(
    min_evidence=0, min_contrast=0, occlusion_tolerance=-1, speckle_px=0
)


def texture(height: int, width: int, seed: int = 0, blur: float = 1.2) -> F64:
    """Band-limited noise of mean 128 and deviation 40."""
    noise = cv2.GaussianBlur(
        np.random.default_rng(seed).normal(0, 1, (height, width)), (0, 0), blur
    )
    return np.asarray(128 + 40 * noise / noise.std())


def gray(image: Array) -> U8:
    """Rounded to 8 bits."""
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def shifted_pair(disparity: F64, seed: int = 0, blur: float = 1.2) -> tuple[U8, U8]:
    """Left and right view of a texture on a surface of this disparity (h, w)."""
    height, width = disparity.shape
    margin = 80
    canvas = texture(height, width + 2 * margin, seed, blur).astype(np.float32)
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    x = (u - disparity + margin).astype(np.float32)
    left = cv2.remap(canvas, x, v, cv2.INTER_LANCZOS4)
    return gray(left), gray(canvas[:, margin : margin + width])


def beliefs(cost: I16, image: U8, iterations: int, levels: int, smoothness: Smoothness) -> Array:
    """(h, w, L) beliefs by the compiled kernels, assembled cell by cell; bytes if they fit."""
    height, labels, width = cost.shape
    above = np.minimum(cost - cost.min(axis=1, keepdims=True), 4 * smoothness.truncation)
    kind = np.uint8 if cost.max() < 256 else np.int16
    data = np.zeros((height, 2, labels, cells_of(width)), kind)
    for parity in range(2):
        columns = above[:, :, parity::2]
        data[:, parity, :, : columns.shape[2]] = columns
    weights = pyramid_of(smoothness.weights(image), levels)
    messages = propagate(data, weights, iterations, smoothness)
    out = np.zeros((height, width, labels), np.int64)
    for v in range(height):
        for u in range(width):
            out[v, u] = data[v, u & 1, :, u // 2]
            out[v, u] += messages[0, v + 2, u & 1, :, u // 2]
            out[v, u] += messages[1, v, u & 1, :, u // 2]
            if u + 1 < width:
                out[v, u] += messages[2, v + 1, (u + 1) & 1, :, (u + 1) // 2]
            if u > 0:
                out[v, u] += messages[3, v + 1, (u - 1) & 1, :, (u - 1) // 2]
    return out


@pytest.mark.parametrize("most", [255, 1200])
@pytest.mark.parametrize(
    ("height", "width", "labels", "iterations", "levels"),
    [
        (1, 1, 2, 5, 5), (1, 9, 3, 2, 3), (9, 1, 3, 2, 3), (23, 37, 5, 5, 5),
        (24, 64, 16, 5, 4), (33, 65, 7, 1, 2), (45, 130, 4, 3, 5), (40, 66, 33, 4, 1),
    ],
)  # fmt: skip
def test_beliefs_equal_the_reference(
    height: int, width: int, labels: int, iterations: int, levels: int, most: int
) -> None:
    rng = np.random.default_rng(height * width)
    cost = rng.integers(0, most, (height, labels, width)).astype(np.int16)
    image = rng.integers(0, 256, (height, width), np.uint8)
    smoothness = BeliefPropagationConfig(edge_floor=0.3).smoothness
    got = beliefs(cost, image, iterations, levels, smoothness)
    want = reference.beliefs(cost, image, iterations, levels, smoothness)
    np.testing.assert_array_equal(got, want)


def test_one_row_finds_the_exact_minimum_of_the_energy() -> None:
    """On a chain, min-sum is exact once messages crossed it: compare with dynamic programming."""
    rng = np.random.default_rng(5)
    width, labels = 24, 6
    cost = rng.integers(0, 700, (1, labels, width)).astype(np.int16)
    image = np.full((1, width), 90, np.uint8)
    config = BeliefPropagationConfig()
    belief = reference.beliefs(cost, image, 60, 1, config.smoothness)
    found = beliefs(cost, image, 60, 1, config.smoothness)
    step = abs(np.arange(labels)[:, None] - np.arange(labels)[None, :])
    price = np.minimum(step * COST_UNIT, config.truncation)
    best = cost[0, :, 0].astype(np.int64)
    trace = []
    for u in range(1, width):
        options = best[None, :] + price
        trace.append(options.argmin(axis=1))
        best = options.min(axis=1) + cost[0, :, u]
    path = [int(best.argmin())]
    for back in reversed(trace):
        path.append(int(back[path[-1]]))
    np.testing.assert_array_equal(belief[0].argmin(axis=1), path[::-1])
    np.testing.assert_array_equal(found[0].argmin(axis=1), path[::-1])


def census(image: U8) -> Array:
    """(h, w) words of 32 bits from the compiled rows, the first neighbour in the highest bit."""
    height, width = image.shape
    words = np.zeros((height, width), np.int64)
    row = np.empty((2, 5, cells_of(width)), np.uint8)
    for v in range(height):
        census_row(columns_apart(image), v, row, 0)
        for parity in range(2):
            here = words[v, parity::2]
            for part in row[parity, :4].astype(np.int64):
                here[:] = here << 8 | part[: len(here)]
            np.testing.assert_array_equal(row[parity, 4, : len(here)], image[v, parity::2])
    return words


def test_census_against_its_definition() -> None:
    image = np.random.default_rng(1).integers(0, 256, (12, 15), np.uint8)
    words = census(image)
    padded = np.pad(image, 3, mode="edge").astype(int)
    assert len(set(CENSUS_OFFSETS)) == 32
    for v, u in ((0, 0), (5, 7), (11, 14), (3, 0)):
        bits = [padded[v + 3 + dv, u + 3 + du] < int(image[v, u]) for dv, du in CENSUS_OFFSETS]
        assert int(words[v, u]) == int("".join("1" if b else "0" for b in bits), 2)


def test_a_byte_holds_the_cost_of_every_label_and_255_is_left() -> None:
    most = BIT_COST * MAX_BITS + LEVEL_COST * MAX_LEVELS
    assert max(most, UNSEEN_COST) < 255 and len(CENSUS_OFFSETS) >= MAX_BITS


@pytest.mark.parametrize("min_disparity", [0, 3, -4, 40, -40])
def test_matching_cost_against_its_definition(min_disparity: int) -> None:
    rng = np.random.default_rng(2)
    left, right = rng.integers(0, 256, (2, 9, 22), np.uint8)
    above, least = matching_cost(left, right, 6, min_disparity)
    words_left, words_right = census(left), census(right)
    for v in range(9):
        for u in range(22):
            seen = {}
            for label in range(6):
                x = u - label - min_disparity
                if 0 <= x < 22:
                    bits = bin(int(words_left[v, u]) ^ int(words_right[v, x])).count("1")
                    gray_step = abs(int(left[v, u]) - int(right[v, x]))
                    census_cost = min(bits, MAX_BITS) * BIT_COST
                    seen[label] = census_cost + min(gray_step, MAX_LEVELS) * LEVEL_COST
            unseen = min(seen.values()) + UNSEEN_COST if seen else 0
            want = [seen.get(label, unseen) for label in range(6)]
            cell = (u & 1, slice(None), u // 2)
            assert least[v, u & 1, u // 2] == min(want)
            assert (above[v][cell].astype(int) + min(want)).tolist() == want


@pytest.mark.parametrize(("labels", "top"), [(16, 12.0), (32, 27.0), (64, 57.0), (5, 3.4)])
def test_slanted_plane_to_a_tenth_of_a_pixel(labels: int, top: float) -> None:
    height, width = 90, 200
    truth = np.tile(np.linspace(1.0, top, width), (height, 1))
    found = belief_propagation(*shifted_pair(truth), labels, BeliefPropagationConfig())
    inner = np.zeros(truth.shape, np.bool_)
    inner[:, 8:-8] = np.arange(8, width - 8) - truth[0, 8:-8] > 4
    error = (found.px - truth)[inner]
    assert np.isfinite(error).mean() > 0.93
    error = error[np.isfinite(error)]
    assert np.sqrt((error**2).mean()) < 0.15
    assert abs(error.mean()) < 0.03
    assert found.px.dtype == found.confidence.dtype == np.float32
    assert ((found.confidence > 0) == np.isfinite(found.px)).all()


def test_offset_between_labels_has_little_bias() -> None:
    for fraction in (0.0, 0.2, 0.4, 0.5, 0.6, 0.8):
        truth = np.full((60, 120), 6 + fraction)
        px = belief_propagation(*shifted_pair(truth, blur=1.5), 16, ACCEPT_ALL).px
        assert abs(np.median(px[:, 30:]) - 6 - fraction) < 0.07


def test_min_disparity_moves_the_window_only() -> None:
    truth = np.full((60, 140), 23.3)
    left, right = shifted_pair(truth)
    for first in (0, 10, 20):
        config = replace(ACCEPT_ALL, min_disparity=first)
        px = belief_propagation(left, right, 26 - first, config).px[:, 40:]
        assert abs(np.nanmedian(px) + first - 23.3) < 0.1
    px = belief_propagation(right, left, 8, replace(ACCEPT_ALL, min_disparity=-27)).px[:, :90]
    assert abs(np.nanmedian(px) - 27 + 23.3) < 0.1  # the views exchanged


def box_scene() -> tuple[F64, U8, U8]:
    """A near box before a far wall, with the truth of the left view."""
    truth = np.full((100, 180), 4.0)
    truth[30:70, 70:120] = 14.0
    far, near = texture(100, 340, 3), texture(100, 340, 4)
    u, v = np.meshgrid(np.arange(180), np.arange(100))
    on_box = truth == 14
    left = np.where(on_box, near[v, u - 14 + 80], far[v, u - 4 + 80])
    box_right = np.roll(on_box, -14, axis=1)
    right = np.where(box_right, near[v, u + 80], far[v, u + 80])
    return truth, gray(left), gray(right)


def test_occluded_strip_is_unknown_and_edges_stay_sharp() -> None:
    truth, left, right = box_scene()
    px = belief_propagation(left, right, 20, BeliefPropagationConfig()).px
    hidden = np.zeros(truth.shape, np.bool_)
    hidden[32:68, 60:69] = True  # wall that the box covers in the right view
    assert np.isnan(px[hidden]).mean() > 0.7
    known = np.isfinite(px)
    assert (np.abs(px - truth) < 1)[known & ~hidden].mean() > 0.97
    filled = belief_propagation(left, right, 20, BeliefPropagationConfig(fill_occluded=True))
    assert (np.abs(filled.px - truth) < 1)[hidden].mean() > 0.5
    assert np.isfinite(filled.px).sum() > known.sum()
    new = np.isfinite(filled.px) & ~known
    assert np.median(filled.confidence[new]) <= 0.051


@pytest.mark.parametrize("contrast", [0, 30, 50])
def test_a_raised_box_is_hardly_widened_over_weakly_textured_ground(contrast: int) -> None:
    far, near = 90 - contrast + 0.3 * texture(100, 340, 3), texture(100, 340, 4) + contrast
    u, v = np.meshgrid(np.arange(180), np.arange(100))
    box, hidden = np.zeros((2, 100, 180), np.bool_)
    box[30:70, 70:120], hidden[30:70, 68:70] = True, True
    left = np.where(box, near[v, u + 74], far[v, u + 76])
    right = np.where(np.roll(box, -6, axis=1), near[v, u + 80], far[v, u + 80])
    px = belief_propagation(gray(left), gray(right), 16, BeliefPropagationConfig()).px
    nearer = np.clip((px - np.where(box, 6, 4)) / 2, -1, 1)
    known = np.isfinite(px[20:80, 60:130]) & ~hidden[20:80, 60:130]
    assert abs(nearer[20:80, 60:130][known].sum()) / (2 * (50 + 40)) < 0.13  # px of its outline


def test_no_label_whose_partner_lies_outside_the_right_image() -> None:
    truth = np.full((60, 100), 12.0)
    left, right = shifted_pair(truth)
    for fill in (False, True):
        config = BeliefPropagationConfig(fill_occluded=fill)
        px = belief_propagation(left, right, 16, config).px
        u = np.arange(100)[None, :]
        assert not (u - px < -0.5).any()  # half a pixel of sub-pixel offset
        assert np.isnan(px[:, :8]).mean() > 0.8


def rng_image(seed: int, level: float) -> U8:
    """Independent noise about gray 128."""
    return gray(np.random.default_rng(seed).normal(128, level, (120, 200)))


@pytest.mark.parametrize(
    ("left", "right"),
    [
        (np.full((120, 200), 130, np.uint8), np.full((120, 200), 130, np.uint8)),
        (np.full((120, 200), 255, np.uint8), np.full((120, 200), 255, np.uint8)),
        (np.zeros((120, 200), np.uint8), rng_image(1, 40)),
        (rng_image(2, 40), rng_image(3, 40)),
        (rng_image(4, 2), rng_image(5, 2)),
        (gray(texture(120, 200, 6)), gray(texture(120, 200, 7))),
    ],
    ids=["blank", "white", "half blank", "noise", "sensor noise", "unrelated"],
)
def test_nothing_is_invented_without_evidence(left: U8, right: U8) -> None:
    px = belief_propagation(left, right, 16, BeliefPropagationConfig()).px
    assert np.isfinite(px).mean() < 0.08


def test_confidence_tells_right_from_wrong() -> None:
    truth = np.tile(np.linspace(3, 12, 200), (120, 1))
    left, right = shifted_pair(truth)
    patch = gray(texture(120, 200, 9))
    left = left.copy()
    left[30:80, 80:150] = patch[30:80, 80:150]  # moved between the exposures
    found = belief_propagation(left, right, 16, ACCEPT_ALL)
    wrong = np.abs(found.px - truth) > 1
    inside = np.zeros(truth.shape, np.bool_)
    inside[34:76, 84:146] = True
    sound = ~inside & (np.arange(200)[None, :] > 20) & ~wrong
    assert found.confidence[inside & wrong].mean() < 0.5 * found.confidence[sound].mean()


def test_exposure_change_is_survived() -> None:
    truth = np.tile(np.linspace(3, 12, 200), (100, 1))
    left, right = shifted_pair(truth)
    brighter = gray(right * 0.8 + 45)
    px = belief_propagation(left, brighter, 16, BeliefPropagationConfig()).px[:, 20:]
    assert np.isfinite(px).mean() > 0.85
    assert np.nanmean(np.abs(px - truth[:, 20:]) < 0.5) > 0.97


@pytest.mark.parametrize(("tiles", "labels"), [(8, 20), (3, 160)])
def test_result_does_not_depend_on_the_number_of_threads(tiles: int, labels: int) -> None:
    """Of the finest level, and of the next one too, where there are labels enough."""
    _, *views = box_scene()
    left, right = (np.tile(view, (tiles, 1)) for view in views)  # tall enough for several bands
    many = belief_propagation(left, right, labels, BeliefPropagationConfig())
    parallel.limit_threads(1)
    try:
        one = belief_propagation(left, right, labels, BeliefPropagationConfig())
    finally:
        parallel.limit_threads(0)
    np.testing.assert_array_equal(many.px, one.px)
    np.testing.assert_array_equal(many.confidence, one.confidence)


def test_read_only_and_strided_images_compile_nothing_new() -> None:
    from numba.core.dispatcher import Dispatcher

    from recon.stereo import belief_propagation as labels
    from recon.stereo import upsampling
    from recon.types import DisparityMap

    image = np.random.default_rng(0).integers(0, 256, (40, 60), np.uint8)
    guide = np.random.default_rng(1).integers(0, 256, (80, 120, 3), np.uint8)
    modules = (costs, message_passing, labels, upsampling)
    kernels = [k for m in modules for k in vars(m).values() if isinstance(k, Dispatcher)]
    assert len(kernels) > 5

    def once(image: U8, guide: U8, config: BeliefPropagationConfig) -> DisparityMap:
        found = belief_propagation(image, image, 4, config)
        return upsampling.upsample(found, guide)

    want = once(image, guide, BeliefPropagationConfig())
    before = [len(kernel.signatures) for kernel in kernels]
    strided = np.repeat(image, 2, axis=1)[:, ::2]
    strided.flags.writeable = False
    large = np.repeat(guide, 2, axis=1)[:, ::2]
    large.flags.writeable = False
    got = once(strided, large, replace(BeliefPropagationConfig(), occlusion_tolerance=1))
    np.testing.assert_array_equal(got.px, want.px)
    assert [len(kernel.signatures) for kernel in kernels] == before


def test_memory_that_is_used_again_leaves_no_trace() -> None:
    """Other sizes, labels and images in between change nothing, nor does another thread."""
    from concurrent.futures import ThreadPoolExecutor

    _, left, right = box_scene()
    config = BeliefPropagationConfig()
    first = belief_propagation(left, right, 20, config)
    kept = first.px.copy()
    belief_propagation(right, left, 20, config)
    belief_propagation(left[:51, :99], right[:51, :99], 7, config)
    belief_propagation(left[:, :179], right[:, :179], 20, config)
    np.testing.assert_array_equal(first.px, kept)
    np.testing.assert_array_equal(belief_propagation(left, right, 20, config).px, kept)
    with ThreadPoolExecutor(3) as pool:
        jobs = [pool.submit(belief_propagation, left, right, 20, config) for _ in range(9)]
    for job in jobs:
        np.testing.assert_array_equal(job.result().px, kept)


def test_memory_need_not_be_cleared_and_grows_no_further_than_needed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _, left, right = box_scene()
    config = BeliefPropagationConfig()
    take = Workspace.take

    def dirty(space: Workspace, name: str, shape: tuple[int, ...]) -> I16:
        array = take(space, name, shape)
        array[...] = -12345
        return array

    for iterations in (1, 5):
        config = replace(config, iterations=iterations)
        want = belief_propagation(left, right, 20, config)
        with monkeypatch.context() as patch:
            patch.setattr(Workspace, "take", dirty)
            got = belief_propagation(left, right, 20, config)
        np.testing.assert_array_equal(got.px, want.px)
        np.testing.assert_array_equal(got.confidence, want.confidence)


def test_the_finest_messages_are_never_kept() -> None:
    """All that is held: costs, a byte each, and the coarser levels' data and messages."""
    from concurrent.futures import ThreadPoolExecutor

    _, *views = box_scene()
    left, right = (np.tile(view, (3, 3)) for view in views)

    def held() -> int:
        belief_propagation(left, right, 20, BeliefPropagationConfig())
        spaces = (message_passing.WORKSPACE, costs.WORKSPACE)
        return sum(a.nbytes for space in spaces for a in space._kept.values())

    with ThreadPoolExecutor(1) as pool:
        total = pool.submit(held).result()
    assert total < 4.5 * left.size * 20, "with those messages 9"


def test_one_piece_of_memory_serves_sizes_that_are_alike() -> None:
    space = Workspace()
    first = space.take("a", (10, 20, 30))
    assert np.shares_memory(first, space.take("a", (11, 20, 29)))
    assert not np.shares_memory(first, space.take("b", (10, 20, 30)))
    large = space.take("a", (1000, 20, 30))
    assert large.shape == (1000, 20, 30) and not np.shares_memory(first, large)
    assert not np.shares_memory(large, space.take("a", (2, 3))), "no memory is held in vain"


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (3, 5), (7, 64), (8, 63)])
def test_small_images_do_not_fail(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    found = belief_propagation(image, image, 4, BeliefPropagationConfig())
    assert found.px.shape == found.confidence.shape == shape


def test_bad_input_is_named() -> None:
    image = np.zeros((20, 30), np.uint8)
    with pytest.raises(ValueError, match="one size"):
        belief_propagation(image, image[:, :-1], 16, ACCEPT_ALL)
    with pytest.raises(ValueError, match="labels"):
        belief_propagation(image, image, 1, ACCEPT_ALL)
    with pytest.raises(ValueError, match="gray"):
        belief_propagation(image.astype(np.float32), image, 16, ACCEPT_ALL)
    for wrong in ({"iterations": 0}, {"min_disparity": 40_000}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            BeliefPropagationConfig(**wrong)  # type: ignore[arg-type]
