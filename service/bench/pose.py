"""The pose of a camera from 900 points, against OpenCV; and matching with pose as a frame runs."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np

from recon import se3
from recon.camera_model import rays
from recon.tracking import pnp
from recon.tracking.matching import MatchingConfig, Pyramid, harris_grid, match
from recon.types import F64
from service.bench import BenchOptions, BenchResult, compare
from service.bench.matching import RADIUS_PX, SHIFT_PX, SIZE, pictures

K: F64 = np.array([[930.0, 0, 639.5], [0, 930.0, 359.5], [0, 0, 1.0]])


def run(options: BenchOptions) -> list[BenchResult]:
    """Milliseconds and centimetres of EPnP in RANSAC with refinement, ours and OpenCV's."""
    points, uv, T = scene(0)
    prior = se3.exp(np.array([0.002, -0.003, 0.004, 0.2, -0.3, 0.1])) @ T
    return [
        compare(
            "pose", "900 points, 15 % wrong", partial(pnp.solve, points, uv, K, None, prior),
            options, "OpenCV RANSAC EPnP + LM", partial(by_opencv, points, uv),
            note="ours with covariance",
        ),
        position_error(),
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


def position_error() -> BenchResult:
    """Mean error of the camera's place over twenty scenes."""
    ours, theirs = [], []
    for seed in range(20):
        points, uv, T = scene(seed)
        result = pnp.solve(points, uv, K)
        truth = se3.inverse(T)[:3, 3]
        if result is not None:
            ours.append(se3.inverse(result.T_camera_points)[:3, 3] - truth)
        theirs.append(se3.inverse(by_opencv(points, uv))[:3, 3] - truth)
    mean = [100 * float(np.linalg.norm(e, axis=1).mean()) for e in (ours, theirs)]
    return BenchResult(
        "pose", "place of the camera, mean of 20", mean[0], "cm", 0.0, "OpenCV RANSAC EPnP + LM",
        mean[1], note=f"{len(ours)} of 20 solved",
    )  # fmt: skip


def frame(options: BenchOptions) -> BenchResult:
    """Milliseconds of what every frame costs: pyramid, matches of 900 landmarks, pose."""
    a, b = pictures()
    config = MatchingConfig()
    key, uv = Pyramid.build(a), harris_grid(a, config).uv_px.astype(np.float64)
    landmarks = rays(K, uv) * 60.0  # flat ground: the shift is a motion along it
    prior = se3.compose(np.eye(3), np.array([0.05, 0.05, 0.02]))

    def one() -> None:
        new = Pyramid.build(b)
        found = match(key, uv, new, uv, RADIUS_PX, None, config)
        seen = found.uv_px[found.ok].astype(np.float64)
        if pnp.solve(landmarks[found.ok], seen, K, None, prior) is None:
            raise RuntimeError("the benchmark's own frame was not solved")

    what = f"matching + pose of a {SIZE[1]}x{SIZE[0]} frame"
    note = f"shift {np.linalg.norm(SHIFT_PX):.0f} px; goal 10 ms"
    return compare("pose", what, one, options, note=note)
