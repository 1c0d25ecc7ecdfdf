"""Surface elements of depth maps in torch, as :func:`recon.clouds.icp_kernels.surface_elements`."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from recon.clouds.icp_kernels import MIN_PIXELS, REACH

DOUBLE = torch.float64


@dataclass(frozen=True, slots=True, eq=False)
class DeviceSurface:
    """As :class:`recon.clouds.registration.Surface`, on a device."""

    elements: Tensor  # (h, w, 6) float32
    intrinsics: Tensor  # (4,) float64 fx fy cx cy
    centre: Tensor  # (3,) m
    lever_m: Tensor  # ()


def build(depth: Tensor, sigma: Tensor, intrinsics: Tensor, edge_share: float) -> DeviceSurface:
    """The surface of ``depth`` and ``sigma`` (h, w) float32; NaN is unknown."""
    elements = surface_elements(depth, sigma, intrinsics, edge_share)
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
    """x and y at z = 1 of every ``stride``-th pixel (h', w') of a picture of ``size`` (h, w)."""
    v = torch.arange(first, size[0], stride, dtype=DOUBLE, device=intrinsics.device)[:, None]
    u = torch.arange(first, size[1], stride, dtype=DOUBLE, device=intrinsics.device)[None, :]
    fx, fy, cx, cy = intrinsics
    shape = (v.shape[0], u.shape[1])
    return ((u - cx) / fx).expand(shape), ((v - cy) / fy).expand(shape)


def surface_elements(depth: Tensor, sigma: Tensor, intrinsics: Tensor, edge_share: float) -> Tensor:
    """(h, w, 6) float32 elements: a plane fitted to the inverse depth of each 5x5 window."""
    z, s = depth.to(DOUBLE), sigma.to(DOUBLE)
    value, along, across, rest, fits = _fitted(z)
    rms = rest.clamp(min=0).sqrt() * z * z
    good = fits & (z > 0) & (s > 0) & ~((rms > edge_share * z) & (rms > 3 * s))
    h, w = depth.shape
    fx, fy, cx, cy = intrinsics
    u = torch.arange(w, dtype=DOUBLE, device=depth.device)[None, :]
    v = torch.arange(h, dtype=DOUBLE, device=depth.device)[:, None]
    # A plane's inverse depth at (u, v) is normal . ray / distance.
    normal = torch.stack(
        [along * fx, across * fy, value - along * (u - cx) - across * (v - cy)], -1
    )
    length = 1.0 / (normal * normal).sum(-1).sqrt()
    element = torch.cat(
        [normal * length[..., None], length[..., None], s[..., None], rms[..., None]], -1
    )
    return torch.where(good[..., None], element, 0.0).float()


def _fitted(z: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Value, slopes along u and v, mean square residual (h, w), and where there are enough."""
    known = z > 0
    q = torch.where(known, 1.0 / torch.where(known, z, 1.0), 0.0)
    n, q1, q2 = _moments(torch.stack([known.to(DOUBLE), q, q * q]))
    count, su, sv = n[0][0], n[0][1], n[1][0]
    sw, sww = q1[0][0], q2[0][0]
    each = torch.where(count > 0, count, 1.0)
    suu, svv = n[0][2] - su * su / each, n[2][0] - sv * sv / each
    suv = n[1][1] - su * sv / each
    suw, svw = q1[0][1] - su * sw / each, q1[1][0] - sv * sw / each
    det = suu * svv - suv * suv
    enough = (count >= MIN_PIXELS) & (det >= 1.0)
    det = torch.where(enough, det, 1.0)
    along, across = (svv * suw - suv * svw) / det, (suu * svw - suv * suw) / det
    value = (sw - along * su - across * sv) / each
    rest = sww - sw * sw / each - along * suw - across * svw
    return value, along, across, rest / (count - 3).clamp(min=1), enough


def _moments(fields: Tensor) -> list[list[list[Tensor]]]:
    """Of each field (h, w), [power of dv][power of du]: sums over 5x5 windows."""
    d = torch.arange(-REACH, REACH + 1, dtype=DOUBLE, device=fields.device)
    powers = torch.stack([torch.ones_like(d), d, d * d], 1)  # (5, 3)
    side = 2 * REACH + 1
    rows = F.pad(fields, (REACH, REACH)).unfold(2, side, 1) @ powers  # (k, h, w, 3)
    rows = F.pad(rows.permute(0, 3, 1, 2), (0, 0, REACH, REACH))  # (k, 3 of u, h + 4, w)
    sums = rows.unfold(2, side, 1) @ powers  # (k, 3 of u, h, w, 3 of v)
    return [[[field[i, :, :, j] for i in range(3)] for j in range(3)] for field in sums]
