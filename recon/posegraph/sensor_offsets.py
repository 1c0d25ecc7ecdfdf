"""Constant difference of each sensor from the similarity that places a segment.

The similarity weighs the sensors against each other over the whole segment. The constant rotation,
scale or shift that remains of each sensor is settled by that; only variation along the track may
bend it. So the constants are removed from the readings before they enter the graph.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from recon import se3
from recon.posegraph.alignment import EXACT_HEIGHTS, Anchor, Similarity, height_ratios
from recon.posegraph.altitude_datum import AltitudeDatum, altitude_datum
from recon.posegraph.boresight import Boresight, Turns, boresight
from recon.types import F64, PosePrior

PRIOR_SIGMA = 0.1
"""rad and share; how far fixes may be turned and stretched against the frame."""

NEAR_SIGMAS = 5.0
"""Fixes further from the track, or attitudes from their median, are no part of a constant."""


NOTABLE_M, NOTABLE_RAD = 0.1, 0.003
"""Changes of the constants of a whole flight that the map must follow."""


@dataclass(frozen=True, slots=True, eq=False)
class Constants:
    """Constants of a whole flight, whatever becomes of the track."""

    datum: AltitudeDatum = field(default_factory=AltitudeDatum)
    boresight: Boresight = field(default_factory=Boresight)

    def applied(self, prior: PosePrior) -> PosePrior:
        """The prior without them."""
        return self.boresight.applied(self.datum.applied(prior))

    def differ(self, other: Constants) -> bool:
        """True when the other's would notably move the map."""
        raised = abs(self.datum.shift_m - other.datum.shift_m) > NOTABLE_M
        turn, before = (b.turn * b.is_sure for b in (self.boresight, other.boresight))
        turned = float(np.abs(turn - before).max()) > NOTABLE_RAD
        return raised or turned


def constants(
    stretches: Sequence[tuple[Sequence[F64], Sequence[PosePrior]]],
    span_s: float,
    fix_s: float = 60.0,
    attitude_s: float = 40.0,
) -> Constants:
    """Those of a flight of ``span_s`` from poses (4, 4) and priors, segment by segment.

    ``fix_s`` and ``attitude_s`` are the time constants with which the sensors wander.
    """
    turns = [t for poses, priors in stretches if (t := Turns.of(poses, priors)) is not None]
    every = [prior for _, priors in stretches for prior in priors]
    return Constants(altitude_datum(every, span_s, fix_s), boresight(turns, span_s, attitude_s))


@dataclass(frozen=True, slots=True, eq=False)
class Offsets:
    """Constants of one segment's sensors against its frame."""

    turn: F64 = field(default_factory=lambda: np.zeros(3))  # rad, takes attitudes to the frame
    log_height: float = 0.0  # log of the frame's scale over that of the heights
    centre_m: F64 = field(default_factory=lambda: np.zeros(3))  # of the fixes
    shift_m: F64 = field(default_factory=lambda: np.zeros(3))  # takes fixes to the frame
    warp: F64 = field(default_factory=lambda: np.zeros((3, 3)))  # likewise, per metre off centre
    reach_m: float = 0.0  # off centre to which the warp is known; it grows no further
    is_exact: bool = False  # only heights of the ground exactly below count

    def applied(self, prior: PosePrior, lean: float) -> PosePrior:
        """The prior's attitude, position and height without their constants.

        ``lean`` is that of the ground whose height vision measures.
        """
        R, position, agl = prior.R_world_camera, prior.position_m, prior.agl_m
        if R is not None:
            R = se3.so3_exp(self.turn) @ R
        if position is not None:
            off = position - self.centre_m
            off = off * min(1.0, self.reach_m / max(float(np.linalg.norm(off)), 1e-9))
            position = position + self.shift_m + self.warp @ off
        if agl is not None and self.is_exact and lean > 0.0:
            agl = None
        elif agl is not None:
            agl = agl * float(np.exp(self.log_height))
        return replace(prior, R_world_camera=R, position_m=position, agl_m=agl)


def offsets(anchors: Sequence[Anchor], frame: Similarity) -> Offsets:
    """The constants of all sensors over the anchors of one segment, robustly."""
    ratios, independent = height_ratios(anchors)
    is_exact = independent == EXACT_HEIGHTS
    log_height = 0.0
    if ratios:
        mean = np.average([r[0] for r in ratios], weights=[r[1] ** -2 for r in ratios])
        log_height = float(np.log(frame.scale) - mean)
    return Offsets(_turn(anchors, frame), log_height, *_fixes(anchors, frame), is_exact)


def _turn(anchors: Sequence[Anchor], frame: Similarity) -> F64:
    """(3,) mean rotation from the attitudes to the frame; its heading only if they have one."""
    turns, sigma = [], []
    for a in anchors:
        R = a.prior.R_world_camera
        if R is None:
            continue
        seen = frame.R @ a.T_odom_camera[:3, :3]
        sigma.append([a.prior.sigma_tilt_rad] * 2 + [a.prior.sigma_yaw_rad])
        if a.prior.sigma_yaw_rad < 1.0:
            turns.append(se3.so3_log(seen @ R.T))
        else:
            up = seen @ R[2]  # where the reading's up points now
            turns.append(np.array([-up[1], up[0], 0.0]))
    if not turns:
        return np.zeros(3)
    apart = np.abs(np.array(turns) - np.median(turns, axis=0))
    near = np.all(apart < NEAR_SIGMAS * np.array(sigma), axis=1)
    if not near.any():
        return np.zeros(3)
    turn = np.asarray(np.mean(np.array(turns)[near], axis=0), np.float64)
    # A sensor that is far off is a fault for the gates to find, not an offset to take out.
    return turn if np.linalg.norm(turn) < 2.0 * PRIOR_SIGMA else np.zeros(3)


def _fixes(anchors: Sequence[Anchor], frame: Similarity) -> tuple[F64, F64, F64, float]:
    """Centre, shift, warp (3, 3) and reach of the fixes, turned and stretched about the centre."""
    nothing = np.zeros(3), np.zeros(3), np.zeros((3, 3)), 0.0
    rows = [
        (frame.place(a.place_of_fix), a.prior.position_m, a.prior.sigma_position_m)
        for a in anchors
        if a.prior.position_m is not None and a.prior.sigma_position_m is not None
    ]
    if len(rows) < 3:
        return nothing
    track, fixes, sigma = (np.array(column, np.float64) for column in zip(*rows, strict=True))
    near = np.all(np.abs(track - fixes) < NEAR_SIGMAS * sigma, axis=1)
    if near.sum() < 3:
        return nothing
    apart, weight = (track - fixes)[near], 1.0 / sigma[near]
    centre = fixes[near].mean(axis=0)
    p = fixes[near] - centre
    A = np.zeros((len(p), 3, 7))  # shift, turn, stretch
    A[:, :, :3] = np.eye(3)
    A[:, 0, 4], A[:, 0, 5] = p[:, 2], -p[:, 1]
    A[:, 1, 3], A[:, 1, 5] = -p[:, 2], p[:, 0]
    A[:, 2, 3], A[:, 2, 4] = p[:, 1], -p[:, 0]
    A[:, :, 6] = p
    rows_A = (A * weight[:, :, None]).reshape(-1, 7)
    H = rows_A.T @ rows_A + np.diag([0.0] * 3 + [PRIOR_SIGMA**-2] * 4)
    x = np.linalg.solve(H, rows_A.T @ (apart * weight).ravel())
    reach_m = float(np.linalg.norm(p, axis=1).max())
    return centre, x[:3], se3.hat(x[3:6]) + x[6] * np.eye(3), reach_m
