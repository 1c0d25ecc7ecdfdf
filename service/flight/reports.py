"""Reports of a flight: lost tracking and doubts about the map for the operator, and figures."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from recon.image_quality import ExposureTimeWatch
from recon.posegraph.pose_graph import PoseGraph
from recon.posegraph.sensor_offsets import Constants
from recon.tracking.frame import Frame, Tracking
from recon.types import F64
from service.scans.trust import scales_differ
from service.stream.records import pack_covariance, pack_motion

LEAST = 5  # number of left-out readings of one kind that is reported
SIGMAS, MIN_SHARE = 3.0, 0.03  # two scales disagree when they are further apart than both of these
LOOK_GROWTH = 1.2  # the track is examined again when its keyframes have grown by this share
MIN_FIXES = 10  # fixes before the track is held against them

LEFT_OUT = {
    "position off": "positions far from the track were left out: does GNSS jump?",
    "position frozen": "positions only repeated the one before: is GNSS frozen?",
    "heading off": "headings contradict the track and were left out: check the compass, and which "
    "way up the camera is",
    "tilt off": "attitudes contradict the images and were left out: check the gimbal's frame",
    "view off": "images do not look as assumed without attitude: set camera.mount_pitch_deg",
    "altitude off": "altitudes stepped and were left out: check the barometer",
}


class GraphWatch:
    """Looks at a pose graph now and then, on the thread that builds it."""

    def __init__(self, graph: PoseGraph) -> None:
        self._graph = graph
        self._seen = 0
        self._reported: set[str] = set()

    def new_findings(self) -> list[str]:
        """New findings, once for each kind; looks when the keyframes have grown enough."""
        if self._graph.entered < max(LEAST, LOOK_GROWTH * self._seen):
            return []
        self._seen = self._graph.entered
        fresh = {k: text for k, text in self._findings().items() if k not in self._reported}
        self._reported |= fresh.keys()
        return list(fresh.values())

    def sentences(self) -> list[str]:
        return list(self._findings().values())

    def _findings(self) -> dict[str, str]:
        counts = self._graph.counts
        out = {
            kind: f"{counts[kind]} {text}" for kind, text in LEFT_OUT.items()
            if counts[kind] >= LEAST
        }  # fmt: skip
        if steps := counts["vision off"]:
            out["vision"] = (
                f"{steps} steps of the track contradict both attitude and positions and were left "
                "out: are images smeared by compression?"
            )
        ratio = gnss_over_heights(self._graph)
        if ratio is not None:
            out["scale"] = f"scale: {scales_differ(ratio)}; check both"
        off = _off_in_sigmas(self._graph.residuals().get("position"))
        if off > SIGMAS:
            out["track"] = (
                f"track and GNSS differ by {off:.0f} sigma: check the camera's model, delay and "
                "shutter"
            )
        return out


def sigma_of_scale(graph: PoseGraph) -> float:
    """Relative sigma of the largest segment's scale; loops and vision that contradict its readings
    leave it as unsure as they are apart."""
    found, growth = graph.segments.largest(), abs(graph.largest_growth())
    assert found is not None
    sigma = found.to_world.sigma_scale
    return growth if growth > SIGMAS * sigma else sigma


def gnss_over_heights(graph: PoseGraph) -> float | None:
    """The scale of the largest segment by fixes over that by heights, where the two disagree."""
    by_fixes, by_heights = graph.segments.largest_scales()
    if by_fixes is None or by_heights is None:
        return None
    (fixes_m, sigma_fixes), (heights_m, sigma_heights) = by_fixes, by_heights
    ratio = fixes_m / heights_m
    limit = max(SIGMAS * math.hypot(sigma_fixes, sigma_heights), MIN_SHARE)
    return ratio if abs(math.log(ratio)) > limit else None


def _off_in_sigmas(rows: F64 | None) -> float:
    """Robust rms of the positions' whitened residuals (n, 3); 0 with too few of them."""
    if rows is None or len(rows) < MIN_FIXES:
        return 0.0
    return 1.4826 * float(np.median(np.abs(rows)))


MAX_LOOPS = 300  # loops that a summary carries with their motions; of more, an even sample


def graph_figures(graph: PoseGraph) -> dict[str, Any] | None:
    """Residuals by kind of factor, loops and readings left out, fit for JSON; None when empty.

    ``nodes`` of the ``keyframes`` are in the graph; the others are interpolated between them.
    ``loops.motions`` are the accepted loops as refinement takes them: two keyframes, seven
    numbers of the motion and 21 of its covariance.
    """
    if len(graph) < 2:
        return None
    step = max(1, -(-len(graph.loops) // MAX_LOOPS))
    accepted = [loop.scaled(graph.scale(loop.a)) for loop in graph.loops[::step]]
    largest = graph.segments.largest()
    noise = None if largest is None else largest.to_world.noise
    pairs = [
        [*loop.ends, taken]
        for loops, taken in ((graph.loops, True), (graph.pending, False))
        for loop in loops
    ]
    return {
        "keyframes": graph.entered,
        "nodes": len(graph),
        "residuals": {
            kind: {
                "count": len(rows),
                "rms": round(float(np.sqrt(np.mean(np.square(rows)))), 4),
            }
            for kind, rows in graph.residuals().items()
            if rows.size
        },
        "loops": {
            "used": len(graph.loops),
            "waiting": len(graph.pending),
            "pairs": pairs[-2 * MAX_LOOPS :],
            "motions": [
                [
                    loop.a,
                    loop.b,
                    [float(f"{v:.9g}") for v in pack_motion(loop.T_a_b)],
                    [float(f"{v:.6g}") for v in pack_covariance(loop.covariance)],
                ]
                for loop in accepted
            ],
        },
        **_constants(graph.constants()),
        "over_claim": 1.0 if noise is None else round(float(noise.over_claim.max()), 2),
        "left_out": {str(k): int(v) for k, v in graph.counts.items()},
    }


def _constants(found: Constants) -> dict[str, Any]:
    """Boresight and altitude's zero. ``boresight.deg`` turns the reported camera about its x, y
    and z axes (right, down, ahead); it is used when it is sure."""
    return {
        "boresight": {
            "deg": [round(float(v), 3) for v in np.degrees(found.turn)],
            "sigma_deg": [round(float(v), 3) for v in np.degrees(found.sigma_turn)],
            "sure": found.is_turn_sure,
        },
        "altitude_datum": {
            "shift_m": round(found.up_m, 3),
            "sigma_m": round(found.sigma_up_m, 3) if np.isfinite(found.sigma_up_m) else None,
        },
    }


LOST_S = 10.0
FOUND = (Tracking.TRACKED, Tracking.KEYFRAME, Tracking.SKIPPED)
"""States with a pose that rests on more than the segment's first image."""


class TrackingWatch:
    """Looks at every frame; ``warn`` gets one text for each loss and one for its end."""

    def __init__(self, warn: Callable[[str], None]) -> None:
        self._warn = warn
        self._since_ns: int | None = None  # the first frame without a pose
        self._frames, self._is_reported = 0, False
        self._reasons: Counter[str] = Counter()

    def add(self, frame: Frame, time_ns: int) -> None:
        """Take the result of a frame; times never decrease. A camera that stands still is not
        lost."""
        if frame.state in FOUND:
            if self._is_reported:
                self._warn("Tracking recovered")
            self._since_ns, self._frames, self._is_reported = None, 0, False
            self._reasons.clear()
            return
        self._since_ns = time_ns if self._since_ns is None else self._since_ns
        self._frames += 1
        self._reasons[frame.reason] += frame.state is Tracking.LOST
        for_s = 1e-9 * (time_ns - self._since_ns)
        is_lost = 2 * self._reasons.total() > self._frames
        if for_s >= LOST_S and is_lost and not self._is_reported:
            ((reason, _),) = self._reasons.most_common(1)
            self._warn(f"Tracking lost for {for_s:.0f} s ({reason}): nothing is scanned")
            self._is_reported = True


def motion_blur(exposure_time: ExposureTimeWatch, px_per_px: float) -> dict[str, Any] | None:
    """The strongest blur so far, fit for JSON; None while the images are sharp. Without an
    exposure time where motion cannot have caused it. ``px_per_px``: pixels of the recording to one
    of the images that are tracked."""
    if exposure_time.strongest is None:
        return None
    blur_px, exposure_s = exposure_time.strongest
    shown_ms = round(1e3 * exposure_s, 1) if exposure_time.is_of_motion else None
    return {"blur_px": round(px_per_px * blur_px, 1), "exposure_ms": shown_ms}


def blur_note(blur: Mapping[str, Any]) -> str:
    """A :func:`motion_blur` for the reader of the scan."""
    px, ms = blur["blur_px"], blur["exposure_ms"]
    if ms is None:
        return (
            f"the images are smeared by {px:.0f} px, farther than they move from one to the next: "
            "compressed too strongly? record with a higher bitrate"
        )
    return (
        f"motion blurs the images by {px:.0f} px: the shutter is open for about {ms:.0f} ms, "
        f"{ms / px:.1f} ms would blur by one; set a shorter exposure or fly slower"
    )


def blur_warning(blur: Mapping[str, Any]) -> str:
    """The same for the operator, whose ground station shows 50 characters."""
    if blur["exposure_ms"] is None:
        return f"Images smeared by {blur['blur_px']:.0f} px: raise the bitrate"
    return f"Shutter too slow: images blur by {blur['blur_px']:.0f} px"
