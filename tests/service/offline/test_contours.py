"""Contours follow the bare ground; none runs over roofs, none is a crumb."""

from __future__ import annotations

import numpy as np
import pytest

from recon.surface.ground import terrain
from recon.surface.raster import Grid, Raster
from recon.types import F64, Array
from service.offline.exports.contours import MIN_LENGTH_M, Contour, contour_lines

GRID = Grid(1000.0, 5000.0, 0.25, (320, 400))  # 100 m x 80 m


def hill(x: Array, y: Array) -> F64:
    return np.asarray(400.3 + 6.0 * np.exp(-((x - 1060) ** 2 + (y - 4960) ** 2) / 900.0))


@pytest.fixture(scope="module")
def surface() -> Raster:
    """A hill with a house of 8 m x 10 m, 5 m high, a car, and noise of 5 cm."""
    rows, cols = np.indices(GRID.shape)
    x, y = GRID.centres(rows.ravel(), cols.ravel()).T.reshape(2, *GRID.shape)
    height = hill(x, y) + np.random.default_rng(3).normal(0.0, 0.05, GRID.shape)
    height[(np.abs(x - 1075) < 4.0) & (np.abs(y - 4955) < 5.0)] += 5.0
    height[(np.abs(x - 1050) < 0.8) & (np.abs(y - 4940) < 2.0)] += 1.5
    height[:, :20] = np.nan
    shape = GRID.shape
    sigma, rgb = np.full(shape, 0.05, np.float32), np.zeros((*shape, 3), np.uint8)
    return Raster(GRID, height.astype(np.float32), sigma, rgb)


@pytest.fixture(scope="module")
def found(surface: Raster) -> list[Contour]:
    return list(contour_lines(terrain(surface), GRID, 1.0))


def test_lines_lie_where_the_ground_has_their_height(found: list[Contour]) -> None:
    assert {one.height_m for one in found} == {401.0, 402.0, 403.0, 404.0, 405.0, 406.0}
    off = np.concatenate([hill(*one.line.T) - one.height_m for one in found])
    assert np.abs(off).mean() < 0.05 and np.abs(off).max() < 0.3


def test_none_is_short_or_runs_over_the_house(found: list[Contour]) -> None:
    for one in found:
        assert np.linalg.norm(np.diff(one.line, axis=0), axis=1).sum() >= MIN_LENGTH_M
        inside = (np.abs(one.line[:, 0] - 1075) < 4.0) & (np.abs(one.line[:, 1] - 4955) < 5.0)
        assert not inside.any()


def test_lines_are_smooth(found: list[Contour]) -> None:
    """No more turning than a hill and its noise ask for: a chain of cells turns at each."""
    steps = [np.diff(one.line, axis=0) for one in found]
    turned = [np.abs(np.angle(np.exp(1j * np.diff(np.arctan2(*s.T))))).sum() for s in steps]
    length = sum(np.linalg.norm(s, axis=1).sum() for s in steps)
    assert sum(turned) / length < 0.25  # rad a metre


def test_every_fifth_line_is_an_index_line_with_a_label(found: list[Contour]) -> None:
    assert {one.label for one in found if one.is_index} == {"405"}
    assert {one.label for one in found if one.height_m != 405.0} == {""}


def test_a_tile_has_the_lines_of_its_box(surface: Raster, found: list[Contour]) -> None:
    box = (1040.0, 4940.0, 1070.0, 4975.0)
    for one in contour_lines(terrain(surface), GRID, 1.0, box):
        assert one.line[:, 0].min() > 1039.5 and one.line[:, 0].max() < 1071.0
        same = np.concatenate([o.line for o in found if o.height_m == one.height_m])
        apart = np.linalg.norm(one.line[:, None] - same[None], axis=2).min(axis=1)
        assert np.median(apart) < 0.6
