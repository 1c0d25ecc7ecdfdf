"""A voxel map with little in memory: parts flown long ago are on disk.

A mission of hours sees more voxels than a companion computer should hold. Tiles that no view
has touched for longest go to files, and come back before a view looks at their ground again.
"""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

import numpy as np

from recon.mapping.voxel_map import (
    LARGEST_REACH,
    LARGEST_VOXELS,
    PAGED,
    VoxelMap,
    tile_of,
    tiles_under,
)
from recon.types import I64, Bool, DepthMap

log = logging.getLogger(__name__)

MAX_OVER = 4


class PagedMap(VoxelMap):
    """A voxel map with about ``max_voxels`` in memory at most.

    The tiles under the view stay, whatever they hold; where they alone have :data:`MAX_OVER`
    times as many, the half seen longest ago is forgotten, and that surface is sent again.

    ``folder`` is made when the first tile leaves and removed by :meth:`close`. A disk that
    takes no more pages costs bandwidth, not data: the map then forgets the oldest half when
    it is full, and that surface is sent again.
    """

    def __init__(self, voxel_m: float, folder: Path, max_voxels: int = 2_000_000) -> None:
        if max_voxels < 1000:
            raise ValueError(f"max_voxels is {max_voxels}, must be at least 1000")
        self.folder, self.max_voxels = folder, max_voxels
        super().__init__(voxel_m, min(LARGEST_VOXELS, MAX_OVER * max_voxels))
        self._margin_m = voxel_m * (LARGEST_REACH + 1)
        self._away: set[int] = set()  # tiles that are on disk
        self._broken = False

    @property
    def tiles_on_disk(self) -> int:
        return len(self._away)

    def fresh(self, depth: DepthMap) -> Bool:
        """(h, w) pixels whose surface is new, or clearly better than what is held."""
        self._bring_back(self._under(depth))
        return super().fresh(depth)

    def insert(self, depth: DepthMap, mask: Bool | None = None) -> int:
        """Remember the surface of ``depth`` where ``mask``; how many voxels are new."""
        here = self._under(depth)
        self._bring_back(here)
        new = super().insert(depth, mask)
        if len(self) > self.max_voxels and not self._broken:
            self._send_away(here)
        return new

    def close(self) -> None:
        """Remove the files; the map is of no use to anyone but this scan."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self._away.clear()

    def _under(self, depth: DepthMap) -> I64:
        return tiles_under(depth, self.voxel_m, self._margin_m)

    def _bring_back(self, tiles: I64) -> None:
        for tile in self._away.intersection(tiles.tolist()):
            self._away.discard(tile)
            path = self._path(tile)
            try:
                self.put(np.load(path).astype(PAGED, casting="no"))
                path.unlink()
            except (OSError, TypeError, ValueError, EOFError) as error:
                log.warning(
                    "page %s of the map is lost (%s): its ground counts as new", path, error
                )

    def _send_away(self, keep: I64) -> None:
        """Page the oldest tiles out until the map is at about half its limit."""
        tiles, counts = self.oldest_tiles()
        away = ~np.isin(tiles, keep)
        tiles, counts = tiles[away], counts[away]
        surplus = len(self) - self.max_voxels // 2
        tiles = tiles[: int(np.searchsorted(np.cumsum(counts), surplus)) + 1]
        taken = self.take(tiles)
        home = tile_of(taken["key"])
        for tile in tiles.tolist():
            page = taken[home == tile]
            try:
                self.folder.mkdir(parents=True, exist_ok=True)
                np.save(self._path(tile), page)
                self._away.add(tile)
            except OSError as error:
                log.warning("the map cannot be paged to %s: %s", self.folder, error)
                self.put(page)
                self._broken = True

    def _path(self, tile: int) -> Path:
        return self.folder / f"{tile}.npy"
