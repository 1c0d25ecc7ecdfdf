"""Alignment of depth images (the paper's ICP, section 2.3).

Depth images are aligned by projective point-to-plane ICP (Blais and Levine 1995,
doi:10.1109/34.400574; Chen and Medioni 1992): a source point's partner is the surface element
of the pixel it projects to, so no tree is searched.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from recon import se3
from recon.camera_model import rays
from recon.mapping import icp_kernels
from recon.parallel import parallel_for
from recon.types import F32, F64, DepthMap, Registration, Verdict

# Variance that the residuals do not show: edges half seen, errors of the normals; measured.
_UNSEEN_VARIANCE = 1.5

AREA_SIGMAS, AREA_LAGS = 4.685, 12
"""Residuals beyond so many sigmas do not count for the correlation of neighbours; its longest
lag."""


MIN_PARTNERS = 50  # minimum number of partners; fewer do not count as an overlap
GATE_SHARE = 0.05  # residuals above this share of the depth are no partners

EDGE_SHARE = 0.004
"""A 5x5 window that bends by more than this share of its depth holds a depth edge."""

HUBER_SIGMAS, TUKEY_SIGMAS = 1.345, 4.685
"""Of the coarse levels and of the last one: 95 % efficient on Gaussian noise, both."""

MIN_INLIER_SHARE, MAX_RMS_SHARE, MAX_TURN_RAD = 0.3, 0.01, 0.1
"""Of the source's surface; point to plane over the median depth; of the correction. A registration
beyond one of them is rejected: the start is off by less."""

WEAK_SLOPE = 0.02
"""Rms slope of the ground that a direction needs to be observed: noise tilts normals by less."""

UNKNOWN_SIGMA_M = 10.0  # of directions that are not observed
MAX_DISAGREEMENT = 4.0  # chi-square per degree of freedom against the images' motion


@dataclass(frozen=True, slots=True)
class IcpConfig:
    strides: tuple[int, ...] = (6, 3)  # pixels between the source points, level by level
    iterations: tuple[int, ...] = (8, 6)  # of each level, at most
    max_step_share: float = 0.05  # correction over the median depth, else rejected


def arrays_of(depth: DepthMap) -> tuple[F32, F32, F64]:
    """Depth and sigma (h, w) and (4,) fx fy cx cy; ValueError when shapes disagree."""
    h, w = depth.depth_m.shape
    if depth.sigma_m.shape != (h, w) or min(h, w) < 8:
        raise ValueError(f"depth {h, w} and sigma {depth.sigma_m.shape} do not fit")
    z, sigma = (np.ascontiguousarray(a, np.float32) for a in (depth.depth_m, depth.sigma_m))
    return z, sigma, depth.K[[0, 1, 0, 1], [0, 1, 2, 2]]


@dataclass(frozen=True, slots=True, eq=False)
class DepthSurface:
    elements: F32  # (h, w, 6), see recon.mapping.icp_kernels
    intrinsics: F64  # (4,) fx fy cx cy
    centre: F64  # (3,) m, mean of the surface in the camera frame
    lever_m: float  # rms distance of the surface from its centre

    @staticmethod
    def build(depth: DepthMap) -> DepthSurface:
        """The surface of ``depth``; raises ValueError when its shapes disagree."""
        z, sigma, intrinsics = arrays_of(depth)
        h, w = z.shape
        elements = np.zeros((h, w, 6), np.float32)
        inverse = 1.0 / np.where(z > 0, z, np.float32(np.nan)).astype(np.float64)
        chunks = -(-h // icp_kernels.CHUNK)
        parallel_for(
            icp_kernels.surface_elements, chunks, z, inverse, sigma, *intrinsics,
            EDGE_SHARE, elements,
        )  # fmt: skip
        v, u = np.nonzero(elements[::4, ::4, 4])
        some = z[4 * v, 4 * u].astype(np.float64)
        points = some[:, None] * rays(depth.K, np.column_stack([4.0 * u, 4.0 * v]))
        centre = points.mean(axis=0) if len(points) else np.zeros(3)
        lever = np.sqrt(np.mean(np.sum((points - centre) ** 2, axis=1))) if len(points) else 1.0
        return DepthSurface(elements, intrinsics, centre, max(float(lever), 1e-6))


class Problem:
    """The weighted normal equations of one iteration, rotating about the points' centre."""

    def __init__(
        self,
        H: F64,
        common: F64,
        g: F64,
        sums: F64,
        centre: F64,
        lever_m: float,
        area: Callable[[], float],
    ) -> None:
        """The sums over all partners of :func:`recon.mapping.icp_kernels.normal_equations`.

        ``centre`` (3,) m is in the target frame, ``lever_m`` the points' rms distance from it;
        ``area`` counts neighbours whose residuals err together, and takes long.
        """
        self.sums, self.centre, self.area = sums, centre, area
        # Turns a twist in metres at the rms lever into rad and m.
        self.unit = np.array([1 / lever_m] * 3 + [1.0] * 3)
        scale = np.outer(self.unit, self.unit)
        values, vectors = np.linalg.eigh(H * scale)
        self.values, self.vectors = values, vectors  # (6,) information along the (6, 6) columns
        # (6,) the part of the information that both surfaces agree on.
        self.shared = np.einsum("ik,ij,jk->k", vectors, common * scale, vectors)
        self.gradient = vectors.T @ (self.unit * g)
        # The eigenvalues are mean squares of the slope against each motion, 1 for a motion along
        # all normals. Noise tilts the normals too, but not those of both surfaces alike.
        enough = WEAK_SLOPE**2 * max(float(values[-1]), 1e-30)
        # (6,) directions that the surface determines.
        self.strong = (self.shared > enough) & (self.shared > 0.35 * values)

    def moved_m(self, T: F64) -> float:
        """By which ``T`` (4, 4) moves the points' centre."""
        centre = self.centre
        return float(np.linalg.norm(T[:3, :3] @ centre + T[:3, 3] - centre))

    def step(self) -> F64:
        """(4, 4) left correction in the target frame; weak directions stay put."""
        part = np.where(self.strong, self.gradient / np.maximum(self.values, 1e-30), 0.0)
        twist = self.unit * (-self.vectors @ part)
        R, centre = se3.so3_exp(twist[:3]), self.centre
        return se3.compose(R, centre - R @ centre + twist[3:])

    def settled(self, step: F64, share: float) -> bool:
        """True when ``step`` moves the points by less than ``share`` of its own sigma."""
        turn = float(np.linalg.norm(se3.so3_log(step[:3, :3]))) / float(self.unit[0])
        sums = self.sums
        variance = float(sums[1]) / max(float(sums[0]), 1.0)
        sigma = np.sqrt(variance / max(float(self.values[self.strong].min(initial=1e30)), 1e-30))
        return max(self.moved_m(step), turn) < max(share * float(sigma), 1e-7)


def _problem(
    source: DepthSurface, target: DepthSurface, T: F64, stride: int, tukey: bool
) -> Problem | None:
    """The problem at ``T``, or None when fewer than :data:`MIN_PARTNERS` points find a partner."""
    h, w = source.elements.shape[:2]
    shape = (h - stride // 2 - 1) // stride + 1, (w - stride // 2 - 1) // stride + 1
    size, rows = np.empty(shape, np.float32), np.empty((*shape, 10), np.float32)
    icp_kernels.residuals(
        source.elements, source.intrinsics, target.elements, target.intrinsics,
        T, stride, GATE_SHARE, size, rows,
    )  # fmt: skip
    matched = size[size < icp_kernels.UNMATCHED]
    if len(matched) < MIN_PARTNERS:
        return None
    every = max(len(matched) // 2000, 1)
    scale = max(float(np.median(np.abs(matched[::every]))) / 0.6745, 1e-3)
    H, common, g, sums = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6), np.zeros(4)
    centre = T[:3, :3] @ source.centre + T[:3, 3]
    limit = scale * (TUKEY_SIGMAS if tukey else HUBER_SIGMAS)
    icp_kernels.normal_equations(size, rows, centre, limit, tukey, H, common, g, sums)

    def area() -> float:
        return float(icp_kernels.correlated_area(size, AREA_SIGMAS * scale, AREA_LAGS))

    return Problem(H, common, g, sums, centre, source.lever_m, area)


def conclude(
    problem: Problem, T: F64, T_start: F64, available: int, iterations: int, config: IcpConfig
) -> Registration:
    """The registration after a last step from ``T`` (4, 4), for a search made elsewhere.
    ``available`` counts the source's surface elements."""
    return _judged(problem, problem.step() @ T, T_start, available, iterations + 1, config)


def register_projective(
    source: DepthMap, target: DepthMap, T_target_source: F64, config: IcpConfig | None = None
) -> Registration:
    """The motion that aligns ``source`` with ``target``, starting from ``T_target_source`` (4, 4).

    The maps' own poses are not used. Directions that the surface does not determine (on flat
    ground: both horizontal shifts and the turn about the vertical) keep the start, get
    ``UNKNOWN_SIGMA_M`` in the covariance and make the verdict DEGENERATE. REJECTED: too
    little overlap, residuals too large, or a correction too large to be plausible.
    """
    config = config or IcpConfig()
    a, b = DepthSurface.build(source), DepthSurface.build(target)
    T = np.array(T_target_source, dtype=np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise ValueError("T_target_source must be (4, 4) finite numbers")
    problem: Problem | None = None
    done = 0
    last = len(config.strides) - 1
    for level, (stride, limit) in enumerate(zip(config.strides, config.iterations, strict=True)):
        for _ in range(limit):
            problem = _problem(a, b, T, stride, level == last)
            if problem is None:
                return no_overlap(T_target_source, done)
            step = problem.step()
            T = step @ T
            done += 1
            if problem.settled(step, 0.3 if level == last else 1.0):
                break
    assert problem is not None
    grid = a.elements[stride // 2 :: stride, stride // 2 :: stride, 4]
    return _judged(problem, T, T_target_source, int(np.count_nonzero(grid)), done, config)


def agreed_motion(T: F64, covariance: F64, found: Registration) -> tuple[F64, F64] | None:
    """The images' motion (4, 4) with its covariance, averaged with a registration's; None where
    that is rejected or contradicts the images."""
    both = T, covariance, found.T_target_source, found.covariance
    if not found.converged or se3.disagreement(*both) > MAX_DISAGREEMENT:
        return None
    return se3.average(*both)


def no_overlap(T: F64, iterations: int) -> Registration:
    """The registration that fewer than :data:`MIN_PARTNERS` partners give: rejected."""
    return Registration(
        np.array(T, np.float64), np.eye(6) * 1e6, Verdict.REJECTED, float("nan"), 0.0, iterations
    )


def _judged(
    problem: Problem, T: F64, T_start: F64, available: int, iterations: int, config: IcpConfig
) -> Registration:
    covariance = _covariance(problem)
    sums, depth = problem.sums, float(problem.centre[2])
    rms = float(np.sqrt(sums[3] / max(sums[0], 1e-9)))
    share = float(sums[2]) / max(available, 1)
    change = T @ se3.inverse(T_start)
    turn = float(np.linalg.norm(se3.so3_log(change[:3, :3])))
    implausible = (
        share < MIN_INLIER_SHARE
        or rms > MAX_RMS_SHARE * depth
        or problem.moved_m(change) > config.max_step_share * depth
        or turn > MAX_TURN_RAD
        or not problem.strong.any()
    )
    good = Verdict.CONVERGED if problem.strong.all() else Verdict.DEGENERATE
    verdict = Verdict.REJECTED if implausible else good
    return Registration(T, covariance, verdict, rms, share, iterations)


def _covariance(problem: Problem) -> F64:
    """(6, 6) covariance of a left perturbation."""
    weights, squares = (float(s) for s in problem.sums[:2])
    # Residuals of neighbours err together, so they count as fewer than they are.
    area = problem.area()
    variance = max(squares / max(weights - 6.0, 1.0), 1e-6) * area * _UNSEEN_VARIANCE
    # Information from noise in the normals is none: only the shared part moves the estimate.
    information = np.maximum(problem.shared, 1e-30) ** 2 / np.maximum(problem.values, 1e-30)
    spread = np.where(problem.strong, variance / information, UNKNOWN_SIGMA_M**2)
    # The rotation was about the centre; a left perturbation turns about the origin.
    move = se3.adjoint(se3.compose(np.eye(3), problem.centre))
    directions = move @ (problem.unit[:, None] * problem.vectors)
    return np.asarray((directions * spread) @ directions.T)
