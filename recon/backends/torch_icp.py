"""Projective point-to-plane ICP in torch: two depth maps go up, a few numbers come down.

Surfaces, partners, weights and steps stay on the device, for a fixed number of iterations; one
that has settled stands still. Nothing is read in between, so on CUDA all of it is one captured
graph. The verdict and the covariance are those of :mod:`recon.mapping.registration`, from the
sums of one more iteration.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from recon.backends.room import kept
from recon.backends.torch_plan import Plan, part
from recon.backends.torch_surface import (
    DOUBLE,
    DeviceSurface,
    SourcePoints,
    build,
    correlation_sums,
    match,
    points,
    scale_of,
    solve,
)
from recon.mapping.registration import (
    AREA_LAGS,
    AREA_SIGMAS,
    MIN_PARTNERS,
    Equations,
    IcpConfig,
    arrays_of,
    conclude,
)
from recon.types import F64, Array, DepthMap, Registration

KEPT_PLANS = 4


class DeviceIcp:
    """Registers depth maps on ``device``; one thread at a time."""

    def __init__(self, device: str) -> None:
        self.device = device
        self._plans: dict[Any, Plan] = {}

    def register(
        self, source: DepthMap, target: DepthMap, T_target_source: F64, config: IcpConfig
    ) -> Registration:
        """As :func:`recon.mapping.registration.register_projective`."""
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
            rows = plan.run()[0].cpu().numpy()
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
        a = build(z_a, sigma_a, K_a, config.edge_share)
        b = build(z_b, sigma_b, K_b, config.edge_share)
        T, state, seen = descend(a, b, T, config)
        last = weigh(seen, a, b, T, True, config)
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
            found = weigh(seen, a, b, T, level == last, config)
            T, state = advance(found, a, T, state, 0.3 if level == last else 1.0, config)
    return T, state, seen


def _concluded(rows: F64, start: F64, config: IcpConfig) -> Registration:
    """The registration from the numbers read from the device."""
    ends = np.cumsum([36, 36, 6, 4, 1, 3, 1, 1, 1, 1, 16])
    H, common, g, sums, scale, centre, lever, partners, available, done, T, lags = np.split(
        rows, ends
    )
    if not np.isfinite(rows[: ends[-1]]).all():  # a start from which nothing can be computed
        partners = np.zeros(1)
    equations = Equations(
        H.reshape(6, 6), common.reshape(6, 6), g, sums, float(scale[0]), centre, float(lever[0]),
        _area(lags.reshape(2, 3, AREA_LAGS)), int(partners[0]),
    )  # fmt: skip
    return conclude(equations, T.reshape(4, 4), start, int(available[0]), int(done[0]), config)


def _area(lags: F64) -> float:
    """How many neighbours err together, as :func:`recon.mapping.icp_kernels.correlated_area`."""
    area = 1.0
    for products, powers, counts in lags:
        length = 1.0
        for product, power, count in zip(products, powers, counts, strict=True):
            if count < 30 or product <= 0.03 * power:
                break
            length += 2.0 * float(product) / float(power)
        area *= length
    return area


SHARED = 0.35
"""A direction counts when this share of its information is common to both surfaces."""

SIGN_ROUNDS = 26
"""A round takes a small eigenvalue 1.5 times nearer to one: to 3e-5 of the largest."""


@dataclass(frozen=True, slots=True, eq=False)
class Weighed:
    """The weighted normal equations, as :class:`recon.mapping.registration.Equations`."""

    H: Tensor  # (6, 6)
    common: Tensor  # (6, 6)
    g: Tensor  # (6,)
    sums: Tensor  # (4,)
    scale: Tensor  # ()
    centre: Tensor  # (3,) m, target frame
    partners: Tensor  # () how many
    residual: Tensor  # (N,) in sigmas, 0 without a partner
    found: Tensor  # (N,) 1 where there is one


def weigh(
    seen: SourcePoints, a: DeviceSurface, b: DeviceSurface, T: Tensor, tukey: bool,
    config: IcpConfig,
) -> Weighed:  # fmt: skip
    """The problem of the points ``seen`` of ``a`` against ``b`` at the motion ``T`` (4, 4)."""
    partners = match(seen, b, T, config)
    centre = T[:3, :3] @ a.centre + T[:3, 3]
    size = partners.residual.abs()
    scale = scale_of(partners.residual, partners.found)
    if tukey:
        weight = (1 - (size / (config.tukey_sigmas * scale)) ** 2).clamp(min=0) ** 2
    else:
        weight = (config.huber_sigmas * scale / size.clamp(min=1e-12)).clamp(max=1)
    weight = weight * partners.found
    J, own = (
        torch.cat([torch.linalg.cross(partners.point - centre, n), n], 1)
        * partners.information[:, None]
        for n in (partners.normal, partners.own_normal)
    )
    weighed = J * weight[:, None]
    mixed = weighed.T @ own
    squares = weight * size**2
    metres = squares / partners.information.clamp(min=1e-12) ** 2
    sums = [weight.sum(), squares.sum(), (weight > 0.1).to(DOUBLE).sum(), metres.sum()]
    return Weighed(
        weighed.T @ J, 0.5 * (mixed + mixed.T), weighed.T @ partners.residual, torch.stack(sums),
        scale, centre, partners.found.sum(), partners.residual, partners.found,
    )  # fmt: skip


def advance(
    weighed: Weighed, a: DeviceSurface, T: Tensor, state: Tensor, share: float, config: IcpConfig
) -> tuple[Tensor, Tensor]:
    """The motion after a step, unless it stands still, and the new state.

    ``state`` (3,): 1 while there are partners enough, 1 while it moves, steps made. It stands
    still once a step is less than ``share`` of its own sigma.
    """
    step, settled = _step(weighed, a.lever_m, share, config)
    overlap = state[0] * (weighed.partners >= MIN_PARTNERS)
    moving = state[1] * overlap
    T = torch.where(moving > 0, step @ T, T)
    return T, torch.stack([overlap, torch.where(settled, 0.0, moving), state[2] + moving])


def _step(sums: Weighed, lever_m: Tensor, share: float, config: IcpConfig) -> tuple[Tensor, Tensor]:
    """(4, 4) left correction along what the surface determines; () True when it is small.

    The host splits the directions by the eigenvectors of H. Here the split is the spectral
    projector of ``C - SHARED H``, C the part of H that both surfaces share: positive where more
    than that share is common and the slope is above ``weak_slope``. Its sign is found by Newton
    and Schulz (Higham, Functions of Matrices, 2008, chapter 5), with matrix products alone.
    """
    device = sums.H.device
    eye = torch.eye(6, dtype=DOUBLE, device=device)
    unit = torch.cat([(1 / lever_m).expand(3), torch.ones(3, dtype=DOUBLE, device=device)])
    H, common = (A * unit[:, None] * unit[None, :] for A in (sums.H, sums.common))
    squared = H @ H
    largest = (squared * squared).sum() ** 0.25 + 1e-30  # eigenvalue, to a factor of 1.6
    flat = (1 - SHARED) * config.weak_slope**2
    sign = (common - SHARED * H) / largest - flat * eye
    for _ in range(SIGN_ROUNDS):
        sign = torch.addmm(sign, sign @ sign, sign, beta=1.5, alpha=-0.5)
    P = 0.5 * (eye + sign)
    restricted = P @ H @ P + largest * (eye - P)
    solved = solve(restricted, torch.cat([P @ (unit * sums.g)[:, None], P], 1))
    twist = -unit * (P @ solved[:, 0])
    twist = torch.where(torch.isfinite(twist).all(), twist, 0.0)
    sigma = (P @ solved[:, 1:]).diagonal().amax().clamp(min=0).sqrt()
    turned, moved = twist[:3].norm() * lever_m, twist[3:].norm()
    return _about(sums.centre, twist), torch.maximum(turned, moved) < (share * sigma).clamp(
        min=1e-7
    )


def _about(centre: Tensor, twist: Tensor) -> Tensor:
    """(4, 4) the turn ``twist[:3]`` about ``centre`` and the shift ``twist[3:]``."""
    x, y, z = twist[:3]
    none = torch.zeros_like(x)
    K = torch.stack([none, -z, y, z, none, -x, -y, x, none]).view(3, 3)
    angle = twist[:3].norm().clamp(min=1e-12)
    half = torch.sin(angle / 2) / (angle / 2)
    eye = torch.eye(3, dtype=DOUBLE, device=twist.device)
    R = eye + (torch.sin(angle) / angle) * K + 0.5 * half**2 * (K @ K)
    shift = centre - R @ centre + twist[3:]
    bottom = torch.cat([torch.zeros_like(eye[:1]), torch.ones_like(eye[:1, :1])], 1)
    return torch.cat([torch.cat([R, shift[:, None]], 1), bottom])
