"""Rectified pairs to the fused depth of a keyframe without leaving the device.

Each pair goes up once, in one copy from pinned memory that no thread waits for; cost, belief
propagation, visibility, upsampling, reprojection and fusion follow on the device, on CUDA as
one graph a pair; the fused depth comes down once, and that is the only wait.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from recon.backends import DenseStages
from recon.backends.room import kept, pyramid_levels, room
from recon.backends.torch_plan import Plan, fused, part, read
from recon.backends.torch_stereo import dense_stereo, drop_unreliable, drop_unseen
from recon.stereo.reprojection import LABEL_SIGMA_PX, DepthFusionConfig
from recon.stereo.reprojection import MIN_CONFIDENCE as MIN_REPROJECTED
from recon.stereo.upsampling import MIN_CONFIDENCE, RANGE_FLOOR, UpsamplingConfig
from recon.types import F64, Array, DepthMap, StereoPair

KEPT_PLANS = 8


class DensePath:
    """``device`` is "cuda" or "cpu"; one path serves one thread at a time."""

    def __init__(self, device: str, stages: DenseStages) -> None:
        self.device, self.stages = device, stages
        self._plans: dict[Any, Plan] = {}
        self._fusions: dict[Any, tuple[Tensor, Plan]] = {}

    def depth(
        self, pairs: Sequence[StereoPair], K: F64, size_px: tuple[int, int], T_world_camera: F64
    ) -> DepthMap:
        """The fused depth on the keyframe's grid of ``size_px`` (w, h) with intrinsics ``K``.

        Raises ValueError without any pair.
        """
        if not pairs:
            raise ValueError("no stereo pair to fuse")
        with torch.inference_mode():
            found, fusion = kept(
                self._fusions, (len(pairs), size_px), KEPT_PLANS,
                lambda: self._fusion(len(pairs), size_px),
            )  # fmt: skip
            for slot, pair in enumerate(pairs):
                plan = self._plan(pair, size_px)
                plan.upload(_inputs(pair, K), slot)
                found[:, slot].copy_(torch.stack(plan.run()))
            depth, sigma, views = read(fusion.run())
        return DepthMap(depth, sigma, views, K, T_world_camera)

    def _fusion(self, pairs: int, size_px: tuple[int, int]) -> tuple[Tensor, Plan]:
        """Room for depth and sigma of each pair, (2, P, h, w), and the plan that fuses them."""
        found = torch.zeros((2, pairs, size_px[1], size_px[0]), device=self.device)
        return found, Plan(self.device, lambda: fuse(found[0], found[1], self.stages.fusion), [])

    def _plan(self, pair: StereoPair, size_px: tuple[int, int]) -> Plan:
        h, w = pair.left.shape
        space = room(h, w, pair.labels)
        fine = None if pair.guide is None else room(pair.guide.shape[0], pair.guide.shape[1], 1)[:2]
        levels = pyramid_levels(h, w, self.stages.matching)
        key = (space, fine, levels, size_px)

        def build() -> Plan:
            stage = partial(
                pair_depth, labels=space[2], levels=levels, size_px=size_px,
                stages=self.stages,
            )  # fmt: skip
            shapes = [space[:2]] * 4 + [(*(fine or (0, 0)), 3), (5,), (15,)]
            given = _inputs(pair, np.eye(3))
            parts = [part(a, s) for a, s in zip(given, shapes, strict=True)]
            return Plan(self.device, stage, parts)

        return kept(self._plans, key, KEPT_PLANS, build)


def pair_depth(
    left: Tensor, right: Tensor, left_seen: Tensor, right_seen: Tensor, guide: Tensor,
    true: Tensor, geometry: Tensor, *, labels: int, levels: int, size_px: tuple[int, int],
    stages: DenseStages,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """One pair to depth and sigma (h, w) on the keyframe's grid, with room for ``labels``.

    ``true`` (5,) is h, w of the pair, H, W of the guide and the number of labels.
    """
    own = torch.stack([true[0], true[1], true[4]])
    px, confidence = dense_stereo(left, right, own, labels, levels, stages.matching)
    px, confidence = drop_unreliable(left, px, confidence, own, stages.matching)
    px, confidence = drop_unseen(px, confidence, left_seen, right_seen, own)
    sizes = true[:4]
    if guide.shape[0] > 0:
        px, confidence = upsampled(px, confidence, guide, sizes, stages.upsampling)
    else:
        sizes = torch.cat([true[:2], true[:2]])
    return reproject(px, confidence, geometry, sizes, size_px)


def _inputs(pair: StereoPair, K: F64) -> list[Array]:
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
    return [pair.left, pair.right, *seen, guide, true, geometry]


FAR_TAP = -1.0e4
"""Log of the weight of a tap outside the coarse image."""


def upsampled(
    px: Tensor, confidence: Tensor, guide: Tensor, true: Tensor, config: UpsamplingConfig
) -> tuple[Tensor, Tensor]:
    """From (h, w) to the size of the guide (H, W, 3) in gray levels; Eq. 2.

    ``true`` (4,) is h, w, H, W.
    """
    taps = averaged(guide, (px.shape[0], px.shape[1]), true)
    layers = tap_layers(px, confidence, taps)
    if fused(px):
        from recon.backends import triton_dense

        return triton_dense.bilateral(layers, guide, true, config)
    rows, log_y = window(px.shape[0], guide.shape[0], true[0], true[2], config)
    columns, log_x = window(px.shape[1], guide.shape[1], true[1], true[3], config)
    image = guide.float().permute(2, 0, 1)
    everything = torch.zeros_like(image[0])
    sums = torch.zeros_like(image)
    for j in range(config.diameter_px):
        row = layers.index_select(1, rows[j])
        for i in range(config.diameter_px):
            tap = row.index_select(2, columns[i])
            tonal = -((image - tap[:3]) ** 2).sum(0) / (2 * config.range_sigma**2)
            near = log_y[j][:, None] + log_x[i][None, :]
            weight = torch.exp(tonal.clamp(min=RANGE_FLOOR * math.log(2)) + near)
            everything = everything + weight
            sums = sums + weight * tap[3:]
    good = sums[2] > config.min_support * everything
    out = torch.where(good, sums[1] / sums[0], math.nan)
    return out, torch.where(good, sums[0] / everything, 0.0)


def tap_layers(px: Tensor, confidence: Tensor, taps: Tensor) -> Tensor:
    """(6, h, w) what a tap brings: three colours, trust, trust times label, 1 where known."""
    known = px == px
    trust = torch.where(known, confidence.clamp(min=MIN_CONFIDENCE), 0.0)
    value = torch.where(known, px, 0.0) * trust
    colour = taps.float().permute(2, 0, 1)
    return torch.cat([colour, torch.stack([trust, value, known.float()])])


def window(
    room: int, fine_room: int, taps: Tensor, fine: Tensor, config: UpsamplingConfig
) -> tuple[Tensor, Tensor]:
    """Coarse index (D, fine), clamped, and log of s, very low outside, of each tap."""
    place = torch.arange(fine_room, dtype=torch.float64, device=taps.device)
    q = (place + 0.5) * (taps.double() / fine) - 0.5
    step = torch.arange(config.diameter_px, dtype=torch.float64, device=taps.device)
    index = torch.ceil(q - config.diameter_px / 2)[None, :] + step[:, None]
    log = -0.5 * ((index - q) / config.spatial_sigma) ** 2
    log = torch.where((index >= 0) & (index < taps), log, FAR_TAP)
    return index.clamp(0, room - 1).long(), log.float()


def averaged(guide: Tensor, room: tuple[int, int], true: Tensor) -> Tensor:
    """(h, w, 3) the guide at the coarse grid: the mean of what each tap covers, in whole levels.

    As :func:`recon.stereo.upsampling.guide_at_taps`, where halves may round the other way.
    """
    if fused(guide):
        from recon.backends import triton_dense

        return triton_dense.averaged(guide, room, true)
    down = _shares(room[0], guide.shape[0], true[0], true[2])
    across = _shares(room[1], guide.shape[1], true[1], true[3])
    image = guide.float().permute(2, 0, 1)
    return torch.round(down @ (image @ across.T)).permute(1, 2, 0)


def _shares(room: int, fine_room: int, taps: Tensor, fine: Tensor) -> Tensor:
    """(room, fine_room) the share of each fine pixel in each coarse one along an axis."""
    step = fine.double() / taps
    first = torch.arange(room, dtype=torch.float64, device=taps.device)[:, None] * step
    pixel = torch.arange(fine_room, dtype=torch.float64, device=taps.device)[None, :]
    last = torch.minimum(first + step, fine.double())
    overlap = torch.minimum(last, pixel + 1) - torch.maximum(first, pixel)
    return (overlap.clamp(min=0) / step).float()


def reproject(
    px: Tensor, confidence: Tensor, geometry: Tensor, true: Tensor, size_px: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Depth and sigma in metres, float32, on the keyframe's grid of ``size_px`` (w, h).

    As :func:`recon.stereo.reprojection.reproject`. ``geometry`` (15,) float64 is the
    homography to the left image (9), the plane (3), slope, f B, and sigma of a label of full
    confidence in pixels; ``true`` (4,) is the size h, w of the pair and that of ``px``, which may
    be a larger array.
    """
    if fused(px):
        from recon.backends import triton_dense

        return triton_dense.reproject(px, confidence, geometry, true, size_px, MIN_REPROJECTED)
    u = torch.arange(size_px[0], device=px.device, dtype=torch.float64)[None, :]
    v = torch.arange(size_px[1], device=px.device, dtype=torch.float64)[:, None]
    H = geometry[:9].view(3, 3)
    z = H[2, 0] * u + H[2, 1] * v + H[2, 2]
    ahead = z >= 1e-3
    z = torch.where(ahead, z, 1.0)
    x = (H[0, 0] * u + H[0, 1] * v + H[0, 2]) / z
    y = (H[1, 0] * u + H[1, 1] * v + H[1, 2]) / z
    X = (x + 0.5) * (true[3].double() / true[1]) - 0.5
    Y = (y + 0.5) * (true[2].double() / true[0]) - 0.5
    label, trust = _label(px, confidence, X, Y, true)
    slope = geometry[12]
    d = geometry[9] * x + geometry[10] * y + geometry[11] + slope * label
    good = ahead & (label == label) & (trust >= MIN_REPROJECTED) & (d >= 1e-3)
    depth = geometry[13] / d / z  # Eq. 3, along the keyframe's z
    sigma = depth / d * slope.abs() * geometry[14] / trust.sqrt()
    return (
        torch.where(good, depth, math.nan).float(),
        torch.where(good, sigma, math.nan).float(),
    )


def _label(
    px: Tensor, confidence: Tensor, X: Tensor, Y: Tensor, true: Tensor
) -> tuple[Tensor, Tensor]:
    """Label at a place: bilinear where the four around it agree, else the nearest; its trust."""
    height, width = true[2], true[3]
    pitch = px.shape[1]
    flat, sure = px.reshape(-1), confidence.reshape(-1)
    i, j = torch.round(X), torch.round(Y)
    within = (i >= 0) & (j >= 0) & (i < width) & (j < height)
    centre = torch.where(within, j * pitch + i, 0.0).long()
    nearest = flat[centre].double()
    i0, j0 = torch.floor(X), torch.floor(Y)
    around = within & (i0 >= 0) & (j0 >= 0) & (i0 + 1 < width) & (j0 + 1 < height)
    first = torch.where(around, j0 * pitch + i0, 0.0).long()
    last = px.numel() - 1
    a, b, c, d = (
        flat[(first + step).clamp(max=last)].double() for step in (0, 1, pitch, pitch + 1)
    )
    apart = torch.stack([a, b, c, d])
    agree = around & (apart.amax(0) - apart.amin(0) <= 1.0)  # false where one is NaN
    fx, fy = X - i0, Y - j0
    mixed = (1 - fy) * ((1 - fx) * a + fx * b) + fy * ((1 - fx) * c + fx * d)
    label = torch.where(agree, mixed, nearest)
    return torch.where(within, label, math.nan), sure[centre].double()


def fuse(depth: Tensor, sigma: Tensor, config: DepthFusionConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Depth, sigma (h, w) float32 and number of views uint8 of pairs (P, h, w); no view: NaN.

    As :func:`recon.stereo.reprojection.fuse`: inverse depth of the largest group that agrees,
    nothing where several pairs read and none comes near another.
    """
    if fused(depth):
        from recon.backends import triton_dense

        return triton_dense.fuse(depth, sigma, config)
    z, e = depth.double(), sigma.double()
    usable = (z > 0) & (e < config.max_sigma_share * z)
    inverse = torch.where(usable, 1 / z, 0.0)
    s = torch.where(usable, e / z**2, math.inf)
    centre, spread = _largest_group(inverse, s, usable, config.agree_sigmas)
    limit = config.agree_sigmas * (s**2 + spread**2).sqrt()
    member = usable & ((inverse - centre).abs() <= limit)
    weight = torch.where(member, 1 / s**2, 0.0)
    views = member.sum(0)
    near = usable & ((inverse - centre).abs() <= config.max_sigma_share * centre)
    contradicted = (views == 1) & (usable.sum(0) > 1) & (near.sum(0) == 1)
    refuted = contradicted.sum() > (views >= 2).sum()
    seen = (views > 0) & ~contradicted & ~refuted
    total = torch.where(seen, weight.sum(0), 1.0)
    mean = (weight * inverse).sum(0) / total
    scatter = (weight * (inverse - mean) ** 2).sum(0)
    variance = 1 / total + scatter / total / (views - 1).clamp(min=1)
    fused_depth = torch.where(seen, 1 / torch.where(seen, mean, 1.0), math.nan)
    alone = torch.where(views == 1, config.single_view_sigma, 1.0)
    error = (variance.sqrt() * fused_depth**2 * alone).maximum(config.min_sigma_share * fused_depth)
    return fused_depth.float(), error.float(), torch.where(seen, views, 0).to(torch.uint8)


def _largest_group(
    inverse: Tensor, sigma: Tensor, usable: Tensor, agree_sigmas: float
) -> tuple[Tensor, Tensor]:
    """Inverse depth and sigma of the reading that most agree with; ties to the smaller sigma."""
    apart = (inverse[:, None] - inverse[None, :]) ** 2
    near = apart <= agree_sigmas**2 * (sigma[:, None] ** 2 + sigma[None, :] ** 2)
    support = (near & usable[:, None] & usable[None, :]).sum(1)
    best, centre, spread = support[0], inverse[0], sigma[0]
    for k in range(1, len(inverse)):
        better = (support[k] > best) | ((support[k] == best) & (sigma[k] < spread))
        best = torch.where(better, support[k], best)
        centre = torch.where(better, inverse[k], centre)
        spread = torch.where(better, sigma[k], spread)
    return centre, spread
