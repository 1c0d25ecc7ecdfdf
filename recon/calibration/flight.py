"""The camera's focal length, centre and distortion from a flight itself, by bundle adjustment.

Poses, landmarks and one shared camera are adjusted at once. The covariance shows how well the
flight's geometry determines the camera: seen straight down from one height, a longer focal length
looks like a greater height.

Tangential terms (Brown, Decentering Distortion of Lenses, 1966) are found with the others: a lens
off its axis tilts the surface of each view its own way, and views of the same ground that are
turned to each other disagree. They and the centre nearly trade places, so neither is sure alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from recon.calibration.global_bundle import (
    Knowledge,
    Problem,
    RowMotion,
    Sightings,
    Solution,
    errors_px,
    joint,
    solve,
)
from recon.calibration.tracks import crossings
from recon.types import F64, Bool, Camera

MIN_SIGHTINGS = 60

LOOSE, PARTS = 0.2, 6
"""Sigma of a focal length that the images alone shall find, and parts of the flight of which one is
left out at a time."""

MAX_SIGHTINGS = 12_000

TOO_FAR = "the camera found is too far from the model given; calibrate with a chessboard"

SIGMA_TURN_RAD = 0.01
"""Of the rows, from the first to the last: within 50 ms, 12 degrees a second, or 10 m/s at 50 m."""

TURNING_STEPS = 10
"""Towards free turns of the rows: noise alone decides the rest of the way to a weak minimum."""

RAYLEIGH_MEDIAN = 1.1774  # median length of an error whose coordinates have sigma 1


@dataclass(frozen=True, slots=True)
class SelfCalibrationConfig:
    sigma_focal: float = 0.05  # of the focal length beforehand, as a share
    sigma_aspect: float = 5e-4  # of height over width of a pixel: one focal length holds for both
    sigma_centre: float = 0.015  # of the centre, as a share of the width
    sigma_k: float = 0.1  # of k1 and of k2
    sigma_p: float = 0.005  # of p1 and of p2
    max_sigma_focal: float = 0.01  # a less certain focal length is refused
    max_sigma_bend: float = np.inf  # likewise of k1, as the share of depth it bends at a corner
    covered_sigma_k1: float = 0.0  # of k1 that is accepted whatever it bends
    max_sigmas: float = 3.0  # from the model given; a camera further off is refused
    pixel_sigma: float = 0.5
    huber_sigmas: float = 1.5
    gate_sigmas: float = 6.0  # sightings further off after the first round are left out
    min_sightings: int = 200
    iterations: int = 40
    max_step: float = 0.3  # in sigmas: a larger last step of the camera has not settled


@dataclass(frozen=True, slots=True, eq=False)
class SelfCalibrated:
    camera: Camera
    sigma_focal: float  # as a share
    sigma_k: tuple[float, float]
    sigma_p: tuple[float, float]
    rms_before_px: float  # of the sightings' robust middle, with the camera given
    rms_after_px: float
    errors_px: F64  # (M,) lengths, of the sightings that took part
    poses: F64  # (N, 4, 4) T_world_camera
    why_not: str  # empty when the camera is accepted


def self_calibrate(
    camera: Camera, poses: F64, landmarks: F64, seen: Sightings, fixes: F64, sigma_fixes: F64,
    config: SelfCalibrationConfig | None = None,
) -> SelfCalibrated:  # fmt: skip
    """The camera that explains the sightings best, with its sigmas.

    Args:
        camera: the model given, a start and a bound.
        poses: (N, 4, 4) T_world_camera to begin with; ``landmarks`` (P, 3) likewise, world,
            NaN without a place.
        fixes: (N, 3) measured places of the cameras, NaN where there is none, with their
            sigmas ``sigma_fixes`` (N, 3) as of independent readings.

    Raises ValueError for too few sightings.
    """
    config = config or SelfCalibrationConfig()
    if len(seen.view) < config.min_sightings:
        raise ValueError(f"{len(seen.view)} sightings are too few; {config.min_sightings} needed")
    if not np.isfinite(fixes).all(axis=1).any():  # the scale has to be held by something
        span = float(np.linalg.norm(np.ptp(poses[:, :3, 3], axis=0)))
        fixes, sigma_fixes = poses[:, :3, 3], np.full((len(poses), 3), 0.05 * span)
    known = replace(
        Knowledge.none(len(poses), len(landmarks)), placed=poses,
        fixes=fixes, sigma_fixes=np.maximum(sigma_fixes, 0.005), placing=first_held(poses),
    )  # fmt: skip
    held = camera_information(camera, config)

    seen = thinned(within(camera, poses, landmarks, seen, np.inf))
    before = errors_px(camera, poses, landmarks, seen)
    problem = Problem(
        camera, camera, poses, landmarks, seen, np.full(len(seen.view), config.pixel_sigma),
        known, held, config.huber_sigmas,
    )  # fmt: skip
    first = solve(problem, config.iterations)
    # Once more without wild sightings and with the pixels' own scatter.
    sigma = float(np.clip(np.median(first.errors_px) / RAYLEIGH_MEDIAN, 0.1, 2.0))
    seen = shared(seen, first.errors_px < config.gate_sigmas * sigma)
    last = replace(adjusted(problem, first), seen=seen, sigma_px=np.full(len(seen.view), sigma))
    alone_px, sigma_alone, wider, at = by_images_alone(last, config)
    found = solve(replace(at, camera_information=held).widened(wider), config.iterations)
    sigmas = camera_sigmas(found.camera_covariance)
    # As much wider as the focal lengths by the images and as given are further apart than their
    # sigmas. Birge 1932, doi:10.1103/PhysRev.40.207.
    apart = abs(np.log(alone_px / camera.K[0, 0])) / np.hypot(sigma_alone, config.sigma_focal)
    focal = focal_sigma(found.camera, sigmas) * max(float(apart), 1.0)
    why_not = doubt(found.camera, camera, sigmas, config)
    if not why_not and focal > config.max_sigma_focal:
        why_not = TOO_FAR
    if not why_not and (np.abs(found.camera_step) > config.max_step * sigmas).any():
        why_not = "the adjustment of the images does not settle"
    return SelfCalibrated(
        found.camera, focal, (float(sigmas[4]), float(sigmas[5])),
        (float(sigmas[6]), float(sigmas[7])), middle(before), middle(found.errors_px),
        found.errors_px, found.poses, why_not,
    )  # fmt: skip


def thinned(seen: Sightings) -> Sightings:
    """Those of evenly chosen landmarks, :data:`MAX_SIGHTINGS` in all: patches of an image share
    their errors, so that more tell nothing more."""
    count = max(len(seen.view), MAX_SIGHTINGS)
    return shared(seen, seen.landmark * MAX_SIGHTINGS % count < MAX_SIGHTINGS)


def by_images_alone(
    problem: Problem, config: SelfCalibrationConfig
) -> tuple[float, float, float, Problem]:
    """The focal length in px without prior knowledge, its relative sigma, by how much sightings
    have to be widened, and the state adjusted to them.

    Errors that neighbouring sightings and views share pull the focal length of a flight straight
    down much further than the adjustment's covariance says. So its sigma is that of a jackknife,
    and of what it changes by where the camera may have a rolling shutter.
    """
    loose = replace(config, sigma_focal=max(config.sigma_focal, LOOSE))
    problem = replace(problem, camera_information=camera_information(problem.given, loose))
    found = solve(problem, config.iterations)
    at = adjusted(problem, found)
    turning = solve(
        replace(at, rows=free_rows(len(at.poses))), min(TURNING_STEPS, config.iterations)
    )
    focal, other = (float(s.camera.K[0, 0]) for s in (found, turning))
    spread = np.hypot(jackknife(at, config.iterations), np.log(focal / other))
    sigma = focal_sigma(found.camera, camera_sigmas(found.camera_covariance))
    wider = max(float(spread) / sigma, 1.0)
    return focal, wider * sigma, wider, at


def adjusted(problem: Problem, found: Solution) -> Problem:
    """``problem`` with the solution to begin with."""
    return replace(problem, camera=found.camera, poses=found.poses, points=found.points)


def free_rows(count: int) -> RowMotion:
    """Of ``count`` views whose rolling shutter is unknown."""
    still = np.zeros((count, 3))
    return RowMotion(still, still, still, np.full(still.shape, SIGMA_TURN_RAD))


def jackknife(problem: Problem, iterations: int = 40) -> float:
    """Relative sigma of the focal length by leaving out one part of the flight after another.
    ``problem`` holds the adjusted state. Tukey 1958, with :data:`PARTS` runs of views."""
    seen, focal = problem.seen, []
    for part in np.array_split(np.unique(seen.view), PARTS):
        rest = shared(seen, ~np.isin(seen.view, part))
        sigmas = np.full(len(rest.view), problem.sigma_px[0])
        found = solve(replace(problem, seen=rest, sigma_px=sigmas), iterations)
        focal.append(np.log(found.camera.K[0, 0]))
    return float(np.sqrt((PARTS - 1) * np.var(focal)))


ROUNDS: tuple[tuple[float, float], ...] = ((8.0, 180.0), (1.0, 15.0))
"""Sigma of a pixel, and the error beyond which it is left out, while poses are far off."""


@dataclass(frozen=True, slots=True, eq=False)
class Network:
    solution: Solution
    seen: Sightings  # that took part
    sigma_px: float  # of a coordinate, as they scatter


def network(
    camera: Camera, poses: F64, seen: Sightings, known: Knowledge, held: F64,
    marks: Sightings | None = None, mark_px: float = 1.0, covariances: bool = False,
    rows: RowMotion | None = None, near: Camera | None = None,
) -> Network:  # fmt: skip
    """Views adjusted to their sightings, from poses that may be far off.

    Args:
        poses: (N, 4, 4) T_world_camera; ``known`` of them and of the landmarks, which are
            numbered alike in ``seen`` and ``marks``.
        held: (8, 8) information of the camera given.
        marks: sightings of surveyed landmarks, which always take part with ``mark_px``.
        rows: of a rolling shutter, to begin with.
        near: the camera to begin with, where ``poses`` and it agree with most sightings already.

    Raises ValueError where too few sightings agree.
    """
    count, given, kept, points = len(known.surveyed), camera, seen, known.surveyed
    marks = marks or Sightings(seen.view[:0], seen.landmark[:0], seen.uv_px[:0])
    rounds = ROUNDS
    if near is not None:
        camera, rounds = near, ()
        points = crossings(poses, camera, joint(seen, marks), count, rows)
    for rough in (*rounds, None):
        if rough is not None:
            sigma, gate = rough
        else:
            errors = errors_px(camera, poses, points, kept, rows)
            sigma = float(np.clip(np.median(errors) / RAYLEIGH_MEDIAN, 0.1, 2.0))
            gate = max(6.0 * sigma, 1.0)
        points = crossings(poses, camera, joint(seen, marks), count, rows)
        kept = within(camera, poses, points, seen, gate, rows)
        points = crossings(poses, camera, joint(kept, marks), count, rows)
        kept = within(camera, poses, points, kept, np.inf, rows)
        if len(kept.view) < MIN_SIGHTINGS:
            raise ValueError("too few places are found again in other images")
        points = np.where(np.isfinite(points), points, known.surveyed)
        every = joint(kept, marks)
        sigmas = np.append(np.full(len(kept.view), sigma), np.full(len(marks.view), mark_px))
        solution = solve(
            Problem(camera, given, poses, points, every, sigmas, known, held, rows=rows),
            covariances=covariances and rough is None,
        )
        poses, points = solution.poses, solution.points
        camera, rows = solution.camera, solution.rows
    return Network(solution, kept, sigma)


def within(
    camera: Camera, poses: F64, points: F64, seen: Sightings, gate_px: float,
    rows: RowMotion | None = None,
) -> Sightings:  # fmt: skip
    """Sightings of known points that are off by less than ``gate_px``, two of each at least."""
    return shared(seen, errors_px(camera, poses, points, seen, rows) < gate_px)


def loosely_placed(poses: F64, seen: Sightings) -> Knowledge:
    """The flight is about where ``poses`` (N, 4, 4) have it, within a tenth of its extent."""
    span = float(np.linalg.norm(np.ptp(poses[:, :3, 3], axis=0)))
    return replace(
        Knowledge.none(len(poses), int(seen.landmark.max()) + 1),
        fixes=poses[:, :3, 3], sigma_fixes=np.full((len(poses), 3), 0.1 * span),
        placed=poses, placing=first_held(poses),
    )  # fmt: skip


def first_held(poses: F64) -> F64:
    """(N, 6, 6) information that loosely holds the first pose, as fixes in a line hold no roll."""
    out = np.zeros((len(poses), 6, 6))
    out[0] = np.diag([0.2**-2] * 3 + [20.0**-2] * 3)
    return out


def shared(seen: Sightings, kept: Bool) -> Sightings:
    """The sightings that are ``kept`` (M,), of landmarks that two or more of them show."""
    often = np.bincount(seen.landmark[kept], minlength=int(seen.landmark.max(initial=0)) + 1)
    kept = kept & (often[seen.landmark] >= 2)
    return Sightings(seen.view[kept], seen.landmark[kept], seen.uv_px[kept])


def doubt(found: Camera, given: Camera, sigmas: F64, c: SelfCalibrationConfig) -> str:
    """Return why the camera, known to ``sigmas`` (8,), is refused; empty when it is accepted."""
    sigma_focal = focal_sigma(found, sigmas)
    if sigma_focal > c.max_sigma_focal:
        return (
            f"the flight does not determine the focal length (to {100 * sigma_focal:.1f} %, asked "
            f"{100 * c.max_sigma_focal:.1f} %): seen straight down from one height it looks "
            "like another height; fly two heights or an oblique turn"
        )
    bend = corner_bend(found, float(sigmas[4]))
    asked = max(c.max_sigma_bend, corner_bend(found, c.covered_sigma_k1))
    if bend > asked:
        return (
            f"the flight does not determine the distortion (to {100 * bend:.1f} % of depth at a "
            f"corner, asked {100 * asked:.1f} %); let images overlap more"
        )
    off = abs(found.K[0, 0] / given.K[0, 0] - 1.0) / c.sigma_focal
    shift = np.abs(found.K[:2, 2] - given.K[:2, 2]).max()
    off = max(off, float(shift) / (c.sigma_centre * given.size_px[0]))
    bent = np.abs(found.distortion[:4] - given.distortion[:4])
    off = max(off, float((bent / [c.sigma_k, c.sigma_k, c.sigma_p, c.sigma_p]).max()))
    if off > c.max_sigmas:
        return TOO_FAR
    return ""


def corner_bend(camera: Camera, sigma_k1: float) -> float:
    """Sigma of depth over depth at a corner, by that of k1: of a pair's disparity, on average over
    its ways."""
    corner = 0.5 * float(np.hypot(*camera.size_px)) / float(camera.K[0, 0])
    return 2.0 * sigma_k1 * corner**2


def focal_sigma(found: Camera, sigmas: F64) -> float:
    """Sigma of the focal length, as a share, of a camera known to ``sigmas`` (8,)."""
    return float(sigmas[:2].max() / found.K[0, 0])


def camera_information(given: Camera, c: SelfCalibrationConfig) -> F64:
    """(8, 8) of fx, fy, cx, cy, k1, k2, p1, p2: the prior information about a camera."""
    f, centre = c.sigma_focal * given.K[0, 0], c.sigma_centre * given.size_px[0]
    sigma = np.array([f, f, centre, centre, c.sigma_k, c.sigma_k, c.sigma_p, c.sigma_p])
    spread = np.diag(sigma**2)
    spread[0, 1] = spread[1, 0] = f * f - 0.5 * (c.sigma_aspect * given.K[0, 0]) ** 2
    return np.asarray(np.linalg.inv(spread))


def camera_sigmas(covariance: F64) -> F64:
    """(8,) sigmas of a camera's parameters; all infinite unless ``covariance`` (8, 8) is one."""
    try:
        known = np.isfinite(np.linalg.cholesky(covariance)).all()
    except np.linalg.LinAlgError:  # not positive definite
        known = False
    return np.sqrt(np.diag(covariance)) if known else np.full(len(covariance), np.inf)


def middle(errors_px: F64) -> float:
    """Root mean square per coordinate of the better nine tenths of lengths."""
    kept = np.sort(errors_px)[: max(1, int(0.9 * len(errors_px)))]
    return float(np.sqrt(0.5 * np.mean(kept**2)))
