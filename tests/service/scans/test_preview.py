"""The preview: where things are drawn, and that it survives thin and empty scans."""

from __future__ import annotations

import numpy as np
import pytest

from recon.surface.raster import Grid, Raster
from recon.types import F64, U8
from service.scans.drawing import (
    BACKGROUND,
    MARGIN,
    TRACK,
    blank_preview,
    draw_maps,
    draw_thumbnail,
    side_by_side,
)


def raster(rows: int, cols: int, cell_m: float = 1.0) -> Raster:
    """Sloping green ground with a red cell block in its north-west."""
    height = np.tile(np.linspace(0, 5, cols, dtype=np.float32), (rows, 1))
    rgb = np.full((rows, cols, 3), (0, 160, 0), np.uint8)
    rgb[: rows // 4, : cols // 4] = (220, 0, 0)
    sigma = np.full((rows, cols), 0.1, np.float32)
    return Raster(Grid(100.0, 200.0, cell_m, (rows, cols)), height, sigma, rgb)


def preview(one: Raster, track_m: F64, lines: list[str], largest_px: int) -> U8:
    return side_by_side(draw_maps(one, track_m, largest_px), lines)


def test_colour_stands_in_its_corner_and_the_track_on_its_way() -> None:
    track = np.array([[100.0, 190.0, 50.0], [140.0, 190.0, 50.0]])
    image = preview(raster(40, 40), track, ["a line"], largest_px=400)
    scale = 8  # at most eight pixels a cell
    panel = image[MARGIN : MARGIN + 40 * scale, MARGIN : MARGIN + 40 * scale].astype(int)
    assert panel[15, 15, 2] > 150 > panel[15, 15, 1]  # red in the north-west
    assert panel[200, 200, 1] > 120 > panel[200, 200, 2]
    row = 10 * scale  # 190 m north is ten cells below the top
    column = panel[row - 3 : row + 4, 160]
    assert np.abs(column - np.array(TRACK)).sum(axis=1).min() < 60


@pytest.mark.parametrize("shape", [(1, 1), (2, 300), (300, 2), (40, 41)])
def test_any_shape_is_drawn(shape: tuple[int, int]) -> None:
    image = preview(raster(*shape), np.zeros((0, 3)), ["x" * 50], largest_px=300)
    assert image.dtype == np.uint8
    assert image.ndim == 3


def test_a_raster_smaller_than_a_pixel_of_the_thumbnail_is_drawn() -> None:
    image = draw_thumbnail(raster(40, 40, 0.1), (-2396.0, -2302.0, 2604.0, 2698.0))
    assert image.shape == (480, 480, 4)
    assert np.count_nonzero(image[..., 3]) <= 4


def test_a_thumbnail_shows_the_raster_in_its_place() -> None:
    image = draw_thumbnail(raster(41, 40), (60.0, 119.0, 180.0, 239.0))
    rows, cols = np.nonzero(image[..., 3] > 127)
    assert [cols.min(), cols.max() + 1] == pytest.approx([160, 320], abs=4)
    assert [rows.min(), rows.max() + 1] == pytest.approx([156, 320], abs=4)
    assert image[170, 170, 2] > 150 > image[170, 170, 1]  # red in the north-west


def test_large_rasters_are_reduced() -> None:
    image = preview(raster(900, 1100, 0.1), np.zeros((0, 3)), [], largest_px=500)
    assert max(image.shape) < 1100


def test_labels_grow_with_the_panel() -> None:
    """The height of the dark letters of a line of text, over the image's height."""
    shares = []
    for rows in (400, 1400):
        image = preview(raster(rows, rows), np.zeros((0, 3)), ["Hill"], largest_px=rows)
        below = image[2 * MARGIN + rows - 8 :]
        dark = np.flatnonzero((below.max(axis=2) < 120).any(axis=1))
        shares.append(np.ptp(dark) / rows)
    assert shares[1] > 0.7 * shares[0]


@pytest.mark.parametrize("side", [300, 1400])
def test_long_lines_are_broken_before_the_edge(side: int) -> None:
    line = "doubtful: " + "; ".join(f"reason {n} of many" for n in range(20))
    one, many = (
        preview(raster(side, side), np.zeros((0, 3)), text, largest_px=side)
        for text in ([line[:8]], [line])
    )
    assert many.shape[0] > one.shape[0] + 20
    assert many.shape[1] == one.shape[1]
    assert (many[:, -MARGIN // 2 :] == BACKGROUND).all()


def test_unknown_ground_is_left_blank_and_far_tracks_do_no_harm() -> None:
    one = raster(40, 40)
    one.height_m[:, 20:] = np.nan
    track = np.array([[1e12, -1e12, 0.0], [0.0, 0.0, 0.0]])
    image = preview(one, track, [], largest_px=40)
    assert (image[MARGIN + 20, MARGIN + 30] == BACKGROUND).all()


def test_a_scan_without_surface_shows_its_figures() -> None:
    image = blank_preview(["nothing seen"])
    assert (image < 100).any()
