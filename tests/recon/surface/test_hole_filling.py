"""The outline of a surface model."""

from __future__ import annotations

import numpy as np

from recon.surface.hole_filling import outlined


def test_a_hole_is_enclosed_and_a_bay_is_not() -> None:
    known = np.zeros((40, 60), np.bool_)
    known[5:35, 5:55] = True
    known[10:20, 10:20] = False  # a hole
    known[5:20, 35:45] = False  # a bay
    known[30:35, 25:27] = False  # a gap of two cells in the rim
    inside = outlined(known)
    assert inside[10:20, 10:20].all() and inside[31:34, 25:27].all()
    assert not inside[5:20, 36:44].any() and not inside[:4].any()
