"""The map of known surface: finds the new surface of a view; parts flown long ago are on disk.

A mission of hours sees more voxels than a companion computer should hold. Tiles that no view
has touched for longest go to files, and come back before a view looks at their ground again.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from recon.mapping.disagreement import Disagreement
from recon.mapping.voxel_map import VoxelMap, VoxelMapConfig, Voxels, tile_of, tiles_under
from recon.stereo.reprojection import LABEL_SIGMA_PX
from recon.types import F32, F64, I64, Bool, DepthMap
from service.cameras.lens import SIGMA_K1
from service.flight.viewpoints import StereoCandidate
from service.progress import Stopwatch

log = logging.getLogger(__name__)

RECORDED_SIGMA_PX = 0.11
"""Sigma of a match, in pixels of the recording: where stereo's pixels are as small, its labels are
no better (docs/reports/simulated-flights.md)."""

ASSUMED_LENS_SHARE = 0.02
"""Sigma of depth over depth where a lens without distortion is assumed: lenses of action cameras
bend surfaces by that much."""

COMMON_FOCAL_SHARE, MAX_FOCAL_SHARE = 0.02, 0.05
"""Sigma of the focal length that all points share, so that it would only hide how they err against
each other, and up to which sigma of depth holds the rest: above a tenth would drop all points."""

MAX_OVER = 4


class PagedMap:
    """A voxel map (:mod:`recon.mapping.voxel_map`) with about ``max_voxels`` in memory at most.

    The tiles under the view stay, whatever they hold; where they alone have :data:`MAX_OVER`
    times as many, the half seen longest ago is forgotten, and that surface is sent again.

    ``folder`` is made when the first tile leaves and removed by :meth:`close`. A disk that
    takes no more pages costs bandwidth, not data: the map then forgets the oldest half when
    it is full, and that surface is sent again.
    """

    def __init__(self, config: VoxelMapConfig, folder: Path, max_voxels: int = 2_000_000) -> None:
        if max_voxels < 1000:
            raise ValueError(f"max_voxels is {max_voxels}, must be at least 1000")
        self.folder, self.max_voxels = folder, max_voxels
        largest = min(config.largest_voxels, MAX_OVER * max_voxels)
        self._map = VoxelMap(replace(config, largest_voxels=largest))
        self._margin_m = config.voxel_m * (config.largest_reach_voxels + 1)
        self._away: set[int] = set()  # tiles that are on disk
        self._broken = False

    def __len__(self) -> int:
        """Number of voxels in memory."""
        return len(self._map)

    @property
    def tiles_on_disk(self) -> int:
        """How many tiles are on disk now."""
        return len(self._away)

    def fresh(self, depth: DepthMap) -> Bool:
        """(h, w) pixels whose surface is new, or clearly better than what is held."""
        self._bring_back(self._under(depth))
        return self._map.fresh(depth)

    def insert(self, depth: DepthMap, mask: Bool | None = None) -> int:
        """Remember the surface of ``depth`` where ``mask``; how many voxels are new."""
        here = self._under(depth)
        self._bring_back(here)
        new = self._map.insert(depth, mask)
        if len(self._map) > self.max_voxels and not self._broken:
            self._send_away(here)
        return new

    def close(self) -> None:
        """Remove the files; the map is of no use to anyone but this scan."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self._away.clear()

    def _under(self, depth: DepthMap) -> I64:
        return tiles_under(depth, self._map.config.voxel_m, self._margin_m)

    def _bring_back(self, tiles: I64) -> None:
        for tile in self._away.intersection(tiles.tolist()):
            self._away.discard(tile)
            path = self._path(tile)
            try:
                with np.load(path) as page:
                    self._map.put(Voxels(page["keys"], page["sigma_m"], page["seen"]))
                path.unlink()
            except (OSError, KeyError, ValueError, EOFError) as error:
                log.warning(
                    "page %s of the map is lost (%s): its ground counts as new", path, error
                )

    def _send_away(self, keep: I64) -> None:
        """Page the oldest tiles out until the map is at about half its limit."""
        tiles, counts = self._map.oldest_tiles()
        away = ~np.isin(tiles, keep)
        tiles, counts = tiles[away], counts[away]
        surplus = len(self._map) - self.max_voxels // 2
        tiles = tiles[: int(np.searchsorted(np.cumsum(counts), surplus)) + 1]
        taken = self._map.take(tiles)
        home = tile_of(taken.keys)
        for tile in tiles.tolist():
            page = taken.where(home == tile)
            try:
                self.folder.mkdir(parents=True, exist_ok=True)
                np.savez(self._path(tile), keys=page.keys, sigma_m=page.sigma_m, seen=page.seen)
                self._away.add(tile)
            except OSError as error:
                log.warning("the map cannot be paged to %s: %s", self.folder, error)
                self._map.put(page)
                self._broken = True

    def _path(self, tile: int) -> Path:
        return self.folder / f"{tile}.npz"


class SurfaceMap:
    """Compares each view with the surface known before, and remembers it.

    :meth:`clear` may be called from another thread.
    """

    def __init__(
        self,
        pages: Path,
        max_voxels: int,
        resolution_m: float,
        stopwatch: Stopwatch,
        focal_px: float,
        assumed: Collection[str] = (),
        sigma_focal: float = 0.0,
    ) -> None:
        """``pages`` is the folder of :class:`PagedMap`.

        ``focal_px`` is of the recorded images, known to ``sigma_focal``, a share. With "lens" or
        "distortion" among ``assumed``, sigma covers the bending by it.
        """
        self._pages, self._max_voxels, self._resolution_m = pages, max_voxels, resolution_m
        self._stopwatch = stopwatch
        self._focal_px = focal_px
        self._lens_share = ASSUMED_LENS_SHARE if "lens" in assumed else 0.0
        apart = max(min(sigma_focal, MAX_FOCAL_SHARE) ** 2 - COMMON_FOCAL_SHARE**2, 0.0)
        self._lens_share = float(np.hypot(self._lens_share, np.sqrt(apart)))
        self._sigma_k1 = SIGMA_K1 if "distortion" in assumed else 0.0
        self._map: PagedMap | None = None
        self._disagreement, self._segment = Disagreement(), -1

    def __call__(
        self, view: StereoCandidate, depth: DepthMap, T_map_camera: F64
    ) -> tuple[F32, Bool]:
        """((h, w) sigma, which holds disagreement of views, an unknown readout, an assumed lens;
        (h, w) surface that is new or better)."""
        with self._stopwatch("map"):
            if view.segment != self._segment:
                self._disagreement.forget()
                self._segment = view.segment
            reduced = self._focal_px / float(depth.K[0, 0])
            noise = np.float32(max(1.0, RECORDED_SIGMA_PX / LABEL_SIGMA_PX / reduced))
            share = cv2.resize(view.rows_share, depth.depth_m.shape[::-1])
            sigma_m = np.hypot(depth.sigma_m * noise, share * depth.depth_m)
            in_map = replace(depth, sigma_m=sigma_m, T_world_camera=T_map_camera)
            factor = np.float32(self._disagreement.take(in_map))
            in_map = replace(in_map, sigma_m=in_map.sigma_m * factor)
            known = self._map
            if known is None:
                known = self._map = self._empty(depth)
            fresh = known.fresh(in_map)
            known.insert(in_map, fresh)
            return np.hypot(in_map.sigma_m, self._bending(depth) * depth.depth_m), fresh

    def _bending(self, depth: DepthMap) -> F32:
        """Sigma by the lens over depth, (h, w) or a scalar.

        k1 shifts a point at the radius r (of the focal length) by k1 r^3. A pair that sees it with
        the baseline b shifts its disparity by b k1 (3 r^2 along it, r^2 across): 2 r^2 on average.
        """
        if not self._sigma_k1:
            return np.asarray(self._lens_share, np.float32)
        h, w = depth.depth_m.shape
        K = depth.K
        x, y = (np.arange(w) - K[0, 2]) / K[0, 0], (np.arange(h) - K[1, 2]) / K[1, 1]
        bent = 2.0 * self._sigma_k1 * np.add.outer(y * y, x * x)
        return np.asarray(np.hypot(bent, self._lens_share), np.float32)

    def _empty(self, depth: DepthMap) -> PagedMap:
        """A map as fine as the first view."""
        ground_m = float(np.nanmedian(depth.depth_m)) / depth.K[0, 0]
        fine = VoxelMapConfig(voxel_m=max(2.0 * ground_m, self._resolution_m, 1e-3))
        return PagedMap(fine, self._pages, self._max_voxels)

    @property
    def held(self) -> dict[str, int]:
        """Voxels in memory and tiles on disk."""
        known = self._map
        if known is None:
            return {"map_voxels": 0, "map_tiles_on_disk": 0}
        return {"map_voxels": len(known), "map_tiles_on_disk": known.tiles_on_disk}

    def clear(self) -> None:
        """Reset the map: all surface counts as unseen."""
        known, self._map = self._map, None
        if known is not None:
            known.close()
