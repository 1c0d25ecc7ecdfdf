"""The scan's local frame: ENU metres to latitude and longitude, to UTM, and between heights.

ENU is the tangent plane at the scan's origin (EPSG method 9837, geocentric/topocentric), so
the ground lies 8 cm below it at one kilometre. The conversion to UTM goes through geodetic
coordinates, which covers scale, meridian convergence and the curvature of the Earth.

Heights are above mean sea level, as autopilots report them, and are used in the ellipsoidal
formulas without a geoid model: origin and points share the same offset. The remaining error is
the offset over the Earth's radius, at most 17 mm per kilometre. A :class:`HeightChange` converts
them by PROJ's grids, which are not part of this package.
"""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable, Iterable
from dataclasses import KW_ONLY, dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from recon import se3
from recon.types import F64, Array
from service.errors import InputError

if TYPE_CHECKING:
    from pyproj import CRS, Transformer


@dataclass(frozen=True, slots=True)
class LocalFrame:
    """East-north-up metres about an origin on WGS 84."""

    lat_deg: float
    lon_deg: float
    alt_amsl_m: float
    _: KW_ONLY
    heights: HeightChange | None = None  # of all but ENU, from AMSL as flown

    def __post_init__(self) -> None:
        """Raise ValueError for an origin that is not on the globe."""
        utm_epsg(self.lat_deg, self.lon_deg)
        if not np.isfinite(self.alt_amsl_m):
            raise ValueError(f"altitude of the origin is {self.alt_amsl_m}, not a finite number")

    @property
    def epsg(self) -> int:
        """EPSG code of the origin's UTM zone (or polar stereographic zone) on WGS 84."""
        return utm_epsg(self.lat_deg, self.lon_deg)

    def to_enu(self, geodetic: Array) -> F64:
        """(N, 3) ENU metres of (N, 3) rows of latitude, longitude (degrees) and AMSL metres."""
        g = _rows(geodetic)
        if self.heights is not None:
            g = self.heights(g, undo=True)
        return _apply(self._geodetic_enu(), g[:, 1], g[:, 0], g[:, 2], inverse=False)

    def to_geodetic(self, enu_m: Array) -> F64:
        """(N, 3) latitude, longitude (degrees) and AMSL metres of (N, 3) ENU metres."""
        e = _rows(enu_m)
        out = _apply(self._geodetic_enu(), e[:, 0], e[:, 1], e[:, 2], inverse=True)
        geodetic = out[:, [1, 0, 2]]
        return geodetic if self.heights is None else self.heights(geodetic)

    def place(self, enu_m: F64) -> tuple[float, float, float]:
        """Latitude, longitude and AMSL metres of one place (3,)."""
        lat_deg, lon_deg, alt_m = self.to_geodetic(enu_m[None])[0].tolist()
        return lat_deg, lon_deg, alt_m

    def to_utm(self, enu_m: Array) -> F64:
        """(N, 3) easting, northing and AMSL metres in the zone ``epsg`` of (N, 3) ENU metres."""
        g = self.to_geodetic(enu_m)
        return _apply(_geodetic_projected(self.epsg), g[:, 1], g[:, 0], g[:, 2], inverse=False)

    def from_utm(self, utm_m: Array) -> F64:
        """(N, 3) ENU metres of (N, 3) easting, northing and AMSL metres: undoes to_utm."""
        u = _rows(utm_m)
        out = _apply(_geodetic_projected(self.epsg), u[:, 0], u[:, 1], u[:, 2], inverse=True)
        return self.to_enu(out[:, [1, 0, 2]])

    def from_utm_grid(self, x_m: F64, y_m: F64, height_m: Array) -> F64:
        """(R, C, 3) ENU metres of eastings (C,), northings (R,) and AMSL metres (R, C). As
        :meth:`from_utm` to within 3 mm over 10 km, and much faster."""

        def foot_and_up(xy: F64) -> F64:
            low = self.from_utm(np.column_stack([xy, np.zeros(len(xy))]))
            high = self.from_utm(np.column_stack([xy, np.full(len(xy), 1e3)]))
            return np.column_stack([low, (high - low) / 1e3])

        places = np.empty((*height_m.shape, 3))
        found = between_nodes(x_m, y_m, foot_and_up)
        for k in range(3):
            places[..., k] = found[k] + height_m * found[3 + k]
        return places

    def _geodetic_enu(self) -> Transformer:
        return _topocentric(float(self.lat_deg), float(self.lon_deg), float(self.alt_amsl_m))


def between_frames(site: LocalFrame, scan: LocalFrame) -> F64:
    """(4, 4) motion from the ENU metres of ``scan`` to those of ``site``; both are rigid."""
    axes = np.vstack([np.zeros(3), 100.0 * np.eye(3)])
    there = site.to_enu(scan.to_geodetic(axes))
    return se3.project_to_so3(se3.compose((there[1:] - there[0]).T / 100.0, there[0]))


NODES = 33


def between_nodes(x: F64, y: F64, function: Callable[[F64], Array]) -> Array:
    """(K, R, C) of a smooth ``function`` from (N, 2) to (N, K), at all of x (C,) and y (R,). It is
    called for NODES places along each side and interpolated linearly between them."""
    (at_x, from_x), (at_y, from_y) = _nodes(x), _nodes(y)
    places = np.stack(np.meshgrid(at_x, at_y), axis=-1).reshape(-1, 2)
    found = function(places).T.reshape(-1, len(at_y), len(at_x))
    return np.asarray(from_y.astype(found.dtype) @ found @ from_x.T.astype(found.dtype))


def _nodes(x: F64) -> tuple[F64, F64]:
    """Evenly spaced nodes over ``x`` (N,), and (N, nodes) their shares in each of its values."""
    nodes = np.linspace(x.min(), x.max(), NODES)
    return nodes, np.column_stack([np.interp(x, nodes, one) for one in np.eye(NODES)])


def cut_at_180(places: F64) -> list[F64]:
    """A line (N, K) of longitude, latitude and more columns, cut where it crosses 180 degrees. The
    parts end at -180 or 180, as RFC 7946 (3.1.9) asks for."""
    lon = np.unwrap(places[:, 0], period=360.0)  # without a step at 180 degrees
    turns = np.floor((lon + 180.0) / 360.0)  # a piece of the line lies in one turn
    parts, first = [], 0
    row = np.column_stack([lon, places[:, 1:]])
    for k in np.flatnonzero(np.diff(turns)).tolist():
        edge = 360.0 * max(turns[k], turns[k + 1]) - 180.0
        share = (edge - lon[k]) / (lon[k + 1] - lon[k])
        end = row[k] + share * (row[k + 1] - row[k])
        parts.append((turns[k], np.vstack([row[first : k + 1], end])))
        row[k], first = end, k
    parts.append((turns[-1] if len(turns) else 0.0, row[first:]))
    return [np.column_stack([p[:, 0] - 360.0 * turn, p[:, 1:]]) for turn, p in parts if len(p) > 1]


def line_geometry(places: F64) -> dict[str, Any]:
    """The GeoJSON geometry of a line (N, 3): longitude, latitude, height in metres."""
    parts = [np.column_stack([p[:, :2].round(8), p[:, 2:].round(3)]) for p in cut_at_180(places)]
    if len(parts) == 1:
        return {"type": "LineString", "coordinates": parts[0].tolist()}
    return {"type": "MultiLineString", "coordinates": [part.tolist() for part in parts]}


Feature = tuple[dict[str, Any], dict[str, Any]]  # properties and geometry in GeoJSON


def geojson_of(features: Iterable[Feature]) -> str:
    found = [{"type": "Feature", "properties": p, "geometry": g} for p, g in features]
    return json.dumps({"type": "FeatureCollection", "features": found})


def map_crs(epsg: int, vertical: str | None = None) -> CRS:
    """The map's coordinate system; with the name of a vertical datum that of its heights as well.
    Nothing is converted, so no geoid grid is needed."""
    from pyproj import CRS

    flat = CRS.from_epsg(epsg)
    if vertical is None:
        return flat
    heights = vertical_code(vertical)
    return flat.to_3d() if heights is None else CRS(f"EPSG:{epsg}+{heights}")


UTM_NAME = re.compile(r"WGS\s*84\s+UTM\s+(\d{1,2})\s*([NS])", re.IGNORECASE)


SAME_PLACE = 1e-6
"""Share of a coordinate, some metres, by which a place may miss itself there and back."""


IN_FEET = {6360: 5703, 8228: 5703}
"""EPSG codes of heights in feet, and of those in metres above the same datum: NAVD 88."""


def system_of(text: str) -> tuple[Transformer, str, float]:
    """The coordinate system in a surveyor's file: of places, the datum of heights, their unit.

    ``text`` is what PROJ knows (``EPSG:25832``, ``EPSG:25832+7837``, a PROJ string) or ``WGS84 UTM
    32N``. The transformer gives longitude and latitude of x and y (of latitude and longitude in
    degrees as well, x is the longitude). The datum is one of :func:`vertical_code`, empty where the
    system has no heights; the unit is in metres. Raises ValueError.
    """
    text = text.strip()
    to_degrees, flat, more = _parts_of(text)
    vertical = next((one for one in more if one.is_vertical), None)
    code = None if vertical is None else vertical.to_epsg()
    axis = (vertical or flat).axis_info[-1]  # the heights', or else what stands for it
    is_flat_in_degrees = vertical is None and flat.is_geographic and len(flat.axis_info) == 2
    unit_m = 1.0 if is_flat_in_degrees else axis.unit_conversion_factor
    if unit_m != 1.0:
        if code not in IN_FEET:
            raise ValueError(
                f"{text[:80]!r} is in {axis.unit_name}; say what its heights are, after a +: "
                "EPSG:n+5703 (NAVD 88, metres), EPSG:n+6360 (US survey feet) or EPSG:n+8228 (feet)"
            )
        code = IN_FEET[code]
    names = {known: name for name, known in DATUMS.items() if known is not None}
    datum = "ellipsoid" if not more and len(flat.axis_info) == 3 else ""
    return to_degrees, datum if code is None else names.get(code, f"EPSG:{code}"), unit_m


def is_system(text: str) -> bool:
    """Whether ``text`` is a coordinate system, also one that :func:`system_of` refuses because it
    does not say what its heights are."""
    try:
        _parts_of(text.strip())
    except ValueError:
        return False
    return True


def _parts_of(text: str) -> tuple[Transformer, CRS, list[CRS]]:
    """What :func:`system_of` reads: to longitude and latitude, the system of places, the others."""
    from pyproj import CRS, Transformer
    from pyproj.exceptions import CRSError

    name = text
    if zone := UTM_NAME.fullmatch(text):
        name = f"EPSG:{(32600 if zone[2] in 'Nn' else 32700) + int(zone[1])}"
    try:
        crs = CRS.from_user_input(name)
        flat, *more = crs.sub_crs_list or [crs]
        if not (flat.is_geographic or flat.is_projected):
            raise CRSError("neither degrees nor a map")
        return Transformer.from_crs(flat.to_2d(), "EPSG:4326", always_xy=True), flat, more
    except CRSError as error:
        raise ValueError(
            f"{name[:80]!r} is not a coordinate system; give EPSG:n, a PROJ string or WGS84 UTM 32N"
        ) from error


def degrees_of(system: Transformer, x: float, y: float) -> tuple[float, float]:
    """Longitude and latitude of a place in a surveyor's coordinate system. ValueError where the
    system does not reach so far: PROJ's series then give some other place."""
    lon, lat = system.transform(x, y)
    back = system.transform(lon, lat, direction="INVERSE")
    if not all(
        abs(b - a) <= SAME_PLACE * max(abs(a), 1.0) for a, b in zip((x, y), back, strict=True)
    ):
        raise ValueError(f"{x:g}, {y:g} is outside the coordinate system")
    return float(lon), float(lat)


def utm_epsg(lat_deg: float, lon_deg: float) -> int:
    """EPSG code on WGS 84 of the UTM zone at a place, or of the polar zone (UPS).

    South-west Norway (zone 32V) and Svalbard (31X, 33X, 35X, 37X) have their wider zones.
    North of 84 and south of -80 degrees it is 32661 or 32761. Raises ValueError when the
    place is not on the globe.
    """
    if not (abs(lat_deg) <= 90.0 and abs(lon_deg) <= 360.0):
        raise ValueError(f"latitude {lat_deg}, longitude {lon_deg} are not on the globe")
    if lat_deg >= 84.0:
        return 32661
    if lat_deg < -80.0:
        return 32761
    lon = (lon_deg + 180.0) % 360.0 - 180.0
    zone = int((lon + 180.0) // 6.0) + 1
    if 56.0 <= lat_deg < 64.0 and 3.0 <= lon < 12.0:
        zone = 32
    if lat_deg >= 72.0 and 0.0 <= lon < 42.0:
        zone = 31 if lon < 9.0 else 33 if lon < 21.0 else 35 if lon < 33.0 else 37
    return (32600 if lat_deg >= 0.0 else 32700) + zone


def _rows(points: Array) -> F64:
    """(N, 3) float64, or ValueError."""
    out = np.asarray(points, np.float64)
    if out.ndim != 2 or out.shape[1] != 3:
        raise ValueError(f"expected points of shape (N, 3), got {out.shape}")
    return out


def _apply(transformer: Transformer, x: F64, y: F64, z: F64, inverse: bool) -> F64:
    """(N, 3) of the transformed columns."""
    from pyproj.enums import TransformDirection

    way = TransformDirection.INVERSE if inverse else TransformDirection.FORWARD
    if len(x) == 1:  # pyproj warns at arrays of one element
        return np.array(
            [transformer.transform(float(x[0]), float(y[0]), float(z[0]), direction=way)]
        )
    return np.column_stack(transformer.transform(x, y, z, direction=way))


@lru_cache(maxsize=16)
def _topocentric(lat_deg: float, lon_deg: float, alt_m: float) -> Transformer:
    """Longitude, latitude (degrees), height to ENU about the origin."""
    from pyproj import Transformer

    return Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad"
        " +step +proj=cart +ellps=WGS84"
        f" +step +proj=topocentric +ellps=WGS84 +lat_0={lat_deg!r} +lon_0={lon_deg!r}"
        f" +h_0={alt_m!r}"
    )


@lru_cache(maxsize=16)
def _geodetic_projected(epsg: int) -> Transformer:
    """Longitude, latitude (degrees) to easting, northing; the height passes through."""
    from pyproj import Transformer

    return Transformer.from_crs("EPSG:4979", f"EPSG:{epsg}", always_xy=True)


DATUMS = {"ellipsoid": None, "EGM96": 5773, "EGM2008": 3855}
"""Named vertical datums and the EPSG codes of their heights; the ellipsoid is that of WGS 84."""

GRID_AREA_DEG = 0.05


def vertical_code(name: str) -> int | None:
    """EPSG code of the heights ``name`` (of DATUMS, or ``EPSG:n``); None for the ellipsoid. Raises
    ValueError for what is not a vertical datum."""
    if name in DATUMS:
        return DATUMS[name]
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    kind, _, number = name.partition(":")
    try:
        if kind.upper() == "EPSG" and number.isdecimal() and CRS.from_epsg(int(number)).is_vertical:
            return int(number)
    except CRSError:
        pass
    known = ", ".join(DATUMS)
    raise ValueError(f"{name}: give {known}, or EPSG:n of vertical coordinates")


@dataclass(frozen=True, slots=True, eq=False)
class HeightChange:
    """Conversion of heights from one vertical datum to another, near one place."""

    words: str
    transformer: Transformer

    def __call__(self, geodetic: F64, undo: bool = False) -> F64:
        """(N, 3) latitude, longitude (degrees) and the height above the other datum, metres. Raises
        InputError where the grid ends."""
        lat, lon, height = geodetic.T
        changed = _apply(self.transformer, lon, lat, height, inverse=undo)[:, 2]
        out = np.column_stack([lat, lon, changed])
        if not np.isfinite(out[np.isfinite(height), 2]).all():
            raise InputError(f"{self.words}: PROJ's grid does not cover all of the scan")
        return out


def height_change(source: str, target: str, lat_deg: float, lon_deg: float) -> HeightChange | None:
    """The conversion of heights near a place by PROJ's grids; None where both datums are one.
    Raises InputError when a grid is missing or PROJ knows no conversion; no offset is assumed."""
    from pyproj.datadir import get_user_data_dir  # type: ignore[attr-defined]
    from pyproj.transformer import AreaOfInterest, TransformerGroup

    if vertical_code(source) == vertical_code(target):
        return None
    south, north = max(lat_deg - GRID_AREA_DEG, -90.0), min(lat_deg + GRID_AREA_DEG, 90.0)
    area = AreaOfInterest(lon_deg - GRID_AREA_DEG, south, lon_deg + GRID_AREA_DEG, north)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of grids that are not there: said below
        group = TransformerGroup(
            _geodetic(source), _geodetic(target), always_xy=True,
            area_of_interest=area, allow_ballpark=False,
        )  # fmt: skip
    words = f"heights above {source} to heights above {target}"
    if group.transformers:
        return HeightChange(words, group.transformers[0])
    if not group.unavailable_operations:
        raise InputError(f"{words}: PROJ knows no conversion at this place")
    missing = [grid for grid in group.unavailable_operations[0].grids if not grid.available]
    names = " and ".join(grid.short_name for grid in missing)
    raise InputError(
        f"{words}: PROJ's grid {names} is missing; 'python -m pyproj sync --file NAME' fetches it, "
        f"or copy it ({' '.join(grid.url for grid in missing)}) to {get_user_data_dir()}"
    )


def _geodetic(name: str) -> CRS:
    """Longitude and latitude on WGS 84 with heights above the datum ``name``."""
    from pyproj import CRS

    code = vertical_code(name)
    return CRS("EPSG:4979" if code is None else f"EPSG:4326+{code}")
