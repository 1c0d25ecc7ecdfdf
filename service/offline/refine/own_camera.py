"""The camera's model from the flight's own video: ``refine --intrinsics --video FILE``.

Features of each keyframe's image are found again in its neighbours' and in those of other legs
that show the same ground, and :mod:`recon.calibration.flight` adjusts poses, landmarks and the
camera at once.
What comes out is a camera file to replay the flight with: depth images that were made with
another focal length cannot be bent to this one. The scan and its own model stay as they are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from recon import se3
from recon.calibration.flight import (
    SelfCalibrated,
    SelfCalibrationConfig,
    camera_information,
    loosely_placed,
    network,
    self_calibrate,
    within,
)
from recon.calibration.global_bundle import Sightings
from recon.calibration.tracks import are_alike, crossings, extended, image_of, joined, sharpened
from recon.camera_model import Undistorter, project, rays
from recon.parallel import run_parallel
from recon.tracking import matching
from recon.types import F64, U8, Camera
from service.cameras.camera_file import save_camera
from service.cameras.images import open_images
from service.cameras.lens import SIGMA_K1
from service.cameras.video import open_file
from service.errors import InputError
from service.offline.exports.images import frames_near

FILE = "camera.refined.yaml"
WITHIN_NS = 20_000_000
"""An image belongs to a keyframe when their times differ by no more."""

REACH = 3
"""A keyframe is compared with so many before and after it."""

ACROSS = 8
"""And in so many others that show the same ground, those that are turned most to it."""

MIN_SHOWN = 0.3
"""Minimum share of an image's ground that such another image shows."""

START = SelfCalibrationConfig()

SIGMA_K = 0.25
"""Of k1 and of k2 where nothing states them: wide lenses have a k1 of -0.5 to 0.2."""

MAX_SIGMA_BEND = 0.02
"""A lens found that bends depth at a corner by more is accepted only where its k1 is surer than one
that nothing states, which the scan's sigma then covers."""

EXHAUSTIVE = 60
"""Up to so many images, all pairs are compared, regardless of their poses."""

GROSS_PX = 15.0
"""A sighting further from its landmark takes no part."""

MIN_IMAGES = 3
"""Fewer do not determine a camera."""

MIN_SHARE = 0.5
"""Share of the keyframes whose images the video must hold."""


def images_at(video: Path, start_unix_ns: int, times_ns: Sequence[int]) -> dict[int, U8]:
    """Gray images by the position of the moment in ``times_ns`` they show.

    ``video`` is a recording or a folder of stills.
    """
    found: dict[int, U8] = {}
    source = (open_images if video.is_dir() else open_file)(str(video), {})
    for k, image in frames_near(source, [t - start_unix_ns for t in times_ns], WITHIN_NS):
        if k not in found:
            found[k] = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    if len(found) < max(MIN_IMAGES, MIN_SHARE * len(times_ns)):
        raise InputError(
            f"{video}: holds images of {len(found)} of {len(times_ns)} keyframes; give the video "
            "that the scan was made of"
        )
    return found


def times_of_stills(folder: Path, start_unix_ns: int) -> dict[str, float]:
    """Unix seconds of each still of a folder, by file name; none for a recording."""
    if not folder.is_dir():
        return {}
    with closing(open_images(str(folder), {})) as source:
        return {name: (start_unix_ns + time_ns) / 1e9 for name, time_ns in source.times.items()}


def by_tags(sigma_focal: float) -> SelfCalibrationConfig:
    """A camera whose focal length is known to ``sigma_focal``, a share; images may better it."""
    return replace(START, sigma_focal=sigma_focal, max_sigma_focal=sigma_focal)


def bent(search: SelfCalibrationConfig) -> SelfCalibrationConfig:
    """``search`` for a lens of which nothing states the distortion."""
    return replace(
        search, sigma_k=SIGMA_K, max_sigma_bend=MAX_SIGMA_BEND, covered_sigma_k1=SIGMA_K1
    )


@dataclass(frozen=True, slots=True, eq=False)
class TiedViews:
    """Views tied by their images, adjusted to the features alone."""

    camera: Camera
    poses: F64  # (N, 4, 4) T_world_camera
    points: F64  # (P, 3) world, m; NaN without a place
    seen: Sightings


def sightings(
    images: Mapping[int, U8], camera: Camera, poses: F64, ground_m: float,
    config: SelfCalibrationConfig = START,
) -> TiedViews:  # fmt: skip
    """Landmarks, where they are seen in the distorted images, and poses that agree with them.

    ``images`` by view, with ``poses`` (N, 4, 4) of all views; the ground lies about
    ``ground_m`` up in the world. Images whose ground overlaps are compared, and of few
    images all that look alike. Raises InputError when nothing ties them together.
    """
    views = sorted(images)
    described = run_parallel(*(partial(image_of, images[k], camera) for k in views))
    features = dict(zip(views, described, strict=True))
    overlap = _overlapping(views, camera, poses, ground_m)
    pairs = {(min(a, b), max(a, b)) for a, others in overlap.items() for b in others}
    if len(views) <= EXHAUSTIVE:
        some = [pair for pair in combinations(views, 2) if pair not in pairs]
        alike = run_parallel(*(partial(are_alike, features[a], features[b]) for a, b in some))
        pairs.update(pair for pair, is_alike in zip(some, alike, strict=True) if is_alike)
    seen = joined(features, sorted(pairs), camera)
    if len(seen.view) == 0:
        raise InputError("no place was found again in another image; is this the video?")
    flat = Undistorter(camera)
    stack = lru_cache(maxsize=64)(lambda k: matching.build_pyramid(flat.image(images[k])))
    seen = sharpened(stack, camera, seen)
    known = loosely_placed(poses, seen)
    try:
        found = network(camera, poses, seen, known, camera_information(camera, config))
    except (ValueError, RuntimeError, np.linalg.LinAlgError) as error:
        raise InputError(f"{error}; is this the video?") from error
    poses, points = found.solution.poses, found.solution.points
    own = found.solution.camera
    points = crossings(poses, own, found.seen, len(points))
    overlap = _overlapping(views, own, poses, float(np.nanmedian(points[:, 2])))
    seen = extended(stack, camera, own, poses, points, found.seen, overlap)
    seen = within(own, poses, points, seen, GROSS_PX)
    return TiedViews(own, poses, points, seen)


def _overlapping(
    views: Sequence[int], camera: Camera, poses: F64, ground_m: float
) -> dict[int, list[int]]:
    """For each view its neighbours in time, and of all that show its ground those turned most."""
    W, H = camera.size_px
    v, u = np.mgrid[0.1:0.9:4j, 0.1:0.9:4j]
    grid = rays(camera.K, np.column_stack([u.ravel() * W, v.ravel() * H]))
    T = poses[views]
    ways = grid @ T[:, :3, :3].transpose(0, 2, 1)
    down = np.where(ways[..., 2] < -0.1, ways[..., 2], np.nan)  # the others lead to the horizon
    far = (ground_m - T[:, 2, 3, None]) / down
    grounds = T[:, None, :3, 3] + ways * far[..., None]  # (V, 16, 3)
    middle = grounds.mean(axis=1)
    reach = np.linalg.norm(grounds - middle[:, None], axis=2).max(axis=1)
    out = {}
    for position, k in enumerate(views):
        nearby = views[max(position - REACH, 0) : position + REACH + 1]
        near = np.linalg.norm(middle - middle[position], axis=1) < reach[position]
        turned = []
        for other in (views[i] for i in np.flatnonzero(near)):
            there = se3.transform(se3.inverse(poses[other]), grounds[position])
            uv = project(camera.K, there)
            shown = (there[:, 2] > 0) & (uv >= 0).all(axis=1) & (uv < (W, H)).all(axis=1)
            if other not in nearby and shown.mean() >= MIN_SHOWN:
                R = poses[k][:3, :3].T @ poses[other][:3, :3]
                turned.append((-float(np.linalg.norm(se3.so3_log(R))), other))
        across = [other for _, other in sorted(turned)[:ACROSS]]
        out[k] = [other for other in (*nearby, *across) if other != k]
    return out


def found_camera(
    images: Mapping[int, U8], camera: Camera, poses: F64, ground_m: float, fixes: F64,
    sigma_fixes: F64, config: SelfCalibrationConfig = START,
) -> SelfCalibrated:  # fmt: skip
    """The camera estimated from the flight; InputError, in one line, when it is not determined."""
    tied = sightings(images, camera, poses, ground_m, config)
    try:
        found = self_calibrate(
            camera, tied.poses, tied.points, tied.seen, fixes, sigma_fixes, config
        )
    except ValueError as error:
        raise InputError(str(error)) from error
    except (RuntimeError, np.linalg.LinAlgError) as error:  # an ill-posed problem
        raise InputError("too few corners tie the images together") from error
    if found.why_not:
        raise InputError(found.why_not)
    return found


def write(found: SelfCalibrated, given: Camera, folder: Path) -> dict[str, Any]:
    """Write the camera file into ``folder``; the figures of it."""
    path = folder / FILE
    folder.mkdir(parents=True, exist_ok=True)
    save_camera(path, replace(found.camera, sigma_focal=found.sigma_focal))
    new, old = found.camera, given
    return {
        "camera_file": str(path),
        "focal_px": [round(float(old.K[0, 0]), 2), round(float(new.K[0, 0]), 2)],
        "sigma_focal_percent": round(100.0 * found.sigma_focal, 3),
        "centre_px": [[round(float(v), 1) for v in c.K[:2, 2]] for c in (old, new)],
        "k1_k2": [[round(float(v), 4) for v in c.distortion[:2]] for c in (old, new)],
        "p1_p2": [[round(float(v), 4) for v in c.distortion[2:4]] for c in (old, new)],
        "rms_px": [round(found.rms_before_px, 2), round(found.rms_after_px, 2)],
    }
