"""Telemetry between two keyframes: the mean of fixes, the distance by velocity, the motion.

Between two instants of one run the difference of two travels is the displacement, with an error
that grows with time only. That gives the scale of the odometry better than fixes, whose error
wanders (:mod:`recon.posegraph.alignment`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from recon import se3
from recon.types import F64, PosePrior, Travel


def at_camera(prior: PosePrior, R_world_camera: F64, scale: float) -> PosePrior:
    """The prior with its fix brought to where the camera is, by the track's ``scale``."""
    if prior.fix_offset is None or prior.position_m is None:
        return prior
    off = scale * R_world_camera @ prior.fix_offset
    return replace(prior, position_m=prior.position_m - off, fix_offset=None)


@dataclass(slots=True, eq=False)
class FixAverage:
    """Takes every tracked frame; gives a keyframe the mean of what came since the one before.

    The mean of fixes is the fix of the mean place, in whatever frame and scale vision has it, so
    nothing but the track itself is needed to bring them together.
    """

    _places: list[F64] = field(default_factory=list)  # (3,) in the segment's odometry
    _fixes: list[F64] = field(default_factory=list)  # (3,) m
    _above: dict[int, float] = field(default_factory=dict)  # m by the time of the receiver's fix
    _last_ns: int = 0

    def take(self, T_odom_camera: F64, prior: PosePrior) -> None:
        """Add a frame of the track with its telemetry."""
        if prior.position_m is not None and prior.sigma_position_m is not None:
            self._places.append(T_odom_camera[:3, 3])
            self._fixes.append(prior.position_m)
        if prior.gnss_minus_baro_m is not None and prior.gnss_minus_baro_ns > self._last_ns:
            self._above[prior.gnss_minus_baro_ns] = prior.gnss_minus_baro_m

    def given(self, T_odom_camera: F64, prior: PosePrior) -> PosePrior:
        """The prior of a keyframe with all that was taken since the last one, and start again."""
        out = prior
        if len(self._fixes) > 1 and prior.position_m is not None:
            place = se3.transform(se3.inverse(T_odom_camera), np.mean(self._places, axis=0)[None])
            out = replace(out, position_m=np.mean(self._fixes, axis=0), fix_offset=place[0])
        if self._above:
            out = replace(
                out, gnss_minus_baro_m=float(np.mean(list(self._above.values()))),
                gnss_minus_baro_fixes=len(self._above),
            )  # fmt: skip
            self._last_ns = max(self._above)
        elif out.gnss_minus_baro_m is not None:
            out = replace(out, gnss_minus_baro_m=None, gnss_minus_baro_fixes=0)
        self.forget()
        return out

    def forget(self) -> None:
        """Start again, as after a break of the track."""
        self._places.clear()
        self._fixes.clear()
        self._above.clear()


MAX_GAP_S = 3.0
"""A longer time without a velocity begins a new run."""


class Odometer:
    """Takes the prior of every frame, in the order of time, and adds the travel to it."""

    def __init__(self) -> None:
        """Nothing is travelled yet."""
        self._last: tuple[int, F64] | None = None  # time in ns, (3,) m/s
        self._travel = Travel(np.zeros(3), 0.0, 0)

    def take(self, time_ns: int, prior: PosePrior) -> PosePrior:
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


def carried(
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
