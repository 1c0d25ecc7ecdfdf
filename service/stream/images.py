"""The small JPEG of each whole keyframe, for people and for software that matches images.

The layers of a keyframe show only what is new. The image shares the keyframe's camera: its
intrinsics are the keyframe's, scaled by the ratio of the widths.
"""

from __future__ import annotations

import math
from itertools import product

import cv2
import numpy as np

from recon.types import U8, Keyframe
from service.stream.planes import image_size

IMAGE_SHARE = 0.05
"""Bytes of a flight's images over those of its layers."""
MAX_IMAGE_BYTES, MAX_IMAGE_PX = 1 << 16, 1024
"""A larger image is invalid."""
STEPS = ((320, 28), (320, 23), (320, 18), (256, 20), (208, 20))
"""Width in pixels and quality of JPEG, the best first: what one image leaves is for later ones."""

SMOOTHED_QUALITY, SMOOTHED_PX = 20, 2
"""Quality at which a decoded image is coded again, and the steps of its shifts within a block."""
BLOCK_PX = 8  # of JPEG


def encode_image(bgr: U8, max_bytes: float = math.inf) -> bytes:
    """The best JPEG of an (h, w, 3) BGR image within ``max_bytes``; if none is, the smallest."""
    h, w = bgr.shape[:2]
    data = b""
    for width, quality in STEPS:
        scale = min(1.0, width / max(w, h))
        size = max(1, round(w * scale)), max(1, round(h * scale))
        small = cv2.resize(bgr, size, interpolation=cv2.INTER_AREA)
        options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
        data = cv2.imencode(".jpg", small, options)[1].tobytes()
        if len(data) <= max_bytes:
            break
    return data


def whole_bgr(keyframe: Keyframe, image: bytes | None) -> U8:
    """(h, w, 3) the keyframe's colours where it is new, and those of its ``image`` around them.

    Without a readable image, as in scans of before there were any, what is not new stays as stored:
    blocks of one colour.
    """
    small = (
        None if image is None else cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR)
    )
    if small is None:
        return keyframe.bgr
    h, w = keyframe.bgr.shape[:2]
    small = _without_blocks(np.asarray(small, np.uint8))
    whole = np.asarray(cv2.resize(small, (w, h), interpolation=cv2.INTER_CUBIC), np.uint8)
    whole[keyframe.fresh] = keyframe.bgr[keyframe.fresh]
    return whole


def _without_blocks(bgr: U8) -> U8:
    """A decoded image nearer to what was coded: the mean of what JPEG makes of it in all shifts of
    its blocks (Nosratinia 2001, Enhancement of JPEG-compressed images by re-application)."""
    h, w = bgr.shape[:2]
    edges = (BLOCK_PX, BLOCK_PX)
    around = np.pad(bgr, (edges, edges, (0, 0)), "symmetric")
    shifts = list(product(range(0, BLOCK_PX, SMOOTHED_PX), repeat=2))
    total = np.zeros(bgr.shape, np.uint32)
    for y, x in shifts:
        part = around[y : y + h + BLOCK_PX, x : x + w + BLOCK_PX]
        data = cv2.imencode(".jpg", part, (cv2.IMWRITE_JPEG_QUALITY, SMOOTHED_QUALITY))[1]
        again = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)
        total += again[BLOCK_PX - y : BLOCK_PX - y + h, BLOCK_PX - x : BLOCK_PX - x + w]
    return np.rint(total / len(shifts)).astype(np.uint8)


def is_image(data: bytes) -> bool:
    """Whether the bytes are within the bounds of a keyframe's image; they are not decoded."""
    size = image_size(data) if data[:2] == b"\xff\xd8" and len(data) <= MAX_IMAGE_BYTES else None
    return size is not None and min(size) > 0 and max(size) <= MAX_IMAGE_PX
