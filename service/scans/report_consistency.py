"""The report's part on how well everything fits together: residuals, loops, drift, survey."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np

from service.scans.report_map import loop_pairs, position_covariance
from service.stream.records import PoseRecord

KINDS = {
    "vision": "vision and ICP, keyframe to keyframe",
    "link": "breaks of vision",
    "attitude": "attitude",
    "position": "GNSS position",
    "altitude": "altitude",
    "height": "height above ground",
    "scale": "change of scale",
    "loop": "loops",
    "placing": "the flight's own placing",
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
        out += ["<h2>How it fits together</h2>", residuals]
    drift = _drift(summary, poses)
    if drift:
        out += ["<h3>Drift</h3>", rows_table((), drift)]
    out += _loops(summary, flown, refined)
    if refined.get("points"):
        out += ["<h3>Surveyed points</h3>", _survey(refined)]
    return out


def rows_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
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
    header = ["residuals over their sigmas, rms (number)", "in flight", "refined"]
    note = (
        "<p>1 is as large as the sigmas claim. Telemetry's are smaller: its sigmas are widened, "
        "because its errors wander slowly and many readings are no better than a few.</p>"
    )
    return rows_table(header if refined else header[:2], rows) + note


def _drift(summary: dict[str, Any], poses: Sequence[PoseRecord]) -> list[tuple[str, str]]:
    """How far off the track may be, and was found to be."""
    out = []
    if len(poses) >= 2:
        sigma = [float(np.sqrt(np.trace(position_covariance(p)))) for p in poses]
        words = ", ".join(f"{sigma[k]:.2f} m" for k in (0, len(sigma) // 2, -1))
        out.append(("sigma of the place at the start, the middle and the end", words))
    scale = summary.get("run", {}).get("scale")
    if isinstance(scale, dict) and scale.get("sigma") is not None:
        out.append(("scale by " + str(scale.get("from")), f"1 sigma {100 * scale['sigma']:.2f} %"))
    refined = summary.get("refinement")
    if refined:
        moved, length = refined["moved_m"], summary["quality"]["distance_m"]
        share = f", {100 * moved['most'] / length:.2f} % of the way" if length else ""
        out.append(
            ("refinement moved keyframes by", f"{moved['median']:.2f} m (most {moved['most']:.2f} m"
             f"{share})")
        )  # fmt: skip
        out.append(("and changed the scale by", f"{100 * (refined['scale'] - 1):+.2f} %"))
    return out


def _loops(summary: dict[str, Any], flown: dict[str, Any], refined: dict[str, Any]) -> list[str]:
    """Loops by what became of them, and their ends."""
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
    return ["<h3>Loops</h3>", rows_table((), rows)]


def _survey(refined: dict[str, Any]) -> str:
    """Each point's offset in the map, before and after, and the sums."""
    rows = []
    for p in refined["points"]:
        offsets = [_offset(p["before_m"]), _offset(p["after_m"])]
        rows.append([p["name"], p["role"], str(p["marks"]), *offsets, p["refused"] or ""])
    for role in ("control", "check"):
        s = refined.get(role)
        if s:
            sums = [f"{s[f'rms_h_{w}_m']:.3f} m, {s[f'rms_v_{w}_m']:.3f} m" for w in
                    ("before", "after")]  # fmt: skip
            rows.append([f"rms of {s['count']}", role, "", *sums, "horizontal, vertical"])
    header = ("point", "role", "marks", "map less survey before: east, north, up, m", "after", "")
    return rows_table(header, rows)


def _offset(values: Sequence[float] | None) -> str:
    if values is None or max(map(abs, values)) > 1e4:
        return ""
    return "  ".join(f"{v:+.3f}" for v in values)
