"""Every stage of one keyframe as one picture: the paper's Figure 2."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from recon.types import U8, Array, Keyframe
from service.errors import InputError
from service.scans.preview import BACKGROUND, INK

PANEL_PX = 480
TITLE_PX = 26
GAP_PX = 10
FONT = cv2.FONT_HERSHEY_SIMPLEX
DEBUG_KEYS = {
    "raw_left": 3,
    "raw_right": 3,
    "rect_left": 2,
    "rect_right": 2,
    "disparity": 2,
    "upsampled": 2,
    "depth_m": 2,
    "sigma_m": 2,
    "bgr": 3,
}
"""What ``debug/keyframe_NNNNNN.npz`` holds, and how many dimensions each array has."""


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """One picture with its title."""

    title: str
    image: U8  # (h, w, 3) BGR


def debug_path(folder: Path, seq: int) -> Path:
    """Where the stages of keyframe ``seq`` are kept when ``scan.keep_debug`` is on."""
    return folder / "debug" / f"keyframe_{seq:06d}.npz"


def save_debug(folder: Path, seq: int, arrays: dict[str, Array]) -> Path:
    """Keep the stages of a keyframe for ``skyrelief inspect``; those of DEBUG_KEYS are read."""
    path = debug_path(folder, seq)
    path.parent.mkdir(parents=True, exist_ok=True)
    kept: dict[str, Any] = {name: arrays[name] for name in DEBUG_KEYS if name in arrays}
    np.savez_compressed(path, **kept)
    return path


def load_debug(path: Path) -> dict[str, Array] | None:
    """The arrays of DEBUG_KEYS in ``path``; None when there is no such file.

    Raises InputError when the file is not what ``save_debug`` writes.
    """
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays: dict[str, Array] = {k: file[k] for k in DEBUG_KEYS if k in file.files}
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise InputError(
            f"{path} cannot be read ({error}); replay with keep_debug again"
        ) from error
    for name, array in arrays.items():
        gray = name.startswith("raw") and array.ndim == 2  # a drone without colour
        if (
            (array.ndim != DEBUG_KEYS[name] and not gray)
            or array.dtype.kind not in "fu"
            or not array.size
        ):
            raise InputError(f"{path}: {name} is {array.dtype}{array.shape}, not an image")
    return arrays


def middle_keyframe(folder: Path, seqs: Sequence[int]) -> int | None:
    """Number of a keyframe in the middle, of those with every stage kept if there are any."""
    kept = [seq for seq in seqs if debug_path(folder, seq).is_file()]
    some = kept or list(seqs)
    return some[len(some) // 2] if some else None


def stages(folder: Path, scan_id: str, keyframe: Keyframe) -> tuple[U8, bool]:
    """One picture of a keyframe's stages (the paper's Figure 2), and whether all were kept."""
    arrays = load_debug(debug_path(folder, keyframe.seq))
    panels = keyframe_panels(keyframe) if arrays is None else debug_panels(arrays)
    return sheet(panels, f"{scan_id}: keyframe {keyframe.seq}"), arrays is not None


def debug_panels(arrays: dict[str, Array]) -> list[Panel]:
    """The stages in the order of the paper's figure; a stage that was not kept is left out."""
    out = []
    for name, title in (("raw_left", "raw, left"), ("raw_right", "raw, right")):
        if name in arrays:
            out.append(Panel(title, _bgr(arrays[name])))
    for name, title in (("rect_left", "rectified, left"), ("rect_right", "rectified, right")):
        if name in arrays:
            out.append(Panel(title, _bgr(arrays[name])))
    if "rect_left" in arrays and "rect_right" in arrays:
        out.append(Panel("anaglyph", anaglyph(arrays["rect_left"], arrays["rect_right"])))
    for name, title in (
        ("disparity", "belief propagation, label"),
        ("upsampled", "upsampled, label"),
    ):
        if name in arrays:
            out.append(coloured(title, arrays[name], "px"))
    if "depth_m" in arrays:
        out.append(coloured("depth", arrays["depth_m"], "m"))
    if "sigma_m" in arrays:
        out.append(coloured("sigma", arrays["sigma_m"], "m", cv2.COLORMAP_MAGMA))
    if "bgr" in arrays:
        out.append(Panel("colour of the points", _bgr(arrays["bgr"])))
    return out


def keyframe_panels(keyframe: Keyframe) -> list[Panel]:
    """What the store holds of a keyframe: colour, depth, sigma and views."""
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
        return Panel(f"{title}: nothing known", blank)
    low, high = (float(p) for p in np.percentile(values[known], [1, 99]))
    span = max(high - low, 1e-9)
    tone = np.clip((np.where(known, values, low) - low) / span * 255, 0, 255).astype(np.uint8)
    image = cv2.applyColorMap(tone, colours)
    image[~known] = BACKGROUND
    share = 100.0 * float(known.mean())
    text = f"{title} {low:.2f} to {high:.2f} {unit}".rstrip()
    return Panel(f"{text}, {share:.0f} % known", np.asarray(image, np.uint8))


def sheet(panels: Sequence[Panel], heading: str, columns: int = 3) -> U8:
    """(h, w, 3) BGR: the panels in rows, each with its title above it."""
    fitted = [_fitted(panel) for panel in panels]
    rows = [fitted[n : n + columns] for n in range(0, len(fitted), columns)]
    width = columns * PANEL_PX + (columns + 1) * GAP_PX
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
    """Any 8-bit gray or colour image as BGR."""
    image = np.asarray(image, np.uint8)
    return image if image.ndim == 3 else np.dstack([image] * 3)
