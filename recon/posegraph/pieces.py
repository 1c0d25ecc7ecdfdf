"""Which segments of a flight are one map, and which are apart."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter

import numpy as np

from recon.posegraph.pose_graph import PoseGraph
from recon.posegraph.segment_frames import SegmentFrames
from recon.types import PosePrior

HEADING_KNOWN_RAD = 1.0

HEIGHT_KNOWN_M, HEIGHTS_AGREE_M = 20.0, 5.0
"""Sigma of a fix's height below which it lays two stretches of one flight on each other, and of one
stretch's height against the other's."""

SCALE_KNOWN = 0.2
"""Sigma of a stretch's scale, by its fixes, below which they lay it on another: depths of unknown
length are no surface beside others."""


class Pieces:
    """The segments of one scan with their keyframes, and which telemetry places in the world."""

    def __init__(self) -> None:
        self._stretches: list[list[int]] = []  # each segment with its first and last keyframe
        self._points: Counter[int] = Counter()  # by segment
        self._placed: set[int] = set()  # by a fix and a heading of their own

    def add(self, seq: int, segment: int, points: int, prior: PosePrior) -> None:
        """Take the next keyframe with surface."""
        if not self._stretches or self._stretches[-1][0] != segment:
            self._stretches.append([segment, seq, seq])
        self._stretches[-1][2] = seq
        self._points[segment] += points
        sigma = prior.sigma_position_m
        is_known = sigma is not None and sigma[2] < HEIGHT_KNOWN_M
        if is_known and prior.sigma_yaw_rad < HEADING_KNOWN_RAD:
            self._placed.add(segment)

    def apart(self, graph: PoseGraph) -> list[tuple[int, int]]:
        """First and last keyframe of the segments that nothing ties to the scan's main piece.

        The main piece is the one that fixes place; without fixes, that with most points.
        """
        piece, frames = {segment: segment for segment, _, _ in self._stretches}, graph.segments
        looped: set[int | None] = set()
        for loop in graph.loops.taken:
            a, b = (self._segment_of(seq) for seq in loop.ends)
            if a is not None and b is not None:
                _join(piece, a, b)
                looped |= {a, b}
        heights = {s: sigma for s in piece if (sigma := _sigma_height_m(frames, s)) is not None}
        unsure = {s for s, sigma in heights.items() if sigma > HEIGHT_KNOWN_M}
        of_any_size = {s for s in heights if not _is_scaled(frames, s)}
        loose = {s for s in unsure if not _agrees(frames, s)} | of_any_size
        placed = self._placed - of_any_size
        fixed = [s for s in piece if s in placed or s in heights.keys() - loose]
        for segment in fixed[1:]:
            _join(piece, fixed[0], segment)
        if fixed:
            main = piece[fixed[0]]
        else:
            sizes: Counter[int] = Counter()
            for segment, points in self._points.items():
                sizes[piece[segment]] += points
            main = sizes.most_common(1)[0][0] if sizes else -1
        return [
            (first, last)
            for segment, first, last in self._stretches
            # A long flight forgets loops, and not which segments they tied.
            if piece[segment] != main
            and (segment in looped or segment in loose or not frames.is_tied(segment))
        ]

    def _segment_of(self, seq: int) -> int | None:
        at = bisect_right(self._stretches, seq, key=lambda one: one[1]) - 1
        return self._stretches[at][0] if at >= 0 else None


def _sigma_height_m(frames: SegmentFrames, segment: int) -> float | None:
    """Sigma of the height at which fixes place a segment; None where they do not."""
    found = frames.known(segment)
    if found is None or "gnss" not in found.sources:
        return None
    return float(np.sqrt(found.covariance[5, 5]))


def _agrees(frames: SegmentFrames, segment: int) -> bool:
    """True when the height is known against the largest segment's: what all fixes of a flight err
    by lays none on another."""
    sigma_m = frames.sigma_height_m(segment)
    return sigma_m is not None and sigma_m < HEIGHTS_AGREE_M


def _is_scaled(frames: SegmentFrames, segment: int) -> bool:
    """True for segments of a known scale, and for the largest, which the others are laid on."""
    found = frames.known(segment)
    assert found is not None
    return found is frames.largest() or found.sigma_scale < SCALE_KNOWN


def _join(piece: dict[int, int], a: int, b: int) -> None:
    """Make one piece of those that segments ``a`` and ``b`` are in."""
    old, new = piece[b], piece[a]
    for segment, name in piece.items():
        if name == old:
            piece[segment] = new
