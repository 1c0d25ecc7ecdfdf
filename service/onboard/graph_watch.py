"""What the pose graph finds wrong with the telemetry, in words for the operator."""

from __future__ import annotations

import math

from recon.graph.pose_graph import PoseGraph

LEAST = 5
"""Readings of one kind left out before it is said."""

SIGMAS, LEAST_SHARE = 3.0, 0.03
"""Two scales disagree when they are further apart than both of these."""

LOOK_GROWTH = 1.2
"""The track is looked at again when its keyframes have grown by so much."""

LEFT_OUT = {
    "position off": "positions far from the track were left out: does GNSS jump?",
    "position frozen": "positions only repeated the one before: is GNSS frozen?",
    "heading off": "headings contradict the track and were left out: check the compass",
    "tilt off": "attitudes contradict the pictures and were left out: check the gimbal's frame",
    "altitude off": "altitudes stepped and were left out: check the barometer",
}


class GraphWatch:
    """Looks at a pose graph now and then, on the thread that builds it."""

    def __init__(self, graph: PoseGraph) -> None:
        self._graph = graph
        self._seen = 0
        self._told: set[str] = set()

    def look(self) -> list[str]:
        """What is newly found, once for each kind; looks when the keyframes have grown enough."""
        if self._graph.entered < max(LEAST, LOOK_GROWTH * self._seen):
            return []
        self._seen = self._graph.entered
        fresh = {k: text for k, text in self._findings().items() if k not in self._told}
        self._told |= fresh.keys()
        return list(fresh.values())

    def sentences(self) -> list[str]:
        """Everything that is wrong, as known now."""
        return list(self._findings().values())

    def _findings(self) -> dict[str, str]:
        """Sentences by kind."""
        counts, scales = self._graph.counts, self._graph.newest_scales()
        out = {
            kind: f"{counts[kind]} {text}" for kind, text in LEFT_OUT.items()
            if counts[kind] >= LEAST
        }  # fmt: skip
        by_fixes, by_heights = scales
        if by_fixes is not None and by_heights is not None:
            apart = math.log(by_fixes.metres / by_heights.metres)
            limit = max(SIGMAS * math.hypot(by_fixes.sigma, by_heights.sigma), LEAST_SHARE)
            if abs(apart) > limit:
                percent = 100.0 * (math.exp(abs(apart)) - 1.0)
                which = "larger" if apart > 0 else "smaller"
                out["scale"] = (
                    f"scale: GNSS makes the map {percent:.0f} % {which} than the height above "
                    "ground does; check both"
                )
        return out
