"""The map of known surface: finds the new surface of a view."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np

from recon.mapping.disagreement import Disagreement
from recon.mapping.voxel_map import VoxelMap
from recon.types import F32, F64, Bool, DepthMap


class SurfaceMap:
    """Compares each view with the surface known before, and remembers it.

    :meth:`clear` may be called from another thread.
    """

    def __init__(
        self,
        placed: Callable[[Sequence[int]], F64],
        resolution_m: float = 0.0,
        new_map: Callable[[float], VoxelMap] = VoxelMap,
    ) -> None:
        """``placed`` as :meth:`recon.posegraph.trajectory.Trajectory.similarities`; ``new_map``
        makes the empty map of a scan."""
        self._resolution_m, self._new_map = resolution_m, new_map
        self.known: VoxelMap | None = None
        self._disagreement, self._segment = Disagreement(placed), -1

    def __call__(
        self, seq: int, segment: int, depth: DepthMap, rows_share: F32, T_odom_camera: F64
    ) -> tuple[F32, Bool]:
        """((h, w) sigma, which holds disagreement of views and an unknown readout, not what all
        points share; (h, w) surface that is new or better).

        ``rows_share`` (n, m), all over the image, is the sigma of depth over depth by the rows'
        motion.
        """
        if segment != self._segment:
            self._disagreement.forget()
            self._segment = segment
        in_odom = self._in_odom(depth, rows_share, T_odom_camera)
        factor = np.float32(self._disagreement.take(seq, in_odom))
        in_odom = replace(in_odom, sigma_m=in_odom.sigma_m * factor)
        known = self.known
        if known is None:
            known = self.known = self._empty(depth)
        fresh = known.fresh(in_odom)
        known.insert(in_odom, fresh)
        return in_odom.sigma_m, fresh

    def peek(self, depth: DepthMap, rows_share: F32, T_odom_camera: F64) -> tuple[F32, Bool]:
        """As :meth:`__call__`, of a depth that is not remembered and shows no disagreement."""
        in_odom = self._in_odom(depth, rows_share, T_odom_camera)
        known = self.known  # another thread may clear it meanwhile
        fresh = np.isfinite(depth.depth_m) if known is None else known.fresh(in_odom)
        return in_odom.sigma_m, fresh

    def _in_odom(self, depth: DepthMap, rows_share: F32, T_odom_camera: F64) -> DepthMap:
        """The depth at its place, its sigma widened by what its rows limit."""
        share = cv2.resize(rows_share, depth.depth_m.shape[::-1])
        sigma_m = np.hypot(depth.sigma_m, share * depth.depth_m)
        return replace(depth, sigma_m=sigma_m, T_world_camera=T_odom_camera)

    def _empty(self, depth: DepthMap) -> VoxelMap:
        """A map as fine as the first view."""
        ground_m = float(np.nanmedian(depth.depth_m)) / depth.K[0, 0]
        return self._new_map(max(2.0 * ground_m, self._resolution_m, 1e-3))

    def clear(self) -> None:
        known, self.known = self.known, None
        if known is not None:
            known.close()
