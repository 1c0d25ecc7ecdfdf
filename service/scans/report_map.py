"""The report's map: coverage, flight path with error ellipses, loops and surveyed points."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np

from recon.surface.raster import Grid
from recon.types import F64
from service.scans.coverage import BEST, GAP, SELDOM, UNSURE, Coverage
from service.scans.drawing import round_length
from service.stream.records import PoseRecord

WIDTH_PX, LARGEST_HEIGHT_PX = 860, 900
MAX_ELLIPSES = 40
SIGMAS = 2.0
SMALLEST_ELLIPSE_PX = 5.0
TEXT_PX = 22  # of scale and north: a page shows the map at half its size
TRACK, LOOP, WAITING = "#20252b", "#1a5fd0", "#d08a1a"


def map_figure(
    summary: dict[str, Any], poses: Sequence[PoseRecord], coverage: Coverage | None
) -> str:
    """A figure of inline SVG; empty when there is neither a track nor a surface."""
    if not poses and coverage is None:
        return ""
    view = _view(poses, coverage)
    parts = [_ground(coverage, view)] if coverage is not None else []
    track = np.array([p.T_world_camera[:2, 3] for p in poses]).reshape(-1, 2)
    grown = 1
    if len(track):
        shown = _px(view, track[:: max(1, len(track) // 1500)])
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in shown)
        parts.append(
            f'<polyline fill="none" stroke="{TRACK}" stroke-width="1.2" points="{points}"/>'
        )
        ellipses, grown = _ellipses(poses, view)
        parts += ellipses
        parts += _loops(summary, poses, view)
    parts += _survey(summary, view)
    parts.append(_scale_bar(view))
    h, w = view.shape
    svg = f'<svg viewBox="0 0 {w} {h}" width="{w}" height="{h}">{"".join(parts)}</svg>'
    return f"<figure>{svg}<figcaption>{_caption(coverage, summary, grown)}</figcaption></figure>"


def _view(poses: Sequence[PoseRecord], coverage: Coverage | None) -> Grid:
    """The map's pixels, as cells of the ground."""
    spots = [p.T_world_camera[:2, 3] for p in poses]
    if coverage is not None:
        west, south, east, north = coverage.layer.grid.bounds
        spots += [np.array([west, south]), np.array([east, north])]
    low, high = np.min(spots, axis=0), np.max(spots, axis=0)
    margin = 0.02 * float(np.max(high - low)) + 1.0
    span = high - low + 2 * margin
    scale = float(min(WIDTH_PX / span[0], LARGEST_HEIGHT_PX / span[1]))
    shape = math.ceil(span[1] * scale), math.ceil(span[0] * scale)
    return Grid(float(low[0] - margin), float(high[1] + margin), 1.0 / scale, shape)


def _px(view: Grid, xy_m: F64) -> F64:
    """(N, 2) places in the SVG, whose pixels begin at whole numbers, of (N, 2) metres."""
    return view.pixels(xy_m) + 0.5


def _ground(coverage: Coverage, view: Grid) -> str:
    west, south, east, north = coverage.layer.grid.bounds
    (x, y), (x1, y1) = _px(view, np.array([[west, north], [east, south]]))
    code = base64.b64encode(coverage.png_bytes()).decode("ascii")
    return (
        f'<image x="{x:.1f}" y="{y:.1f}" width="{x1 - x:.1f}" height="{y1 - y:.1f}" '
        f'preserveAspectRatio="none" style="image-rendering:pixelated" '
        f'href="data:image/png;base64,{code}"/>'
    )


def _ellipses(poses: Sequence[PoseRecord], view: Grid) -> tuple[list[str], int]:
    """Ellipses of the horizontal position at some keyframes, and their enlargement."""
    keys = [p for p in poses if p.keyframe_seq is not None] or list(poses)
    keys = keys[:: max(1, -(-len(keys) // MAX_ELLIPSES))]
    shapes = [np.linalg.eigh(p.position_covariance[:2, :2]) for p in keys]
    usual = SIGMAS * float(np.median([np.sqrt(max(v[1], 0.0)) for v, _ in shapes]))
    grown = 1
    while usual > 0 and usual * grown / view.cell_m < SMALLEST_ELLIPSE_PX and grown < 1000:
        grown *= 10
    out = []
    for pose, (values, axes) in zip(keys, shapes, strict=True):
        x, y = _px(view, pose.T_world_camera[None, :2, 3])[0]
        small, large = (SIGMAS * float(np.sqrt(max(v, 0.0))) * grown / view.cell_m for v in values)
        turn = -math.degrees(math.atan2(axes[1, 1], axes[0, 1]))
        out.append(
            f'<ellipse cx="{x:.1f}" cy="{y:.1f}" rx="{min(large, 400):.1f}" '
            f'ry="{min(small, 400):.1f}" transform="rotate({turn:.1f} {x:.1f} {y:.1f})" '
            f'fill="{LOOP}" fill-opacity="0.07" stroke="{LOOP}" stroke-opacity="0.5"/>'
        )
    return out, grown


def _loops(summary: dict[str, Any], poses: Sequence[PoseRecord], view: Grid) -> list[str]:
    """Lines between the ends of loops; dashed where unused."""
    where = {p.keyframe_seq: p.T_world_camera[:2, 3] for p in poses if p.keyframe_seq is not None}
    out = []
    for a, b, used in loop_pairs(summary):
        if a in where and b in where:
            (x, y), (x1, y1) = _px(view, np.array([where[a], where[b]]))
            look = f'stroke="{LOOP}"' if used else f'stroke="{WAITING}" stroke-dasharray="4 3"'
            out.append(
                f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{x1:.1f}" y2="{y1:.1f}" '
                f'{look} stroke-width="1.5"/>'
            )
    return out


def loop_pairs(summary: dict[str, Any]) -> list[tuple[int, int, bool]]:
    """(keyframe, keyframe, used) of the refinement's loops, else of the flight's."""
    refined = summary.get("refinement") or {}
    flown = summary.get("run", {}).get("graph") or {}
    pairs = (refined.get("loops") or {}).get("pairs") or (flown.get("loops") or {}).get("pairs")
    return [(int(a), int(b), bool(used)) for a, b, used in pairs or []]


def _survey(summary: dict[str, Any], view: Grid) -> list[str]:
    """Triangles for control, circles for checks, red where refused."""
    out = []
    for p in (summary.get("refinement") or {}).get("points", []):
        if p.get("place_m") is None:
            continue
        x, y = _px(view, np.array([p["place_m"][:2]]))[0]
        if not (0 <= x <= view.shape[1] and 0 <= y <= view.shape[0]):
            continue
        colour = "#d03030" if p["refused"] else "#fff"
        shape = f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5"'
        if p["role"] == "control":
            corners = f"{x:.1f},{y - 7:.1f} {x - 6:.1f},{y + 4:.1f} {x + 6:.1f},{y + 4:.1f}"
            shape = f'<polygon points="{corners}"'
        out.append(f'{shape} fill="{colour}" stroke="{TRACK}" stroke-width="1.5"/>')
        out.append(
            f'<text x="{x + 8:.1f}" y="{y + 4:.1f}" font-size="11">{escape(p["name"])}</text>'
        )
    return out


def _scale_bar(view: Grid) -> str:
    """A bar of round length, and north."""
    length_m = round_length(0.2 * view.shape[1] * view.cell_m)
    length, y, x = length_m / view.cell_m, view.shape[0] - 12, view.shape[1] - 24
    text = f'<text style="font-size:{TEXT_PX}px"'
    return (
        f'<path d="M12 {y - 8}v8h{length:.1f}v-8M{x} 58v-46m-8 14l8 -14l8 14" fill="none" '
        f'stroke="{TRACK}" stroke-width="3"/>{text} x="18" y="{y - 10}">{length_m:g} m</text>'
        f'{text} x="{x - 8}" y="82">N</text>'
    )


def _caption(coverage: Coverage | None, summary: dict[str, Any], grown: int) -> str:
    times = "" if grown == 1 else f", {grown} times enlarged"
    out = [f"Flight path with error ellipses of {SIGMAS:g} sigma{times}."]
    if coverage is not None:
        f = coverage.figures()
        marks = (
            (BEST, "measured"),
            (UNSURE, f"sigma over {f['most_sigma_m']:.2f} m"),
            (SELDOM, f"in fewer than {f['least_views']} images"),
            (GAP, "no surface"),
        )
        out += [f'<span style="color:rgb({b[2]},{b[1]},{b[0]})">&#9632;</span> {t}.'
                for b, t in marks]  # fmt: skip
    if loop_pairs(summary):
        out.append("Blue lines: loops; dashed lines: unused loops.")
    if (summary.get("refinement") or {}).get("points"):
        out.append("Triangles: control points; circles: check points; red: refused.")
    return " ".join(out)
