"""Corners, matches and the camera's pose on a 1280x720 pair, against OpenCV."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np
from scipy.ndimage import fourier_shift

from recon import se3
from recon.camera_model import rays
from recon.tracking import pnp
from recon.tracking.matching import MatchingConfig, build_pyramid, harris_grid, match
from recon.tracking.sift_features import FeatureMatches, features, match_features
from recon.types import F32, F64, U8
from service.bench import BenchOptions, BenchResult, compare
from service.bench.keyframes import natural

SIZE = (720, 1280)
SHIFT_PX = np.array([23.4, -17.7])
RADIUS_PX = 38.0  # what the odometry searches around a fair prediction
NOISE = 2.0  # gray levels


def run(options: BenchOptions) -> list[BenchResult]:
    """Milliseconds for 900 corners and their matches.

    The peers are OpenCV's corner detector and its pyramidal Lucas-Kanade tracker run forward
    and backward, with windows and levels that reach as far.
    """
    a, b = images()
    config = MatchingConfig()
    corners = np.ascontiguousarray(harris_grid(a, config)[:, :2])
    points = corners[:, None]
    return [
        compare(
            "corners, 1280x720, 30x30 grid", partial(harris_grid, a, config), options,
            "OpenCV goodFeaturesToTrack",
            partial(cv2.goodFeaturesToTrack, a, 900, 0.001, 15, useHarrisDetector=True, k=0.04),
        ),
        compare(
            f"match {len(corners)} corners, radius {RADIUS_PX:.0f} px",
            partial(matched, a, b, corners, config), options,
            "OpenCV PyrLK both ways", partial(tracked, a, b, points),
            note="pyramids included",
        ),
        compare(
            "common view without a prior", partial(shared, a, b), options
        ),
    ]  # fmt: skip


def shared(a: U8, b: U8) -> FeatureMatches | None:
    """Correspondences of two images, their features included."""
    return match_features(features(a), features(b))


def images() -> tuple[U8, U8]:
    """Two noisy views of one texture with detail at every scale, shifted by SHIFT_PX."""
    rng = np.random.default_rng(0)
    h, w = SIZE[0] + 128, SIZE[1] + 128
    total = 128 + 55 * natural(h, w, 1.3, 0)
    moved = np.fft.ifft2(fourier_shift(np.fft.fft2(total), -SHIFT_PX[::-1])).real
    return noisy(total, rng), noisy(moved, rng)


def noisy(scene: F64, rng: np.random.Generator) -> U8:
    """The middle of the scene as a camera with noise sees it."""
    view = scene[64 : 64 + SIZE[0], 64 : 64 + SIZE[1]]
    seen = view + rng.normal(size=SIZE) * NOISE
    return np.asarray(np.clip(np.round(seen), 0, 255), np.uint8)


def matched(a: U8, b: U8, corners: F32, config: MatchingConfig) -> tuple[F32, F32]:
    """Pixels in a and b of the corners that ours found."""
    found = match(build_pyramid(a), corners, build_pyramid(b), corners, RADIUS_PX, None, config)
    return corners[found.ok], found.uv_px[found.ok]


def tracked(a: U8, b: U8, points: F32) -> tuple[F32, F32]:
    """Pixels in a and b of the corners that OpenCV's tracker found both ways."""
    window = {"winSize": (11, 11), "maxLevel": 3}
    there, ok, _ = cv2.calcOpticalFlowPyrLK(a, b, points, None, **window)  # type: ignore[call-overload]
    back, ok_back, _ = cv2.calcOpticalFlowPyrLK(b, a, there, None, **window)  # type: ignore[call-overload]
    near = np.linalg.norm(back - points, axis=2)[:, 0] < 0.5
    good = near & (ok[:, 0] > 0) & (ok_back[:, 0] > 0)
    return points[good, 0], there[good, 0]


K: F64 = np.array([[930.0, 0, 639.5], [0, 930.0, 359.5], [0, 0, 1.0]])


def run_pose(options: BenchOptions) -> list[BenchResult]:
    """Milliseconds of EPnP in RANSAC with refinement, ours and OpenCV's, and of a frame."""
    points, uv, T = scene(0)
    prior = se3.exp(np.array([0.002, -0.003, 0.004, 0.2, -0.3, 0.1])) @ T
    return [
        compare(
            "900 points, 15 % wrong", partial(pnp.solve, points, uv, K, prior),
            options, "OpenCV RANSAC EPnP + LM", partial(by_opencv, points, uv),
            note="ours with covariance",
        ),
        frame(options),
    ]  # fmt: skip


def scene(seed: int) -> tuple[F64, F64, F64]:
    """Points (900, 3) 50 to 62 m below, their pixels with 0.3 px noise and 15 % wild, the pose."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform([10, 10], [1270, 710], (900, 2))
    T = se3.exp(np.concatenate([rng.normal(size=3), rng.normal(size=3) * 20]))
    depth = rng.uniform(50, 62, (900, 1))
    points = se3.transform(se3.inverse(T), rays(K, uv) * depth)
    seen = uv + rng.normal(size=uv.shape) * 0.3
    wild = rng.random(900) < 0.15
    seen[wild] = rng.uniform([0, 0], [1280, 720], (int(wild.sum()), 2))
    return points, seen, T


def by_opencv(points: F64, uv: F64) -> F64:
    """(4, 4) pose by OpenCV's own functions with the same thresholds."""
    _, rvec, tvec, inliers = cv2.solvePnPRansac(
        points, uv, K, None, flags=cv2.SOLVEPNP_EPNP, reprojectionError=2.0, iterationsCount=200,
        confidence=0.9999,
    )  # fmt: skip
    kept = np.asarray(inliers)[:, 0]
    rvec, tvec = cv2.solvePnPRefineLM(points[kept], uv[kept], K, None, rvec, tvec)
    R = np.asarray(cv2.Rodrigues(rvec)[0], np.float64)
    return se3.compose(R, np.asarray(tvec, np.float64).ravel())


def frame(options: BenchOptions) -> BenchResult:
    """Milliseconds of what every frame costs: pyramid, matches of 900 landmarks, pose."""
    a, b = images()
    config = MatchingConfig()
    key, uv = build_pyramid(a), harris_grid(a, config)[:, :2].astype(np.float64)
    landmarks = rays(K, uv) * 60.0  # flat ground: the shift is a motion along it
    prior = se3.compose(np.eye(3), np.array([0.05, 0.05, 0.02]))

    def one() -> None:
        new = build_pyramid(b)
        found = match(key, uv, new, uv, RADIUS_PX, None, config)
        seen = found.uv_px[found.ok].astype(np.float64)
        if pnp.solve(landmarks[found.ok], seen, K, prior) is None:
            raise RuntimeError("the benchmark's own frame was not solved")

    what = f"matching + pose of a {SIZE[1]}x{SIZE[0]} frame"
    note = f"shift {np.linalg.norm(SHIFT_PX):.0f} px; goal 10 ms"
    return compare(what, one, options, note=note)
