"""Which stretches of unbroken vision hang together, and which nothing ties to the rest."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter

from recon.graph.keyframe_graph import KeyframeGraph
from recon.types import PosePrior

HEADING_KNOWN_RAD = 1.0


class Pieces:
    """The segments of one scan with their keyframes, and which telemetry places in the world."""

    def __init__(self) -> None:
        self._starts: list[int] = []  # numbers of the segments' first keyframes
        self._segments: list[int] = []
        self._last: list[int] = []
        self._points: Counter[int] = Counter()  # by segment
        self._placed: set[int] = set()  # by a fix and a heading of their own

    def add(self, seq: int, segment: int, points: int, prior: PosePrior) -> None:
        """Take the next keyframe with surface."""
        if not self._segments or self._segments[-1] != segment:
            self._starts.append(seq)
            self._segments.append(segment)
            self._last.append(seq)
        self._last[-1] = seq
        self._points[segment] += points
        if prior.sigma_position_m is not None and prior.sigma_yaw_rad < HEADING_KNOWN_RAD:
            self._placed.add(segment)

    def apart(self, graph: KeyframeGraph) -> list[tuple[int, int]]:
        """First and last keyframe of the segments that nothing ties to the scan's main piece.

        The main piece is the one that fixes place; without fixes, that with most points.
        """
        piece = {segment: segment for segment in self._segments}
        looped: set[int | None] = set()
        for edge in graph.loops:
            a, b = (self._segment_of(seq) for seq in (edge.a, edge.b))
            if edge.accepted and a is not None and b is not None:
                _join(piece, a, b)
                looped |= {a, b}
        fixed = [s for s in self._segments if s in self._placed or _rests_on_fixes(graph, s)]
        for segment in fixed[1:]:
            _join(piece, fixed[0], segment)
        if fixed:
            main = piece[fixed[0]]
        else:
            sizes: Counter[int] = Counter()
            for segment, points in self._points.items():
                sizes[piece[segment]] += points
            main = sizes.most_common(1)[0][0] if sizes else -1
        ends = zip(self._segments, self._starts, self._last, strict=True)
        return [
            (first, last)
            for segment, first, last in ends
            # A long flight forgets loops, and not which segments they tied.
            if piece[segment] != main and (segment in looped or not graph.is_tied(segment))
        ]

    def _segment_of(self, seq: int) -> int | None:
        at = bisect_right(self._starts, seq) - 1
        return self._segments[at] if at >= 0 else None


def _rests_on_fixes(graph: KeyframeGraph, segment: int) -> bool:
    found = graph.similarity(segment)
    return found is not None and "gnss" in found.sources


def _join(piece: dict[int, int], a: int, b: int) -> None:
    """Make one piece of those that segments ``a`` and ``b`` are in."""
    old, new = piece[b], piece[a]
    for segment, name in piece.items():
        if name == old:
            piece[segment] = new
