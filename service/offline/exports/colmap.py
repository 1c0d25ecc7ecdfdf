"""The flight for other reconstruction tools: a COLMAP model with the frames and their tracks.

The text model of https://colmap.github.io/format.html, from which COLMAP's bundle adjustment and
the training of splats go on.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from recon import se3
from recon.calibration.flight import shared
from recon.calibration.global_bundle import Sightings, errors_px
from recon.calibration.tracks import crossings, without_distortion
from recon.camera_model import Undistorter
from recon.types import F64, U8, Camera, Keyframe
from service.errors import InputError
from service.offline.exports.images import frames_at, recording_for
from service.offline.exports.view import ExportOptions, ScanView
from service.offline.refine.own_camera import sightings
from service.scans.main_piece import main_keyframes
from service.scans.track import camera_of
from service.scans.writing import writing_folder
from service.stream.codec import whole_bgr

JPEG_QUALITY = 95


def write_colmap(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """A folder: ``images/`` and ``sparse/0/`` with cameras, images and points as text.

    World coordinates are the scan's ENU metres, poses are the scan's. Images are the recording's
    frames at full size without distortion, or those that the scan stores where there is no
    recording; points are places that at least two of them show, with the pixels where they do.
    Raises InputError where neither shows whole images.
    """
    header, keyframes = scan.store.header, list(main_keyframes(scan.store))
    video = recording_for(scan, options).path
    frames: Iterable[tuple[int, U8]]
    if video is not None:
        camera = camera_of(header)
        frames = frames_at(
            [k.time_ns for k in keyframes], header, video, options.video_epoch_ns, scan.progress
        )
    else:
        camera, frames = _stored(scan, keyframes)
    with writing_folder(out) as part:
        (part / "images").mkdir()
        model = part / "sparse" / "0"
        model.mkdir(parents=True)
        undistort, gray = Undistorter(camera), dict[int, U8]()
        for n, frame in frames:
            gray[n] = np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), np.uint8)
            quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
            path = part / "images" / _name(keyframes[n])
            cv2.imwrite(str(path), undistort.image(frame), quality)
        scan.progress("matching the images")
        poses = np.array([k.depth.T_world_camera for k in keyframes])
        points, seen = _tracks(gray, camera, poses, keyframes)
        uv = without_distortion(camera, seen.uv_px)
        rgb = _colours(part / "images", keyframes, seen, uv, len(points))
        (model / "cameras.txt").write_text(_pinhole(camera), encoding="ascii")
        errors = errors_px(camera, poses, points, seen)
        _write_images(model / "images.txt", {n: keyframes[n] for n in sorted(gray)}, seen, uv)
        _write_points(model / "points3D.txt", keyframes, points, rgb, errors, seen)


def _stored(
    scan: ScanView, keyframes: Sequence[Keyframe]
) -> tuple[Camera, Iterator[tuple[int, U8]]]:
    """The camera of the stored keyframes, and their whole images; InputError without these."""
    images = [scan.store.image(k.seq) for k in keyframes]
    if not keyframes or None in images:
        raise InputError(
            f"{scan.folder}: colmap needs whole frames; this scan stores none, and its recording "
            "is not where it was; give --video"
        )
    depth = keyframes[0].depth
    h, w = depth.depth_m.shape
    scan.progress(f"images of {w}x{h} from the scan itself; --video gives those of full size")
    whole = (whole_bgr(k, image) for k, image in zip(keyframes, images, strict=True))
    return Camera(depth.K, np.zeros(5), (w, h)), enumerate(whole)


def _tracks(
    gray: dict[int, U8], camera: Camera, poses: F64, keyframes: Sequence[Keyframe]
) -> tuple[F64, Sightings]:
    """(P, 3) world points and their sightings, each landmark seen at least twice."""
    ahead_m = float(np.median([np.nanmedian(k.depth.depth_m) for k in keyframes]))
    ground_m = float(np.median((poses[:, :3, 3] + ahead_m * poses[:, :3, 2])[:, 2]))
    seen = sightings(gray, camera, poses, ground_m).seen
    count = int(seen.landmark.max()) + 1
    points = crossings(poses, camera, seen, count)
    is_known = np.asarray(np.isfinite(points[seen.landmark]).all(axis=1), np.bool_)
    seen = shared(seen, is_known)
    used, landmark = np.unique(seen.landmark, return_inverse=True)
    return points[used], Sightings(seen.view, np.asarray(landmark, np.int64), seen.uv_px)


def _colours(
    folder: Path, keyframes: Sequence[Keyframe], seen: Sightings, uv: F64, count: int
) -> U8:
    """(P, 3) RGB of each point in the last image that shows it."""
    rgb = np.zeros((count, 3), np.uint8)
    for n in np.unique(seen.view):
        image = cv2.imread(str(folder / _name(keyframes[n])))
        assert image is not None
        rows = np.flatnonzero(seen.view == n)
        u, v = np.rint(uv[rows]).astype(int).T
        h, w = image.shape[:2]
        rgb[seen.landmark[rows]] = image[np.clip(v, 0, h - 1), np.clip(u, 0, w - 1), ::-1]
    return rgb


def _pinhole(camera: Camera) -> str:
    """The line of the camera in COLMAP's pixels, whose centres lie at halves."""
    (w, h), K = camera.size_px, camera.K
    focal = f"{K[0, 0]:.9g} {K[1, 1]:.9g} {K[0, 2] + 0.5:.9g} {K[1, 2] + 0.5:.9g}"
    return f"1 PINHOLE {w} {h} {focal}\n"


def _name(one: Keyframe) -> str:
    return f"keyframe_{one.seq:06d}.jpg"


def _write_images(path: Path, shown: dict[int, Keyframe], seen: Sightings, uv: F64) -> None:
    """Two lines an image: world to camera, then the pixels of its points."""
    with path.open("w", encoding="ascii") as file:
        for n, one in shown.items():
            T = se3.inverse(one.depth.T_world_camera)
            q = se3.quaternion_from_rotation(T[:3, :3])
            numbers = " ".join(f"{v:.9f}" for v in (*q, *T[:3, 3]))
            rows = np.flatnonzero(seen.view == n)
            spots = " ".join(
                f"{u:.3f} {v:.3f} {k + 1}"
                for (u, v), k in zip(uv[rows] + 0.5, seen.landmark[rows], strict=True)
            )
            file.write(f"{one.seq + 1} {numbers} 1 {_name(one)}\n{spots}\n")


def _write_points(
    path: Path, keyframes: Sequence[Keyframe], points: F64, rgb: U8, errors: F64, seen: Sightings
) -> None:
    """A line a point: place, colour, mean error in px, and (image, place in its list) pairs."""
    error = np.bincount(seen.landmark, errors) / np.bincount(seen.landmark)
    listed = np.zeros(len(keyframes), np.int64)  # so far, of each image
    track: list[list[str]] = [[] for _ in points]
    for view, landmark in zip(seen.view, seen.landmark, strict=True):
        track[landmark].append(f"{keyframes[view].seq + 1} {listed[view]}")
        listed[view] += 1
    with path.open("w", encoding="ascii") as file:
        for k, ((x, y, z), (r, g, b)) in enumerate(zip(points, rgb, strict=True)):
            place = f"{x:.4f} {y:.4f} {z:.4f}"
            file.write(f"{k + 1} {place} {r} {g} {b} {error[k]:.3f} {' '.join(track[k])}\n")
