"""Rectified pairs to the fused depth of a keyframe without leaving the device.

Each pair goes up once, in one copy from pinned memory that nobody waits for; cost, belief
propagation, visibility, upsampling, reprojection and fusion follow on the device, on CUDA as
one graph a pair; the fused depth comes down once, and that is the only wait.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from recon.backends.room import pyramid_levels, room
from recon.backends.torch_believe import believe, drop_unseen
from recon.backends.torch_dense import DenseStereo
from recon.backends.torch_depth import fuse, reproject
from recon.backends.torch_kernels import PLAIN, Kernels
from recon.backends.torch_plan import Plan, part, read
from recon.backends.torch_upsampling import JointBilateral, averaged
from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.stereo.depth_fusion import FusionConfig
from recon.stereo.upsampling import UpsamplingConfig
from recon.types import F64, Array, DepthMap, StereoPair

KEPT_PLANS = 8


class DensePath:
    """``device`` is "cuda" or "cpu"; one path serves one thread at a time.

    Only exact upsampling is done here: ``upsampling.method`` must be "bilateral", and
    ``matching.fill_occluded`` off, else ValueError.
    """

    def __init__(
        self,
        device: str,
        matching: BeliefPropagationConfig,
        upsampling: UpsamplingConfig,
        fusion: FusionConfig,
        messages: torch.dtype = torch.int16,
        kernels: Kernels = PLAIN,
    ) -> None:
        if matching.fill_occluded or upsampling.method != "bilateral":
            raise ValueError("the path on the device neither fills nor uses the guided filter")
        self.device = device
        self.matching = matching
        self.upsampling = upsampling
        self.fusion = fusion
        self.messages = messages
        self.kernels = kernels
        self._plans: dict[Any, Plan] = {}

    def depth(
        self, pairs: Sequence[StereoPair], K: F64, size_px: tuple[int, int], T_world_camera: F64
    ) -> DepthMap:
        """The fused depth on the keyframe's grid of ``size_px`` (w, h) with intrinsics ``K``.

        Raises ValueError without any pair.
        """
        if not pairs:
            raise ValueError("no stereo pair to fuse")
        with torch.inference_mode():
            for slot, pair in enumerate(pairs):
                self._plan(pair, size_px).upload(_inputs(pair, K), slot)
                if slot == 0:
                    found = self._results(len(pairs), size_px)
                for to, layer in zip(found, self._plan(pair, size_px).run(), strict=True):
                    to[slot].copy_(layer)
            depth, sigma, views = read(fuse(*found, self.fusion))
        return DepthMap(depth, sigma, views.astype(np.uint8), K, T_world_camera)

    def _results(self, pairs: int, size_px: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """Room for depth and sigma of each pair, two (P, h, w)."""
        both = torch.empty((2, pairs, size_px[1], size_px[0]), device=self.device)
        return both[0], both[1]

    def _plan(self, pair: StereoPair, size_px: tuple[int, int]) -> Plan:
        h, w = pair.left.shape
        space = room(h, w, pair.labels)
        fine = None if pair.guide is None else room(pair.guide.shape[0], pair.guide.shape[1], 1)[:2]
        levels = pyramid_levels(h, w, self.matching)
        key = (space, fine, levels, size_px)
        if key not in self._plans:
            while len(self._plans) >= KEPT_PLANS:
                self._plans.pop(next(iter(self._plans)))
            stage = PairDepthStage(self, space[2], levels, size_px)
            shapes = [space[:2]] * 4 + [(*(fine or (0, 0)), 3), (5,), (14,)]
            given = _inputs(pair, np.eye(3))
            parts = [part(a, s) for a, s in zip(given, shapes, strict=True)]
            self._plans[key] = Plan(self.device, stage, parts)
        return self._plans[key]


class PairDepthStage(torch.nn.Module):
    """One pair to depth and sigma (h, w) on the keyframe's grid."""

    def __init__(self, path: DensePath, labels: int, levels: int, size_px: tuple[int, int]) -> None:
        super().__init__()
        self.stereo = DenseStereo(labels, levels, path.matching, path.messages, path.kernels)
        self.upsampling = JointBilateral(path.upsampling, path.kernels)
        self.matching = path.matching
        self.size_px = size_px

    def forward(
        self, left: Tensor, right: Tensor, left_seen: Tensor, right_seen: Tensor, guide: Tensor,
        true: Tensor, geometry: Tensor,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """``true`` (5,) is h, w of the pair, H, W of the guide and the number of labels."""
        own = torch.stack([true[0], true[1], true[4]])
        px, confidence = self.stereo(left, right, own)
        px, confidence = believe(left, px, confidence, own, self.matching)
        px, confidence = drop_unseen(px, confidence, left_seen, right_seen, own)
        sizes = true[:4]
        if guide.shape[0] > 0:
            taps = averaged(guide, (px.shape[0], px.shape[1]), sizes)
            px, confidence = self.upsampling(px, confidence, taps, guide, sizes)
        else:
            sizes = torch.cat([true[:2], true[:2]])
        return reproject(px, confidence, geometry, sizes, self.size_px)


def _inputs(pair: StereoPair, K: F64) -> list[Array]:
    """What goes up: pictures, masks, guide, true sizes and geometry."""
    h, w = pair.left.shape
    everywhere = np.ones((h, w), np.uint8)
    seen = [
        everywhere if m is None else m.view(np.uint8) for m in (pair.left_seen, pair.right_seen)
    ]
    if pair.left_seen is None or pair.right_seen is None:
        seen = [everywhere, everywhere]
    guide = np.zeros((0, 0, 3), np.uint8) if pair.guide is None else pair.guide
    to_left = pair.K @ pair.R_left_keyframe @ np.linalg.inv(K)
    base = [pair.slope, pair.K[0, 0] * pair.baseline_m]
    geometry = np.concatenate([to_left.ravel(), pair.plane, base]).astype(np.float64)
    true = np.array([h, w, guide.shape[0], guide.shape[1], pair.labels], np.int64)
    return [pair.left, pair.right, *seen, guide, true, geometry]
