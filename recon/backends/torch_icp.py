"""Projective point-to-plane ICP with the work per pixel in torch.

Each iteration matches every ``stride``-th source element on the device and brings back two
6x6 matrices and a few sums: one wait per iteration. The last iteration, the covariance and the
verdict are those of :mod:`recon.registration`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from recon import se3
from recon.registration import IcpConfig, Surface, register_surfaces
from recon.types import F64, DepthMap, Registration

MIN_PARTNERS = 50
DOUBLE = torch.float64


@dataclass(frozen=True, slots=True, eq=False)
class _Partners:
    """Elements that found each other, in the target's frame; rows of the same N."""

    normal: Tensor  # (N, 3) of the target
    own_normal: Tensor  # (N, 3) of the source
    point: Tensor  # (N, 3) m
    information: Tensor  # (N,) 1 / m
    residual: Tensor  # (N,) in sigmas
    found: Tensor  # (N,) 1 where there is a partner, else 0


def register_projective(
    source: DepthMap, target: DepthMap, T_target_source: F64, config: IcpConfig, device: str
) -> Registration:
    """As :func:`recon.registration.register_projective`, on ``device``."""
    T = np.array(T_target_source, np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise ValueError("T_target_source must be (4, 4) finite numbers")
    a, b = Surface.build(source, config), Surface.build(target, config)
    with torch.inference_mode():
        T = _descend(a, b, T, config, device)
    last = replace(config, strides=config.strides[-1:], iterations=(1,))
    found = register_surfaces(a, b, T, last)
    change = found.T_target_source @ se3.inverse(np.asarray(T_target_source, np.float64))
    centre = found.T_target_source[:3, :3] @ a.centre + found.T_target_source[:3, 3]
    step = float(np.linalg.norm(change[:3, :3] @ centre + change[:3, 3] - centre))
    turn = float(np.linalg.norm(se3.so3_log(change[:3, :3])))
    if step > config.max_step_share * float(centre[2]) or turn > config.max_turn_rad:
        return replace(found, verdict="rejected")
    return found


def _descend(a: Surface, b: Surface, T: F64, config: IcpConfig, device: str) -> F64:
    """The motion after the iterations of every level; the start when too few partners."""
    elements_a = torch.from_numpy(a.elements).to(device, non_blocking=True)
    elements_b = torch.from_numpy(b.elements).to(device, non_blocking=True)
    last = len(config.strides) - 1
    for level, (stride, limit) in enumerate(zip(config.strides, config.iterations, strict=True)):
        points, normals, sigma = _points(elements_a[stride // 2 :: stride, stride // 2 :: stride],
                                         a.intrinsics, stride)  # fmt: skip
        for _ in range(limit):
            move = torch.from_numpy(T).to(device, non_blocking=True)
            partners = _match(points, normals, sigma, elements_b, b.intrinsics, move, config)
            centre = T[:3, :3] @ a.centre + T[:3, 3]
            sums = _normal_equations(partners, centre, level == last, config).cpu().numpy()
            if sums[78] < MIN_PARTNERS:
                return T
            step, settled = _step(sums, centre, a.lever_m, 0.3 if level == last else 1.0, config)
            T = step @ T
            if settled:
                break
    return T


def _points(elements: Tensor, intrinsics: F64, stride: int) -> tuple[Tensor, Tensor, Tensor]:
    """Where the rays meet the elements (N, 3), their normals (N, 3) and sigmas (N,)."""
    h, w = elements.shape[:2]
    fx, fy, cx, cy = (float(k) for k in intrinsics)
    v = torch.arange(h, device=elements.device, dtype=DOUBLE)[:, None] * stride + stride // 2
    u = torch.arange(w, device=elements.device, dtype=DOUBLE)[None, :] * stride + stride // 2
    x, y = ((u - cx) / fx).expand(h, w), ((v - cy) / fy).expand(h, w)
    ray = torch.stack([x, y, torch.ones_like(x)], -1)
    element = elements.to(DOUBLE)
    along = (element[..., :3] * ray).sum(-1)
    z = element[..., 3] / torch.where(along.abs() > 1e-9, along, 1.0)
    return (
        (ray * z[..., None]).reshape(-1, 3),
        element[..., :3].reshape(-1, 3),
        element[..., 4].reshape(-1),
    )


def _match(
    points: Tensor, normals: Tensor, sigma: Tensor, target: Tensor, intrinsics: F64, T: Tensor,
    config: IcpConfig,
) -> _Partners:  # fmt: skip
    """Each element with the target element of the pixel that it projects to."""
    h, w = target.shape[:2]
    fx, fy, cx, cy = (float(k) for k in intrinsics)
    p = points @ T[:3, :3].T + T[:3, 3]
    n = normals @ T[:3, :3].T
    depth = torch.where(p[:, 2] > 1e-3, p[:, 2], 1.0)
    u, v = fx * p[:, 0] / depth + cx + 0.5, fy * p[:, 1] / depth + cy + 0.5
    found = (sigma > 0) & (p[:, 2] > 1e-3) & (u >= 0) & (v >= 0) & (u < w) & (v < h)
    index = v.clamp(0, h - 1).long() * w + u.clamp(0, w - 1).long()
    e = target.reshape(-1, target.shape[2])[index].to(DOUBLE)
    along = (e[:, :3] * p).sum(-1)
    r = along - e[:, 3]
    found = found & (e[:, 4] > 0) & (r.abs() <= config.gate_share * p[:, 2])
    found = found & ((n * e[:, :3]).sum(-1) >= 0.707)
    spread = along.abs() * torch.sqrt(e[:, 4] ** 2 + sigma**2) + 1e-9
    share = found.to(DOUBLE)
    return _Partners(e[:, :3], n, p, share * depth / spread, share * r * depth / spread, share)


def _normal_equations(partners: _Partners, centre: F64, tukey: bool, config: IcpConfig) -> Tensor:
    """(79,) H (36), H with the source's normals on one side (36), g (6), number of partners.

    The scale is the median magnitude of the residuals, as a value of the device.
    """
    c = torch.from_numpy(centre).to(partners.point.device, non_blocking=True)
    size = partners.residual.abs()
    nan = torch.full_like(size, torch.nan)
    median = torch.nanmedian(torch.where(partners.found > 0, size, nan))
    scale = (torch.nan_to_num(median) / 0.6745).clamp(min=1e-3)
    if tukey:
        weight = (1 - (size / (config.tukey_sigmas * scale)) ** 2).clamp(min=0) ** 2
    else:
        weight = (config.huber_sigmas * scale / size.clamp(min=1e-12)).clamp(max=1)
    weight = weight * partners.found

    def lever(normal: Tensor) -> Tensor:
        turn = torch.linalg.cross(partners.point - c, normal)
        return torch.cat([turn, normal], 1) * partners.information[:, None]

    J, own = lever(partners.normal), lever(partners.own_normal)
    H = (J * weight[:, None]).T @ J
    mixed = (J * weight[:, None]).T @ own
    g = J.T @ (weight * partners.residual)
    parts = [H.reshape(-1), (0.5 * (mixed + mixed.T)).reshape(-1), g, partners.found.sum()[None]]
    return torch.cat(parts)


def _step(
    sums: F64, centre: F64, lever_m: float, share: float, config: IcpConfig
) -> tuple[F64, bool]:
    """(4, 4) left correction along the directions that the surface determines; True when small."""
    unit = np.array([1 / lever_m] * 3 + [1.0] * 3)
    H, common, g = sums[:36].reshape(6, 6), sums[36:72].reshape(6, 6), sums[72:78]
    values, vectors = np.linalg.eigh(H * np.outer(unit, unit))
    shared = np.einsum("ik,ij,jk->k", vectors, common * np.outer(unit, unit), vectors)
    strong = (shared > config.weak_slope**2 * max(float(values[-1]), 1e-30)) & (
        shared > 0.35 * values
    )
    part = np.where(strong, vectors.T @ (unit * g) / np.maximum(values, 1e-30), 0.0)
    twist = -unit * (vectors @ part)
    R = se3.so3_exp(twist[:3])
    sigma = 1 / np.sqrt(max(float(values[strong].min(initial=1e30)), 1e-30))
    moved = max(float(np.linalg.norm(twist[3:])), float(np.linalg.norm(twist[:3])) * lever_m)
    return se3.compose(R, centre - R @ centre + twist[3:]), moved < max(share * sigma, 1e-7)
