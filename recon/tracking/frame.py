"""A frame on its way through tracking and stereo, and its pose relative to its keyframe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.rolling_shutter import GLOBAL_SHUTTER, FrameRows
from recon.tracking.keyframe_window import OdometryKeyframe
from recon.tracking.matching import Pyramid
from recon.types import F64, U8, PosePrior


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


@dataclass(frozen=True, slots=True, eq=False)
class UndistortedFrame:
    """A frame without distortion but for its image in colour, which only views need.

    The odometry adds the motion of its rows. Once it has a pose it may take part in stereo, as a
    view or as a view's partner, and its pose follows its odometry keyframe's.
    """

    seq: int
    time_ns: int
    prior: PosePrior
    image: U8 | None  # (H, W, 3) with distortion; None for one that is only a partner
    gray: U8  # (H, W)
    pyramid: Pyramid  # of (h, w) gray, as the odometry takes it; empty once it is tracked
    mask: U8 | None  # (h, w) non-zero where the image is valid; None: everywhere
    is_blurred: bool  # takes no part in stereo, only in the track
    relative: RelativePose | None = None  # to the last keyframe when it was tracked
    row_motion: FrameRows = GLOBAL_SHUTTER  # better once its neighbours are known

    @property
    def small(self) -> U8:
        """(h, w) gray, as the odometry takes it."""
        return self.pyramid[0]

    @property
    def segment(self) -> int:
        return self._relative.segment

    @property
    def keyframe(self) -> OdometryKeyframe:
        assert self._relative.keyframe is not None, "a frame of stereo is not settled"
        return self._relative.keyframe

    @property
    def T_odom_camera(self) -> F64:
        """(4, 4) as refined by now."""
        return self._relative.T_odom_camera

    @property
    def _relative(self) -> RelativePose:
        assert self.relative is not None, "the frame is not tracked"
        return self.relative
