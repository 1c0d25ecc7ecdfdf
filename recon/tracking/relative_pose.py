"""A frame's pose relative to its reference keyframe of the odometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.tracking.keyframe_window import OdometryKeyframe
from recon.types import F64


@dataclass(frozen=True, slots=True, eq=False)
class RelativePose:
    """A frame's pose relative to a keyframe, whose own pose gets better while it is adjusted.

    Once it no longer changes, :meth:`settled` releases the keyframe, which holds images.
    """

    seq: int
    segment: int
    T_keyframe_camera: F64  # (4, 4); T_odom_camera without a keyframe
    keyframe: OdometryKeyframe | None = None

    @property
    def T_odom_camera(self) -> F64:
        """(4, 4) as known by now."""
        if self.keyframe is None:
            return self.T_keyframe_camera
        return np.asarray(self.keyframe.T_odom_camera @ self.T_keyframe_camera)

    def settled(self) -> RelativePose:
        """The same with only its current pose in the odometry."""
        return RelativePose(self.seq, self.segment, self.T_odom_camera)
