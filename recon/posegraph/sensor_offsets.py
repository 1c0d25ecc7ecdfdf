"""Constant errors of the sensors: of a whole flight, and of one segment against its similarity.

Both are removed from the readings before these enter the graph: only variation along the track may
bend it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from recon import se3
from recon.posegraph.alignment import SIGMA_MOUNT_RAD
from recon.posegraph.alignment_readings import Alignment, from_middle
from recon.posegraph.ground import EXACT_HEIGHTS, height_ratios
from recon.posegraph.pose_priors import off_attitudes
from recon.posegraph.records import Node
from recon.posegraph.sensor_noise import FIX_S
from recon.similarity import lever
from recon.types import F64, PosePrior

BOUND_RAD = np.radians(15.0)  # a larger angle is not a boresight but another fault
SURE = 9.0  # squared sigmas by which a boresight must differ from none to be applied


@dataclass(frozen=True, slots=True, eq=False)
class Constants:
    """Of a whole flight, whatever becomes of the track. The boresight: ``R_world_camera =
    R_reported @ exp(turn)``. The altitudes' datum: ``up_m`` is to be added to them."""

    turn: F64 = field(default_factory=lambda: np.zeros(3))  # rad, in the camera's frame
    sigma_turn: F64 = field(default_factory=lambda: np.full(3, SIGMA_MOUNT_RAD))
    up_m: float = 0.0
    sigma_up_m: float = float("inf")  # of what is then left of the constant
    slow_share: float = 1.0  # of the receiver's variance; the rest is new in each fix

    @property
    def is_turn_sure(self) -> bool:
        """True when the boresight is significant; otherwise it is not applied."""
        return float(np.sum(np.square(self.turn / self.sigma_turn))) > SURE

    def without(self, prior: PosePrior) -> PosePrior:
        """A prior without them."""
        R, position = prior.R_world_camera, prior.position_m
        if R is not None and self.is_turn_sure:
            R = R @ se3.so3_exp(self.turn)
        if position is not None:
            position = position + np.array([0.0, 0.0, self.up_m])
        return replace(prior, R_world_camera=R, position_m=position)


@dataclass(frozen=True, slots=True, eq=False)
class Offsets:
    """Of one segment, from its sensors to its similarity; without the :class:`Constants`."""

    at: Alignment  # the similarity: it has the mount of assumed views and the altitudes' drift
    turn_world: F64 = field(default_factory=lambda: np.zeros(3))  # takes attitudes to it
    log_height: float = 0.0  # log of its scale over that of the heights
    centre_m: F64 = field(default_factory=lambda: np.zeros(3))  # of the fixes
    shift_m: F64 = field(default_factory=lambda: np.zeros(3))  # takes fixes to it
    warp: F64 = field(default_factory=lambda: np.zeros((3, 3)))  # per metre off centre
    reach_m: float = 0.0  # off centre to which the warp is known; it grows no further
    is_exact: bool = False  # only heights of the ground exactly below count

    def without(self, prior: PosePrior, time_s: float, slant: float = 0.0) -> PosePrior:
        """A prior without them; ``slant`` is that of the ground whose height vision measures."""
        R, position, agl = prior.R_world_camera, prior.position_m, prior.agl_m
        if R is not None:
            R = R @ se3.so3_exp(self.at.mount_rad) if prior.is_view_assumed else R
            R = se3.so3_exp(self.turn_world) @ R
        if position is not None:
            drift_m = self.at.drift_m * float(from_middle(time_s, *self.at.span_s))
            position = position - np.array([0.0, 0.0, drift_m])
            off = position - self.centre_m
            off = off * min(1.0, self.reach_m / max(float(np.linalg.norm(off)), 1e-9))
            position = position + self.shift_m + self.warp @ off
        if agl is not None:
            is_relief = self.is_exact and slant > 0.0
            agl = None if is_relief else agl * float(np.exp(self.log_height))
        return replace(prior, R_world_camera=R, position_m=position, agl_m=agl)


MIN_INTERVALS = 3  # minimum number of intervals between keyframes with fixes
STEADY_SHARE = 0.1  # of the claimed sigma that stays: one flight cannot show all errors
OFF_SIGMAS = 4.0  # of scatter and sigma: intervals further from the median do not count
BY_CHANCE = 2.6  # the variance of four means exceeds the true one by more in one case of twenty
WILD_STEPS = 36.0  # squared steps between fixes, over their median, beyond which they are jumps


def altitude_datum(priors: Sequence[PosePrior], span_s: float) -> Constants:
    """The datum by all fixes of a flight of ``span_s``, in the order of time.

    An autopilot's altitude follows its barometer, whose zero is off by decimetres to metres. The
    receiver's own altitudes scatter more, but about another mean. The part of the receiver's
    claimed sigma that shows as scatter from fix to fix averages out; the rest wanders (first-order
    Gauss-Markov, as in :mod:`recon.posegraph.factors`) and stays. The autopilot's altitude rests
    on the same receiver, so the receiver's mean is taken over only as far as it is the better one.
    Where the scatter could be all of the sigma, it is taken to be, but for what is seen to wander.
    """
    rows = [
        (p.gnss_minus_baro_m, p.gnss_minus_baro_fixes, p.sigma_position_m[2])
        for p in priors
        if p.gnss_minus_baro_m is not None
        and p.gnss_minus_baro_fixes > 0
        and p.sigma_position_m is not None
    ]
    if len(rows) < MIN_INTERVALS:
        return Constants()
    above, fixes, claimed = np.array(rows, np.float64).T
    sigma = float(np.median(claimed))
    steps = np.diff(above) ** 2 / (1.0 / fixes[1:] + 1.0 / fixes[:-1])
    usual = steps[steps <= WILD_STEPS * np.median(steps)]
    white = float(np.sqrt(usual.mean()))  # of one fix
    doubt = 1.0 + 2.0 * np.sqrt(3.0 / len(usual))  # of a variance by so many steps
    apart = np.abs(above - np.median(above))
    near = apart <= OFF_SIGMAS * np.sqrt(white**2 / fixes + sigma**2)
    mean = float(np.average(above[near], weights=fixes[near]))
    seen = min(_wandered(above[near], fixes[near], white), sigma**2)
    slow = max(sigma**2 - doubt * white**2, seen, (STEADY_SHARE * sigma) ** 2)
    slow_share = min(slow / sigma**2, 1.0)
    slow /= 1.0 + max(span_s, 0.0) / (2.0 * FIX_S)
    left = slow + white**2 / float(fixes[near].sum())
    share = max(0.0, 1.0 - 2.0 * left / sigma**2)
    left_m = float(np.sqrt(left)) if share > 0 else sigma
    return Constants(up_m=float(share * mean), sigma_up_m=left_m, slow_share=float(slow_share))


def _wandered(above: F64, fixes: F64, white: float) -> float:
    """m^2 by which quarters of (N,) altitudes differ beyond the scatter ``white`` of one fix; 0
    where chance could be the reason, as for fewer than three in a quarter."""
    if len(above) < 12:
        return 0.0
    quarters = zip(np.array_split(above, 4), np.array_split(fixes, 4), strict=True)
    means, counts = np.array([(np.average(a, weights=n), n.sum()) for a, n in quarters]).T
    scatter, apart = white**2 * float(np.mean(1.0 / counts)), float(np.var(means, ddof=1))
    return apart - scatter if apart > BY_CHANCE * scatter else 0.0


PRIOR_SIGMA = 0.1  # rad and share; how far fixes may be turned and stretched against the similarity

GATE_SIGMAS = 5.0
"""Beyond so many sigmas from the prediction a reading is left out, as noise alone reaches that once
in a million."""

FRAME_SIGMA_RAD = (0.05, 0.05, 0.15)
"""Smallest sigma of a placed segment's tilt and heading. Attitudes that are further off than this
and their own allow are at fault, for the gates to find; a constant within is taken out, as it would
pull the map."""

NEAR_SIGMAS = 5.0  # fixes further from the track, attitudes from their median, are no constant's


def constants(
    priors: Sequence[PosePrior], span_s: float, boresights: Sequence[tuple[F64, F64]]
) -> Constants:
    """Those of a flight of ``span_s`` by its priors, and by what segments show of the boresight
    (:func:`recon.posegraph.alignment.boresight`)."""
    datum = altitude_datum(priors, span_s)
    H = np.eye(3) * SIGMA_MOUNT_RAD**-2 + sum(matrix for _, matrix in boresights)
    turn = np.linalg.solve(H, sum((side for side, _ in boresights), np.zeros(3)))
    if float(np.linalg.norm(turn)) > BOUND_RAD:
        return datum
    return replace(datum, turn=turn, sigma_turn=np.sqrt(np.diag(np.linalg.inv(H))))


def offsets(nodes: Sequence[Node], at: Alignment) -> Offsets:
    """Those of one segment, robustly over its nodes, which are without the flight's constants."""
    fitted = Offsets(at)
    nodes = [replace(n, prior=fitted.without(n.prior, n.time_s)) for n in nodes]
    ratios, independent = height_ratios(nodes)
    log_height = 0.0
    if ratios:
        mean = np.average([r[0] for r in ratios], weights=[r[1] ** -2 for r in ratios])
        log_height = float(np.log(at.scale) - mean)
    is_exact = independent == EXACT_HEIGHTS
    return Offsets(at, _turn(nodes, at), log_height, *_fixes(nodes, at), is_exact)


def _turn(nodes: Sequence[Node], at: Alignment) -> F64:
    """(3,) mean rotation from the attitudes to the similarity; a heading only if they have one."""
    known = [n for n in nodes if n.prior.R_world_camera is not None]
    if not known:
        return np.zeros(3)
    seen = at.R @ np.array([n.T_odom_camera[:3, :3] for n in known])
    measured = np.array([n.prior.R_world_camera for n in known])
    sigma = np.array([[n.prior.sigma_tilt_rad] * 2 + [n.prior.sigma_yaw_rad] for n in known])
    turns = off_attitudes(seen, measured, sigma[:, 2] < 1.0)
    near = np.all(np.abs(turns - np.median(turns, axis=0)) < NEAR_SIGMAS * sigma, axis=1)
    turn = turns[near].mean(axis=0) if near.any() else np.zeros(3)
    allowed = GATE_SIGMAS * np.hypot(FRAME_SIGMA_RAD, np.median(sigma, axis=0))
    return turn if np.all(np.abs(turn) < allowed) else np.zeros(3)


def _fixes(nodes: Sequence[Node], at: Alignment) -> tuple[F64, F64, F64, float]:
    """Centre, shift, warp (3, 3) and reach of the fixes, turned and stretched about the centre."""
    nothing = np.zeros(3), np.zeros(3), np.zeros((3, 3)), 0.0
    rows = [
        (at.points(a.place_of_fix), a.prior.position_m, a.prior.sigma_position_m)
        for a in nodes
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
    A = lever(p)[:, :, [3, 4, 5, 0, 1, 2, 6]]  # shift, turn, stretch
    A = (A * weight[:, :, None]).reshape(-1, 7)
    H = A.T @ A + np.diag([0.0] * 3 + [PRIOR_SIGMA**-2] * 4)
    x = np.linalg.solve(H, A.T @ (apart * weight).ravel())
    reach_m = float(np.linalg.norm(p, axis=1).max())
    return centre, x[:3], se3.hat(x[3:6]) + x[6] * np.eye(3), reach_m
