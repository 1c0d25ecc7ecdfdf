"""A frame of an image that has no distortion, for the tests of the odometry."""

from __future__ import annotations

from recon.tracking.frame import NO_IMAGE, Frame
from recon.tracking.matching import build_pyramid
from recon.types import U8, PosePrior


def undistorted(gray: U8, seq: int, time_ns: int, prior: PosePrior) -> Frame:
    """The frame of ``gray`` (H, W), all of it valid."""
    return Frame(NO_IMAGE, time_ns, seq, prior, gray=gray, pyramid=build_pyramid(gray))
