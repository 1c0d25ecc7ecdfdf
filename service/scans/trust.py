"""How far a scan can be trusted: ``quality.trust`` of scan.json, a level with its reasons; and the
sigma of heights in the world: a point's own, and what the points around it share."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Any

import numpy as np

from recon.plane import plane_through
from recon.tracking.frame import CONTRADICTED, TWO_ONLY
from recon.types import F32, F64, Array
from service.scans.main_piece import main_track
from service.stream.records import PoseRecord
from service.stream.store import ScanStore

MAX_SCALE_SIGMA = 0.05  # a less certain scale is not a measurement

MAX_SLOPE_DEG = 30.0
"""Above this slope, with an assumed view direction, the site was not seen from above."""

MAX_LEAN_SIGMA_DEG = 2.0
"""Above this sigma of what is level, slopes are in doubt: cameras that look 15 degrees ahead make
level ground lean by 10."""

HALF = 0.5  # of a focal length: a change beyond it is found, but not its size

MIN_LENS_SIGMA, MAX_LENS_SIGMA = 0.01, 0.1
"""Sigma of a focal length above which heights are in doubt, and above which the shape is; so, too,
where positions and heights give scales that differ by more, as after a zoom."""

PRESSURE_SIGMA_M = 70.0
"""Of an altitude by the air pressure of the standard atmosphere, as DJI's drones without RTK state
it: 8.4 m for each hPa of the weather, whose sigma is about 8 hPa."""

MAX_NUMBER = 1e12  # a larger figure in a summary is none: a peer's may be anything that JSON can be

NO_ALTITUDE = "no altitude"  # of what is assumed in a scan

BENDS = {"lens": 0.02, "distortion": 0.01}
"""Sigma of depth over depth by what is assumed of the lens: it bends surfaces by so much."""

MIN_PLACED_SHARE = 0.5  # share of the frames; below it vision was lost for most of the flight

REFUSED_SHARE, WRONG_SHARE = 0.2, 0.5
"""Of the measured positions or attitudes, that contradict the track. Above the first, positions are
less certain than sigma says; above the second, either may be wrong. Where depths of more than the
second contradict each other, those of the other views may agree by chance."""

LEVELS_DIFFER = "attitudes and positions contradict each other on what is level"

OVER_CLAIM = 2.0
"""Positions that scatter so many times as far as they claim are reported, and vision's scale that
changes as many times as far as usual."""

MAX_LATENCY_MS, LATENCY_SIGMAS = 10.0, 5.0
"""A camera's latency by the images that differs from the one applied by both is another one."""

SCALE_KINDS = ("scale", "loop scale")
"""Residuals of the pose graph that show it."""

MAX_REFUTED_SHARE = 0.05
"""Of the steps of the track; where vision is refuted more often, it errs elsewhere by as much as
attitude and positions do not show."""

MAX_PIXELS_OFF = 10.0
"""Median sigma of the points in pixels on the ground, above which the shape is in doubt: where
images match to a pixel, not to the usual twentieth of one, pairs a tenth of the height apart err
by so much."""

BY_SURVEY = "control points"  # georeference of a scan that control points have placed

FIRST_TELEMETRY = "first telemetry"
"""``scale.from`` of a scan whose segments are all too short to be fitted to telemetry."""


class Trust(Enum):
    """Quantities that may be measured in a scan, from the most to the least."""

    GEOREFERENCED = "georeferenced"  # positions and distances
    SCALED = "scaled"  # distances, without georeference
    RELATIVE = "relative"  # shapes, of unknown size
    DOUBTFUL = "doubtful"  # not even the shape is certain


def trust_of(
    run: Mapping[str, Any],
    georeference: str,
    slope_deg: float = 0.0,
    points: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """The level as ``level`` and what limits it as ``reasons``, both for scan.json.

    Args:
        run: figures of the scan's run: ``assumed``, ``sigma_focal``, ``scale``,
            ``lean_sigma_deg``, ``frames``, ``frames_tracked``, ``keyframes``, ``drops``, ``graph``.
            Missing or malformed ones limit nothing.
        georeference: of the scan's header; "none" without.
        slope_deg: of the plane through the cloud.
        points: ``sigma_median_m`` and ``ground_sample_m`` of the cloud.
    """
    assumed = _assumed(run)
    scale = run.get("scale")
    sigma = _number(scale, "sigma")
    doubts = []
    focal = _number(run, "sigma_focal") or 0.0
    if "lens" in assumed:
        doubts.append("the lens is assumed: shapes bend; calibrate the camera")
    elif focal > MAX_LENS_SIGMA:
        doubts.append(_uncertain(focal))
    if "turn" in assumed:
        doubts.append(
            "the view is narrower than 3 degrees: how far the ground is and how the camera turns "
            "cannot be told apart"
        )
    if "view" in assumed and slope_deg > MAX_SLOPE_DEG:
        doubts.append(
            f"the view direction is assumed, and the site slopes by {slope_deg:.0f} degrees"
        )
    if "level" in assumed:
        doubts.append("no attitude, and not seen from straight above: the ground is taken as level")
    frames, tracked = _number(run, "frames"), _number(run, "frames_tracked")
    in_pairs = _number(run.get("drops"), TWO_ONLY) or 0.0  # frames that nothing confirms
    placed = max((tracked or 0.0) - in_pairs, 0.0)
    is_placed = placed > 0.0 and placed >= MIN_PLACED_SHARE * ((frames or 0.0) - 1)
    if frames and tracked is not None and not is_placed:
        doubts.append(f"vision placed only {placed:.0f} of {frames:.0f} frames")
    dropped = _number(run.get("drops"), CONTRADICTED) or 0.0
    keyframes = _number(run, "keyframes")
    matched = dropped + (keyframes or 0.0)
    if keyframes is not None and dropped > WRONG_SHARE * matched:
        doubts.append(f"the depths of {dropped:.0f} of {matched:.0f} views contradict each other")
    for why, views in (("tilt off", "attitudes"), ("view off", "assumed view directions")):
        tilted, attitudes = _refused(run, "attitude", why)
        if tilted > WRONG_SHARE * attitudes:
            doubts.append(f"{tilted:.0f} of {attitudes:.0f} {views} contradict the images")
    refused, measured = _refused(run, "position", "position off")
    contradicted = f"{refused:.0f} of {measured:.0f} positions contradict the track"
    if refused > WRONG_SHARE * measured:
        doubts.append(contradicted)
    ratio = _number(scale, "gnss_over_heights")
    if ratio and max(ratio, 1.0 / ratio) > 1.0 + MAX_LENS_SIGMA:
        doubts.append(f"{scales_differ(ratio)}: the lens, positions or heights are wrong")
    broken, steps = _refused(run, "vision", "vision off")
    refuted = f"{broken:.0f} of {steps:.0f} steps of vision contradict attitude and positions"
    if broken > MAX_REFUTED_SHARE * steps:
        doubts.append(f"{refuted}: the images are too poor")
    sigma_m, sample_m = _number(points, "sigma_median_m"), _number(points, "ground_sample_m")
    if sigma_m and sample_m and sigma_m > MAX_PIXELS_OFF * sample_m:
        doubts.append(
            f"half of the points are uncertain by {sigma_m:.1f} m or more, "
            f"{sigma_m / sample_m:.0f} pixels on the ground: the images match too poorly"
        )
    unsized = []
    if "start" in assumed:
        unsized.append("when the recording began is assumed, and no turn confirms it")
    if "height" in assumed:
        unsized.append("the scale comes from an assumed height above ground")
    elif isinstance(scale, Mapping) and scale.get("from") == FIRST_TELEMETRY:
        unsized.append("too few keyframes in a row to measure the scale")
    elif sigma is not None and sigma > MAX_SCALE_SIGMA:
        unsized.append(f"the scale is uncertain by {100.0 * sigma:.0f} % (1 sigma)")
    if doubts or unsized:
        return _said(Trust.DOUBTFUL if doubts else Trust.RELATIVE, doubts + unsized)
    if georeference == "none":
        return _said(Trust.SCALED, ["no positions: the scan has its own origin and heading"])
    limits = []
    if "distortion" in assumed:
        limits.append(
            "the lens's distortion is unknown: surfaces bend by a percent of the distance"
        )
    if focal > MIN_LENS_SIGMA:
        limits.append(_uncertain(focal))
    if NO_ALTITUDE in assumed and georeference != BY_SURVEY:
        limits.append(
            "no position has an altitude, or all say 0: heights are above the scan's origin, not "
            "above sea level; give control points"
        )
    elif "altitude" in assumed and georeference != BY_SURVEY:
        limits.append(
            "the altitudes are those of the air pressure in standard weather: all heights above "
            f"sea level err by {PRESSURE_SIGMA_M:.0f} m together (1 sigma); give control points"
            if "pressure" in assumed
            else "the altitudes state no accuracy: all heights above sea level may be off by tens "
            "of metres together"
        )
    lean_deg = _number(run, "lean_sigma_deg")
    if lean_deg is not None and lean_deg > MAX_LEAN_SIGMA_DEG:
        limits.append(
            f"{'the view direction is assumed' if 'view' in assumed else LEVELS_DIFFER}: all may "
            f"lean by {lean_deg:.0f} degrees; control points level it, or more strips flown both "
            "ways"
        )
    if broken:
        limits.append(f"{refuted}: what they show is left out")
    if refused > REFUSED_SHARE * measured:
        limits.append(f"{contradicted}: they are less certain than sigma says")
    over = _number(run.get("graph"), "over_claim") or 1.0
    if over > OVER_CLAIM:
        limits.append(f"positions scatter {over:.1f} times as far as they claim: sigma follows it")
    if ratio:
        limits.append(scales_differ(ratio))
    if (late := _latency_off(run)) is not None:
        limits.append(f"{late}: the map is shifted along the flight; set camera.latency_ms")
    wander = _scale_wander(run)
    if wander > OVER_CLAIM:
        limits.append(
            f"vision's scale changes {wander:.1f} times as far as usual: is the image stabilised "
            "in the camera, or the lens another one?"
        )
    return _said(Trust.GEOREFERENCED, limits)


def _latency_off(run: Mapping[str, Any]) -> str | None:
    """A sentence on a camera's latency that is surely another one than that applied, or None."""
    latency = _part(run, "camera_latency")
    found, sigma = _number(latency, "estimate_ms"), _number(latency, "sigma_ms")
    applied = _number(latency, "applied_ms")
    if found is None or sigma is None or applied is None:
        return None
    if not is_another_latency(found, sigma, applied):
        return None
    return f"the images show a camera latency of {found:.0f} ms, {applied:.0f} ms are applied"


def is_another_latency(found_ms: float, sigma_ms: float, applied_ms: float) -> bool:
    return abs(found_ms - applied_ms) > max(MAX_LATENCY_MS, LATENCY_SIGMAS * sigma_ms)


def _uncertain(sigma_focal: float) -> str:
    share = f"{100.0 * sigma_focal:.0f} %" if sigma_focal < HALF else "more than half"
    return (
        f"the focal length is uncertain by {share} (1 sigma): heights err by as much of the "
        "distance; calibrate the camera"
    )


def _refused(run: Mapping[str, Any], kind: str, why: str) -> tuple[float, float]:
    """Number of readings of a kind that the pose graph left out, and of all."""
    refused = _number(_part(run.get("graph"), "left_out"), why) or 0.0
    return refused, refused + (_number(_residuals(run).get(kind), "count") or 0.0)


def _scale_wander(run: Mapping[str, Any]) -> float:
    """How many times further vision's scale changes along the track and over loops than usual, 1 at
    least."""
    residuals = _residuals(run)
    return max([1.0, *(_number(residuals.get(kind), "rms") or 0.0 for kind in SCALE_KINDS)])


def _residuals(run: Mapping[str, Any]) -> Mapping[str, Any]:
    """Of the pose graph, by the kind of reading."""
    return _part(run.get("graph"), "residuals")


def scales_differ(gnss_over_heights: float) -> str:
    """A sentence on two scales of a scan by their ratio."""
    which, ratio = "larger", gnss_over_heights
    if ratio < 1.0:
        which, ratio = "smaller", 1.0 / ratio
    percent = 100.0 * (ratio - 1.0)
    return f"GNSS makes the map {percent:.0f} % {which} than the height above ground does"


def scale_sigma(run: Mapping[str, Any], georeference: str) -> float | None:
    """Relative sigma of the scale as the flight measured it, of the focal length, which scales
    heights, and of positions and heights that contradict each other: as unsure as they are apart.

    None where nothing measured it, or where control points gave a better one.
    """
    scale = run.get("scale")
    sigma = None if georeference == BY_SURVEY else _number(scale, "sigma")
    if sigma is None:
        return None
    ratio = _number(scale, "gnss_over_heights") or 0.0
    apart = math.log(ratio) if ratio > 0.0 else 0.0
    sigma *= _scale_wander(run)
    return math.hypot(sigma, _number(run, "sigma_focal") or 0.0, apart)


def depth_share(run: Mapping[str, Any], georeference: str) -> float | None:
    """Sigma of depth over depth that all points share, by scale and lens; None where heights in the
    world are not measured."""
    scale = 0.0 if georeference == BY_SURVEY else scale_sigma(run, georeference)
    if georeference == "none" or scale is None:
        return None
    return math.hypot(scale, *(BENDS[what] for what in BENDS if what in _assumed(run)))


def _assumed(run: Mapping[str, Any]) -> list[Any]:
    assumed = run.get("assumed")
    return assumed if isinstance(assumed, list) else []


def _said(level: Trust, reasons: list[str]) -> dict[str, Any]:
    return {"level": level.value, "reasons": reasons}


def _part(document: Any, key: str) -> Mapping[str, Any]:
    part = document.get(key) if isinstance(document, Mapping) else None
    return part if isinstance(part, Mapping) else {}


def _number(document: Any, key: str) -> float | None:
    value = document.get(key) if isinstance(document, Mapping) else None
    if isinstance(value, int | float) and abs(value) < MAX_NUMBER:
        return float(value)
    return None


def slope_deg(xyz_m: Array) -> float:
    """The angle in degrees between the plane through points (N, 3) and the horizontal. 0 for fewer
    than three points."""
    if len(xyz_m) < 3:
        return 0.0
    normal, _ = plane_through(xyz_m[:: max(1, len(xyz_m) // 20_000)].astype(np.float64))
    return float(np.degrees(np.arccos(min(1.0, abs(normal[2])))))


MAX_POSES = 5000  # of the track, that are asked; sigma of the position changes slowly along it


class SharedSigma:
    """Sigma of the height that points near a place share: of position, scale, lens and datum."""

    def __init__(self, poses: Sequence[PoseRecord], share: float, datum_m: float = 0.0) -> None:
        """``share`` of a depth is its sigma by scale and lens, ``datum_m`` that of all heights."""
        poses = poses[:: 1 + len(poses) // MAX_POSES]
        places = np.array([p.T_world_camera[:3, 3] for p in poses])
        from scipy.spatial import cKDTree  # a flight does without it

        self._near, self._up_m = cKDTree(places[:, :2]), places[:, 2]
        self._sigma_m = np.array([p.sigma_h_v_m[1] for p in poses])
        self._share, self._datum_m = share, datum_m

    def absolute_m(self, own_m: F32, places_m: F32 | F64) -> F32:
        """(N,) sigma of the heights of (N, 3) ENU m whose own sigmas are (N,)."""
        at = self._near.query(places_m[:, :2])[1]
        by_depth = self._share * (self._up_m[at] - places_m[:, 2])
        whole_m = np.sqrt(own_m**2 + self._sigma_m[at] ** 2 + by_depth**2 + self._datum_m**2)
        return np.asarray(whole_m, np.float32)


def lacks_altitude(store: ScanStore) -> bool:
    """Whether nothing says how high above sea level the scan is."""
    assumed = _assumed(store.summary or {})
    return NO_ALTITUDE in assumed and store.header.georeference != BY_SURVEY


def shared_sigma(store: ScanStore) -> SharedSigma | None:
    """What the points of a scan share; None where it is not placed, or of unknown scale."""
    run, georeference = store.summary or {}, store.header.georeference
    share, poses = depth_share(run, georeference), main_track(store)
    by_pressure = "pressure" in _assumed(run) and georeference != BY_SURVEY
    datum_m = PRESSURE_SIGMA_M if by_pressure else 0.0
    return None if share is None or not poses else SharedSigma(poses, share, datum_m)
