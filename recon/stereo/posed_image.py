"""What rectification starts from: a posed image without distortion, and the parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.rolling_shutter import Rows
from recon.types import F64, U8


@dataclass(frozen=True, slots=True)
class VirtualStereoConfig:
    min_base_to_height: float = 0.03  # baseline over distance
    max_base_to_height: float = 0.8
    min_overlap: float = 0.25  # share of the left view that the right one sees
    width_px: int = 320  # of the stereo views, along the image's width
    guided: bool = True  # make the image that guides the upsampling
    labels: int = 16  # the fewest; relief may widen it
    max_labels: int = 96
    margin_labels: float = 3.0  # on either side of the relief that the landmarks show
    epipole_margin: float = 1.3  # half images; a polar pair where the epipole is nearer
    max_sigma_share: float = 0.04  # of the distance; about the epipole, where it is more, a mask
    margin_share: float = 0.25  # of the camera's height, beyond the relief that landmarks show
    min_usable: float = 0.1  # share of the left view outside that mask and on the ground

    def __post_init__(self) -> None:
        if not 0 < self.min_base_to_height < self.max_base_to_height:
            raise ValueError("0 < min_base_to_height < max_base_to_height must hold")
        if self.labels < 4 or self.max_labels < self.labels:
            raise ValueError("4 <= labels <= max_labels must hold")
        if self.width_px < 32:
            raise ValueError(f"width_px is at least 32, not {self.width_px}")

    def labels_for(self, need: float) -> int:
        """Labels that cover ``need`` of them, by fours: every one costs time."""
        return max(self.labels, 4 * int(np.ceil(need / 4)))


@dataclass(frozen=True, slots=True, eq=False)
class PosedImage:
    """A posed image without distortion that may become a left or right view."""

    bgr: U8 | None  # (H, W, 3); only a left view that guides the upsampling needs it
    gray: U8  # (H, W) the same
    K: F64  # (3, 3) px of that image
    T_odom_camera: F64  # (4, 4)
    seen: U8 | None = None  # (H, W) zero where the image has nothing; None: all of it
    rows: Rows | None = None  # how the camera moved while it read the image; None: not at all
    scene: F64 | None = None  # (3,) inverse depth of the ground, times a ray with z = 1; with rows
    blur_px: F64 | None = None  # (2,) how far the image moved while exposed; None: not at all
    seq: int = -1  # number of its frame

    def inside(self, focal_px: float) -> U8:
        """(H, W) 1 where the image shows something, a pixel of that focal length from its rim."""
        rim = int(np.ceil(1.0 + self.K[0, 0] / focal_px))
        inside = np.zeros(self.gray.shape, np.uint8)
        inside[rim:-rim, rim:-rim] = 1 if self.seen is None else self.seen[rim:-rim, rim:-rim]
        return inside
