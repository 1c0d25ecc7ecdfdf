"""The heavy operations on the processor's cores, compiled by numba.

Each operation imports its kernels when it first runs: an idle service holds a backend, but not the
60 MB of the compiler.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from recon.types import F64, U8, DepthMap, DisparityMap, Registration, StereoPair

if TYPE_CHECKING:
    from recon.mapping.registration import IcpConfig
    from recon.stereo.belief_propagation import BeliefPropagationConfig


class CpuBackend:
    """Runs everywhere; several threads may call it at once."""

    name = "cpu"
    device = "cpu"
    keeps_pairs = False

    def belief_propagation(
        self, left: U8, right: U8, labels: int, config: BeliefPropagationConfig
    ) -> DisparityMap:
        from recon.stereo.belief_propagation import belief_propagation

        return belief_propagation(left, right, labels, config)

    def upsample(self, coarse: DisparityMap, guide: U8) -> DisparityMap:
        from recon.stereo.upsampling import upsample

        return upsample(coarse, guide)

    def register(
        self, source: DepthMap, target: DepthMap, T_target_source: F64, config: IcpConfig
    ) -> Registration:
        from recon.mapping.registration import register_projective

        return register_projective(source, target, T_target_source, config)

    def fused_depth(
        self,
        pairs: Sequence[StereoPair],
        K: F64,
        size_px: tuple[int, int],
        T_world_camera: F64,
        config: BeliefPropagationConfig,
    ) -> None:
        """Nothing is gained here: None."""


def warm_up() -> None:
    """Compile every kernel, or load it from numba's cache on disk; seconds once, then less."""
    from recon.mapping.registration import IcpConfig
    from recon.stereo.belief_propagation import BeliefPropagationConfig

    rng = np.random.default_rng(0)
    guide = rng.integers(0, 256, (180, 320, 3), np.uint8)  # rows enough for several threads
    gray = np.ascontiguousarray(guide[:, :, 0])
    backend = CpuBackend()
    for fill in (False, True):
        matching = BeliefPropagationConfig(fill_occluded=fill)
        found = backend.belief_propagation(gray, gray, 4, matching)
    backend.upsample(found, guide)
    depth = DepthMap(
        np.full((64, 96), 50, np.float32),
        np.full((64, 96), 0.1, np.float32),
        np.ones((64, 96), np.uint8),
        np.array([[80.0, 0, 48], [0, 80, 32], [0, 0, 1]]),
        np.eye(4),
    )
    backend.register(depth, depth, np.eye(4), IcpConfig())
