"""Intrinsics and lens distortion from images of a chessboard.

The corners come from OpenCV's detectors; the model is fitted by its bundle adjustment after
Zhang (2000, DOI 10.1109/34.888718). Radial distortion only,
as in the paper (section 2.1), unless tangential is asked for. Views that do not fit the
others are left out, each with the reason.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from recon.tracking.robust_geometry import attempt
from recon.types import F32, F64, U8, Camera

MIN_VIEWS = 4
OUTLIER_RATIO = 3.0  # of a view's rms to the median view's
OUTLIER_FLOOR_PX = 0.5  # views better than this are never left out


@dataclass(frozen=True, slots=True)
class Board:
    """A chessboard: inner corners along its two sides, and the side of a square."""

    columns: int
    rows: int
    square_m: float

    def __post_init__(self) -> None:
        if not (3 <= self.columns <= 100 and 3 <= self.rows <= 100):
            raise ValueError(f"a board of {self.columns}x{self.rows} inner corners is too small")
        if not (np.isfinite(self.square_m) and 0 < self.square_m < 10):
            raise ValueError(f"squares of {self.square_m:g} m are not within 0 to 10 m")

    def points_m(self) -> F32:
        """(N, 3) corners on the board, row by row, z = 0."""
        i, j = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        plane = np.stack([i.ravel(), j.ravel(), np.zeros(i.size)], axis=1) * self.square_m
        return np.asarray(plane, np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class BoardView:
    """The corners of the board in one image."""

    name: str
    corners_px: F32  # (N, 2), in the board's order


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    camera: Camera
    rms_px: float  # over all corners of the views used
    used: tuple[str, ...]
    view_rms_px: F64  # (V,) of the views used
    rejected: tuple[tuple[str, str], ...]  # (name, reason)
    sigma_focal_px: float  # 1 sigma, the larger of fx and fy
    coverage: float  # share of the image's 8x6 cells with a corner in it
    warnings: tuple[str, ...]


AS_WELL = 1.02  # a model fits as well as another if its rms is at most so many times the other's


def find_board(gray: U8, board: Board) -> F32 | None:
    """(N, 2) corners of the board in a gray image, sub-pixel, or None when it is not there.

    The classic detector finds more real boards; the sector-based one (Duda and Frese 2018)
    is asked where it finds none. Both are refined to the saddle points.
    """
    pattern = (board.columns, board.rows)
    classic = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, corners = cv2.findChessboardCorners(gray, pattern, flags=classic)
    if not found:
        sector = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
        found, corners = cv2.findChessboardCornersSB(gray, pattern, flags=sector)
    if not found or len(corners) != board.columns * board.rows:
        return None
    points = _refined(gray, np.asarray(corners, np.float32), pattern).reshape(-1, 2)
    return points if np.isfinite(points).all() else None


def _refined(gray: U8, corners: F32, pattern: tuple[int, int]) -> F32:
    """Corners moved to the saddle points; the window stays within a square."""
    grid = corners.reshape(pattern[1], pattern[0], 2)
    along = np.linalg.norm(np.diff(grid, axis=1), axis=2).min()
    across = np.linalg.norm(np.diff(grid, axis=0), axis=2).min()
    half = int(np.clip(0.35 * min(along, across), 2, 11))
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
    return np.asarray(cv2.cornerSubPix(gray, corners, (half, half), (-1, -1), stop), np.float32)


def calibrate(
    views: Sequence[BoardView], board: Board, size_px: tuple[int, int], tangential: bool = False
) -> Calibration | None:
    """The camera of ``size_px`` (W, H) that took the views, or None when it cannot be fitted.
    Raises ValueError for fewer than four views."""
    if len(views) < MIN_VIEWS:
        raise ValueError(f"{len(views)} views of the board are too few; at least {MIN_VIEWS}")
    kept = list(views)
    rejected: list[tuple[str, str]] = []
    while True:
        fit = _fit(kept, board, size_px, tangential)
        if fit is None:
            return None
        rms, K, distortion, sigma, per_view = fit
        usual = float(np.median(per_view))
        worst = int(np.argmax(per_view))
        limit = max(OUTLIER_RATIO * usual, OUTLIER_FLOOR_PX)
        if per_view[worst] <= limit or len(kept) <= MIN_VIEWS:
            break
        reason = f"rms {per_view[worst]:.2f} px where the median view has {usual:.2f} px"
        rejected.append((kept.pop(worst).name, reason))
    coverage = _coverage(kept, size_px)
    return Calibration(
        camera=Camera(K, distortion, size_px, sigma_focal=sigma / float(K[0, 0])),
        rms_px=rms,
        used=tuple(view.name for view in kept),
        view_rms_px=per_view,
        rejected=tuple(rejected),
        sigma_focal_px=sigma,
        coverage=coverage,
        warnings=_warnings(kept, K, sigma, coverage, distortion, size_px),
    )


def _fit(
    views: Sequence[BoardView], board: Board, size_px: tuple[int, int], tangential: bool
) -> tuple[float, F64, F64, float, F64] | None:
    """(rms, K, distortion, sigma of the focal length, rms per view), or None.

    Corners that stay away from the image's edge leave the highest radial terms open: of a model
    that folds over within the image, those without which the corners fit as well are left out.
    """
    flags = 0 if tangential else cv2.CALIB_ZERO_TANGENT_DIST
    found = _fit_terms(views, board, size_px, flags)
    for fewer in (cv2.CALIB_FIX_K3, cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3):
        if found is None or _monotonic(found[2], found[1], size_px):
            break
        other = _fit_terms(views, board, size_px, flags | fewer)
        if other is not None and other[0] < AS_WELL * found[0]:
            found = other
    return found


def _fit_terms(
    views: Sequence[BoardView], board: Board, size_px: tuple[int, int], flags: int
) -> tuple[float, F64, F64, float, F64] | None:
    """As :func:`_fit`, with OpenCV's ``flags``."""
    objects = [board.points_m()] * len(views)
    images = [view.corners_px.reshape(-1, 1, 2) for view in views]
    start, unbent = np.eye(3), np.zeros(5)
    found = attempt(
        lambda: cv2.calibrateCameraExtended(objects, images, size_px, start, unbent, flags=flags)
    )
    if found is None:
        return None
    rms, K, distortion, _, _, sigma, _, per_view = found
    distortion = np.asarray(distortion, np.float64).ravel()[:5]
    if not (np.isfinite(K).all() and np.isfinite(distortion).all() and K[0, 0] > 0 < K[1, 1]):
        return None
    focal_sigma = float(np.max(np.asarray(sigma).ravel()[:2]))
    each = np.asarray(per_view, np.float64).ravel()
    return float(rms), np.asarray(K, np.float64), distortion, focal_sigma, each


def _coverage(views: Sequence[BoardView], size_px: tuple[int, int]) -> float:
    """Share of 8x6 cells of the image that hold a corner."""
    uv = np.concatenate([view.corners_px for view in views])
    cells = (uv / size_px * (8, 6)).astype(int).clip(0, (7, 5))
    return len(np.unique(cells, axis=0)) / 48


def _warnings(
    views: Sequence[BoardView],
    K: F64,
    sigma: float,
    coverage: float,
    distortion: F64,
    size_px: tuple[int, int],
) -> tuple[str, ...]:
    out = []
    if len(views) < 10:
        out.append(f"only {len(views)} views were used; 15 or more give a more accurate result")
    if coverage < 0.6:
        out.append(
            f"corners cover {coverage:.0%} of the image; the distortion is a guess in the rest"
        )
    if sigma > 0.01 * K[0, 0]:
        out.append(f"the focal length is uncertain by {sigma / K[0, 0]:.1%}; tilt the board more")
    if not _monotonic(distortion, K, size_px):
        out.append("the distortion folds over within the image; show the board near the corners")
    return tuple(out)


def _monotonic(distortion: F64, K: F64, size_px: tuple[int, int]) -> bool:
    """True when the radial model grows all the way to the image's corner."""
    corner = max(
        float(np.hypot((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]))
        for u in (0, size_px[0] - 1)
        for v in (0, size_px[1] - 1)
    )
    return fold(distortion)[1] > corner


def fold(distortion: F64) -> tuple[float, float]:
    """Radius up to which the radial model grows, without and with it; (4, inf) if up to there."""
    r = np.linspace(0.0, 4.0, 4000)
    bent = r * (1 + distortion[0] * r**2 + distortion[1] * r**4 + distortion[4] * r**6)
    turn = np.flatnonzero(np.diff(bent) <= 0)
    return (float(r[turn[0]]), float(bent[turn[0]])) if len(turn) else (4.0, np.inf)
