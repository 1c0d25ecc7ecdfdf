"""Images as a decoder gives them, converted to BGR when they are looked at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from recon.types import U8

if TYPE_CHECKING:
    import av


@dataclass(frozen=True, slots=True)
class Decoded:
    """An image as the decoder gave it, in BGR once that is asked for."""

    frame: av.VideoFrame
    turned_deg: int  # clockwise

    @property
    def shape(self) -> tuple[int, int, int]:
        """(H, W, 3) as turned."""
        stored = int(self.frame.width), int(self.frame.height)
        W, H = stored[::-1] if self.turned_deg % 180 else stored
        return H, W, 3

    def __call__(self) -> U8:
        """(H, W, 3) BGR."""
        return np.ascontiguousarray(np.rot90(frame_bgr(self.frame), -(self.turned_deg // 90)))


def frame_bgr(frame: av.VideoFrame) -> U8:
    """(H, W, 3) BGR of a decoded image."""
    return np.ascontiguousarray(frame.to_ndarray(format="bgr24"), dtype=np.uint8)
