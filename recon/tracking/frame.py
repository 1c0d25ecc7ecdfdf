"""A frame on its way through tracking and stereo, and its pose relative to its keyframe."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from recon.rolling_shutter import GLOBAL_SHUTTER, FrameRows
from recon.tracking.keyframe_window import OdometryKeyframe
from recon.tracking.matching import Pyramid
from recon.types import F64, U8, PosePrior

NO_IMAGE: U8 = np.zeros((0, 0), np.uint8)
UNKNOWN = PosePrior()


class Tracking(str, Enum):
    STARTED = "started"  # first of a segment
    WAITING = "waiting"  # the camera has not moved enough for a second view
    TRACKED = "tracked"
    KEYFRAME = "keyframe"
    SKIPPED = "skipped"  # too close to the last one
    LOST = "lost"


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
class Frame:
    """One image of the camera, with what is known of it by now.

    The caller gives the image, its time and number, and telemetry; :class:`Undistort` the images
    without distortion; the odometry the rest. A frame with a pose may take part in stereo, as a
    view or as a view's partner, and its pose follows its odometry keyframe's. Images that are no
    longer needed are :data:`NO_IMAGE`.
    """

    image: U8  # (H, W, 3) BGR with distortion
    time_ns: int  # mid-exposure; companion monotonic live, unix nanoseconds in a replay
    seq: int
    prior: PosePrior = UNKNOWN
    gray: U8 = field(default_factory=lambda: NO_IMAGE)  # (H, W) without distortion
    pyramid: Pyramid = ()  # of (h, w) gray, as the odometry takes it
    mask: U8 | None = None  # (h, w) non-zero where the image is valid; None: everywhere
    is_blurred: bool = False  # takes no part in stereo, only in the track
    state: Tracking = Tracking.SKIPPED
    segment: int = -1
    T_tracked: F64 | None = None  # (4, 4) T_odom_camera when it was tracked; None: it has no pose
    relative: RelativePose | None = None  # the same, to the last keyframe
    tracks: int = 0  # corners found
    reason: str = ""  # why it has no pose
    row_motion: FrameRows = GLOBAL_SHUTTER  # better once its neighbours are known

    @property
    def small(self) -> U8:
        """(h, w) gray, as the odometry takes it."""
        return self.pyramid[0]

    @property
    def keyframe(self) -> OdometryKeyframe:
        assert self.relative is not None, "the frame is not tracked"
        assert self.relative.keyframe is not None, "a frame of stereo is not settled"
        return self.relative.keyframe

    @property
    def T_odom_camera(self) -> F64:
        """(4, 4) as refined by now."""
        assert self.relative is not None, "the frame is not tracked"
        return self.relative.T_odom_camera
