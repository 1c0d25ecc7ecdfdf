"""The readings that place a segment, as rows of one least-squares problem, and how they err.

Errors of fixes next to each other are not independent, nor are those of velocities: both weigh by
the inverse of their covariance (:mod:`recon.posegraph.sensor_noise`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from recon import se3
from recon.posegraph.ground import GUESSED_SHARE, UNMEASURED_HEIGHTS, height_ratios
from recon.posegraph.pose_priors import MIN_FIX_M, has_fix, off_attitudes
from recon.posegraph.records import FRAME_DRIFT, Node
from recon.posegraph.sensor_noise import ATTITUDE_S, FIX_S, Noise, bias_time_constant_s, inflation
from recon.similarity import Similarity
from recon.types import F64, Bool, PosePrior

BIAS_SHARE = 0.6  # of a fix's sigma that differs along a flight; the rest is common to all

KNOWN_YAW_RAD, NO_YAW_RAD = 1.0, 3.0
"""Sigma below which a heading counts as known, and one of a heading that is not."""

USUAL_RATE_M_S, RATE_S = 0.05, 20.0  # slow part of a velocity's error: sigma and time constant
MIN_TRAVEL_S = 1e-3  # no travel by velocity is shorter
UNKNOWNS = 11  # rotation, shift and log scale; an assumed view's mount and the drift of altitudes
AXES = (slice(0, 2), slice(2, 3))  # those of a position that err alike: horizontal and vertical
LEVEL_SIGMAS = 3.0  # so many of an attitude's by which it and fixes differ on what is level
TINY = 1e-6  # sigma of what no reading has


Heights = tuple[float, float, float]
"""What fixes of one receiver tell about heights against each other: sigma of the mean height in m,
its time in s, and the drift in m/s that they may have, 0 where they state their accuracy."""


@dataclass(frozen=True, slots=True, eq=False)
class ReadingNoise:
    """How fixes and velocities err along one flight, 1 sigma per axis."""

    fixes: tuple[Noise, Noise, Noise] | None = None  # of a fix, m, by axis; None: as it claims
    off_track: tuple[Noise, Noise] | None = None  # off vision's track, which drifts too; h and v
    reach_m: F64 | None = None  # (3,) how far fixes may wander
    tilt: Noise | None = None  # of an assumed view about its mount, rad
    claimed: F64 | None = None  # (3,) m as the fixes claim it
    over_claim: F64 = field(default_factory=lambda: np.ones(3))  # times their scatter exceeds it
    fresh_share: F64 = field(default_factory=lambda: np.ones(3))  # of fixes, by their correlation
    walk_m_per_sqrt_s: float = 0.1  # of the integrated velocity
    rate_m_s: float = USUAL_RATE_M_S  # of the velocity, which errs so for RATE_S

    def of_fixes(self, claimed: F64) -> tuple[F64, tuple[Noise, Noise]]:
        """(m, 3) sigma of a fix alone, and how such errors, in units of it, go along the track:
        horizontal and vertical."""
        if self.off_track is not None:
            h, v = (replace(n, white=max(n.white, MIN_FIX_M)) for n in self.off_track)
            single = np.full_like(claimed, [h.total, h.total, v.total])
            return single, (h.in_units_of(h.total), v.in_units_of(v.total))
        tau_s = bias_time_constant_s(float(np.median(claimed[:, 0]))) if len(claimed) else FIX_S
        usual = Noise(1.0, (BIAS_SHARE**-2 - 1.0) ** 0.5, tau_s)
        return BIAS_SHARE * claimed, (usual, usual)

    def or_else(self, usual: ReadingNoise | None, claimed: F64) -> ReadingNoise:
        """The same with the ``usual`` noise of fixes that claim as much, (m, 3), if their own is
        not known."""
        if self.fixes is not None or usual is None or usual.claimed is None:
            return self
        if not len(claimed) or np.any(np.abs(np.log(np.median(claimed, 0) / usual.claimed)) > 0.5):
            return self
        tilt = self.tilt or usual.tilt
        walk, rate = self.walk_m_per_sqrt_s, self.rate_m_s
        return replace(usual, tilt=tilt, walk_m_per_sqrt_s=walk, rate_m_s=rate)

    def of_tilts(self, claimed: F64, times_s: F64) -> F64:
        """(n, 2) sigma with which assumed views weigh, of (n, 2) claimed ones at (n,) times."""
        span_s = float(np.ptp(times_s)) if len(times_s) else 0.0
        if self.tilt is None:
            return np.asarray(claimed * inflation(len(claimed), span_s, ATTITUDE_S))
        return np.full_like(claimed, self.tilt.effective_sigma(len(claimed), span_s))

    def of_mean(self, claimed: F64, times_s: F64) -> tuple[F64, F64]:
        """(3,) sigma of the mean error of fixes with (m, 3) claimed sigmas at (m,) times, and what
        the readings in a graph count for it."""
        usual, count, span_s = np.median(claimed, axis=0), len(claimed), float(np.ptp(times_s))
        if self.fixes is None or self.reach_m is None:
            return usual, usual / np.sqrt(1.0 + span_s / (2.0 * FIX_S))
        far = zip(self.fixes, self.reach_m, count * self.fresh_share, strict=True)
        mean = [one.of_mean(float(m), float(n), span_s) for one, m, n in far]
        counted = [one.effective_sigma(count, span_s) / count**0.5 for one in self.fixes]
        return np.array(mean), np.array(counted)

    def of_travels(self, seconds: F64) -> F64:
        """(k,) sigma of the mean velocity, m/s, over each of so many seconds."""
        return np.asarray(np.hypot(self.walk_m_per_sqrt_s / np.sqrt(seconds), self.rate_m_s))


@dataclass(frozen=True, slots=True, eq=False)
class Alignment(Similarity):
    """``x_world = scale * R @ x_odom + t``; covariance of (rotation, translation, log scale)."""

    covariance: F64 = field(default_factory=lambda: np.eye(7))
    sources: tuple[str, ...] = ()
    noise: ReadingNoise | None = None  # as measured by the fit; None without one
    sigma_fixes: F64 | None = None  # (3,) m of the mean error of all fixes, where they wander
    sigma_counted: F64 | None = None  # (3,) m that the readings in the graph count for it
    mount_rad: F64 = field(default_factory=lambda: np.zeros(3))  # turns assumed views
    drift_m: float = 0.0  # by which altitudes are too high in the end, and too low at first
    span_s: tuple[float, float] = (0.0, 1.0)  # of the drift: the middle, and half its length
    heights: Heights | None = None  # where the noise of fixes is known
    bend_rad: float = 0.0  # sigma of a part of the track against its mean, as vision's turns add up
    lean: F64 | None = None  # (6, 6) of a left perturbation that tilts all; None: level is known

    def moved(self, step: F64) -> Alignment:
        """The same after a step (UNKNOWNS,) of the fit."""
        return replace(
            self, scale=self.scale * float(np.exp(step[6])), R=se3.so3_exp(step[:3]) @ self.R,
            t=self.t + step[3:6], mount_rad=self.mount_rad + step[7:10],
            drift_m=self.drift_m + float(step[10]),
        )  # fmt: skip

    @property
    def sigma_scale(self) -> float:
        return float(np.sqrt(self.covariance[6, 6]))

    @property
    def sigma_lean_rad(self) -> float | None:
        """1-sigma uncertainty of what is level somewhere, about the axis where it is largest."""
        if self.lean is None:
            return None
        return float(np.sqrt(np.linalg.eigvalsh(self.lean[:2, :2])[-1] + self.bend_rad**2))


class AlignmentReadings:
    """The nodes' readings as arrays, by kind; rows of one reading form a group."""

    def __init__(
        self,
        nodes: Sequence[Node],
        noise: ReadingNoise | None = None,
        sigma_mount_rad: float | None = None,
    ) -> None:
        """``sigma_mount_rad`` is that of the mount of assumed views; None: as they state it."""
        turned = [a for a in nodes if a.prior.R_world_camera is not None]
        fixed = [a for a in nodes if has_fix(a.prior)]
        moved = [(a, b, w) for a, b in pairwise(nodes) if (w := _travelled(a.prior, b.prior))]
        heights, independent = height_ratios(nodes)
        noise = noise or ReadingNoise()
        self.R_odom = _stack([a.T_odom_camera[:3, :3] for a in turned], (3, 3))
        self.R_prior = _stack([a.prior.R_world_camera for a in turned], (3, 3))
        self.is_assumed = np.array([a.prior.is_view_assumed for a in turned], bool)
        self.sigma_turn = _stack(
            [[a.prior.sigma_tilt_rad] * 2 + [a.prior.sigma_yaw_rad] for a in turned], (3,)
        )
        self.heading_known = self.sigma_turn[:, 2] < KNOWN_YAW_RAD
        self.tilt_s = _stack([a.time_s for a in turned if a.prior.is_view_assumed], ())
        known_s = [a.time_s for a in turned if not a.prior.is_view_assumed]
        self.claimed_tilt = self.sigma_turn[~self.is_assumed, 0].copy()
        span_s = float(np.ptp(known_s)) if known_s else 0.0
        self.sigma_turn[~self.is_assumed] *= inflation(len(known_s), span_s, ATTITUDE_S)
        self.sigma_turn[self.is_assumed, :2] = noise.of_tilts(
            self.sigma_turn[self.is_assumed, :2], self.tilt_s
        )
        self.x = _stack([a.place_of_fix for a in fixed], (3,))  # in the odometry
        self.fix = _stack([a.prior.position_m for a in fixed], (3,))  # in the world
        self.claimed = _stack([a.prior.sigma_position_m for a in fixed], (3,))
        self.fix_s = _stack([a.time_s for a in fixed], ())
        self.is_height_claimed = all(a.prior.is_sigma_claimed for a in fixed)  # so without any
        self.sigma_fix, self.fix_noise = noise.of_fixes(self.claimed)
        self.step = _stack([b.place - a.place for a, b, _ in moved], (3,))  # by vision
        self.travel_m = _stack([metres for *_, (metres, _) in moved], (3,))  # the same by velocity
        self.travel_s = np.maximum(_stack([s for *_, (_, s) in moved], ()), MIN_TRAVEL_S)
        self.travel_end_s = _stack([b.time_s for _, b, _ in moved], ())
        self.sigma_speed = noise.of_travels(self.travel_s)
        self._slow = Noise(0.0, noise.rate_m_s, RATE_S)
        self.has_measured_heights = bool(heights) and independent > UNMEASURED_HEIGHTS
        self.has_heights = any(sigma < GUESSED_SHARE for _, sigma in heights)
        self.is_height_assumed = bool(heights) and not self.has_heights
        self.log_ratio = _stack([h[0] for h in heights], ())  # of telemetry's height to vision's
        thinned = min(1.0, (independent / max(len(heights), 1)) ** 0.5)
        self.sigma_log = _stack([h[1] for h in heights], ()) / thinned
        three, single = len(turned) + len(fixed) + len(moved), len(heights)
        counts = np.array([3] * three + [1] * single + [4], int)
        self.group = np.repeat(np.arange(len(counts)), counts)
        """(M,) the group of each row."""
        known = 1.0 / self.sigma_turn
        known[~self.heading_known, 2] = 0.0
        travel = np.repeat(1.0 / (self.sigma_speed * self.travel_s), 3)
        self._whitening = np.concatenate(
            [known.ravel(), 1.0 / self.sigma_fix.ravel(), travel, 1.0 / self.sigma_log,
             1.0 / self._sigma_common(turned, sigma_mount_rad)]
        )  # fmt: skip
        self.of_fixes = slice(len(turned), len(turned) + len(fixed))
        """Groups of the fixes."""
        self.of_travels = slice(self.of_fixes.stop, three)
        """Groups of the travels."""
        self._turned, self._fixed = 3 * len(turned), 3 * len(fixed)
        self._rows = slice(self._turned, self._turned + self._fixed)  # of the fixes
        self._scaled = slice(self._turned, 3 * three)
        self._moved = slice(self._rows.stop, 3 * three)  # of the travels
        self._J = np.zeros((len(self.group), UNKNOWNS))  # where it is constant
        self._J[: self._turned, :3] = np.tile(np.eye(3), (len(turned), 1))
        self._J[self._rows, 3:6] = np.tile(np.eye(3), (len(fixed), 1))
        self._J[self._rows, 10] = np.outer(self.time_share, [0.0, 0.0, 1.0]).ravel()
        self._J[3 * three : -4, 6] = 1.0
        self._J[-4:, 7:] = np.eye(4)

    def _sigma_common(self, turned: Sequence[Node], sigma_mount_rad: float | None) -> F64:
        """(4,) of the assumed mount and of the altitudes' drift; next to none where there is
        neither."""
        tilts = [a.prior.sigma_tilt_rad for a in turned if a.prior.is_view_assumed]
        mount = sigma_mount_rad or (float(np.median(tilts)) if tilts else TINY)
        drift = TINY if self.is_height_claimed else float(np.median(self.claimed[:, 2]))
        return np.array([mount] * 3 + [drift])

    @cached_property
    def span_s(self) -> tuple[float, float]:
        """The middle of the fixes' time, and half its length."""
        if len(self.fix_s) == 0:
            return 0.0, 1.0
        first, last = float(self.fix_s[0]), float(self.fix_s[-1])
        return 0.5 * (first + last), max(0.5 * (last - first), 1e-3)

    @property
    def time_share(self) -> F64:
        """(m,) times of the fixes, -1 to 1."""
        return from_middle(self.fix_s, *self.span_s)

    def heights(self, at: Alignment, H: F64, covariance: F64) -> Heights:
        """What the fixes tell about the mean height; ``covariance`` (7, 7) is that of the fit."""
        east, north, up = at.scale * at.R @ self.x.mean(axis=0)
        of_mean = np.array([north, -east, 0.0, 0.0, 0.0, 1.0, up])
        sigma_m, time_s = float(np.sqrt(of_mean @ covariance @ of_mean)), float(self.fix_s.mean())
        if self.is_height_claimed:
            return sigma_m, time_s, 0.0
        sigma_drift_m = float(np.sqrt(np.linalg.inv(H)[10, 10]))
        _, half_s = self.span_s
        return sigma_m, time_s, float(np.hypot(at.drift_m / half_s, sigma_drift_m / half_s))

    def linearised(self, at: Alignment) -> tuple[F64, F64]:
        """Whitened residuals (M,) and Jacobian (M, UNKNOWNS)."""
        fix, travel = self.fix_residuals(at), self.velocity_residuals(at)
        turn, of_mount = self.attitude_residuals(at)
        J = self._J.copy()
        drifted = np.outer(self.time_share * at.drift_m, [0.0, 0.0, 1.0])
        y = np.concatenate([fix + self.fix - drifted - at.t, travel + self.travel_m])
        of = J[self._scaled].reshape(-1, 3, UNKNOWNS)
        of[:, :, :3], of[:, :, 6] = -se3.hat(y), y
        J[: self._turned, 7:10] = of_mount.reshape(-1, 3)
        height, common = np.log(at.scale) - self.log_ratio, np.r_[at.mount_rad, at.drift_m]
        r = np.concatenate([turn.ravel(), fix.ravel(), travel.ravel(), height, common])
        return r * self._whitening, J * self._whitening[:, None]

    def information(self, extra: F64) -> list[F64]:
        """(m, m) inverse covariances of whitened fixes, horizontal and vertical, each with an
        ``extra`` (2, m) variance of its own."""
        return [n.information(self.fix_s, e) for n, e in zip(self.fix_noise, extra, strict=True)]

    def leave_one_out(self, r: F64, known: Sequence[F64], extra: F64) -> F64:
        """(m,) whitened residual of each fix against what all others tell about its error."""
        fixes, square = r[self._rows].reshape(-1, 3), np.zeros(len(self.fix))
        for axes, P, own in zip(AXES, known, extra, strict=True):
            variance = 1.0 / np.diag(P)
            left = (P @ fixes[:, axes]) * variance[:, None]
            square += np.sum(left**2, axis=1) / (variance - own)
        return np.sqrt(square)

    def outlier_variance(self, known: Sequence[F64], extra: F64, weight: F64) -> F64:
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
        out[self._moved] = self._weighted_travels(rows[self._moved], weight[self.of_travels])
        return out

    def _weighted_travels(self, rows: F64, weight: F64) -> F64:
        """Whitened rows (3 k, c) times the inverse of their covariance: a velocity's slow error
        adds up. An outlier of a ``weight`` (k,) below 1 gets a variance of its own."""
        sigma = self.sigma_speed[:, None]
        own = self.sigma_speed**2 / np.maximum(weight, TINY) - self._slow.bias**2
        travels = sigma * rows.reshape(len(sigma), 3 * rows.shape[1])
        return (sigma * self._slow.weighted(self.travel_end_s, own, travels)).reshape(rows.shape)

    def variance_factor(self, r: F64, weighted: F64, kept: Bool) -> float:
        """Variance factor of the fixes by residuals (M,), the same ``weighted``, and which groups
        are ``kept``: 1 where they are as their noise says."""
        free = 3.0 * np.count_nonzero(kept[self.of_fixes]) - 7.0
        return float(r[self._rows] @ weighted[self._rows]) / max(free, 1.0)

    def fix_residuals(self, at: Alignment) -> F64:
        """(m, 3) m from the fixes, without their drift, to where the similarity has them."""
        drifted = np.outer(self.time_share * at.drift_m, [0.0, 0.0, 1.0])
        return np.asarray(at.scale * self.x @ at.R.T + at.t + drifted - self.fix)

    def velocity_residuals(self, at: Alignment) -> F64:
        """(k, 3) m from travels by velocity to those by vision."""
        return np.asarray(at.scale * self.step @ at.R.T - self.travel_m)

    def attitude_residuals(self, at: Alignment) -> tuple[F64, F64]:
        """(n, 3) rotations from the attitudes; of one whose heading is unknown, the tilt alone. And
        (n, 3, 3) how they change with the mount."""
        n = len(self.R_odom)
        if n == 0:
            return np.zeros((0, 3)), np.zeros((0, 3, 3))
        seen, R_prior = at.R @ self.R_odom, self.R_prior.copy()
        R_prior[self.is_assumed] = R_prior[self.is_assumed] @ se3.so3_exp(at.mount_rad)
        of_up = seen @ se3.hat(R_prior[:, 2])
        of_tilt = np.stack([-of_up[:, 1], of_up[:, 0], np.zeros((n, 3))], axis=1)
        of_mount = np.where(self.heading_known[:, None, None], -seen, of_tilt)
        of_mount *= self.is_assumed[:, None, None]
        return off_attitudes(seen, R_prior, self.heading_known), of_mount

    def over_claim(self, residuals: F64, scale: float, white: Sequence[float]) -> F64:
        """(3,) times that fixes scatter further than claimed, 1 at least, by their
        ``residuals`` (m, 3) to the track, which drifts as well, and what is ``white`` of these."""
        drift_m = FRAME_DRIFT * scale * float(np.linalg.norm(np.diff(self.x, axis=0), axis=1).sum())
        far = [1.4826 * float(np.median(np.abs(residuals[:, axes]))) for axes in AXES]
        seen = np.sqrt(np.maximum(np.square(far) - drift_m**2, np.square(white)))[[0, 0, 1]]
        return np.asarray(np.maximum(seen / np.median(self.claimed, axis=0), 1.0))

    def tilt_off(self, at: Alignment) -> F64:
        """(2,) by which known attitudes and fixes differ on what is level; 0 where it may be
        noise. Neither says which of them is wrong."""
        if not len(self.claimed_tilt):
            return np.zeros(2)
        off: F64 = np.median(self.attitude_residuals(at)[0][~self.is_assumed, :2], axis=0)
        is_noise = np.linalg.norm(off) < LEVEL_SIGMAS * np.median(self.claimed_tilt)
        return np.zeros(2) if is_noise else off


def from_middle(time_s: float | F64, middle_s: float, half_s: float) -> F64:
    """Times as -1 at the start of the readings to 1 at their end, and no further."""
    return np.asarray(np.clip((time_s - middle_s) / half_s, -1.0, 1.0))


def _travelled(a: PosePrior, b: PosePrior) -> tuple[F64, float] | None:
    """(3,) m flown by velocity between two priors, and the seconds; None where it was not
    integrated from one to the other without a gap."""
    one, two = a.travel, b.travel
    if one is None or two is None or one.run != two.run:
        return None
    return two.metres - one.metres, two.seconds - one.seconds


def _stack(rows: Sequence[object], shape: tuple[int, ...]) -> F64:
    return np.asarray(rows, np.float64).reshape(len(rows), *shape)
