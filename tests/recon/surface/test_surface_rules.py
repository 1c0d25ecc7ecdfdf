"""What a surface model holds below air that was not seen, in scenes of a few cells.

Cells have 0.25 m. The air is stated, not computed: what lies above a cell is free, not seen, or
hidden by a surface from all that look there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

from recon.surface.raster import Grid, Raster
from recon.types import F32, F64, U8, Bool
from service.offline.exports import surface

CELL_M = 0.25
SIZE = 60
ROWS, COLS = np.mgrid[0:SIZE, 0:SIZE]
SIGMA_M = np.full((SIZE, SIZE), 0.05, np.float32)
NOWHERE = np.zeros((SIZE, SIZE), np.bool_)


def is_within(cells: int) -> Bool:
    """Cells of the crown, or of a wider one."""
    return np.asarray(np.maximum(np.abs(ROWS - 30), np.abs(COLS - 30)) <= 10 + cells)


BELOW_CROWN = is_within(3) & ~is_within(0)
CROWN = np.where(is_within(0), 6.0, 0.0).astype(np.float32)
"""Level ground with a crown 6 m high, whose edge only hides the ground."""


@dataclass
class Air:
    """Air above the cells: ``unseen``, or ``hidden`` between two heights (m)."""

    unseen: Bool = field(default_factory=NOWHERE.copy)
    hidden: Bool = field(default_factory=NOWHERE.copy)
    hidden_m: tuple[float, float] = (0.0, 0.0)

    def above(self, places: F64, up_m: Sequence[float]) -> tuple[Bool, U8]:
        """As a scan's: no surface is seen through, and the rest of the air is free."""
        cols, rows = (places[:, :2] * [1.0, -1.0] / CELL_M).astype(int).T
        up = places[:, 2:] + np.array(up_m)
        low, high = self.hidden_m
        behind = self.hidden[rows, cols][:, None] & (up >= low) & (up <= high)
        is_free = ~self.unseen[rows, cols][:, None] & ~behind & (up > 0.0)
        return is_free, behind.astype(np.uint8)


def scan_of(height: F32, air: Air) -> Any:
    grid = Grid(0.0, 0.0, CELL_M, (SIZE, SIZE))
    measured = Raster(grid, height, SIGMA_M, np.full((SIZE, SIZE, 3), 90, np.uint8))
    return SimpleNamespace(
        raster=lambda cell_m: measured,
        frame=None,
        off_nadir_deg=np.zeros(3),
        shared=lambda key, make: make(),
        air_above=air.above,
    )


def test_a_ledge_below_air_that_was_not_seen_is_not_certain() -> None:
    ledge = (ROWS >= 24) & (ROWS < 36) & (COLS >= 5) & (COLS < 7)
    height = CROWN + np.where(ledge, np.float32(0.6), np.float32(0.0))
    assert not surface.surface_model(scan_of(height, Air(ledge)), CELL_M).known[ledge].any()
    assert surface.surface_model(scan_of(height, Air()), CELL_M).known[ledge].all()


def test_ground_seen_below_a_crown_is_as_high_as_the_crown() -> None:
    air = Air(unseen=BELOW_CROWN, hidden=BELOW_CROWN, hidden_m=(3.0, 6.0))
    found, origin = surface.complete_model(scan_of(CROWN, air), CELL_M)
    beside = BELOW_CROWN & (np.abs(ROWS - 30) <= 10)  # a median rounds the corners
    assert (np.abs(found.height_m[beside] - 6.0) < 0.3).all()
    assert (origin[BELOW_CROWN] == surface.FILLED).all()
    assert (np.abs(found.height_m[~is_within(4)]) < 0.1).all()


def test_ground_below_air_that_nothing_hides_stays_ground() -> None:
    unseen = Air(unseen=BELOW_CROWN)
    under_an_eave = Air(BELOW_CROWN, BELOW_CROWN, (0.5, 3.0))
    for air in (unseen, under_an_eave, Air()):
        found, _ = surface.complete_model(scan_of(CROWN, air), CELL_M)
        far_half = is_within(3) & ~is_within(1)
        assert (np.abs(found.height_m[far_half]) < 0.3).all()
