"""Keyframes as coded layers, and back.

A keyframe becomes a coarse layer and a fine layer. Each layer is one message that decodes
independently; the fine layer replaces the coarse one. Only ``fresh`` pixels with known depth are
coded. A layer is an envelope (header, sizes, checksum) around five sections; :func:`unpack` checks
every bound on a decoder's memory before a section is opened. ``docs/wire.md`` specifies the bytes.

The layers show only what is new, so a small JPEG of the whole keyframe goes with them, for people
and for software that matches images. Its intrinsics are the keyframe's, scaled by the ratio of the
widths.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import accumulate, pairwise, product
from typing import Any

import cv2
import numpy as np

from recon.camera_model import scaled_K
from recon.types import F64, U8, Array, DepthMap, Keyframe, Pose
from service.stream import planes
from service.stream.records import Placed, source_bits, sources_of
from service.stream.validity import MAX_DEPTH_M, MIN_DEPTH_M, is_inverse_depth, is_pinhole, is_time

MAX_SIDE_PX = 4096
MAX_PIXELS = 1 << 22
"""Width times height of a grid; 2704x1520 fits. Decoding allocates less than 160 MB."""
MAX_LAYER_BYTES = 1 << 24
MAX_LAYERS = 8
IMAGE_LAYER = MAX_LAYERS  # place of a keyframe's image among its layers in the store

_LAYER = Placed(
    b"SRKF\x01",
    # layer, layers, sources, seq, time; full w h, factor, depth method, box x y w h;
    # inverse min, inverse step, fx, fy, cx, cy
    first="BBBIqHHBB4H6f",
    last="5I",  # sizes of the sections
    max_bytes=MAX_LAYER_BYTES,
)
HEADER_BYTES = _LAYER.size


@dataclass(frozen=True, slots=True, eq=False)
class LayerHead:
    layer: int  # 0 is the coarsest
    layers: int
    seq: int
    time_unix_ns: int
    full_px: tuple[int, int]  # (w, h) of the keyframe's grid
    factor: int  # one pixel of this layer is factor x factor pixels of the full grid
    method: int  # how the depth section is coded
    box: tuple[int, int, int, int]  # x, y, w, h in this layer's grid; pixels outside are unknown
    inverse_min: float  # 1/m of depth code 0
    inverse_step: float  # 1/m
    K: F64  # (3, 3) of the full grid
    T_world_camera: F64  # (4, 4)
    covariance: F64  # (6, 6)
    sources: tuple[str, ...]

    @property
    def grid_px(self) -> tuple[int, int]:
        return -(-self.full_px[0] // self.factor), -(-self.full_px[1] // self.factor)

    @property
    def grid_K(self) -> F64:
        return scaled_K(self.K, 1.0 / self.factor, 1.0 / self.factor)


def pack(head: LayerHead, sections: Sequence[bytes]) -> bytes:
    """The layer of ``head`` and its mask, depth, sigma, views and colour sections."""
    K = head.K
    first = (
        head.layer, head.layers, source_bits(head.sources), head.seq, head.time_unix_ns,
        *head.full_px, head.factor, head.method, *head.box,
        head.inverse_min, head.inverse_step, K[0, 0], K[1, 1], K[0, 2], K[1, 2],
    )  # fmt: skip
    sizes = [len(section) for section in sections]
    return _LAYER.pack(first, head.T_world_camera, head.covariance, sizes, b"".join(sections))


def peek(data: bytes) -> LayerHead | None:
    """The header of a layer whose checksum holds and whose sizes are allowed, else None."""
    opened = unpack(data)
    return opened[0] if opened else None


def unpack(data: bytes) -> tuple[LayerHead, tuple[bytes, ...]] | None:
    """Header and the five sections of a layer; None for an invalid layer."""
    found = _LAYER.unpack(data)
    if found is None:
        return None
    head = _head(*found[:3])
    ends = list(accumulate(found[3], initial=HEADER_BYTES))
    if head is None or ends[-1] != len(data):
        return None
    return head, tuple(data[start:end] for start, end in pairwise(ends))


def _head(fields: tuple[Any, ...], T: F64, covariance: F64) -> LayerHead | None:
    """The header of the leading ``fields``; None for implausible values."""
    layer, layers, bits, seq, time_unix_ns, w, h, factor, method, x, y, box_w, box_h = fields[:13]
    low, step, fx, fy, cx, cy = fields[13:]
    if not (_is_grid(w, h) and is_time(time_unix_ns) and all(map(math.isfinite, fields[13:]))):
        return None
    if not (factor >= 1 and layer < layers <= MAX_LAYERS and is_pinhole((fx, fy, cx, cy), (w, h))):
        return None
    if box_w and not is_inverse_depth(low, step):
        return None
    head = LayerHead(
        layer=layer,
        layers=layers,
        seq=seq,
        time_unix_ns=time_unix_ns,
        full_px=(w, h),
        factor=factor,
        method=method,
        box=(x, y, box_w, box_h),
        inverse_min=low,
        inverse_step=step,
        K=np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
        T_world_camera=T,
        covariance=covariance,
        sources=sources_of(bits),
    )
    W, H = head.grid_px
    is_inside = x + box_w <= W and y + box_h <= H and (box_w == 0) == (box_h == 0)
    return head if is_inside else None


def _is_grid(w: int, h: int) -> bool:
    return 0 < w <= MAX_SIDE_PX and 0 < h <= MAX_SIDE_PX and w * h <= MAX_PIXELS


REFERENCE_DEPTH_M = 60.0
FINE_RMS_M, COARSE_RMS_M = 0.00398, 0.1
"""Rounding error of depth at the reference; the step of inverse depth is uniform, so that the error
grows with the depth squared."""
FINE_QUALITY, COARSE_QUALITY = 80, 25  # of JPEG, 1 to 100
COARSE_WIDTH_PX = 80


def encode(
    keyframe: Keyframe, time_unix_ns: int, is_coarse_enough: bool = False
) -> tuple[bytes, ...]:
    """The layers of ``keyframe``, coarse first; the last one holds everything, and is left out
    where the coarse one ``is_coarse_enough``.

    A keyframe no wider than COARSE_WIDTH_PX is one layer. Raises ValueError when the
    grid is empty, beyond MAX_SIDE_PX or MAX_PIXELS, or the arrays differ in size.
    """
    depth = keyframe.depth
    h, w = depth.depth_m.shape
    if not _is_grid(w, h):
        raise ValueError(f"keyframe of {w}x{h} px; at most 4096 a side and {MAX_PIXELS} in all")
    arrays: dict[str, Array] = {
        "sigma_m": depth.sigma_m, "views": depth.views, "fresh": keyframe.fresh, "bgr": keyframe.bgr
    }  # fmt: skip
    for name, array in arrays.items():
        if array.shape[:2] != (h, w):
            raise ValueError(f"{name} is {array.shape[:2]}, the depth is {(h, w)}")
    with np.errstate(invalid="ignore"):
        known = keyframe.fresh & (depth.depth_m > MIN_DEPTH_M) & (depth.depth_m < MAX_DEPTH_M)
    fine = planes.planes_of(depth, keyframe.bgr, known)
    factor = -(-w // COARSE_WIDTH_PX)
    layer = partial(_layer, keyframe, time_unix_ns)
    if factor == 1:
        return (layer(0, 1, 1, fine, FINE_RMS_M, FINE_QUALITY),)
    coarse = layer(0, 2, factor, planes.reduce(fine, factor), COARSE_RMS_M, COARSE_QUALITY)
    if is_coarse_enough:
        return (coarse,)
    return coarse, layer(1, 2, 1, fine, FINE_RMS_M, FINE_QUALITY)


def _layer(
    keyframe: Keyframe,
    time_unix_ns: int,
    layer: int,
    layers: int,
    factor: int,
    full: planes.Planes,
    rms_m: float,
    quality: int,
) -> bytes:
    """One coded layer, of depths whose rounding error at the reference is ``rms_m``."""
    from service.stream import plane_coders

    box = planes.bounding_box(full.known)
    low, step = 0.0, rms_m * math.sqrt(12.0) / REFERENCE_DEPTH_M**2  # 1/m
    sections: tuple[bytes, ...] = (b"",) * 5
    if box[2] > 0:
        cut = full.crop(box)
        codes, low, step = planes.quantise(cut, step)
        sections = (
            plane_coders.encode_mask(cut.known),
            plane_coders.encode_codes(codes, cut.known),
            planes.encode_sigma(cut),
            planes.encode_views(cut) if layer == layers - 1 else b"",
            planes.encode_colour(cut, quality),
        )
    h, w = keyframe.depth.depth_m.shape
    head = LayerHead(
        layer=layer,
        layers=layers,
        seq=keyframe.seq,
        time_unix_ns=time_unix_ns,
        full_px=(w, h),
        factor=factor,
        method=planes.METHOD_PREDICTION,
        box=box,
        inverse_min=low,
        inverse_step=step,
        K=keyframe.depth.K,
        T_world_camera=keyframe.depth.T_world_camera,
        covariance=keyframe.pose.covariance,
        sources=keyframe.pose.sources,
    )
    return pack(head, sections)


def decode(layers: Sequence[bytes]) -> Keyframe | None:
    """The keyframe at the finest of ``layers`` that decodes; None when none does.

    Any bytes are safe. ``time_ns`` is unix time, ``fresh`` marks the coded pixels, and the depth
    of all others is NaN. A coarse layer gives a keyframe with its own, smaller grid.
    """
    opened = [unpacked for data in layers if (unpacked := unpack(data)) is not None]
    for head, sections in sorted(opened, key=lambda o: -o[0].layer):
        content = _open_planes(head, sections)
        if content is not None:
            return _keyframe(head, content)
    return None


def _open_planes(head: LayerHead, sections: Sequence[bytes]) -> planes.Planes | None:
    from service.stream import plane_coders

    w, h = head.box[2:]
    if w == 0:
        blank = np.zeros((0, 0), np.float32)
        none = np.zeros((0, 0), np.uint8)
        return planes.Planes(blank, blank, none, np.zeros((0, 0, 3), np.uint8), none > 0)
    mask, depth, sigma, views, colour = sections
    known = plane_coders.decode_mask(mask, w, h)
    depth_m = planes.decode_depth(depth, known, head.method, head.inverse_min, head.inverse_step)
    sigma_m = planes.decode_sigma(sigma, w, h)
    count = planes.decode_views(views, w, h)
    bgr = planes.decode_colour(colour, w, h)
    if depth_m is None or sigma_m is None or count is None or bgr is None:
        return None
    known &= depth_m >= 0.5 * np.float32(MIN_DEPTH_M)  # minimum of any encoder
    return planes.Planes(depth_m, sigma_m, count, bgr, known)


def _keyframe(head: LayerHead, content: planes.Planes) -> Keyframe:
    w, h = head.grid_px
    x, y, box_w, box_h = head.box
    cut = np.s_[y : y + box_h, x : x + box_w]
    depth_m = np.full((h, w), np.nan, np.float32)
    sigma_m = np.full((h, w), np.nan, np.float32)
    views = np.zeros((h, w), np.uint8)
    bgr = np.zeros((h, w, 3), np.uint8)
    fresh = np.zeros((h, w), np.bool_)
    depth_m[cut] = np.where(content.known, content.depth_m, np.float32(np.nan))
    sigma_m[cut] = np.where(content.known, content.sigma_m, np.float32(np.nan))
    views[cut] = np.where(content.known, content.views, 0)
    bgr[cut] = content.bgr
    fresh[cut] = content.known
    T = head.T_world_camera
    return Keyframe(
        seq=head.seq,
        time_ns=head.time_unix_ns,
        depth=DepthMap(depth_m, sigma_m, views, head.grid_K, T),
        bgr=bgr,
        pose=Pose(T, head.covariance, head.sources),
        fresh=fresh,
    )


IMAGE_SHARE = 0.05  # bytes of a flight's images over those of its layers
MAX_IMAGE_BYTES, MAX_IMAGE_PX = 1 << 16, 1024  # a larger image is invalid
IMAGE_STEPS = ((320, 28), (320, 23), (320, 18), (256, 20), (208, 20))
"""Width in pixels and quality of JPEG, the best first: what one image leaves is for later ones."""

SMOOTHED_QUALITY, SMOOTHED_PX = 20, 2
"""Quality at which a decoded image is coded again, and the steps of its shifts within a block."""
BLOCK_PX = 8  # of JPEG


def encode_image(bgr: U8, max_bytes: float = math.inf) -> bytes:
    """The best JPEG of an (h, w, 3) BGR image within ``max_bytes``; if none is, the smallest."""
    h, w = bgr.shape[:2]
    data = b""
    for width, quality in IMAGE_STEPS:
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
    is_jpeg = data[:2] == b"\xff\xd8" and len(data) <= MAX_IMAGE_BYTES
    size = planes.image_size(data) if is_jpeg else None
    return size is not None and min(size) > 0 and max(size) <= MAX_IMAGE_PX
