"""Harris corners and the zero-mean SSD search in torch (paper section 2.3, Eq. 4-5).

The same answers as :mod:`recon.tracking.matching` and :mod:`recon.tracking.patch_search`, all
points at once and without leaving the device. Images are (H, W) uint8, points (N, 2) float64
pixels of their level, inverse warps (N, 4): rows of the 2x2 matrix that takes an offset in b to
one in a.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from recon.tracking.matching import MatchingConfig
from recon.tracking.patch_search import NO_SCORE

BINOMIAL = (1.0, 4.0, 6.0, 4.0, 1.0)
"""Window w of Eq. 4 along one axis, over 16."""


def harris_cells(image: Tensor, config: MatchingConfig, mask: Tensor | None = None) -> Tensor:
    """(grid, grid, 3) u, v and R of each cell's best local maximum; R is 0 where there is none.

    ``mask`` (H, W) is zero where the picture holds nothing; patches stay clear of it.
    """
    H, W = image.shape
    margin = config.patch_radius_px + 3
    response = _response(image.float(), config.harris_k)
    peak = F.max_pool2d(response[None], 3, 1, 1)[0]
    row = torch.arange(H, device=image.device)
    column = torch.arange(W, device=image.device)
    allowed = ((row >= margin) & (row < H - margin))[:, None]
    allowed = allowed & ((column >= margin) & (column < W - margin))[None, :]
    if mask is not None:
        hole = F.max_pool2d((mask == 0).float()[None], 2 * margin + 1, 1, margin)[0]
        allowed = allowed & (hole == 0)
    value = torch.where(allowed & (response > 0), response, 0.0).view(-1)
    cell = (_cell(H, config.grid, row)[:, None] * config.grid + _cell(W, config.grid, column)).view(
        -1
    )
    count = config.grid**2
    best = torch.zeros(count, device=image.device).scatter_reduce(0, cell, value, "amax")
    flat = torch.arange(H * W, device=image.device)
    first = torch.where((value == best[cell]) & (value > 0), flat, H * W)
    place = torch.full((count,), H * W, device=image.device).scatter_reduce(0, cell, first, "amin")
    place = place.clamp(max=H * W - 1)
    # The maximum of the cell may be the flank of a corner in the next cell.
    top = torch.where(peak.view(-1)[place] <= best, best, 0.0)
    found = torch.stack([(place % W).float(), (place // W).float(), top], -1)
    return torch.where(top[:, None] > 0, found, 0.0).view(config.grid, config.grid, 3)


def _cell(length: int, grid: int, place: Tensor) -> Tensor:
    """Which of the ``grid`` cells along an axis each place is in."""
    first = torch.arange(grid + 1, device=place.device) * length // grid
    return torch.searchsorted(first, place, right=True) - 1


def _response(image: Tensor, k: float) -> Tensor:
    """(H, W) R of Eq. 5; 0 within two pixels of the border."""
    across = image[:, 2:] - image[:, :-2]
    down = image[2:] - image[:-2]
    gx = 0.125 * (across[:-2] + 2 * across[1:-1] + across[2:])
    gy = 0.125 * (down[:, :-2] + 2 * down[:, 1:-1] + down[:, 2:])
    products = F.pad(torch.stack([gx * gx, gy * gy, gx * gy]), (1, 1, 3, 3))
    H, W = image.shape
    rows = sum(b * products[:, i : i + H] for i, b in enumerate(BINOMIAL))
    assert isinstance(rows, Tensor)
    window = sum(b * rows[:, :, i : i + W - 4] for i, b in enumerate(BINOMIAL))
    assert isinstance(window, Tensor)
    a, b, c = F.pad(window / 256, (2, 2))
    response: Tensor = a * b - c * c - k * (a + b) ** 2  # Eq. 5
    return response


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """The answer of a search."""

    uv: Tensor  # (N, 2) px in b; as predicted where nothing could be compared
    score: Tensor  # (N,) correlation, NO_SCORE where nothing could be compared
    second: Tensor  # (N,) correlation of the next separate peak
    contrast: Tensor  # (N,) gray levels, of the patch of a


def search(
    image_a: Tensor, image_b: Tensor, uv_a: Tensor, uv_b: Tensor, inverse_warp: Tensor,
    active: Tensor, reach: int, radius: int, min_contrast: float,
) -> Found:  # fmt: skip
    """Each active point of a, near ``uv_b`` in image b, to about a quarter of a pixel."""
    H, W = image_b.shape
    S = 2 * reach + 1
    centre = torch.floor(uv_b + 0.5).long()
    near = (centre >= -reach).all(1) & (centre[:, 0] < W + reach) & (centre[:, 1] < H + reach)
    patch, within = _sample(image_a, uv_a, inverse_warp, radius)
    usable = active & near & within
    patch, contrast = _normalised(patch)
    contrast = torch.where(usable, contrast, 0.0)
    usable = usable & (contrast >= min_contrast)
    scores = _scores(image_b, centre, reach, radius, patch, min_contrast)
    best, at = scores.reshape(-1, S * S).max(1)
    by, bx = at // S, at % S
    index = torch.arange(S, device=uv_b.device)
    beside = ((index[None, :, None] - by[:, None, None]).abs() <= 2) & (
        (index[None, None, :] - bx[:, None, None]).abs() <= 2
    )
    top = (F.max_pool2d(scores, 3, 1, 1) <= scores) & ~beside
    second = torch.where(top, scores, NO_SCORE).amax((1, 2))
    each = torch.arange(len(scores), device=uv_b.device)
    offset = torch.stack([_vertex(scores[each, by], bx), _vertex(scores[each, :, bx], by)], 1)
    uv = centre - reach + torch.stack([bx, by], 1) + offset
    return Found(
        torch.where(usable[:, None], uv, uv_b),
        torch.where(usable, best, NO_SCORE).double(),
        torch.where(usable, second, NO_SCORE).double(),
        contrast.double(),
    )


def _sample(image: Tensor, uv: Tensor, warp: Tensor, radius: int) -> tuple[Tensor, Tensor]:
    """(N, n, n) float32 bilinear patches about the points; (N,) True where inside the image."""
    H, W = image.shape
    step = torch.arange(-radius, radius + 1, device=image.device, dtype=torch.float64)
    dx, dy = step[None, None, :], step[None, :, None]
    w = warp[:, :, None, None]
    u = uv[:, 0, None, None] + w[:, 0] * dx + w[:, 1] * dy
    v = uv[:, 1, None, None] + w[:, 2] * dx + w[:, 3] * dy
    reach = (warp[:, 0::2].abs() + warp[:, 1::2].abs()) * radius  # (N, 2) along u and v
    low, high = uv - reach, uv + reach
    within = (low >= 0).all(1) & (high[:, 0] < W - 1) & (high[:, 1] < H - 1)
    u0, v0 = torch.floor(u).clamp(0, W - 2), torch.floor(v).clamp(0, H - 2)
    fu, fv = (u - u0).float(), (v - v0).float()
    flat, first = image.float().view(-1), (v0 * W + u0).long()
    a, b, c, d = (flat[first + k] for k in (0, 1, W, W + 1))
    top, bottom = a + fu * (b - a), c + fu * (d - c)
    return top + fv * (bottom - top), within


def _normalised(patch: Tensor) -> tuple[Tensor, Tensor]:
    """The patches (N, n, n) made zero-mean and unit, and their contrast (N,)."""
    patch = patch - patch.mean((1, 2), keepdim=True)
    power = (patch * patch).sum((1, 2))
    scale = torch.where(power > 1e-6, power.clamp(min=1e-12).rsqrt(), 0.0)
    return patch * scale[:, None, None], (power / patch[0].numel()).sqrt()


def _scores(
    image: Tensor, centre: Tensor, reach: int, radius: int, patch: Tensor, min_contrast: float
) -> Tensor:
    """(N, S, S) correlation of the patch with each place, NO_SCORE where none is possible."""
    H, W = image.shape
    n, S = 2 * radius + 1, 2 * reach + 1
    side = torch.arange(S + n - 1, device=image.device)
    u = centre[:, 0, None] - reach - radius + side
    v = centre[:, 1, None] - reach - radius + side
    flat = image.float().view(-1) - 128
    window = flat[v.clamp(0, H - 1)[:, :, None] * W + u.clamp(0, W - 1)[:, None, :]]
    scores = F.conv2d(window[None], patch[:, None], groups=len(centre))[0]
    s1 = F.avg_pool2d(window, n, 1, divisor_override=1)
    s2 = F.avg_pool2d(window * window, n, 1, divisor_override=1)
    power = s2 - s1 * s1 / n**2
    good = power > min_contrast**2 * n**2
    good = good & ((v[:, :S] >= 0) & (v[:, :S] + n <= H))[:, :, None]
    good = good & ((u[:, :S] >= 0) & (u[:, :S] + n <= W))[:, None, :]
    return torch.where(good, scores * power.clamp(min=1e-12).rsqrt(), NO_SCORE)


def _vertex(line: Tensor, i: Tensor) -> Tensor:
    """(N,) offset of a parabola's top from the peak ``line[:, i]``, -0.5 to 0.5."""
    last = line.shape[1] - 1
    inner = (i > 0) & (i < last)
    k = i.clamp(1, last - 1)[:, None]
    a, b, c = (line.gather(1, k + step)[:, 0].double() for step in (-1, 0, 1))
    bend = a - 2 * b + c
    sound = inner & (torch.minimum(a, c) > -1.0) & (bend <= -1e-9)
    offset = (0.5 * (a - c) / torch.where(sound, bend, -1.0)).clamp(-0.5, 0.5)
    return torch.where(sound, offset, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """The answer of the refinement."""

    uv: Tensor  # (N, 2) px in b
    score: Tensor  # (N,) correlation, NO_SCORE when it was lost
    contrast_a: Tensor  # (N,) gray levels, of the patch in a
    contrast_b: Tensor  # (N,) and where it was found


def refine(
    image_a: Tensor, image_b: Tensor, uv_a: Tensor, uv_b: Tensor, inverse_warp: Tensor,
    active: Tensor, radius: int, iterations: int,
) -> Refined:  # fmt: skip
    """``uv_b`` moved to the sub-pixel minimum of the normalised zero-mean SSD.

    As :func:`recon.tracking.patch_search.refine`, with every iteration done for all points and
    those that have arrived held still.
    """
    large, within = _sample(image_a, uv_a, inverse_warp, radius + 1)
    kernels, contrast_a = _template(large - 128)
    contrast_a = torch.where(active & within, contrast_a, 0.0)
    alive = contrast_a > 0
    uv, score = uv_b, torch.full_like(contrast_a, NO_SCORE)
    contrast_b = torch.zeros_like(contrast_a)
    for _ in range(iterations):
        other, there = _interpolated(image_b, uv, radius)
        seen, step, contrast = _compare(kernels, other)
        moving = alive & there
        score = torch.where(moving, seen, torch.where(alive, NO_SCORE, score))
        contrast_b = torch.where(moving, contrast, contrast_b)
        uv = torch.where(moving[:, None], uv + step, uv)
        strayed = moving & ((uv - uv_b).abs().amax(1) > 2.0)
        score = torch.where(strayed, NO_SCORE, score)
        alive = moving & ~strayed & (step.abs().amax(1) >= 0.02)
    return Refined(uv, score.double(), contrast_a.double(), contrast_b.double())


def _template(large: Tensor) -> tuple[Tensor, Tensor]:
    """(3, N, n, n) template and its Gauss-Newton kernels along u and v, and its contrast (N,).

    ``large`` (N, n + 2, n + 2) has a border of one. Contrast is 0 without two-dimensional
    texture.
    """
    patch = large[:, 1:-1, 1:-1]
    n = patch.shape[1]
    patch = patch - patch.mean((1, 2), keepdim=True)
    power = (patch * patch).sum((1, 2))
    scale = power.clamp(min=1e-3).rsqrt()[:, None, None]
    patch = patch * scale
    gx = 0.5 * scale * (large[:, 1:-1, 2:] - large[:, 1:-1, :-2])
    gy = 0.5 * scale * (large[:, 2:, 1:-1] - large[:, :-2, 1:-1])
    gx, gy = (
        g - g.mean((1, 2), keepdim=True) - (g * patch).sum((1, 2), keepdim=True) * patch
        for g in (gx, gy)
    )
    a, b, c = ((p * q).sum((1, 2)) for p, q in ((gx, gx), (gy, gy), (gx, gy)))
    det = a * b - c * c
    textured = (power >= 1e-3) & (det > 1e-4 * (a + b) ** 2)
    det = torch.where(textured, det, 1.0)
    a, b, c = ((k / det)[:, None, None] for k in (a, b, c))
    kernels = torch.stack([patch, b * gx - c * gy, a * gy - c * gx])
    return kernels, torch.where(textured, power.sqrt() / n, 0.0)


def _interpolated(image: Tensor, uv: Tensor, radius: int) -> tuple[Tensor, Tensor]:
    """(N, n, n) Catmull-Rom patches about the points, less 128; (N,) True where inside."""
    H, W = image.shape
    n = 2 * radius + 1
    whole = torch.floor(uv)
    side = torch.arange(n + 3, device=image.device)
    u, v = (whole[:, k, None].long() - radius - 1 + side for k in (0, 1))
    there = (u[:, 0] >= 0) & (v[:, 0] >= 0) & (u[:, -1] < W) & (v[:, -1] < H)
    flat = image.float().view(-1) - 128
    window = flat[v.clamp(0, H - 1)[:, :, None] * W + u.clamp(0, W - 1)[:, None, :]]
    wu, wv = (_cubic((uv - whole)[:, k]) for k in (0, 1))
    rows = torch.zeros_like(window[:, :, :n])
    for k in range(4):
        rows = rows + wu[k][:, None, None] * window[:, :, k : k + n]
    patch = torch.zeros_like(rows[:, :n])
    for k in range(4):
        patch = patch + wv[k][:, None, None] * rows[:, k : k + n]
    return patch, there


def _cubic(f: Tensor) -> Tensor:
    """(4, N) float32 weights of Catmull-Rom interpolation at the fraction ``f``."""
    return torch.stack(
        [
            ((-0.5 * f + 1.0) * f - 0.5) * f,
            (1.5 * f - 2.5) * f * f + 1.0,
            ((-1.5 * f + 2.0) * f + 0.5) * f,
            (0.5 * f - 0.5) * f * f,
        ]
    ).float()


def _compare(kernels: Tensor, other: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Score (N,), step (N, 2) and contrast (N,) of the patches ``other``."""
    n = other.shape[1]
    mean = other.mean((1, 2), keepdim=True)
    length = ((other - mean) ** 2).sum((1, 2)).clamp(min=1e-3).sqrt()
    score, su, sv = (kernels * other).sum((2, 3)) / length
    # The template itself has no part along its slopes, so the residual is minus the patch.
    return score, -torch.stack([su, sv], 1).double(), length / n
