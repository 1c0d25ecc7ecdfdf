"""Sigma of heights in the world: a point's own, and what the points around it share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from recon.types import F32, F64
from service.scans.main_piece import main_track
from service.scans.trust import depth_share
from service.stream.records import PoseRecord
from service.stream.store import ScanStore

MAX_POSES = 5000
"""Of the track, that are asked; sigma of the position changes slowly along it."""


class SharedSigma:
    """Sigma of the height that all points near a place share: of position, scale and lens."""

    def __init__(self, poses: Sequence[PoseRecord], share: float) -> None:
        """``share`` of a depth is its sigma by scale and lens."""
        poses = poses[:: 1 + len(poses) // MAX_POSES]
        places = np.array([p.T_world_camera[:3, 3] for p in poses])
        from scipy.spatial import cKDTree  # a flight does without it

        self._near, self._up_m = cKDTree(places[:, :2]), places[:, 2]
        self._sigma_m = np.array([p.sigma_h_v_m[1] for p in poses])
        self._share = share

    def absolute_m(self, own_m: F32, places_m: F32 | F64) -> F32:
        """(N,) sigma of the heights of (N, 3) ENU m whose own sigmas are (N,)."""
        at = self._near.query(places_m[:, :2])[1]
        by_depth = self._share * (self._up_m[at] - places_m[:, 2])
        whole_m = np.sqrt(own_m**2 + self._sigma_m[at] ** 2 + by_depth**2)
        return np.asarray(whole_m, np.float32)


def shared_sigma(store: ScanStore) -> SharedSigma | None:
    """What the points of a scan share; None where it is not placed, or of unknown scale."""
    share, poses = depth_share(store.summary or {}, store.header.georeference), main_track(store)
    return None if share is None or not poses else SharedSigma(poses, share)
