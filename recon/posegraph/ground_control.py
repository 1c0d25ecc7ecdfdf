"""All keyframes of a scan adjusted at once, with surveyed points on the ground.

One batch over poses and the scale of each stretch (Levenberg-Marquardt of GTSAM): the motions
between keyframes as vision had them, loops, telemetry or the placing it once gave, and ground
control points. A control point is seen in images: each mark gives a direction and, where the
keyframe has a surface there, a distance. The point itself is unknown within its survey's
sigma. Check points take no part; :func:`map_position` says where the map has them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from recon import se3
from recon.posegraph import factors as graph_factors
from recon.posegraph.factors import matrix, pose3
from recon.posegraph.records import loops_agree
from recon.posegraph.smoother import left_covariance
from recon.types import F64, Bool, PosePrior

CHI2_LIMIT = 22.5
"""99.9 % of chi-square with six degrees of freedom: loops beyond it are left out."""

ATTITUDE_S, FIX_S = 40.0, 60.0
"""Errors of attitude and fixes wander with these time constants."""


@dataclass(frozen=True, slots=True)
class BatchConfig:
    """How far each kind of knowledge is trusted."""

    sigma_step: float = 0.003  # of one motion, as a share of its length
    sigma_step_m: float = 0.01
    sigma_turn_rad: float = 5e-4  # of one motion
    sigma_scale: float = 0.02  # of the whole scan, as a share
    sigma_scale_walk: float = 0.003  # between stretches
    stretch: int = 20  # keyframes that share a scale
    break_s: float = 10.0  # a longer pause between keyframes is a break of vision
    sigma_break_m: float = 5.0
    sigma_break_rad: float = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Mark:
    """A point as one image sees it."""

    point: int  # which, of the list of points
    keyframe: int  # which, of the list of keyframes
    ray: F64  # (3,) in the image's camera, z = 1
    sigma: float  # of the direction, rad
    depth_m: float | None = None  # along z, of the keyframe's surface there
    sigma_depth_m: float = 1.0
    T_key_camera: F64 = field(default_factory=lambda: np.eye(4))  # for images between keyframes


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """A surveyed point in the world."""

    position_m: F64  # (3,)
    sigma_m: F64  # (3,)


@dataclass(frozen=True, slots=True, eq=False)
class Closure:
    """A motion seen between two keyframes that are far apart in time."""

    a: int  # which, of the list of keyframes
    b: int
    T_a_b: F64  # (4, 4) m
    covariance: F64  # (6, 6) left perturbation in a's frame


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """The keyframes as they are before."""

    poses: F64  # (N, 4, 4) T_world_camera
    times_s: F64  # (N,)
    covariances: F64  # (N, 6, 6) left perturbation in the world; they err together
    priors: Sequence[PosePrior] = ()  # of each keyframe; without them the poses are the prior
    loops: Sequence[Closure] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """The keyframes as they are after."""

    poses: F64  # (N, 4, 4)
    covariances: F64  # (N, 6, 6) left perturbation in the world
    scales: F64  # (N,) what depths are multiplied by
    residuals: dict[str, F64]  # whitened, by kind of factor, (n, dimension) each
    loops_refused: tuple[int, ...]  # positions in the track's list


def adjust(
    track: Track,
    points: Sequence[Point] = (),
    marks: Sequence[Mark] = (),
    config: BatchConfig | None = None,
) -> Adjusted:
    """The adjustment of a track with control points; loops that contradict it are left out.

    Raises ValueError for fewer than two keyframes or shapes that do not fit.
    """
    n = len(track.poses)
    if n < 2 or track.poses.shape != (n, 4, 4) or track.covariances.shape != (n, 6, 6):
        raise ValueError(f"expected two poses (N, 4, 4) or more, got {track.poses.shape}")
    if len(track.times_s) != n or (track.priors and len(track.priors) != n):
        raise ValueError("times and priors must be as many as poses")
    loops = list(range(len(track.loops)))
    problem = _Batch(track, loops, points, marks, config or BatchConfig())
    chi2 = np.sum(problem.residuals().get("loop", np.zeros((0, 6))) ** 2, axis=1)
    refused = tuple(k for k, value in zip(loops, chi2, strict=True) if value > CHI2_LIMIT)
    if refused:
        loops = [k for k in loops if k not in refused]
        problem = _Batch(track, loops, points, marks, config or BatchConfig())
    return Adjusted(*problem.states(), problem.residuals(), refused)


def supported(loops: Sequence[Closure], poses: F64, window: int = 15) -> list[Closure]:
    """Those loops that another one confirms, whose ends lie within ``window`` keyframes.

    Both, joined by the track between their ends (trusted to 3 % of its length), must close on
    themselves. Repeated texture gives perfect matches at the wrong place, but not twice alike.
    """
    out = []
    for one in loops:
        for other in loops:
            near = abs(one.a - other.a) <= window and abs(one.b - other.b) <= window
            if near and (one.a, one.b) != (other.a, other.b) and _agree(one, other, poses):
                out.append(one)
                break
    return out


def _agree(one: Closure, other: Closure, poses: F64) -> bool:
    T_a_a = se3.inverse(poses[one.a]) @ poses[other.a]
    T_b_b = se3.inverse(poses[other.b]) @ poses[one.b]
    return loops_agree(one, other, T_a_a, T_b_b, CHI2_LIMIT)


def map_position(poses: F64, scales: F64, marks: Sequence[Mark]) -> tuple[F64, float] | None:
    """(3,) where the map has a point, and its sigma in metres; None when it has it nowhere.

    The surface at the marks, weighted; where no mark has one, the rays' nearest point.
    """
    seen = [m for m in marks if m.depth_m is not None]
    if not seen:
        return _crossing(poses, marks)
    spots = np.array([surface_point(poses, scales, m) for m in seen])
    sigma = np.array([np.hypot(m.sigma_depth_m, m.sigma * (m.depth_m or 0.0)) for m in seen])
    weight = 1.0 / np.maximum(sigma, 1e-3) ** 2
    middle = np.median(spots, axis=0)
    weight /= 1.0 + (np.linalg.norm(spots - middle, axis=1) / (3.0 * sigma)) ** 2
    return np.asarray(weight @ spots / weight.sum()), float(1.0 / np.sqrt(weight.sum()))


def surface_point(poses: F64, scales: F64, mark: Mark) -> F64:
    """(3,) world point of the surface at a mark. Raises ValueError for a mark without one."""
    if mark.depth_m is None:
        raise ValueError("the mark has no depth")
    here = scales[mark.keyframe] * mark.depth_m * mark.ray
    return np.asarray(se3.transform(poses[mark.keyframe] @ mark.T_key_camera, here[None])[0])


def _crossing(poses: F64, marks: Sequence[Mark]) -> tuple[F64, float] | None:
    """The point nearest to all rays; None when they are too nearly parallel."""
    H, g = np.zeros((3, 3)), np.zeros(3)
    for mark in marks:
        T = poses[mark.keyframe] @ mark.T_key_camera
        way = T[:3, :3] @ (mark.ray / np.linalg.norm(mark.ray))
        across = np.eye(3) - np.outer(way, way)
        H += across
        g += across @ T[:3, 3]
    values = np.linalg.eigvalsh(H)
    if len(marks) < 2 or values[0] < 1e-3 * len(marks):  # about two degrees
        return None
    found = np.asarray(np.linalg.solve(H, g), np.float64)
    far = float(np.mean([np.linalg.norm(found - poses[m.keyframe][:3, 3]) for m in marks]))
    return found, marks[0].sigma * far / float(np.sqrt(values[0]))


def consenting(surveyed_m: F64, mapped_m: F64, sigma_m: F64) -> Bool:
    """(N,) True for the largest set of points whose offsets from the map agree.

    A map is off by nearly the same everywhere: what two points' offsets (N, 3) may differ by
    is their sigmas (N,), 1 % of the distance between them and 0.1 m.
    """
    offset = surveyed_m - mapped_m
    apart = np.linalg.norm(offset[:, None] - offset[None], axis=2)
    between = np.linalg.norm(mapped_m[:, None] - mapped_m[None], axis=2)
    allowed = 4.0 * np.hypot(sigma_m[:, None], sigma_m[None]) + 0.01 * between + 0.1
    agree = apart <= allowed
    best = max(range(len(agree)), key=lambda k: (int(agree[k].sum()), -float(apart[k].sum())))
    return np.asarray(agree[best])


def placed_by_points(mapped_m: F64, surveyed_m: F64) -> tuple[float, F64, F64] | None:
    """Scale, (3, 3) rotation and (3,) shift from the map to the survey, (N, 3) each.

    Umeyama 1991, doi:10.1109/34.88573. None for fewer than three points or points in a line.
    """
    if len(mapped_m) < 3:
        return None
    a, b = mapped_m - mapped_m.mean(axis=0), surveyed_m - surveyed_m.mean(axis=0)
    spread = np.linalg.svd(a, compute_uv=False)
    if spread[1] < 0.05 * spread[0]:
        return None
    U, _, Vt = np.linalg.svd(b.T @ a)
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    scale = float(np.sum(b * (a @ R.T)) / np.sum(a**2))
    return scale, R, np.asarray(surveyed_m.mean(axis=0) - scale * R @ mapped_m.mean(axis=0))


def mark_error(mark: Mark) -> Any:
    """Error function of (pose, point[, log scale]): direction and, if known, distance."""
    R_camera_key = mark.T_key_camera[:3, :3].T
    t_key_camera = mark.T_key_camera[:3, 3]
    sigma, depth = mark.sigma, mark.depth_m

    def error(factor: Any, values: Any, jacobians: Any) -> F64:
        keys = factor.keys()
        pose = values.atPose3(keys[0])
        R = pose.rotation().matrix()
        in_key = R.T @ (values.atPoint3(keys[1]) - pose.translation())
        p = R_camera_key @ (in_key - t_key_camera)
        z = max(float(p[2]), 1e-3)
        rows = [(p[:2] / z - mark.ray[:2]) / sigma]
        D = np.array([[1.0 / z, 0.0, -p[0] / z**2], [0.0, 1.0 / z, -p[1] / z**2]]) / sigma
        if depth is not None:
            grown = depth * float(np.exp(values.atVector(keys[2])[0]))
            rows.append(np.array([(p[2] - grown) / mark.sigma_depth_m]))
            D = np.vstack([D, [0.0, 0.0, 1.0 / mark.sigma_depth_m]])
        if jacobians is not None:
            D = D @ R_camera_key
            jacobians[0] = np.hstack([D @ se3.hat(in_key), -D])
            jacobians[1] = D @ R.T
            if depth is not None:
                jacobians[2] = np.array([[0.0], [0.0], [-grown / mark.sigma_depth_m]])
        return np.concatenate(rows)

    return error


class _Batch:
    """The factors of one adjustment and its solution."""

    def __init__(
        self, track: Track, loops: Sequence[int], points: Sequence[Point], marks: Sequence[Mark],
        config: BatchConfig,
    ) -> None:  # fmt: skip
        import gtsam

        self._gtsam, self._track, self._config = gtsam, track, config
        self._graph, self._start = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._kinds: list[str] = []
        self._noises: list[Any] = []
        for key, T in enumerate(track.poses):
            self._start.insert(key, pose3(T))
        self._add_scales()
        for key in range(1, len(track.poses)):
            self._add_step(key)
        self._add_telemetry() if track.priors else self._add_placing()
        for k in loops:
            self._add_loop(track.loops[k])
        self._add_points(points, marks)
        settings = gtsam.LevenbergMarquardtParams()
        settings.setMaxIterations(60)
        settings.setRelativeErrorTol(1e-7)
        solver = gtsam.LevenbergMarquardtOptimizer(self._graph, self._start, settings)
        self._values: Any = solver.optimize()

    def states(self) -> tuple[F64, F64, F64]:
        """Poses (N, 4, 4), left covariances (N, 6, 6) and scales (N,)."""
        n = len(self._track.poses)
        marginals = self._gtsam.Marginals(self._graph, self._values)
        poses = np.array([matrix(self._values.atPose3(key)) for key in range(n)])
        spread = [
            left_covariance(T, np.asarray(marginals.marginalCovariance(key)))
            for key, T in enumerate(poses)
        ]
        logs = [float(self._values.atVector(self._scale_key(key))[0]) for key in range(n)]
        return poses, np.array(spread), np.exp(logs)

    def residuals(self) -> dict[str, F64]:
        """Whitened residuals by kind, without the robust losses."""
        out: dict[str, list[F64]] = {}
        for i, kind in enumerate(self._kinds):
            error = graph_factors.whitened(self._graph.at(i), self._noises[i], self._values)
            out.setdefault(kind, []).append(np.pad(error, (0, 6 - len(error))))
        return {kind: np.array(rows) for kind, rows in out.items()}

    # ---- factors ---------------------------------------------------------------------------

    def _add(self, factor: Any, kind: str, noise: Any = None) -> None:
        """``noise`` is the factor's noise model without a robust loss, when it has one."""
        self._graph.add(factor)
        self._kinds.append(kind)
        self._noises.append(noise or factor.noiseModel())

    def _robust(self, noise: Any, loss: str = "Huber", at: float = 1.5) -> Any:
        model = self._gtsam.noiseModel
        return model.Robust.Create(getattr(model.mEstimator, loss).Create(at), noise)

    def _scale_key(self, key: int) -> int:
        return int(self._gtsam.symbol("s", key // self._config.stretch))

    def _add_scales(self) -> None:
        one, gtsam = self._gtsam.noiseModel.Isotropic, self._gtsam
        keys = sorted({self._scale_key(key) for key in range(len(self._track.poses))})
        for before, key in zip([None, *keys], keys, strict=False):
            self._start.insert(key, np.zeros(1))
            if before is None:
                noise = one.Sigma(1, self._config.sigma_scale)
                self._add(gtsam.PriorFactorVector(key, np.zeros(1), noise), "scale")
            else:
                noise = one.Sigma(1, self._config.sigma_scale_walk)
                self._add(gtsam.BetweenFactorVector(before, key, np.zeros(1), noise), "scale")

    def _add_step(self, key: int) -> None:
        """The motion from the keyframe before, as vision and ICP had it."""
        track, c = self._track, self._config
        motion = se3.inverse(track.poses[key - 1]) @ track.poses[key]
        length = float(np.linalg.norm(motion[:3, 3]))
        turn, shift, kind = c.sigma_turn_rad, c.sigma_step * length + c.sigma_step_m, "vision"
        pause = float(track.times_s[key] - track.times_s[key - 1])
        if pause > c.break_s:
            turn, shift, kind = c.sigma_break_rad, c.sigma_break_m * pause / c.break_s, "link"
        noise = self._gtsam.noiseModel.Diagonal.Sigmas(np.array([turn] * 3 + [shift] * 3))
        keys = [key - 1, key, self._scale_key(key - 1)]
        error = graph_factors.scaled_motion_error(motion)
        self._add(self._gtsam.CustomFactor(noise, keys, error), kind)

    def _add_loop(self, loop: Closure) -> None:
        noise = self._gtsam.noiseModel.Gaussian.Covariance(
            graph_factors.right_covariance(loop.T_a_b, loop.covariance)
        )
        keys = [loop.a, loop.b, self._scale_key(loop.a)]
        error = graph_factors.scaled_motion_error(loop.T_a_b)
        self._add(self._gtsam.CustomFactor(self._robust(noise), keys, error), "loop", noise)

    def _add_placing(self) -> None:
        """The poses' own covariances: they err together, so each counts one N-th."""
        n = len(self._track.poses)
        for key, (T, spread) in enumerate(
            zip(self._track.poses, self._track.covariances, strict=True)
        ):
            floor = np.diag([1e-8] * 3 + [1e-6] * 3)
            right = graph_factors.right_covariance(T, n * (spread + floor))
            noise = self._gtsam.noiseModel.Gaussian.Covariance(0.5 * (right + right.T))
            self._add(self._gtsam.PriorFactorPose3(key, pose3(T), noise), "placing")

    def _add_telemetry(self) -> None:
        """Attitude and fixes; sigmas grow as their errors wander slowly (cf. graph_readings)."""
        gtsam, times = self._gtsam, self._track.times_s
        loose = gtsam.noiseModel.Diagonal.Sigmas(np.array([2.0] * 3 + [1e4] * 3))
        self._add(gtsam.PriorFactorPose3(0, pose3(self._track.poses[0]), loose), "placing")
        gap_s = max(float(np.median(np.diff(times))), 1e-3)
        for key, prior in enumerate(self._track.priors):
            R = prior.R_world_camera
            if R is not None:
                yaw = prior.sigma_yaw_rad if prior.sigma_yaw_rad < 1.0 else 10.0
                sigma = np.array([prior.sigma_tilt_rad, prior.sigma_tilt_rad, yaw])
                sigma = sigma * np.sqrt(max(1.0, 2.0 * ATTITUDE_S / gap_s))
                spread = R.T @ np.diag(sigma**2) @ R
                noise = gtsam.noiseModel.Gaussian.Covariance(spread)
                turn = pose3(se3.compose(R, np.zeros(3))).rotation()
                factor = gtsam.PoseRotationPrior3D(key, turn, self._robust(noise))
                self._add(factor, "attitude", noise)
            if prior.position_m is not None and prior.sigma_position_m is not None:
                sigma = np.maximum(prior.sigma_position_m, 0.005)
                sigma = sigma * np.sqrt(max(1.0, 2.0 * FIX_S / gap_s))
                noise = gtsam.noiseModel.Diagonal.Sigmas(sigma)
                robust = self._robust(noise, "Cauchy", 2.0)
                self._add(gtsam.GPSFactor(key, prior.position_m, robust), "position", noise)

    def _add_points(self, points: Sequence[Point], marks: Sequence[Mark]) -> None:
        gtsam = self._gtsam
        for k in sorted({m.point for m in marks}):
            key = int(gtsam.symbol("p", k))
            self._start.insert(key, np.array(points[k].position_m, np.float64))
            noise = gtsam.noiseModel.Diagonal.Sigmas(np.maximum(points[k].sigma_m, 1e-3))
            self._add(gtsam.PriorFactorPoint3(key, points[k].position_m, noise), "survey")
        for mark in marks:
            keys = [mark.keyframe, int(gtsam.symbol("p", mark.point))]
            rows = 2
            if mark.depth_m is not None:
                keys.append(self._scale_key(mark.keyframe))
                rows = 3
            noise = gtsam.noiseModel.Unit.Create(rows)
            robust = self._robust(noise, at=2.5)
            self._add(gtsam.CustomFactor(robust, keys, mark_error(mark)), "control", noise)
