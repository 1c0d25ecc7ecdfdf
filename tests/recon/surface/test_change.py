"""Change between two surfaces: objects, volumes and their sigmas against drawn truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.ndimage as ndi

from recon.surface.change import (
    SumErrors,
    change_between,
    left_over_m,
    level_filled,
    mean_surface,
    of_tile,
    outlines,
    scatter_of_means,
    sigmas_of_any,
    volumes,
)
from recon.surface.raster import Grid, Raster, fill_holes
from recon.types import F32, F64

CELL_M, SIGMA_M = 0.2, 0.06
GRID = Grid(1000.0, 2000.0, CELL_M, (250, 250))  # a quarter of a hectare


def surface(
    seed: int, boxes: list[tuple[int, int, int, int, float]], lift_m: float = 0.0
) -> Raster:
    """Gentle ground with noise that neighbours share, and boxes (row, col, rows, cols, m)."""
    rng = np.random.default_rng(seed)
    r, c = np.indices(GRID.shape)
    z = 2.0 * np.sin(r / 60.0) * np.cos(c / 45.0) + lift_m
    noise = ndi.gaussian_filter(rng.normal(size=GRID.shape), 0.7)
    z = z + SIGMA_M * noise / noise.std()
    for row, col, rows, cols, tall in boxes:
        z[row : row + rows, col : col + cols] += tall
    sigma = np.full(GRID.shape, SIGMA_M, np.float32)
    rgb = np.full((*GRID.shape, 3), 128, np.uint8)
    return Raster(GRID, z.astype(np.float32), sigma, rgb)


@pytest.mark.slow
def test_surfaces_without_change_show_none_in_nineteen_of_twenty() -> None:
    house = [(60, 60, 40, 50, 6.0)]
    shown = 0
    for seed in range(20):
        before, after = surface(seed, house), surface(100 + seed, [(61, 60, 40, 50, 6.0)], 0.02)
        shown += bool(change_between(before, after).bodies)
    assert shown <= 1


def test_unknown_ground_around_a_box_does_not_make_it_wider() -> None:
    boxes = [(20 + 40 * (k // 5), 20 + 40 * (k % 5), 10, 10, 1.5) for k in range(25)]
    after = surface(2, boxes)
    r, c = np.indices(GRID.shape)
    height = after.height_m.copy()
    for row, col, rows, cols, _ in boxes:  # two cells around it, as where it hides the ground
        inside = [(r >= row - k) & (r < row + rows + k) & (c >= col - k) & (c < col + cols + k)
                  for k in (0, 2)]  # fmt: skip
        height[inside[1] & ~inside[0]] = np.nan
    height[:, 7::23] = np.nan  # lines without a point
    holed = replace(after, height_m=height)
    true = 25 * 100 * CELL_M**2 * 1.5
    errors = []
    for surface_after in (level_filled(holed, 2), fill_holes(holed, 2)):
        found = change_between(surface(1, []), surface_after).bodies
        assert len(found) == 25
        errors.append(sum(b.volume_m3 for b in found) / true - 1.0)
    assert abs(errors[0]) < 0.02 < 0.1 < errors[1]
    filled = level_filled(holed, 2)
    assert np.isfinite(filled.height_m[2:15, 7::23]).all()  # level ground is closed


def test_gaps_between_level_cells_are_closed_up_to_the_edge_of_a_roof_and_no_further() -> None:
    whole = surface(1, [(60, 60, 40, 40, 6.0)])
    height = whole.height_m.copy()
    height[58:102, [59, 61, 80, 98]] = np.nan  # next to the roof, and through it along its edges
    height[[60, 99], 85:90] = np.nan  # the edges themselves
    filled = level_filled(replace(whole, height_m=height), 2)
    assert np.isfinite(filled.height_m[61:99, [61, 80, 98]]).all()
    assert np.abs(filled.height_m - whole.height_m)[61:99, [61, 80, 98]].max() < 6 * SIGMA_M
    assert np.isnan(filled.height_m[62:98, 59]).all() and np.isnan(filled.height_m[60, 85:90]).all()
    rows = slice(61, 99)
    assert (filled.rgb[rows, 61] == whole.rgb[rows, 60]).all()
    ends = whole.sigma_m[rows, 60] + whole.sigma_m[rows, 62]
    np.testing.assert_allclose(filled.sigma_m[rows, 61], ends)


def test_boxes_of_a_metre_and_forty_centimetres_are_found() -> None:
    boxes = [(20 + 40 * (k // 5), 20 + 40 * (k % 5), 5, 5, 0.4 + 0.02 * k) for k in range(25)]
    found = change_between(surface(1, []), surface(2, boxes))
    centres = {(int(np.mean(np.nonzero(found.labels == b.label)[0])) // 40,
                int(np.mean(np.nonzero(found.labels == b.label)[1])) // 40)
               for b in found.bodies}  # fmt: skip
    assert len(centres) >= 24 and len(found.bodies) <= 26
    assert all(b.volume_m3 > 0 for b in found.bodies)


def uneven(seed: int, boxes: list[tuple[int, int, int, int, float]]) -> Raster:
    """Ground whose errors reach over a metre, and are larger in some places than in others."""
    rng = np.random.default_rng(seed)

    def smooth(reach: float) -> F64:
        noise = ndi.gaussian_filter(rng.normal(size=GRID.shape), reach)
        return np.asarray(noise / noise.std())

    errors = 0.5 * smooth(0.7) + 0.6 * smooth(3.0) + 0.6 * smooth(6.0)
    flat = surface(seed, boxes)
    z = 0.03 * errors * np.exp(0.2 * smooth(10.0))
    for row, col, rows, cols, tall in boxes:
        z[row : row + rows, col : col + cols] += tall
    return Raster(GRID, z.astype(np.float32), flat.sigma_m, flat.rgb)


@pytest.mark.slow
def test_errors_that_neighbours_share_unevenly_are_no_change() -> None:
    shown = (change_between(uneven(s, []), uneven(500 + s, [])).bodies for s in range(30))
    assert sum(bool(bodies) for bodies in shown) <= 2


def test_boxes_of_thirty_centimetres_are_found_in_errors_that_neighbours_share() -> None:
    boxes = [(20 + 45 * (k // 5), 20 + 45 * (k % 5), 6, 6, 0.3) for k in range(25)]
    found = change_between(uneven(1, []), uneven(2, boxes))
    assert sum(bool(found.labels[r : r + 6, c : c + 6].any()) for r, c, *_ in boxes) >= 24
    assert len(found.bodies) <= 26


def test_objects_that_stereo_draws_worse_than_flat_ground_are_no_change() -> None:
    cars = [(12 + 40 * (k // 6), 12 + 40 * (k % 6), 8, 20, 1.5) for k in range(36)]
    added = [(30 + 40 * (k // 5), 34 + 40 * (k % 5), 6, 6, 0.5) for k in range(25)]
    before, after = surface(1, cars), surface(2, [*cars, *added])
    rng = np.random.default_rng(8)
    for one in (before, after):
        rough = ndi.gaussian_filter(rng.normal(size=GRID.shape), 2.0)
        for row, col, rows, cols, _ in cars:
            on = slice(row - 1, row + rows + 1), slice(col - 1, col + cols + 1)
            one.height_m[on] += (0.15 * rough / rough.std())[on].astype(np.float32)
    found = change_between(before, after)
    on_cars = sum(bool(found.labels[r : r + 8, c : c + 20].any()) for r, c, *_ in cars)
    assert on_cars <= 1
    assert sum(bool(found.labels[r : r + 6, c : c + 6].any()) for r, c, *_ in added) >= 24


@pytest.mark.parametrize("places", [1, 40, 1000])
def test_the_largest_of_many_errors_exceeds_the_level_as_often_as_told(places: int) -> None:
    rng = np.random.default_rng(places)
    largest = np.abs(rng.normal(size=(4000, places))).max(axis=1)
    share = float(np.mean(largest > sigmas_of_any(0.05, places)))
    assert share == pytest.approx(0.05, abs=0.012)


@pytest.mark.slow
def test_volumes_are_right_within_their_sigma() -> None:
    boxes = [(30, 30, 20, 25, 1.2), (120, 120, 15, 15, 0.8)]
    true = (20 * 25 * 1.2, -15 * 15 * 0.8)
    ratios = []
    for seed in range(12):
        before, after = surface(seed, boxes[1:]), surface(50 + seed, boxes[:1])
        found = change_between(before, after)
        by_sign = sorted(found.bodies, key=lambda b: -b.volume_m3)
        assert len(by_sign) == 2
        for body, cells in zip(by_sign, true, strict=True):
            volume = cells * CELL_M**2
            assert body.volume_m3 == pytest.approx(volume, rel=0.05)
            ratios.append((body.volume_m3 - volume) / body.sigma_m3)
        total = volumes(found.bodies, found.alignment_m)
        assert total.fill[0] - total.cut[0] == pytest.approx(total.net[0])
        assert total.fill[0] == pytest.approx(true[0] * CELL_M**2, rel=0.05)
        assert total.fill[1] >= 0.01 * by_sign[0].area_m2
    assert float(np.sqrt(np.mean(np.square(ratios)))) < 1.5


@pytest.mark.parametrize("reach", [0.0, 3.0, 8.0])
def test_a_sum_over_cells_errs_by_what_they_share(reach: float) -> None:
    rng = np.random.default_rng(4)
    d = ndi.gaussian_filter(rng.normal(size=(600, 600)), reach)
    d = (0.1 * d / d.std()).astype(np.float32)
    window = ndi.uniform_filter(d, 3)
    errors = SumErrors(np.full_like(d, window.std()), 3, scatter_of_means(d), 0.0)
    cells = np.zeros(d.shape, np.bool_)
    cells[100:118, 200:225] = True
    sums = (18 * 25 * ndi.uniform_filter(d, (18, 25)))[20:-20, 20:-20]
    assert errors.of_sum(cells) == pytest.approx(float(sums.std()), rel=0.15)
    shared = SumErrors(errors.sigma, 3, errors.scatter, 0.5)
    assert shared.of_sum(cells) == pytest.approx(0.5 * 18 * 25)


def test_an_alignment_that_is_off_is_no_change() -> None:
    found = change_between(surface(1, []), surface(2, [], lift_m=0.4))
    assert not found.bodies and abs(float(np.nanmedian(found.height_m))) < 0.01


def test_bending_is_taken_away_and_a_wide_pit_is_not() -> None:
    bend = np.sin(np.indices(GRID.shape)[0] / 80.0).astype(np.float32) * 0.3  # 100 m long
    after = surface(2, [(80, 80, 70, 70, -1.5)])  # 14 m wide
    after.height_m[:] += bend
    found = change_between(surface(1, []), after)
    (pit,) = found.bodies
    assert pit.volume_m3 == pytest.approx(-1.5 * (70 * CELL_M) ** 2, rel=0.03)
    assert found.alignment_m < 0.1
    assert not change_between(
        surface(3, []), Raster(GRID, surface(4, []).height_m + bend, after.sigma_m, after.rgb)
    ).bodies


def test_roofs_that_two_surveys_draw_some_cells_apart_are_no_change() -> None:
    roof = [(60, 60, 40, 50, 6.0), (150, 150, 15, 15, 3.0)]
    moved = [(58, 62, 42, 50, 6.0), (151, 148, 14, 17, 3.0)]
    assert not change_between(surface(1, roof), surface(2, moved)).bodies


def test_a_grove_is_no_change_until_it_is_felled() -> None:
    rng = np.random.default_rng(5)
    surveys = [surface(seed, []) for seed in (1, 2)]
    bare = surveys[1].height_m.copy()
    for one in surveys:
        crown = ndi.gaussian_filter(rng.normal(size=GRID.shape), 3.0)
        one.height_m[50:110, 50:110] += (8.0 + 1.5 * crown / crown.std())[50:110, 50:110]
    before, after = surveys
    assert len(change_between(before, after).bodies) <= 2
    after.height_m[:] = bare
    assert any(b.volume_m3 < -800.0 for b in change_between(before, after).bodies)


def test_what_the_rim_of_the_survey_cuts_is_no_change() -> None:
    after = surface(2, [(100, 100, 20, 20, 1.5)])
    assert len(change_between(surface(1, []), after).bodies) == 1
    after.height_m[:, :105] = np.nan
    assert not change_between(surface(1, []), after).bodies


def test_a_strip_that_a_box_hides_does_not_hide_the_change() -> None:
    after = surface(2, [(100, 100, 20, 20, 1.5)])
    after.height_m[98:122, 120:125] = np.nan
    (body,) = change_between(surface(1, []), after).bodies
    assert body.volume_m3 == pytest.approx(1.5 * 400 * CELL_M**2, rel=0.03)
    after.height_m[98:122, 120:] = np.nan
    assert not change_between(surface(1, []), after).bodies


def test_ground_that_scatters_more_than_the_rest_needs_more() -> None:
    rng = np.random.default_rng(3)
    after = surface(2, [])
    poor = ndi.gaussian_filter(rng.normal(size=GRID.shape), 3.0)
    after.height_m[:, :80] += (0.3 * poor / poor.std())[:, :80].astype(np.float32)
    assert len(change_between(surface(1, []), after).bodies) <= 2


def test_unknown_ground_is_not_compared() -> None:
    before, after = surface(1, []), surface(2, [(20, 20, 10, 10, 2.0)])
    before.height_m[:100] = np.nan
    found = change_between(before, after)
    assert not found.bodies and np.isnan(found.height_m[:100]).all()
    assert np.isfinite(found.height_m).sum() == 150 * 250


def test_left_over_needs_ground_to_tell() -> None:
    assert left_over_m(np.full((20, 20), np.nan, np.float32), 0.2, 8.0) == 0.0
    tilted: F32 = np.tile(np.linspace(-0.3, 0.3, 250, dtype=np.float32), (250, 1))
    assert 0.1 < left_over_m(tilted, 0.2, 8.0) < 0.4


def test_outlines_enclose_the_area_and_leave_holes_out() -> None:
    ring = [(50, 50, 30, 30, 1.5)]
    after = surface(2, ring)
    after.height_m[58:72, 58:72] -= 1.5
    found = change_between(surface(1, []), after)
    (body,) = found.bodies
    ((outer, *holes),) = outlines(found, body.label)
    assert len(holes) == 1 and np.array_equal(outer[0], outer[-1])

    def area(xy: F64) -> float:
        x, y = xy.T
        return float(abs(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])) / 2)

    assert area(outer) - area(holes[0]) == pytest.approx(body.area_m2, rel=0.12)
    assert outer[:, 0].min() == pytest.approx(1000.0 + 50 * CELL_M, abs=2 * CELL_M)
    assert outer[:, 1].max() == pytest.approx(2000.0 - 50 * CELL_M, abs=2 * CELL_M)


def test_a_mean_surface_keeps_the_volume_at_the_rim() -> None:
    rng = np.random.default_rng(1)
    xy = rng.uniform(0.0, 10.0, (200_000, 2))
    grid = Grid(0.0, 10.0, 0.25, (40, 40))
    on = (np.abs(xy - [5.11, 4.93]) < 0.53).all(axis=1)
    xyz = np.column_stack([xy, 100.0 + 0.8 * on])
    rgb = np.full((len(xyz), 3), 77, np.uint8)
    found = mean_surface(xyz, rgb, np.full(len(xyz), 0.05, np.float32), grid)
    volume = float(np.sum(found.height_m.astype(np.float64) - 100.0)) * 0.25**2
    assert volume == pytest.approx(1.06**2 * 0.8, rel=0.02)
    assert found.known.all() and (found.rgb == 77).all()
    assert float(found.sigma_m.max()) > 0.3 > 0.05 > float(np.median(found.sigma_m))
    outside = mean_surface(
        xyz + np.array([100.0, 0.0, 0.0]), rgb, np.ones(len(xyz), np.float32), grid
    )
    assert not outside.known.any()


def test_tiles_count_each_object_once() -> None:
    """Two tiles with a margin of 40 cells: a small object on their border, and a wide one."""
    before, after = surface(1, []), surface(2, [(60, 110, 8, 20, 1.0), (130, 40, 20, 170, 1.5)])
    whole = change_between(before, after)
    halves = []
    for first, last in ((0, 120), (120, 250)):
        cut = slice(max(first - 40, 0), last + 40)
        grid = GRID.part(slice(0, 250), slice(cut.start, min(cut.stop, 250)))
        one, two = (
            Raster(grid, r.height_m[:, cut], r.sigma_m[:, cut], r.rgb[:, cut])
            for r in (before, after)
        )
        part = change_between(one, two, ground_m2=2500.0)
        own = slice(first - cut.start, last - cut.start)
        halves.append(of_tile(part, slice(0, 250), own, 40))
    areas = sorted(round(b.area_m2, 1) for h in halves for b in h.bodies)
    assert len(whole.bodies) == 2 and len(areas) == 3  # the wide one in two parts
    small, wide = sorted(whole.bodies, key=lambda b: b.area_m2)
    assert areas[0] == pytest.approx(small.area_m2, rel=0.1)
    assert areas[1] + areas[2] == pytest.approx(wide.area_m2, rel=0.05)
    volume = sum(b.volume_m3 for h in halves for b in h.bodies)
    assert volume == pytest.approx(sum(b.volume_m3 for b in whole.bodies), rel=0.05)
