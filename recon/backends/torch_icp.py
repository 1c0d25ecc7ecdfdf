"""Projective point-to-plane ICP in torch: two depth maps go up, a few numbers come down.

Surfaces, partners, weights and steps stay on the device, for a fixed number of iterations; one
that has settled stands still. Nothing is read in between, so on CUDA all of it is one captured
graph. The verdict and the covariance are those of :mod:`recon.mapping.registration`, from the
sums of one more iteration; surface elements are those of :mod:`recon.mapping.icp_kernels`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from recon.backends.room import kept
from recon.backends.torch_plan import Plan, fused, part, read
from recon.mapping.icp_kernels import MIN_PIXELS, REACH
from recon.mapping.registration import (
    AREA_LAGS,
    AREA_SIGMAS,
    MIN_PARTNERS,
    Equations,
    IcpConfig,
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
        a = build(z_a, sigma_a, K_a, config.edge_share)
        b = build(z_b, sigma_b, K_b, config.edge_share)
        T, state, seen = descend(a, b, T, config)
        last = weigh(seen, a, b, T, True, config)
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
            found = weigh(seen, a, b, T, level == last, config)
            T, state = advance(found, a, T, state, 0.3 if level == last else 1.0, config)
    return T, state, seen


def _concluded(rows: F64, start: F64, config: IcpConfig) -> Registration:
    """The registration from the numbers read from the device."""
    ends = np.cumsum([36, 36, 6, 4, 3, 1, 1, 1, 1, 16])
    H, common, g, sums, centre, lever, partners, available, done, T, lags = np.split(rows, ends)
    if not np.isfinite(rows[: ends[-1]]).all():  # a start from which nothing can be computed
        partners = np.zeros(1)
    if partners[0] < MIN_PARTNERS:
        return no_overlap(start, int(done[0]))
    equations = Equations(
        H.reshape(6, 6), common.reshape(6, 6), g, sums, centre, float(lever[0]),
        lambda: _area(lags.reshape(2, 3, AREA_LAGS)),
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
    if fused(T):
        from recon.backends import triton_icp

        return triton_icp.weigh(seen, a, b, T, tukey, config)
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
    if fused(T):
        from recon.backends import triton_icp

        return triton_icp.advance(weighed, a, T, state, share, config)
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


# ---- surface elements, their partners, and linear algebra ------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class DeviceSurface:
    """As :class:`recon.mapping.registration.DepthSurface`, on a device."""

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
    if fused(depth):
        from recon.backends import triton_icp

        return triton_icp.surface_elements(depth, sigma, intrinsics, edge_share)
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
    if fused(residual):
        from recon.backends import triton_icp

        return triton_icp.scale_of(residual[::every], found[::every])
    middle = median(residual[::every].abs(), found[::every] > 0)
    return (middle / 0.6745).clamp(min=1e-3)
