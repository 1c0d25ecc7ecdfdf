"""How much depth images of the same ground disagree, relative to their sigmas.

Stereo measures its own noise (:func:`recon.stereo.reprojection.label_noise`). That a lens is not
quite as its model says, or that the poses a depth image was made with were off, tilts and bows the
whole image; only other images of the same ground show it, each where the map has it now: what the
odometry drifts by until a loop corrects it is no error of the map. What they disagree by is the
square root of the adjustment's variance factor (Mikhail and Ackermann, Observations and Least
Squares, 1976), and sigmas are multiplied by it.

The same images refute surface in free space: where stereo has one pair alone, nothing contradicts a
false match of it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from recon import se3
from recon.camera_model import rays
from recon.mapping.free_space import seen_through
from recon.mapping.voxel_map import sampled, shared
from recon.types import F32, F64, Bool, DepthMap, PointCloud

NORMAL_MEDIAN = 0.6745  # median of the absolute value of a normal variable of unit sigma
IMAGES = 32  # number of images that are kept
WIDTH_PX = 320  # of those that show what is free space, at most; at half their size or less
MIN_COMMON = 60  # minimum number of samples that two images share

NEIGHBOURS_CORRELATION = (0.55, 0.28)
"""Correlation of the errors of an image and of the one before it, and the one before that.

They share frames. Measured on simulated flights at three widths
(docs/reports/simulated-flights.md); three images apart it is 0."""

MIN_FACTOR, MAX_FACTOR = 0.75, 30.0
"""Errors that all images share show in no difference; a larger difference is other ground."""

MAX_REFUTED = 0.01  # of an image; more of it shows that its pose is false, not its depth


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
        self._shown: deque[tuple[int, DepthMap]] = deque(maxlen=IMAGES)

    def forget(self) -> None:
        """Forget earlier images: the new ones are of another segment."""
        self._earlier.clear()
        self._shown.clear()

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

    def refuted(self, seq: int, depth: DepthMap) -> Bool:
        """(h, w) pixels that one pair alone saw, where more pairs of the last images see through
        that place; the image is remembered. ``depth`` as in :meth:`take`, with its final sigma."""
        depth = replace(depth, T_world_camera=np.eye(4))
        *there, here = self._placed([*(one for one, _ in self._shown), seq])
        views = [
            replace(one, T_world_camera=np.linalg.solve(here, T))
            for (_, one), T in zip(self._shown, there, strict=True)
        ]
        self._shown.append((seq, _coarser(depth)))
        alone = depth.views == 1
        v, u = np.nonzero(alone)
        places = rays(depth.K, np.column_stack([u, v]).astype(np.float64))
        places *= depth.depth_m[alone, None]
        cloud = PointCloud(
            places.astype(np.float32), np.zeros((len(u), 3), np.uint8), depth.sigma_m[alone],
            depth.views[alone],
        )  # fmt: skip
        false = seen_through(cloud, [depth, *views], window_px=1)
        out = np.zeros(alone.shape, np.bool_)
        out[alone] = false & (np.count_nonzero(false) <= MAX_REFUTED * depth.depth_m.size)
        return out


def _coarser(depth: DepthMap) -> DepthMap:
    """Every second pixel of a depth, or fewer: a window of 3x3 of them is 5x5 of its own."""
    few = depth.every(max(2, -(-depth.depth_m.shape[1] // WIDTH_PX)))
    own = few.depth_m.copy(), few.sigma_m.copy(), few.views.copy()  # the whole depth may go
    return DepthMap(*own, few.K, few.T_world_camera)


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
