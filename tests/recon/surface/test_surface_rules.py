"""What comes back into a surface model and what is filled, in scenes of a few cells.

Cells have 0.25 m. The air is stated, not computed: what lies above a cell is free, not seen, or
hidden by a surface from all that look there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

from recon.surface.raster import Grid, Raster, without_cells
from recon.types import F32, F64, U8, Bool
from service.offline.exports import surface
from service.offline.exports.surface import SurfaceHeights

CELL_M = 0.25
SIZE = 60
ROWS, COLS = np.mgrid[0:SIZE, 0:SIZE]
SIGMA_M = np.full((SIZE, SIZE), 0.05, np.float32)
NOWHERE = np.zeros((SIZE, SIZE), np.bool_)
GAP = (ROWS >= 24) & (ROWS < 36) & (COLS >= 26) & (COLS < 30)
"""Cells of the ground along the west wall of :func:`house`."""


def house() -> F32:
    """Level ground with a roof 6 m high."""
    is_roof = (ROWS >= 20) & (ROWS < 40) & (COLS >= 30) & (COLS < 50)
    return np.where(is_roof, 6.0, 0.0).astype(np.float32)


@dataclass
class Air:
    """Air above the cells: ``unseen`` at all heights, and ``hidden`` at some of them (m)."""

    unseen: Bool = field(default_factory=NOWHERE.copy)
    hidden: dict[float, Bool] = field(default_factory=dict)

    def above(self, places: F64, up_m: Sequence[float]) -> tuple[Bool, U8]:
        """As a scan's: no surface is seen through, and the rest of the air is free."""
        cols, rows = (places[:, :2] * [1.0, -1.0] / CELL_M).astype(int).T
        behind = np.stack([self.hidden.get(up, NOWHERE)[rows, cols] for up in up_m], axis=1)
        is_free = ~self.unseen[rows, cols][:, None] & ~behind & (np.array(up_m) > 0.0)
        return is_free, behind.astype(np.uint8)


def modelled(
    height: F32,
    missing: Bool,
    air: Air,
    is_whole: bool = True,
) -> SurfaceHeights:
    """The surface model of these heights (rows, cols) without the ``missing`` ones."""
    grid = Grid(0.0, 0.0, CELL_M, (SIZE, SIZE))
    rgb = np.full((SIZE, SIZE, 3), 90, np.uint8)
    measured = without_cells(Raster(grid, height, SIGMA_M, rgb), missing)
    scan: Any = SimpleNamespace(
        raster=lambda cell_m: measured,
        is_whole=is_whole,
        frame=None,
        off_nadir_deg=np.zeros(3),
        shared=lambda key, make: make(),
        air_above=air.above,
    )
    return surface.surface_model(scan, CELL_M)


def test_level_ground_comes_back_as_measured_where_nothing_hides_it() -> None:
    """Next to the wall no fill is made, and the air above is not seen."""
    wall = GAP & (COLS == 29)
    height = house() + np.where(wall, np.float32(0.125), np.float32(0.0))
    air = Air(wall, {1: wall & (ROWS >= 28) & (ROWS < 30), 6: wall & (ROWS >= 32)})
    found = modelled(height, NOWHERE, air)
    is_back = wall & ((ROWS < 28) | (ROWS >= 30) & (ROWS < 32))
    assert (found.raster.height_m[is_back] == 0.125).all() and found.is_filled[is_back].all()
    assert not found.raster.known[wall & ~is_back].any()


def test_a_ledge_below_air_that_was_not_seen_does_not_come_back() -> None:
    ledge = (ROWS >= 24) & (ROWS < 36) & (COLS >= 10) & (COLS < 12)
    height = house() + np.where(ledge, np.float32(0.6), np.float32(0.0))
    assert not modelled(height, NOWHERE, Air(ledge)).raster.known[ledge].any()
    assert modelled(height, NOWHERE, Air()).raster.known[ledge].all()


def test_holes_are_filled_up_to_six_metres() -> None:
    for cells, is_filled in ((22, True), (28, False)):
        hole = np.maximum(np.abs(ROWS - 29.5), np.abs(COLS - 29.5)) < cells / 2
        found = modelled(np.zeros((SIZE, SIZE), np.float32), hole, Air())
        assert found.raster.known[29, 29] == found.is_filled[29, 29] == is_filled


def test_fills_near_something_higher_need_free_air_low_above_them() -> None:
    for up_m in (1, 2, 3):
        found = modelled(house(), GAP, Air(hidden={up_m: GAP & (ROWS >= 30)}))
        near = GAP & (COLS == 28)
        assert found.raster.known[near & (ROWS < 30)].all()
        assert not found.raster.known[near & (ROWS >= 30)].any()
        assert (found.raster.height_m[GAP & (COLS < 28)] == 0.0).all()


def test_beyond_the_outline_of_a_whole_scan_nothing_comes_back() -> None:
    """At the rim: level ground below unseen air, a bay without measurements, a narrow roof."""
    survey = (ROWS >= 10) & (ROWS < 50) & (COLS >= 10) & (COLS < 55)
    rim = (ROWS >= 30) & (ROWS < 40) & (COLS == 10)
    bay = (ROWS < 22) & (COLS >= 14) & (COLS < 20)
    height = house()
    height[30:40, 52:] = 6.0
    for is_whole in (True, False):
        found = modelled(height, ~survey | bay, Air(rim), is_whole)
        known = found.raster.known
        assert known[rim].all() != is_whole and known[rim].any() != is_whole
        assert known[18, 15:19].any() != is_whole and known[31:39, 53].any() != is_whole
        assert not known[~survey & ~bay].any()
