"""The triangles of a keyframe's surface, at all levels of detail."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from web_module import NEEDS_NODE, web_module

from recon.types import F64

RESULT = """[0, 1, 2, 3, 4].map((level) => {
  const { codes, sigma, ...head } = given;
  const arrays = { codes: Uint32Array.from(codes), sigma: Uint8Array.from(sigma), views: [] };
  const { pixel, at, index } = page.triangulate({ ...head, ...arrays }, level);
  return { pixel: [...pixel], at: [...at], index: [...index] };
})"""
WIDTH_PX, HEIGHT_PX, FOCAL_PX = 320, 180, 300.0
GROUND_M, ROOF_M, NOISE_M = 60.0, 52.0, 0.02
LOW, STEP = 0.01, 2e-7
SKIRT, OUTSIDE_PX, EDGE_PX = 32768, 16, 8
ROOF = np.s_[50:130, 101:223]

pytestmark = NEEDS_NODE


def flat_roof() -> dict[str, Any]:
    """A keyframe from above a flat roof on sloping ground, with some pixels unknown."""
    rng = np.random.default_rng(3)
    depth = np.tile(GROUND_M + 0.01 * np.arange(WIDTH_PX), (HEIGHT_PX, 1))
    depth[ROOF] = ROOF_M
    depth += rng.normal(0.0, NOISE_M, depth.shape)
    known = rng.uniform(size=depth.shape) > 0.05
    codes = np.where(known, np.rint((1.0 / depth - LOW) / STEP) + 1.0, 0.0).astype(int)
    blocks = -(-WIDTH_PX // 4) * -(-HEIGHT_PX // 4)
    return {
        "codes": codes.ravel().tolist(),
        "sigma": [1 + int(4 * np.log2(NOISE_M / 0.001))] * blocks,
        "w": WIDTH_PX, "h": HEIGHT_PX, "box": [0, 0, WIDTH_PX, HEIGHT_PX],
        "size": [WIDTH_PX, HEIGHT_PX], "isWhole": True,
        "K": [FOCAL_PX, FOCAL_PX, WIDTH_PX / 2, HEIGHT_PX / 2], "low": LOW, "step": STEP,
    }  # fmt: skip


def corners(grid: dict[str, list[int]]) -> tuple[F64, F64]:
    """Of (N, 3) triangles the places, (N, 3, 2) pixels, and the depths, m."""
    pixel = np.array(grid["pixel"], float).reshape(-1, 4)
    index = np.array(grid["index"]).reshape(-1, 3)
    place = pixel[:, :2] - OUTSIDE_PX - np.array([SKIRT, 0]) * (pixel[:, :1] >= SKIRT)
    depth = 1.0 / (LOW + STEP * pixel[:, 2])
    return place[index], depth[index]


def area(places: F64) -> float:
    """Pixels that the triangles cover together, none of them twice."""
    a, b, c = places[:, 0], places[:, 1], places[:, 2]
    u, v = b - a, c - a
    return float(np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum() / 2.0)


@pytest.mark.slow
def test_no_level_joins_a_roof_to_the_ground(tmp_path_factory: pytest.TempPathFactory) -> None:
    levels = web_module(tmp_path_factory.mktemp("surface"), "surface", RESULT)(flat_roof())
    tops, left = np.zeros((HEIGHT_PX, WIDTH_PX), bool), WIDTH_PX * HEIGHT_PX
    tops[ROOF] = True
    for level, grid in enumerate(levels):
        places, depths = corners(grid)
        assert np.ptp(depths, axis=1).max() < 4.0, level  # the roof is 8 m above
        is_roof = depths.mean(axis=1) < (GROUND_M + ROOF_M) / 2.0
        side, (high, wide) = 2**level, tops[ROOF].shape
        assert area(places[is_roof]) > (high - 2 * side) * (wide - 2 * side), level
        around = 2 * side * (high + wide + 2 * side)
        assert area(places[~is_roof]) > left - tops.sum() - around, level


@pytest.mark.slow
def test_a_skirt_has_the_colours_of_its_own_place(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Where the keyframe's whole image shows them; beyond that those of its border."""
    shown = web_module(tmp_path_factory.mktemp("skirts"), "surface", RESULT)
    size = np.array([WIDTH_PX, HEIGHT_PX])
    for is_whole in (True, False):
        (grid, *_) = shown({**flat_roof(), "isWhole": is_whole})
        pixel = np.array(grid["pixel"], float).reshape(-1, 4)[:, :2] - OUTSIDE_PX
        pixel[:, 0] -= SKIRT * (pixel[:, 0] > SKIRT / 2)
        at = np.array(grid["at"], float).reshape(-1, 2) / 65535 * (size + 2 * EDGE_PX)
        away = np.abs(at - EDGE_PX - 0.5 - np.clip(pixel, 0, size - 1)).max(axis=1)
        assert (pixel.min() < 0) and (away.max() < 0.1) == is_whole
        assert away.max() < 3.0  # else those of the nearest measured pixel


@pytest.mark.slow
def test_a_graphics_card_keeps_images_sharp_where_they_lie_aslant(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    seen = """given.map((card) => {
      const texture = new three.Texture();
      page.sharpen(texture, card);
      return [texture.anisotropy, texture.minFilter === three.LinearMipmapLinearFilter]; })"""
    run = web_module(tmp_path_factory.mktemp("sharp"), "surface", seen)
    cards = [{"software": software, "anisotropy": 16} for software in (True, False)]
    assert run(cards) == [[1, False], [16, True]]
