"""Alignment of depth images (the paper's ICP, section 2.3).

Depth images are aligned by projective point-to-plane ICP (Blais and Levine 1995,
doi:10.1109/34.400574; Chen and Medioni 1992): a source point's partner is the surface element
of the pixel it projects to, so no tree is searched.

A surface element is a plane in the camera frame, ``normal . X = distance``, fitted to the
inverse depth of a 5x5 window: the inverse depth of a plane is affine in the pixel, so the fit
is linear, exact on planes, and needs no matrix per pixel. ``elements`` are (h, w, 6) float32:
normal (unit, pointing away from the camera), distance, sigma of the depth, rms of the fit in
metres of depth; the sigma is 0 where there is no element.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from recon import se3
from recon.camera_model import rays
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
    elements: F32  # (h, w, 6), see above
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
        chunks = -(-h // CHUNK)
        parallel_for(
            surface_elements, chunks, z, inverse, sigma, *intrinsics,
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
        """The sums over all partners of :func:`normal_equations`.

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
    residuals(
        source.elements, source.intrinsics, target.elements, target.intrinsics,
        T, stride, GATE_SHARE, size, rows,
    )  # fmt: skip
    matched = size[size < UNMATCHED]
    if len(matched) < MIN_PARTNERS:
        return None
    every = max(len(matched) // 2000, 1)
    scale = max(float(np.median(np.abs(matched[::every]))) / 0.6745, 1e-3)
    H, common, g, sums = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6), np.zeros(4)
    centre = T[:3, :3] @ source.centre + T[:3, 3]
    limit = scale * (TUKEY_SIGMAS if tukey else HUBER_SIGMAS)
    normal_equations(size, rows, centre, limit, tukey, H, common, g, sums)

    def area() -> float:
        return float(correlated_area(size, AREA_SIGMAS * scale, AREA_LAGS))

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


# Compiled kernels


REACH = 2  # the window is (2 REACH + 1) squared
MIN_PIXELS = 12  # of the 25, next to holes
UNMATCHED = np.float32(1e9)
CHUNK = 8  # rows per parallel work item


@njit(cache=True, nogil=True)
def _gappy_fit(inverse: Any, v: int, u: int, fit: Any) -> bool:
    """Fill ``fit`` (4,) with value, slopes and mean square residual; False when too few."""
    h, w = inverse.shape
    count, su, sv, sw = 0.0, 0.0, 0.0, 0.0
    suu, svv, suv, suw, svw, sww = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for dv in range(max(-REACH, -v), min(REACH, h - 1 - v) + 1):
        for du in range(max(-REACH, -u), min(REACH, w - 1 - u) + 1):
            q = inverse[v + dv, u + du]
            if np.isnan(q):
                continue
            count += 1
            su += du
            sv += dv
            sw += q
            suu += du * du
            svv += dv * dv
            suv += du * dv
            suw += du * q
            svw += dv * q
            sww += q * q
    if count < MIN_PIXELS:
        return False
    suu, svv, suv = suu - su * su / count, svv - sv * sv / count, suv - su * sv / count
    suw, svw = suw - su * sw / count, svw - sv * sw / count
    det = suu * svv - suv * suv
    if det < 1.0:
        return False
    fit[1] = (svv * suw - suv * svw) / det
    fit[2] = (suu * svw - suv * suw) / det
    fit[0] = (sw - fit[1] * su - fit[2] * sv) / count
    fit[3] = max(sww - sw * sw / count - fit[1] * suw - fit[2] * svw, 0.0) / (count - 3)
    return True


@njit(cache=True, nogil=True)
def _full_fits(inverse: Any, v: int, column: Any, fits: Any) -> None:
    """Fill ``fits`` (4, w) of row ``v``: value, slopes, mean square residual; NaN near holes. A
    hole is NaN and spoils every sum that it is part of, so no pixel needs to be asked."""
    h, w = inverse.shape
    fits[:] = np.nan
    if v < REACH or v >= h - REACH:
        return
    r0, r1, r2, r3, r4 = (
        inverse[v - 2], inverse[v - 1], inverse[v], inverse[v + 1], inverse[v + 2]
    )  # fmt: skip
    sums, slopes, squares = column[0], column[1], column[2]
    for u in range(w):
        a, b, c, d, e = r0[u], r1[u], r2[u], r3[u], r4[u]
        sums[u] = a + b + c + d + e
        slopes[u] = 2.0 * (e - a) + d - b
        squares[u] = a * a + b * b + c * c + d * d + e * e
    value, along, across, rest = fits[0], fits[1], fits[2], fits[3]
    for u in range(REACH, w - REACH):
        s0 = sums[u - 2] + sums[u - 1] + sums[u] + sums[u + 1] + sums[u + 2]
        s1 = slopes[u - 2] + slopes[u - 1] + slopes[u] + slopes[u + 1] + slopes[u + 2]
        s2 = squares[u - 2] + squares[u - 1] + squares[u] + squares[u + 1] + squares[u + 2]
        sx = 2.0 * (sums[u + 2] - sums[u - 2]) + sums[u + 1] - sums[u - 1]
        value[u], along[u], across[u] = s0 * (1 / 25), sx * (1 / 50), s1 * (1 / 50)
        rest[u] = (s2 - s0 * s0 * (1 / 25) - (sx * sx + s1 * s1) * (1 / 50)) * (1 / 22)


@njit(cache=True, nogil=True)
def surface_elements(
    begin: int, end: int, depth: Any, inverse: Any, sigma: Any, fx: float, fy: float, cx: float,
    cy: float, edge: float, elements: Any,
) -> None:  # fmt: skip
    """Fill ``elements`` from ``depth``, its ``inverse`` and ``sigma`` (h, w); NaN is unknown.

    ``begin`` to ``end`` count chunks of rows.

    No element where the fit misses by more than ``edge`` (share of the depth) and 3 sigma: a
    depth edge runs through the window.
    """
    h, w = depth.shape
    for chunk in range(begin, end):
        column, fits = np.empty((3, w)), np.empty((4, w))
        for v in range(chunk * CHUNK, min((chunk + 1) * CHUNK, h)):
            _full_fits(inverse, v, column, fits)
            for u in range(w):
                element = elements[v, u]
                element[4] = 0.0
                z = depth[v, u]
                if not (z > 0 and sigma[v, u] > 0):
                    continue
                if np.isnan(fits[0, u]) and not _gappy_fit(inverse, v, u, fits[:, u]):
                    continue
                rms = np.sqrt(max(fits[3, u], 0.0)) * z * z
                if rms > edge * z and rms > 3 * sigma[v, u]:
                    continue
                # A plane's inverse depth at (u, v) is normal . ray / distance.
                a, b = fits[1, u] * fx, fits[2, u] * fy
                c = fits[0, u] - fits[1, u] * (u - cx) - fits[2, u] * (v - cy)
                length = 1.0 / np.sqrt(a * a + b * b + c * c)
                element[0], element[1], element[2] = a * length, b * length, c * length
                element[3], element[4], element[5] = length, sigma[v, u], rms


@njit(cache=True, nogil=True, fastmath=True)
def residuals(
    elements_s: Any, K_s: Any, elements_t: Any, K_t: Any, T: Any, stride: int, gate: float,
    size: Any, rows: Any,
) -> None:  # fmt: skip
    """Match every ``stride``-th source pixel to the target element it projects onto.

    ``size`` (hs, ws) float32 receives the signed residual over its sigma, UNMATCHED where there
    is no partner: no element, out of view, further than ``gate`` (share of the depth), or
    normals 45 degrees apart. ``rows`` (hs, ws, 10): target normal, source normal, point, all
    in the target frame, and 1 / sigma.
    """
    hs, ws = size.shape
    ht, wt = elements_t.shape[0], elements_t.shape[1]
    for j in range(hs):
        v = j * stride + stride // 2
        for i in range(ws):
            u = i * stride + stride // 2
            size[j, i] = UNMATCHED
            n = elements_s[v, u]
            if not n[4] > 0:
                continue
            # The point where the ray meets the element: it averages the noise of 25 pixels.
            x, y = (u - K_s[2]) / K_s[0], (v - K_s[3]) / K_s[1]
            z = n[3] / (n[0] * x + n[1] * y + n[2])
            x, y = x * z, y * z
            px = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
            py = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
            pz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            if not pz > 1e-3:
                continue
            ut, vt = K_t[0] * px / pz + K_t[2] + 0.5, K_t[1] * py / pz + K_t[3] + 0.5
            if not (ut >= 0 and vt >= 0 and ut < wt and vt < ht):
                continue
            e = elements_t[int(vt), int(ut)]
            if not e[4] > 0:
                continue
            along = e[0] * px + e[1] * py + e[2] * pz
            r = along - e[3]
            nx = T[0, 0] * n[0] + T[0, 1] * n[1] + T[0, 2] * n[2]
            ny = T[1, 0] * n[0] + T[1, 1] * n[1] + T[1, 2] * n[2]
            nz = T[2, 0] * n[0] + T[2, 1] * n[1] + T[2, 2] * n[2]
            if abs(r) > gate * pz or nx * e[0] + ny * e[1] + nz * e[2] < 0.707:
                continue
            # Depth errors lie along the rays; what counts is their part along the normal.
            information = pz / (abs(along) * np.sqrt(e[4] * e[4] + n[4] * n[4]) + 1e-9)
            size[j, i] = r * information
            row = rows[j, i]
            row[0], row[1], row[2] = e[0], e[1], e[2]
            row[3], row[4], row[5] = nx, ny, nz
            row[6], row[7], row[8] = px, py, pz
            row[9] = information


@njit(inline="always", fastmath=True)
def _lever(row: Any, first: int, centre: Any, J: Any) -> None:
    """Fill ``J`` (6,): change of the distance along the normal ``row[first:first + 3]``."""
    x, y, z = row[6] - centre[0], row[7] - centre[1], row[8] - centre[2]
    a, b, c = row[first], row[first + 1], row[first + 2]
    scale = row[9]
    J[0], J[1], J[2] = (y * c - z * b) * scale, (z * a - x * c) * scale, (x * b - y * a) * scale
    J[3], J[4], J[5] = a * scale, b * scale, c * scale


@njit(cache=True, nogil=True, fastmath=True)
def normal_equations(
    size: Any, rows: Any, centre: Any, limit: float, tukey: bool, H: Any, common: Any, g: Any,
    sums: Any,
) -> None:  # fmt: skip
    """Fill H (6, 6), ``common`` (6, 6), g (6,) and ``sums`` (4,) of the weighted problem.

    The unknown is a rotation about ``centre`` (3,) and a translation, in the target frame.
    ``common`` is H with the source's normals on one side: noise of the normals, which is not
    shared, does not enter it. ``limit`` is in sigmas: Huber's corner, or Tukey's end.
    ``sums``: weights, weighted squares, points with a weight above a tenth, weighted squares
    in metres.
    """
    H[:] = 0.0
    common[:] = 0.0
    g[:] = 0.0
    sums[:] = 0.0
    J, J_s = np.empty(6), np.empty(6)
    for j in range(size.shape[0]):
        for i in range(size.shape[1]):
            r = size[j, i]
            magnitude = abs(r)
            if magnitude >= UNMATCHED or (tukey and magnitude >= limit):
                continue
            if tukey:
                share = 1.0 - (r / limit) * (r / limit)
                weight = share * share
            else:
                weight = 1.0 if magnitude <= limit else limit / magnitude
            row = rows[j, i]
            _lever(row, 0, centre, J)
            _lever(row, 3, centre, J_s)
            for a in range(6):
                wJ, wJ_s = weight * J[a], weight * J_s[a]
                g[a] += wJ * r
                for b in range(a, 6):
                    H[a, b] += wJ * J[b]
                    common[a, b] += 0.5 * (wJ * J_s[b] + wJ_s * J[b])
            sums[0] += weight
            sums[1] += weight * r * r
            sums[2] += 1.0 if weight > 0.1 else 0.0
            sums[3] += weight * r * r / (row[9] * row[9])
    for a in range(6):
        for b in range(a):
            H[a, b], common[a, b] = H[b, a], common[b, a]


@njit(cache=True, nogil=True, fastmath=True)
def correlated_area(size: Any, limit: float, lags: int) -> float:
    """Number of neighbouring residuals that err together: the sum of their autocorrelation."""
    h, w = size.shape
    area = 1.0
    for axis in range(2):
        length = 1.0
        for lag in range(1, lags + 1):
            product, power, count = 0.0, 0.0, 0
            dj, di = (lag, 0) if axis == 0 else (0, lag)
            for j in range(h - dj):
                for i in range(w - di):
                    a, b = size[j, i], size[j + dj, i + di]
                    if abs(a) < limit and abs(b) < limit:
                        product += a * b
                        power += 0.5 * (a * a + b * b)
                        count += 1
            if count < 30 or product <= 0.03 * power:
                break
            length += 2.0 * product / power
        area *= length
    return area
