"""A finished scan adjusted by its own images: ``refine --video FLIGHT``.

The keyframes' images, and those that hold marks of surveyed points, are matched again at full
size. One adjustment has their poses, the places seen, the telemetry and the surveyed points in it.
Depth images and textures keep the camera that the scan was flown with, so poses are those of that
camera: with another one's they would lie pixels apart, even where it fits the images better. That
one (if observable) is found alongside. Each depth image is scaled to the places that it shows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from recon import se3
from recon.calibration.flight import (
    Network,
    SelfCalibrationConfig,
    camera_information,
    camera_sigmas,
    doubt,
    first_held,
    focal_sigma,
    loosely_placed,
    network,
)
from recon.calibration.global_bundle import Knowledge, Problem, Sightings, dispersion
from recon.calibration.tracks import pieces, with_distortion, without_distortion
from recon.camera_model import project, rays
from recon.parallel import run_parallel
from recon.survey.ground_control import Adjusted, KeyframeTrack, Mark, Survey, map_position
from recon.types import F64, Bool, Camera, Keyframe
from service.errors import InputError
from service.offline.refine import own_camera
from service.offline.refine.control_points import MARK_PX, Candidate
from service.offline.refine.revisions import KeyframeStates, moved_frames
from service.offline.refine.survey_file import SurveyPoint
from service.scans.track import camera_of
from service.stream.records import PoseRecord, ScanHeader

FREE = SelfCalibrationConfig(max_sigma_focal=0.003)
HELD = replace(
    FREE, sigma_focal=1e-5, sigma_aspect=1e-5, sigma_centre=1e-6, sigma_k=1e-6, sigma_p=1e-7
)

MIN_FIXES = 3
"""Measured places that place a piece."""

MIN_DEPTHS = 8
"""Places that a depth image has to show before it is scaled to them."""

Surfaces = Callable[[int], Keyframe | None]


@dataclass(frozen=True, slots=True, eq=False)
class ImageNetwork:
    """The result of an adjustment by images."""

    keyframes: int
    given: Camera  # that the poses are of
    camera: Camera  # that fits the images best, or the one given
    poses: F64  # (V, 4, 4) T_world_camera: those of the keyframes, then of other marked frames
    points: F64  # (P, 3)
    seen: Sightings
    sigma_focal: float
    doubt: str  # why the camera is held; empty when it is found

    def figures(self) -> dict[str, Any]:
        return {
            "sightings": len(self.seen.view),
            "places": len(np.unique(self.seen.landmark)),
            "views": len(self.poses),
            "focal_px": [round(float(c.K[0, 0]), 2) for c in (self.given, self.camera)],
            "centre_px": [round(float(v), 1) for v in self.camera.K[:2, 2]],
            "distortion": [round(float(v), 5) for v in self.camera.distortion],
        }


def stretches_untied(seqs: Sequence[int], seen: Sightings, fixed: Bool) -> list[list[int]]:
    """First and last keyframe of each run that no chain of images ties to the main piece.

    Args:
        seqs: numbers of the keyframes, the first views of ``seen``.
        fixed: (N,) keyframes with a measured place. Pieces with :data:`MIN_FIXES` of them are tied.

    The main piece is the one with most keyframes.
    """
    piece = pieces(seen, len(seqs))
    main = np.bincount(piece).argmax()
    out: list[list[int]] = []
    before = main
    for seq, its in zip(seqs, piece, strict=True):
        is_tied = its == main or fixed[piece == its].sum() >= MIN_FIXES
        if not is_tied and its == before:
            out[-1][1] = seq
        elif not is_tied:
            out.append([seq, seq])
        before = its
    return out


def network_of(
    video: Path, header: ScanHeader, states: KeyframeStates,
    marked: Sequence[PoseRecord], ahead_m: float,
) -> ImageNetwork:  # fmt: skip
    """The images of the keyframes, and of the frames ``marked``, tied together.

    Raises InputError when ``video`` is not the scan's.
    """
    given = camera_of(header)
    times = [*states.times_ns.tolist(), *(f.time_unix_ns for f in marked)]
    poses = np.array([*states.poses, *(f.T_world_camera for f in marked)])
    images = own_camera.images_at(video, header.started_unix_ns, times)
    ground_m = float(np.median((poses[:, :3, 3] + ahead_m * poses[:, :3, 2])[:, 2]))
    return fitted(given, poses, own_camera.sightings(images, given, poses, ground_m), len(states))


def fitted(
    given: Camera, poses: F64, tied: own_camera.TiedViews, keyframes: int,
    config: SelfCalibrationConfig = FREE,
) -> ImageNetwork:  # fmt: skip
    """The network of views that are ``tied``, and the camera that fits them best.

    Raises ValueError where too few sightings agree.
    """
    known, free = loosely_placed(poses, tied.seen), camera_information(given, config)
    found = network(given, tied.poses, tied.seen, known, free, near=tied.camera)
    s, pixel = found.solution, np.full(len(found.seen.view), found.sigma_px)
    settled = Problem(s.camera, given, s.poses, s.points, found.seen, pixel, known, free)
    sigmas = camera_sigmas(s.camera_covariance) * np.sqrt(max(dispersion(settled), 1.0))
    focal, why = focal_sigma(s.camera, sigmas), doubt(s.camera, given, sigmas, config)
    camera = given if why else s.camera
    held = network(given, tied.poses, tied.seen, known, camera_information(given, HELD))
    s = held.solution
    return ImageNetwork(keyframes, given, camera, s.poses, s.points, held.seen, focal, why)


def marked_frames(
    survey: Sequence[SurveyPoint], frames: Sequence[PoseRecord], states: KeyframeStates
) -> list[PoseRecord]:
    """Frames other than keyframes in which surveyed points are marked."""
    wanted = {
        round(seen.time_unix_s * 1e9)
        for point in survey
        for seen in point.sightings
        if seen.time_unix_s is not None
    }
    out = {}
    for time_ns in wanted:
        near = min(frames, key=lambda f: abs(f.time_unix_ns - time_ns), default=None)
        if near is not None and np.abs(states.times_ns - time_ns).min() >= 2_000_000:
            out[near.time_unix_ns] = near
    return [out[t] for t in sorted(out)]


def as_seen(
    found: ImageNetwork, states: KeyframeStates, frames: Sequence[PoseRecord],
    marked: Sequence[PoseRecord], surface: Surfaces,
) -> tuple[KeyframeStates, list[PoseRecord]]:  # fmt: skip
    """Keyframes and frames as the images have them."""
    n = len(states)
    scales = depth_scales(found, found.poses, found.points, found.seen, surface)
    after = Adjusted(found.poses[:n], states.covariances, scales, {}, ())
    moved = moved_frames(frames, states, after, None)
    own = {f.time_unix_ns: T for f, T in zip(marked, found.poses[n:], strict=True)}
    moved = [replace(f, T_world_camera=own.get(f.time_unix_ns, f.T_world_camera)) for f in moved]
    return replace(states, poses=found.poses[:n], scales=states.scales * scales), moved


def depth_scales(
    found: ImageNetwork, poses: F64, points: F64, seen: Sightings, surface: Surfaces
) -> F64:
    """(N,) what the depth of each keyframe is multiplied by to meet the places that it shows."""
    flat = rays(found.given.K, without_distortion(found.given, seen.uv_px))

    def scale(k: int) -> float:
        keyframe = surface(k)
        rows = np.flatnonzero(seen.view == k)
        if keyframe is None or len(rows) < MIN_DEPTHS:
            return np.nan
        depth = keyframe.depth
        h, w = depth.depth_m.shape
        u, v = np.rint(project(depth.K, flat[rows])).astype(int).T
        inside = (u >= 0) & (u < w) & (v >= 0) & (v < h)
        there = se3.transform(se3.inverse(poses[k]), points[seen.landmark[rows[inside]]])[:, 2]
        ratio = there / depth.depth_m[v[inside], u[inside]]
        ratio = ratio[np.isfinite(ratio) & (ratio > 0)]
        return float(np.median(ratio)) if len(ratio) >= MIN_DEPTHS else np.nan

    out = np.array(run_parallel(*(partial(scale, k) for k in range(found.keyframes))))
    usual = float(np.nanmedian(out)) if np.isfinite(out).any() else 1.0
    return np.where(np.isfinite(out), out, usual)


def adjusted(
    images: ImageNetwork, track: KeyframeTrack, survey: Survey,
    marks: Sequence[Mark], surface: Surfaces,
) -> tuple[Adjusted, ImageNetwork]:  # fmt: skip
    """The adjustment with telemetry and surveyed points, and the network after it.

    ``images`` is in the world of ``track``.
    """
    n, first = len(track.poses), len(images.points)
    known = _known(images, track, survey, {m.point for m in marks})
    rows = [
        (_view_of(images, mark), first + mark.point, project(images.given.K, mark.ray[None]))
        for mark in marks
    ]
    seen = None
    if rows:
        at_px = with_distortion(images.given, np.concatenate([row[2] for row in rows]))
        seen = Sightings(np.array([r[0] for r in rows]), np.array([r[1] for r in rows]), at_px)
    try:
        found = network(
            images.given, images.poses, images.seen, known,
            camera_information(images.given, HELD), seen, MARK_PX, True,
        )  # fmt: skip
    except (ValueError, RuntimeError, np.linalg.LinAlgError) as error:
        raise InputError(f"the images do not tie the scan together ({error})") from error
    s = found.solution
    scales = depth_scales(images, s.poses, s.points, found.seen, surface)
    after = replace(images, poses=s.poses, seen=found.seen)
    return Adjusted(s.poses[:n], s.covariances[:n], scales, _residuals(found, known), ()), after


def _view_of(images: ImageNetwork, mark: Mark) -> int:
    """Which view a mark is in: a keyframe, or the marked frame at its pose."""
    if np.array_equal(mark.T_key_camera, np.eye(4)):
        return mark.keyframe
    T, n = images.poses[mark.keyframe] @ mark.T_key_camera, images.keyframes
    return n + int(np.argmin(np.linalg.norm(images.poses[n:, :3, 3] - T[:3, 3], axis=1)))


def _known(images: ImageNetwork, track: KeyframeTrack, survey: Survey, used: set[int]) -> Knowledge:
    """Priors from telemetry, or from the flight's last georeference, and from the survey."""
    n, first, (places_m, sigmas_m) = len(track.poses), len(images.points), survey
    out = Knowledge.none(len(images.poses), first + len(places_m))
    for k in used:
        out.surveyed[first + k] = places_m[k]
        out.sigma_surveyed[first + k] = np.maximum(sigmas_m[k], 1e-3)
    out.placed[:n] = track.poses
    if not track.priors:
        floor = np.diag([1e-8] * 3 + [1e-6] * 3)
        for k, (T, spread) in enumerate(zip(track.poses, track.covariances, strict=True)):
            A = se3.adjoint(se3.inverse(T))
            out.placing[k] = np.linalg.inv(n * A @ (spread + floor) @ A.T)
        return out
    out.placing[0] = first_held(track.poses)[0] * 1e-4
    log = track.readings()
    out.fixes[:n], out.sigma_fixes[:n], out.attitudes[:n], out.sigma_attitudes[:n] = log
    return out


def _residuals(found: Network, known: Knowledge) -> dict[str, F64]:
    """Whitened, by kind."""
    s = found.solution
    errors = s.errors_px[: len(found.seen.view)] / found.sigma_px / np.sqrt(2.0)
    out = {
        "pixels": errors[np.isfinite(errors), None],
        "position": (s.poses[:, :3, 3] - known.fixes) / known.sigma_fixes,
        "survey": (s.points - known.surveyed) / known.sigma_surveyed,
    }
    return {kind: rows[np.isfinite(rows).all(axis=1)] for kind, rows in out.items()}


def crossing_marks(candidate: Candidate, poses: F64) -> None:
    """Find a point's place in the map from the rays of its marks, if they cross."""
    bare = [replace(m, depth_m=None) for m in candidate.marks]
    crossing = map_position(poses, np.ones(len(poses)), bare)
    if crossing is not None:
        candidate.marks = bare
        candidate.before_m, candidate.sigma_before_m = crossing
        candidate.why_not = ""


def carried_marks(candidate: Candidate, before: ImageNetwork, after: ImageNetwork) -> list[Mark]:
    """A point's marks with the poses that its frames have after the adjustment."""
    out = []
    for mark in candidate.marks:
        view = _view_of(before, mark)
        if view >= before.keyframes:
            T = se3.inverse(after.poses[mark.keyframe]) @ after.poses[view]
            mark = replace(mark, T_key_camera=T)
        out.append(mark)
    return out
