"""The small JPEG of each whole keyframe, for people and for software that matches images.

The layers of a keyframe show only what is new. The image shares the keyframe's camera: its
intrinsics are the keyframe's, scaled by the ratio of the widths.
"""

from __future__ import annotations

import math

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
    whole = np.asarray(cv2.resize(small, (w, h), interpolation=cv2.INTER_CUBIC), np.uint8)
    whole[keyframe.fresh] = keyframe.bgr[keyframe.fresh]
    return whole


def is_image(data: bytes) -> bool:
    """Whether the bytes are within the bounds of a keyframe's image; they are not decoded."""
    size = image_size(data) if data[:2] == b"\xff\xd8" and len(data) <= MAX_IMAGE_BYTES else None
    return size is not None and min(size) > 0 and max(size) <= MAX_IMAGE_PX
