"""The search for loops among all keyframes of a finished scan.

A kept keyframe holds only surface that was new. Each is filled from its neighbours on the same
stretch, and verified against every earlier one that sees the same ground.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import islice

import cv2
import numpy as np
from scipy.spatial import cKDTree

from recon import se3
from recon.posegraph.loop_closure import LoopEnd, candidates, ground_seen
from recon.posegraph.records import Loop
from recon.survey.ground_control import KeyframeTrack
from recon.survey.submap_loops import filled, verify_surfaces
from recon.types import F64, Keyframe
from service.progress import Progress

NEIGHBOURS = 8
"""Keyframes before and after that fill a keyframe's view, at most. Those of the two ends of a
loop never overlap: one surface at both ends would only confirm the track."""

BREAK_S = 10.0
"""A longer pause between keyframes ends a stretch."""

MIN_GAP, MIN_OVERLAP = 10, 0.2
"""Keyframes between the two ends of a loop, and how much of the later view must lie in the earlier
one."""

LOOPS_PER_KEYFRAME, TRIES = 2, 5
"""Loops between one keyframe and another scan, or its own, and verifications for them, at most."""

TELLING = 2.0
"""Loops less sure by this factor than the surest give no step between their ends."""

LOOP_SCALE = 0.005
"""Sigma of a loop's length, as a share of it, from the scale of the depths that gave it."""


class LoopEnds:
    """Keyframes of one track, each filled with what its neighbours on the same stretch add."""

    def __init__(
        self, keyframe: Callable[[int], Keyframe | None], stretches: Sequence[int], held: int = 96
    ) -> None:
        """``stretches`` has the number of each keyframe's stretch; it may grow."""
        self.stretches = stretches
        self._keyframe = keyframe
        self._view = lru_cache(maxsize=held)(self._filled)

    def end(self, k: int, reach: int = NEIGHBOURS) -> LoopEnd | None:
        """A keyframe with what ``reach`` neighbours on each side add; None without any surface."""
        return self._view(k, max(k - reach, 0), min(k + reach + 1, len(self.stretches)))

    def at(self, k: int) -> Keyframe | None:
        """A keyframe with any surface."""
        found = self._keyframe(k)
        return found if found is not None and np.isfinite(found.depth.depth_m).any() else None

    def _filled(self, k: int, first: int, end: int) -> LoopEnd | None:
        own = self.at(k)
        if own is None:
            return None
        nearby = (j for j in range(first, end) if self.stretches[j] == self.stretches[k] and j != k)
        others = [self.at(j) for j in nearby]
        whole = filled(own, [one for one in others if one is not None])
        gray = np.asarray(cv2.cvtColor(whole.bgr, cv2.COLOR_BGR2GRAY), np.uint8)
        return LoopEnd(gray, whole.depth.K, whole.depth)


def likely(end: LoopEnd, poses: Mapping[int, F64]) -> list[int]:
    """Numbers of the ``poses`` that see what ``end``, of the last of them, sees, best first; few
    are worth a look."""
    size_px = end.depth.depth_m.shape[::-1]
    found = candidates(poses, end.K, size_px, ground_seen(end.depth), MIN_OVERLAP)
    return [a for a, _ in found[:TRIES]]


def verified(
    a: int, b: int, ends: tuple[LoopEnd | None, LoopEnd | None], guess: F64
) -> Loop | None:
    """The loop between the keyframes ``a`` and ``b``, by what they see."""
    if ends[0] is None or ends[1] is None:
        return None
    found = verify_surfaces(ends[0], ends[1], guess)
    if found is None:
        return None
    T_a_b, covariance, growth = found
    return Loop(a, b, T_a_b, loose(T_a_b, covariance), growth)


def stored_loops(
    track: KeyframeTrack,
    keyframe: Callable[[int], Keyframe | None],
    progress: Progress | None = None,
    scans: Sequence[int] | None = None,
    min_gap: int = MIN_GAP,
) -> list[Loop]:
    """All pairs of keyframes far apart in time that see the same place, verified; by their places
    on the track.

    ``keyframe`` gives each one with its depth at its pose on the track. With ``scans``, the number
    of each keyframe's scan, only loops between scans are sought.
    """
    pauses = np.diff(track.times_s, prepend=track.times_s[0])
    ends = LoopEnds(keyframe, np.cumsum(pauses > BREAK_S).tolist())
    tree = cKDTree(track.poses[:, :2, 3])

    def verified_at(a: int, b: int) -> Loop | None:
        reach = NEIGHBOURS  # to fill each of two views with, so that they share none
        if ends.stretches[a] == ends.stretches[b]:
            reach = next((n for n in (NEIGHBOURS, NEIGHBOURS // 2, 2, 1) if 2 * n < b - a), 0)
        guess = se3.inverse(track.poses[a]) @ track.poses[b]
        return verified(a, b, (ends.end(a, reach), ends.end(b, reach)), guess)

    out: list[Loop] = []
    later = range(min_gap, len(track.poses))
    for b in (progress or Progress()).over(later, len(later)):
        own = ends.at(b)
        if own is None:
            continue
        groups: dict[int, list[int]] = {}  # earlier keyframes near it, of each scan
        for a in sorted(tree.query_ball_point(track.poses[b, :2, 3], reach_m(own))):
            if a <= b - min_gap and (scans is None or scans[a] != scans[b]):
                groups.setdefault(0 if scans is None else scans[a], []).append(a)
        end = ends.end(b) if groups else None
        if end is None:
            continue
        for _, group in sorted(groups.items()):
            poses = {a: track.poses[a] for a in (*group, b)}
            found = (verified_at(a, b) for a in likely(end, poses))
            out += islice(filter(None, found), LOOPS_PER_KEYFRAME)
    return weighted(out)


def reach_m(one: Keyframe) -> float:
    """Between two cameras that may see the same ground."""
    return 2.0 * float(np.nanmedian(one.depth.depth_m))


def weighted(loops: Sequence[Loop]) -> list[Loop]:
    """The loops, less sure where several rest on the same filled surfaces: they err alike."""
    ends = np.array([(one.a, one.b) for one in loops]).reshape(-1, 2)
    near = [int((np.abs(ends - end).max(axis=1) <= NEIGHBOURS).sum()) for end in ends]
    return [replace(o, covariance=n * o.covariance) for o, n in zip(loops, near, strict=True)]


def loose(T_a_b: F64, covariance: F64) -> F64:
    """(6, 6) covariance of a loop whose length is that of depths, which err together."""
    out: F64 = covariance.copy()
    out[3:, 3:] += LOOP_SCALE**2 * np.outer(T_a_b[:3, 3], T_a_b[:3, 3])
    return out


def steps_m(loops: Sequence[Loop], poses: F64, scales: F64, ahead_m: float) -> F64:
    """(n,) metres between where the two ends of a loop have the same ground.

    The ground is taken ``ahead_m`` before the later camera; the loop's own length grows with
    the scale there. It follows from the loops that are surest of it; others are left out.
    """
    spot, sigma, steps = np.array([[0.0, 0.0, ahead_m]]), [], []
    for loop in loops:
        here = se3.transform(loop.T_a_b, spot)[0]
        sigma.append(se3.sigma_at(here, loop.covariance))
        seen = loop.T_a_b.copy()
        seen[:3, 3] *= scales[loop.a]
        there = se3.inverse(poses[loop.a]) @ poses[loop.b]
        apart = se3.transform(seen, spot) - se3.transform(there, spot)
        steps.append(float(np.linalg.norm(apart)))
    sure = np.array(sigma) <= TELLING * min(sigma, default=0.0)
    return np.array(steps)[sure]
