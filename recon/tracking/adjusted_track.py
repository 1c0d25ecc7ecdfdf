"""A track that is known before it is flown: stills that were adjusted all together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from recon import se3
from recon.rolling_shutter import FrameRows, RowClock, Rows
from recon.tracking.focal_watch import FocalWatch
from recon.tracking.frame import Frame, RelativePose, Tracking
from recon.tracking.keyframe_window import Landmarks, OdometryKeyframe
from recon.tracking.motion_blur import ExposureWatch
from recon.tracking.odometry import Odometry
from recon.tracking.readout_search import ReadoutEstimate, ReadoutSearch
from recon.types import F64, I64, Camera, PosePrior

KEPT = 8
"""Keyframes that are remembered."""


@dataclass(frozen=True, slots=True, eq=False)
class AdjustedStill:
    """Where a still was taken, and what it shows."""

    T_odom_camera: F64  # (4, 4) of its middle row, m
    covariance: F64  # (6, 6) of the motion from the still before, left of T_here_before
    rate: F64  # (6,) of T_camera_odom per s; unused under a global shutter
    turn_covariance: F64  # (3, 3) of its rotation
    landmark: I64  # (n,) which of the points it shows


class AdjustedTrack:
    """Takes frames as :class:`recon.tracking.odometry.Odometry` does, and says what is known."""

    def __init__(
        self, stills: Mapping[int, AdjustedStill], points: F64, lens: Camera, sigma_readout_s: float
    ) -> None:
        """``stills`` by the number of the frame; ``points`` (P, 3) m are finite.

        ``lens`` is the camera with its distortion and shutter; ``sigma_readout_s`` is 0 for one
        that was given.
        """
        self.segment, self.keyframes = -1, list[OdometryKeyframe]()
        self.exposure, self.focal = ExposureWatch(), FocalWatch(lens.K)  # no window is adjusted
        clock = RowClock(lens)
        self.readout = ReadoutSearch(clock, lens.K) if sigma_readout_s else None
        if self.readout is not None:  # and its search is over
            known = lens.shutter.readout_s, sigma_readout_s, len(stills)
            self.readout.estimate = ReadoutEstimate(*known)
        self.K = lens.K
        self._stills, self._landmarks = stills, Landmarks()
        self._landmarks.add(points)
        self._clock = clock if lens.shutter.readout_s else None

    def can_skip(self, time_ns: int, prior: PosePrior, frames_per_step: float) -> bool:
        return False

    def needs_turn(self, time_ns: int) -> bool:
        return False

    def track(self, frame: Frame) -> list[Frame]:
        seq, time_ns, prior = frame.seq, frame.time_ns, frame.prior
        still = self._stills.get(seq)
        if still is None:
            reason = "not tied to other stills"
            return [replace(frame, state=Tracking.LOST, segment=self.segment, reason=reason)]
        state = Tracking.KEYFRAME if self.keyframes else Tracking.STARTED
        self.segment = 0
        T_camera_odom = se3.inverse(still.T_odom_camera)
        rows = None
        if self._clock is not None:
            spread = np.zeros((6, 6))
            spread[:3, :3] = still.turn_covariance
            rows = Rows(self._clock, still.rate, np.zeros(6), spread)
        row_motion = FrameRows(time_ns, prior, T_camera_odom, rows, is_measured=True)
        key = OdometryKeyframe(
            seq, 0, T_camera_odom, still.covariance, prior, frame.pyramid,
            np.zeros((len(still.landmark), 2)), still.landmark, self._landmarks, row_motion,
        )  # fmt: skip
        self.keyframes = [*self.keyframes[1 - KEPT :], key]
        relative = RelativePose(seq, 0, se3.inverse(key.T_odom_camera) @ still.T_odom_camera, key)
        found = replace(
            frame, state=state, segment=0, T_tracked=still.T_odom_camera, relative=relative,
            tracks=len(still.landmark), row_motion=row_motion,
        )  # fmt: skip
        return [found]


AnyTrack = Odometry | AdjustedTrack
