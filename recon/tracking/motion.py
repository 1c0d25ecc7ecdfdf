"""Where the camera was last and how fast it moves: the first guess of where it is now."""

from __future__ import annotations

import numpy as np

from recon import se3
from recon.tracking import prediction
from recon.types import F64, PosePrior

STEADY_S = 0.3
"""Velocities of frames closer than this are averaged with those before."""


class Motion:
    """A camera that goes on as it went, and turns as telemetry says. Odometry's own units."""

    def __init__(self, time_ns: int, T_odom_camera: F64, prior: PosePrior) -> None:
        """At rest there; ``prior`` is telemetry's word of that moment."""
        self._last = (time_ns, T_odom_camera, prior)
        self._velocity = np.zeros(3)

    def update(self, time_ns: int, T_odom_camera: F64, prior: PosePrior) -> None:
        """Take in the next frame's pose (4, 4)."""
        last_ns, T_last, _ = self._last
        if time_ns > last_ns:
            dt = (time_ns - last_ns) * 1e-9
            velocity = (T_odom_camera[:3, 3] - T_last[:3, 3]) / dt
            keep = 0.5 if dt < STEADY_S and np.any(self._velocity) else 0.0
            self._velocity = keep * self._velocity + (1 - keep) * velocity
        self._last = (time_ns, T_odom_camera, prior)

    def correct(self, T_odom_camera: F64) -> None:
        """The last frame's pose was adjusted; the velocity stays."""
        time_ns, _, prior = self._last
        self._last = (time_ns, T_odom_camera, prior)

    def ahead(self, time_ns: int, prior: PosePrior) -> tuple[F64, F64 | None, float]:
        """T_odom_camera (4, 4) expected then, the turn R_new_last of telemetry, and seconds."""
        last_ns, T_last, last_prior = self._last
        dt = (time_ns - last_ns) * 1e-9
        R = T_last[:3, :3]
        turn = prediction.relative_rotation(last_prior, prior)
        if turn is not None:
            R = R @ turn.T
        return se3.compose(R, T_last[:3, 3] + self._velocity * dt), turn, dt
