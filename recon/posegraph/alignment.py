"""From the odometry's own frame to the world: one similarity from all telemetry.

Vision alone leaves scale, heading, position and (weakly) tilt open. They are fitted over
the whole flown stretch at once, so that single bad fixes and compass errors average out;
GNSS is never forced on single poses (Umeyama 1991, doi:10.1109/34.88573, with attitude,
height and robust weights added, solved by Gauss-Newton).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from recon import se3
from recon.posegraph.level_ground import ASSUMED_TILT_RAD
from recon.posegraph.sensor_noise import (
    MIN_READINGS,
    MIN_WANDER,
    PRECISE_M,
    PRECISE_TAU_S,
    SURE_OF_WANDER,
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

ODD = 5.0
"""The same of a fix against those next to it."""

KNOWN_YAW_RAD, NO_YAW_RAD = 1.0, 3.0
"""Sigma below which a heading counts as known, and one of a heading that is not."""

MIN_FIX_M = 0.005
"""Sigma that no fix is better than."""

UNKNOWNS = 11
"""Rotation, shift and log scale; an assumed view's mount and the drift of altitudes."""

ROUNDS = 4
"""Times that the noise of altitudes and the tilt by them are found in turn."""

STEP_SHARE = 0.002
"""Share of its length by which a motion of vision errs."""

AXES = (slice(0, 2), slice(2, 3))
"""Those of a position that err alike: horizontal and vertical."""

TINY = 1e-6
"""Sigma of what no reading has."""

MIN_WALK, MIN_RATE_M_S = 0.02, 0.01
"""The same of an integrated velocity: m / sqrt(s), and the constant part of its error."""


@dataclass(frozen=True, slots=True, eq=False)
class Common:
    """Errors that readings of one kind have in common, where nothing states their accuracy."""

    mount_rad: F64 = field(default_factory=lambda: np.zeros(3))  # turns an assumed view
    drift_m: float = 0.0  # by which altitudes are too high at the end, and too low at the start
    middle_s: float = 0.0
    half_s: float = 1.0

    def along(self, time_s: float | F64) -> F64:
        """Times as -1 at the start of the readings to 1 at their end, and no further."""
        return np.asarray(np.clip((time_s - self.middle_s) / self.half_s, -1.0, 1.0))

    def applied(self, prior: PosePrior, time_s: float) -> PosePrior:
        """The prior without them."""
        R, position = prior.R_world_camera, prior.position_m
        if R is not None and prior.is_view_assumed:
            R = R @ se3.so3_exp(self.mount_rad)
        if position is not None:
            position = position - np.array([0.0, 0.0, self.drift_m * float(self.along(time_s))])
        return replace(prior, R_world_camera=R, position_m=position)


@dataclass(frozen=True, slots=True)
class Heights:
    """What fixes of one receiver tell about heights against each other."""

    sigma_m: float  # of the mean height
    time_s: float
    rate_m_s: float  # of their drift, 0 where they state their accuracy
    sigma_rate_m_s: float

    def sigma_to(self, main: Heights) -> float:
        """Sigma in m of the mean height against that of the main segment, which shows the drift."""
        passed_s = abs(self.time_s - main.time_s)
        drift_m = passed_s * float(np.hypot(main.rate_m_s, main.sigma_rate_m_s))
        return float(np.sqrt(self.sigma_m**2 + main.sigma_m**2 + drift_m**2))


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
    common: Common = field(default_factory=lambda: Common())
    heights: Heights | None = None  # where the noise of fixes is known
    bend_rad: float = 0.0  # sigma of a part of the track against its mean, as vision's turns add up
    lean: F64 | None = None  # (6, 6) of a left perturbation that tilts all; None: level is known

    @property
    def sigma_scale(self) -> float:
        """Relative 1-sigma uncertainty of the scale."""
        return float(np.sqrt(self.covariance[6, 6]))

    @property
    def sigma_lean_rad(self) -> float | None:
        """1-sigma uncertainty of what is level somewhere, about the axis where it is largest."""
        if self.lean is None:
            return None
        return float(np.sqrt(np.linalg.eigvalsh(self.lean[:2, :2])[-1] + self.bend_rad**2))

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


def _together(times_s: F64 | Sequence[float], wander_s: float) -> float:
    """Factor on the sigmas of readings at (n,) times whose errors wander with a time constant."""
    if len(times_s) == 0:
        return 1.0
    independent = 1.0 + float(np.ptp(times_s)) / (2.0 * max(wander_s, 1e-3))
    return float(np.sqrt(max(1.0, len(times_s) / independent)))


@dataclass(frozen=True, slots=True, eq=False)
class ReadingNoise:
    """How fixes and velocities err along one flight, 1 sigma per axis."""

    horizontal: Noise | None = None  # of a fix, m; None: as it claims
    vertical: Noise | None = None
    apart: tuple[Noise, Noise] | None = None  # the same off vision's track, which drifts as well
    reach_m: F64 | None = None  # (3,) how far fixes may wander
    tilt: Noise | None = None  # of an assumed view about its mount, rad
    claimed: F64 | None = None  # (3,) m as the fixes claim it
    walk_m_per_sqrt_s: float = 0.1  # of the integrated velocity
    rate_m_s: float = 0.05  # constant part of the velocity's error

    def of_fixes(self, claimed: F64, fix_s: float) -> tuple[F64, tuple[Noise, Noise]]:
        """(m, 3) sigma of a fix alone, and how such errors, in units of it, go along the track:
        horizontal and vertical."""
        if self.apart is not None:
            across, along = (replace(n, white=max(n.white, MIN_FIX_M)) for n in self.apart)
            single = np.full_like(claimed, [across.total, across.total, along.total])
            return single, (across.over(across.total), along.over(along.total))
        is_precise = len(claimed) > 0 and float(np.median(claimed[:, 0])) < PRECISE_M
        tau_s = PRECISE_TAU_S if is_precise else fix_s
        common = (WANDER_SHARE**-2 - 1.0) ** 0.5 if fix_s > 0 else 0.0
        usual = Noise(1.0, common, max(tau_s, 1.0))
        return WANDER_SHARE * claimed, (usual, usual)

    def or_else(self, usual: ReadingNoise | None, claimed: F64) -> ReadingNoise:
        """The same with the ``usual`` noise of fixes that claim as much, (m, 3), if their own is
        not known."""
        if self.horizontal is not None or usual is None or usual.claimed is None:
            return self
        if not len(claimed) or np.any(np.abs(np.log(np.median(claimed, 0) / usual.claimed)) > 0.5):
            return self
        tilt = self.tilt or usual.tilt
        walk, rate = self.walk_m_per_sqrt_s, self.rate_m_s
        return replace(usual, tilt=tilt, walk_m_per_sqrt_s=walk, rate_m_s=rate)

    def of_tilts(self, claimed: F64, times_s: F64, attitude_s: float) -> F64:
        """(n, 2) sigma with which assumed views weigh, of (n, 2) claimed ones at (n,) times."""
        if self.tilt is None:
            return np.asarray(claimed * _together(times_s, attitude_s))
        span_s = float(np.ptp(times_s)) if len(times_s) else 0.0
        return np.full_like(claimed, self.tilt.of_each(len(claimed), span_s))

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


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """A similarity, and the errors that readings have in common."""

    R: F64
    t: F64
    log_scale: float
    mount: F64 = field(default_factory=lambda: np.zeros(3))
    drift: float = 0.0

    def moved(self, step: F64) -> _State:
        """The state after a step (UNKNOWNS,)."""
        return _State(
            se3.so3_exp(step[:3]) @ self.R, self.t + step[3:6], self.log_scale + float(step[6]),
            self.mount + step[7:10], self.drift + float(step[10]),
        )  # fmt: skip


class _Readings:
    """The anchors' readings as arrays, by kind; rows of one reading form a group."""

    def __init__(
        self,
        anchors: Sequence[Anchor],
        noise: ReadingNoise | None = None,
        wander_s: tuple[float, float] = (60.0, 40.0),
    ) -> None:
        turned = [a for a in anchors if a.prior.R_world_camera is not None]
        fixed = [a for a in anchors if _has_fix(a.prior)]
        moved = [(a, b) for a, b in pairwise(anchors) if _are_on_one_run(a.prior, b.prior)]
        heights, independent = height_ratios(anchors)
        noise, (fix_s, attitude_s) = noise or ReadingNoise(), wander_s
        self.R_odom = _stack([a.T_odom_camera[:3, :3] for a in turned], (3, 3))
        self.R_prior = _stack([a.prior.R_world_camera for a in turned], (3, 3))
        self.is_assumed = np.array([a.prior.is_view_assumed for a in turned], bool)
        self.sigma_turn = _stack(
            [[a.prior.sigma_tilt_rad] * 2 + [a.prior.sigma_yaw_rad] for a in turned], (3,)
        )
        self.heading_known = self.sigma_turn[:, 2] < KNOWN_YAW_RAD
        self.tilt_s = _stack([a.time_s for a in turned if a.prior.is_view_assumed], ())
        self.sigma_turn[~self.is_assumed] *= _together(
            [a.time_s for a in turned if not a.prior.is_view_assumed], attitude_s
        )
        self.sigma_turn[self.is_assumed, :2] = noise.of_tilts(
            self.sigma_turn[self.is_assumed, :2], self.tilt_s, attitude_s
        )
        self.x = _stack([a.place_of_fix for a in fixed], (3,))
        self.fix = _stack([a.prior.position_m for a in fixed], (3,))
        self.claimed = _stack([a.prior.sigma_position_m for a in fixed], (3,))
        self.fix_s = _stack([a.time_s for a in fixed], ())
        self.is_height_claimed = all(a.prior.is_sigma_claimed for a in fixed)  # so without any
        self.sigma_fix, self.wander = noise.of_fixes(self.claimed, fix_s)
        self.step = _stack([b.place - a.place for a, b in moved], (3,))
        self.way = _stack([_way(a.prior, b.prior) for a, b in moved], (3,))
        self.way_s = _stack([_seconds(a.prior, b.prior) for a, b in moved], ())
        self.sigma_way = noise.of_travels(self.way_s, float(np.sum(self.way_s)))
        self.has_measured_heights = bool(heights) and independent > UNMEASURED_HEIGHTS
        self.has_heights = any(sigma < GUESSED_SHARE for _, sigma in heights)
        self.log_ratio = _stack([h[0] for h in heights], ())
        thinned = min(1.0, (independent / max(len(heights), 1)) ** 0.5)
        self.sigma_log = _stack([h[1] for h in heights], ()) / thinned
        three, single = len(turned) + len(fixed) + len(moved), len(heights)
        counts = np.array([3] * three + [1] * single + [4], int)
        self.group = np.repeat(np.arange(len(counts)), counts)
        """(M,) the group of each row."""
        known = 1.0 / self.sigma_turn
        known[~self.heading_known, 2] = 0.0
        way = np.repeat(1.0 / self.sigma_way, 3)
        self._whitening = np.concatenate(
            [known.ravel(), 1.0 / self.sigma_fix.ravel(), way, 1.0 / self.sigma_log,
             1.0 / self._sigma_common(turned)]
        )  # fmt: skip
        self.of_fixes = slice(len(turned), len(turned) + len(fixed))
        """Groups of the fixes."""
        self._turned, self._fixed = 3 * len(turned), 3 * len(fixed)
        self._rows = slice(self._turned, self._turned + self._fixed)  # of the fixes
        self._scaled = slice(self._turned, 3 * three)
        self._J = np.zeros((len(self.group), UNKNOWNS))  # where it is constant
        self._J[: self._turned, :3] = np.tile(np.eye(3), (len(turned), 1))
        self._J[self._rows, 3:6] = np.tile(np.eye(3), (len(fixed), 1))
        self._J[self._rows, 10] = np.outer(self.along, [0.0, 0.0, 1.0]).ravel()
        self._J[3 * three : -4, 6] = 1.0
        self._J[-4:, 7:] = np.eye(4)

    def _sigma_common(self, turned: Sequence[Anchor]) -> F64:
        """(4,) of the assumed mount and of the altitudes' drift; next to none where there is
        neither."""
        tilts = [a.prior.sigma_tilt_rad for a in turned if a.prior.is_view_assumed]
        mount = float(np.median(tilts)) if tilts else TINY
        drift = TINY if self.is_height_claimed else float(np.median(self.claimed[:, 2]))
        return np.array([mount] * 3 + [drift])

    @cached_property
    def spanned(self) -> Common:
        """The times of the fixes."""
        if len(self.fix_s) == 0:
            return Common()
        first, last = float(self.fix_s[0]), float(self.fix_s[-1])
        return Common(middle_s=0.5 * (first + last), half_s=max(0.5 * (last - first), 1e-3))

    @property
    def along(self) -> F64:
        """(m,) times of the fixes, -1 to 1."""
        return self.spanned.along(self.fix_s)

    def heights(self, at: _State, H: F64, covariance: F64) -> Heights:
        """What the fixes tell about the mean height; ``covariance`` (7, 7) is that of the fit."""
        east, north, up = np.exp(at.log_scale) * at.R @ self.x.mean(axis=0)
        of_mean = np.array([north, -east, 0.0, 0.0, 0.0, 1.0, up])
        sigma_m, time_s = float(np.sqrt(of_mean @ covariance @ of_mean)), float(self.fix_s.mean())
        if self.is_height_claimed:
            return Heights(sigma_m, time_s, 0.0, 0.0)
        sigma_drift_m = float(np.sqrt(np.linalg.inv(H)[10, 10]))
        half_s = self.spanned.half_s
        return Heights(sigma_m, time_s, at.drift / half_s, sigma_drift_m / half_s)

    def common(self, at: _State) -> Common:
        """What the readings have in common."""
        return replace(self.spanned, mount_rad=at.mount, drift_m=at.drift)

    def linearised(self, at: _State) -> tuple[F64, F64]:
        """Whitened residuals (M,) and Jacobian (M, UNKNOWNS)."""
        fix, way = self.placed(at), self.moved(at)
        turn, of_mount = self.turned(at)
        J = self._J.copy()
        drifted = np.outer(self.along * at.drift, [0.0, 0.0, 1.0])
        y = np.concatenate([fix + self.fix - drifted - at.t, way + self.way])
        of = J[self._scaled].reshape(-1, 3, UNKNOWNS)
        of[:, 0, 1], of[:, 1, 2], of[:, 2, 0] = y[:, 2], y[:, 0], y[:, 1]
        of[:, 0, 2], of[:, 1, 0], of[:, 2, 1] = -y[:, 1], -y[:, 2], -y[:, 0]
        of[:, :, 6] = y
        J[: self._turned, 7:10] = of_mount.reshape(-1, 3)
        height, common = at.log_scale - self.log_ratio, np.r_[at.mount, at.drift]
        r = np.concatenate([turn.ravel(), fix.ravel(), way.ravel(), height, common])
        return r * self._whitening, J * self._whitening[:, None]

    def information(self, extra: F64) -> list[F64]:
        """(m, m) inverse covariances of whitened fixes, horizontal and vertical, each with an
        ``extra`` (2, m) variance of its own."""
        return [n.information(self.fix_s, e) for n, e in zip(self.wander, extra, strict=True)]

    def alone(self, r: F64, known: Sequence[F64], extra: F64) -> F64:
        """(m,) whitened residual of each fix against what all others tell about its error."""
        fixes, square = r[self._rows].reshape(-1, 3), np.zeros(len(self.fix))
        for axes, P, own in zip(AXES, known, extra, strict=True):
            variance = 1.0 / np.diag(P)
            left = (P @ fixes[:, axes]) * variance[:, None]
            square += np.sum(left**2, axis=1) / (variance - own)
        return np.sqrt(square)

    def doubted(self, known: Sequence[F64], extra: F64, weight: F64) -> F64:
        """(2, m) variance that gives fixes the weight (groups,): their neighbours keep theirs."""
        alone = np.array([1.0 / np.diag(P) for P in known]) - extra
        return np.asarray(alone * (1.0 / np.maximum(weight[self.of_fixes], TINY) - 1.0))

    def weighted(self, rows: F64, weight: F64, known: Sequence[F64]) -> F64:
        """Whitened rows (M, k) times the inverse of their errors' covariance; ``weight`` (groups,)
        is of all but fixes, whose inverse is ``known``."""
        out = rows * weight[self.group][:, None]
        fixes = rows[self._rows].reshape(len(self.fix), 3, rows.shape[1])
        parts = [
            np.einsum("ij,jak->iak", P, fixes[:, axes]) for axes, P in zip(AXES, known, strict=True)
        ]
        out[self._rows] = np.concatenate(parts, axis=1).reshape(-1, rows.shape[1])
        return out

    def excess(self, r: F64, kept: F64) -> float:
        """Variance factor of the fixes: 1 where their residuals (M,) are as their noise says."""
        none = np.zeros((2, len(self.fix)))
        known = self.information(self.doubted(self.information(none), none, kept))
        free = 3.0 * float(np.sum(kept[self.of_fixes])) - 7.0
        weighted = self.weighted(r[:, None], kept, known)[:, 0]
        return float(r[self._rows] @ weighted[self._rows]) / max(free, 1.0)

    def placed(self, at: _State) -> F64:
        """(m, 3) m from the fixes, without their drift, to where the similarity has them."""
        placed = np.exp(at.log_scale) * self.x @ at.R.T + at.t
        return np.asarray(placed + np.outer(self.along * at.drift, [0.0, 0.0, 1.0]) - self.fix)

    def moved(self, at: _State) -> F64:
        """(k, 3) m from ways by velocity to those by vision."""
        return np.asarray(np.exp(at.log_scale) * self.step @ at.R.T - self.way)

    def turned(self, at: _State) -> tuple[F64, F64]:
        """(n, 3) rotations from the attitudes; of one whose heading is unknown, the tilt alone.

        And (n, 3, 3) how they change with the mount.
        """
        n = len(self.R_odom)
        if n == 0:
            return np.zeros((0, 3)), np.zeros((0, 3, 3))
        seen, R_prior = at.R @ self.R_odom, self.R_prior.copy()
        R_prior[self.is_assumed] = R_prior[self.is_assumed] @ se3.so3_exp(at.mount)
        turn = se3.each_so3_log(seen @ R_prior.transpose(0, 2, 1))
        up = np.einsum("nij,nj->ni", seen, R_prior[:, 2])  # where the prior's up points now
        tilt = np.column_stack([-up[:, 1], up[:, 0], np.zeros(n)])
        of_up = (seen @ se3.hat(R_prior[:, 2])) * self.is_assumed[:, None, None]
        of_mount = np.stack([-of_up[:, 1], of_up[:, 0], np.zeros((n, 3))], axis=1)
        return np.where(self.heading_known[:, None], turn, tilt), of_mount


def fit(
    anchors: Sequence[Anchor],
    fix_s: float = 60.0,
    attitude_s: float = 40.0,
    iterations: int = 30,
    slow_share: float = 1.0,
    usual: ReadingNoise | None = None,
) -> Similarity | None:
    """The similarity that brings the anchors onto their priors, or None without any prior.

    The anchors stand in the order of time; ``fix_s`` and ``attitude_s`` are the usual time
    constants with which a receiver and assumed views wander. How fixes and velocities err is
    measured by their residuals against the track of a first fit and weighs them in a second one.
    An assumed view is off by one angle in all images, and altitudes of no stated accuracy drift:
    both are fitted too. Attitudes of one flight err together, so the covariance is inflated by
    their number. The receiver's error that all fixes share goes into the position's covariance.
    ``slow_share`` is the part of its variance that may wander. Too few fixes to be measured err as
    the ``usual`` ones of the flight.
    """
    usable = [a for a in anchors if a.prior.R_world_camera is not None or _has_fix(a.prior)]
    if not usable:
        return None
    wander_s = (fix_s, attitude_s)
    readings = _Readings(usable, wander_s=wander_s)
    if _velocities_contradict(readings):
        usable = [replace(a, prior=replace(a.prior, travel=None)) for a in usable]
        readings = _Readings(usable, wander_s=wander_s)
    found = [_solve(readings, start, iterations) for start in _starts(usable, readings)]
    best = min(found, key=lambda f: f.cost)
    noise = _measured(usable, best.at, wander_s, iterations, slow_share)
    noise = noise.or_else(usual, readings.claimed)
    readings = _Readings(usable, noise, wander_s)
    best = _solve(readings, best.at, iterations)
    covariance = np.asarray(np.linalg.inv(best.H)[:7, :7] * max(best.excess, 1.0), np.float64)
    heights = None
    if len(readings.fix) and noise.horizontal is not None:
        heights = readings.heights(best.at, best.H, covariance)
    covariance[6, 6] += STEP_SHARE**2 / max(len(usable) - 1, 1)
    mean = counted = None
    if len(readings.fix):
        covariance[3:6, 3:6] += np.diag(np.mean(np.square(readings.claimed), axis=0))
    if len(readings.fix) and fix_s > 0:
        mean, counted = noise.of_mean(readings.claimed, readings.fix_s, fix_s)
    at = best.at
    similarity = Similarity(
        float(np.exp(at.log_scale)), at.R, at.t, covariance, _sources(readings), noise, mean,
        counted, readings.common(at), heights=heights,
    )  # fmt: skip
    if not readings.is_assumed.all() or not len(readings.fix):
        return similarity
    lean = np.zeros((6, 6))
    lean[:2, :2] = covariance[:2, :2]
    centre = similarity.place(readings.x.mean(axis=0))
    return replace(similarity, lean=se3.about(-centre, lean))


def _measured(
    anchors: Sequence[Anchor],
    start: _State,
    wander_s: tuple[float, float],
    iterations: int,
    slow_share: float,
) -> ReadingNoise:
    """The noise of fixes and of velocities, each by its residuals to the track as it alone, with
    the tilt of the attitudes, has it: a compass that is off would look like a drift."""
    level = [
        replace(a, height=None, prior=replace(a.prior, sigma_yaw_rad=NO_YAW_RAD)) for a in anchors
    ]
    fixed = [replace(a, prior=replace(a.prior, travel=None)) for a in level]
    moved = [replace(a, prior=replace(a.prior, position_m=None)) for a in level]
    out, fixes = ReadingNoise(), _Readings(fixed, None, wander_s)
    # Altitudes that weigh too little leave a lean, which looks like a wander of theirs.
    for _ in range(1 if fixes.is_height_claimed else ROUNDS):
        at = _solve(fixes, start, iterations).at
        out = _of_fixes(fixes, at, wander_s, slow_share)
        fixes = _Readings(fixed, out, wander_s)
    ways = _Readings(moved, None, wander_s)
    if len(ways.way) >= MIN_READINGS:
        drift = ways.moved(_solve(ways, start, iterations).at)
        found = drift_noise(np.cumsum(ways.way_s), np.cumsum(drift, axis=0))
        if found is not None:
            walk, rate = max(found[0], MIN_WALK), max(found[1], MIN_RATE_M_S)
            out = replace(out, walk_m_per_sqrt_s=walk, rate_m_s=rate)
    return out


def _of_fixes(
    fixes: _Readings, at: _State, wander_s: tuple[float, float], slow_share: float
) -> ReadingNoise:
    """The noise of fixes and of assumed views, by their residuals to a track.

    A slow difference may be vision's own drift, so a wander is bounded by what the sensor claims.
    Its white part is not: from one fix to the next vision does not err by as much. Altitudes whose
    accuracy nothing states wander as they are seen to, and by a share of their drift: none is
    steady.
    """
    fix_s, attitude_s = wander_s
    if len(fixes.fix) < MIN_READINGS:
        return ReadingNoise()
    tilts = fixes.turned(at)[0][fixes.is_assumed, :2]
    tilt = wander_noise(fixes.tilt_s, tilts, attitude_s, 1.0)
    if tilt is not None:
        tilt = tilt.bounded(ASSUMED_TILT_RAD, attitude_s, MIN_WANDER * ASSUMED_TILT_RAD)
    apart, is_claimed = fixes.placed(at), fixes.is_height_claimed
    flat_off, high_off = (wander_noise(fixes.fix_s, apart[:, k], fix_s, 1.0) for k in AXES)
    across = wander_noise(fixes.fix_s, apart[:, :2], fix_s)
    along = wander_noise(fixes.fix_s, apart[:, 2:], fix_s, SURE_OF_WANDER if is_claimed else 1.0)
    if across is None or along is None or flat_off is None or high_off is None:
        return ReadingNoise(tilt=tilt)
    claimed = np.median(fixes.claimed, axis=0)
    flat, high = float(claimed[:2].mean()), float(claimed[2])
    least = 1.0 if is_claimed else MIN_WANDER
    reach = across.reach(flat, min(least, slow_share))
    span_s = float(np.ptp(fixes.fix_s))
    most, drift = across.reach(flat, slow_share), high if is_claimed else abs(at.drift)
    vertical = along.bounded(high, fix_s, MIN_WANDER * drift)
    return ReadingNoise(
        horizontal=across.bounded(most, fix_s, MIN_WANDER * most),
        vertical=vertical,
        apart=(
            flat_off.drifting(most, fix_s, span_s),
            high_off.drifting(high, fix_s, span_s) if is_claimed else vertical,
        ),
        reach_m=np.array([reach, reach, along.reach(high, least)]),
        tilt=tilt,
        claimed=claimed,
    )


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
    """The best state with its (UNKNOWNS, UNKNOWNS) information and its robust cost."""

    at: _State
    H: F64
    cost: float
    excess: float  # squared residuals of the fixes over what their noise explains


def _solve(readings: _Readings, at: _State, iterations: int) -> _Solution:
    """Gauss-Newton with Huber's weights."""
    group, kept = readings.group, np.ones(int(readings.group[-1]) + 1)
    H, cost, extra = np.eye(UNKNOWNS), np.inf, np.zeros((2, len(readings.fix)))
    ridge = np.diag([1e-6] * 6 + [1e-4] + [0.0] * 4)
    for i in range(iterations + 10):
        r, J = readings.linearised(at)
        norms = np.sqrt(np.bincount(group, weights=r**2, minlength=len(kept)))
        cost = float(np.sum(np.where(norms < HUBER, 0.5 * norms**2, HUBER * (norms - HUBER / 2))))
        known = readings.information(extra)
        alone, fixes = readings.alone(r, known, extra), norms[readings.of_fixes]
        np.maximum(fixes, alone * np.where(alone > ODD, WILD / ODD, 1.0), out=fixes)
        weight = kept * np.minimum(1.0, HUBER / np.maximum(norms, 1e-9))
        W = readings.weighted(np.column_stack([J, r]), weight, known)
        extra = readings.doubted(known, extra, weight)
        H, g = J.T @ W[:, :-1] + ridge, J.T @ W[:, -1]
        step = np.linalg.solve(H, -g)
        step[:3] = np.clip(step[:3], -0.5, 0.5)
        step[6:10] = np.clip(step[6:10], -0.5, 0.5)
        at = at.moved(step)
        stands = np.abs(step).max() < 1e-7 or i >= iterations - 1
        if stands and not (kept.all() and _leave_out(readings, norms, kept)):
            break
    return _Solution(at, H, cost, readings.excess(r, kept))


def _leave_out(readings: _Readings, norms: F64, kept: F64) -> bool:
    """True when attitudes or fixes are wild and now out of ``kept``: fewer than half of them."""
    n, m = len(readings.R_odom), len(readings.fix)
    for kind in (slice(0, n), slice(n, n + m)):
        wild = norms[kind] > WILD
        if 2 * wild.sum() < len(wild):
            kept[kind][wild] = 0.0
    return not kept.all()


def _starts(anchors: Sequence[Anchor], readings: _Readings) -> list[_State]:
    """To begin with: by the attitude, and by the track.

    The second matters when the compass is far off or there is none: then only the track of
    the fixes determines the heading.
    """
    R = np.eye(3)
    for a in anchors:
        if a.prior.R_world_camera is not None:
            R = a.prior.R_world_camera @ a.T_odom_camera[:3, :3].T
            break
    if not len(readings.fix):
        return [_State(R, -R @ anchors[0].T_odom_camera[:3, 3], 0.0)]
    x = readings.x @ R.T
    starts = [_State(R, np.asarray(np.median(readings.fix - x, axis=0)), 0.0)]
    if len(x) >= 4:
        weight = 1.0 / np.mean(readings.claimed**2, axis=1)
        scale, turn, _ = umeyama(x, readings.fix, weight)
        if scale > 0:
            shift = np.asarray(np.median(readings.fix - scale * x @ turn.T, axis=0))
            starts.append(_State(turn @ R, shift, float(np.log(scale))))
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
