"""The scan's picture from above: colour over shaded relief, and height over shaded relief.

Both panels are north-up at the same scale, with the track, a scale bar, a north arrow and
the key figures in a line below.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from recon.surface.raster import Grid, Raster, fill_holes, hillshade, smoothed
from recon.types import F32, F64, U8, Bool

BACKGROUND = (250, 248, 246)  # BGR
INK = (40, 36, 32)
TRACK = (40, 60, 235)
FONT = cv2.FONT_HERSHEY_SIMPLEX
MARGIN = 16
LINE_PX = 24


def draw_preview(
    raster: Raster,
    track_m: F64,
    lines: Sequence[str],
    largest_px: int = 1400,
    height_of_zero_m: float = 0.0,
) -> U8:
    """(h, w, 3) BGR picture of ``raster`` with the (N, 2 or 3) track in the raster's frame.

    Each panel's longer side is at most ``largest_px``; ``lines`` are the key figures.
    ``height_of_zero_m`` is added to the heights written.
    """
    shown = fill_holes(raster)
    shade = _relief(shown)
    colour = _fit(_colour_panel(shown, shade), largest_px)
    height = _fit(_height_panel(shown, shade), largest_px)
    scale = _scale(raster.grid.shape, largest_px)
    for panel in (colour, height):
        _draw_track(panel, raster.grid, track_m, scale)
        _draw_scale_bar(panel, raster.grid.cell_m / scale)
        _draw_north(panel)
    _draw_height_legend(height, shown, height_of_zero_m)
    h, w = colour.shape[:2]
    stacked = w > 1.3 * h
    gap = np.full((MARGIN, w, 3) if stacked else (h, MARGIN, 3), BACKGROUND, np.uint8)
    both = np.concatenate([colour, gap, height], axis=0 if stacked else 1)
    return _with_lines(both, lines)


def blank_preview(lines: Sequence[str]) -> U8:
    """The picture of a scan without any surface: only its key figures."""
    return _with_lines(np.full((120, 640, 3), BACKGROUND, np.uint8), lines)


def _relief(raster: Raster) -> F32:
    """Shading of the smoothed surface, about 1 on level ground; NaN where unknown."""
    level = math.sin(math.radians(45.0))
    shade = hillshade(smoothed(raster).height_m, raster.grid.cell_m)
    return np.asarray(shade / level, np.float32)


def _colour_panel(raster: Raster, shade: F32) -> U8:
    """Colour times shading, softened so that the picture stays readable."""
    light = np.clip(0.6 + 0.4 * np.nan_to_num(shade, nan=1.0), 0.0, 1.25)
    bright = float(np.percentile(raster.rgb[raster.known], 98)) if raster.known.any() else 255.0
    gain = float(np.clip(230.0 / max(bright, 1.0), 1.0, 2.0))
    bgr = gain * raster.rgb[..., ::-1] * light[..., None]
    return _on_background(np.clip(bgr, 0, 255).astype(np.float32), raster.known)


def _height_panel(raster: Raster, shade: F32) -> U8:
    """Height as hue times shading."""
    low, high = _height_range(raster)
    unit = (np.nan_to_num(raster.height_m, nan=low) - low) / (high - low)
    tone = np.clip(np.rint(255 * unit), 0, 255).astype(np.uint8)
    bgr = cv2.applyColorMap(tone, cv2.COLORMAP_VIRIDIS).astype(np.float32)
    light = np.clip(np.nan_to_num(shade, nan=1.0), 0.15, 1.3)
    return _on_background(
        np.clip((0.25 * 255 + 0.75 * bgr) * light[..., None], 0, 255), raster.known
    )


def _height_range(raster: Raster) -> tuple[float, float]:
    """Heights of the ends of the colour scale: 2nd and 98th percentile, at least 1 m apart."""
    known = raster.height_m[raster.known]
    low, high = (float(p) for p in np.percentile(known, [2, 98]))
    middle = 0.5 * (low + high)
    half = max(0.5 * (high - low), 0.5)
    return middle - half, middle + half


def _on_background(bgr: F64 | F32, known: Bool) -> U8:
    return np.asarray(np.where(known[..., None], bgr, np.array(BACKGROUND)), np.uint8)


def _fit(panel: U8, largest_px: int) -> U8:
    """The panel at a size good to look at: enlarged in whole steps, or reduced by area."""
    h, w = panel.shape[:2]
    scale = _scale((h, w), largest_px)
    if scale >= 1.0:
        return _at_least(panel.repeat(int(scale), axis=0).repeat(int(scale), axis=1))
    size = (max(1, round(w * scale)), max(1, round(h * scale)))
    return _at_least(np.asarray(cv2.resize(panel, size, interpolation=cv2.INTER_AREA), np.uint8))


def _scale(shape: tuple[int, int], largest_px: int) -> float:
    """Picture pixels per cell: a whole number up to 8, or less than one."""
    scale = largest_px / max(shape)
    return float(min(int(scale), 8)) if scale >= 1.0 else scale


def _at_least(panel: U8, smallest_px: int = 160) -> U8:
    """The panel with background to its right and below, so that the labels have room."""
    h, w = panel.shape[:2]
    if min(h, w) >= smallest_px:
        return panel
    out = np.full((max(h, smallest_px), max(w, smallest_px), 3), BACKGROUND, np.uint8)
    out[:h, :w] = panel
    return out


def _draw_track(panel: U8, grid: Grid, track_m: F64, scale: float) -> None:
    """The way flown, with a ring where it began."""
    if not len(track_m):
        return
    px = (grid.pixels(track_m[:, :2]) + 0.5) * scale
    path = np.rint(np.clip(px, -1e6, 1e6) * 8).astype(np.int32)
    cv2.polylines(panel, [path[:, None]], False, TRACK, 1, cv2.LINE_AA, shift=3)
    x, y = (round(float(v)) for v in np.clip(px[0], -1e6, 1e6))
    cv2.circle(panel, (x, y), 5, TRACK, 1, cv2.LINE_AA)


def _draw_scale_bar(panel: U8, metres_per_px: float) -> None:
    """A bar of 1, 2 or 5 times a power of ten metres, about a fifth of the panel wide."""
    target = panel.shape[1] * metres_per_px / 5.0
    power = 10.0 ** math.floor(math.log10(target))
    length_m = max(m * power for m in (1.0, 2.0, 5.0) if m * power <= target)
    length_px = round(length_m / metres_per_px)
    x, y = 12, panel.shape[0] - 14
    for colour, thick in ((BACKGROUND, 5), (INK, 2)):
        cv2.line(panel, (x, y), (x + length_px, y), colour, thick, cv2.LINE_AA)
    _text(panel, f"{length_m:g} m", (x, y - 8), 0.45)


def _draw_north(panel: U8) -> None:
    x, y = panel.shape[1] - 20, 14
    for colour, thick in ((BACKGROUND, 5), (INK, 2)):
        cv2.arrowedLine(panel, (x, y + 26), (x, y), colour, thick, cv2.LINE_AA, tipLength=0.35)
    _text(panel, "N", (x - 5, y + 42), 0.45)


def _draw_height_legend(panel: U8, raster: Raster, height_of_zero_m: float) -> None:
    """The colour scale with its two heights."""
    low, high = _height_range(raster)
    length = min(120, panel.shape[0] // 3)
    tones = np.linspace(255, 0, length).astype(np.uint8)[:, None].repeat(10, axis=1)
    bar = 0.25 * 255 + 0.75 * cv2.applyColorMap(tones, cv2.COLORMAP_VIRIDIS).astype(np.float32)
    panel[12 : 12 + length, 12:22] = bar.astype(np.uint8)
    _text(panel, f"{high + height_of_zero_m:.1f} m", (28, 22), 0.4)
    _text(panel, f"{low + height_of_zero_m:.1f} m", (28, 12 + length), 0.4)


def _text(image: U8, text: str, at: tuple[int, int], size: float) -> None:
    """Dark letters on a light label, readable on any ground."""
    (w, h), below = cv2.getTextSize(text, FONT, size, 1)
    x, y = at
    cv2.rectangle(image, (x - 2, y - h - 2), (x + w + 1, y + below), BACKGROUND, cv2.FILLED)
    cv2.putText(image, text, at, FONT, size, INK, 1, cv2.LINE_AA)


def _with_lines(picture: U8, lines: Sequence[str]) -> U8:
    """The picture in a margin, wide enough for the lines of text below it."""
    widest = max((cv2.getTextSize(t, FONT, 0.5, 1)[0][0] for t in lines), default=0)
    h, w = picture.shape[:2]
    size = (h + 2 * MARGIN + LINE_PX * len(lines) + 6, max(w, widest) + 2 * MARGIN, 3)
    out = np.full(size, BACKGROUND, np.uint8)
    out[MARGIN : MARGIN + h, MARGIN : MARGIN + w] = picture
    for n, text in enumerate(lines):
        at = (MARGIN, h + 2 * MARGIN + 10 + LINE_PX * n)
        cv2.putText(out, text, at, FONT, 0.5, INK, 1, cv2.LINE_AA)
    return out
