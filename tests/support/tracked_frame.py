"""A frame of an image that has no distortion, for the tests of the odometry."""

from __future__ import annotations

from recon.tracking.frame import UndistortedFrame
from recon.tracking.matching import build_pyramid
from recon.types import U8, PosePrior


def undistorted(gray: U8, seq: int, time_ns: int, prior: PosePrior) -> UndistortedFrame:
    """The frame of ``gray`` (H, W), all of it valid."""
    return UndistortedFrame(
        seq, time_ns, prior, None, gray, build_pyramid(gray), mask=None, is_blurred=False
    )
