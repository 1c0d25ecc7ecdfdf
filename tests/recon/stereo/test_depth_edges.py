"""Depth that mixes the two sides of an edge, or lies beyond it, is dropped; surfaces stay."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from recon.stereo import depth_edges
from recon.stereo.depth_edges import drop_edges
from recon.types import F64, U8, Bool, DepthMap

K = np.array([[480.0, 0, 99.5], [0, 480.0, 79.5], [0, 0, 1]])
SHAPE = (160, 200)
SIGMA_M = 0.05
GRAY = np.full((*SHAPE, 3), 120, np.uint8)


def seen(depth_m: F64) -> DepthMap:
    noise = np.random.default_rng(5).normal(0.0, 0.4 * SIGMA_M, SHAPE)
    smooth = np.asarray(cv2.GaussianBlur(noise, (0, 0), 1.0)) * 3.0
    z = (depth_m + smooth).astype(np.float32)
    return DepthMap(
        z, np.full(SHAPE, SIGMA_M, np.float32), np.full(SHAPE, 4, np.uint8), K, np.eye(4)
    )


def box(side: int, height_m: float) -> F64:
    depth = np.full(SHAPE, 60.0)
    depth[70 : 70 + side, 90 : 90 + side] -= height_m
    return depth


def blurred(true: F64) -> DepthMap:
    """As windows of 5x5 and 7x7 blur one after the other."""
    return seen(np.asarray(cv2.blur(cv2.blur(true, (5, 5)), (7, 7)), np.float64))


def painted(roof: Bool) -> U8:
    """Roofs and ground in different colours, both with texture and noise."""
    rng = np.random.default_rng(8)
    base = np.where(roof[..., None], [70.0, 80.0, 150.0], [90.0, 130.0, 110.0])
    texture = cv2.GaussianBlur(rng.normal(0.0, 40.0, SHAPE), (0, 0), 1.2)[..., None]
    return np.clip(base + texture + rng.normal(0.0, 3.0, base.shape), 0, 255).astype(np.uint8)


def test_a_roof_that_spills_over_its_edge_ends_at_the_edge_of_its_colour() -> None:
    """Matching puts a roof 2 pixels too far out on two sides; without colour nothing says so."""
    true = np.full(SHAPE, 60.0)
    true[50:100, 60:130] = 56.0
    wide = np.full(SHAPE, 60.0)
    wide[50:102, 60:132] = 56.0
    spilt, roof = wide < true, true < 58.0
    kept = np.isfinite(drop_edges(seen(wide), painted(roof)).depth_m)
    assert kept[spilt].mean() < 0.15
    assert kept[roof].mean() > 0.99 and kept[~roof & ~spilt].mean() > 0.99
    assert np.isfinite(drop_edges(seen(wide), GRAY).depth_m).mean() > 0.99


def test_what_a_window_mixes_at_an_edge_is_dropped() -> None:
    for side, height in ((12, 1.0), (24, 2.5)):
        true = box(side, height)
        found = blurred(true)
        kept = np.isfinite(drop_edges(found, GRAY).depth_m)
        off = np.abs(found.depth_m - true)
        assert kept[off > 0.4 * height].mean() < 0.05
        assert kept[off < 0.1].mean() > 0.99
        middle = slice(70 + side // 2 - 2, 70 + side // 2 + 2)
        assert kept[middle, slice(90 + side // 2 - 2, 90 + side // 2 + 2)].all()


def test_ground_that_a_box_hides_from_aside_stays_unknown() -> None:
    """A camera looks past a box of 4 m3: what its windows mix would fill the hidden strip."""
    true = box(12, 2.0)

    def heights(depth: DepthMap) -> F64:
        """(h, w) mean height on the ground's cells, NaN where no pixel falls."""
        rows, cols = np.nonzero(np.isfinite(depth.depth_m))
        height = 60.0 - depth.depth_m[rows, cols].astype(np.float64)
        cell = rows * SHAPE[1] + np.floor(cols - 0.35 * height * 480.0 / 60.0 + 0.5).astype(int)
        count = np.bincount(cell, minlength=true.size)
        with np.errstate(invalid="ignore"):
            return (np.bincount(cell, height, true.size) / count).reshape(SHAPE)

    exact, before = heights(seen(true)), heights(blurred(true))
    after = heights(drop_edges(blurred(true), GRAY))
    hidden = np.isnan(exact[70:82, 84:102])
    cell_m2 = 0.125**2
    fill = [float(np.nansum(h[70:82, 84:102][hidden])) * cell_m2 for h in (before, after)]
    assert hidden.sum() > 40 and fill[0] > 0.3  # m3
    assert fill[1] < 0.3 * fill[0]


def test_slopes_roofs_and_noise_are_surfaces() -> None:
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float64)
    slanted = 60.0 / (1.0 + 0.004 * (cols - 100) + 0.002 * (rows - 80))
    roof = 60.0 - 4.0 + 0.08 * np.abs(cols - 100)
    for surface in (np.full(SHAPE, 60.0), slanted, roof):
        kept = np.isfinite(drop_edges(seen(surface), painted(surface < 58.0)).depth_m)
        assert kept.mean() > 0.99


def test_what_is_dropped_has_no_sigma_and_no_views() -> None:
    depth = blurred(box(24, 2.5))
    depth.depth_m[:40] = depth.sigma_m[:40] = np.nan
    found = drop_edges(depth, GRAY)
    known = np.isfinite(found.depth_m)
    assert not known[:40].any() and known[40:].any() and not known[40:].all()
    np.testing.assert_array_equal(known, np.isfinite(found.sigma_m))
    np.testing.assert_array_equal(known[40:], found.views[40:] > 0)
    nothing = DepthMap(np.full(SHAPE, np.nan, np.float32), depth.sigma_m, depth.views, K, np.eye(4))
    assert drop_edges(nothing, GRAY) is nothing


@pytest.mark.parametrize("radius", [depth_edges.FLAT_RADIUS, depth_edges.PLANE_RADIUS])
def test_a_row_at_once_finds_the_windows_of_its_pixels(radius: int) -> None:
    """At the rims too, where windows lie outside."""
    rng = np.random.default_rng(3)
    x = rng.normal(0.0, 0.1, (9, 14)).astype(np.float32)
    x[:, 6:] += 1.0
    windows = depth_edges.window_fits(x, radius, radius == depth_edges.PLANE_RADIUS)
    shifts = [radius * k for k in (-1, 0, 1)]
    for v in range(9):
        least, expected, place = np.empty((3, 14), np.float32)
        depth_edges.steadiest_windows(windows, radius, v, least, expected, place)
        for u in range(14):
            around = [(v - dv, u - du) for dv in shifts for du in shifts]
            inside = [(i, j) for i, j in around if 0 <= i < 9 and 0 <= j < 14]
            i, j = min(inside, key=lambda at: windows[3][at])
            mean, across, down, variance = (one[i, j] for one in windows)
            value = mean + across * (u - j) + down * (v - i)
            plane = depth_edges.plane_at(windows, radius, place[u], u, v)
            assert least[u] == variance
            assert np.allclose([expected[u], *plane], [value, value, across, down], atol=1e-6)
