"""Results of a refinement, as figures for JSON and in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from recon.survey.ground_control import Adjusted, KeyframeTrack, map_position
from recon.types import F64
from service.offline.refine.control_points import Candidate
from service.offline.refine.stored_loops import steps_m


def figures_of(
    seqs: Sequence[int],
    track: KeyframeTrack,
    found: Adjusted,
    candidates: Sequence[Candidate],
    verified: int,
    ahead_m: float,
    places_m: F64,
) -> dict[str, Any]:
    """Figures of the adjustment of the keyframes ``seqs``, at ``places_m`` (N, 3) before.

    ``verified``: loops of the flight and loops that matching confirmed; of these the track
    has those with support. ``ahead_m`` is the usual distance of the ground.
    """
    shift = np.linalg.norm(found.poses[:, :3, 3] - places_m, axis=1)
    points = [_point(c, found) for c in candidates]
    return {
        "keyframes": len(track.poses),
        "moved_m": {"median": _round(np.median(shift)), "most": _round(shift.max())},
        "scale": _round(np.median(found.scales), 5),
        "telemetry": bool(track.priors),
        "loops": {
            "verified": verified,
            "used": len(track.loops) - len(found.loops_refused),
            "refused": verified - len(track.loops) + len(found.loops_refused),
            "step_m": _steps(track, found, ahead_m),
            "pairs": [
                [seqs[loop.a], seqs[loop.b], k not in found.loops_refused]
                for k, loop in enumerate(track.loops)
            ],
        },
        "residuals": {
            kind: {"count": len(rows), "rms": _round(np.sqrt(np.mean(rows[rows != 0.0] ** 2)))}
            for kind, rows in found.residuals.items()
            if np.any(rows)
        },
        "points": points,
        "control": _summed([p for p in points if p["role"] == "control"]),
        "check": _summed([p for p in points if p["role"] == "check"]),
    }


def _steps(track: KeyframeTrack, found: Adjusted, ahead_m: float) -> dict[str, Any] | None:
    """How far apart the two ends of the used loops have the same ground; None without any."""
    used = [loop for k, loop in enumerate(track.loops) if k not in found.loops_refused]
    if not used:
        return None
    out: dict[str, Any] = {}
    for when, poses, scales in (
        ("before", track.poses, np.ones(len(track.poses))),
        ("after", found.poses, found.scales),
    ):
        steps = steps_m(used, poses, scales, ahead_m)
        out[when] = {"median": _round(np.median(steps)), "most": _round(steps.max())}
    return out


def _point(one: Candidate, found: Adjusted) -> dict[str, Any]:
    after = map_position(found.poses, found.scales, one.marks)
    return {
        "name": one.point.name,
        "role": "check" if one.point.is_check else "control",
        "marks": len(one.marks),
        "refused": one.why_not or None,
        "place_m": None if one.surveyed_m is None else [_round(v) for v in one.surveyed_m],
        "before_m": off_by(one, one.before_m),
        "after_m": off_by(one, None if after is None else after[0]),
    }


def off_by(one: Candidate, place: F64 | None) -> list[float | None] | None:
    """East, north and, where it was surveyed, up from a point's survey to ``place`` (3,)."""
    if place is None or one.surveyed_m is None:
        return None
    east, north, up = (_round(v) for v in one.off_m(place))
    return [east, north, up if one.has_height else None]


def _summed(points: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """Root mean squares over the points that were not refused; None without any."""
    kept = [p for p in points if p["refused"] is None and p["after_m"] is not None]
    if not kept:
        return None
    out: dict[str, Any] = {"count": len(kept)}
    for when in ("before", "after"):
        off = np.array([p[f"{when}_m"] for p in kept], np.float64)  # NaN: no height
        out[f"rms_h_{when}_m"] = _round(np.sqrt(np.mean(np.sum(off[:, :2] ** 2, axis=1))))
        up = off[np.isfinite(off[:, 2]), 2]
        out[f"rms_v_{when}_m"] = _round(np.sqrt(np.mean(up**2))) if len(up) else None
    return out


def _round(value: Any, digits: int = 4) -> float:
    return round(float(value), digits)


def in_words(figures: dict[str, Any]) -> str:
    parts = ["its own images" if "images" in figures else f"{figures['loops']['used']} loops"]
    if figures["telemetry"]:
        parts.append("the flight's telemetry")
    control, check = figures["control"], figures["check"]
    if control:
        parts.append(f"{control['count']} control points")
    text = f"refined as a whole with {', '.join(parts)}"
    if check:
        up_m, count = check["rms_v_after_m"], check["count"]
        up = "" if up_m is None else f" and {up_m:.2f} m vertically"
        flat = f"{check['rms_h_after_m']:.2f} m horizontally"
        text += f"; {count} check points are off by {flat}{up} (rms)"
    return text
