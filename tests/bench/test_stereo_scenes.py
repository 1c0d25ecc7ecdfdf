"""Rendered pairs are exact, and belief propagation beats the semi-global matcher on them."""

from __future__ import annotations

import numpy as np
import pytest
from bench_scenes import accuracy
from stereo_scenes import NOISE, rendered

from recon.backends import load_backend


def test_both_views_agree_where_the_truth_says_so() -> None:
    pair = rendered("rows")
    v, u = np.mgrid[0 : pair.left.shape[0], 0 : pair.left.shape[1]]
    place = np.where(pair.visible, u - pair.truth_px, 0)
    first = np.floor(place).astype(int)
    part = place - first
    right = pair.right.astype(float)
    there = (1 - part) * right[v, first] + part * right[v, np.minimum(first + 1, u.max())]
    inner = pair.visible & (np.abs(np.gradient(pair.truth_px, axis=1)) < 0.2)
    assert np.median(np.abs(pair.left - there)[inner]) < 2.5 * NOISE
    assert 0.8 < pair.visible.mean() < 1
    np.testing.assert_array_equal(rendered("rows").left, pair.left)
    assert (rendered("rows", 1).left != pair.left).mean() > 0.5


@pytest.mark.parametrize("name", ["pale", "rows"])
def test_fewer_wrong_pixels_than_the_semi_global_matcher(name: str) -> None:
    """In weak texture and repeated structure, also where the exposures differ."""
    results = accuracy([rendered(name)], load_backend("cpu"))
    assert [r.what for r in results] == [
        f"{name}, bad-1.0", "mean, bad-1.0",
        f"{name}, exposures differ, bad-1.0", "mean, exposures differ, bad-1.0",
    ]  # fmt: skip
    for result in results:
        assert result.peer_value is not None
        assert result.value < result.peer_value
