"""Keyframes as coded layers, and back.

A keyframe becomes a coarse layer and a fine layer. Each layer is a message of its own that
decodes alone; the fine layer replaces the coarse one. Only ``fresh`` pixels with a known
depth are carried. The bytes are specified in ``docs/wire.md``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from recon.types import DepthMap, Keyframe, Pose
from service.stream import planes
from service.stream.layer import MAX_PIXELS, MAX_SIDE_PX, LayerHead, pack, unpack
from service.stream.records import pack_place
from service.stream.validity import MAX_DEPTH_M, MIN_DEPTH_M


@dataclass(frozen=True, slots=True)
class CodecConfig:
    """How finely keyframes are coded.

    The step of inverse depth is uniform and set so that its rounding alone gives
    ``depth_rms_m`` at ``reference_depth_m``; the error grows with the depth squared.
    """

    depth_rms_m: float = 0.00398
    reference_depth_m: float = 60.0
    colour_quality: int = 80  # JPEG, 1 to 100
    coarse_width_px: int = 80
    coarse_depth_rms_m: float = 0.1
    coarse_colour_quality: int = 25
    depth_method: int = planes.METHOD_PREDICTION  # or planes.METHOD_JPEG_LS

    def __post_init__(self) -> None:
        for name in ("depth_rms_m", "reference_depth_m", "coarse_depth_rms_m"):
            if not 0 < getattr(self, name) < 1e6:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        for name in ("colour_quality", "coarse_colour_quality"):
            if not 1 <= getattr(self, name) <= 100:
                raise ValueError(f"{name} must be 1 to 100, got {getattr(self, name)}")
        if self.depth_method not in (planes.METHOD_JPEG_LS, planes.METHOD_PREDICTION):
            raise ValueError(f"depth_method must be 1 or 2, got {self.depth_method}")
        if not 8 <= self.coarse_width_px <= MAX_SIDE_PX:
            raise ValueError(f"coarse_width_px must be 8 to 4096, got {self.coarse_width_px}")

    @property
    def fine_step(self) -> float:
        """Step of inverse depth, 1/m, whose rounding error is ``depth_rms_m`` rms."""
        return self.depth_rms_m * math.sqrt(12.0) / self.reference_depth_m**2

    @property
    def coarse_step(self) -> float:
        """The same for ``coarse_depth_rms_m``."""
        return self.coarse_depth_rms_m * math.sqrt(12.0) / self.reference_depth_m**2


def encode(
    keyframe: Keyframe, time_unix_ns: int, config: CodecConfig | None = None
) -> tuple[bytes, ...]:
    """The layers of ``keyframe``, coarse first; the last one holds everything.

    A keyframe no wider than ``coarse_width_px`` is one layer. Raises ValueError when the
    grid is empty, beyond MAX_SIDE_PX or MAX_PIXELS, or the arrays differ in size.
    """
    config = config or CodecConfig()
    depth = keyframe.depth
    h, w = depth.depth_m.shape
    _check(keyframe, w, h)
    with np.errstate(invalid="ignore"):
        known = keyframe.fresh & (depth.depth_m > MIN_DEPTH_M) & (depth.depth_m < MAX_DEPTH_M)
    fine = planes.planes_of(depth, keyframe.bgr, known)
    factor = -(-w // config.coarse_width_px)
    fine_place = (0, 1, 1) if factor == 1 else (1, 2, 1)
    pose = pack_place(depth.T_world_camera, keyframe.pose.covariance)
    quality = config.colour_quality
    fine_layer = _layer(
        keyframe, time_unix_ns, fine_place, pose, fine, config.fine_step, quality, config
    )
    if factor == 1:
        return (fine_layer,)
    coarse = planes.reduce(fine, factor)
    quality = config.coarse_colour_quality
    place = (0, 2, factor)
    return (
        _layer(keyframe, time_unix_ns, place, pose, coarse, config.coarse_step, quality, config),
        fine_layer,
    )


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
    config: CodecConfig,
) -> bytes:
    """One coded layer; ``place`` is its number, how many there are, and its factor; ``pose``
    is that of the keyframe, packed."""
    layer, layers, factor = place
    box = planes.bounding_box(full.known)
    low = 0.0
    sections: tuple[bytes, ...] = (b"",) * 5
    if box[2] > 0:
        cut = full.crop(box)
        codes, low, step = planes.quantise(cut, step)
        sections = (
            planes.encode_mask(cut.known),
            planes.encode_depth(codes, cut.known, config.depth_method),
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
        method=config.depth_method,
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

    Any bytes are survived. ``time_ns`` is unix time, ``fresh`` marks the pixels carried, and
    the depth of all others is NaN. A coarse layer gives a keyframe of its own, smaller grid.
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
    known &= depth_m >= 0.5 * np.float32(MIN_DEPTH_M)  # what no encoder writes, but for rounding
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
