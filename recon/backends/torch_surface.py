"""Surface elements of depth maps in torch, their partners, and the linear algebra of ICP.

The elements are those of :func:`recon.mapping.icp_kernels.surface_elements`. No library call here
waits for the device, so all of it can be captured as a graph.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from recon.mapping.icp_kernels import MIN_PIXELS, REACH
from recon.mapping.registration import IcpConfig

DOUBLE = torch.float64


@dataclass(frozen=True, slots=True, eq=False)
class DeviceSurface:
    """As :class:`recon.mapping.registration.Surface`, on a device."""

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
    """x and y at z = 1 of every ``stride``-th pixel (h', w') of an image of ``size`` (h, w)."""
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

    As :func:`recon.mapping.icp_kernels.residuals`.
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


MEDIAN_OF = 4000
"""About so many residuals give the scale of all."""


def solve(A: Tensor, B: Tensor) -> Tensor:
    """X (n, k) with ``A X = B``, A (n, n) symmetric and positive definite; Gauss and Jordan.

    No pivoting, because such a matrix needs none; one that is not positive definite gives
    meaningless numbers, never an error.
    """
    n = A.shape[0]
    rows = torch.cat([A, B], 1)
    unit = torch.eye(n, dtype=A.dtype, device=A.device)
    for k in range(n):
        pivot = rows[k] / rows[k, k]
        rows = rows - (rows[:, k, None] - unit[:, k, None]) * pivot
    return rows[:, n:]


def median(values: Tensor, chosen: Tensor) -> Tensor:
    """() mean of the two middle values of those ``chosen`` (N,); the largest float if none is."""
    far = torch.finfo(values.dtype).max
    ordered = torch.where(chosen, values, far).sort().values
    count = chosen.sum()
    middle = torch.stack([(count - 1).clamp(min=0) // 2, count // 2])
    return ordered.gather(0, middle.clamp(max=len(values) - 1)).mean()


def scale_of(residual: Tensor, found: Tensor) -> Tensor:
    """() standard deviation of the residuals (N,) that are ``found``, by their median."""
    every = max(len(residual) // MEDIAN_OF, 1)
    middle = median(residual[::every].abs(), found[::every] > 0)
    return (middle / 0.6745).clamp(min=1e-3)
