"""From the odometry's own frame to the world: one similarity from all telemetry.

Vision alone leaves scale, heading, position and (weakly) tilt open. They are fitted over
the whole flown stretch at once, so that single bad fixes and compass errors average out;
GNSS is never forced on single poses (Umeyama 1991, doi:10.1109/34.88573, with attitude,
height and robust weights added, solved by Gauss-Newton).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from recon import se3
from recon.posegraph.sensor_noise import (
    MIN_READINGS,
    MIN_WANDER,
    Noise,
    drift_noise,
    wander_noise,
)
from recon.types import F64, DepthMap, PosePrior


def umeyama(source: F64, target: F64, weight: F64) -> tuple[float, F64, F64]:
    """Scale, (3, 3) rotation about z and (3,) shift that best take ``source`` (N, 3) to ``target``.

    Umeyama 1991, doi:10.1109/34.88573. ``weight`` (N,) is relative.
    """
    w = weight / weight.sum()
    ms, mt = w @ source, w @ target
    a, b = source - ms, target - mt
    cross = (b * w[:, None]).T @ a
    yaw = np.arctan2(cross[1, 0] - cross[0, 1], cross[0, 0] + cross[1, 1])
    R = se3.so3_exp(np.array([0.0, 0.0, yaw]))
    power = float(w @ np.sum(a**2, axis=1))
    scale = float(np.sum(R * cross)) / max(power, 1e-12)
    return scale, R, np.asarray(mt - scale * R @ ms)


WANDER_SHARE = 0.4
"""Share of a fix's sigma that differs between fixes of one flight; the rest is common to all."""

INDEPENDENT_HEIGHTS = 4.0
"""Heights of one flight count as so many: they share the ground's relief."""

UNMEASURED_HEIGHTS = 1.0
"""Heights above the take-off point, or assumed ones, count as so many: they share one offset."""

GUESSED_SHARE = 0.5
"""Relative sigma of a height that is assumed: it holds a scale that nothing else gives."""

EXACT_HEIGHTS = 16.0
"""The same where the ground exactly below was measured: relief has no part in it."""

LEANING_SHARE = 2.0
"""Sigma of a height, as a share of it, per unit of (1 - cosine) off the vertical."""

MIN_EXACT = 4
"""Heights exactly below from which on no others count."""

MIN_SPREAD = 0.005
"""Share of a height by which readings of one flight may always differ."""

EDGE_SHARE = 0.03
"""Depths about the point below that differ by more than this share belong to an edge."""

HUBER = 2.5
"""Whitened residuals beyond this lose weight."""

WILD = 12.5
"""Fixes and attitudes beyond this are left out once the fit stands, if fewer than half are."""

KNOWN_YAW_RAD, NO_YAW_RAD = 1.0, 3.0
"""Sigma below which a heading counts as known, and one of a heading that is not."""

MIN_FIX_M = 0.005
"""Sigma that no fix is better than."""

MIN_WALK, MIN_RATE_M_S = 0.02, 0.01
"""The same of an integrated velocity: m / sqrt(s), and the constant part of its error."""


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """``x_world = scale * R @ x_odom + t``; covariance of (rotation, translation, log scale)."""

    scale: float
    R: F64  # (3, 3)
    t: F64  # (3,) m
    covariance: F64  # (7, 7)
    sources: tuple[str, ...] = ()
    noise: ReadingNoise | None = None  # as measured by the fit; None without one
    sigma_fixes: F64 | None = None  # (3,) m of the mean error of all fixes, where they wander
    sigma_counted: F64 | None = None  # (3,) m that the readings in the graph count for it

    @property
    def sigma_scale(self) -> float:
        """Relative 1-sigma uncertainty of the scale."""
        return float(np.sqrt(self.covariance[6, 6]))

    def place(self, x_odom: F64) -> F64:
        """(3,) m of a place (3,) in the odometry."""
        return np.asarray(self.scale * self.R @ x_odom + self.t)

    def pose(self, T_odom_camera: F64) -> F64:
        """(4, 4) T_world_camera in metres of a pose of the odometry."""
        return se3.compose(
            self.R @ T_odom_camera[:3, :3], self.scale * self.R @ T_odom_camera[:3, 3] + self.t
        )


@dataclass(frozen=True, slots=True, eq=False)
class Anchor:
    """A keyframe of the odometry with its telemetry."""

    T_odom_camera: F64  # (4, 4)
    prior: PosePrior
    height: float | None  # of the camera above ground that it sees, in odometry units
    lean: float = 0.0  # 1 - cosine of how far off the vertical that ground is; 0 is below
    time_s: float = 0.0

    @property
    def place(self) -> F64:
        """(3,) of the camera, in the odometry."""
        return np.asarray(self.T_odom_camera[:3, 3])

    @property
    def place_of_fix(self) -> F64:
        """(3,) where the prior's position was, in the odometry."""
        offset, T = self.prior.fix_offset, self.T_odom_camera
        return T[:3, 3] if offset is None else T[:3, :3] @ offset + T[:3, 3]


@dataclass(frozen=True, slots=True)
class Scale:
    """Metres per unit of the odometry by one kind of reading, with its relative sigma."""

    metres: float
    sigma: float


def height_above(points: F64, up: F64) -> tuple[float, float] | None:
    """Height above the ground nearest below, and the deviation of that ground from the vertical.

    Args:
        points: (N, 3) ground in the camera's frame.
        up: (3,) unit vector upwards in that frame.

    The height is the median over the sixth of the points that lie most nearly below; the
    second number is 1 - cosine of their angle from the vertical. None under 12 points.
    """
    if len(points) < 12:
        return None
    drop = -(points @ up)
    cosine = drop / np.linalg.norm(points, axis=1)
    below = np.argsort(-cosine)[: max(12, len(points) // 6)]
    height = float(np.median(drop[below]))
    return (height, 1.0 - float(np.median(cosine[below]))) if height > 0 else None


def height_below(depth: DepthMap, up: F64) -> float | None:
    """Height above the ground exactly below, in the depth map's unit; None where it is not seen.

    ``up`` (3,) is the unit vector upwards in the camera's frame. Edges and holes do not count.
    """
    down = -up
    if down[2] < 0.2:
        return None
    h, w = depth.depth_m.shape
    u = round(float(depth.K[0, 0] * down[0] / down[2] + depth.K[0, 2]))
    v = round(float(depth.K[1, 1] * down[1] / down[2] + depth.K[1, 2]))
    if not (2 <= u < w - 2 and 2 <= v < h - 2):
        return None
    window = depth.depth_m[v - 2 : v + 3, u - 2 : u + 3]
    known = window[np.isfinite(window)]
    if len(known) < 15 or float(np.ptp(known)) > EDGE_SHARE * float(np.median(known)):
        return None
    return float(np.median(known)) / float(down[2])


def height_ratio(anchor: Anchor) -> tuple[float, float] | None:
    """Log of height by telemetry over height by vision, and its sigma; None without both."""
    agl, height = anchor.prior.agl_m, anchor.height
    if agl is None or height is None or not height > 0:
        return None
    # The height is measured straight below; ground seen elsewhere may lie otherwise.
    sigma = anchor.prior.sigma_agl_m / agl + LEANING_SHARE * anchor.lean
    return float(np.log(agl / height)), sigma


def height_ratios(anchors: Sequence[Anchor]) -> tuple[list[tuple[float, float]], float]:
    """:func:`height_ratio` of the anchors that have one, and as how many independent ones they
    count.

    Measured heights stand in for all others, and heights of the ground exactly below for those.
    """
    known = [(h, a) for a in anchors if (h := height_ratio(a)) is not None]
    measured = [(h, a) for h, a in known if a.prior.is_agl_measured]
    if not measured:
        return [h for h, _ in known], UNMEASURED_HEIGHTS
    exact = [h for h, a in measured if a.lean == 0.0]
    if len(exact) < MIN_EXACT:
        return [h for h, _ in measured], INDEPENDENT_HEIGHTS
    # A rangefinder meets a tree where the image sees through it: single ones are far off.
    ratio = np.array([h[0] for h in exact])
    apart = np.abs(ratio - np.median(ratio))
    limit = max(3.0 * 1.48 * float(np.median(apart)), MIN_SPREAD)
    return [h for h, off in zip(exact, apart, strict=True) if off <= limit], EXACT_HEIGHTS


@dataclass(frozen=True, slots=True, eq=False)
class ReadingNoise:
    """How fixes and velocities err along one flight, 1 sigma per axis."""

    horizontal: Noise | None = None  # of a fix, m; None: as it claims
    vertical: Noise | None = None
    reach_m: F64 | None = None  # (3,) how far fixes may wander
    walk_m_per_sqrt_s: float = 0.1  # of the integrated velocity
    rate_m_s: float = 0.05  # constant part of the velocity's error

    def of_fixes(self, claimed: F64, times_s: F64) -> tuple[F64, F64]:
        """(m, 3) sigma with which each fix weighs, and (m, 3) by which an outlier is known."""
        weighing, single = WANDER_SHARE * claimed, WANDER_SHARE * claimed
        span_s = float(np.ptp(times_s)) if len(times_s) else 0.0
        for noise, axes in ((self.horizontal, slice(0, 2)), (self.vertical, slice(2, 3))):
            if noise is not None:
                weighing[:, axes] = max(noise.of_each(len(claimed), span_s), MIN_FIX_M)
                single[:, axes] = max(noise.total, MIN_FIX_M)
        return weighing, single

    def of_mean(self, claimed: F64, times_s: F64, fix_s: float) -> tuple[F64, F64]:
        """(3,) sigma of the mean error of fixes with (m, 3) claimed sigmas at (m,) times, and what
        the readings in a graph count for it."""
        usual, span_s = np.median(claimed, axis=0), float(np.ptp(times_s))
        if self.horizontal is None or self.vertical is None or self.reach_m is None:
            return usual, usual / np.sqrt(1.0 + span_s / (2.0 * fix_s))
        known = (self.horizontal, self.horizontal, self.vertical)
        mean = [one.of_mean(float(m), span_s) for one, m in zip(known, self.reach_m, strict=True)]
        counted = [one.of_each(len(claimed), span_s) / len(claimed) ** 0.5 for one in known]
        return np.array(mean), np.array(counted)

    def of_travels(self, seconds: F64, span_s: float) -> F64:
        """(k,) sigma of ways of so many seconds each; over all of them the rate adds up."""
        variance = self.walk_m_per_sqrt_s**2 + self.rate_m_s**2 * span_s
        return np.asarray(np.sqrt(variance * np.maximum(seconds, 1e-3)))


class _Readings:
    """The anchors' readings as arrays, by kind; rows of one reading form a group."""

    def __init__(self, anchors: Sequence[Anchor], noise: ReadingNoise | None = None) -> None:
        turned = [a for a in anchors if a.prior.R_world_camera is not None]
        fixed = [a for a in anchors if _has_fix(a.prior)]
        moved = [(a, b) for a, b in pairwise(anchors) if _are_on_one_run(a.prior, b.prior)]
        heights, independent = height_ratios(anchors)
        noise = noise or ReadingNoise()
        self.R_odom = _stack([a.T_odom_camera[:3, :3] for a in turned], (3, 3))
        self.R_prior = _stack([a.prior.R_world_camera for a in turned], (3, 3))
        self.sigma_turn = _stack(
            [[a.prior.sigma_tilt_rad] * 2 + [a.prior.sigma_yaw_rad] for a in turned], (3,)
        )
        self.heading_known = self.sigma_turn[:, 2] < KNOWN_YAW_RAD
        self.x = _stack([a.place_of_fix for a in fixed], (3,))
        self.fix = _stack([a.prior.position_m for a in fixed], (3,))
        self.claimed = _stack([a.prior.sigma_position_m for a in fixed], (3,))
        self.fix_s = _stack([a.time_s for a in fixed], ())
        self.sigma_fix, self.sigma_single = noise.of_fixes(self.claimed, self.fix_s)
        self.step = _stack([b.place - a.place for a, b in moved], (3,))
        self.way = _stack([_way(a.prior, b.prior) for a, b in moved], (3,))
        self.way_s = _stack([_seconds(a.prior, b.prior) for a, b in moved], ())
        self.sigma_way = noise.of_travels(self.way_s, float(np.sum(self.way_s)))
        self.has_measured_heights = bool(heights) and independent > UNMEASURED_HEIGHTS
        self.has_heights = any(sigma < GUESSED_SHARE for _, sigma in heights)
        self.log_ratio = _stack([h[0] for h in heights], ())
        thinned = min(1.0, (independent / max(len(heights), 1)) ** 0.5)
        self.sigma_log = _stack([h[1] for h in heights], ()) / thinned
        one = np.ones(len(turned)), np.ones(len(moved)), np.ones(len(heights))
        outlying = np.mean(self.sigma_fix / self.sigma_single, axis=1)
        self.outlying = np.concatenate([one[0], outlying, one[1], one[2]])
        """(groups,) what a group's whitened residual is multiplied by to find an outlier."""
        counts = np.array([3] * (len(turned) + len(fixed) + len(moved)) + [1] * len(heights), int)
        self.group = np.repeat(np.arange(len(counts)), counts)
        """(M,) the group of each row."""
        known = 1.0 / self.sigma_turn
        known[~self.heading_known, 2] = 0.0
        way = np.repeat(1.0 / self.sigma_way, 3)
        self._whitening = np.concatenate(
            [known.ravel(), 1.0 / self.sigma_fix.ravel(), way, 1.0 / self.sigma_log]
        )
        first, last = 3 * len(turned), 3 * (len(turned) + len(fixed) + len(moved))
        self._scaled = slice(first, last)
        self._J = np.zeros((len(self.group), 7))  # where it is constant
        self._J[:first, :3] = np.tile(np.eye(3), (len(turned), 1))
        self._J[first : first + 3 * len(fixed), 3:6] = np.tile(np.eye(3), (len(fixed), 1))
        self._J[last:, 6] = 1.0

    def linearised(self, R: F64, t: F64, log_scale: float) -> tuple[F64, F64]:
        """Whitened residuals (M,) and Jacobian (M, 7)."""
        fix, way = self.placed(R, t, log_scale), self.moved(R, log_scale)
        J = self._J.copy()
        y = np.concatenate([fix + self.fix - t, way + self.way])
        of = J[self._scaled].reshape(-1, 3, 7)
        of[:, 0, 1], of[:, 1, 2], of[:, 2, 0] = y[:, 2], y[:, 0], y[:, 1]
        of[:, 0, 2], of[:, 1, 0], of[:, 2, 1] = -y[:, 1], -y[:, 2], -y[:, 0]
        of[:, :, 6] = y
        height = log_scale - self.log_ratio
        r = np.concatenate([self._turns(R).ravel(), fix.ravel(), way.ravel(), height])
        return r * self._whitening, J * self._whitening[:, None]

    def placed(self, R: F64, t: F64, log_scale: float) -> F64:
        """(m, 3) m from the fixes to where the similarity has them."""
        return np.asarray(np.exp(log_scale) * self.x @ R.T + t - self.fix)

    def moved(self, R: F64, log_scale: float) -> F64:
        """(k, 3) m from ways by velocity to those by vision."""
        return np.asarray(np.exp(log_scale) * self.step @ R.T - self.way)

    def _turns(self, R: F64) -> F64:
        """(n, 3) rotations from the attitudes; of one whose heading is unknown, the tilt alone."""
        n = len(self.R_odom)
        if n == 0:
            return np.zeros((0, 3))
        seen = R @ self.R_odom
        turn = se3.each_so3_log(seen @ self.R_prior.transpose(0, 2, 1))
        up = np.einsum("nij,nj->ni", seen, self.R_prior[:, 2])  # where the prior's up points now
        tilt = np.column_stack([-up[:, 1], up[:, 0], np.zeros(n)])
        return np.where(self.heading_known[:, None], turn, tilt)


def fit(
    anchors: Sequence[Anchor], fix_s: float = 60.0, iterations: int = 30, slow_share: float = 1.0
) -> Similarity | None:
    """The similarity that brings the anchors onto their priors, or None without any prior.

    The anchors stand in the order of time; ``fix_s`` is the usual time constant of a receiver's
    wander. How fixes and velocities err is measured by their
    residuals against the track of a first fit and weighs them in a second one. Attitudes of one
    flight err together, so the covariance is inflated by their number. The receiver's error that
    all fixes share goes into the position's covariance. ``slow_share`` is the part of its variance
    that may wander.
    """
    usable = [a for a in anchors if a.prior.R_world_camera is not None or _has_fix(a.prior)]
    if not usable:
        return None
    readings = _Readings(usable)
    if _velocities_contradict(readings):
        usable = [replace(a, prior=replace(a.prior, travel=None)) for a in usable]
        readings = _Readings(usable)
    found = [_solve(readings, *start, iterations) for start in _starts(usable, readings)]
    best = min(found, key=lambda f: f.cost)
    noise = _measured(usable, best, fix_s, iterations, slow_share)
    readings = _Readings(usable, noise)
    best = _solve(readings, best.R, best.t, best.log_scale, iterations)
    inflation = max(1.0, 0.2 * len(usable)) if noise.horizontal is None else 1.0
    covariance = np.asarray(np.linalg.inv(best.H) * inflation, np.float64)
    mean = counted = None
    if len(readings.fix):
        covariance[3:6, 3:6] += np.diag(np.mean(np.square(readings.claimed), axis=0))
    if len(readings.fix) and fix_s > 0:
        mean, counted = noise.of_mean(readings.claimed, readings.fix_s, fix_s)
    scale = float(np.exp(best.log_scale))
    return Similarity(scale, best.R, best.t, covariance, _sources(readings), noise, mean, counted)


def _measured(
    anchors: Sequence[Anchor], start: _Solution, fix_s: float, iterations: int, slow_share: float
) -> ReadingNoise:
    """The noise of fixes and of velocities, each by its residuals to the track as it alone, with
    the tilt of the attitudes, has it: a compass that is off would look like a drift.

    A slow difference may be vision's own drift, so a receiver's wander is bounded by what it
    claims. Its white part is not: from one fix to the next vision does not err by as much.
    """
    out, at = ReadingNoise(), (start.R, start.t, start.log_scale, iterations)
    level = [
        replace(a, height=None, prior=replace(a.prior, sigma_yaw_rad=NO_YAW_RAD)) for a in anchors
    ]
    fixes = _Readings([replace(a, prior=replace(a.prior, travel=None)) for a in level])
    if len(fixes.fix) >= MIN_READINGS:
        alone = _solve(fixes, *at)
        apart = fixes.placed(alone.R, alone.t, alone.log_scale)
        across = wander_noise(fixes.fix_s, apart[:, :2], fix_s)
        along = wander_noise(fixes.fix_s, apart[:, 2:], fix_s)
        if across is not None and along is not None:
            claimed = np.median(fixes.claimed, axis=0)
            flat, high = float(claimed[:2].mean()), float(claimed[2])
            is_claimed = all(a.prior.is_sigma_claimed for a in level if _has_fix(a.prior))
            least = 1.0 if is_claimed else MIN_WANDER
            reach = across.reach(flat, min(least, slow_share))
            out = replace(
                out,
                horizontal=across.bounded(across.reach(flat, slow_share), fix_s),
                vertical=along.bounded(high, fix_s),
                reach_m=np.array([reach, reach, along.reach(high, least)]),
            )
    ways = _Readings([replace(a, prior=replace(a.prior, position_m=None)) for a in level])
    if len(ways.way) >= MIN_READINGS:
        alone = _solve(ways, *at)
        drift = ways.moved(alone.R, alone.log_scale)
        found = drift_noise(np.cumsum(ways.way_s), np.cumsum(drift, axis=0))
        if found is not None:
            walk, rate = max(found[0], MIN_WALK), max(found[1], MIN_RATE_M_S)
            out = replace(out, walk_m_per_sqrt_s=walk, rate_m_s=rate)
    return out


def _velocities_contradict(readings: _Readings) -> bool:
    """True when velocities and fixes give lengths of the flight that no noise explains."""
    if len(readings.way) == 0 or len(readings.fix) < 2:
        return False
    flown = float(np.linalg.norm(readings.way.sum(axis=0)))
    fixed = float(np.linalg.norm(readings.fix[-1] - readings.fix[0]))
    slack = 3.0 * float(np.max(readings.claimed)) + 0.2 * max(flown, fixed)
    return abs(flown - fixed) > slack


def scales(anchors: Sequence[Anchor], at: Similarity) -> tuple[Scale | None, Scale | None]:
    """The scale by position fixes alone and by measured heights alone, each with its sigma.

    None where the track or the readings give none.
    """
    r = _Readings(anchors)
    by_fixes = by_heights = None
    if len(r.fix) >= 4:
        x, y = r.x @ at.R.T, r.fix
        near = np.abs(at.scale * x + at.t - y) < 5.0 * r.claimed
        w = (near.all(axis=1)[:, None]) / r.claimed**2
        total = np.maximum(np.sum(w, axis=0), 1e-30)
        x, y = (v - np.sum(w * v, axis=0) / total for v in (x, y))
        power = float(np.sum(w * x**2))
        if power > 0:
            scale = float(np.sum(w * x * y)) / power
            # Errors of fixes wander slowly: all of them together count as a few.
            sigma = np.sqrt(max(len(x) / INDEPENDENT_HEIGHTS, 1.0) / power) / max(scale, 1e-9)
            by_fixes = Scale(scale, float(sigma)) if scale > 0 else None
    if r.has_measured_heights:
        spread = 1.0 / float(np.sqrt(np.sum(1.0 / r.sigma_log**2)))
        by_heights = Scale(float(np.exp(np.median(r.log_ratio))), spread)
    return by_fixes, by_heights


def _has_fix(prior: PosePrior) -> bool:
    return prior.position_m is not None and prior.sigma_position_m is not None


def _are_on_one_run(a: PosePrior, b: PosePrior) -> bool:
    """True when velocity was integrated from one to the other without a gap."""
    return a.travel is not None and b.travel is not None and a.travel.run == b.travel.run


def _way(a: PosePrior, b: PosePrior) -> F64:
    """(3,) m flown by velocity between two priors of one run."""
    assert a.travel is not None and b.travel is not None
    return b.travel.metres - a.travel.metres


def _seconds(a: PosePrior, b: PosePrior) -> float:
    """Seconds between two priors of one run."""
    assert a.travel is not None and b.travel is not None
    return b.travel.seconds - a.travel.seconds


def _stack(rows: Sequence[object], shape: tuple[int, ...]) -> F64:
    return np.asarray(rows, np.float64).reshape(len(rows), *shape)


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """A similarity with its (7, 7) information and its robust cost."""

    R: F64
    t: F64
    log_scale: float
    H: F64
    cost: float


def _solve(readings: _Readings, R: F64, t: F64, log_scale: float, iterations: int) -> _Solution:
    """Gauss-Newton with Huber's weights."""
    group, kept = readings.group, np.ones(len(readings.outlying))
    H, cost, ridge = np.eye(7), np.inf, np.diag([1e-6] * 6 + [1e-4])
    for i in range(iterations + 10):
        r, J = readings.linearised(R, t, log_scale)
        norms = np.sqrt(np.bincount(group, weights=r**2, minlength=len(kept)))
        weight = (kept * np.minimum(1.0, HUBER / np.maximum(norms, 1e-9)))[group]
        cost = float(np.sum(np.where(norms < HUBER, 0.5 * norms**2, HUBER * (norms - HUBER / 2))))
        JW = (J * weight[:, None]).T
        H = JW @ J + ridge
        step = np.linalg.solve(H, -JW @ r)
        step[:3] = np.clip(step[:3], -0.5, 0.5)
        step[6] = np.clip(step[6], -0.5, 0.5)
        R = se3.so3_exp(step[:3]) @ R
        t = t + step[3:6]
        log_scale += float(step[6])
        stands = np.abs(step).max() < 1e-7 or i >= iterations - 1
        if stands and not (kept.all() and _leave_out(readings, norms * readings.outlying, kept)):
            break
    return _Solution(R, t, log_scale, H, cost)


def _leave_out(readings: _Readings, norms: F64, kept: F64) -> bool:
    """True when attitudes or fixes are wild and now out of ``kept``: fewer than half of them."""
    n, m = len(readings.R_odom), len(readings.fix)
    for kind in (slice(0, n), slice(n, n + m)):
        wild = norms[kind] > WILD
        if 2 * wild.sum() < len(wild):
            kept[kind][wild] = 0.0
    return not kept.all()


def _starts(anchors: Sequence[Anchor], readings: _Readings) -> list[tuple[F64, F64, float]]:
    """Rotation, shift and log scale to begin with: by the attitude, and by the track.

    The second matters when the compass is far off or there is none: then only the track of
    the fixes determines the heading.
    """
    R = np.eye(3)
    for a in anchors:
        if a.prior.R_world_camera is not None:
            R = a.prior.R_world_camera @ a.T_odom_camera[:3, :3].T
            break
    if not len(readings.fix):
        return [(R, -R @ anchors[0].T_odom_camera[:3, 3], 0.0)]
    x = readings.x @ R.T
    starts = [(R, np.asarray(np.median(readings.fix - x, axis=0)), 0.0)]
    if len(x) >= 4:
        weight = 1.0 / np.mean(readings.claimed**2, axis=1)
        scale, turn, _ = umeyama(x, readings.fix, weight)
        if scale > 0:
            shift = np.asarray(np.median(readings.fix - scale * x @ turn.T, axis=0))
            starts.append((turn @ R, shift, float(np.log(scale))))
    return starts


def _sources(readings: _Readings) -> tuple[str, ...]:
    out = []
    if readings.heading_known.any():
        out.append("attitude")
    if readings.has_heights:
        out.append("altitude")
    if len(readings.fix):
        out.append("gnss")
    return tuple(out)
