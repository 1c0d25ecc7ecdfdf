"""Projective point-to-plane ICP in torch: two depth maps go up, a few numbers come down.

Surfaces, partners, weights and steps stay on the device, for a fixed number of iterations; one
that has settled stands still. Nothing is read in between, so on CUDA all of it is one captured
graph. The verdict and the covariance are those of :mod:`recon.clouds.registration`, from the
sums of one more iteration.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from recon.backends.torch_kernels import PLAIN, Kernels
from recon.backends.torch_partners import SourcePoints, correlation_sums, points
from recon.backends.torch_plan import Plan, part
from recon.backends.torch_sums import advance, weigh
from recon.backends.torch_surface import DOUBLE, DeviceSurface, build
from recon.clouds.registration import (
    AREA_LAGS,
    AREA_SIGMAS,
    Equations,
    IcpConfig,
    conclude,
)
from recon.types import F64, Array, DepthMap, Registration

KEPT_PLANS = 4


class DeviceIcp:
    """Registers depth maps on ``device``; one thread at a time."""

    def __init__(self, device: str, kernels: Kernels = PLAIN) -> None:
        self.device = device
        self._kernels = kernels
        self._plans: dict[Any, Plan] = {}

    def register(
        self, source: DepthMap, target: DepthMap, T_target_source: F64, config: IcpConfig
    ) -> Registration:
        """As :func:`recon.clouds.registration.register_projective`."""
        start = np.array(T_target_source, np.float64)
        if start.shape != (4, 4) or not np.isfinite(start).all():
            raise ValueError("T_target_source must be (4, 4) finite numbers")
        given = [*_inputs(source), *_inputs(target), start]
        key = (source.depth_m.shape, target.depth_m.shape, config)
        with torch.inference_mode():
            if key not in self._plans:
                while len(self._plans) >= KEPT_PLANS:
                    self._plans.pop(next(iter(self._plans)))
                stage = _descent(config, self._kernels)
                self._plans[key] = Plan(self.device, stage, [part(a) for a in given])
            plan = self._plans[key]
            plan.upload(given)
            told = plan.run()[0].cpu().numpy()
        return _concluded(told, start, config)

    def plan(self) -> Plan:
        """Of the last new pair of sizes, with its inputs on the device."""
        return list(self._plans.values())[-1]


def _inputs(depth: DepthMap) -> list[Array]:
    """Depth, sigma and intrinsics; ValueError when shapes disagree."""
    h, w = depth.depth_m.shape
    if depth.sigma_m.shape != (h, w) or min(h, w) < 8:
        raise ValueError(f"depth {h, w} and sigma {depth.sigma_m.shape} do not fit")
    K = depth.K
    intrinsics = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], np.float64)
    z, sigma = (np.ascontiguousarray(a, np.float32) for a in (depth.depth_m, depth.sigma_m))
    return [z, sigma, intrinsics]


def _descent(config: IcpConfig, kernels: Kernels) -> Callable[..., tuple[Tensor, ...]]:
    """What a plan runs: from two depth maps and a start to the numbers of :func:`_concluded`."""

    def run(
        z_a: Tensor, sigma_a: Tensor, K_a: Tensor, z_b: Tensor, sigma_b: Tensor, K_b: Tensor,
        T: Tensor,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        a = build(z_a, sigma_a, K_a, config.edge_share)
        b = build(z_b, sigma_b, K_b, config.edge_share)
        T, state, seen = descend(a, b, T, config, kernels)
        last = (kernels.weigh or weigh)(seen, a, b, T, True, config)
        size = last.residual.view(seen.shape)
        near = (last.found.view(seen.shape) > 0) & (size.abs() < AREA_SIGMAS * last.scale)
        numbers = [
            last.H, last.common, last.g, last.sums, last.scale, last.centre, a.lever_m,
            last.partners * state[0], seen.known.sum(), state[2], T,
            correlation_sums(torch.where(near, size, 0.0), near, AREA_LAGS),
        ]  # fmt: skip
        return (torch.cat([n.reshape(-1).to(DOUBLE) for n in numbers]),)

    return run


def descend(
    a: DeviceSurface, b: DeviceSurface, T: Tensor, config: IcpConfig, kernels: Kernels = PLAIN
) -> tuple[Tensor, Tensor, SourcePoints]:
    """The motion after the iterations of every level, their state, and the last level's points."""
    look, move = kernels.weigh or weigh, kernels.advance or advance
    last = len(config.strides) - 1
    ones = torch.ones(2, dtype=DOUBLE, device=T.device)
    state = torch.cat([ones, torch.zeros_like(ones[:1])])
    for level, (stride, limit) in enumerate(zip(config.strides, config.iterations, strict=True)):
        seen = points(a, stride)
        state = torch.stack([state[0], state[0], state[2]])
        for _ in range(limit):
            found = look(seen, a, b, T, level == last, config)
            T, state = move(found, a, T, state, 0.3 if level == last else 1.0, config)
    return T, state, seen


def _concluded(told: F64, start: F64, config: IcpConfig) -> Registration:
    """The registration from the numbers that came down."""
    ends = np.cumsum([36, 36, 6, 4, 1, 3, 1, 1, 1, 1, 16])
    H, common, g, sums, scale, centre, lever, partners, available, done, T, lags = np.split(
        told, ends
    )
    if not np.isfinite(told[: ends[-1]]).all():  # a start from which nothing can be computed
        partners = np.zeros(1)
    equations = Equations(
        H.reshape(6, 6), common.reshape(6, 6), g, sums, float(scale[0]), centre, float(lever[0]),
        _area(lags.reshape(2, 3, AREA_LAGS)), int(partners[0]),
    )  # fmt: skip
    return conclude(equations, T.reshape(4, 4), start, int(available[0]), int(done[0]), config)


def _area(lags: F64) -> float:
    """How many neighbours err together, as :func:`recon.clouds.icp_kernels.correlated_area`."""
    area = 1.0
    for products, powers, counts in lags:
        length = 1.0
        for product, power, count in zip(products, powers, counts, strict=True):
            if count < 30 or product <= 0.03 * power:
                break
            length += 2.0 * float(product) / float(power)
        area *= length
    return area
