"""Parts of the view by themselves: the filled ground below the surfaces, the words of shares."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from web_module import NEEDS_NODE, web_module

RESULT = """(() => {
  const field = page.filled((use) => given.forEach(([x, y]) => use(x, y, 0, 90, 90, 90)));
  return { ...field, z: [], rgb: [], alpha: [...field.alpha] };
})()"""

pytestmark = [*NEEDS_NODE, pytest.mark.slow]


def test_the_ground_ends_where_the_map_does_also_at_its_outermost_corners(tmp_path: Path) -> None:
    """The corners of a map that lies aslant touch the box around it."""
    along, across = np.meshgrid(np.arange(0.0, 100.0, 0.5), np.arange(0.0, 60.0, 0.5))
    turn = np.radians(30.0)
    x = np.cos(turn) * along - np.sin(turn) * across
    y = np.sin(turn) * along + np.cos(turn) * across
    places = np.column_stack([x.ravel(), y.ravel()])
    field = web_module(tmp_path, "fill", RESULT)(places.tolist())
    alpha = np.array(field["alpha"]).reshape(field["rows"], field["cols"])
    row, col = np.nonzero(alpha)
    east = field["west"] + (col + 0.5) * field["cell"]
    north = field["south"] + (row + 0.5) * field["cell"]
    u = np.cos(turn) * east + np.sin(turn) * north
    v = np.cos(turn) * north - np.sin(turn) * east
    beyond = np.hypot(
        np.maximum(np.maximum(-u, u - 100.0), 0), np.maximum(np.maximum(-v, v - 60.0), 0)
    )
    assert beyond.max() < 8 * field["cell"]  # which fades
    whole = alpha[row, col] == 1.0
    assert beyond[whole].max() < 3 * field["cell"] and whole.sum() * field["cell"] ** 2 > 5900.0


def test_a_share_that_is_tiny_is_not_said_to_be_none(tmp_path: Path) -> None:
    said = web_module(tmp_path, "units", "given.map((value) => page.share(value))")
    assert said([0.25, 0.034, 0.0012, 0.0004]) == ["25 %", "3.4 %", "0.1 %", "0.04 %"]
