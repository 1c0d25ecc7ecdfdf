"""Images of a scan: from above, and every stage of one keyframe (the paper's Figure 2).

The view from above has two panels, colour and height over shaded relief, both north-up at the same
scale, with the track, a scale bar, a north arrow and the key figures in a line below.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from recon.surface.raster import Grid, Raster, fill_holes, hillshade, smoothed
from recon.types import F32, F64, U8, Array, Keyframe
from service.errors import InputError
from service.scans.fused_cloud import Box
from service.stream.store import ScanStore

BACKGROUND = (250, 248, 246)  # BGR
INK = (40, 36, 32)
TRACK = (40, 60, 235)
FONT = cv2.FONT_HERSHEY_SIMPLEX
MARGIN = 16
LINE_PX = 24
MIN_LINE_PX = 640  # width of the text below an image that is narrower

SIGN_PX = 500
"""Panels this large have labels of their usual size; on larger ones labels grow, as pages show a
panel about this large."""
PAINTED_ROWS, COUNTED = 128, 1 << 18


class Maps(NamedTuple):
    """A surface seen from above, with the track, scale and north."""

    colour: U8  # (h, w, 3) BGR
    height: U8  # (h, w, 3) BGR
    cell_m: float  # of the surface


SCREEN = 16 / 9
"""Width over height; of panels wider than that, the image is nearer to it with one above the
other."""


def side_by_side(maps: Maps, lines: Sequence[str]) -> U8:
    """(h, w, 3) BGR image of both panels, above each other where they are wide, over the key
    figures ``lines``."""
    colour, height, _ = maps
    h, w = colour.shape[:2]
    stacked = w > SCREEN * h
    gap = np.full((MARGIN, w, 3) if stacked else (h, MARGIN, 3), BACKGROUND, np.uint8)
    both = np.concatenate([colour, gap, height], axis=0 if stacked else 1)
    return _with_lines(both, lines, _growth(colour))


def draw_maps(
    raster: Raster,
    track_m: F64,
    largest_px: int = 1400,
    height_of_zero_m: float = 0.0,
    is_shaded: bool = True,
) -> Maps:
    """``raster`` in colour, shaded by the relief or not, and in height, with the (N, 2 or 3) track
    in the raster's frame.

    The longer side is at most ``largest_px``; ``height_of_zero_m`` is added to heights in labels.
    """
    shown = fill_holes(raster)
    ends = _height_range(shown)
    shade = _relief(shown)
    shown = replace(shown, sigma_m=raster.sigma_m)  # that of the filled is no longer needed
    lit = shade if is_shaded else np.ones_like(shade)
    colour = _fit(_painted(shown, _colours(shown, lit)), largest_px)
    height = _fit(_painted(shown, _heights(shown, ends, shade)), largest_px)
    scale = _scale(raster.grid.shape, largest_px)
    for panel in (colour, height):
        _draw_track(panel, raster.grid, track_m, scale)
        _draw_scale_and_north(panel, raster.grid.cell_m / scale)
    _draw_height_legend(height, [end + height_of_zero_m for end in ends])
    return Maps(colour, height, raster.grid.cell_m)


def draw_thumbnail(raster: Raster, bounds: Box, largest_px: int = 480) -> U8:
    """(h, w, 4) BGRA of the colours within ``bounds`` (west, south, east, north in the raster's
    frame), clear where nothing is known."""
    west, south, east, north = bounds
    grid = raster.grid
    scale = largest_px / max(east - west, north - south)  # pixels a metre
    cell_px = min(grid.cell_m * scale, 1.0)
    rows, cols = (max(round(cells * cell_px), 1) for cells in grid.shape)
    small = [  # the mean of known cells: unknown ones are black
        cv2.resize(image, (cols, rows), interpolation=cv2.INTER_AREA)
        for image in (np.where(raster.known[..., None], raster.rgb[..., ::-1], np.uint8(0)),
                      np.where(raster.known, np.uint8(255), np.uint8(0)))
    ]  # fmt: skip
    up = grid.cell_m * scale * np.divide(grid.shape, (rows, cols))
    A = np.array(
        [[up[1], 0.0, (grid.west_m - west) * scale], [0.0, up[0], (north - grid.north_m) * scale]]
    )
    size = max(round((east - west) * scale), 1), max(round((north - south) * scale), 1)
    colour, known = (cv2.warpAffine(image, A, size).astype(np.float32) for image in small)
    colour *= _gain(raster) * 255.0 / np.maximum(known, 1.0)[..., None]
    out = np.dstack([np.clip(colour, 0.0, 255.0), known])
    return np.asarray(out, np.uint8)


def blank_preview(lines: Sequence[str]) -> U8:
    """The image of a scan without any surface: only its key figures."""
    return _with_lines(np.full((120, MIN_LINE_PX, 3), BACKGROUND, np.uint8), lines)


def _relief(raster: Raster) -> F32:
    """Shading of the smoothed surface, about 1 on level ground; NaN where unknown."""
    shade = hillshade(smoothed(raster).height_m, raster.grid.cell_m)
    shade /= math.sin(math.radians(45.0))
    return shade


def _colours(raster: Raster, shade: F32) -> Callable[[slice], F32]:
    """Paints rows in colour times shading, softened so that the image stays readable."""
    gain = _gain(raster)

    def paint(rows: slice) -> F32:
        lit = np.nan_to_num(shade[rows], nan=1.0)
        light = np.clip(0.6 + 0.4 * lit, 0.0, 1.25, dtype=np.float32)
        bgr = raster.rgb[rows, :, ::-1].astype(np.float32)
        bgr *= (np.float32(gain) * light)[..., None]
        return np.asarray(bgr)

    return paint


def _gain(raster: Raster) -> float:
    return exposure(values(raster.rgb[raster.known]))


def values(rgb: U8) -> Array:
    """(256,) how often each value occurs in colours, some at a time: counting takes eight times
    their memory."""
    parts = np.array_split(rgb.ravel(), 1 + rgb.size // COUNTED)
    return np.asarray(np.sum([np.bincount(part, minlength=256) for part in parts], axis=0))


def exposure(counts: Array) -> float:
    """What makes the colours of a dark scan, with so many of each value, readable."""
    bright = int(np.searchsorted(np.cumsum(counts), 0.98 * counts.sum())) if counts.any() else 255
    return float(np.clip(230.0 / max(bright, 1), 1.0, 2.0))


def _heights(raster: Raster, ends: Sequence[float], shade: F32) -> Callable[[slice], F32]:
    """Paints rows in height as hue times shading; ``ends`` are those of the colour scale."""
    low, high = ends

    def paint(rows: slice) -> F32:
        unit = (np.nan_to_num(raster.height_m[rows], nan=low) - low) / (high - low)
        tone = np.clip(np.rint(255 * unit), 0, 255).astype(np.uint8)
        bgr = cv2.applyColorMap(tone, cv2.COLORMAP_VIRIDIS).astype(np.float32)
        bgr *= 0.75
        bgr += 0.25 * 255
        bgr *= np.clip(np.nan_to_num(shade[rows], nan=1.0), 0.15, 1.3)[..., None]
        return np.asarray(bgr, np.float32)

    return paint


def _height_range(raster: Raster) -> tuple[float, float]:
    """Heights of the ends of the colour scale: 2nd and 98th percentile, at least 1 m apart."""
    known = raster.height_m[raster.known]
    low, high = (float(p) for p in np.percentile(known, [2, 98]))
    middle = 0.5 * (low + high)
    half = max(0.5 * (high - low), 0.5)
    return middle - half, middle + half


def _painted(raster: Raster, paint: Callable[[slice], F32]) -> U8:
    """(rows, cols, 3) BGR on the background, some rows at a time: a whole panel of floats takes
    more memory than all else."""
    out = np.empty(raster.rgb.shape, np.uint8)
    for top in range(0, len(out), PAINTED_ROWS):
        rows = slice(top, top + PAINTED_ROWS)
        bgr = paint(rows)
        out[rows] = np.clip(bgr, 0, 255, out=bgr)
        out[rows][~raster.known[rows]] = BACKGROUND
    return out


def _fit(panel: U8, largest_px: int) -> U8:
    """The panel at display size: enlarged in whole steps, or reduced by area."""
    h, w = panel.shape[:2]
    scale = _scale((h, w), largest_px)
    if scale >= 1.0:
        return _padded_to(panel.repeat(int(scale), axis=0).repeat(int(scale), axis=1))
    size = (max(1, round(w * scale)), max(1, round(h * scale)))
    return _padded_to(np.asarray(cv2.resize(panel, size, interpolation=cv2.INTER_AREA), np.uint8))


def _scale(shape: tuple[int, int], largest_px: int) -> float:
    """Image pixels per cell: a whole number up to 8, or less than one."""
    scale = largest_px / max(shape)
    return float(min(int(scale), 8)) if scale >= 1.0 else scale


def _padded_to(panel: U8, smallest_px: int = 160) -> U8:
    """The panel with background added to its right and bottom, to make room for labels."""
    below, right = (max(smallest_px - n, 0) for n in panel.shape[:2])
    edges = 0, below, 0, right
    padded = cv2.copyMakeBorder(panel, *edges, cv2.BORDER_CONSTANT, value=BACKGROUND)
    return np.asarray(padded, np.uint8)


def _growth(panel: U8) -> float:
    """Size of a panel's labels over their usual one."""
    return max(1.0, float(max(panel.shape[:2])) / SIGN_PX)


def _draw_track(panel: U8, grid: Grid, track_m: F64, scale: float) -> None:
    """The flight path, with a ring at its start."""
    if not len(track_m):
        return
    px = (grid.pixels(track_m[:, :2]) + 0.5) * scale
    path = np.rint(np.clip(px, -1e6, 1e6) * 8).astype(np.int32)
    thick = round(_growth(panel))
    cv2.polylines(panel, [path[:, None]], False, TRACK, thick, cv2.LINE_AA, shift=3)
    x, y = (round(float(v)) for v in np.clip(px[0], -1e6, 1e6))
    cv2.circle(panel, (x, y), 5 * thick, TRACK, thick, cv2.LINE_AA)


def round_length(most: float) -> float:
    """The largest of 1, 2 or 5 times a power of ten up to ``most`` (positive)."""
    power = 10.0 ** math.floor(math.log10(most))
    return max(m * power for m in (1.0, 2.0, 5.0) if m * power <= most * (1.0 + 1e-12))


def _draw_scale_and_north(panel: U8, metres_per_px: float) -> None:
    length_m = round_length(panel.shape[1] * metres_per_px / 5.0)
    length_px = round(length_m / metres_per_px)
    grown = _growth(panel)
    left, above, right, top, foot, word = (round(v * grown) for v in (12, 14, 20, 14, 40, 56))
    y, x = panel.shape[0] - above, panel.shape[1] - right
    for colour, size in ((BACKGROUND, 5), (INK, 2)):
        thick = round(size * grown)
        cv2.line(panel, (left, y), (left + length_px, y), colour, thick, cv2.LINE_AA)
        cv2.arrowedLine(panel, (x, foot), (x, top), colour, thick, cv2.LINE_AA, tipLength=0.35)
    _text(panel, f"{length_m:g} m", (left, y - round(8 * grown)), 0.45 * grown)
    _text(panel, "N", (x - round(5 * grown), word), 0.45 * grown)


def _draw_height_legend(panel: U8, ends_m: Sequence[float]) -> None:
    low, high = ends_m
    grown = _growth(panel)
    edge, wide, words = (round(v * grown) for v in (12, 10, 28))
    length = min(round(120 * grown), panel.shape[0] // 3)
    tones = np.linspace(255, 0, length).astype(np.uint8)[:, None].repeat(wide, axis=1)
    bar = 0.25 * 255 + 0.75 * cv2.applyColorMap(tones, cv2.COLORMAP_VIRIDIS).astype(np.float32)
    panel[edge : edge + length, edge : edge + wide] = bar.astype(np.uint8)
    top = edge + wide
    _text(panel, f"{high:.1f} m", (words, top), 0.4 * grown)
    _text(panel, f"{low:.1f} m", (words, edge + length), 0.4 * grown)


def _text(image: U8, text: str, at: tuple[int, int], size: float) -> None:
    """Dark text on a light label, readable on any ground."""
    thick = max(1, round(2 * size))
    (w, h), below = cv2.getTextSize(text, FONT, size, thick)
    x, y = at
    cv2.rectangle(image, (x - 2, y - h - 2), (x + w + 1, y + below), BACKGROUND, cv2.FILLED)
    cv2.putText(image, text, at, FONT, size, INK, thick, cv2.LINE_AA)


def _with_lines(image: U8, lines: Sequence[str], growth: float = 1.0) -> U8:
    """The image in a margin, with the lines of text below it, broken where they are too long."""
    h, w = image.shape[:2]
    width = max(w, MIN_LINE_PX)
    broken = [part for text in lines for part in _broken(text, width, growth)]
    line_px, thick = round(LINE_PX * growth), round(growth)
    size = (h + 2 * MARGIN + line_px * len(broken) + 6, width + 2 * MARGIN, 3)
    out = np.full(size, BACKGROUND, np.uint8)
    out[MARGIN : MARGIN + h, MARGIN : MARGIN + w] = image
    for n, text in enumerate(broken):
        at = (MARGIN, h + 2 * MARGIN + round(10 * growth) + line_px * n)
        cv2.putText(out, text, at, FONT, 0.5 * growth, INK, thick, cv2.LINE_AA)
    return out


def _broken(text: str, width_px: int, growth: float) -> list[str]:
    """The text in lines of at most ``width_px``, if its words allow."""
    out = [""]
    for word in text.split():
        longer = f"{out[-1]} {word}".lstrip()
        wide = cv2.getTextSize(longer, FONT, 0.5 * growth, round(growth))[0][0]
        if wide > width_px and out[-1]:
            out.append(word)
        else:
            out[-1] = longer
    return out


PANEL_PX = 480
COLUMNS = 3
TITLE_PX = 26
GAP_PX = 10
STAGES: dict[str, tuple[int, str, tuple[str, int] | None]] = {
    "raw_left": (3, "raw, left", None),
    "raw_right": (3, "raw, right", None),
    "rect_left": (2, "rectified, left", None),
    "rect_right": (2, "rectified, right", None),
    "disparity": (2, "belief propagation, label", ("px", cv2.COLORMAP_TURBO)),
    "upsampled": (2, "upsampled, label", ("px", cv2.COLORMAP_TURBO)),
    "depth_m": (2, "depth", ("m", cv2.COLORMAP_TURBO)),
    "sigma_m": (2, "sigma", ("m", cv2.COLORMAP_MAGMA)),
    "bgr": (3, "colour of the points", None),
}
"""Contents of ``debug/keyframe_NNNNNN.npz`` in the order of the paper's figure: dimensions of each
array, title, and the unit and colours of what is no image."""


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    title: str
    image: U8  # (h, w, 3) BGR
    ends: tuple[str, ...] = ()  # of the colour scale


def debug_path(folder: Path, seq: int) -> Path:
    return folder / "debug" / f"keyframe_{seq:06d}.npz"


def save_debug(folder: Path, seq: int, arrays: Mapping[str, Array]) -> Path:
    """Save the stages of a keyframe for ``skyrelief inspect``, which reads those of STAGES."""
    path = debug_path(folder, seq)
    path.parent.mkdir(parents=True, exist_ok=True)
    kept: dict[str, Any] = {name: arrays[name] for name in STAGES if name in arrays}
    np.savez_compressed(path, **kept)
    return path


def load_debug(path: Path) -> dict[str, Array] | None:
    """The arrays of STAGES in ``path``; None when there is no such file. Raises InputError when the
    file was not written by ``save_debug``."""
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays: dict[str, Array] = {k: file[k] for k in STAGES if k in file.files}
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise InputError(
            f"{path} cannot be read ({error}); replay with keep_debug again"
        ) from error
    for name, array in arrays.items():
        gray = name.startswith("raw") and array.ndim == 2  # a drone without colour
        if (
            (array.ndim != STAGES[name][0] and not gray)
            or array.dtype.kind not in "fu"
            or not array.size
        ):
            raise InputError(f"{path}: {name} is {array.dtype}{array.shape}, not an image")
    return arrays


def middle_keyframe(folder: Path, store: ScanStore, seqs: Sequence[int]) -> int | None:
    """Number of the keyframe with the most points of the ten in the middle, preferably of those
    with every stage saved: of ground that is known already hardly anything is stored."""
    kept = [seq for seq in seqs if debug_path(folder, seq).is_file()]
    some = kept or list(seqs)
    middle = max(0, len(some) // 2 - 5)
    return max(some[middle : middle + 10], key=lambda seq: _points(store, seq), default=None)


def _points(store: ScanStore, seq: int) -> int:
    keyframe = store.keyframe(seq)
    return 0 if keyframe is None else int(np.isfinite(keyframe.depth.depth_m).sum())


def stages(folder: Path, scan_id: str, keyframe: Keyframe) -> tuple[U8, bool]:
    """One image of a keyframe's stages (the paper's Figure 2), and whether all were saved."""
    arrays = load_debug(debug_path(folder, keyframe.seq))
    panels = keyframe_panels(keyframe) if arrays is None else debug_panels(arrays)
    return sheet(panels, f"{scan_id}: keyframe {keyframe.seq}"), arrays is not None


def debug_panels(arrays: dict[str, Array]) -> list[Panel]:
    """The stages and the anaglyph; stages that were not saved are left out."""
    out = []
    for name, (_, title, scale) in STAGES.items():
        if name not in arrays:
            continue
        image = arrays[name]
        out.append(Panel(title, _bgr(image)) if scale is None else coloured(title, image, *scale))
        if name == "rect_right" and "rect_left" in arrays:
            out.append(Panel("anaglyph", anaglyph(arrays["rect_left"], image)))
    return out


def keyframe_panels(keyframe: Keyframe) -> list[Panel]:
    """Images of a keyframe in the store: colour, depth, sigma and views."""
    depth = keyframe.depth
    views = np.where(np.isfinite(depth.depth_m), depth.views.astype(np.float32), np.nan)
    return [
        Panel("colour of the points", keyframe.bgr),
        coloured("depth", depth.depth_m, "m"),
        coloured("sigma", depth.sigma_m, "m", cv2.COLORMAP_MAGMA),
        coloured("stereo pairs that agree", views, ""),
    ]


def anaglyph(left: Array, right: Array) -> U8:
    """(h, w, 3) BGR: the left view in red, the right in green and blue (cyan)."""
    right = right[: left.shape[0], : left.shape[1]]
    return np.dstack([right, right, left]).astype(np.uint8)


def coloured(title: str, values: Array, unit: str, colours: int = cv2.COLORMAP_TURBO) -> Panel:
    """Values in colour between their 1st and 99th percentile; unknown pixels stay light."""
    known = np.isfinite(values)
    if not known.any():
        blank = np.full((*values.shape, 3), BACKGROUND, np.uint8)
        return Panel(f"{title}: no data", blank)
    low, high = (float(p) for p in np.percentile(values[known], [1, 99]))
    span = max(high - low, 1e-9)
    tone = np.clip((np.where(known, values, low) - low) / span * 255, 0, 255).astype(np.uint8)
    image = cv2.applyColorMap(tone, colours)
    image[~known] = BACKGROUND
    share = 100.0 * float(known.mean())
    digits = 2 if unit else 0  # counts are whole
    ends = f"{low:.{digits}f}", f"{high:.{digits}f} {unit}".rstrip()
    text = f"{title} {' to '.join(ends)}, {share:.0f} % known"
    return Panel(text, np.asarray(image, np.uint8), ends)


def sheet(panels: Sequence[Panel], heading: str) -> U8:
    """(h, w, 3) BGR: the panels in rows, each with its title above it."""
    fitted = [_fitted(panel) for panel in panels]
    rows = [fitted[n : n + COLUMNS] for n in range(0, len(fitted), COLUMNS)]
    width = COLUMNS * PANEL_PX + (COLUMNS + 1) * GAP_PX
    heights = [max(f.shape[0] for f in row) + GAP_PX for row in rows]
    out = np.full((TITLE_PX + 2 * GAP_PX + sum(heights), width, 3), BACKGROUND, np.uint8)
    cv2.putText(out, heading, (GAP_PX, 24), FONT, 0.6, INK, 1, cv2.LINE_AA)
    y = TITLE_PX + 2 * GAP_PX
    for row, height in zip(rows, heights, strict=True):
        for n, one in enumerate(row):
            x = GAP_PX + n * (PANEL_PX + GAP_PX)
            out[y : y + one.shape[0], x : x + PANEL_PX] = one
        y += height
    return out


def _fitted(panel: Panel) -> U8:
    """The panel at PANEL_PX wide, its title above it."""
    h, w = panel.image.shape[:2]
    size = (PANEL_PX, max(1, round(h * PANEL_PX / w)))
    how = cv2.INTER_AREA if w > PANEL_PX else cv2.INTER_NEAREST
    image = cv2.resize(panel.image, size, interpolation=how)
    out = np.full((size[1] + TITLE_PX, PANEL_PX, 3), BACKGROUND, np.uint8)
    cv2.putText(out, panel.title, (2, 18), FONT, 0.48, INK, 1, cv2.LINE_AA)
    out[TITLE_PX:] = image
    return out


def _bgr(image: Array) -> U8:
    image = np.asarray(image, np.uint8)
    return image if image.ndim == 3 else np.dstack([image] * 3)
