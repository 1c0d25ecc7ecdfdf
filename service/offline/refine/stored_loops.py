"""The search for loops among all keyframes of a finished scan.

A kept keyframe holds only surface that was new. Each is filled from its neighbours on the same
stretch, and verified against every earlier one that sees the same ground.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
from scipy.spatial import cKDTree

from recon import se3
from recon.posegraph.ground_control import Closure, Track
from recon.posegraph.loop_closure import LoopConfig, LoopView, candidates, ground_seen
from recon.posegraph.submap_loops import SubmapLoopConfig, filled, verify_surfaces
from recon.types import F64, Keyframe
from service.progress import Progress

NEIGHBOURS = 8
"""Keyframes before and after that fill a keyframe's view, at most. Those of the two ends of a
loop never overlap: one surface at both ends would only confirm the track."""

BREAK_S = 10.0
"""A longer pause between keyframes ends a stretch."""

LOOPS_PER_KEYFRAME, TRIES = 2, 5
"""Loops that end in one keyframe, and verifications for them, at most."""

TELLING = 2.0
"""Loops less sure by this factor than the surest give no step between their ends."""

LOOP_SCALE = 0.005
"""Sigma of a loop's length, as a share of it, from the scale of the depths that gave it."""


class StoredLoops:
    """Finds loops; keyframes are numbered by their place on the track."""

    def __init__(
        self,
        track: Track,
        keyframe: Callable[[int], Keyframe | None],
        config: SubmapLoopConfig,
        scans: Sequence[int] | None = None,
    ) -> None:
        """``keyframe`` gives each one with its depth at its pose on the track.

        With ``scans``, the number of each keyframe's scan, only loops between scans are sought.
        """
        self._track, self._keyframe, self._config = track, keyframe, config
        self._scans = scans
        self._breaks = np.cumsum(np.diff(track.times_s, prepend=track.times_s[0]) > BREAK_S)
        self._view = lru_cache(maxsize=96)(self._filled)

    def find(self, progress: Progress | None = None) -> list[Closure]:
        """All pairs far apart in time that see the same place, verified."""
        tree = cKDTree(self._track.poses[:, :2, 3])
        out = []
        later = range(self._config.min_gap, len(self._track.poses))
        for b in (progress or Progress()).over(later, len(later)):
            likely = self._likely(b, tree)
            found = 0
            for a in likely[:TRIES]:
                closure = self._verified(a, b)
                if closure is not None:
                    out.append(closure)
                    found += 1
                if found == LOOPS_PER_KEYFRAME:
                    break
        return [replace(one, covariance=_alike(one, out) * one.covariance) for one in out]

    def _likely(self, b: int, tree: cKDTree) -> list[int]:
        """Earlier keyframes that see what ``b`` sees, best first; few are worth a look."""
        poses, own = self._track.poses, self._keyframe(b)
        if own is None or not np.isfinite(own.depth.depth_m).any():
            return []
        depth_m = float(np.nanmedian(own.depth.depth_m))
        near = tree.query_ball_point(poses[b, :2, 3], 2.0 * depth_m)
        earlier = sorted(a for a in near if a <= b - self._config.min_gap and self._wanted(a, b))
        view = self._view(b, NEIGHBOURS) if earlier else None
        if view is None:
            return []
        h, w = view.depth.depth_m.shape
        some = {a: poses[a] for a in (*earlier, b)}
        options = LoopConfig(min_gap=1, min_overlap=self._config.min_overlap)
        ground = ground_seen(view.depth)
        return [a for a, _ in candidates(some, b, view.K, (w, h), ground, options)]

    def _wanted(self, a: int, b: int) -> bool:
        return self._scans is None or self._scans[a] != self._scans[b]

    def _verified(self, a: int, b: int) -> Closure | None:
        reach = self._reach(a, b)
        one, two = self._view(a, reach), self._view(b, reach)
        if one is None or two is None:
            return None
        guess = se3.inverse(self._track.poses[a]) @ self._track.poses[b]
        found = verify_surfaces(one, two, guess, self._config)
        if found is None:
            return None
        return Closure(a, b, found.T_a_b, loose(found.T_a_b, found.covariance))

    def _reach(self, a: int, b: int) -> int:
        """Neighbours to fill each of two views with, so that they share none."""
        if self._breaks[a] != self._breaks[b]:
            return NEIGHBOURS
        return next((n for n in (NEIGHBOURS, NEIGHBOURS // 2, 2, 1) if 2 * n < b - a), 0)

    def _filled(self, k: int, reach: int) -> LoopView | None:
        """A keyframe with what ``reach`` neighbours add; None without any surface."""
        own = self._at(k)
        if own is None:
            return None
        last = len(self._track.poses) - 1
        nearby = range(max(k - reach, 0), min(k + reach, last) + 1)
        others = [self._at(j) for j in nearby if j != k and self._breaks[j] == self._breaks[k]]
        whole = filled(own, [one for one in others if one is not None])
        gray = np.asarray(cv2.cvtColor(whole.bgr, cv2.COLOR_BGR2GRAY), np.uint8)
        return LoopView(gray, whole.depth.K, whole.depth)

    def _at(self, k: int) -> Keyframe | None:
        """A keyframe with any surface."""
        found = self._keyframe(k)
        return found if found is not None and np.isfinite(found.depth.depth_m).any() else None


def _alike(one: Closure, loops: Sequence[Closure]) -> int:
    """Loops that rest on the same filled surfaces as ``one``, itself included: they err alike."""
    return sum(abs(one.a - x.a) <= NEIGHBOURS and abs(one.b - x.b) <= NEIGHBOURS for x in loops)


def loose(T_a_b: F64, covariance: F64) -> F64:
    """(6, 6) covariance of a loop whose length is that of depths, which err together."""
    out: F64 = covariance.copy()
    out[3:, 3:] += LOOP_SCALE**2 * np.outer(T_a_b[:3, 3], T_a_b[:3, 3])
    return out


def steps_m(loops: Sequence[Closure], poses: F64, scales: F64, ahead_m: float) -> F64:
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
