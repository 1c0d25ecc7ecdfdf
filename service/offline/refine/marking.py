"""Control points marked by hand: which images show a point, where, and how far the map is off.

Pixels are those of the camera's own image, as in a file of control points; poses are those that
the scan has now, refined or not.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from recon.calibration.tracks import with_distortion, without_distortion
from recon.camera_model import project, rays, scaled
from recon.similarity import Similarity
from recon.types import F64, U8, Camera
from service.errors import InputError, MissingError, SkyreliefError
from service.georeference import LocalFrame
from service.offline.exports.images import frames_at, recording_of
from service.offline.refine.control_points import (
    Candidate,
    ScanImages,
    candidates_of,
    place_by_survey,
    screen,
)
from service.offline.refine.revisions import NEWEST, Revisions
from service.offline.refine.survey_file import Sighting, SurveyPoint, SurveyRow, read_survey
from service.scans.track import camera_of, local_frame
from service.stream.codec import whole_bgr
from service.stream.store import ScanStore

GCP = "gcp.csv"
"""A scan's control points, next to its store."""

MAX_IMAGES = 12
"""Images offered for one point."""

MAX_MARKS = 100
"""Of one point."""

GROUND_FROM = 5
"""Keyframes that the height of the ground is taken from."""

JPEG_QUALITY = 90


@dataclass(frozen=True, slots=True)
class Shown:
    """A point in one image."""

    keyframe_seq: int
    expected_px: tuple[float, float] | None  # None: the place of the scan is not known
    marked_px: tuple[float, float] | None


@dataclass(frozen=True, slots=True)
class Marked:
    """A point, the images that show it, the marked ones among them, and how far the map is off."""

    point: SurveyPoint
    images: list[Shown]
    off_m: tuple[float, float, float] | None  # map less survey: east, north, up
    why_not: str  # what speaks against its marks


class Marking:
    """The control points of an open scan. Raises InputError when it has no keyframes or camera."""

    def __init__(self, store: ScanStore) -> None:
        states = Revisions(store).states(NEWEST)
        if not len(states):
            raise MissingError("no keyframes yet")
        self.camera = camera_of(store.header)
        self._scan = ScanImages(
            states, store.poses(), store.header, lambda k: store.keyframe(states.seqs[k]),
            local_frame(store.header),
        )  # fmt: skip
        self._poses = states.poses
        self._ahead_m = cache(self._distance_m)  # many points have the same images nearest

    def of(self, survey: Sequence[SurveyPoint]) -> list[Marked]:
        """What is known of each point. Raises InputError for marks that the scan cannot have."""
        candidates = candidates_of([p for p in survey if p.sightings], self._scan, GCP)
        frame, to_survey = self._placed(candidates)
        why_not = {one.point.name: one.why_not for one in candidates}
        off = {
            one.point.name: one.off_m(to_survey.points(one.before_m))
            for one in candidates
            if one.before_m is not None and one.surveyed_m is not None
        }
        sound = [off_m for name, off_m in off.items() if not why_not[name]]
        usual = np.asarray(np.median(sound, axis=0)) if sound else np.zeros(3)
        out = []
        for point in survey:
            name = point.name
            expected = None if frame is None else self._expected(point, frame, to_survey, usual)
            off_m = tuple(off[name].tolist()) if name in off else None
            images = self._images(point, expected)
            out.append(Marked(point, images, off_m, why_not.get(name, "")))
        return out

    def _placed(self, candidates: Sequence[Candidate]) -> tuple[LocalFrame | None, Similarity]:
        """The frame of the survey, and what takes the map there; None while it is not known."""
        same = Similarity(1.0, np.eye(3), np.zeros(3))
        if self._scan.frame is not None:
            screen(candidates, self._scan.frame)
            return self._scan.frame, same
        try:
            frame, move = place_by_survey(candidates)
        except InputError:  # too few yet
            return None, same
        for one in candidates:
            one.surveyed_m = one.point.enu(frame)
        return frame, move

    def _expected(
        self, point: SurveyPoint, frame: LocalFrame, to_survey: Similarity, usual: F64
    ) -> F64:
        """(3,) where the map should have a point, off as the marked ones are."""
        spot = point.enu(frame) + usual
        spot = to_survey.R.T @ (spot - to_survey.t) / to_survey.scale
        if point.alt_amsl_m is None:
            spot[2] = self._ground_m(spot)
        return np.asarray(spot)

    def _ground_m(self, spot: F64) -> float:
        """Height of the surface in the keyframes nearest to a place."""
        apart = np.linalg.norm((self._poses[:, :3, 3] - spot)[:, :2], axis=1)
        heights = []
        for k in np.argsort(apart)[:GROUND_FROM]:
            T, ahead_m = self._poses[k], self._ahead_m(int(k))
            if ahead_m is not None:
                heights.append(float(T[2, 3] + ahead_m * T[2, 2]))
        return float(np.median(heights)) if heights else 0.0

    def _distance_m(self, k: int) -> float | None:
        """Median distance of what a keyframe sees, along its axis."""
        keyframe = self._scan.keyframe(k)
        if keyframe is None or not np.isfinite(keyframe.depth.depth_m).any():
            return None
        return float(np.nanmedian(keyframe.depth.depth_m))

    def _images(self, point: SurveyPoint, expected: F64 | None) -> list[Shown]:
        """Those marked, and those that see the point best; any where its place is not known."""
        marked = {s.keyframe_seq: s.uv_px for s in point.sightings if s.keyframe_seq is not None}
        seqs = self._scan.states.seqs
        uv = np.full((len(seqs), 2), np.nan)
        if expected is None:
            step = max(1, len(seqs) // (4 * MAX_IMAGES))
            best = list(range(0, len(seqs), step))
        else:
            uv = self._pixels(expected)
            W, H = self.camera.size_px
            away = np.abs((uv + 0.5) / (W, H) - 0.5).max(axis=1)
            near = np.argsort(np.where(np.isnan(away), np.inf, away), kind="stable")
            best = [int(k) for k in near[:MAX_IMAGES] if away[k] <= 0.5]
        best += [k for k, seq in enumerate(seqs) if seq in marked and k not in best]
        pixel = [None if np.isnan(p).any() else (float(p[0]), float(p[1])) for p in uv]
        return [Shown(seqs[k], pixel[k], marked.get(seqs[k])) for k in best]

    def _pixels(self, spot: F64) -> F64:
        """(N, 2) of a place in the image of each keyframe; NaN behind it and far outside."""
        there = np.einsum("nij,ni->nj", self._poses[:, :3, :3], spot - self._poses[:, :3, 3])
        flat = there / np.where(there[:, 2:] > 1e-6, there[:, 2:], np.nan)
        W, H = self.camera.size_px
        wide = rays(self.camera.K, np.array([[-0.25 * W, -0.25 * H], [1.25 * W, 1.25 * H]]))
        inside = ((flat > wide[0]) & (flat < wide[1]))[:, :2].all(axis=1)
        out = np.full((len(flat), 2), np.nan)
        if inside.any():
            out[inside] = with_distortion(self.camera, project(self.camera.K, flat[inside]))
        return out


def image_of(folder: Path, store: ScanStore, seq: int) -> bytes:
    """A keyframe's image with the lens's distortion, JPEG: the frame of a recording in the scan's
    folder, else what the scan stores, smaller. Raises InputError for an unknown keyframe.
    """
    keyframe = store.keyframe(seq)
    if keyframe is None:
        raise MissingError("no such keyframe")
    bgr = _recorded(folder, store, keyframe.time_ns)
    if bgr is None:
        whole, K = whole_bgr(keyframe, store.image(seq)), keyframe.depth.K
        bgr = _distorted(whole, K, camera_of(store.header))
    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    return cv2.imencode(".jpg", bgr, quality)[1].tobytes()


def _recorded(folder: Path, store: ScanStore, time_ns: int) -> U8 | None:
    """The recording's frame of a moment; None where it is not there."""
    video = recording_of(folder, store.header, within=folder).path
    if video is None:
        return None
    try:
        return next(iter(frames_at([time_ns], store.header, video, None)))[1]
    except (SkyreliefError, StopIteration):
        return None


def _distorted(flat: U8, K: F64, camera: Camera) -> U8:
    """An image (h, w, 3) of a camera ``K`` without distortion, as ``camera`` sees it, in its own
    size."""
    h, w = flat.shape[:2]
    small = scaled(camera, (w, h))
    v, u = np.mgrid[:h, :w].astype(np.float64)
    ways = rays(small.K, without_distortion(small, np.column_stack([u.ravel(), v.ravel()])))
    x, y = project(K, ways).T.reshape(2, h, w).astype(np.float32)
    return np.asarray(cv2.remap(flat, x, y, cv2.INTER_LINEAR), np.uint8)


# ---- the file of a scan --------------------------------------------------------------------------


def marked_file(folder: Path) -> Path | None:
    """The control points of a scan folder, where it has any with a mark."""
    path = folder / GCP
    return path if path.exists() and any(p.sightings for p in read_survey(path)) else None


def without_stills(survey: Sequence[SurveyPoint]) -> list[SurveyPoint]:
    """The points without marks that name a still: its time is known with the folder only."""
    return [replace(p, sightings=tuple(s for s in p.sightings if not s.image)) for p in survey]


def marked(
    survey: Sequence[SurveyPoint], name: str, seq: int, uv_px: tuple[float, float] | None
) -> list[SurveyPoint]:
    """The points with the one mark of ``name`` in a keyframe set, or taken away.

    Raises InputError for an unknown point, or too many marks of it.
    """
    if name not in {p.name for p in survey}:
        raise MissingError(f"no control point {name[:100]!r}")
    return [_marked(p, seq, uv_px) if p.name == name else p for p in survey]


def _marked(point: SurveyPoint, seq: int, uv_px: tuple[float, float] | None) -> SurveyPoint:
    rest = tuple(s for s in point.sightings if s.keyframe_seq != seq)
    if uv_px is None:
        return replace(point, sightings=rest)
    if len(rest) >= MAX_MARKS:
        raise InputError(f"{point.name} has {MAX_MARKS} marks; take one away first")
    return replace(point, sightings=(*rest, Sighting(0, keyframe_seq=seq, uv_px=uv_px)))


def survey_text(survey: Sequence[SurveyPoint]) -> str:
    """The points as a CSV, as :func:`service.offline.refine.survey_file.read_survey` reads it."""
    out = io.StringIO()
    table = csv.writer(out, lineterminator="\n")
    fields = [name for name in SurveyRow.__struct_fields__ if name not in ("name", "image")]
    table.writerow([*fields, "name"])
    for p in survey:
        place = (p.lat_deg, p.lon_deg, p.alt_amsl_m, p.sigma_h_m, p.sigma_v_m)
        role = "check" if p.is_check else "control"
        for s in p.sightings or (Sighting(0),):
            uv, xyz = s.uv_px or (None, None), s.xyz_m or (None, None, None)
            row = (*place, role, s.keyframe_seq, s.time_unix_s, *uv, *xyz, p.name)
            table.writerow(["" if v is None else v for v in row])
    return out.getvalue()
