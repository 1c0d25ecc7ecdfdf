"""Projective ICP as Triton kernels: surface elements, and an iteration in four of them.

``weigh`` matches every point, as :func:`recon.mapping.registration.residuals`, and writes its
residual; the scale of the residuals is their median; then the points are matched again,
weighed, and summed up, a row of partial sums for a block of points. ``advance`` is one program: the
directions that the surface determines, the step along them, and what has settled. All numbers are
float64, as on the host.
"""

# mypy: allow-untyped-defs, allow-incomplete-defs
# Triton reads annotations of a kernel as values of its own, so its arguments have none.
from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

from recon.backends.triton_dense import blocks
from recon.mapping.registration import (
    EDGE_SHARE,
    GATE_SHARE,
    HUBER_SIGMAS,
    MIN_PARTNERS,
    MIN_PIXELS,
    REACH,
    TUKEY_SIGMAS,
    WEAK_SLOPE,
)

POINTS = 128  # points of one program
ROW = 83  # numbers of a row of sums: H, H with the source's normals on one side, g, sums, partners
MEDIAN_OF = 4000  # about so many residuals give the scale of all
SHARED = 0.35  # a direction counts when this share of its information is common to both surfaces
SIGN_ROUNDS = 26  # a round takes a small eigenvalue 1.5 times nearer to one: to 3e-5 of the largest


@dataclass(frozen=True, slots=True, eq=False)
class DeviceSurface:
    """As :class:`recon.mapping.registration.DepthSurface`, on a device."""

    elements: Tensor  # (h, w, 6) float32
    intrinsics: Tensor  # (4,) float64 fx fy cx cy
    centre: Tensor  # (3,) m
    lever_m: Tensor  # ()


@dataclass(frozen=True, slots=True, eq=False)
class SourcePoints:
    """Every ``stride``-th element of the source, flat."""

    shape: tuple[int, int]
    point: Tensor  # (N, 3) m, where the ray meets the element: it averages the noise of 25 pixels
    normal: Tensor  # (N, 3)
    sigma: Tensor  # (N,) m of depth
    known: Tensor  # (N,) where there is an element


@dataclass(frozen=True, slots=True, eq=False)
class Weighed:
    """The weighted normal equations, as :class:`recon.mapping.registration.Problem`."""

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
    seen: SourcePoints, a: DeviceSurface, b: DeviceSurface, T: Tensor, tukey: bool
) -> Weighed:
    """The problem of the points ``seen`` of ``a`` against ``b`` at the motion ``T`` (4, 4)."""
    count = len(seen.sigma)
    residual, found = torch.empty((2, count), dtype=torch.float64, device=T.device)
    programs = blocks(count, POINTS)
    partial = torch.empty((programs, ROW), dtype=torch.float64, device=T.device)
    h, w = b.elements.shape[:2]
    given = (seen.point, seen.normal, seen.sigma, b.elements, b.intrinsics, T)
    residuals_kernel[(programs,)](
        *given, residual, found, count, h, w, GATE_SHARE, POINTS, num_warps=1
    )
    every = max(count // MEDIAN_OF, 1)
    scale = scale_of(residual[::every], found[::every])
    sigmas = TUKEY_SIGMAS if tukey else HUBER_SIGMAS
    normal_equations_kernel[(programs,)](
        *given, a.centre, scale, partial, count, h, w, GATE_SHARE, sigmas, int(tukey),
        POINTS, ROW, num_warps=1,
    )  # fmt: skip
    sums = partial.sum(0)
    H, mixed = sums[:36].view(6, 6), sums[36:72].view(6, 6)
    centre = T[:3, :3] @ a.centre + T[:3, 3]
    return Weighed(
        H, 0.5 * (mixed + mixed.T), sums[72:78], sums[78:82], scale, centre, sums[82], residual,
        found,
    )  # fmt: skip


def advance(
    weighed: Weighed, a: DeviceSurface, T: Tensor, state: Tensor, share: float
) -> tuple[Tensor, Tensor]:
    """The motion after a step, unless it stands still, and the new state; both are new tensors.

    ``state`` (3,): 1 while there are partners enough, 1 while it moves, steps made. It stands
    still once a step is less than ``share`` of its own sigma.

    The host splits the directions by the eigenvectors of H. Here the split is the spectral
    projector of ``C - SHARED H``, C the part of H that both surfaces share: positive where more
    than that share is common and the slope is above ``WEAK_SLOPE``. Its sign is found by Newton
    and Schulz (Higham, Functions of Matrices, 2008, chapter 5), with matrix products alone.
    """
    T, state = T.clone(), state.clone()
    advance_kernel[(1,)](
        weighed.H, weighed.common, weighed.g, weighed.partners, weighed.centre, a.lever_m, T,
        state, share, WEAK_SLOPE, SHARED, MIN_PARTNERS, SIGN_ROUNDS,
        num_warps=1,
    )  # fmt: skip
    return T, state


def surface_elements(depth: Tensor, sigma: Tensor, intrinsics: Tensor) -> Tensor:
    """(h, w, 6) float32, a plane fitted to the inverse depth of each window."""
    h, w = depth.shape
    out = torch.empty((h, w, 6), device=depth.device)
    surface_kernel[(blocks(h * w, POINTS),)](
        depth, sigma, intrinsics, out, h, w, EDGE_SHARE, MIN_PIXELS, REACH, POINTS
    )
    return out


@triton.jit(do_not_specialize=["height", "width", "min_pixels"])
def surface_kernel(
    depth, sigma, K, out, height, width, edge_share, min_pixels, reach: tl.constexpr,
    PIXELS: tl.constexpr,
):  # fmt: skip
    at = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    here = at < height * width
    v, u = at // width, at % width
    none = tl.full((PIXELS,), 0.0, tl.float64)
    count, su, sv, suu, suv, svv = none, none, none, none, none, none
    sw, sww, suw, svw = none, none, none, none
    for n in tl.static_range((2 * reach + 1) * (2 * reach + 1)):
        dy = n // (2 * reach + 1) - reach
        dx = n % (2 * reach + 1) - reach
        inside = here & (v + dy >= 0) & (v + dy < height) & (u + dx >= 0) & (u + dx < width)
        z = tl.load(depth + at + dy * width + dx, mask=inside, other=0.0).to(tl.float64)
        known = z > 0
        q = tl.where(known, 1.0 / tl.where(known, z, 1.0), 0.0)
        k = known.to(tl.float64)
        count, sw, sww = count + k, sw + q, sww + q * q
        su, suu, suw = su + k * dx, suu + k * (dx * dx), suw + q * dx
        sv, svv, svw = sv + k * dy, svv + k * (dy * dy), svw + q * dy
        suv += k * (dx * dy)
    each = tl.where(count > 0, count, 1.0)
    suu, suv, svv = suu - su * su / each, suv - su * sv / each, svv - sv * sv / each
    suw, svw = suw - su * sw / each, svw - sv * sw / each
    det = suu * svv - suv * suv
    z = tl.load(depth + at, mask=here, other=0.0).to(tl.float64)
    s = tl.load(sigma + at, mask=here, other=0.0).to(tl.float64)
    good = here & (count >= min_pixels) & (det >= 1.0) & (z > 0) & (s > 0)
    det = tl.where(good, det, 1.0)
    along, across = (svv * suw - suv * svw) / det, (suu * svw - suv * suw) / det
    value = (sw - along * su - across * sv) / each
    rest = sww - sw * sw / each - along * suw - across * svw
    rest = tl.maximum(rest / tl.maximum(count - 3, 1.0), 0.0)
    rms = tl.sqrt(rest) * z * z
    good = good & ((rms <= edge_share * z) | (rms <= 3 * s))
    nx, ny = along * tl.load(K), across * tl.load(K + 1)
    nz = value - along * (u.to(tl.float64) - tl.load(K + 2))
    nz -= across * (v.to(tl.float64) - tl.load(K + 3))
    square = nx * nx + ny * ny + nz * nz
    length = 1.0 / tl.sqrt(tl.where(good, square, 1.0))
    to = out + 6 * at
    tl.store(to, tl.where(good, nx * length, 0.0).to(tl.float32), mask=here)
    tl.store(to + 1, tl.where(good, ny * length, 0.0).to(tl.float32), mask=here)
    tl.store(to + 2, tl.where(good, nz * length, 0.0).to(tl.float32), mask=here)
    tl.store(to + 3, tl.where(good, length, 0.0).to(tl.float32), mask=here)
    tl.store(to + 4, tl.where(good, s, 0.0).to(tl.float32), mask=here)
    tl.store(to + 5, tl.where(good, rms, 0.0).to(tl.float32), mask=here)


def scale_of(residual: Tensor, found: Tensor) -> Tensor:
    """() standard deviation of the residuals (N,), of any stride, by their median."""
    out = torch.empty((), dtype=torch.float64, device=residual.device)
    count = len(residual)
    scale_kernel[(1,)](
        residual, found, out, count, residual.stride(0), triton.next_power_of_2(count), num_warps=8
    )
    return out


@triton.jit(do_not_specialize=["count", "stride"])
def scale_kernel(residual, found, out, count, stride, COUNT: tl.constexpr):
    """The mean of the two middle sizes: the middle is between ``low`` and ``high``, ever nearer."""
    i = tl.arange(0, COUNT)
    chosen = tl.load(found + i * stride, mask=i < count, other=0.0) > 0
    size = tl.abs(tl.load(residual + i * stride, mask=i < count, other=0.0))
    size = tl.where(chosen, size, float("inf"))
    many = tl.sum(chosen.to(tl.int32), 0)
    lower, upper = tl.maximum(many - 1, 0) // 2, many // 2
    high = tl.max(tl.where(chosen, size, 0.0), 0)
    low = -1e-3 * high - 1e-300
    for _ in range(40):
        middle = 0.5 * (low + high)
        enough = tl.sum((size <= middle).to(tl.int32), 0) > lower
        high, low = tl.where(enough, middle, high), tl.where(enough, low, middle)
    a = tl.min(tl.where(size > low, size, float("inf")), 0)
    next_one = tl.min(tl.where(size > a, size, float("inf")), 0)
    b = tl.where(tl.sum((size <= a).to(tl.int32), 0) > upper, a, next_one)
    tl.store(out, tl.maximum(0.5 * (a + b) / 0.6745, 1e-3))


@triton.jit
def _moved(points, T, i, here):
    """x, y and z of the points ``i`` (3 numbers each) turned by T, without its shift."""
    x = tl.load(points + 3 * i, mask=here, other=0.0)
    y = tl.load(points + 3 * i + 1, mask=here, other=0.0)
    z = tl.load(points + 3 * i + 2, mask=here, other=0.0)
    u = tl.load(T) * x + tl.load(T + 1) * y + tl.load(T + 2) * z
    v = tl.load(T + 4) * x + tl.load(T + 5) * y + tl.load(T + 6) * z
    w = tl.load(T + 8) * x + tl.load(T + 9) * y + tl.load(T + 10) * z
    return u, v, w


@triton.jit
def _partner(points, normals, sigmas, elements, K, T, i, count, height, width, gate):
    """Where the points ``i`` are, both normals, 1 / sigma, residual and who has a partner."""
    here = i < count
    px, py, pz = _moved(points, T, i, here)
    px, py, pz = px + tl.load(T + 3), py + tl.load(T + 7), pz + tl.load(T + 11)
    nx, ny, nz = _moved(normals, T, i, here)
    sigma = tl.load(sigmas + i, mask=here, other=0.0)
    ahead = pz > 1e-3
    depth = tl.where(ahead, pz, 1.0)
    u = tl.load(K) * px / depth + tl.load(K + 2) + 0.5
    v = tl.load(K + 1) * py / depth + tl.load(K + 3) + 0.5
    found = here & (sigma > 0) & ahead & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    column, row = tl.where(found, u, 0.0).to(tl.int32), tl.where(found, v, 0.0).to(tl.int32)
    e = elements + 6 * (row * width + column)
    ex = tl.load(e).to(tl.float64)
    ey = tl.load(e + 1).to(tl.float64)
    ez = tl.load(e + 2).to(tl.float64)
    es = tl.load(e + 4).to(tl.float64)
    along = ex * px + ey * py + ez * pz
    r = along - tl.load(e + 3).to(tl.float64)
    found = found & (es > 0) & (tl.abs(r) <= gate * pz)
    found = found & (nx * ex + ny * ey + nz * ez >= 0.707)
    spread = tl.abs(along) * tl.sqrt(es * es + sigma * sigma) + 1e-9
    information = tl.where(found, depth / spread, 0.0)
    return px, py, pz, ex, ey, ez, nx, ny, nz, information, tl.where(found, r, 0.0), found


@triton.jit(do_not_specialize=["count", "height", "width"])
def residuals_kernel(
    points, normals, sigmas, elements, K, T, residual, found, count, height, width, gate,
    POINTS: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * POINTS + tl.arange(0, POINTS)
    _x, _y, _z, _a, _b, _c, _d, _e, _f, information, r, partner = _partner(
        points, normals, sigmas, elements, K, T, i, count, height, width, gate
    )
    tl.store(residual + i, r * information, mask=i < count)
    tl.store(found + i, partner.to(tl.float64), mask=i < count)


@triton.jit
def _row(out, a, x, y, z, u, v, w):
    """Store the sums of ``a`` times each of the six."""
    tl.store(out, tl.sum(a * x, 0))
    tl.store(out + 1, tl.sum(a * y, 0))
    tl.store(out + 2, tl.sum(a * z, 0))
    tl.store(out + 3, tl.sum(a * u, 0))
    tl.store(out + 4, tl.sum(a * v, 0))
    tl.store(out + 5, tl.sum(a * w, 0))


@triton.jit
def _products(out, weight, a, b, c, d, e, f, x, y, z, u, v, w):
    """Store the (6, 6) weighted sums of a, b ... f times x, y ... w."""
    _row(out, weight * a, x, y, z, u, v, w)
    _row(out + 6, weight * b, x, y, z, u, v, w)
    _row(out + 12, weight * c, x, y, z, u, v, w)
    _row(out + 18, weight * d, x, y, z, u, v, w)
    _row(out + 24, weight * e, x, y, z, u, v, w)
    _row(out + 30, weight * f, x, y, z, u, v, w)


@triton.jit(do_not_specialize=["count", "height", "width", "tukey"])
def normal_equations_kernel(
    points, normals, sigmas, elements, K, T, centre, scale, partial, count, height, width, gate,
    limit, tukey, POINTS: tl.constexpr, ROW: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * POINTS + tl.arange(0, POINTS)
    px, py, pz, ex, ey, ez, nx, ny, nz, information, r, partner = _partner(
        points, normals, sigmas, elements, K, T, i, count, height, width, gate
    )
    ax, ay, az = tl.load(centre), tl.load(centre + 1), tl.load(centre + 2)
    px -= tl.load(T) * ax + tl.load(T + 1) * ay + tl.load(T + 2) * az + tl.load(T + 3)
    py -= tl.load(T + 4) * ax + tl.load(T + 5) * ay + tl.load(T + 6) * az + tl.load(T + 7)
    pz -= tl.load(T + 8) * ax + tl.load(T + 9) * ay + tl.load(T + 10) * az + tl.load(T + 11)
    sized = r * information
    size = tl.abs(sized)
    most = limit * tl.load(scale)
    share = size / most
    inner = tl.maximum(1.0 - share * share, 0.0)
    huber = tl.minimum(most / tl.maximum(size, 1e-12), 1.0)
    weight = tl.where(tukey != 0, inner * inner, huber) * partner.to(tl.float64)
    a, b, c = py * ez - pz * ey, pz * ex - px * ez, px * ey - py * ex
    x, y, z = py * nz - pz * ny, pz * nx - px * nz, px * ny - py * nx
    both = weight * information * information
    row = partial + tl.program_id(0) * ROW
    _products(row, both, a, b, c, ex, ey, ez, a, b, c, ex, ey, ez)
    _products(row + 36, both, a, b, c, ex, ey, ez, x, y, z, nx, ny, nz)
    _row(row + 72, weight * information * sized, a, b, c, ex, ey, ez)
    squares = weight * sized * sized
    step = tl.maximum(information, 1e-12)
    tl.store(row + 78, tl.sum(weight, 0))
    tl.store(row + 79, tl.sum(squares, 0))
    tl.store(row + 80, tl.sum((weight > 0.1).to(tl.float64), 0))
    tl.store(row + 81, tl.sum(squares / (step * step), 0))
    tl.store(row + 82, tl.sum(partner.to(tl.float64), 0))


@triton.jit
def _product(A, B):
    return tl.sum(A[:, :, None] * B[None, :, :], 1)


@triton.jit
def _total(A):
    return tl.sum(tl.sum(A, 1), 0)


@triton.jit
def _inverse(A, r, c):
    """Of (8, 8), symmetric and positive definite, by Gauss and Jordan."""
    X = tl.where(r == c, 1.0, 0.0).to(tl.float64)
    for k in range(8):
        pivot = _total(tl.where((r == k) & (c == k), A, 0.0))
        row_a = tl.sum(tl.where(r == k, A, 0.0), 0) / pivot
        row_x = tl.sum(tl.where(r == k, X, 0.0), 0) / pivot
        column = tl.sum(tl.where(c == k, A, 0.0) - tl.where((r == k) & (c == k), 1.0, 0.0), 1)
        A -= column[:, None] * row_a[None, :]
        X -= column[:, None] * row_x[None, :]
    return X


@triton.jit(do_not_specialize=["least", "rounds"])
def advance_kernel(
    H, common, g, partners, centre, lever, T, state, share, weak_slope, shared, least,
    rounds,
):  # fmt: skip
    """See :func:`advance`; one program."""
    c = tl.arange(0, 8)
    r, s = c[:, None], c[None, :]
    inside = (r < 6) & (s < 6)
    metres = tl.load(lever)
    unit = tl.where(c < 3, 1.0 / metres, 1.0)
    units = unit[:, None] * unit[None, :]
    at = r * 6 + s
    A = tl.load(H + at, mask=inside, other=0.0) * units
    C = tl.load(common + at, mask=inside, other=0.0) * units
    slope = tl.load(g + c, mask=c < 6, other=0.0) * unit
    eye = tl.where(r == s, 1.0, 0.0).to(tl.float64)
    squared = _product(A, A)
    largest = tl.sqrt(tl.sqrt(_total(squared * squared))) + 1e-30
    sign = (C - shared * A) / largest - (1.0 - shared) * weak_slope * weak_slope * eye
    for _ in range(rounds):
        sign = 1.5 * sign - 0.5 * _product(_product(sign, sign), sign)
    P = 0.5 * (eye + sign)
    inverse = _inverse(_product(_product(P, A), P) + largest * (eye - P), r, s)
    along = tl.sum(P * slope[None, :], 1)
    along = tl.sum(inverse * along[None, :], 1)
    twist = -unit * tl.sum(P * along[None, :], 1)
    good = _total(tl.where(r == s, twist[:, None], 0.0))
    twist = tl.where(good - good == 0.0, twist, 0.0)
    spread = tl.sum(tl.where(r == s, _product(_product(P, inverse), P), 0.0), 1)
    sigma = tl.sqrt(tl.maximum(tl.max(spread, 0), 0.0))
    x = tl.sum(tl.where(c == 0, twist, 0.0), 0)
    y = tl.sum(tl.where(c == 1, twist, 0.0), 0)
    z = tl.sum(tl.where(c == 2, twist, 0.0), 0)
    angle = x * x + y * y + z * z
    moved = tl.sum(tl.where((c > 2) & (c < 6), twist * twist, 0.0), 0)
    far = tl.sqrt(tl.maximum(angle * metres * metres, moved))
    enough = tl.load(partners) >= least
    overlap = tl.load(state) * enough.to(tl.float64)
    moving = tl.load(state + 1) * overlap
    # Sine and cosine to 1e-13 for steps of 0.3 rad; larger ones are rejected in the end.
    p = 1 - angle / 6 * (1 - angle / 20 * (1 - angle / 42 * (1 - angle / 72)))
    q = 0.5 * (1 - angle / 12 * (1 - angle / 30 * (1 - angle / 56 * (1 - angle / 90))))
    d = tl.arange(0, 4)
    i, j = d[:, None], d[None, :]
    turn = tl.where((i == 0) & (j == 1), -z, 0.0) + tl.where((i == 0) & (j == 2), y, 0.0)
    turn += tl.where((i == 1) & (j == 0), z, 0.0) + tl.where((i == 1) & (j == 2), -x, 0.0)
    turn += tl.where((i == 2) & (j == 0), -y, 0.0) + tl.where((i == 2) & (j == 1), x, 0.0)
    R = tl.where(i == j, 1.0, 0.0) + p * turn + q * _product(turn, turn)
    middle = tl.load(centre + d, mask=d < 3, other=0.0)
    push = tl.load(centre + d, mask=d < 3, other=0.0) - tl.sum(R * middle[None, :], 1)
    for k in range(3):
        push += tl.where(d == k, tl.sum(tl.where(c == 3 + k, twist, 0.0), 0), 0.0)
    step = tl.where((j == 3) & (i < 3), push[:, None], R)
    before = tl.load(T + 4 * i + j)
    after = _product(step, before)
    tl.store(T + 4 * i + j, tl.where(moving > 0, after, before))
    tl.store(state, overlap)
    tl.store(state + 1, tl.where(far < tl.maximum(share * sigma, 1e-7), 0.0, moving))
    tl.store(state + 2, tl.load(state + 2) + moving)
