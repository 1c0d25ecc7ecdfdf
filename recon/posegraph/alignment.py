"""From the odometry's own frame to the world: one similarity from all telemetry.

Vision alone leaves scale, heading, position and (weakly) tilt open. They are fitted over
the whole flown stretch at once, so that single bad fixes and compass errors average out:
Gauss-Newton over the readings of docs/pose-graph.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from recon import parallel, se3
from recon.posegraph.alignment_readings import (
    AXES,
    NO_YAW_RAD,
    RATE_S,
    UNKNOWNS,
    USUAL_RATE_M_S,
    Alignment,
    AlignmentReadings,
    ReadingNoise,
)
from recon.posegraph.ground import ASSUMED_TILT_RAD, GUESSED_SHARE
from recon.posegraph.pose_priors import has_fix
from recon.posegraph.records import SIGMA_STEP, Node
from recon.posegraph.sensor_noise import (
    ATTITUDE_S,
    FIX_S,
    MIN_BIAS,
    MIN_READINGS,
    SURE_OF_BIAS,
    Noise,
    bias_time_constant_s,
    drift_noise,
    fresh_shares,
    gauss_markov_noise,
)
from recon.similarity import umeyama
from recon.types import F64, PosePrior

HUBER = 2.5
"""Whitened residuals beyond this lose weight: of three axes together, noise alone reaches it once
in ten times, so that little is lost where all is noise."""

WILD = 12.5
"""Beyond this, and beyond twice the median, what a reading pulls falls by the square of its
residual (redescending, as Hampel's): it is no noise. From a wrong start all residuals are large."""

ODD = 5.0  # the same of a fix against those next to it, which noise reaches once in a million times
SETTLED = 1e-3  # sigmas; a shorter step ends the fit: each is about half the one before
SETTLED_START = 0.1  # the same for a fit that starts another one, or whose residuals give the noise
ITERATIONS = 30  # steps of a fit, at most
ROUNDS = 4  # times that the noise of altitudes and the tilt by them are found in turn
SIGMA_MOUNT_RAD = np.radians(2.0)  # how well a camera is aligned before anything is known
MIN_ATTITUDES = 8  # of a segment that shows a boresight
STRANGE = 5.0  # sigmas of a tilt, median, beyond which attitudes and images do not belong together
MIN_WALK = 0.02  # sigma that no integrated velocity is better than, m / sqrt(s)


def fit(
    nodes: Sequence[Node],
    slow_share: float = 1.0,
    usual: ReadingNoise | None = None,
) -> Alignment | None:
    """The similarity that brings the nodes onto their priors, or None without any prior.

    The nodes stand in the order of time. How fixes and velocities err is measured by their
    residuals against the track of a first fit and weighs them in a second one.
    An assumed height takes part only where nothing else measures the scale as well.
    An assumed view is off by one angle in all images, and altitudes of no stated accuracy drift:
    both are fitted too. Where fixes differ by more than their noise, the covariance grows by as
    much. The receiver's error that all fixes share goes into the position's covariance.
    ``slow_share`` is the part of its variance that may wander. Too few fixes to be measured err as
    the ``usual`` ones of the flight.
    """
    usable = [a for a in nodes if a.prior.R_world_camera is not None or has_fix(a.prior)]
    if not usable:
        return None
    readings = AlignmentReadings(usable)
    if _velocities_contradict(readings):
        usable = [replace(a, prior=replace(a.prior, travel=None)) for a in usable]
        readings = AlignmentReadings(usable)
    starts = _starts(usable, readings)
    found = [_solve(readings, start, SETTLED_START) for start in starts]
    best = min(found, key=lambda f: f.cost)
    noise = _measured(usable, best.at, slow_share).or_else(usual, readings.claimed)
    readings = AlignmentReadings(usable, noise)
    best = _solve(readings, best.at, SETTLED)
    covariance = _covariance(readings, best)
    if readings.is_height_assumed:
        others = AlignmentReadings([replace(a, height=None) for a in usable], noise)
        measured = _solve(others, best.at, SETTLED)
        known = _covariance(others, measured)
        if known[6, 6] < GUESSED_SHARE**2:  # the assumed height would pull the scale
            readings, best, covariance = others, measured, known
        else:
            covariance[6, 6] = max(covariance[6, 6], GUESSED_SHARE**2)
    heights = None
    if len(readings.fix) and noise.fixes is not None:
        heights = readings.heights(best.at, best.H, covariance)
    covariance[6, 6] += SIGMA_STEP**2 / max(len(usable) - 1, 1)
    mean = counted = None
    if len(readings.fix):
        claimed = readings.claimed * noise.over_claim
        covariance[3:6, 3:6] += np.diag(np.mean(np.square(claimed), axis=0))
        mean, counted = noise.of_mean(readings.claimed, readings.fix_s)
    similarity = replace(
        best.at, covariance=covariance, sources=_sources(readings), noise=noise, sigma_fixes=mean,
        sigma_counted=counted, span_s=readings.span_s, heights=heights,
    )  # fmt: skip
    views = [a.prior for a in usable if a.prior.R_world_camera is not None]
    is_known = any(v.sigma_tilt_rad < ASSUMED_TILT_RAD for v in views)
    off = readings.tilt_off(best.at)
    if not len(readings.fix) or (is_known and not off.any()):
        return similarity
    lean = np.zeros((6, 6))
    lean[:2, :2] = covariance[:2, :2] + np.outer(off, off)
    centre = similarity.points(readings.x.mean(axis=0))
    return replace(similarity, lean=se3.about(-centre, lean))


def boresight(nodes: Sequence[Node]) -> tuple[F64, F64]:
    """How reported attitudes are turned against the camera, in its frame: the (3,) right side and
    (3, 3) matrix of its normal equations, zero where attitudes and images do not belong together.

    The attitudes are those of a mount that is known to :data:`SIGMA_MOUNT_RAD`, with nothing else
    to go by: only turns separate it from the lean of the map, as in hand-eye calibration (Park and
    Martin 1994, doi:10.1109/70.326576). About the vertical they stay one as long as the camera only
    turns about it.
    """
    nothing = np.zeros(3), np.zeros((3, 3))
    seen = [
        replace(a, height=None, prior=PosePrior(p.R_world_camera, p.sigma_tilt_rad,
                                                p.sigma_yaw_rad, is_view_assumed=True))
        for a in nodes
        if (p := a.prior).R_world_camera is not None and not p.is_view_assumed
    ]  # fmt: skip
    if len(seen) < MIN_ATTITUDES:
        return nothing
    readings = AlignmentReadings(seen, None, SIGMA_MOUNT_RAD)
    found = _solve(readings, _starts(seen, readings)[0], SETTLED_START)
    tilts = np.linalg.norm(readings.attitude_residuals(found.at)[0][:, :2], axis=1)
    if float(np.median(tilts / [a.prior.sigma_tilt_rad for a in seen])) > STRANGE:
        return nothing
    turn, matrix = found.at.mount_rad, np.linalg.inv(np.linalg.inv(found.H)[7:10, 7:10])
    sigmas = float(np.linalg.norm(turn)) / SIGMA_MOUNT_RAD
    weight = min(1.0, HUBER / max(sigmas, 1e-9))  # of what was known before
    return matrix @ turn, matrix - weight * np.eye(3) * SIGMA_MOUNT_RAD**-2


def _covariance(readings: AlignmentReadings, found: _Solution) -> F64:
    """(7, 7) of a solution, larger where fixes differ by more than their noise."""
    return np.asarray(np.linalg.inv(found.H)[:7, :7] * max(found.variance_factor, 1.0), np.float64)


def _measured(nodes: Sequence[Node], start: Alignment, slow_share: float) -> ReadingNoise:
    """The noise of fixes and of velocities, each estimated from residuals against a fit of that
    sensor and the attitudes' tilt alone: a compass that is off would look like a drift."""
    level = [
        replace(a, height=None, prior=replace(a.prior, sigma_yaw_rad=NO_YAW_RAD)) for a in nodes
    ]
    fixed = [replace(a, prior=replace(a.prior, travel=None)) for a in level]
    moved = [replace(a, prior=replace(a.prior, position_m=None)) for a in level]
    out, at, fixes = ReadingNoise(), start, AlignmentReadings(fixed)
    # Altitudes that weigh too little leave a lean, which looks like a wander of theirs. So they
    # begin as if they were as good as places.
    if not fixes.is_height_claimed and len(fixes.fix):
        alike = Noise(float(np.median(fixes.claimed[:, :2])), 0.0, FIX_S)
        fixes = AlignmentReadings(fixed, ReadingNoise(off_track=(alike, alike)))
    for _ in range(1 if fixes.is_height_claimed else ROUNDS):
        at = _solve(fixes, at, SETTLED_START).at
        out = _of_fixes(fixes, at, slow_share)
        fixes = AlignmentReadings(fixed, out)
    moves = AlignmentReadings(moved)
    if len(moves.travel_m) >= MIN_READINGS:
        drift = moves.velocity_residuals(_solve(moves, start, SETTLED_START).at)
        found = drift_noise(np.cumsum(moves.travel_s), np.cumsum(drift, axis=0))
        if found is not None:
            # A steady error along a leg looks like another scale: no residual shows it.
            hidden = Noise(0.0, found[1], RATE_S).reach(USUAL_RATE_M_S, MIN_BIAS)
            walk, rate = max(found[0], MIN_WALK), max(found[1], hidden)
            out = replace(out, walk_m_per_sqrt_s=walk, rate_m_s=rate)
    return out


def _of_fixes(fixes: AlignmentReadings, at: Alignment, slow_share: float) -> ReadingNoise:
    """The noise of fixes and of assumed views, by their residuals to a track.

    A slow difference may be vision's own drift, so a wander is bounded by what the sensor claims;
    its white part is not. Altitudes whose accuracy nothing states wander as they are seen to, and
    by a share of their drift: none is steady.
    """
    if len(fixes.fix) < MIN_READINGS:
        return ReadingNoise()
    tilts = fixes.attitude_residuals(at)[0][fixes.is_assumed, :2]
    tilt = gauss_markov_noise(fixes.tilt_s, tilts, ATTITUDE_S, 1.0)
    if tilt is not None:
        tilt = tilt.scattered(tilts).bounded(
            ASSUMED_TILT_RAD, ATTITUDE_S, MIN_BIAS * ASSUMED_TILT_RAD
        )
    residuals, is_claimed = fixes.fix_residuals(at), fixes.is_height_claimed
    off_h, off_v = (gauss_markov_noise(fixes.fix_s, residuals[:, k], FIX_S, 1.0) for k in AXES)
    horizontal = gauss_markov_noise(fixes.fix_s, residuals[:, :2], FIX_S)
    vertical = gauss_markov_noise(
        fixes.fix_s, residuals[:, 2:], FIX_S, SURE_OF_BIAS if is_claimed else 1.0
    )
    if horizontal is None or vertical is None or off_h is None or off_v is None:
        return ReadingNoise(tilt=tilt)
    claimed, span_s = np.median(fixes.claimed, axis=0), float(np.ptp(fixes.fix_s))
    sigma_h, sigma_v = float(claimed[:2].mean()), float(claimed[2])
    over = fixes.over_claim(residuals, at.scale, [horizontal.white, vertical.white])
    least = 1.0 if is_claimed else MIN_BIAS
    reach = horizontal.reach(sigma_h, min(least, slow_share))
    most, drift = horizontal.reach(sigma_h, slow_share), sigma_v if is_claimed else abs(at.drift_m)
    tau_h_s, tau_v_s = bias_time_constant_s(most), bias_time_constant_s(sigma_v)
    bounded_h = horizontal.bounded(most, tau_h_s, MIN_BIAS * most)
    bounded_v = vertical.bounded(sigma_v, tau_v_s, MIN_BIAS * drift)
    return ReadingNoise(
        fixes=(bounded_h, bounded_h, bounded_v),
        off_track=(
            off_h.drifting(most, tau_h_s, span_s),
            off_v.drifting(sigma_v, tau_v_s, span_s) if is_claimed else bounded_v,
        ),
        reach_m=over * [reach, reach, vertical.reach(sigma_v, least)],
        tilt=tilt,
        claimed=claimed,
        over_claim=over,
        fresh_share=fresh_shares(residuals),
    )


def _velocities_contradict(readings: AlignmentReadings) -> bool:
    """True when velocities and fixes give lengths of the flight that no noise explains."""
    if len(readings.travel_m) == 0 or len(readings.fix) < 2:
        return False
    flown = float(np.linalg.norm(readings.travel_m.sum(axis=0)))
    fixed = float(np.linalg.norm(readings.fix[-1] - readings.fix[0]))
    slack = 3.0 * float(np.max(readings.claimed)) + 0.2 * max(flown, fixed)
    return abs(flown - fixed) > slack


Scale = tuple[float, float]
"""Metres per unit of the odometry by one kind of reading, and its relative sigma."""


def scales(nodes: Sequence[Node], at: Alignment) -> tuple[Scale | None, Scale | None]:
    """The scale by position fixes alone and by measured heights alone; None where the track or the
    readings give none."""
    r = AlignmentReadings(nodes)
    by_fixes = by_heights = None
    if len(r.fix) >= 4:
        alone = [replace(a, height=None, prior=replace(a.prior, travel=None)) for a in nodes]
        found = _solve(AlignmentReadings(alone), at, SETTLED_START)
        by_fixes = found.at.scale, float(np.sqrt(np.linalg.inv(found.H)[6, 6]))
    if r.has_measured_heights:
        spread = 1.0 / float(np.sqrt(np.sum(1.0 / r.sigma_log**2)))
        by_heights = float(np.exp(np.median(r.log_ratio))), spread
    return by_fixes, by_heights


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """The best state with its (UNKNOWNS, UNKNOWNS) information and its robust cost."""

    at: Alignment
    H: F64
    cost: float
    variance_factor: float  # of the fixes: 1 where they differ as their noise says


def _solve(readings: AlignmentReadings, at: Alignment, settled: float) -> _Solution:
    """Gauss-Newton with robust weights, until a step of ``settled`` sigmas."""
    H, cost, extra = np.eye(UNKNOWNS), np.inf, np.zeros((2, len(readings.fix)))
    ridge = np.diag([1e-6] * 6 + [1e-4] + [0.0] * 4)
    for _ in range(ITERATIONS):
        parallel.release_gil()
        r, J = readings.linearised(at)
        norms = np.sqrt(np.bincount(readings.group, weights=r**2))
        cost = float(np.sum(np.where(norms < HUBER, 0.5 * norms**2, HUBER * (norms - HUBER / 2))))
        known = readings.information(extra)
        others, fixes = readings.leave_one_out(r, known, extra), norms[readings.of_fixes]
        np.maximum(fixes, others * np.where(others > ODD, WILD / ODD, 1.0), out=fixes)
        wild, norms = max(WILD, 2.0 * float(np.median(norms))), np.maximum(norms, 1e-9)
        weight = np.minimum(1.0, HUBER / norms) * np.minimum(1.0, wild / norms) ** 2
        W = readings.weighted(np.column_stack([J, r]), weight, known)
        extra = readings.outlier_variance(known, extra, weight)
        H, g = J.T @ W[:, :-1] + ridge, J.T @ W[:, -1]
        step = np.linalg.solve(H, -g)
        step[:3] = np.clip(step[:3], -0.5, 0.5)
        step[6:10] = np.clip(step[6:10], -0.5, 0.5)
        at = at.moved(step)
        if step @ H @ step < settled**2:
            break
    variance_factor = readings.variance_factor(r, W[:, -1], norms < wild)
    return _Solution(_centred(readings, at, weight), H, cost, variance_factor)


def _centred(readings: AlignmentReadings, at: Alignment, weight: F64) -> Alignment:
    """The state whose track lies in the mean of the fixes by ``weight`` (groups,), so that their
    mean error is its shift: what is best for a wander's slope rests on the first and last."""
    if not len(readings.fix):
        return at
    each = weight[readings.of_fixes, None] / readings.sigma_fix**2
    return replace(at, t=at.t - np.average(readings.fix_residuals(at), axis=0, weights=each))


def _starts(nodes: Sequence[Node], readings: AlignmentReadings) -> list[Alignment]:
    """To begin with: by the attitude, and by the track of the fixes, which alone determines the
    heading when the compass is far off or there is none."""
    R = np.eye(3)
    for a in nodes:
        if a.prior.R_world_camera is not None:
            R = a.prior.R_world_camera @ a.T_odom_camera[:3, :3].T
            break
    if not len(readings.fix):
        return [Alignment(1.0, R, -R @ nodes[0].T_odom_camera[:3, 3])]
    x = readings.x @ R.T
    starts = [Alignment(1.0, R, np.asarray(np.median(readings.fix - x, axis=0)))]
    if len(x) >= 4:
        weight = 1.0 / np.mean(readings.claimed**2, axis=1)
        found = umeyama(x, readings.fix, weight, is_level=True)
        if found is not None and found.scale > 0:
            shift = np.asarray(np.median(readings.fix - found.scale * x @ found.R.T, axis=0))
            starts.append(Alignment(found.scale, found.R @ R, shift))
    return starts


def _sources(readings: AlignmentReadings) -> tuple[str, ...]:
    known = {
        "attitude": readings.heading_known.any(),
        "altitude": readings.has_heights,
        "gnss": len(readings.fix) > 0,
    }
    return tuple(name for name, is_known in known.items() if is_known)
