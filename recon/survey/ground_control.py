"""All keyframes of a scan adjusted at once, with surveyed points on the ground.

One batch over poses and the scale of each stretch (:mod:`recon.posegraph.smoother`): the motions
between keyframes as vision measured them, loops, telemetry or the placing it once gave, and ground
control points. A control point is seen in images: each mark gives a direction and, where the
keyframe has a surface there, a distance. The point itself is unknown within its survey's
sigma. Check points take no part; :func:`map_position` says where the map has them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from recon import se3
from recon.posegraph.records import CHI2_LIMIT, LOOP_WINDOW, Loop, loops_agree
from recon.posegraph.sensor_noise import ATTITUDE_S, FIX_S
from recon.posegraph.smoother import (
    NO_SCALE,
    Linear,
    Smoother,
    State,
    columns_of,
    scale_columns,
)
from recon.table import Rows
from recon.types import F64, I64, Bool, PosePrior

STEPS = 60  # maximum number of steps of the solution

SIGMA_STEP, SIGMA_STEP_M, SIGMA_TURN_RAD = 0.003, 0.01, 5e-4
"""Sigmas of one motion: as a share of its length, in metres, and of its turn."""

SIGMA_SCALE, SIGMA_SCALE_WALK, STRETCH = 0.02, 0.003, 20
"""Sigma of the whole scan's scale, as a share, and between stretches, of so many keyframes that
share one."""

BREAK_S, SIGMA_BREAK_M, SIGMA_BREAK_RAD = 10.0, 5.0, 0.3
"""A longer pause between keyframes is a break of vision, with these sigmas of its motion."""

HELD, HELD_PLACE, HELD_SIGMA = "held", "held place", 1e-5
"""Kinds of factors that hold what is not an unknown; rad and m."""

UNIT = NO_SCALE + 1  # key of the first stretch's scale, in whose unit all motions err

MARK = np.dtype(
    [("key", int), ("point", int), ("scale", int), ("ray", float, (3,)), ("depth", float),
     ("R", float, (3, 3)), ("t", float, (3,)), ("weight", float, (3,))]
)  # fmt: skip


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


Survey = tuple[F64, F64]
"""Places (P, 3) m of surveyed points, and their sigmas (P, 3) m."""

NO_SURVEY: Survey = (np.zeros((0, 3)), np.zeros((0, 3)))


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeTrack:
    """The keyframes as they are before."""

    poses: F64  # (N, 4, 4) T_world_camera
    times_s: F64  # (N,)
    covariances: F64  # (N, 6, 6) left perturbation in the world; they err together
    priors: Sequence[PosePrior] = ()  # of each keyframe; without them the poses are the prior
    loops: Sequence[Loop] = ()  # between places in the list, in metres

    def readings(self) -> tuple[F64, F64, F64, F64]:
        """Fixes (N, 3) m and attitudes (N, 3, 3), each followed by its sigmas (N, 3) m and rad
        about the axes of the world, as of independent readings: they grow as errors wander (cf.
        factors.py). NaN where there is none."""
        shapes = (3,), (3,), (3, 3), (3,)
        out = tuple(np.full((len(self.poses), *shape), np.nan) for shape in shapes)
        fixes, sigma_fixes, attitudes, sigma_attitudes = out
        gap_s = max(float(np.median(np.diff(self.times_s))), 1e-3)
        more = np.sqrt(np.maximum(1.0, 2.0 * np.array([FIX_S, ATTITUDE_S]) / gap_s))
        for k, prior in enumerate(self.priors):
            if prior.position_m is not None and prior.sigma_position_m is not None:
                fixes[k] = prior.position_m
                sigma_fixes[k] = more[0] * np.maximum(prior.sigma_position_m, 0.005)
            if prior.R_world_camera is not None:
                tilt = prior.sigma_tilt_rad
                yaw = prior.sigma_yaw_rad if prior.sigma_yaw_rad < 1.0 else 10.0
                attitudes[k] = prior.R_world_camera
                sigma_attitudes[k] = more[1] * np.array([tilt, tilt, yaw])
        return fixes, sigma_fixes, attitudes, sigma_attitudes


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """The keyframes as they are after."""

    poses: F64  # (N, 4, 4)
    covariances: F64  # (N, 6, 6) left perturbation in the world
    scales: F64  # (N,) what depths are multiplied by
    residuals: dict[str, F64]  # whitened, by kind of factor, (n, dimension) each
    loops_refused: tuple[int, ...]  # positions in the track's list


def adjust(
    track: KeyframeTrack,
    survey: Survey = NO_SURVEY,
    marks: Sequence[Mark] = (),
    sigma_scale: float = SIGMA_SCALE,
    sigma_scale_walk: float = SIGMA_SCALE_WALK,
) -> Adjusted:
    """The adjustment of a track with control points; loops that contradict it are left out.

    ``sigma_scale`` is of the whole scan, ``sigma_scale_walk`` between stretches.

    Raises ValueError for fewer than two keyframes.
    """
    if len(track.poses) < 2:
        raise ValueError(f"expected two poses (N, 4, 4) or more, got {track.poses.shape}")
    args, n = (survey, marks, sigma_scale, sigma_scale_walk), len(track.poses)
    smoother, refused = _solved(track, track.loops, *args), tuple[int, ...]()
    if track.loops:
        chi2 = np.sum(smoother.residuals()["loop"] ** 2, axis=1)
        refused = tuple(np.flatnonzero(chi2 > CHI2_LIMIT).tolist())
    if refused:
        kept = [loop for k, loop in enumerate(track.loops) if k not in refused]
        smoother = _solved(track, kept, *args)
    poses, spread = zip(*(smoother.state(key) for key in range(n)), strict=True)
    scales = np.exp(smoother.logs()[_scale_key(np.arange(n))])
    found = smoother.residuals()  # without the robust losses
    residuals = {kind: rows for kind, rows in found.items() if kind not in (HELD, HELD_PLACE)}
    return Adjusted(np.array(poses), np.array(spread), scales, residuals, refused)


def supported(loops: Sequence[Loop], poses: F64 | Mapping[int, F64]) -> list[Loop]:
    """Those loops that another one confirms, whose ends lie within LOOP_WINDOW keyframes.

    Both, joined by the track between their ends (trusted to 3 % of its length), must close on
    themselves. Repeated texture gives perfect matches at the wrong place, but not twice alike.
    """
    out = []
    for one in loops:
        for other in loops:
            if not 0 < max(abs(one.a - other.a), abs(one.b - other.b)) <= LOOP_WINDOW:
                continue
            T_a_a = se3.inverse(poses[one.a]) @ poses[other.a]
            T_b_b = se3.inverse(poses[other.b]) @ poses[one.b]
            if loops_agree(one, other, T_a_a, T_b_b):
                out.append(one)
                break
    return out


def map_position(poses: F64, scales: F64, marks: Sequence[Mark]) -> tuple[F64, float] | None:
    """(3,) where the map has a point, and its sigma in metres; None when it has it nowhere. The
    surface at the marks, weighted; where no mark has one, the rays' nearest point."""
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
    """(3,) world point of the surface at a mark that has one."""
    assert mark.depth_m is not None
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

    A map's error is nearly the same everywhere: the offsets (N, 3) of two points may differ by
    their sigmas (N,), 1 % of the distance between them and 0.1 m.
    """
    offset = surveyed_m - mapped_m
    apart = np.linalg.norm(offset[:, None] - offset[None], axis=2)
    between = np.linalg.norm(mapped_m[:, None] - mapped_m[None], axis=2)
    allowed = 4.0 * np.hypot(sigma_m[:, None], sigma_m[None]) + 0.01 * between + 0.1
    agree = apart <= allowed
    best = max(range(len(agree)), key=lambda k: (int(agree[k].sum()), -float(apart[k].sum())))
    return np.asarray(agree[best])


def of_marks(rows: Rows, at: State) -> Linear:
    """Direction and, where it is known, distance of a point as an image sees it. p = R_camera_key
    (R^T (P - t) - t_key_camera); the place P of a point is the shift of its key."""
    key, point, scale = rows["key"], rows["point"], rows["scale"]
    R_key_world = at.R[key].transpose(0, 2, 1)
    apart = at.t[point] - at.t[key]
    in_camera = rows["R"] @ (np.einsum("nij,nj->ni", R_key_world, apart) - rows["t"])[:, :, None]
    x, y, z = in_camera[:, :, 0].T
    z = np.maximum(z, 1e-3)
    grown = rows["depth"] * np.exp(at.logs[scale])
    error = np.stack([x / z - rows["ray"][:, 0], y / z - rows["ray"][:, 1], z - grown], axis=1)
    D = np.zeros((len(rows), 3, 3))
    D[:, 0, 0] = D[:, 1, 1] = 1.0 / z
    D[:, 0, 2], D[:, 1, 2], D[:, 2, 2] = -x / z**2, -y / z**2, 1.0
    to_world = (rows["weight"][:, :, None] * D) @ rows["R"] @ R_key_world
    of_scale = np.zeros((len(rows), 3, 1))
    of_scale[:, 2, 0] = -grown * rows["weight"][:, 2]
    J = np.concatenate([to_world @ se3.hat(apart), -to_world, to_world, of_scale], axis=2)
    columns = [columns_of(key, 0, 6), columns_of(point, 3, 6), scale_columns(at, scale)]
    return error * rows["weight"], J, np.hstack(columns)


def _scale_key(keyframes: I64) -> I64:
    return np.asarray(UNIT + keyframes // STRETCH)


def _solved(
    track: KeyframeTrack, loops: Sequence[Loop], survey: Survey,
    marks: Sequence[Mark], sigma: float, sigma_walk: float,
) -> Smoother:  # fmt: skip
    """All factors of one adjustment, solved. Keys of the smoother: keyframes, then the world
    itself, then points, whose turns are held."""
    smoother, n = Smoother(), len(track.poses)
    scale_key = _scale_key(np.arange(n)).tolist()
    for T, spread in zip(track.poses, track.covariances, strict=True):
        smoother.append_pose(T, spread)
    for key in range(UNIT, scale_key[-1] + 1):
        smoother.append_scale(0.0)
        smoother.add_scale("scale", (key - 1, key), 0.0, sigma if key == UNIT else sigma_walk)
    for key in range(1, n):
        kind, motion, spread = _step(track, key)
        smoother.add_motion(kind, (key - 1, key), motion, spread, scale_key[key - 1], UNIT)
    _add_telemetry(smoother, track) if track.priors else _add_placing(smoother, track)
    for one in loops:
        smoother.add_motion(
            "loop", one.ends, one.T_a_b, one.covariance, scale_key[one.a], UNIT, 1.5
        )
    seen = _add_points(smoother, n, survey, marks)
    for mark in marks:
        R_camera_key = mark.T_key_camera[:3, :3].T
        far = 0.0 if mark.depth_m is None else 1.0 / mark.sigma_depth_m
        row = (
            mark.keyframe, seen[mark.point], scale_key[mark.keyframe], mark.ray,
            mark.depth_m or 0.0, R_camera_key, mark.T_key_camera[:3, 3],
            (1.0 / mark.sigma, 1.0 / mark.sigma, far),
        )  # fmt: skip
        smoother.add(of_marks, MARK, "control", row, 2.5)
    smoother.update(now=True, steps=STEPS)
    return smoother


def _hold(smoother: Smoother, key: int, T: F64, sigma_rad: float, sigma_m: float) -> None:
    smoother.add_turn(HELD, key, T[:3, :3], np.full(3, sigma_rad))
    smoother.add_place(HELD_PLACE, key, T[:3, 3], np.full(3, sigma_m))


def _step(track: KeyframeTrack, key: int) -> tuple[str, F64, F64]:
    """Kind, motion and covariance from the keyframe before, as vision and ICP measured it."""
    motion = se3.inverse(track.poses[key - 1]) @ track.poses[key]
    length = float(np.linalg.norm(motion[:3, 3]))
    turn, shift, kind = SIGMA_TURN_RAD, SIGMA_STEP * length + SIGMA_STEP_M, "vision"
    pause = float(track.times_s[key] - track.times_s[key - 1])
    if pause > BREAK_S:
        turn, shift, kind = SIGMA_BREAK_RAD, SIGMA_BREAK_M * pause / BREAK_S, "link"
    right = np.diag([turn**2] * 3 + [shift**2] * 3)
    return kind, motion, se3.left_covariance(motion, right)


def _add_placing(smoother: Smoother, track: KeyframeTrack) -> None:
    """The poses' own covariances: they err together, so each counts one N-th."""
    n, floor = len(track.poses), np.diag([1e-8] * 3 + [1e-6] * 3)
    for key, (T, spread) in enumerate(zip(track.poses, track.covariances, strict=True)):
        smoother.add_motion("placing", (n, key), T, n * (spread + floor))


def _add_telemetry(smoother: Smoother, track: KeyframeTrack) -> None:
    _hold(smoother, 0, track.poses[0], 2.0, 1e4)
    readings = zip(*track.readings(), strict=True)
    for key, (place, sigma_m, R, sigma_rad) in enumerate(readings):
        if np.isfinite(R).all():
            smoother.add_turn("attitude", key, R, sigma_rad, 1.5)
        if np.isfinite(place).all():
            smoother.add_place("position", key, place, sigma_m, cauchy=2.0)


def _add_points(
    smoother: Smoother, world: int, survey: Survey, marks: Sequence[Mark]
) -> dict[int, int]:
    """The ``world`` by its key and the points that images see after it; their keys by number."""
    smoother.append_pose(np.eye(4), np.zeros((6, 6)))
    _hold(smoother, world, np.eye(4), HELD_SIGMA, HELD_SIGMA)
    seen = {k: key for key, k in enumerate(sorted({m.point for m in marks}), world + 1)}
    places_m, sigmas_m = survey
    for k, key in seen.items():
        smoother.append_pose(se3.compose(np.eye(3), places_m[k]), np.eye(6))
        smoother.add_turn(HELD, key, np.eye(3), np.full(3, HELD_SIGMA))
        smoother.add_place("survey", key, places_m[k], np.maximum(sigmas_m[k], 1e-3))
    return seen
