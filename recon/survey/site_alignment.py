"""Several scans of one site moved onto each other: one similarity each, all at once.

The errors of one flight's receiver, heading and scale are nearly the same all along it, so one
motion and one scale per scan explains most of the disagreement of two scans. Ties are places that
both scans have; the receivers' claimed sigmas are the prior, so the mean of several flights is
better placed than each. Gauss-Newton with Cauchy weights (Barfoot 2017, ch. 5.3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from recon import se3
from recon.similarity import Similarity, lever
from recon.types import F64, Bool

STEPS = 12  # Gauss-Newton steps, each with new robust weights
CAUCHY_SIGMAS = 2.0  # sigmas of a tie's error, per component, beyond which it loses weight
ALIKE = 5.0  # sigmas of place within this factor may be of receivers that are equally good
UNKNOWNS = 7  # unknowns of a scan: rotation vector, shift of its centre, logarithm of the scale


@dataclass(frozen=True, slots=True, eq=False)
class Tie:
    """Places of the ground as two scans have them, each in site coordinates before alignment."""

    a: int  # number of a scan
    b: int
    at_a: F64  # (P, 3) m
    at_b: F64  # (P, 3) m
    covariance: F64  # (P, 3, 3) m2, of at_a - at_b; it turns and grows with the scans


def alike(sigma: F64) -> F64:
    """The sigmas (S, 7) of the scans' own placing, those of place as like receivers share them.

    A flight shows its receiver's error by a few independent fixes only, so equal receivers get
    sigmas that differ several times, and a lucky one would place the whole site. None is taken to
    be better than the rms of all, unless it is ALIKE times better.
    """
    own = sigma[:, 3:6]
    out: F64 = sigma.copy()
    usual = np.sqrt((own**2).mean(axis=0))
    out[:, 3:6] = np.where(own * ALIKE > usual, np.maximum(own, usual), own)
    return out


@dataclass(frozen=True, slots=True, eq=False)
class SiteAlignment:
    """Where all scans go, and how sure that is."""

    moves: list[Similarity]
    covariance: F64  # (7 S, 7 S) of the unknowns
    before_m: F64  # (T,) distance of the two ends of each tie
    after_m: F64  # (T,)
    used: Bool  # (T,) ties within five sigmas afterwards
    factor: float  # errors of the used ties over their sigmas, rms, at least 1
    groups: list[int]  # (S,) scans that ties join have one number


def align(ties: Sequence[Tie], centres_m: F64, sigma: F64) -> SiteAlignment:
    """The alignment of S scans. A scan without ties stays. Each turns and grows about its centre
    (S, 3); its own poses place it to a ``sigma`` (S, 7) in rad, m and share."""
    n = len(centres_m)
    moves = [Similarity(1.0, np.eye(3), np.zeros(3)) for _ in centres_m]
    before = _errors(ties, moves)
    state = np.zeros((n, UNKNOWNS))
    for _ in range(STEPS):
        H, g = _equations(ties, centres_m, sigma, state)
        step: F64 = np.asarray(-np.linalg.solve(H, g).reshape(n, UNKNOWNS), np.float64)
        state = np.array([_moved(x, d) for x, d in zip(state, step, strict=True)])
        if np.abs(step).max() < 1e-9:
            break
    moves = [_similarity(x, centre) for x, centre in zip(state, centres_m, strict=True)]
    after = _errors(ties, moves)
    size = np.array([_size(e, t) for e, t in zip(after, ties, strict=True)])
    used = size < 5.0
    factor = max(1.0, float(np.sqrt(np.mean(size[used] ** 2)))) if used.any() else 1.0
    H, _ = _equations(ties, centres_m, sigma, state)
    covariance = np.asarray(factor**2 * np.linalg.inv(H), np.float64)
    return SiteAlignment(
        moves, covariance, _lengths(before), _lengths(after), used, factor,
        _groups(n, [t for t, ok in zip(ties, used, strict=True) if ok]),
    )  # fmt: skip


def _equations(ties: Sequence[Tie], centres_m: F64, sigma: F64, state: F64) -> tuple[F64, F64]:
    """Normal equations (7 S, 7 S) and gradient (7 S,) at ``state`` (S, 7)."""
    information = (1.0 / sigma**2).ravel()
    H, g = np.diag(information), information * state.ravel()
    moves = [_similarity(x, centre) for x, centre in zip(state, centres_m, strict=True)]
    for tie, error in zip(ties, _errors(ties, moves), strict=True):
        weight = 1.0 / (1.0 + (_size(error, tie) / CAUCHY_SIGMAS) ** 2)
        W = weight * np.linalg.inv(tie.covariance)
        sides, R = np.zeros((len(error), 3, 2, UNKNOWNS)), moves[tie.a].R
        ends = ((tie.a, tie.at_a, 1.0), (tie.b, tie.at_b, -1.0))
        for side, (scan, points, sign) in enumerate(ends):
            centre = centres_m[scan] + state[scan, 3:6]
            moved = lever(moves[scan].points(points) - centre)
            sides[:, :, side] = sign * R.T @ moved / _unit(tie, moves)
            sides[:, :, side, 6] -= 0.5 * error
        sides[:, :, 0, :3] += R.T @ se3.hat(error @ R.T)
        J = sides.reshape(len(error), 3, 2 * UNKNOWNS)
        rows = np.concatenate([UNKNOWNS * s + np.arange(UNKNOWNS) for s in (tie.a, tie.b)])
        H[np.ix_(rows, rows)] += np.einsum("pki,pkl,plj->ij", J, W, J)
        g[rows] += np.einsum("pki,pkl,pl->i", J, W, error)
    return H, g


def _moved(x: F64, step: F64) -> F64:
    turn = se3.so3_log(se3.so3_exp(step[:3]) @ se3.so3_exp(x[:3]))
    return np.concatenate([turn, x[3:] + step[3:]])


def _similarity(x: F64, centre_m: F64) -> Similarity:
    scale, R = float(np.exp(x[6])), se3.so3_exp(x[:3])
    return Similarity(scale, R, centre_m + x[3:6] - scale * R @ centre_m)


def _errors(ties: Sequence[Tie], moves: Sequence[Similarity]) -> list[F64]:
    """(P, 3) of each tie, along the first scan's axes, which are those of its covariance: it does
    not fall because everything turns to where ties are less sure."""
    return [
        (moves[t.a].points(t.at_a) - moves[t.b].points(t.at_b)) @ moves[t.a].R / _unit(t, moves)
        for t in ties
    ]


def _unit(tie: Tie, moves: Sequence[Similarity]) -> float:
    """Growth of both scans: in its units the error does not fall because everything shrinks."""
    return float(np.sqrt(moves[tie.a].scale * moves[tie.b].scale))


def _lengths(errors: Sequence[F64]) -> F64:
    return np.array([float(np.median(np.linalg.norm(e, axis=1))) for e in errors])


def _size(error: F64, tie: Tie) -> float:
    """Rms of the numbers of an error, in sigmas."""
    whitened = np.einsum("pi,pij,pj->p", error, np.linalg.inv(tie.covariance), error)
    return float(np.sqrt(np.mean(whitened) / 3.0))


def _groups(n: int, ties: Sequence[Tie]) -> list[int]:
    """(n,) the smallest scan number that ties lead to."""
    out = list(range(n))
    for _ in range(n):
        for tie in ties:
            out[tie.a] = out[tie.b] = min(out[tie.a], out[tie.b])
    return out
