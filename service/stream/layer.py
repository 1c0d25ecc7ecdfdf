"""The envelope of a coded layer: its header, its sections, its checksum.

The bytes are specified in ``docs/wire.md``. Every bound on what a decoder may allocate is
checked here, before any section is opened.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from recon.camera_model import scaled_K
from recon.types import F64
from service.stream.records import PLACE_BYTES, pack_place, source_bits, sources_of, unpack_place
from service.stream.validity import is_inverse_depth, is_pinhole, is_time

MAX_SIDE_PX = 4096
MAX_PIXELS = 1 << 22
"""Width times height of a grid; 2704x1520 fits. Decoding allocates less than 160 MB."""
MAX_LAYER_BYTES = 1 << 24
MAX_LAYERS = 8

_ID = struct.Struct("<4sBBBBIq")  # magic, version, layer, layers, sources, seq, time
_GRID = struct.Struct("<HHBB4H")  # full w, full h, factor, depth method, box x y w h
_OPTICS = struct.Struct("<6f")  # inverse min, inverse step, fx, fy, cx, cy
_PLACE = struct.Struct(f"<{PLACE_BYTES}s")  # pose and covariance, as records have them
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
    box: tuple[int, int, int, int]  # x, y, w, h in this layer's grid; all else is unknown
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

    ``place`` is what pack_place makes of the head's pose and covariance, if known already.
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
    """Header and the five sections of a layer; None for bytes that are no valid layer."""
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


def _head(fields: list[tuple[object, ...]]) -> LayerHead | None:
    _, _, layer, layers, bits, seq, time_unix_ns = _ints(fields[0])
    w, h, factor, method, x, y, box_w, box_h = _ints(fields[1])
    optics = np.array(fields[2], np.float64)
    place = unpack_place(fields[3][0]) if isinstance(fields[3][0], bytes) else None
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


def _ints(values: tuple[object, ...]) -> list[int]:
    return [v if isinstance(v, int) else 0 for v in values]


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
