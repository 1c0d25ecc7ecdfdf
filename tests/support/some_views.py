"""Keyframes and views without images, for tests of what becomes of their poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from recon import se3
from recon.pipeline.views import StereoView
from recon.rolling_shutter import FrameRows
from recon.stereo.posed_image import PosedImage
from recon.tracking.frame import NO_IMAGE, Frame
from recon.types import F64, PosePrior

UNKNOWN, NO_MOTIONS = PosePrior(), dict[int, F64]()


def keyframe_at(seq: int, T_odom_camera: F64, segment: int = 0, is_measured: bool = False) -> Frame:
    """A keyframe of the odometry without corners."""
    row_motion = FrameRows(seq, UNKNOWN, T_odom_camera, is_measured=is_measured)
    return Frame(
        NO_IMAGE, seq, seq, segment=segment, row_motion=row_motion,
        T_camera_odom=se3.inverse(T_odom_camera), covariance=np.eye(6),
    )  # fmt: skip


def view_at(
    seq: int, T_odom_camera: F64, segment: int = 0, prior: PosePrior = UNKNOWN,
    points: F64 | None = None, covariance: F64 | None = None,
    earlier: Mapping[int, F64] = NO_MOTIONS, partners: Sequence[PosedImage] = (),
    image: PosedImage | None = None,
) -> StereoView:  # fmt: skip
    """A view at a place of the odometry, of no image unless one is given."""
    blank = PosedImage(None, np.zeros((1, 1), np.uint8), np.eye(3), T_odom_camera, seq=seq)
    frame = Frame(NO_IMAGE, seq, seq, prior, segment=segment, T_keyframe_camera=T_odom_camera)
    return StereoView(
        frame, image or blank, tuple(partners),
        np.zeros((0, 3)) if points is None else points,
        np.eye(6) if covariance is None else covariance, earlier,
    )  # fmt: skip
