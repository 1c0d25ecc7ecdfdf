"""The planes of a keyframe (mask, depth, sigma, views, colour) as coded sections, and back.

Decoders return None for malformed data. They check the size in an embedded image's header before
decoding it, so that they allocate no more than the caller's grid needs. Compiled code is imported
where it runs, so that opening a store loads no compiler.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import cv2
import numpy as np

from recon.types import F32, U8, U16, Array, Bool, DepthMap

METHOD_JPEG_LS = 1
METHOD_PREDICTION = 2
SIGMA_BLOCK_PX = 4
SIGMA_UNIT_M = 0.001
SIGMA_STEPS_PER_OCTAVE = 4
SIGMA_M = SIGMA_UNIT_M * 2.0 ** ((np.arange(256) - 1) / SIGMA_STEPS_PER_OCTAVE)
"""Sigma by its code; 0 is unknown."""
SIGMA_M[0] = np.nan
VIEWS_BLOCK_PX = 2
MAX_VIEWS = 15
MCU_PX = 16  # JPEG codes colour in blocks of this size
MAX_CODE = 65535
SPREAD = 0.03
"""A coarse pixel whose inverse depths vary by more than this share (rms) uses the middle pixel
instead of the mean, so that no points appear in the air between roof and ground."""


@dataclass(frozen=True, slots=True, eq=False)
class Planes:
    """The contents of a layer per pixel; all but ``known`` is arbitrary where unknown."""

    depth_m: F32  # (h, w)
    sigma_m: F32  # (h, w), 0 where there is none
    views: U8  # (h, w)
    bgr: U8  # (h, w, 3)
    known: Bool  # (h, w)

    def crop(self, box: tuple[int, int, int, int]) -> Planes:
        x, y, w, h = box
        cut = np.s_[y : y + h, x : x + w]
        return Planes(
            self.depth_m[cut], self.sigma_m[cut], self.views[cut], self.bgr[cut], self.known[cut]
        )


def planes_of(depth: DepthMap, bgr: U8, known: Bool) -> Planes:
    with np.errstate(invalid="ignore"):
        good = known & (depth.sigma_m > 0) & (depth.sigma_m < 1e6)
    sigma = depth.sigma_m if good.all() else np.where(good, depth.sigma_m, np.float32(0))
    return Planes(depth.depth_m, sigma.astype(np.float32, copy=False), depth.views, bgr, known)


def bounding_box(known: Bool) -> tuple[int, int, int, int]:
    """(x, y, w, h) of the known pixels; all zero when there is none."""
    columns = np.flatnonzero(known.any(axis=0))
    rows = np.flatnonzero(known.any(axis=1))
    if columns.size == 0:
        return 0, 0, 0, 0
    x, y = int(columns[0]), int(rows[0])
    return x, y, int(columns[-1]) - x + 1, int(rows[-1]) - y + 1


def reduce(full: Planes, factor: int) -> Planes:
    """``full`` at 1/factor of its size; a block is known when a quarter of it is."""
    from service.stream import plane_coders

    depth, sigma, views, bgr, known = plane_coders.reduce(
        full.depth_m, full.sigma_m, full.views, full.bgr, full.known, factor, SPREAD
    )
    return Planes(depth, sigma, np.clip(views, 1, MAX_VIEWS), bgr, known)


def _fill_back(values: Array, known: Bool) -> Array:
    """``values`` with each unknown pixel replaced by the last known one in scan order."""
    if known.all():
        return values
    index = np.where(known.ravel(), np.arange(known.size), 0)
    index = np.maximum.accumulate(index)
    index[index == 0] = int(np.argmax(known))
    return np.asarray(values.reshape(known.size)[index].reshape(known.shape))


# Depth: codes of inverse depth.


def quantise(planes: Planes, step: float) -> tuple[U16, float, float]:
    """Codes of inverse depth, and the inverse depth of code 0 and the step, in 1/m. Codes of
    unknown pixels are arbitrary. The step grows when 65536 codes are too few."""
    depth, known = planes.depth_m, planes.known
    if known.all():
        near, far = float(depth.min()), float(depth.max())
    else:
        near, far = float(depth[known].min()), float(depth[known].max())
        depth = np.where(known, depth, np.float32(far))
    low = np.float32(1.0 / far)
    step32 = np.float32(max(step, (1.0 / near - float(low)) / (MAX_CODE - 1)))
    codes = (1.0 / float(step32)) / depth.astype(np.float64)
    codes -= float(low) / float(step32) - 0.5
    return np.clip(codes, 0, MAX_CODE).astype(np.uint16), float(low), float(step32)


def decode_depth(data: bytes, known: Bool, method: int, low: float, step: float) -> F32 | None:
    """(h, w) depth in metres; arbitrary where unknown."""
    from service.stream import plane_coders

    h, w = known.shape
    codes: Array | None = None
    if method == METHOD_PREDICTION:
        codes = plane_coders.decode_codes(data, known)
    elif method == METHOD_JPEG_LS:
        codes = open_jpeg_ls(data, w, h)
    if codes is None:
        return None
    return np.asarray(1.0 / (low + step * codes.astype(np.float64)), np.float32)


# Sigma: mean of 4x4 blocks on a logarithmic scale; 0 is unknown.


def encode_sigma(planes: Planes) -> bytes:
    """The section of sigma: one code per block of SIGMA_BLOCK_PX."""
    blocks = _blocks(planes.sigma_m, SIGMA_BLOCK_PX, 0)
    codes = sigma_codes(blocks.sum(axis=0) / np.maximum(np.count_nonzero(blocks, axis=0), 1))
    return _jpeg_ls(_fill_back(codes, codes > 0)) if codes.any() else b""


def sigma_codes(sigma_m: Array) -> U8:
    """The code of each sigma in metres; 0 unless it is positive and finite."""
    known_m = np.nan_to_num(sigma_m, posinf=0.0)
    octaves = np.log2(np.maximum(known_m, SIGMA_UNIT_M) / SIGMA_UNIT_M)
    codes = np.clip(np.rint(octaves * SIGMA_STEPS_PER_OCTAVE) + 1, 1, 255)
    return np.where(known_m > 0, codes, 0).astype(np.uint8)


def decode_sigma(data: bytes, w: int, h: int) -> F32 | None:
    """(h, w) sigma in metres; an empty section means that none is known (NaN)."""
    if not data:
        return np.full((h, w), np.nan, np.float32)
    codes = open_jpeg_ls(data, -(-w // SIGMA_BLOCK_PX), -(-h // SIGMA_BLOCK_PX))
    if codes is None:
        return None
    return _enlarge(SIGMA_M.astype(np.float32)[np.minimum(codes, 255)], SIGMA_BLOCK_PX, w, h)


# Views: minimum count of 2x2 blocks; coarse layers have none.


def encode_views(planes: Planes) -> bytes:
    """The section of views: one count per block of VIEWS_BLOCK_PX, at most MAX_VIEWS."""
    views = np.where(planes.known, np.clip(planes.views, 1, MAX_VIEWS), np.uint8(255))
    low = _blocks(views, VIEWS_BLOCK_PX, 255).min(axis=0)
    return _jpeg_ls(_fill_back(low, low != 255))


def decode_views(data: bytes, w: int, h: int) -> U8 | None:
    """(h, w) counts of views; an empty section means one."""
    if not data:
        return np.ones((h, w), np.uint8)
    codes = open_jpeg_ls(data, -(-w // VIEWS_BLOCK_PX), -(-h // VIEWS_BLOCK_PX))
    if codes is None:
        return None
    return _enlarge(np.clip(codes, 1, MAX_VIEWS).astype(np.uint8), VIEWS_BLOCK_PX, w, h)


# Colour: a baseline JPEG of the box.


def encode_colour(planes: Planes, quality: int) -> bytes:
    """The box as a JPEG; blocks without known pixels are flat and cost little."""
    from service.stream import plane_coders

    image = np.ascontiguousarray(planes.bgr)
    if not planes.known.all():
        image = plane_coders.calm(image, np.ascontiguousarray(planes.known), MCU_PX)
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    return cv2.imencode(".jpg", image, options)[1].tobytes()


def decode_colour(data: bytes, w: int, h: int) -> U8 | None:
    """(h, w, 3) BGR."""
    if image_size(data) != (w, h):
        return None
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        return None
    if image is None or image.shape != (h, w, 3):
        return None
    return np.asarray(image, np.uint8)


def _blocks(plane: Array, size: int, outside: float) -> Array:
    """(size x size, rows, columns) of the plane: the pixels of each square block."""
    h, w = plane.shape
    full = np.pad(plane, ((0, -h % size), (0, -w % size)), constant_values=outside)
    return np.stack([full[i::size, j::size] for i in range(size) for j in range(size)])


def _enlarge(blocks: Array, factor: int, w: int, h: int) -> Array:
    return np.repeat(np.repeat(blocks, factor, axis=0), factor, axis=1)[:h, :w]


def image_size(data: bytes) -> tuple[int, int] | None:
    """(w, h) in the frame header of a JPEG or JPEG-LS image; None if it has none."""
    at = 2
    if data[:2] != b"\xff\xd8":
        return None
    while at + 9 <= len(data):
        if data[at] != 0xFF:
            return None
        marker = data[at + 1]
        if marker in (0xC0, 0xC1, 0xC2, 0xF7):
            return int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(
                data[at + 5 : at + 7], "big"
            )
        if marker in (0xD9, 0xDA):
            return None
        length = int.from_bytes(data[at + 2 : at + 4], "big")
        at += 2 + max(length, 2)
    return None


def _jpeg_ls(codes: Array) -> bytes:
    """A JPEG-LS image of (h, w) uint8 codes, by FFmpeg."""
    from av import VideoCodecContext, VideoFrame

    encoder = VideoCodecContext.create("jpegls", "w")
    encoder.thread_count = 1
    encoder.height, encoder.width = codes.shape
    encoder.pix_fmt, encoder.time_base = "gray", Fraction(1)
    frame = VideoFrame.from_ndarray(np.ascontiguousarray(codes), format="gray")
    return b"".join(bytes(part) for part in (*encoder.encode(frame), *encoder.encode(None)))


def open_jpeg_ls(data: bytes, w: int, h: int) -> Array | None:
    """(h, w) codes of a JPEG-LS image of exactly that size and one component."""
    if image_size(data) != (w, h):
        return None
    from av import Packet, VideoCodecContext
    from av.error import FFmpegError

    decoder = VideoCodecContext.create("jpegls", "r")
    decoder.thread_count = 1
    decoder.options = {"max_pixels": str((w + 64) * (h + 64)), "err_detect": "explode"}
    try:
        frames = [*decoder.decode(Packet(data)), *decoder.decode(None)]
    except (FFmpegError, ValueError):
        return None
    if (
        len(frames) != 1
        or frames[0].is_corrupt
        or frames[0].format.name not in ("gray", "gray16le")
    ):
        return None
    codes = frames[0].to_ndarray()
    return np.asarray(codes) if codes.shape == (h, w) else None
