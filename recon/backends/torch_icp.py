"""Projective point-to-plane ICP in torch: two depth maps go up, a few numbers come down.

Surfaces, partners, weights and steps stay on the device, for a fixed number of iterations; one
that has settled stands still. Nothing is read in between, so on CUDA all of it is one captured
graph. The verdict and the covariance are those of :mod:`recon.mapping.registration`, from the
sums of one more iteration; surface elements are those of :mod:`recon.mapping.registration`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from recon.backends.padding import kept
from recon.backends.torch_plan import Plan, part, read
from recon.backends.triton_icp import (
    DeviceSurface,
    SourcePoints,
    advance,
    surface_elements,
    weigh,
)
from recon.mapping.registration import (
    AREA_LAGS,
    AREA_SIGMAS,
    MIN_PARTNERS,
    IcpConfig,
    Problem,
    arrays_of,
    conclude,
    no_overlap,
)
from recon.types import F64, Array, DepthMap, Registration

KEPT_PLANS = 4
DOUBLE = torch.float64


class DeviceIcp:
    """Registers depth maps on ``device``; one thread at a time."""

    def __init__(self, device: str) -> None:
        self.device = device
        self._plans: dict[Any, Plan] = {}

    def register(
        self, source: DepthMap, target: DepthMap, T_target_source: F64, config: IcpConfig
    ) -> Registration:
        start = np.array(T_target_source, np.float64)
        if start.shape != (4, 4) or not np.isfinite(start).all():
            raise ValueError("T_target_source must be (4, 4) finite numbers")
        given: list[Array] = [*arrays_of(source), *arrays_of(target), start]
        key = (source.depth_m.shape, target.depth_m.shape, config)
        with torch.inference_mode():
            plan = kept(
                self._plans, key, KEPT_PLANS,
                lambda: Plan(self.device, _descent(config), [part(a) for a in given]),
            )  # fmt: skip
            plan.upload(given)
            (rows,) = read(plan.run())
        return _concluded(rows, start, config)

    def plan(self) -> Plan:
        """Of the last new pair of sizes, with its inputs on the device."""
        return list(self._plans.values())[-1]


def _descent(config: IcpConfig) -> Callable[..., tuple[Tensor, ...]]:
    """The function of a plan: two depth maps and a start to the numbers of :func:`_concluded`."""

    def run(
        z_a: Tensor, sigma_a: Tensor, K_a: Tensor, z_b: Tensor, sigma_b: Tensor, K_b: Tensor,
        T: Tensor,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        a, b = build(z_a, sigma_a, K_a), build(z_b, sigma_b, K_b)
        T, state, seen = descend(a, b, T, config)
        last = weigh(seen, a, b, T, True)
        size = last.residual.view(seen.shape)
        near = (last.found.view(seen.shape) > 0) & (size.abs() < AREA_SIGMAS * last.scale)
        numbers = [
            last.H, last.common, last.g, last.sums, last.centre, a.lever_m,
            last.partners * state[0], seen.known.sum(), state[2], T,
            correlation_sums(torch.where(near, size, 0.0), near, AREA_LAGS),
        ]  # fmt: skip
        return (torch.cat([n.reshape(-1).to(DOUBLE) for n in numbers]),)

    return run


def descend(
    a: DeviceSurface, b: DeviceSurface, T: Tensor, config: IcpConfig
) -> tuple[Tensor, Tensor, SourcePoints]:
    """The motion after the iterations of every level, their state, and the last level's points."""
    last = len(config.strides) - 1
    ones = torch.ones(2, dtype=DOUBLE, device=T.device)
    state = torch.cat([ones, torch.zeros_like(ones[:1])])
    for level, (stride, limit) in enumerate(zip(config.strides, config.iterations, strict=True)):
        seen = points(a, stride)
        state = torch.stack([state[0], state[0], state[2]])
        for _ in range(limit):
            found = weigh(seen, a, b, T, level == last)
            T, state = advance(found, a, T, state, 0.3 if level == last else 1.0)
    return T, state, seen


def _concluded(rows: F64, start: F64, config: IcpConfig) -> Registration:
    """The registration from the numbers read from the device."""
    ends = np.cumsum([36, 36, 6, 4, 3, 1, 1, 1, 1, 16])
    H, common, g, sums, centre, lever, partners, available, done, T, lags = np.split(rows, ends)
    if not np.isfinite(rows[: ends[-1]]).all():  # a start from which nothing can be computed
        partners = np.zeros(1)
    if partners[0] < MIN_PARTNERS:
        return no_overlap(start, int(done[0]))
    problem = Problem(
        H.reshape(6, 6), common.reshape(6, 6), g, sums, centre, float(lever[0]),
        lambda: area_of(lags.reshape(2, 3, AREA_LAGS)),
    )  # fmt: skip
    return conclude(problem, T.reshape(4, 4), start, int(available[0]), int(done[0]), config)


def area_of(lags: F64) -> float:
    """How many neighbours err together, as :func:`recon.mapping.registration.correlated_area`."""
    area = 1.0
    for products, powers, counts in lags:
        length = 1.0
        for product, power, count in zip(products, powers, counts, strict=True):
            if count < 30 or product <= 0.03 * power:
                break
            length += 2.0 * float(product) / float(power)
        area *= length
    return area


def build(depth: Tensor, sigma: Tensor, intrinsics: Tensor) -> DeviceSurface:
    """The surface of ``depth`` and ``sigma`` (h, w) float32; NaN is unknown."""
    elements = surface_elements(depth, sigma, intrinsics)
    h, w = depth.shape
    some = elements[::4, ::4, 4] > 0
    z = torch.where(some, depth[::4, ::4], 0.0).to(DOUBLE)
    x, y = rays((h, w), intrinsics, 4, 0)
    points = torch.stack([z * x, z * y, z], -1)
    count = some.sum().clamp(min=1)
    centre = points.sum((0, 1)) / count
    away = torch.where(some, ((points - centre) ** 2).sum(-1), 0.0)
    lever = torch.where(some.any(), (away.sum() / count).sqrt(), 1.0).clamp(min=1e-6)
    return DeviceSurface(elements, intrinsics, centre, lever)


def rays(
    size: tuple[int, int], intrinsics: Tensor, stride: int, first: int
) -> tuple[Tensor, Tensor]:
    """x and y at z = 1 of every ``stride``-th pixel (h', w') of an image of ``size`` (h, w)."""
    v = torch.arange(first, size[0], stride, dtype=DOUBLE, device=intrinsics.device)[:, None]
    u = torch.arange(first, size[1], stride, dtype=DOUBLE, device=intrinsics.device)[None, :]
    fx, fy, cx, cy = intrinsics
    shape = (v.shape[0], u.shape[1])
    return ((u - cx) / fx).expand(shape), ((v - cy) / fy).expand(shape)


def points(source: DeviceSurface, stride: int) -> SourcePoints:
    """The points that an iteration at this stride looks at."""
    first = stride // 2
    element = source.elements[first::stride, first::stride].to(DOUBLE)
    h, w = source.elements.shape[:2]
    x, y = rays((h, w), source.intrinsics, stride, first)
    known = element[..., 4] > 0
    along = element[..., 0] * x + element[..., 1] * y + element[..., 2]
    z = torch.where(known, element[..., 3] / torch.where(known, along, 1.0), 0.0)
    point = torch.stack([x * z, y * z, z], -1).view(-1, 3)
    shape = (element.shape[0], element.shape[1])
    normal, sigma = element[..., :3].contiguous(), element[..., 4].contiguous()
    return SourcePoints(
        shape, point, normal.view(-1, 3), sigma.view(-1), known.contiguous().view(-1)
    )


def correlation_sums(size: Tensor, near: Tensor, lags: int) -> Tensor:
    """(2, 3, lags) down and across: products, mean squares and pairs of residuals k apart.

    ``size`` (h, w) is zero where ``near`` is false. The sum over pairs k rows apart is the k-th
    diagonal of a product of matrices.
    """
    one = near.to(DOUBLE)
    out = []
    for x, m in ((size, one), (size.T, one.T)):
        rows = torch.arange(x.shape[0], device=x.device)
        apart = rows[None, :] - rows[:, None]
        lag = torch.arange(1, lags + 1, device=x.device)
        band = (apart[None] == lag[:, None, None]).to(DOUBLE)
        power = (x * x) @ m.T
        grams = torch.stack([x @ x.T, 0.5 * (power + power.T), m @ m.T])
        out.append(torch.einsum("kij,sij->sk", band, grams))
    return torch.stack(out)
