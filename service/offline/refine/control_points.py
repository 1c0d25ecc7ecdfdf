"""Surveyed points brought onto a scan: marks in its keyframes, and which points to accept."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from recon import se3
from recon.calibration.tracks import without_distortion
from recon.camera_model import project, rays
from recon.similarity import Similarity, umeyama
from recon.survey.ground_control import Mark, consenting, map_position
from recon.types import F64, Keyframe
from service.errors import InputError
from service.georeference import LocalFrame
from service.offline.refine.revisions import KeyframeStates
from service.offline.refine.survey_file import Sighting, SurveyPoint
from service.scans.track import camera_of
from service.stream.records import PoseRecord, ScanHeader

MARK_PX = 1.5
"""How well a point is marked in an image, 1 sigma, with what remains of lens and pose."""

FAR_M = 50.0
"""A point farther from its place in the map is a mistake, whatever the receiver claims."""

STEP_M = 15.0
"""A height off by more than this with the place right is another height reference."""

MAX_VIEWS = 6
"""A point given in the cloud's coordinates is tied to so many keyframes that see it best."""

MAX_TRIPLES = 400


UNKNOWN_HEIGHT_M = 1e4
"""Sigma of the height of a point that was surveyed horizontally only."""

MIN_SPAN = 0.5
"""Share of the track's length that control points should span."""


@dataclass(slots=True, eq=False)
class Candidate:
    """A surveyed point with its marks, and what became of it."""

    point: SurveyPoint
    marks: list[Mark] = field(default_factory=list)
    surveyed_m: F64 | None = None  # (3,) ENU
    before_m: F64 | None = None  # (3,) ENU, where the unrefined map has it
    sigma_before_m: float = 1.0
    why_not: str = ""

    @property
    def usable(self) -> bool:
        """True while no reason against it is known."""
        return not self.why_not

    @property
    def is_control(self) -> bool:
        """True while the adjustment may use it; a check point takes no part."""
        return self.usable and not self.point.is_check

    @property
    def has_height(self) -> bool:
        """False for a point that was surveyed horizontally only."""
        return self.point.alt_amsl_m is not None

    @property
    def sigma_m(self) -> F64:
        """(3,) of the survey."""
        p = self.point
        sigma_v_m = p.sigma_v_m if self.has_height else UNKNOWN_HEIGHT_M
        return np.array([p.sigma_h_m, p.sigma_h_m, sigma_v_m])

    def tolerance_m(self, sigma_mapped_m: float) -> float:
        """Sigma of a difference between survey and map along what was surveyed."""
        p = self.point
        largest = max(p.sigma_h_m, p.sigma_v_m) if self.has_height else p.sigma_h_m
        return float(np.hypot(largest, sigma_mapped_m))

    def off_m(self, place_m: F64) -> F64:
        """(3,) from the surveyed place to ``place_m``; 0 along a height that is not known."""
        assert self.surveyed_m is not None
        off: F64 = place_m - self.surveyed_m
        return off if self.has_height else off * (1.0, 1.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class ScanImages:
    """Parts of a scan that marks refer to."""

    states: KeyframeStates
    frames: Sequence[PoseRecord]
    header: ScanHeader
    keyframe: Callable[[int], Keyframe | None]
    frame: LocalFrame | None


def candidates_of(survey: Sequence[SurveyPoint], scan: ScanImages, path: str) -> list[Candidate]:
    """The survey's points with their marks. Raises InputError, with the line, for bad marks."""
    out = []
    for number, point in enumerate(survey):
        one = Candidate(point)
        for seen in point.sightings:
            where = f"{path} line {seen.line}: {point.name}"
            if seen.xyz_m is not None:
                one.marks += _in_map(seen, number, scan, where)
            else:
                one.marks.append(_in_image(seen, number, scan, where))
        found = map_position(scan.states.poses, np.ones(len(scan.states)), one.marks)
        if found is None:
            one.why_not = "the map has no surface at its mark; mark it in a second image"
        else:
            one.before_m, one.sigma_before_m = found
        out.append(one)
    return out


# ---- marks -------------------------------------------------------------------------------------


def _in_image(seen: Sighting, number: int, scan: ScanImages, where: str) -> Mark:
    """A mark from pixels of the camera's own, distorted image."""
    assert seen.uv_px is not None
    camera, (u, v) = camera_of(scan.header), seen.uv_px
    width, height = camera.size_px
    if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
        raise InputError(
            f"{where}: pixel {u:g}, {v:g} is outside the camera's image of {width}x{height}"
        )
    ray = rays(camera.K, without_distortion(camera, np.array([[u, v]])))[0]
    sigma = MARK_PX / float(camera.K[0, 0])
    index, T = _image(seen, scan, where)
    if not np.array_equal(T, np.eye(4)):
        return Mark(number, index, ray, sigma, T_key_camera=T)
    depth = _surface_at(scan.keyframe(index), ray)
    if depth is None:
        return Mark(number, index, ray, sigma)
    return Mark(number, index, ray, sigma, depth[0], depth[1])


def _image(seen: Sighting, scan: ScanImages, where: str) -> tuple[int, F64]:
    """The keyframe that a mark refers to, and the image's pose in its camera."""
    seqs, keys = scan.states.seqs, scan.states.times_ns
    if seen.keyframe_seq is not None:
        if seen.keyframe_seq not in seqs:
            near = min(seqs, key=lambda s: abs(s - (seen.keyframe_seq or 0)))
            raise InputError(f"{where}: no keyframe {seen.keyframe_seq}; the nearest is {near}")
        return seqs.index(seen.keyframe_seq), np.eye(4)
    assert seen.time_unix_s is not None
    time_ns = round(seen.time_unix_s * 1e9)
    nearest = int(np.argmin(np.abs(keys - time_ns)))
    if abs(int(keys[nearest]) - time_ns) < 2_000_000:
        return nearest, np.eye(4)
    times = np.array([f.time_unix_ns for f in scan.frames])
    k = int(np.argmin(np.abs(times - time_ns))) if len(times) else -1
    if k < 0 or abs(int(times[k]) - time_ns) > 20_000_000:
        raise InputError(f"{where}: no image within 20 ms of time {seen.time_unix_s:.3f}")
    T = se3.inverse(scan.states.poses[nearest]) @ scan.frames[k].T_world_camera
    return nearest, T


def _surface_at(keyframe: Keyframe | None, ray: F64) -> tuple[float, float] | None:
    """Depth and sigma of a keyframe's surface along a ray; None where it has none."""
    if keyframe is None:
        return None
    depth = keyframe.depth
    h, w = depth.depth_m.shape
    u, v = np.rint(project(depth.K, ray[None])[0]).astype(int)
    box = np.s_[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2]
    if not (0 <= u < w and 0 <= v < h):
        return None
    near, sigma = depth.depth_m[box], depth.sigma_m[box]
    known = np.isfinite(near)
    if not known.any():
        return None
    middle = float(np.median(near[known]))
    spread = float(np.ptp(near[known]))
    pixel_m = middle / float(depth.K[0, 0])
    noise = float(np.nan_to_num(np.median(sigma[known]), nan=1.0))
    return middle, float(np.sqrt(noise**2 + (0.5 * spread) ** 2 + (0.1 * pixel_m) ** 2))


def _in_map(seen: Sighting, number: int, scan: ScanImages, where: str) -> list[Mark]:
    """Marks in the keyframes whose surface holds a point of the unrefined cloud."""
    assert seen.xyz_m is not None
    place = np.array([seen.xyz_m])
    spot = place[0] if scan.frame is None else scan.frame.from_utm(place)[0]
    found = []
    for index, T in enumerate(scan.states.poses):
        p = se3.transform(se3.inverse(T), spot[None])[0]
        if p[2] <= 0 or np.abs(p[:2]).max() > 3.0 * p[2]:
            continue
        surface = _surface_at(scan.keyframe(index), p / p[2])
        if surface is None or abs(surface[0] - p[2]) > 4.0 * surface[1] + 0.01 * p[2]:
            continue
        sigma = 0.5 / float(scan.header.camera["K"][0]) if "K" in scan.header.camera else 1e-3
        found.append(Mark(number, index, p / p[2], sigma, float(p[2]), surface[1]))
    if not found:
        raise InputError(
            f"{where}: no surface at x,y,z; give coordinates of the cloud as it was delivered "
            "before any refinement"
        )
    return sorted(found, key=lambda m: m.sigma_depth_m)[:MAX_VIEWS]


# ---- which points to accept ----------------------------------------------------------------------


def screen(candidates: Sequence[Candidate], frame: LocalFrame) -> None:
    """Note against each point what speaks against it: far off, or against all the others."""
    for one in candidates:
        one.surveyed_m = one.point.enu(frame)
    _lift(candidates)
    for one in candidates:
        if one.usable and one.before_m is not None:
            one.why_not = _far(one, frame)
    voters = [c for c in candidates if c.is_control]
    if len(voters) < 2:
        return
    surveyed = np.array([c.surveyed_m for c in voters])
    mapped = np.array([c.before_m for c in voters])
    sigma = np.array([c.tolerance_m(c.sigma_before_m) for c in voters])
    agree = consenting(surveyed, mapped, sigma)
    usual = np.median((surveyed - mapped)[agree], axis=0)
    if len(voters) == 2 and not agree.all():
        apart = float(np.linalg.norm((surveyed - mapped)[0] - (surveyed - mapped)[1]))
        for one in voters:
            other = next(c for c in voters if c is not one)
            one.why_not = f"contradicts {other.point.name} by {apart:.2f} m; a third would decide"
        return
    for one, fits, off in zip(voters, agree, surveyed - mapped - usual, strict=True):
        if not fits:
            one.why_not = f"{_in_words(off)} against the other points"
    while (odd := _odd_one([c for c in voters if c.usable])) is not None:
        one, off = odd
        one.why_not = f"{_in_words(off)} from where the other points put it"


def _in_words(off_m: F64) -> str:
    return f"{off_m[0]:+.2f} m east, {off_m[1]:+.2f} m north, {off_m[2]:+.2f} m up"


def _lift(candidates: Sequence[Candidate]) -> None:
    """Give points without a surveyed height the map's, shifted as the other points' heights are."""
    steps = [
        c.surveyed_m[2] - c.before_m[2]
        for c in candidates
        if c.has_height and c.surveyed_m is not None and c.before_m is not None
    ]
    step = float(np.median(steps)) if steps else 0.0
    for one in candidates:
        if not one.has_height and one.surveyed_m is not None and one.before_m is not None:
            one.surveyed_m[2] = one.before_m[2] + step


def _odd_one(voters: Sequence[Candidate]) -> tuple[Candidate, F64] | None:
    """The point that lies farthest from where a similarity of all others puts it, and its offset.

    None when every point lies within its tolerance: its sigmas, 1 % of the distance to the
    others' middle, and 0.2 m for what bends a map. It takes five points to find the wrong one.
    """
    if len(voters) < 5:
        return None
    surveyed = np.array([c.surveyed_m for c in voters])
    mapped = np.array([c.before_m for c in voters])
    worst, by = None, 1.0
    for k, one in enumerate(voters):
        others = np.arange(len(voters)) != k
        found = umeyama(mapped[others], surveyed[others])
        if found is None:
            return None
        off = surveyed[k] - found.points(mapped[k])
        away = float(np.linalg.norm(mapped[k] - mapped[others].mean(axis=0)))
        sigma = one.tolerance_m(one.sigma_before_m)
        ratio = float(np.linalg.norm(off)) / (4.0 * sigma + 0.01 * away + 0.2)
        if ratio > by:
            worst, by = (one, off), ratio
    return worst


def clustered(candidates: Sequence[Candidate], places_m: F64) -> str:
    """A warning when the control points span little of the track (N, 3); empty otherwise."""
    points = [c.surveyed_m for c in candidates if c.is_control and c.surveyed_m is not None]
    if not points:
        return ""
    about = places_m[:, :2] - places_m[:, :2].mean(axis=0)
    along = np.linalg.svd(about, full_matrices=False)[2][0]
    flown = float(np.ptp(places_m[:, :2] @ along))
    span = float(np.ptp(np.array(points)[:, :2] @ along))
    if span >= MIN_SPAN * flown:
        return ""
    return (
        f"the control points span {span:.0f} m of {flown:.0f} m flown: away from them the map "
        "rests on the flight's own readings; spread them over the whole site"
    )


def _far(one: Candidate, frame: LocalFrame) -> str:
    """The fault of a point far from its place in the map; else empty."""
    assert one.surveyed_m is not None and one.before_m is not None
    off = one.surveyed_m - one.before_m
    flat, up = float(np.linalg.norm(off[:2])), float(off[2])
    if flat > FAR_M:
        p = one.point
        for lat, lon, hint in (
            (p.lon_deg, p.lat_deg, "lat and lon are swapped"),
            (-p.lat_deg, p.lon_deg, "lat has the wrong sign"),
            (p.lat_deg, -p.lon_deg, "lon has the wrong sign"),
            (-p.lat_deg, -p.lon_deg, "lat and lon have the wrong sign"),
        ):
            if abs(lat) > 90.0:
                continue
            there = replace(p, lat_deg=lat, lon_deg=lon).enu(frame)
            if np.linalg.norm((there - one.before_m)[:2]) < 20.0 * FAR_M:
                return f"{_metres(flat)} from its place in the map: {hint}"
        return f"{_metres(flat)} from its place in the map: wrong point, zone or sign"
    if abs(up) > STEP_M:
        return (
            f"{up:+.1f} m in height from its place in the map: heights must be above mean sea "
            "level, not above the ellipsoid"
        )
    return ""


def _metres(value: float) -> str:
    return f"{value / 1000:.0f} km" if value >= 10_000 else f"{value:.0f} m"


def place_by_survey(candidates: Sequence[Candidate]) -> tuple[LocalFrame, Similarity]:
    """Origin of a scan without a place, and what moves it there, from three points or more.

    Points that the largest agreeing set contradicts are noted. Where a height is not known the
    map's vertical and its zero of heights hold. Raises InputError when there are too few, they
    lie in a line, or no three agree with the map.
    """
    voters = [c for c in candidates if c.is_control]
    if len(voters) < 3:
        raise InputError(
            f"the scan has no georeference and only {len(voters)} usable control points; three "
            "that are not in a line can place it"
        )
    heights = [c.point.alt_amsl_m for c in voters if c.point.alt_amsl_m is not None]
    first = voters[0].point
    frame = LocalFrame(first.lat_deg, first.lon_deg, heights[0] if heights else 0.0)
    level = len(heights) < len(voters)
    surveyed = np.array([c.point.enu(frame) for c in voters])
    mapped = np.array([c.before_m for c in voters])
    best, most = None, np.zeros(len(voters), np.bool_)
    for triple in list(combinations(range(len(voters)), 3))[:MAX_TRIPLES]:
        found = _placed(mapped[list(triple)], surveyed[list(triple)], level)
        if found is None or not 1e-3 < found.scale < 1e3:
            continue
        off = found.points(mapped) - surveyed
        away = np.linalg.norm(off[:, :2] if level else off, axis=1)
        fits = away < 0.02 * np.ptp(surveyed[:, :2], axis=0).max() + 0.3
        if best is None or fits.sum() > most.sum():
            best, most = found, fits
    if best is None:
        raise InputError("the control points lie in a line; one off that line is needed")
    if most.sum() >= 3:
        best = _placed(mapped[most], surveyed[most], level)
    if most.sum() < 3 or best is None:
        raise InputError(
            "no three control points have the same distances in the map and in the survey, "
            "within 2 % of the site; check the marks and the camera model"
        )
    for one, fits in zip(voters, most, strict=True):
        if not fits:
            one.why_not = "contradicts the other points"
    return frame, best


def _placed(mapped_m: F64, surveyed_m: F64, level: bool) -> Similarity | None:
    """From map to survey, each (N, 3); None where they leave it open.

    ``level``: not every height is known, so the map's own vertical holds, and its height of zero.
    """
    if not level:
        return umeyama(mapped_m, surveyed_m)
    flat = np.array([1.0, 1.0, 0.0])
    if np.ptp(mapped_m[:, :2], axis=0).max() < 1e-6:
        return None
    return umeyama(mapped_m * flat, surveyed_m * flat, is_level=True)
