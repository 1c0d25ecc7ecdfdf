"""A second flight over the weak areas of the first, as a mission for ground stations.

Lines run over the weak cells of the coverage layer at the height flown, as far apart as the
camera's image and the wanted overlap allow. The camera starts before the first line and
stops after the last, so that the second flight is one scan.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from recon.surface.raster import Grid
from recon.table import Rows
from recon.types import F64, Bool
from service.errors import InputError
from service.georeference import Feature, LocalFrame, geojson_of
from service.scans.coverage import Coverage
from service.stream.records import PoseRecord

MAX_LINES = 150
TAKEOFF, WAYPOINT, RETURN, SPEED = 22, 16, 20, 178
VIDEO_START, VIDEO_STOP, PHOTO_START, PHOTO_STOP = 2500, 2501, 2000, 2001
AMSL, MISSION, RELATIVE = 0, 2, 3  # MAV_FRAME
SMALLEST_SHARE = 0.005
"""Weak patches smaller than this share of an image are ignored."""

NO_FLIGHT = f"no weak place is larger than {SMALLEST_SHARE:.1%} of an image; no flight is needed"

FORWARD_OVERLAP = 0.8
"""Overlap of consecutive photographs."""


@dataclass(frozen=True, slots=True)
class Swath:
    """How the camera flew: its image on the ground and where it looks."""

    across_m: float
    along_m: float
    ahead_m: float  # from below the camera to the middle of its image, along the flight
    heading_rad: float  # most flown, from east to north
    altitude_amsl_m: float
    speed_m_s: float
    height_m: float | None  # above the ground


@dataclass(frozen=True, slots=True)
class MissionItem:
    command: int
    frame: int
    params: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    lat_deg: float = 0.0
    lon_deg: float = 0.0
    alt_m: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Refly:
    lines: F64  # (L, 2, 2) starts and ends of the camera's lines over the ground, ENU metres
    items: tuple[MissionItem, ...]
    home: tuple[float, float, float]  # latitude, longitude, AMSL metres
    swath: Swath
    spacing_m: float
    weak_m2: float
    patches: int

    @property
    def length_m(self) -> float:
        return _length_m(self.lines.reshape(-1, 2))

    @property
    def seconds(self) -> int:
        return round(self.length_m / max(self.swath.speed_m_s, 1.0))


def _length_m(places: F64) -> float:
    """Of the way along (N, 2) places."""
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())


def _directions(lines: F64) -> F64:
    """(L, 2) unit vectors along (L, 2, 2) lines."""
    ways = lines[:, 1] - lines[:, 0]
    return np.asarray(ways / np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-6))


def flown_swath(places: Rows, frame: LocalFrame, speed_m_s: float, height_m: float | None) -> Swath:
    """Camera and flight by the keyframes' images. Raises InputError for one alone."""
    if len(places) < 2:
        raise InputError("the scan holds a single keyframe: there is no flown line to plan from")
    cameras = places["camera_m"]
    steps = np.gradient(cameras[:, :2], axis=0)
    length = np.linalg.norm(steps, axis=1)
    if length.max() < 0.1:
        raise InputError("the camera never moved in this scan: there is no flown line to plan from")
    ways = steps / np.maximum(length, 1e-6)[:, None]
    edges = np.diff(places["corners_m"][:, :3], axis=1)
    sizes = np.linalg.norm(edges, axis=2)
    cosine = np.abs(np.einsum("nec,nc->ne", edges, ways)) / np.maximum(sizes, 1e-6)
    along = np.argmax(cosine, axis=1)
    rows = np.arange(len(places))
    ahead = np.sum((places["centre_m"] - cameras[:, :2]) * ways, axis=1)
    moving = length > 0.3 * np.median(length)
    return Swath(
        across_m=float(np.median(sizes[rows, 1 - along])),
        along_m=float(np.median(sizes[rows, along])),
        ahead_m=float(np.median(ahead[moving])),
        heading_rad=_usual_heading(ways[moving]),
        altitude_amsl_m=frame.alt_amsl_m + float(np.median(cameras[:, 2])),
        speed_m_s=speed_m_s,
        height_m=height_m,
    )


def _usual_heading(ways: F64) -> float:
    """Direction of most of the (N, 2) unit steps, there and back alike, from east to north."""
    doubled = np.exp(2j * np.arctan2(ways[:, 1], ways[:, 0]))
    most = np.ones(len(doubled), np.bool_)
    for _ in range(5):
        mean = doubled[most].sum()
        most = np.abs(np.angle(doubled * np.conj(mean))) <= np.radians(40.0)
        if not most.any():
            break
    return float(np.angle(mean) / 2)


def weak_patches(weak: Bool, grid: Grid, swath: Swath) -> list[F64]:
    """(N, 2) cell centres of each group of weak patches that one set of lines can serve."""
    cell = grid.cell_m
    cleaned = weak.astype(np.uint8)
    for step in (cv2.MORPH_CLOSE, cv2.MORPH_OPEN):  # heal single cells, then drop thin strips
        cleaned = np.asarray(cv2.morphologyEx(cleaned, step, np.ones((3, 3), np.uint8)), np.uint8)
    count, label, stats, _ = cv2.connectedComponentsWithStats(cleaned, connectivity=8)
    least = max(4.0, SMALLEST_SHARE * swath.across_m * swath.along_m / cell**2)
    large = np.array([n > 0 and stats[n, cv2.CC_STAT_AREA] >= least for n in range(count)])
    kept = large[label]
    if not kept.any():
        return []
    reach = 2 * int(0.25 * min(swath.across_m, swath.along_m) / cell) + 1
    grown = cv2.dilate(kept.astype(np.uint8), np.ones((reach, reach), np.uint8))
    groups, member = cv2.connectedComponents(grown, connectivity=8)
    out = []
    for n in range(1, groups):
        cells_m = grid.centres(*np.nonzero(kept & (member == n)))
        if len(cells_m):
            out.append(cells_m)
    return out


def lines_over(cells_m: F64, swath: Swath, overlap: float) -> F64:
    """(L, 2, 2) parallel lines that cover (N, 2) cells, in the direction of the shortest way."""
    box = cv2.minAreaRect(cells_m.astype(np.float32))
    turn = np.radians(box[2])
    best, least = np.zeros((0, 2, 2)), np.inf
    for angle in (swath.heading_rad, turn, turn + np.pi / 2):
        lines = _parallel(cells_m, angle, swath, overlap)
        length = sum(map(_length_m, lines)) + swath.across_m * len(lines)
        if length < 0.8 * least:  # the heading flown is preferred where little is lost
            best, least = lines, length
    return best


def _parallel(cells_m: F64, angle: float, swath: Swath, overlap: float) -> F64:
    """(L, 2, 2) lines at ``angle`` (from east to north), back and forth."""
    way = np.array([np.cos(angle), np.sin(angle)])
    side = np.array([-way[1], way[0]])
    s, t = cells_m @ way, cells_m @ side
    low, width = float(t.min()), float(np.ptp(t))
    count = max(1, int(np.ceil(width / (swath.across_m * (1.0 - overlap)))))
    step = width / count
    lines: list[F64] = []
    for middle in low + (np.arange(count) + 0.5) * step:
        here = s[np.abs(t - middle) <= 0.5 * step + 1e-6]
        if len(here):
            # Half an image before and after, so that the ends are seen as often as the middle.
            ends = np.array([here.min() - 0.5 * swath.along_m, here.max() + 0.5 * swath.along_m])
            line = ends[:, None] * way + middle * side
            lines.append(line[::-1] if len(lines) % 2 else line)
    return np.array(lines)


def in_order(groups: Sequence[F64], begin_m: F64) -> F64:
    """(L, 2, 2) all groups' lines, the nearest next, each group entered at its nearer end."""
    left = list(groups)
    out: list[F64] = []
    here = begin_m
    while left:
        # A group is flown from its first or last line, from either end.
        choices = [
            (float(np.linalg.norm(entry[0, 0] - here)), k, entry)
            for k, group in enumerate(left)
            for entry in (group, group[:, ::-1], group[::-1], group[::-1, ::-1])
        ]
        _, k, nearest = min(choices, key=lambda choice: choice[:2])
        left.pop(k)
        out.append(nearest)
        here = nearest[-1, 1]
    return np.concatenate(out)


def suggest(
    coverage: Coverage,
    poses: Sequence[PoseRecord],
    overlap: float = 0.6,
    relative: bool = False,
    photos: bool = False,
) -> Refly | None:
    """A flight over the weak areas; None when no weak place is large enough.

    Height and speed are those of ``poses``. ``overlap`` is that of neighbouring lines' images.
    Altitudes are AMSL as flown, or ``relative`` to home by the height above ground flown.

    Raises InputError when the scan is not georeferenced, holds too few keyframes, or the
    weak areas would take more than MAX_LINES lines.
    """
    heights = [p.agl_m for p in poses if p.agl_m is not None]
    height_m = float(np.median(heights)) if heights else None
    moving = [p.speed_m_s for p in poses if p.speed_m_s > 0.2]
    speed_m_s = float(np.median(moving)) if moving else 3.0
    if not 0.0 <= overlap <= 0.9:
        raise InputError(f"overlap {overlap:g} is not 0 to 0.9")
    frame = coverage.frame
    if frame is None:
        raise InputError("the scan has no georeference; a mission needs one (fly with GNSS)")
    if relative and height_m is None:
        raise InputError("the scan has no height above ground; omit --relative")
    swath = flown_swath(coverage.places, frame, speed_m_s, height_m)
    patches = weak_patches(coverage.weak, coverage.layer.grid, swath)
    if not patches:
        return None
    groups = [lines_over(cells, swath, overlap) for cells in patches]
    count = sum(map(len, groups))
    if count > MAX_LINES:
        raise InputError(
            f"{count} lines would be needed, more than {MAX_LINES}; raise --sigma-m, lower "
            "--views or fly the whole area again"
        )
    cameras, grid = coverage.places["camera_m"], coverage.layer.grid
    lines = in_order(groups, cameras[-1, :2])
    lines = lines - swath.ahead_m * _directions(lines)[:, None]  # the image's middle follows them
    lat, lon, alt = frame.to_geodetic(cameras[:1])[0].tolist()
    return Refly(
        lines,
        tuple(_items(lines, frame, swath, relative, photos)),
        (lat, lon, alt - (height_m or 0.0)),
        swath,
        swath.across_m * (1 - overlap),
        sum(map(len, patches)) * grid.cell_m**2,
        len(patches),
    )


def _items(
    lines: F64, frame: LocalFrame, swath: Swath, relative: bool, photos: bool
) -> list[MissionItem]:
    """Take-off, speed, camera on, all lines, camera off, return."""
    where = RELATIVE if relative else AMSL
    altitude = (swath.height_m or 0.0) if relative else swath.altitude_amsl_m
    altitude = round(altitude, 2)
    points = _lon_lat(lines.reshape(-1, 2), frame)

    def at(command: int, lon_lat: list[float]) -> MissionItem:
        lon, lat = lon_lat
        return MissionItem(command, where, (0.0, 0.0, 0.0, 0.0), lat, lon, altitude)

    speed = max(swath.speed_m_s, 1.0)
    interval = max(round((1 - FORWARD_OVERLAP) * swath.along_m / speed, 1), 0.5)
    start = MissionItem(PHOTO_START, MISSION, (0.0, interval, 0.0, 0.0))
    stop = MissionItem(PHOTO_STOP, MISSION)
    if not photos:
        start, stop = MissionItem(VIDEO_START, MISSION), MissionItem(VIDEO_STOP, MISSION)
    return [
        at(TAKEOFF, points[0]),
        MissionItem(SPEED, MISSION, (1.0, round(speed, 1), -1.0, 0.0)),
        at(WAYPOINT, points[0]),
        start,
        *(at(WAYPOINT, point) for point in points[1:]),
        stop,
        MissionItem(RETURN, MISSION),
    ]


def geojson(refly: Refly | None, frame: LocalFrame) -> str:
    """Each line, and the ground that its images cover, as GeoJSON; no features without a flight."""
    if refly is None:
        return geojson_of([])
    features: list[Feature] = []
    swath, ways = refly.swath, _directions(refly.lines)
    for number, (line, way) in enumerate(zip(refly.lines, ways, strict=True), 1):
        aside = 0.5 * swath.across_m * np.array([-way[1], way[0]])
        ends = [swath.ahead_m - 0.5 * swath.along_m, swath.ahead_m + 0.5 * swath.along_m]
        before, after = line + np.array(ends)[:, None] * way
        ring = [before - aside, after - aside, after + aside, before + aside, before - aside]
        facts = {"line": number, "altitude_amsl_m": round(swath.altitude_amsl_m, 1)}
        ground = {"type": "Polygon", "coordinates": [_lon_lat(np.array(ring), frame)]}
        route = {"type": "LineString", "coordinates": _lon_lat(line, frame)}
        features += [(facts, ground), (facts, route)]
    return geojson_of(features)


def _lon_lat(places_m: F64, frame: LocalFrame) -> list[list[float]]:
    rows = frame.to_geodetic(np.column_stack([places_m, np.zeros(len(places_m))]))
    return [[round(lon, 8), round(lat, 8)] for lat, lon, _ in rows.tolist()]


def plan_json(refly: Refly) -> str:
    """The mission as QGroundControl's .plan."""
    items: list[dict[str, Any]] = []
    for n, item in enumerate(refly.items, 1):
        entry: dict[str, Any] = {
            "type": "SimpleItem",
            "autoContinue": True,
            "command": item.command,
            "doJumpId": n,
            "frame": item.frame,
            "params": [*item.params, item.lat_deg, item.lon_deg, item.alt_m],
        }
        if item.frame != MISSION:
            mode = 1 if item.frame == RELATIVE else 2
            entry |= {"AMSLAltAboveTerrain": None, "Altitude": item.alt_m, "AltitudeMode": mode}
        items.append(entry)
    document = {
        "fileType": "Plan",
        "version": 1,
        "groundStation": "QGroundControl",
        "geoFence": {"circles": [], "polygons": [], "version": 2},
        "rallyPoints": {"points": [], "version": 2},
        "mission": {
            "version": 2,
            "firmwareType": 0,
            "globalPlanAltitudeMode": 1 if refly.items[0].frame == RELATIVE else 2,
            "vehicleType": 2,
            "cruiseSpeed": refly.swath.speed_m_s,
            "hoverSpeed": max(round(refly.swath.speed_m_s, 1), 1.0),
            "plannedHomePosition": list(refly.home),
            "items": items,
        },
    }
    return json.dumps(document, indent=4) + "\n"


def waypoints_text(refly: Refly) -> str:
    """The mission as QGC WPL 110, which Mission Planner and MAVProxy read; home comes first."""
    rows: list[tuple[float, ...]] = [(0, 1, 0, WAYPOINT, 0, 0, 0, 0, *refly.home, 1)]
    for n, i in enumerate(refly.items, 1):
        rows.append((n, 0, i.frame, i.command, *i.params, i.lat_deg, i.lon_deg, i.alt_m, 1))
    text = [[f"{v:.8f}" if isinstance(v, float) else str(v) for v in row] for row in rows]
    return "QGC WPL 110\n" + "".join("\t".join(row) + "\n" for row in text)
