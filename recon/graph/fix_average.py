"""All fixes between two keyframes as one: their mean, and where along the track it was."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from recon import se3
from recon.types import F64, PosePrior


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
        """A frame of the track, with what telemetry says of it."""
        if prior.position_m is not None and prior.sigma_position_m is not None:
            self._places.append(T_odom_camera[:3, 3])
            self._fixes.append(prior.position_m)
        if prior.above_m is not None and prior.above_ns > self._last_ns:
            self._above[prior.above_ns] = prior.above_m

    def given(self, T_odom_camera: F64, prior: PosePrior) -> PosePrior:
        """The prior of a keyframe with all that was taken since the last one; begins anew."""
        out = prior
        if len(self._fixes) > 1 and prior.position_m is not None:
            place = se3.transform(se3.inverse(T_odom_camera), np.mean(self._places, axis=0)[None])
            out = replace(out, position_m=np.mean(self._fixes, axis=0), fix_offset=place[0])
        if self._above:
            out = replace(
                out, above_m=float(np.mean(list(self._above.values()))),
                above_fixes=len(self._above),
            )  # fmt: skip
            self._last_ns = max(self._above)
        elif out.above_m is not None:
            out = replace(out, above_m=None, above_fixes=0)
        self.forget()
        return out

    def forget(self) -> None:
        """Begin anew, as when the track broke."""
        self._places.clear()
        self._fixes.clear()
        self._above.clear()
