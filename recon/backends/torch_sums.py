"""An iteration of projective ICP in torch: weighted sums over all partners, and the step."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from recon.backends.torch_linear import scale_of, solve
from recon.backends.torch_partners import SourcePoints, match
from recon.backends.torch_surface import DOUBLE, DeviceSurface
from recon.clouds.registration import MIN_PARTNERS, IcpConfig

SHARED = 0.35
"""A direction counts when this share of its information is common to both surfaces."""

SIGN_ROUNDS = 26
"""A round takes a small eigenvalue 1.5 times nearer to one: to 3e-5 of the largest."""


@dataclass(frozen=True, slots=True, eq=False)
class Weighed:
    """The weighted normal equations, as :class:`recon.clouds.registration.Equations`."""

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
