"""Which segments of a flight are one map, and which are apart."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Sequence

import numpy as np

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
    known = [segment for segment in segments.with_surface() if not segment.is_false]
    piece = {segment.number: segment.number for segment in known}
    looped: set[int] = set()
    for loop in loops:
        a, b = (_segment_of(known, seq) for seq in loop.ends)
        if a is not None and b is not None:
            _join(piece, a, b)
            looped |= {a, b}
    heights = {s.number: sigma for s in known if (sigma := _sigma_height_m(s)) is not None}
    unsure = {number for number, sigma in heights.items() if sigma > HEIGHT_KNOWN_M}
    main_segment = segments.largest()
    of_any_size = {
        number
        for number in heights
        if segments[number] is not main_segment
        and segments[number].frame.sigma_scale >= SCALE_KNOWN
    }
    loose = {number for number in unsure if not _agrees(segments, number)} | of_any_size
    placed = {segment.number for segment in known if segment.is_fixed} - of_any_size
    fixed = [number for number in piece if number in placed or number in heights.keys() - loose]
    for number in fixed[1:]:
        _join(piece, fixed[0], number)
    if fixed:
        main = piece[fixed[0]]
    else:
        sizes: Counter[int] = Counter()
        for segment in known:
            sizes[piece[segment.number]] += segment.points
        main = sizes.most_common(1)[0][0] if sizes else -1
    return [
        (segment.surface[0], segment.surface[-1])
        for segment in known
        # A long flight forgets loops, and not which segments they tied.
        if piece[segment.number] != main
        and (segment.number in looped or segment.number in loose or not segment.is_tied)
    ]


def _segment_of(known: Sequence[Segment], seq: int) -> int | None:
    at = bisect_right(known, seq, key=lambda one: one.first) - 1
    return known[at].number if at >= 0 and seq <= known[at].surface[-1] else None


def _sigma_height_m(segment: Segment) -> float | None:
    """Sigma of the height at which fixes place a segment; None where they do not."""
    found = segment.similarity
    if found is None or "gnss" not in found.sources:
        return None
    return float(np.sqrt(found.covariance[5, 5]))


def _agrees(segments: Segments, number: int) -> bool:
    """True when the height is known against the largest segment's: what all fixes of a flight err
    by lays none on another."""
    sigma_m = segments.sigma_height_m(number)
    return sigma_m is not None and sigma_m < HEIGHTS_AGREE_M


def _join(piece: dict[int, int], a: int, b: int) -> None:
    """Make one piece of those that segments ``a`` and ``b`` are in."""
    old, new = piece[b], piece[a]
    for number, name in piece.items():
        if name == old:
            piece[number] = new
