"""Depth from disparity (Eq. 3) and the fusion of pairs in torch, as the compiled ones do it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from recon.stereo.depth_fusion import FusionConfig
from recon.stereo.reprojection import LABEL_SIGMA_PX, MIN_CONFIDENCE

GEOMETRY = 14
"""float64 numbers of a pair: homography to the left picture (9), plane (3), slope, f B."""


def reproject(
    px: Tensor, confidence: Tensor, geometry: Tensor, true: Tensor, size_px: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Depth and sigma in metres, float32, on the keyframe's grid of ``size_px`` (w, h).

    As :func:`recon.stereo.reprojection.reproject`. ``geometry`` (14,) float64; ``true`` (4,) is the
    size h, w of the pair and that of ``px``, which may be a larger array.
    """
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
    good = ahead & (label == label) & (trust >= MIN_CONFIDENCE) & (d >= 1e-3)
    depth = geometry[13] / d / z  # Eq. 3, along the keyframe's z
    sigma = depth / d * slope.abs() * LABEL_SIGMA_PX / trust.sqrt()
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


def fuse(depth: Tensor, sigma: Tensor, config: FusionConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Depth, sigma and number of views (h, w) float32 of pairs (P, h, w); no view: NaN.

    As :func:`recon.stereo.depth_fusion.fuse`: inverse depth of the largest group that agrees.
    """
    z, e = depth.double(), sigma.double()
    usable = (z > 0) & (e < config.most_sigma_share * z)
    inverse = torch.where(usable, 1 / z, 0.0)
    s = torch.where(usable, e / z**2, math.inf)
    centre, spread = _largest_group(inverse, s, usable, config.agree_sigmas)
    limit = config.agree_sigmas * (s**2 + spread**2).sqrt()
    member = usable & ((inverse - centre).abs() <= limit)
    weight = torch.where(member, 1 / s**2, 0.0)
    views = member.sum(0)
    seen = views > 0
    total = torch.where(seen, weight.sum(0), 1.0)
    mean = (weight * inverse).sum(0) / total
    scatter = (weight * (inverse - mean) ** 2).sum(0)
    variance = 1 / total + scatter / total / (views - 1).clamp(min=1)
    fused = 1 / torch.where(seen, mean, 1.0)
    alone = torch.where(views == 1, config.single_view_sigma, 1.0)
    error = (variance.sqrt() * fused**2 * alone).maximum(config.least_sigma_share * fused)
    nan = math.nan
    return (
        torch.where(seen, fused, nan).float(),
        torch.where(seen, error, nan).float(),
        views.float(),
    )


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
