"""Priors on a keyframe's pose by telemetry: made sound, averaged between keyframes, dead-reckoned.

A keyframe speaks for what came since the one before it (:func:`averaged`): for frames that are no
keyframes (:class:`FixAverage`), and for keyframes that are no nodes any more. The mean of fixes is
the fix of the mean place, in whatever frame and scale vision has it.

The difference of two travels of one run errs by the time between them only, and so gives the scale
of the odometry better than fixes, whose error wanders.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from recon import se3
from recon.posegraph.records import Node
from recon.types import F64, Bool, PosePrior, Travel

MIN_FIX_M = 0.005  # sigma that no fix is better than
MIN_TURN_RAD = 1e-4  # sigma that no attitude is better than
MAX_WORSE = 2.0  # a fix whose sigma is so many times that of another spoils their mean


def has_fix(prior: PosePrior) -> bool:
    return prior.position_m is not None and prior.sigma_position_m is not None


def check_prior(prior: PosePrior) -> None:
    """Raise ValueError, naming the field, where a part of the prior is none that can be."""
    if not isinstance(prior, PosePrior):
        raise ValueError(f"the prior must be a PosePrior, not {prior!r}; leave it out for none")
    R = prior.R_world_camera
    if R is not None and not (
        _is_finite(R, (3, 3))
        and np.allclose(R @ R.T, np.eye(3), atol=1e-3)
        and np.linalg.det(R) > 0.0
    ):
        raise ValueError(f"R_world_camera must be a (3, 3) rotation, or None, not {R!r}")
    for name in ("position_m", "sigma_position_m", "velocity_m_s", "turn_rad_s"):
        value = getattr(prior, name)
        if value is not None and not _is_finite(value, (3,)):
            raise ValueError(f"{name} must be an array of 3 numbers, or None, not {value!r}")


def _is_finite(value: object, shape: tuple[int, ...]) -> bool:
    if not isinstance(value, np.ndarray) or value.shape != shape or value.dtype.kind not in "fiu":
        return False
    return bool(np.isfinite(value).all())


def sound(prior: PosePrior) -> PosePrior:
    """The prior without readings that cannot be, as an attitude without an error, and no sigma
    below what a sensor reaches."""
    R, position, sigma = prior.R_world_camera, prior.position_m, prior.sigma_position_m
    has_turn = _are_finite(R, prior.sigma_tilt_rad, prior.sigma_yaw_rad)
    has_turn &= min(prior.sigma_tilt_rad, prior.sigma_yaw_rad) > 0.0
    has_agl = _are_finite(prior.agl_m, prior.sigma_agl_m) and (prior.agl_m or 0.0) > 0.0
    has_altitude = _are_finite(prior.altitude_m, prior.sigma_altitude_m)
    has_place, has_own = _are_finite(position), _are_finite(prior.gnss_minus_baro_m)
    is_fix = has_place and _are_finite(sigma)
    return replace(
        prior,
        R_world_camera=R if has_turn else None,
        sigma_tilt_rad=max(prior.sigma_tilt_rad, MIN_TURN_RAD),
        sigma_yaw_rad=max(prior.sigma_yaw_rad, MIN_TURN_RAD),
        position_m=position if has_place and (is_fix or sigma is None) else None,
        sigma_position_m=np.maximum(sigma, MIN_FIX_M) if is_fix and sigma is not None else None,
        agl_m=prior.agl_m if has_agl else None,
        sigma_agl_m=max(prior.sigma_agl_m, MIN_FIX_M),
        altitude_m=prior.altitude_m if has_altitude else None,
        sigma_altitude_m=max(prior.sigma_altitude_m, MIN_FIX_M),
        gnss_minus_baro_m=prior.gnss_minus_baro_m if has_own else None,
        gnss_minus_baro_fixes=prior.gnss_minus_baro_fixes if has_own else 0,
    )


def _are_finite(*parts: F64 | float | None) -> bool:
    return all(part is not None and bool(np.isfinite(part).all()) for part in parts)


def is_frozen(prior: PosePrior, before: PosePrior) -> bool:
    """True when the receiver only repeats the position that it gave before."""
    if prior.position_m is None or before.position_m is None:
        return False
    return float(np.abs(before.position_m - prior.position_m).max()) <= 1e-6


def off_attitudes(seen: F64, measured: F64, has_heading: Bool) -> F64:
    """(N, 3) rotations in the world from attitudes (N, 3, 3) to those seen (N, 3, 3); of one
    without a heading, the tilt alone."""
    turn = se3.each_so3_log(seen @ measured.transpose(0, 2, 1))
    up = np.einsum("nij,nj->ni", seen, measured[:, 2])  # where the attitude's up points now
    tilt = np.column_stack([-up[:, 1], up[:, 0], np.zeros(len(up))])
    return np.where(has_heading[:, None], turn, tilt)


class FixAverage:
    """Takes every tracked frame; gives a keyframe the mean of what came since the one before."""

    def __init__(self) -> None:
        self._last_ns = 0  # of the receiver's own altitude
        self._mean: tuple[F64, PosePrior] | None = None  # the last pose, with the mean there
        self._fixes = 0  # in the mean

    def take(self, T_odom_camera: F64, prior: PosePrior) -> None:
        if prior.gnss_minus_baro_ns <= self._last_ns:  # that of the frame before, again
            prior = replace(prior, gnss_minus_baro_m=None, gnss_minus_baro_fixes=0)
        self._last_ns = max(self._last_ns, prior.gnss_minus_baro_ns)
        self._fixes += has_fix(prior)
        if self._mean is not None:
            prior = averaged((T_odom_camera, prior), self._mean, 1.0 / max(self._fixes, 1))
            if prior.fix_offset is None:  # the fixes before are no part of it
                self._fixes = int(has_fix(prior))
        self._mean = T_odom_camera, prior

    def given(self) -> PosePrior:
        """The prior of the last frame with the mean of all that was taken since this was asked for
        last."""
        assert self._mean is not None, "a keyframe is taken first"
        _, prior = self._mean
        self.forget()
        return prior

    def forget(self) -> None:
        """Start again, as after a break of the track."""
        self._mean, self._fixes = None, 0


def without_fixes(nodes: Sequence[Node], refused: Collection[int]) -> list[Node]:
    """The nodes without the fixes that the graph refused, unless most of a segment's were: among
    fewer nodes one that is far off would weigh too much."""
    seen = Counter(n.segment for n in nodes)
    off = Counter(n.segment for n in nodes if n.seq in refused)
    return [
        replace(n, prior=replace(n.prior, sigma_position_m=None))
        if n.seq in refused and 2 * off[n.segment] <= seen[n.segment]
        else n
        for n in nodes
    ]


def averaged(one: tuple[F64, PosePrior], other: tuple[F64, PosePrior], share: float) -> PosePrior:
    """The prior at a pose (4, 4) that also speaks for an earlier one, which is left out: with the
    mean of both fixes, of which ``one`` has a ``share``, that is the fix of the mean place, and of
    the receiver's own altitudes."""
    (T, own), (T_other, others) = one, other
    readings = own.gnss_minus_baro_fixes + others.gnss_minus_baro_fixes
    if readings:
        sums_m = ((p.gnss_minus_baro_m or 0.0) * p.gnss_minus_baro_fixes for p in (own, others))
        mean_m = sum(sums_m) / readings
        own = replace(own, gnss_minus_baro_m=mean_m, gnss_minus_baro_fixes=readings)
    fix_m, sigma_m, others_m = own.position_m, own.sigma_position_m, others.position_m
    if others_m is None or others.sigma_position_m is None:
        return own
    if fix_m is None or sigma_m is None:
        share, fix_m, sigma_m = 0.0, others_m, others.sigma_position_m
    elif np.any(others.sigma_position_m > MAX_WORSE * sigma_m):
        return own
    place = share * own.place_of_fix(T) + (1.0 - share) * others.place_of_fix(T_other)
    return replace(
        own,
        position_m=share * fix_m + (1.0 - share) * others_m,
        sigma_position_m=sigma_m,
        fix_offset=se3.transform(se3.inverse(T), place[None])[0],
    )


MAX_GAP_S = 3.0  # a longer time without a velocity begins a new run


class VelocityIntegrator:
    """Takes the prior of every frame, in the order of time, and adds its velocity's integral."""

    def __init__(self) -> None:
        self._last: tuple[int, F64] | None = None  # time in ns, (3,) m/s
        self._travel = Travel(np.zeros(3), 0.0, 0)

    def add(self, time_ns: int, prior: PosePrior) -> PosePrior:
        """The prior with its travel; as it is when it has no velocity."""
        velocity = prior.velocity_m_s
        if velocity is None or not np.isfinite(velocity).all():
            return prior
        last, self._last = self._last, (time_ns, velocity)
        before = self._travel
        passed_s = 0.0 if last is None else (time_ns - last[0]) * 1e-9
        if last is None or not 0.0 < passed_s <= MAX_GAP_S:
            self._travel = Travel(np.zeros(3), 0.0, before.run + 1)
        else:
            way = 0.5 * passed_s * (last[1] + velocity)
            self._travel = Travel(before.metres + way, before.seconds + passed_s, before.run)
        return replace(prior, travel=self._travel)


def dead_reckoned(
    before: PosePrior, now: PosePrior, T_before: F64, velocity_m_s: F64 | None, seconds: float
) -> F64:
    """(4, 4) pose by telemetry's motion since ``before``, when the camera was at ``T_before``.

    Telemetry's error then is assumed to hold now, so that nothing jumps. Without positions the
    camera continues at ``velocity_m_s`` (3,) for ``seconds``, if known.
    """
    T: F64 = T_before.copy()
    a, b = before.R_world_camera, now.R_world_camera
    if b is not None and now.sigma_yaw_rad < 1.0:
        known = a is not None and before.sigma_yaw_rad < 1.0
        T[:3, :3] = b @ a.T @ T_before[:3, :3] if a is not None and known else b
    if before.position_m is not None and now.position_m is not None:
        T[:3, 3] += now.position_m - before.position_m
    elif velocity_m_s is not None:
        T[:3, 3] += velocity_m_s * seconds
    return T
