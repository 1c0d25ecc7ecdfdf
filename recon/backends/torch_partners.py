"""Who is whose partner between two surfaces on a device, and how their residuals vary together."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from recon.backends.torch_surface import DOUBLE, DeviceSurface, rays
from recon.clouds.registration import IcpConfig


@dataclass(frozen=True, slots=True, eq=False)
class SourcePoints:
    """Every ``stride``-th element of the source, flat."""

    shape: tuple[int, int]
    point: Tensor  # (N, 3) m, where the ray meets the element: it averages the noise of 25 pixels
    normal: Tensor  # (N, 3)
    sigma: Tensor  # (N,) m of depth
    known: Tensor  # (N,) where there is an element


@dataclass(frozen=True, slots=True, eq=False)
class Partners:
    """Elements that found each other, in the target's frame; rows of the same N."""

    normal: Tensor  # (N, 3) of the target
    own_normal: Tensor  # (N, 3) of the source
    point: Tensor  # (N, 3) m
    information: Tensor  # (N,) 1 / m; 0 where there is no partner, as the residual
    residual: Tensor  # (N,) in sigmas
    found: Tensor  # (N,) 1 where there is a partner, else 0


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


def match(source: SourcePoints, target: DeviceSurface, T: Tensor, config: IcpConfig) -> Partners:
    """Each element with the target element of the pixel that it projects to.

    As :func:`recon.clouds.icp_kernels.residuals`.
    """
    h, w = target.elements.shape[:2]
    fx, fy, cx, cy = target.intrinsics
    p = source.point @ T[:3, :3].T + T[:3, 3]
    n = source.normal @ T[:3, :3].T
    ahead = p[:, 2] > 1e-3
    depth = torch.where(ahead, p[:, 2], 1.0)
    u, v = fx * p[:, 0] / depth + cx + 0.5, fy * p[:, 1] / depth + cy + 0.5
    found = source.known & ahead & (u >= 0) & (v >= 0) & (u < w) & (v < h)
    index = torch.where(found, v.floor() * w + u.floor(), 0.0).long()
    e = target.elements.view(-1, 6)[index].to(DOUBLE)
    along = (e[:, :3] * p).sum(-1)
    r = along - e[:, 3]
    found = found & (e[:, 4] > 0) & (r.abs() <= config.gate_share * p[:, 2])
    found = found & ((n * e[:, :3]).sum(-1) >= 0.707)
    # Depth errors lie along the rays; what counts is their part along the normal.
    spread = along.abs() * torch.sqrt(e[:, 4] ** 2 + source.sigma**2) + 1e-9
    information = torch.where(found, depth / spread, 0.0)
    return Partners(
        e[:, :3], n, p, information, torch.where(found, r, 0.0) * information, found.to(DOUBLE)
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
