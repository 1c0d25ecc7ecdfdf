"""A track that is known before it is flown: stills that were adjusted all together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from recon import se3
from recon.rolling_shutter import FrameRows, RowClock, Rows
from recon.tracking.frame import NO_IMAGE, UNKNOWN, Frame, Landmarks, Tracking
from recon.tracking.odometry import Odometry
from recon.tracking.readout_search import ReadoutSearch
from recon.types import F64, I64, Camera, PosePrior

KEPT = 8  # keyframes that are remembered


class AdjustedTrack:
    """Takes frames as :class:`recon.tracking.odometry.Odometry` does, and says what is known."""

    def __init__(self, stills: Mapping[int, Frame], lens: Camera, sigma_readout_s: float) -> None:
        """``stills`` by their number, as :func:`adjusted_still` gives them. ``lens`` is the camera
        with its distortion and shutter; ``sigma_readout_s`` is 0 for one that was given."""
        self.segment, self.keyframes = -1, list[Frame]()
        self.readout = ReadoutSearch(RowClock(lens), lens.K) if sigma_readout_s else None
        if self.readout is not None:  # and its search is over
            self.readout.readout_s, self.readout.sigma_s = lens.shutter.readout_s, sigma_readout_s
            self.readout.windows = len(stills)
        self.K, self._stills = lens.K, stills

    def can_skip(self, time_ns: int, prior: PosePrior, frames_per_step: float) -> bool:
        return False

    def needs_turn(self, time_ns: int) -> bool:
        return False

    def track(self, frame: Frame) -> list[Frame]:
        seq = frame.seq
        still = self._stills.get(seq)
        if still is None:
            reason = "not tied to other stills"
            return [replace(frame, state=Tracking.LOST, segment=self.segment, reason=reason)]
        state = Tracking.KEYFRAME if self.keyframes else Tracking.STARTED
        self.segment = 0
        key = replace(still, time_ns=frame.time_ns, prior=frame.prior)
        self.keyframes = [*self.keyframes[1 - KEPT :], key]
        found = replace(
            frame, state=state, segment=0, T_keyframe_camera=np.eye(4), reference=key,
            tracks=len(still.landmark), row_motion=still.row_motion,
        )  # fmt: skip
        return [found]


def adjusted_still(
    seq: int, T_odom_camera: F64, covariance: F64, rows: Rows | None, landmark: I64,
    landmarks: Landmarks,
) -> Frame:  # fmt: skip
    """A still at a place (4, 4) m of its middle row, which shows the landmarks of these numbers.

    ``covariance`` (6, 6) is that of the motion from the still before, left of T_here_before;
    ``rows`` is None under a global shutter.
    """
    T_camera_odom = se3.inverse(T_odom_camera)
    row_motion = FrameRows(0, UNKNOWN, T_camera_odom, rows, is_measured=True)
    return Frame(
        NO_IMAGE, 0, seq, segment=0, T_camera_odom=T_camera_odom,
        covariance=covariance, uv=np.zeros((len(landmark), 2)), landmark=landmark,
        landmarks=landmarks, row_motion=row_motion,
    )  # fmt: skip


AnyTrack = Odometry | AdjustedTrack
