"""Which segments of a flight are one map, and which are apart."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence

from recon.posegraph.records import Loop
from recon.posegraph.segments import HEIGHT_KNOWN_M, Segment, Segments

HEIGHTS_AGREE_M = 5.0
"""Sigma of a segment's height against the largest one's, below which fixes lay it on that one."""

SCALE_KNOWN = 0.2
"""Sigma of a segment's scale, by its fixes, below which they lay it on another: depths of unknown
length are no surface beside others."""


def apart(segments: Segments, loops: Sequence[Loop]) -> list[tuple[int, int]]:
    """First and last keyframe of the segments that nothing ties to the scan's main piece.

    The main piece is the one that fixes place; without fixes, that with most points.
    """
    # Loads scipy.spatial, which a flight does without until its end.
    from scipy.cluster.hierarchy import DisjointSet

    known = [segment for segment in segments.with_surface() if not segment.is_false]
    pieces = DisjointSet([segment.number for segment in known])
    looped: set[int] = set()
    for loop in loops:
        a, b = (_segment_of(known, seq) for seq in loop.ends)
        if a is not None and b is not None:
            pieces.merge(a, b)
            looped |= {a, b}
    # Of those that fixes place, the sigma of the height there.
    heights = {s.number: s.frame.covariance[5, 5] ** 0.5 for s in known if s.rests_on_fixes}
    unsure = {number for number, sigma_m in heights.items() if sigma_m > HEIGHT_KNOWN_M}
    main_segment = segments.largest()
    of_any_size = {
        number
        for number in heights
        if segments[number] is not main_segment
        and segments[number].frame.sigma_scale >= SCALE_KNOWN
    }
    loose = {n for n in unsure if segments.sigma_height_m(n) >= HEIGHTS_AGREE_M} | of_any_size
    placed = {segment.number for segment in known if segment.is_fixed} - of_any_size
    fixed = [number for number in pieces if number in placed or number in heights.keys() - loose]
    for number in fixed[1:]:
        pieces.merge(fixed[0], number)
    if fixed:
        main = pieces.subset(fixed[0])
    else:
        main = max(
            pieces.subsets(), key=lambda p: sum(segments[n].points for n in p), default=set()
        )
    return [
        (segment.surface[0], segment.surface[-1])
        for segment in known
        # A long flight forgets loops, and not which segments they tied.
        if segment.number not in main
        and (segment.number in looped or segment.number in loose or not segment.is_tied)
    ]


def _segment_of(known: Sequence[Segment], seq: int) -> int | None:
    at = bisect_right(known, seq, key=lambda one: one.first) - 1
    return known[at].number if at >= 0 and seq <= known[at].surface[-1] else None
