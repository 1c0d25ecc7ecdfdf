"""Rotations of whole flights at once: arrays of quaternions (w x y z, unit)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from mavlink.quaternion import Quaternion

F64 = npt.NDArray[np.float64]
Bool = npt.NDArray[np.bool_]

LONGEST_GAP_S = 0.25
"""Attitudes further apart say nothing of what was between them."""

FINER = 4
"""Steps from one attitude to the next."""


class Attitudes:
    """A flight's attitudes, to be asked for the turn between any two instants."""

    def __init__(self, samples: Sequence[tuple[int, Quaternion]]) -> None:
        """``samples`` are (time in ns, ``q_ned_body``), oldest first; two at least.

        They are averaged over the time between two of them: noise would otherwise be least
        half-way between two samples, and draw every comparison there.
        """
        self.base_ns = samples[0][0]
        times_s: F64 = np.array([(t - self.base_ns) * 1e-9 for t, _ in samples])
        q: F64 = np.array([q for _, q in samples], np.float64)
        flips = np.where(np.einsum("ij,ij->i", q[1:], q[:-1]) < 0.0, -1.0, 1.0)
        q[1:] *= np.cumprod(flips)[:, None]  # neighbours on the same side, so they can be mixed
        self.spacing_s = float(np.median(np.diff(times_s)))
        self._step_s = max(self.spacing_s / FINER, 1e-3)
        self._grid_s = np.arange(0.0, times_s[-1] + self._step_s, self._step_s)
        fine, known = _between(times_s, q, self._grid_s)
        weights = np.concatenate([[0.5], np.ones(FINER - 1), [0.5]]) / FINER
        self._q = np.stack([np.convolve(fine[:, k], weights, "same") for k in range(4)], axis=1)
        self._known: Bool = np.convolve(known, weights, "same") > 0.999

    @property
    def first_s(self) -> float:
        """Time of the oldest."""
        return float(self._grid_s[0])

    @property
    def last_s(self) -> float:
        """Time of the newest."""
        return float(self._grid_s[-1])

    def turns(self, start_s: F64, end_s: F64) -> tuple[F64, Bool]:
        """((N, 3) rotation vectors in rad in the axes at the start, (N,) where they are known).

        Times are seconds since ``base_ns``.
        """
        first, ok_first = self._at(start_s)
        second, ok_second = self._at(end_s)
        return rotation_vectors(multiply(conjugate(first), second)), ok_first & ok_second

    def _at(self, time_s: F64) -> tuple[F64, Bool]:
        """(N, 4) attitudes at instants, and where samples are near enough."""
        i = np.searchsorted(self._grid_s, time_s, "right")
        inside = (i > 0) & (i < len(self._grid_s))
        i = np.clip(i, 1, len(self._grid_s) - 1)
        u = np.clip((time_s - self._grid_s[i - 1]) / self._step_s, 0.0, 1.0)[:, None]
        q = (1.0 - u) * self._q[i - 1] + u * self._q[i]
        known = inside & self._known[i - 1] & self._known[i]
        return q / np.linalg.norm(q, axis=1, keepdims=True), known


def _between(times_s: F64, q: F64, at_s: F64) -> tuple[F64, Bool]:
    """(N, 4) attitudes on straight lines between samples, and where samples are near enough.

    Between samples so near a straight line is a slerp to a thousandth of the turn.
    """
    i = np.clip(np.searchsorted(times_s, at_s, "right"), 1, len(times_s) - 1)
    gap = times_s[i] - times_s[i - 1]
    u = (at_s - times_s[i - 1]) / np.maximum(gap, 1e-9)
    mixed = q[i - 1] + np.clip(u, 0.0, 1.0)[:, None] * (q[i] - q[i - 1])
    return mixed, (u > -1e-9) & (u < 1.0 + 1e-9) & (gap < LONGEST_GAP_S)


def conjugate(q: F64) -> F64:
    """(N, 4) the opposite rotations."""
    return np.asarray(q * np.array([1.0, -1.0, -1.0, -1.0]))


def multiply(a: F64, b: F64) -> F64:
    """(N, 4) rotations: b first, then a."""
    w, v = a[:, :1], a[:, 1:]
    p, r = b[:, :1], b[:, 1:]
    scalar = w * p - np.einsum("ij,ij->i", v, r)[:, None]
    return np.concatenate([scalar, w * r + p * v + np.cross(v, r)], axis=1)


def rotation_vectors(q: F64) -> F64:
    """(N, 3) axis times angle in rad, the shorter way round."""
    q = np.where(q[:, :1] < 0.0, -q, q)
    length = np.linalg.norm(q[:, 1:], axis=1)
    angle = 2.0 * np.arctan2(length, q[:, 0])
    scale = np.where(length > 1e-12, angle / np.maximum(length, 1e-12), 2.0)
    return np.asarray(q[:, 1:] * scale[:, None])


def best_rotation(source: F64, target: F64) -> F64:
    """(3, 3) rotation R with ``target ~ R source`` for (N, 3) vectors.

    Kabsch, DOI 10.1107/S0567739476001873.
    """
    u, _, vt = np.linalg.svd(target.T @ source)
    turn = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt)) or 1.0])
    return np.asarray(u @ turn @ vt)
