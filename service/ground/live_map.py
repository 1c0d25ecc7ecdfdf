"""The map of a scan while it grows, as Web Mercator tiles drawn from its keyframes.

A tile keeps the keyframes that it was drawn from: a new one is drawn into it, one that moved or
became finer makes it again. Each pixel has the height and the colour of its surest point. Where
nothing is measured inside of what is, as around crowns, it has the colour that images show.
"""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from dataclasses import dataclass, field, replace
from functools import lru_cache

import cv2
import numpy as np

from recon.mapping.cloud_fusion import cloud_of, joined
from recon.mapping.voxel_map import ground_sample_m
from recon.surface.raster import Grid, Raster, fill_holes
from recon.types import F32, F64, U8, Array, Keyframe, PointCloud
from service.errors import MissingError
from service.georeference import LocalFrame
from service.scans.drawing import exposure, values
from service.scans.main_piece import main_seqs
from service.scans.track import local_frame
from service.stream.codec import whole_bgr
from service.stream.store import ScanStore

SIDE, MARGIN = 256, 8
WIDE = SIDE + 2 * MARGIN
"""Pixels of a tile, and of the margin around it that shading and contours look at."""

EQUATOR_M = 2.0 * math.pi * 6378137.0
MAX_ZOOM = 24
HOLE_PX = 4
GAP_PX = 12  # of an image: what lies between measured pixels, up to twice so far apart, is shown

UNMEASURED_M = 1e6
"""Sigma of a place that images show and nothing measured, and one more for each pixel from there to
a measured one: the nearest is shown."""

MAX_TILES = 150

Tile = tuple[int, int, int]  # zoom, column from west, row from north

State = tuple[int, int]
"""Of a keyframe, as :meth:`ScanStore.states` gives it."""


def mercator(lat_deg: F64, lon_deg: F64) -> F64:
    """(N, 2) places in the square of Web Mercator: 0 to 1 from west and from north."""
    y = np.arcsinh(np.tan(np.radians(lat_deg))) / np.pi
    return np.column_stack([lon_deg / 360.0 + 0.5, 0.5 - 0.5 * y])


def degrees(x: float, y: float) -> tuple[float, float]:
    """(latitude, longitude) of a place in that square."""
    return math.degrees(math.atan(math.sinh(math.pi * (1.0 - 2.0 * y)))), 360.0 * (x - 0.5)


def pixel_m(zoom: int, lat_deg: float) -> float:
    """Length of a tile's pixel on the ground."""
    return EQUATOR_M * math.cos(math.radians(lat_deg)) / (SIDE << zoom)


@dataclass(slots=True, eq=False)
class _Drawn:
    states: dict[int, State] = field(default_factory=dict)
    sigma: F32 = field(default_factory=lambda: np.full(WIDE * WIDE, np.inf, np.float32))
    height: F32 = field(default_factory=lambda: np.full(WIDE * WIDE, np.nan, np.float32))
    rgb: U8 = field(default_factory=lambda: np.zeros((WIDE * WIDE, 3), np.uint8))


@dataclass(frozen=True, slots=True, eq=False)
class _Points:
    """A keyframe's points, the surest last."""

    place: F64  # (N, 2) in the square of Web Mercator
    height_m: F32  # NaN where it is not measured
    sigma_m: F32
    rgb: U8


class LiveMap:
    """The map of one open store. Use it from one thread at a time."""

    def __init__(self, store: ScanStore) -> None:
        """Raises InputError for a scan without a georeference."""
        frame = local_frame(store.header)
        if frame is None:
            raise MissingError("no map: the scan has no georeference")
        self._store, self._frame = store, frame
        self.zoom: int | None = None  # the finest that is drawn; finer tiles are enlarged
        self.version = 0  # counts the keyframes that came or changed
        self._states: dict[int, State] = {}  # of the keyframes that were read
        self._boxes: dict[int, F64] = {}
        self._values: dict[int, Array] = {}  # of the colours
        self._tiles: OrderedDict[Tile, _Drawn] = OrderedDict()
        self._points = lru_cache(maxsize=64)(self._points_of)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """(west, north, east, south) in the square of Web Mercator; InputError without surface."""
        boxes = np.array(list(self._boxes.values())).reshape(-1, 4)
        if not np.isfinite(boxes).any():
            raise MissingError("no surface yet")
        west, north = np.nanmin(boxes[:, :2], axis=0).tolist()
        east, south = np.nanmax(boxes[:, 2:], axis=0).tolist()
        return west, north, east, south

    @property
    def exposure(self) -> float:
        """What the colours are multiplied with where they are looked at, as in the 3D view."""
        return exposure(np.sum([np.zeros(256), *self._values.values()], axis=0))

    def refresh(self, read_s: float = 2.0) -> None:
        """Take note of keyframes that are new, finer or moved, for ``read_s`` at most: the next
        request reads on."""
        until = time.monotonic() + read_s
        states = self._store.states()
        for seq in main_seqs(self._store):
            state = states.get(seq, (-1, -1))
            if self._states.get(seq) == state:
                continue
            self._boxes[seq], self._states[seq] = self._box(seq, state), state
            self.version += 1
            if time.monotonic() > until:
                return

    def surface(self, tile: Tile, seen: bool = False) -> Raster:
        """The measured part of a tile, (WIDE, WIDE) with its margin, at a zoom up to :attr:`zoom`.
        With ``seen`` all that images show between, at height 0."""
        drawn = self._tiles.pop(tile, None) or _Drawn()
        now = dict(self._within(tile))
        if any(now.get(seq) != state for seq, state in drawn.states.items()):
            drawn = _Drawn()
        for seq in now.keys() - drawn.states.keys():
            self._draw(self._points(seq, now[seq]), tile, drawn)
        drawn.states = now
        self._tiles[tile] = drawn
        while len(self._tiles) > MAX_TILES:
            self._tiles.popitem(last=False)
        height = drawn.height
        if seen:
            height = np.where(np.isfinite(drawn.sigma), 0.0, np.nan).astype(np.float32)
        shape = (WIDE, WIDE)
        grid = Grid(0.0, 0.0, pixel_m(tile[0], self._frame.lat_deg), shape)
        raster = Raster(
            grid, height.reshape(shape), drawn.sigma.reshape(shape), drawn.rgb.reshape(*shape, 3)
        )
        return fill_holes(raster, HOLE_PX)

    def _within(self, tile: Tile) -> list[tuple[int, State]]:
        """Keyframes whose points may lie in a tile or its margin, with their states."""
        west, north = _corner(tile)
        side = WIDE / SIDE / (1 << tile[0])
        seqs, b = list(self._boxes), np.array(list(self._boxes.values())).reshape(-1, 4)
        hit = (b[:, 0] < west + side) & (b[:, 2] > west) & (b[:, 1] < north + side)
        inside = np.flatnonzero(hit & (b[:, 3] > north))
        return [(seqs[i], self._states[seqs[i]]) for i in inside]

    def _draw(self, points: _Points, tile: Tile, drawn: _Drawn) -> None:
        """Put those points into a tile whose sigma is smaller than that of the point it shows."""
        scale = float(SIDE << tile[0])
        col, row = np.floor((points.place - _corner(tile)) * scale).astype(np.int64).T
        inside = (col >= 0) & (col < WIDE) & (row >= 0) & (row < WIDE)
        at = (row * WIDE + col)[inside]
        sigma = np.full(WIDE * WIDE, np.inf, np.float32)
        which = np.zeros(WIDE * WIDE, np.int64)
        sigma[at], which[at] = points.sigma_m[inside], np.flatnonzero(inside)
        new = np.flatnonzero(sigma < drawn.sigma)
        drawn.sigma[new] = sigma[new]
        drawn.height[new] = points.height_m[which[new]]
        drawn.rgb[new] = points.rgb[which[new]]

    def _box(self, seq: int, state: State) -> F64:
        """(4,) bounds of a keyframe's points; NaN without any."""
        points = self._points(seq, state)
        place = points.place
        self._values[seq] = values(points.rgb[np.isfinite(points.height_m)])
        if not len(place):
            return np.full(4, np.nan)
        return np.concatenate([place.min(axis=0), place.max(axis=0)])

    def _points_of(self, seq: int, state: State) -> _Points:
        keyframe = self._store.keyframe(seq)
        if keyframe is None:
            empty = np.zeros(0, np.float32)
            return _Points(np.zeros((0, 2)), empty, empty, np.zeros((0, 3), np.uint8))
        sample_m = ground_sample_m(keyframe.depth)
        if self.zoom is None and sample_m is not None:
            finest = math.log2(pixel_m(0, self._frame.lat_deg) / max(sample_m, 1e-3))
            self.zoom = min(max(math.floor(finest), 0), MAX_ZOOM)
        cloud = cloud_of(keyframe.depth, keyframe.bgr, keyframe.fresh)
        image = self._store.image(seq)
        if image is not None and len(cloud):
            cloud = joined([cloud, unmeasured(keyframe, image)])
        order = np.argsort(-cloud.sigma_m)
        sigma = cloud.sigma_m[order]
        place = on_map(self._frame, cloud.xyz_m[order].astype(np.float64))
        height = np.where(sigma < UNMEASURED_M, place[:, 2], np.nan).astype(np.float32)
        return _Points(place[:, :2], height, sigma, cloud.rgb[order])


def unmeasured(keyframe: Keyframe, image: bytes) -> PointCloud:
    """The pixels between measured ones, in the colours of the keyframe's ``image`` (JPEG), at the
    depth of the nearest measured one; none where it cannot be read."""
    from scipy import ndimage

    colours = whole_bgr(keyframe, image)
    is_readable = colours is not keyframe.bgr
    depth = keyframe.depth
    known = np.isfinite(depth.depth_m) & keyframe.fresh
    size = 2 * GAP_PX + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    padded = np.pad(known, GAP_PX).astype(np.uint8)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disc)[GAP_PX:-GAP_PX, GAP_PX:-GAP_PX]
    inside = ndimage.binary_fill_holes(closed) & ~known & is_readable
    distance, near = ndimage.distance_transform_edt(~known, return_indices=True)
    filled = replace(
        depth, depth_m=depth.depth_m[tuple(near)], sigma_m=np.zeros_like(depth.sigma_m)
    )
    cloud = cloud_of(filled, colours, inside)
    return replace(cloud, sigma_m=(UNMEASURED_M + distance[inside]).astype(np.float32))


def _corner(tile: Tile) -> F64:
    """(2,) the north-west corner of a tile's margin, in the square of Web Mercator."""
    zoom, x, y = tile
    return (np.array([x, y]) - MARGIN / SIDE) / (1 << zoom)


def on_map(frame: LocalFrame, enu_m: F64) -> F64:
    """(N, 3) place in the square of Web Mercator and AMSL metres of (N, 3) ENU metres.

    By an affine map of the box around the points, which over some kilometres is exact to far
    less than a pixel of their image.
    """
    if not len(enu_m):
        return np.zeros((0, 3))
    low, high = enu_m.min(axis=0), enu_m.max(axis=0) + 1.0
    box = np.array(np.meshgrid(*np.column_stack([low, high]))).reshape(3, -1).T
    geodetic = frame.to_geodetic(box)
    known = np.column_stack([mercator(geodetic[:, 0], geodetic[:, 1]), geodetic[:, 2]])
    middle, zero = box.mean(axis=0), known.mean(axis=0)
    A: Array = np.linalg.lstsq(box - middle, known - zero, rcond=None)[0]
    return np.asarray((enu_m - middle) @ A + zero)
