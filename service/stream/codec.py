"""Keyframes as coded layers, and back.

A keyframe becomes a coarse layer and a fine layer. Each layer is one message that decodes
independently; the fine layer replaces the coarse one. Only ``fresh`` pixels with known depth are
coded. A layer is an envelope (header, sizes, checksum) around five sections; :func:`unpack` checks
every bound on a decoder's memory before a section is opened. ``docs/wire.md`` specifies the bytes.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from recon.camera_model import scaled_K
from recon.types import F64, DepthMap, Keyframe, Pose
from service.stream import planes
from service.stream.records import PLACE_BYTES, pack_place, source_bits, sources_of, unpack_place
from service.stream.validity import MAX_DEPTH_M, MIN_DEPTH_M, is_inverse_depth, is_pinhole, is_time

MAX_SIDE_PX = 4096
MAX_PIXELS = 1 << 22
"""Width times height of a grid; 2704x1520 fits. Decoding allocates less than 160 MB."""
MAX_LAYER_BYTES = 1 << 24
MAX_LAYERS = 8
IMAGE_LAYER = MAX_LAYERS
"""Place of a keyframe's image among its layers in the store."""

_ID = struct.Struct("<4sBBBBIq")  # magic, version, layer, layers, sources, seq, time
_GRID = struct.Struct("<HHBB4H")  # full w, full h, factor, depth method, box x y w h
_OPTICS = struct.Struct("<6f")  # inverse min, inverse step, fx, fy, cx, cy
_PLACE = struct.Struct(f"<{PLACE_BYTES}s")  # pose and covariance, as in records
_SIZES = struct.Struct("<5I")
_CRC = struct.Struct("<I")
_PARTS = (_ID, _GRID, _OPTICS, _PLACE, _SIZES)
_SEALED_BYTES = sum(part.size for part in _PARTS)

MAGIC = b"SRKF"
VERSION = 1
HEADER_BYTES = _SEALED_BYTES + _CRC.size


@dataclass(frozen=True, slots=True, eq=False)
class LayerHead:
    """The header of one layer."""

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
        """(w, h) of this layer's grid."""
        return -(-self.full_px[0] // self.factor), -(-self.full_px[1] // self.factor)

    @property
    def grid_K(self) -> F64:
        """(3, 3) intrinsics of this layer's grid."""
        return scaled_K(self.K, 1.0 / self.factor, 1.0 / self.factor)


def pack(head: LayerHead, sections: Sequence[bytes], place: bytes = b"") -> bytes:
    """The layer: ``head``, checksum, then mask, depth, sigma, views and colour sections.

    ``place`` is the head's pose and covariance packed by pack_place, if available.
    """
    K = head.K
    sealed = b"".join(
        (
            _ID.pack(
                MAGIC,
                VERSION,
                head.layer,
                head.layers,
                source_bits(head.sources),
                head.seq,
                head.time_unix_ns,
            ),
            _GRID.pack(*head.full_px, head.factor, head.method, *head.box),
            _OPTICS.pack(head.inverse_min, head.inverse_step, K[0, 0], K[1, 1], K[0, 2], K[1, 2]),
            place or pack_place(head.T_world_camera, head.covariance),
            _SIZES.pack(*(len(s) for s in sections)),
        )
    )
    body = b"".join(sections)
    return sealed + _CRC.pack(zlib.crc32(body, zlib.crc32(sealed))) + body


def peek(data: bytes) -> LayerHead | None:
    """The header of a layer whose checksum holds and whose sizes are allowed, else None."""
    opened = unpack(data)
    return opened[0] if opened else None


def unpack(data: bytes) -> tuple[LayerHead, tuple[bytes, ...]] | None:
    """Header and the five sections of a layer; None for an invalid layer."""
    if not HEADER_BYTES <= len(data) <= MAX_LAYER_BYTES or data[:5] != MAGIC + bytes([VERSION]):
        return None
    crc = zlib.crc32(memoryview(data)[HEADER_BYTES:], zlib.crc32(data[:_SEALED_BYTES]))
    if crc != _CRC.unpack_from(data, _SEALED_BYTES)[0]:
        return None
    fields = []
    offset = 0
    for part in _PARTS:
        fields.append(part.unpack_from(data, offset))
        offset += part.size
    head = _head(fields)
    if head is None or not _plausible(head):
        return None
    sections = []
    offset = HEADER_BYTES
    for size in fields[4]:
        sections.append(data[offset : offset + size])
        offset += size
    return (head, tuple(sections)) if offset == len(data) else None


def _head(fields: list[tuple[Any, ...]]) -> LayerHead | None:
    _, _, layer, layers, bits, seq, time_unix_ns = fields[0]
    w, h, factor, method, x, y, box_w, box_h = fields[1]
    optics = np.array(fields[2], np.float64)
    place = unpack_place(fields[3][0])
    if place is None or not np.isfinite(optics).all():
        return None
    fx, fy, cx, cy = optics[2:]
    return LayerHead(
        layer=layer,
        layers=layers,
        seq=seq,
        time_unix_ns=time_unix_ns,
        full_px=(w, h),
        factor=factor,
        method=method,
        box=(x, y, box_w, box_h),
        inverse_min=float(optics[0]),
        inverse_step=float(optics[1]),
        K=np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
        T_world_camera=place[0],
        covariance=place[1],
        sources=sources_of(bits),
    )


def _plausible(head: LayerHead) -> bool:
    w, h = head.full_px
    if not (0 < w <= MAX_SIDE_PX and 0 < h <= MAX_SIDE_PX and w * h <= MAX_PIXELS):
        return False
    if not is_time(head.time_unix_ns):
        return False
    if not (head.factor >= 1 and head.layer < head.layers <= MAX_LAYERS):
        return False
    K = head.K
    if not is_pinhole((K[0, 0], K[1, 1], K[0, 2], K[1, 2]), (w, h)):
        return False
    x, y, box_w, box_h = head.box
    if x + box_w > head.grid_px[0] or y + box_h > head.grid_px[1] or (box_w == 0) != (box_h == 0):
        return False
    return box_w == 0 or is_inverse_depth(head.inverse_min, head.inverse_step)


REFERENCE_DEPTH_M = 60.0
FINE_RMS_M, COARSE_RMS_M = 0.00398, 0.1
"""Rounding error of depth at the reference; the step of inverse depth is uniform, so that the error
grows with the depth squared."""
FINE_QUALITY, COARSE_QUALITY = 80, 25  # of JPEG, 1 to 100
COARSE_WIDTH_PX = 80


def _step(rms_m: float) -> float:
    """Step of inverse depth, 1/m, whose rounding error at the reference is ``rms_m``."""
    return rms_m * math.sqrt(12.0) / REFERENCE_DEPTH_M**2


def encode(keyframe: Keyframe, time_unix_ns: int) -> tuple[bytes, ...]:
    """The layers of ``keyframe``, coarse first; the last one holds everything.

    A keyframe no wider than COARSE_WIDTH_PX is one layer. Raises ValueError when the
    grid is empty, beyond MAX_SIDE_PX or MAX_PIXELS, or the arrays differ in size.
    """
    depth = keyframe.depth
    h, w = depth.depth_m.shape
    _check(keyframe, w, h)
    with np.errstate(invalid="ignore"):
        known = keyframe.fresh & (depth.depth_m > MIN_DEPTH_M) & (depth.depth_m < MAX_DEPTH_M)
    fine = planes.planes_of(depth, keyframe.bgr, known)
    factor = -(-w // COARSE_WIDTH_PX)
    pose = pack_place(depth.T_world_camera, keyframe.pose.covariance)

    def layer(number: int, factor: int, full: planes.Planes, rms_m: float, quality: int) -> bytes:
        place = (number, layers, factor)
        return _layer(keyframe, time_unix_ns, place, pose, full, _step(rms_m), quality)

    layers = 1 if factor == 1 else 2
    finest = layer(layers - 1, 1, fine, FINE_RMS_M, FINE_QUALITY)
    if layers == 1:
        return (finest,)
    coarse = planes.reduce(fine, factor)
    return layer(0, factor, coarse, COARSE_RMS_M, COARSE_QUALITY), finest


def _check(keyframe: Keyframe, w: int, h: int) -> None:
    if not (0 < w <= MAX_SIDE_PX and 0 < h <= MAX_SIDE_PX and w * h <= MAX_PIXELS):
        raise ValueError(f"keyframe of {w}x{h} px; at most 4096 a side and {MAX_PIXELS} in all")
    depth = keyframe.depth
    for name, shape in (
        ("sigma_m", depth.sigma_m.shape),
        ("views", depth.views.shape),
        ("fresh", keyframe.fresh.shape),
        ("bgr", keyframe.bgr.shape[:2]),
    ):
        if shape != (h, w):
            raise ValueError(f"{name} is {shape}, the depth is {(h, w)}")


def _layer(
    keyframe: Keyframe,
    time_unix_ns: int,
    place: tuple[int, int, int],
    pose: bytes,
    full: planes.Planes,
    step: float,
    quality: int,
) -> bytes:
    """One coded layer; ``place`` is its number, how many there are, and its factor; ``pose``
    is that of the keyframe, packed."""
    from service.stream import plane_coders

    layer, layers, factor = place
    box = planes.bounding_box(full.known)
    low = 0.0
    sections: tuple[bytes, ...] = (b"",) * 5
    if box[2] > 0:
        cut = full.crop(box)
        codes, low, step = planes.quantise(cut, step)
        sections = (
            planes.encode_mask(cut.known),
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
    return pack(head, sections, pose)


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
    w, h = head.box[2:]
    if w == 0:
        blank = np.zeros((0, 0), np.float32)
        none = np.zeros((0, 0), np.uint8)
        return planes.Planes(blank, blank, none, np.zeros((0, 0, 3), np.uint8), none > 0)
    mask, depth, sigma, views, colour = sections
    known = planes.decode_mask(mask, w, h)
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
