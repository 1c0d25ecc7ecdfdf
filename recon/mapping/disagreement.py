"""How much depth images of the same ground disagree, relative to their sigmas.

Stereo measures its own noise (:func:`recon.stereo.reprojection.label_noise`). That a lens is not
quite as its model says, or that the poses a depth image was made with were off, tilts and bows the
whole image; only other images of the same ground show it, each where the map has it now: what the
odometry drifts by until a loop corrects it is no error of the map. What they disagree by is the
square root of the adjustment's variance factor (Mikhail and Ackermann, Observations and Least
Squares, 1976), and sigmas are multiplied by it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from recon import se3
from recon.mapping.voxel_map import sampled, shared
from recon.types import F32, F64, Bool, DepthMap

NORMAL_MEDIAN = 0.6745  # median of the absolute value of a normal variable of unit sigma
IMAGES = 32  # number of images that are kept
MIN_COMMON = 60  # minimum number of samples that two images share

NEIGHBOURS_CORRELATION = (0.55, 0.28)
"""Correlation of the errors of an image and of the one before it, and the one before that.

They share frames. Measured on simulated flights at three widths
(docs/reports/simulated-flights.md); three images apart it is 0."""

MIN_FACTOR, MAX_FACTOR = 0.75, 30.0
"""Errors that all images share show in no difference; a larger difference is other ground."""


@dataclass(frozen=True, slots=True, eq=False)
class _Samples:
    """Some surface of an earlier depth image, in units of the odometry."""

    seq: int
    points: F32  # (N, 3) in its camera
    sigma: F32  # (N,) along its own z
    is_sure: Bool  # (N,) seen by two pairs or more


class Disagreement:
    """Compares each new depth image with the last ones, where the map has them now."""

    def __init__(self, placed: Callable[[Sequence[int]], F64]) -> None:
        """``placed`` as :meth:`recon.posegraph.trajectory.Trajectory.similarities`."""
        self._placed = placed
        self._earlier: deque[_Samples] = deque(maxlen=IMAGES)

    def forget(self) -> None:
        """Forget earlier images: the new ones are of another segment."""
        self._earlier.clear()

    def take(self, seq: int, depth: DepthMap) -> float:
        """The factor that the new image's sigmas are to be multiplied by; it is remembered.

        1 where nothing earlier shows its ground. Sigmas of the image and of those before it
        count as equally wrong: it is the root mean square over the earlier images of the robust
        normalised difference, less what their errors have in common. Points that one pair alone
        saw take part where there are too few others. ``depth`` is in units of the odometry.
        """
        depth = replace(depth, T_world_camera=np.eye(4))
        *there, here = self._placed([*(one.seq for one in self._earlier), seq])
        common = (*NEIGHBOURS_CORRELATION, *[0.0] * IMAGES)
        found = [
            (_apart(depth, one, np.linalg.solve(here, T)), np.sqrt(1.0 - rho))
            for one, T, rho in zip(reversed(self._earlier), reversed(there), common, strict=False)
        ]
        ratios = [ratio / differing for ratio, differing in found if ratio is not None]
        self._earlier.append(_samples(seq, depth))
        if not ratios:
            return 1.0
        factor = float(np.sqrt(np.mean(np.square(ratios))))
        return float(np.clip(factor, MIN_FACTOR, MAX_FACTOR))


def _apart(depth: DepthMap, one: _Samples, T_here_there: F64) -> float | None:
    """Robust normalised difference along z; None with too little in common."""
    here = se3.transform(T_here_there, one.points.astype(np.float64))
    which, (v, u), there = shared(depth, here.astype(np.float32))
    sure = (depth.views[v, u] >= 2) & one.is_sure[which]
    if np.count_nonzero(sure) >= MIN_COMMON:
        which, v, u, there = which[sure], v[sure], u[sure], there[sure]
    if len(which) < MIN_COMMON:
        return None
    growth = np.linalg.norm(T_here_there[:3, 0])
    off = np.abs(there - depth.depth_m[v, u])
    off /= np.hypot(growth * one.sigma[which], depth.sigma_m[v, u])
    return float(np.median(off)) / NORMAL_MEDIAN


def _samples(seq: int, depth: DepthMap) -> _Samples:
    """The surface at every so many pixels of a depth in its camera."""
    at, points = sampled(depth)
    sigma = np.asarray(depth.sigma_m[at], np.float32)
    return _Samples(seq, points.astype(np.float32), sigma, depth.views[at] >= 2)
