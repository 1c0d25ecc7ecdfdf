"""Rectified pairs to the fused depth of a keyframe without leaving the device.

Each pair goes up once, in one copy from pinned memory that no thread waits for; cost, belief
propagation, visibility, upsampling, reprojection and fusion follow on the device, on CUDA as
one graph a pair; the fused depth comes down once, and that is the only wait.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
import torch
from torch import Tensor

from recon.backends.padding import kept, padded, pyramid_levels
from recon.backends.torch_plan import Plan, part, read
from recon.backends.triton_dense import (
    averaged,
    bilateral,
    drop_unreliable,
    drop_unseen,
    fuse,
    reproject,
    stereo,
)
from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.stereo.brightness_transfer import match_brightness
from recon.stereo.reprojection import (
    LABEL_SIGMA_PX,
    MAX_NOISE,
    MIN_COMMON,
    NOISE_STRIDE,
    PAIRS_CORRELATION,
)
from recon.stereo.reprojection import MIN_CONFIDENCE as MIN_REPROJECTED
from recon.stereo.upsampling import MIN_CONFIDENCE
from recon.types import F64, Array, DepthMap, StereoPair

KEPT_PLANS = 8


class DensePath:
    """``device`` is that of the backend; one path serves one thread at a time."""

    def __init__(self, device: str, matching: BeliefPropagationConfig) -> None:
        self.device, self.matching = device, matching
        self.plans: dict[Any, Plan] = {}
        self._fusions: dict[Any, tuple[Tensor, Plan]] = {}

    def depth(
        self, pairs: Sequence[StereoPair], K: F64, size_px: tuple[int, int], T_world_camera: F64
    ) -> DepthMap:
        """The fused depth on the keyframe's grid of ``size_px`` (w, h) with intrinsics ``K``.
        Raises ValueError without any pair."""
        if not pairs:
            raise ValueError("no stereo pair to fuse")
        with torch.inference_mode():
            found, fusion = kept(
                self._fusions, (len(pairs), size_px), KEPT_PLANS,
                lambda: self._fusion(len(pairs), size_px),
            )  # fmt: skip
            for slot, pair in enumerate(pairs):
                plan = self._plan(pair, size_px)
                plan.upload(device_inputs(pair, K, self.matching.min_disparity), slot)
                found[:, slot].copy_(torch.stack(plan.run()))
            depth, sigma, views = read(fusion.run())
        return DepthMap(depth, sigma, views, K, T_world_camera)

    def _fusion(self, pairs: int, size_px: tuple[int, int]) -> tuple[Tensor, Plan]:
        """Room for depth and sigma of each pair, (2, P, h, w), and the plan that fuses them."""
        found = torch.zeros((2, pairs, size_px[1], size_px[0]), device=self.device)

        def fused() -> tuple[Tensor, Tensor, Tensor]:
            return fused_pairs(found[0], found[1])

        return found, Plan(self.device, fused, [])

    def _plan(self, pair: StereoPair, size_px: tuple[int, int]) -> Plan:
        h, w = pair.left.shape
        space = padded(h, w, pair.labels)
        fine = None
        if pair.guide is not None:
            fine = padded(pair.guide.shape[0], pair.guide.shape[1], 1)[:2]
        levels = pyramid_levels(h, w, self.matching)
        key = (space, fine, levels, size_px)

        def build() -> Plan:
            stage = partial(
                pair_depth, labels=space[2], levels=levels, size_px=size_px,
                matching=self.matching,
            )  # fmt: skip
            shapes = [space[:2]] * 4 + [(*(fine or (0, 0)), 3), (5,), (15,)]
            given = device_inputs(pair, np.eye(3), self.matching.min_disparity)
            parts = [part(a, s) for a, s in zip(given, shapes, strict=True)]
            return Plan(self.device, stage, parts)

        return kept(self.plans, key, KEPT_PLANS, build)


def pair_depth(
    left: Tensor, right: Tensor, left_seen: Tensor, right_seen: Tensor, guide: Tensor,
    true: Tensor, geometry: Tensor, *, labels: int, levels: int, size_px: tuple[int, int],
    matching: BeliefPropagationConfig,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """One pair to depth and sigma (h, w) on the keyframe's grid, with room for ``labels``. ``true``
    (5,) is h, w of the pair, H, W of the guide and the number of labels."""
    own = torch.stack([true[0], true[1], true[4]])
    px, confidence = stereo(left, right, labels, levels, own, matching)
    px, confidence = drop_unreliable(left, px, confidence, own, matching)
    px, confidence = drop_unseen(px, confidence, left_seen, right_seen, own)
    sizes = true[:4]
    if guide.shape[0] > 0:
        px, confidence = upsampled(px, confidence, guide, sizes)
    else:
        sizes = torch.cat([true[:2], true[:2]])
    return reproject(px, confidence, geometry, sizes, size_px, MIN_REPROJECTED)


def fused_pairs(depth: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """As :func:`recon.stereo.reprojection.fuse` of pairs (P, h, w), with the noise they show."""
    noise = label_noise(depth, sigma)
    is_refuted = ~(fuse(depth, sigma)[2] > 0).any()
    out, error, views = fuse(depth, sigma * noise)
    out, error = (torch.where(is_refuted, torch.nan, a) for a in (out, error))
    return out, error, torch.where(is_refuted, 0, views)


def label_noise(depth: Tensor, sigma: Tensor) -> Tensor:
    """As :func:`recon.stereo.reprojection.label_noise` of pairs (P, h, w), a number on the device,
    for which no thread waits; 1 where too few pairs show it."""
    if len(depth) < 2:
        return torch.ones((), device=depth.device)
    inverse = 1.0 / depth[:, ::NOISE_STRIDE, ::NOISE_STRIDE]
    error = sigma[:, ::NOISE_STRIDE, ::NOISE_STRIDE] * inverse * inverse
    squares, known = torch.zeros((2, 1), device=depth.device)
    for i, j in combinations(range(len(depth)), 2):
        apart = ((inverse[i] - inverse[j]).abs() / torch.hypot(error[i], error[j])).ravel()
        apart = torch.where(apart.isfinite(), apart, torch.inf).sort().values
        count = apart.isfinite().sum()
        enough = count >= MIN_COMMON
        middle = apart.gather(0, ((count - 1).clamp(min=0) // 2).reshape(1)) / 0.6745  # no wait
        squares = squares + torch.where(enough, middle * middle, 0.0)
        known = known + enough
    noise = (squares / known.clamp(min=1) / (1.0 - PAIRS_CORRELATION)).sqrt()
    return torch.where(known > 0, noise.clamp(1.0, MAX_NOISE), 1.0)


def device_inputs(pair: StereoPair, K: F64, min_disparity: int) -> list[Array]:
    """Inputs on the device: images, masks, guide, true sizes and geometry."""
    h, w = pair.left.shape
    seen = [np.ones((h, w), np.uint8)] * 2
    if pair.left_seen is not None and pair.right_seen is not None:
        seen = [pair.left_seen.view(np.uint8), pair.right_seen.view(np.uint8)]
    guide = np.zeros((0, 0, 3), np.uint8) if pair.guide is None else pair.guide
    to_left = pair.K @ pair.R_left_keyframe @ np.linalg.inv(K)
    base = [pair.slope, pair.K[0, 0] * pair.baseline_m, LABEL_SIGMA_PX * pair.noise]
    geometry = np.concatenate([to_left.ravel(), pair.plane, base]).astype(np.float64)
    true = np.array([h, w, guide.shape[0], guide.shape[1], pair.labels], np.int64)
    right = match_brightness(pair.left, pair.right, pair.labels, min_disparity)
    return [pair.left, right, *seen, guide, true, geometry]


def upsampled(px: Tensor, confidence: Tensor, guide: Tensor, true: Tensor) -> tuple[Tensor, Tensor]:
    """From (h, w) to the size of the guide (H, W, 3) in gray levels; Eq. 2. ``true`` (4,) is h, w,
    H, W."""
    taps = averaged(guide, (px.shape[0], px.shape[1]), true)
    trust = torch.where(px == px, confidence.clamp(min=MIN_CONFIDENCE), 0.0)
    value = torch.where(px == px, px, 0.0) * trust
    layers = torch.cat([taps.permute(2, 0, 1), torch.stack([trust, value])])
    return bilateral(layers, guide, true)
