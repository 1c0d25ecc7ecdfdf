"""``report.html``: flight, coverage, accuracy, speeds and faults, in one file.

Images and curves are embedded; the file loads and runs nothing.
"""

from __future__ import annotations

import base64
import datetime as dt
import math
from collections.abc import Sequence
from html import escape
from typing import Any

import cv2
import numpy as np

from recon.surface.raster import Raster, grid_over
from recon.types import F32, U8, PointCloud
from service.scans.coverage import Coverage
from service.scans.drawing import coloured, round_length
from service.scans.report_map import loop_pairs, map_figure
from service.stream.records import PoseRecord

LARGEST_MAP_PX = 900
SPEEDS = (
    "frames", "frames_tracked", "frames_lost", "segments", "pairs", "clouds",
    "clouds_per_second", "seconds", "backend",
)  # fmt: skip
CURVE_PX = (820, 150)
STYLE = (
    "body{font:15px/1.5 system-ui,sans-serif;color:#20252b;max-width:960px;margin:24px auto;"
    "padding:0 16px}h1{font-size:24px}h2{font-size:18px;margin-top:30px}table{border-collapse:"
    "collapse;display:block;overflow-x:auto}svg{max-width:100%;height:auto}"
    "td,th{overflow-wrap:break-word;padding:3px 14px 3px 0;text-align:left;"
    "border-bottom:1px solid #e3e7eb}"
    "td+td{font-variant-numeric:tabular-nums}img{max-width:100%;border:1px solid #e3e7eb}"
    "figure{margin:14px 0}figcaption{color:#56606a;font-size:13.5px}text{font-size:11px}"
    "@media(max-width:600px){text{font-size:22px}}"
    "@page{margin:14mm}@media print{body{margin:0;max-width:none;padding:0;font-size:12px;"
    "print-color-adjust:exact}figure,table,tr,h2,h3{break-inside:avoid}h2,h3{break-after:avoid}"
    "img,svg{max-height:110mm;width:auto}}"
)


def report_html(
    summary: dict[str, Any],
    poses: Sequence[PoseRecord],
    cloud: PointCloud,
    raster: Raster | None,
    preview_jpg: bytes,
    coverage: Coverage | None = None,
    keyframe_jpg: bytes | None = None,
) -> str:
    """The report of a scan whose scan.json holds ``summary``.

    ``keyframe_jpg`` shows the stages of one keyframe.
    """
    run = summary["run"]
    parts = [
        f"<h1>{escape(summary['id'])}</h1>",
        _table(_flown(summary, poses)),
        _figure(preview_jpg, "image/jpeg", "Colour and height from above, with the track."),
        "<h2>Coverage and accuracy</h2>",
        map_figure(summary, poses, coverage),
        _table([*_covered(coverage), *_accuracy(summary, raster)]),
        *_maps(cloud, raster),
        *consistency(summary, poses),
        "<h2>The flight</h2>",
        *_curves(poses),
        *_stages(keyframe_jpg),
        "<h2>Speeds and faults</h2>",
        _table(_rows(run, SPEEDS)),
        _counted("Not used for stereo", run.get("refusals")),
        _counted("Readings left out of the pose graph", (run.get("graph") or {}).get("left_out")),
        _counted("Clouds registered", run.get("registrations")),
        _counted("Milliseconds per call of each stage", run.get("stage_ms")),
        *(f"<p>Note: {escape(str(note))}</p>" for note in summary["notes"]),
        f"<p>{escape(summary['software'])}</p>",
    ]
    head = (
        "<!doctype html><html lang=en><meta charset=utf-8>"
        "<meta name=viewport content='width=device-width, initial-scale=1'>"
        f"<title>{escape(summary['id'])}"
    )
    return f"{head}</title><style>{STYLE}</style><body>{''.join(parts)}</body></html>\n"


def _stages(image: bytes | None) -> list[str]:
    if image is None:
        return []
    words = "Stages of a keyframe in the middle; all of them with scan.keep_debug=true."
    return ["<h2>A keyframe</h2>", _figure(image, "image/jpeg", words)]


def _flown(summary: dict[str, Any], poses: Sequence[PoseRecord]) -> list[tuple[str, str]]:
    origin, times = summary["origin"], summary["times"]
    rows = [("drone", summary["drone"]), ("began", _when(times["started_unix_s"]))]
    if poses:
        seconds = times["last_pose_unix_s"] - times["first_pose_unix_s"]
        rows += [
            ("duration", f"{seconds:.0f} s"),
            ("distance", f"{summary['quality']['distance_m']:.0f} m"),
            ("speed, median", f"{np.median([p.speed_m_s for p in poses]):.1f} m/s"),
        ]
        heights = [p.agl_m for p in poses if p.agl_m is not None]
        if heights:
            rows.append(("height above ground, median", f"{np.median(heights):.1f} m"))
    if origin is None:
        rows.append(("position", "no georeference: metres about the scan's own origin"))
    else:
        rows.append(("origin", f"{origin['lat_deg']:.7f}, {origin['lon_deg']:.7f}"))
        rows.append(("coordinates", f"EPSG:{summary['epsg']}, {summary['heights']}"))
    rows.append(("finished", "yes" if summary["finished"] else "no, still growing or cut off"))
    return rows


def _accuracy(summary: dict[str, Any], raster: Raster | None) -> list[tuple[str, str]]:
    quality, counts = summary["quality"], summary["counts"]
    trust = quality["trust"]
    rows = [
        ("trust", "; ".join([trust["level"], *trust["reasons"]])),
        ("points", f"{counts['points']} from {counts['keyframes']} keyframes"),
        ("area of the cloud", f"{quality['area_m2']:.0f} m2"),
        ("voxel", f"{quality['voxel_m']:.3f} m"),
    ]
    for name, key, unit in (
        ("sigma of the points, median", "sigma_median_m", "m"),
        ("sigma of the points, 90 %", "sigma_90_percent_m", "m"),
        ("stereo pairs per point, median", "views_median", ""),
        ("sigma of the camera's position, horizontal", "position_sigma_h_median_m", "m"),
        ("sigma of the camera's position, vertical", "position_sigma_v_median_m", "m"),
    ):
        if quality[key] is not None:
            rows.append((name, f"{quality[key]:.3g} {unit}"))
    if quality["seen_once_share"] is not None:
        rows.append(("points that one pair sees", f"{100.0 * quality['seen_once_share']:.0f} %"))
    if raster is not None and quality["area_m2"]:
        rows.append(("points per m2", f"{counts['points'] / quality['area_m2']:.1f}"))
    return [*rows, *sensor_constants((summary.get("run") or {}).get("graph") or {})]


def sensor_constants(graph: dict[str, Any]) -> list[tuple[str, str]]:
    """Constant sensor errors found by the pose graph."""
    rows = []
    boresight, datum = graph.get("boresight"), graph.get("altitude_datum")
    if boresight is not None:
        offsets = ("{:+.2f} +- {:.2f}".format(*pair) for pair in
                zip(boresight["deg"], boresight["sigma_deg"], strict=True))  # fmt: skip
        verdict = "corrected" if boresight["sure"] else "uncertain, not applied"
        name = "boresight about right, down, ahead"
        rows.append((name, f"{', '.join(offsets)} degrees: {verdict}"))
    if datum is not None and datum["shift_m"]:
        rows.append(("altitude raised to the receiver's", f"{datum['shift_m']:+.2f} m"))
    return rows


def _covered(coverage: Coverage | None) -> list[tuple[str, str]]:
    if coverage is None:
        return []
    f = coverage.figures()
    return [
        ("area flown", f"{f['flown_m2']:.0f} m2"),
        ("of it without a surface", f"{f['gaps_m2']:.0f} m2"),
        ("of it weak (skyrelief refly plans a flight over it)", f"{f['weak_m2']:.0f} m2"),
        ("images per place, median", f"{f['views_median']:.0f}"),
    ]


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
        ("Stereo pairs that agree, maximum per cell:", views, "", cv2.COLORMAP_VIRIDIS),
        ("Sigma, minimum per cell:", sigma, "m", cv2.COLORMAP_MAGMA),
    ):
        panel = coloured(title, values, unit, colours)
        caption = panel.title.rpartition(",")[0] or panel.title
        out.append(_figure(_png(panel.image), "image/png", caption + ", dark to light."))
    return out


def _per_cell(cloud: PointCloud, cell_m: float) -> tuple[F32, F32]:
    """Maximum views and minimum sigma of the points in each cell, NaN where there are none."""
    xy = cloud.xyz_m[:, :2].astype(np.float64)
    grid = grid_over(xy, cell_m)
    at = np.ravel_multi_index(grid.cells(xy), grid.shape)
    views, sigma = (np.full(grid.shape, far, np.float32) for far in (-np.inf, np.inf))
    np.maximum.at(views.reshape(-1), at, cloud.views.astype(np.float32))
    np.minimum.at(sigma.reshape(-1), at, cloud.sigma_m)
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
    return f"<h3>{escape(title)}</h3>" + _table([(str(k), str(v)) for k, v in values.items()])


def _figure(data: bytes, kind: str, caption: str) -> str:
    code = base64.b64encode(data).decode("ascii")
    image = f'<img alt="" src="data:{kind};base64,{code}">'
    return f"<figure>{image}<figcaption>{escape(caption)}</figcaption></figure>"


def _png(image: U8) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def _when(unix_s: float) -> str:
    when = dt.datetime.fromtimestamp(unix_s, dt.timezone.utc)
    return when.strftime("%Y-%m-%d %H:%M:%S UTC")


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


def consistency(summary: dict[str, Any], poses: Sequence[PoseRecord]) -> list[str]:
    """Sections as HTML; those without content are left out."""
    flown = summary.get("run", {}).get("graph") or {}
    refined = summary.get("refinement") or {}
    out = []
    residuals = _residuals(flown.get("residuals") or {}, refined.get("residuals") or {})
    if residuals:
        out += ["<h2>Consistency</h2>", residuals]
    drift = _drift(summary, poses)
    if drift:
        out += ["<h3>Drift</h3>", _table(drift)]
    out += _loops(summary, flown, refined)
    if refined.get("points"):
        out += ["<h3>Surveyed points</h3>", _survey(refined)]
    return out


def _table(rows: Sequence[Sequence[str]], header: Sequence[str] = ()) -> str:
    """A table, its text escaped; empty without rows."""
    if not rows:
        return ""
    head = "".join(f"<th>{escape(name)}</th>" for name in header)
    head = f"<tr>{head}</tr>" if header else ""
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows
    )
    return f"<table>{head}{body}</table>"


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
    return _table(rows, header if refined else header[:2]) + note


def _drift(summary: dict[str, Any], poses: Sequence[PoseRecord]) -> list[tuple[str, str]]:
    """Estimated and observed drift of the track."""
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
    return ["<h3>Loops</h3>", _table(rows)]


def _survey(refined: dict[str, Any]) -> str:
    """Each point's offset in the map, before and after, and rms values."""
    rows = []
    for p in refined["points"]:
        offsets = [_offset(p["before_m"]), _offset(p["after_m"])]
        rows.append([p["name"], p["role"], str(p["marks"]), *offsets, p["refused"] or ""])
    for role in ("control", "check"):
        s = refined.get(role)
        if s:
            sums = [_rms(s[f"rms_h_{w}_m"], s[f"rms_v_{w}_m"]) for w in ("before", "after")]
            rows.append([f"rms of {s['count']}", role, "", *sums, "horizontal, vertical"])
    header = ("point", "role", "marks", "map minus survey before: east, north, up, m", "after", "")
    return _table(rows, header)


def _offset(values: Sequence[float | None] | None) -> str:
    """East, north and, where it was surveyed, up."""
    if values is None or max(abs(v or 0.0) for v in values) > 1e4:
        return ""
    return "  ".join(f"{v:+.3f}" for v in values if v is not None)


def _rms(flat_m: float, up_m: float | None) -> str:
    return f"{flat_m:.3f} m" if up_m is None else f"{flat_m:.3f} m, {up_m:.3f} m"
