"""Corners and tracks of the odometry in torch: a picture goes up once, a few numbers come down.

The pyramid is made on the host and goes to the device in one copy; finding corners and
following points from one picture to another are one run of kernels each (on CUDA a captured
graph) and one small result. Motion between pictures (phase correlation), pose and landmarks
stay on the host. The dense stages run in another thread, so this has a stream of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from recon.backends.room import kept
from recon.backends.torch_matching import Found, Refined, harris_cells, refine, search
from recon.backends.torch_plan import Plan, part
from recon.backends.torch_surface import median, solve
from recon.tracking.matching import (
    FAR,
    Corners,
    Matches,
    MatchingConfig,
    Pyramid,
    checked_points,
    checked_warps,
    start_level,
)
from recon.tracking.patch_search import NO_SCORE
from recon.types import U8, Array

KEPT_PLANS = 16
ROOM_POINTS = 128
"""The number of points is rounded up to a multiple, so that few graphs serve a flight."""

Shapes = tuple[tuple[int, int], ...]
"""Heights and widths of the levels of a pyramid."""


class TorchMatcher:
    """A :class:`recon.tracking.matching.Matcher` for one thread at a time."""

    def __init__(self, device: str) -> None:
        self.device = device
        cuda = device.startswith("cuda")
        self._stream: Any = None
        if cuda:  # ahead of the dense stages: the pose is waited for
            self._stream = torch.cuda.Stream(device, priority=-1)  # type: ignore[no-untyped-call]
        self._plans: dict[Any, Plan] = {}
        self._pictures: dict[Shapes, tuple[Tensor, Tensor]] = {}
        self._mask: tuple[U8, Tensor] | None = None

    def pyramid(self, gray: U8, levels: int) -> Pyramid:
        """The pyramid of ``gray`` (H, W), its levels one after the other on the device too."""
        made = Pyramid.build(gray, levels)
        with self._own_stream():
            return Pyramid(made.levels, self._sent(made))

    def corners(self, pyramid: Pyramid, config: MatchingConfig, mask: U8 | None) -> Corners:
        """As :func:`recon.tracking.matching.harris_grid`; ValueError for a mask of another size."""
        shapes = _shapes(pyramid)
        if mask is not None and mask.shape != shapes[0]:
            raise ValueError(f"mask {mask.shape} and image {shapes[0]} differ")
        with torch.inference_mode(), self._own_stream():
            image, _ = self._room(shapes)
            image.copy_(self._held(pyramid), non_blocking=True)
            hole = self._mask_on_device(mask)
            first = _levels(image, shapes[:1])[0]
            plan = self._plan(
                ("corners", shapes, config, None if hole is None else hole.data_ptr()),
                lambda: lambda: (harris_cells(first, config, hole),),
                [],
            )
            cells = plan.run()[0].cpu().numpy().reshape(-1, 3)
        best = cells[cells[:, 2] > config.min_response]
        return Corners(np.ascontiguousarray(best[:, :2]), np.ascontiguousarray(best[:, 2]))

    def match(
        self, pyramid_a: Pyramid, uv_a: npt.ArrayLike, pyramid_b: Pyramid,
        uv_b_predicted: npt.ArrayLike, radius_px: float, warp: npt.ArrayLike | None,
        config: MatchingConfig,
    ) -> Matches:  # fmt: skip
        """As :func:`recon.tracking.matching.match`; both pyramids are of one size."""
        a = checked_points(uv_a, "uv_a")
        predicted = checked_points(uv_b_predicted, "uv_b_predicted", len(a))
        if not (np.isfinite(radius_px) and radius_px > 0):
            raise ValueError(f"radius_px must be positive, got {radius_px}")
        shapes = _shapes(pyramid_a)
        if shapes != _shapes(pyramid_b):
            raise ValueError(f"pyramids {shapes} and {_shapes(pyramid_b)} differ")
        start = start_level(radius_px, len(shapes), config)
        warps = checked_warps(warp, len(a))
        everyone = np.abs(np.hstack([a, predicted])).max(axis=1, initial=0.0) < FAR
        room = max(-(-len(a) // ROOM_POINTS) * ROOM_POINTS, ROOM_POINTS)
        given = [_padded(x, room) for x in (a, predicted, *warps, everyone.astype(np.uint8))]
        given.append(np.array([radius_px]))
        with torch.inference_mode(), self._own_stream():
            both = self._room(shapes)
            for there, pyramid in zip(both, (pyramid_a, pyramid_b), strict=True):
                there.copy_(self._held(pyramid), non_blocking=True)
            plan = self._plan(
                ("match", shapes, room, start, config),
                lambda: _matching(both, shapes, start, config),
                given,
            )
            plan.upload(given)
            found = plan.run()[0].cpu().numpy()[: len(a)]
        ok = found[:, 3] > 0
        return Matches(np.array(found[:, :2]), np.array(found[:, 2]), ok)

    def _own_stream(self) -> AbstractContextManager[object]:
        if self._stream is None:
            return nullcontext()
        context: AbstractContextManager[object] = torch.cuda.stream(self._stream)
        return context

    def _plan(
        self, key: Any, build: Callable[[], Callable[..., tuple[Tensor, ...]]], given: list[Array]
    ) -> Plan:
        return kept(
            self._plans, key, KEPT_PLANS,
            lambda: Plan(self.device, build(), [part(x) for x in given]),
        )  # fmt: skip

    def _room(self, shapes: Shapes) -> tuple[Tensor, Tensor]:
        """Where the pictures of a run lie: graphs read them from a place that never moves."""
        if shapes not in self._pictures:
            self._plans.clear()
            size = sum(h * w for h, w in shapes)
            one, other = torch.zeros((2, size), dtype=torch.uint8, device=self.device)
            self._pictures = {shapes: (one, other)}
        return self._pictures[shapes]

    def _held(self, pyramid: Pyramid) -> Tensor:
        return pyramid.held if isinstance(pyramid.held, Tensor) else self._sent(pyramid)

    def _sent(self, pyramid: Pyramid) -> Tensor:
        """(all pixels,) uint8 on the device: one copy that nobody waits for."""
        flat = torch.from_numpy(np.concatenate([level.ravel() for level in pyramid.levels]))
        if self._stream is not None:
            flat = flat.pin_memory()
        return flat.to(self.device, non_blocking=True)

    def _mask_on_device(self, mask: U8 | None) -> Tensor | None:
        """The mask of a flight's pictures, sent once."""
        if mask is None or mask.all():
            return None
        if self._mask is None or not np.array_equal(self._mask[0], mask):
            self._mask = mask.copy(), torch.from_numpy(mask.copy()).to(self.device)
        return self._mask[1]


def _matching(
    pictures: tuple[Tensor, Tensor], shapes: Shapes, start: tuple[int, int], config: MatchingConfig
) -> Callable[..., tuple[Tensor, ...]]:
    """What a plan runs: from the points to their matches."""
    a, b = (_levels(flat, shapes) for flat in pictures)

    def run(
        uv: Tensor, near: Tensor, forward: Tensor, inverse: Tensor, active: Tensor, radius: Tensor
    ) -> tuple[Tensor, ...]:
        return (match(a, b, uv, near, (forward, inverse), active > 0, radius[0], start, config),)

    return run


def _levels(flat: Tensor, shapes: Shapes) -> list[Tensor]:
    """The pictures (h, w) that lie one after the other."""
    out, at = [], 0
    for h, w in shapes:
        out.append(flat[at : at + h * w].view(h, w))
        at += h * w
    return out


def _shapes(pyramid: Pyramid) -> Shapes:
    return tuple((level.shape[0], level.shape[1]) for level in pyramid.levels)


def _padded(values: Array, room: int) -> Array:
    """The rows, and rows of zeros up to ``room``."""
    return np.pad(values, [(0, room - len(values))] + [(0, 0)] * (values.ndim - 1))


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
    :func:`recon.tracking.matching.affine_trend`.
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
