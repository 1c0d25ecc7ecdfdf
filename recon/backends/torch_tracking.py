"""All of :func:`recon.tracking.matching.match` in torch: both ways, consensus, refinement, no wait.

The decisions that the host makes between the searches are masks here, so that one call is one
run of kernels and one small result: place, ZSSD and verdict of each point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from recon.backends.torch_linear import median, solve
from recon.backends.torch_matching import Found, Refined, refine, search
from recon.tracking.matching import MatchingConfig
from recon.tracking.patch_search import NO_SCORE


@dataclass(frozen=True, slots=True, eq=False)
class _Direction:
    """The search for points of pictures a in pictures b, level by level."""

    a: Sequence[Tensor]
    b: Sequence[Tensor]
    uv_a: Tensor
    inverse_warp: Tensor
    config: MatchingConfig

    def at(self, level: int, uv_b: Tensor, active: Tensor, reach: int) -> Found:
        """Best places within ``reach`` px of the level about ``uv_b``; full-size px."""
        scale = 2.0**level
        found = search(
            self.a[level], self.b[level], self.uv_a / scale, uv_b / scale, self.inverse_warp,
            active, reach, self.config.patch_radius_px, self.config.min_contrast,
        )  # fmt: skip
        return Found(found.uv * scale, found.score, found.second, found.contrast)

    def refined(self, uv_b: Tensor, active: Tensor) -> Refined:
        """Sub-pixel places from starts within about a pixel."""
        return refine(
            self.a[0], self.b[0], self.uv_a, uv_b, self.inverse_warp, active,
            self.config.patch_radius_px, self.config.refine_iterations,
        )  # fmt: skip


def match(
    levels_a: Sequence[Tensor], levels_b: Sequence[Tensor], uv_a: Tensor, predicted: Tensor,
    warps: tuple[Tensor, Tensor], everyone: Tensor, radius_px: Tensor, start: tuple[int, int],
    config: MatchingConfig,
) -> Tensor:  # fmt: skip
    """(N, 4) float32 u, v, ZSSD and 1 where the match is good.

    Pictures (h, w) uint8 level by level; ``uv_a`` and ``predicted`` (N, 2) float64; forward and
    inverse ``warps`` (N, 4); ``everyone`` (N,) the points that take part; ``radius_px`` () of
    the search; ``start`` its level and its reach in pixels of that level.
    """
    forward = _Direction(levels_a, levels_b, uv_a, warps[1], config)
    level, reach = start
    coarse = forward.at(level, predicted, everyone, reach)
    uv = coarse.uv
    active = _distinct(coarse, config.ambiguity) & (1.0 - coarse.score <= config.max_zssd)
    back = _Direction(levels_b, levels_a, uv, warps[0], config)
    doubtful = active & ~_distinct(coarse, 0.4 * config.ambiguity)
    returned = back.at(level, uv_a, doubtful, min(reach, 4)).uv
    active = active & ((returned - uv_a).abs().amax(1) <= 1.6 * 2**level)
    if level > 0:
        stray_px = (0.5 * radius_px).clamp(min=4.0 * 2**level)
        uv, active = _follow_others(uv_a, uv, predicted, active, everyone, 2.0 * 2**level, stray_px)
    while level > 1:
        finer = max(level - 2, 1)
        found = forward.at(finer, uv, active, 1 + level - finer)
        uv, level = found.uv, finer
        active = active & (found.score > 0)
    fine = forward.refined(uv, active)
    uv = fine.uv
    ok = active & (2.0 * (1.0 - fine.score) <= config.max_zssd)
    ok = ok & (fine.contrast_b >= config.min_contrast)
    if start[0] > 0:  # a texture that repeats may vanish on the coarse level
        vague = ok & (coarse.contrast < 0.3 * fine.contrast_a)
        ok = ok & (~vague | _distinct(forward.at(1, uv, vague, 8), config.ambiguity))
    home = _Direction(levels_b, levels_a, uv, warps[0], config).refined(uv_a, ok)
    away = (home.uv - uv_a).norm(dim=1)
    ok = ok & (home.score > 0) & (away <= config.max_return_px)
    zssd = torch.where(fine.score > NO_SCORE, 2.0 * (1.0 - fine.score), 4.0)
    uv = torch.where(ok[:, None], uv, predicted)
    return torch.cat([uv, zssd[:, None], ok[:, None].double()], 1).float()


def _distinct(found: Found, ratio: float) -> Tensor:
    """(N,) True where the best place is that much better than any other."""
    return 1.0 - found.score <= ratio * (1.0 - found.second)


def _follow_others(
    a: Tensor, uv: Tensor, predicted: Tensor, active: Tensor, everyone: Tensor,
    tolerance_px: float, stray_px: Tensor,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Places and who takes part, after points without an answer got one from the trend."""
    trend, agreed = _consensus(a, uv - predicted, active, tolerance_px)
    expected = predicted + trend
    own = active & ((uv - expected).norm(dim=1) <= stray_px)
    followed = torch.where(own[:, None], uv, expected)
    return torch.where(agreed, followed, uv), torch.where(agreed, everyone, active)


def _consensus(
    uv: Tensor, residual: Tensor, good: Tensor, tolerance_px: float
) -> tuple[Tensor, Tensor]:
    """(N, 2) affine trend of ``residual`` over ``uv``, and () True if most good points see it.

    Reweighted from the median with a tolerance that narrows, as
    :func:`recon.tracking.affine_trend.affine_trend`.
    """
    X = torch.cat([torch.ones_like(uv[:, :1]), uv / 1000], 1)
    start = torch.stack([median(residual[:, k], good) for k in (0, 1)])
    trend = torch.zeros((3, 2), dtype=uv.dtype, device=uv.device)
    trend = torch.cat([start[None], trend[1:]])
    least = 1e-6 * torch.eye(3, dtype=uv.dtype, device=uv.device)
    moves = torch.where(good[:, None], residual, 0.0)
    for sharpness in (0.125, 0.25, 0.5, 1.0, 1.0):
        share = ((moves - X @ trend) ** 2).sum(1) * (sharpness / tolerance_px) ** 2
        weight = torch.where(good, 1.0 / (1.0 + share) ** 2, 0.0)
        weighed = X * weight[:, None]
        trend = solve(weighed.T @ X + least, weighed.T @ moves)
    everywhere = X @ trend
    agree = good & ((residual - everywhere).norm(dim=1) < 2 * tolerance_px)
    count = good.sum()
    most = (agree.sum() >= 12) & (agree.sum() >= 0.4 * count)
    return everywhere, (count >= 12) & most
