"""The report's appendix: what engineers look at when a scan is in doubt."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import Any

import cv2
import numpy as np

from recon.surface.raster import Raster, grid_over
from recon.types import F32, U8, PointCloud
from service.scans.drawing import coloured, round_length
from service.scans.fused_cloud import CHUNK_POINTS
from service.scans.report_map import loop_pairs
from service.scans.report_parts import embedded, figure, table
from service.stream.records import PoseRecord

LARGEST_MAP_PX = 900
SPEEDS = (
    "frames", "frames_tracked", "frames_lost", "segments", "pairs", "clouds",
    "clouds_per_second", "seconds", "backend",
)  # fmt: skip
CURVE_PX = (820, 150)

KINDS = {
    "vision": "vision and ICP, keyframe to keyframe",
    "link": "breaks of vision",
    "attitude": "attitude",
    "position": "GNSS position",
    "altitude": "altitude",
    "height": "height above ground",
    "scale": "change of scale",
    "loop": "loops",
    "placing": "placement in flight",
    "prior": "start",
    "survey": "survey of control points",
    "control": "marks of control points",
}
"""Kinds of factors in words."""


def appendix(
    summary: dict[str, Any],
    poses: Sequence[PoseRecord],
    cloud: PointCloud,
    raster: Raster | None,
    keyframe: U8 | None = None,
) -> list[str]:
    """Sections as HTML; ``keyframe`` shows the stages of one keyframe."""
    run = summary["run"]
    return [
        *_maps(cloud, raster),
        table(_cloud(summary)),
        *consistency(summary, poses),
        "<h3>The flight over time</h3>",
        *_curves(poses),
        *([] if keyframe is None else ["<h3>A keyframe</h3>", figure(
            embedded(keyframe, quality=85),
            "Stages of a keyframe in the middle; all of them with scan.keep_debug=true.",
        )]),
        "<h3>Speeds and faults</h3>",
        table(_rows(run, SPEEDS)),
        _counted("Not used for stereo", run.get("refusals")),
        _counted("Readings left out of the pose graph", (run.get("graph") or {}).get("left_out")),
        _counted("Clouds registered", run.get("registrations")),
        _counted("Milliseconds per call of each stage", run.get("stage_ms")),
    ]  # fmt: skip


def _cloud(summary: dict[str, Any]) -> list[tuple[str, str]]:
    quality, counts = summary["quality"], summary["counts"]
    rows = [
        ("points", f"{counts['points']:,} from {counts['keyframes']:,} keyframes"),
        ("voxel", f"{quality['voxel_m']:.3f} m"),
    ]
    if quality["views_median"] is not None:
        rows.append(("stereo pairs per point, median", f"{quality['views_median']:.3g}"))
    if quality["seen_once_share"] is not None:
        rows.append(("points that one pair sees", f"{100.0 * quality['seen_once_share']:.0f} %"))
    if quality["area_m2"]:
        rows.append(("points per m²", f"{counts['points'] / quality['area_m2']:.1f}"))
    return [*rows, *sensor_constants((summary.get("run") or {}).get("graph") or {})]


def sensor_constants(graph: dict[str, Any]) -> list[tuple[str, str]]:
    rows = []
    boresight, datum = graph.get("boresight"), graph.get("altitude_datum")
    if boresight is not None:
        offsets = ("{:+.2f} ± {:.2f}".format(*pair) for pair in
                zip(boresight["deg"], boresight["sigma_deg"], strict=True))  # fmt: skip
        verdict = "corrected" if boresight["sure"] else "uncertain, not applied"
        name = "boresight about right, down, ahead"
        rows.append((name, f"{', '.join(offsets)} degrees: {verdict}"))
    if datum is not None and datum["shift_m"]:
        rows.append(("altitude raised to the receiver's", f"{datum['shift_m']:+.2f} m"))
    return rows


def _maps(cloud: PointCloud, raster: Raster | None) -> list[str]:
    """Maps of the number of views and of sigma per cell."""
    if raster is None:
        return ["<p>There is no surface.</p>"]
    cell = raster.grid.cell_m
    while max(raster.grid.shape) * raster.grid.cell_m / cell > LARGEST_MAP_PX:
        cell *= 2.0
    views, sigma = _per_cell(cloud, cell)
    out = []
    for title, values, unit, colours in (
        ("Stereo pairs that agree, maximum per cell", views, "", cv2.COLORMAP_VIRIDIS),
        ("Sigma, minimum per cell", sigma, "m", cv2.COLORMAP_MAGMA),
    ):
        panel = coloured(title, values, unit, colours)
        scale = _colour_bar(colours, *panel.ends) if panel.ends else ": no data"
        out.append(figure(embedded(panel.image, "png"), title, scale))
    return out


def _colour_bar(colours: int, low: str, high: str) -> str:
    """One of OpenCV's colour scales between the values of its ends, as HTML."""
    tones = np.linspace(0, 255, 9).astype(np.uint8)[None]
    shown = cv2.applyColorMap(tones, colours)[0, :, ::-1].tolist()
    steps = ",".join(f"rgb({r},{g},{b})" for r, g, b in shown)
    style = f"display:inline-block;width:9em;height:.8em;background:linear-gradient(90deg,{steps})"
    return f': {escape(low)} <span style="{style}"></span> {escape(high)}'


def _per_cell(cloud: PointCloud, cell_m: float) -> tuple[F32, F32]:
    """Maximum views and minimum sigma of the points in each cell, NaN where there are none."""
    grid = grid_over(cloud.xyz_m[:, :2], cell_m)
    views, sigma = (np.full(grid.shape, far, np.float32) for far in (-np.inf, np.inf))
    for first in range(0, len(cloud), CHUNK_POINTS):
        some = slice(first, first + CHUNK_POINTS)
        at = grid.cells(cloud.xyz_m[some, :2].astype(np.float64))
        np.maximum.at(views, at, cloud.views[some].astype(np.float32))
        np.minimum.at(sigma, at, cloud.sigma_m[some])
    nan = np.float32(np.nan)
    return np.where(np.isfinite(views), views, nan), np.where(np.isfinite(sigma), sigma, nan)


def _curves(poses: Sequence[PoseRecord]) -> list[str]:
    if len(poses) < 2:
        return ["<p>There is no trajectory.</p>"]
    t = np.array([(p.time_unix_ns - poses[0].time_unix_ns) / 1e9 for p in poses])
    series = {
        "height above ground, m": [math.nan if p.agl_m is None else p.agl_m for p in poses],
        "height of the camera above the origin, m": [p.T_world_camera[2, 3] for p in poses],
        "speed, m/s": [p.speed_m_s for p in poses],
        "turn rate, degrees/s": [math.degrees(p.turn_rate_rad_s) for p in poses],
        "sigma of the position, m": [p.sigma_m for p in poses],
    }
    return [_curve(name, t, np.array(values, float)) for name, values in series.items()]


def _curve(name: str, t: np.typing.NDArray[Any], values: np.typing.NDArray[Any]) -> str:
    """One quantity over time as SVG; at most a point per pixel."""
    known = np.isfinite(values)
    if known.sum() < 2:
        return ""
    t, values = t[known], values[known]
    step = max(1, len(t) // CURVE_PX[0])
    low, high = float(values.min()), float(values.max())
    w, h = CURVE_PX
    left, bottom, span_s = 56, h - 18, float(t[-1] - t[0])
    x = left + (w - left - 8) * (t - t[0]) / max(span_s, 1e-9)
    y = bottom - 6 - (bottom - 12) * (values - low) / max(high - low, 1e-9)
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x[::step], y[::step], strict=True))
    parts = [f'<path fill="none" stroke="#8a949e" d="M{left} 2V{bottom}H{w}"/>']
    for value in _ticks(low, high, 3):
        at = float(np.interp(value, [low, high], [bottom - 6, 6]))
        parts.append(f'<path stroke="#e3e7eb" d="M{left} {at:.1f}H{w}"/>')
        parts.append(_label(left - 5, at + 4, "end", value))
    for value in _ticks(0.0, span_s, 4):
        at = float(np.interp(value, [0.0, span_s], [left, w - 8]))
        parts.append(_label(at, h - 4, "middle", value, " s"))
    parts.append(f'<polyline fill="none" stroke="#1a5fd0" points="{points}"/>')
    caption = f"{escape(name)}: {low:.2f} to {high:.2f}, over {span_s:.0f} s"
    svg = f'<svg viewBox="0 0 {w} {h}" width="{w}" height="{h}">{"".join(parts)}</svg>'
    return f"<figure>{svg}<figcaption>{caption}</figcaption></figure>"


def _ticks(low: float, high: float, count: int) -> list[float]:
    """Round values within a range, from ``count`` to 2.5 times as many; its start without width."""
    if not high - low > 1e-9:
        return [low]
    step = round_length((high - low) / count)
    return [float(k * step) for k in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _label(x: float, y: float, anchor: str, value: float, unit: str = "") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{value:.6g}{unit}</text>'


def _rows(values: dict[str, Any], names: Sequence[str]) -> list[tuple[str, str]]:
    return [(name.replace("_", " "), str(values[name])) for name in names if name in values]


def _counted(title: str, values: Any) -> str:
    """A table of names and numbers; empty without numbers."""
    if not isinstance(values, dict) or not values:
        return ""
    return f"<h4>{escape(title)}</h4>" + table([(str(k), str(v)) for k, v in values.items()])


def consistency(summary: dict[str, Any], poses: Sequence[PoseRecord]) -> list[str]:
    """Sections as HTML; those without content are left out."""
    flown = summary.get("run", {}).get("graph") or {}
    refined = summary.get("refinement") or {}
    out = []
    residuals = _residuals(flown.get("residuals") or {}, refined.get("residuals") or {})
    if residuals:
        out += ["<h3>Consistency</h3>", residuals]
    drift = _drift(summary, poses)
    if drift:
        out += ["<h4>Drift</h4>", table(drift)]
    out += _loops(summary, flown, refined)
    return out


def _residuals(flown: dict[str, Any], refined: dict[str, Any]) -> str:
    """Whitened residuals by kind of factor, in flight and after refinement."""
    rows = []
    for kind, words in KINDS.items():
        cells = [words]
        for found in (flown, refined):
            one = found.get(kind)
            cells.append("" if one is None else f"{one['rms']:.2f} ({one['count']})")
        if any(cells[1:]):
            rows.append(cells if refined else cells[:2])
    if not rows:
        return ""
    header = ["residuals divided by sigma, rms (number)", "in flight", "refined"]
    note = (
        "<p>1 agrees with sigma. Values of telemetry are smaller: its sigmas are enlarged, "
        "because its errors drift slowly and are correlated.</p>"
    )
    return table(rows, header if refined else header[:2]) + note


def _drift(summary: dict[str, Any], poses: Sequence[PoseRecord]) -> list[tuple[str, str]]:
    out = []
    if len(poses) >= 2:
        sigma = [float(np.sqrt(np.trace(p.position_covariance))) for p in poses]
        words = ", ".join(f"{sigma[k]:.2f} m" for k in (0, len(sigma) // 2, -1))
        out.append(("sigma of the position at start, middle and end", words))
    scale = summary.get("run", {}).get("scale")
    if isinstance(scale, dict) and scale.get("sigma") is not None:
        out.append(("scale by " + str(scale.get("from")), f"1 sigma {100 * scale['sigma']:.2f} %"))
    refined = summary.get("refinement")
    if refined:
        moved, length = refined["moved_m"], summary["quality"]["distance_m"]
        share = f", {100 * moved['most'] / length:.2f} % of the distance" if length else ""
        out.append(
            ("refinement moved keyframes by", f"{moved['median']:.2f} m (max {moved['most']:.2f} m"
             f"{share})")
        )  # fmt: skip
        out.append(("refinement changed the scale by", f"{100 * (refined['scale'] - 1):+.2f} %"))
    return out


def _loops(summary: dict[str, Any], flown: dict[str, Any], refined: dict[str, Any]) -> list[str]:
    """Loops by status, and their keyframes."""
    rows = []
    for name, found in (("in flight", flown.get("loops")), ("refined", refined.get("loops"))):
        if found:
            words = [f"{found[k]} {k}" for k in ("used", "waiting", "refused") if k in found]
            rows.append((f"loops {name}", ", ".join(words)))
    if not rows:
        return []
    used = [f"{a}-{b}" for a, b, counted in loop_pairs(summary) if counted]
    if used:
        more = f" and {len(used) - 40} more" if len(used) > 40 else ""
        rows.append(("between keyframes", ", ".join(used[:40]) + more))
    return ["<h4>Loops</h4>", table(rows)]
