"""The local frame against closed forms and against pyproj's own zone table."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pyproj import CRS, Geod, Proj, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_utm_crs_info

from recon.types import F64
from service.georeference import LocalFrame, utm_epsg

A, F = 6378137.0, 1 / 298.257223563
E2 = F * (2 - F)

PLACES = [(47.39, 8.54, 408.0), (-35.363, 149.165, 584.0), (1e-3, -0.002, 0.0), (69.6, 19.0, 10.0)]


def ecef(lat_deg: float, lon_deg: float, h: float) -> F64:
    """Geocentric metres by the textbook formula."""
    lat, lon = math.radians(lat_deg), math.radians(lon_deg)
    n = A / math.sqrt(1 - E2 * math.sin(lat) ** 2)
    return np.array(
        [
            (n + h) * math.cos(lat) * math.cos(lon),
            (n + h) * math.cos(lat) * math.sin(lon),
            (n * (1 - E2) + h) * math.sin(lat),
        ]
    )


def enu_axes(lat_deg: float, lon_deg: float) -> F64:
    """(3, 3) rows east, north, up in geocentric coordinates."""
    lat, lon = math.radians(lat_deg), math.radians(lon_deg)
    sl, cl, so, co = math.sin(lat), math.cos(lat), math.sin(lon), math.cos(lon)
    return np.array([[-so, co, 0.0], [-sl * co, -sl * so, cl], [cl * co, cl * so, sl]])


@pytest.mark.parametrize("place", PLACES)
def test_enu_is_the_closed_form(place: tuple[float, float, float]) -> None:
    lat, lon, alt = place
    frame = LocalFrame(lat, lon, alt)
    rng = np.random.default_rng(3)
    geo = np.column_stack(
        [
            lat + rng.uniform(-0.02, 0.02, 50),
            lon + rng.uniform(-0.02, 0.02, 50),
            alt + rng.uniform(-50, 150, 50),
        ]
    )
    expected = [enu_axes(lat, lon) @ (ecef(*g) - ecef(lat, lon, alt)) for g in geo]
    np.testing.assert_allclose(frame.to_enu(geo), expected, atol=1e-6)
    back = frame.to_geodetic(np.array(expected))
    np.testing.assert_allclose(back[:, :2], geo[:, :2], atol=1e-10)
    np.testing.assert_allclose(back[:, 2], geo[:, 2], atol=1e-6)


@pytest.mark.parametrize("place", PLACES)
def test_utm_has_scale_and_convergence(place: tuple[float, float, float]) -> None:
    frame = LocalFrame(*place)
    assert CRS.from_epsg(frame.epsg).utm_zone is not None
    factors = Proj(f"EPSG:{frame.epsg}").get_factors(place[1], place[0])
    step = 10.0
    origin, north = frame.to_utm(np.array([[0.0, 0.0, 0.0], [0.0, step, 0.0]]))
    delta = north - origin
    # Grid azimuth of true north is minus the meridian convergence; metres shrink with height.
    convergence = math.degrees(math.atan2(delta[0], delta[1]))
    assert convergence == pytest.approx(-factors.meridian_convergence, abs=1e-4)
    level = factors.meridional_scale / (1 + place[2] / 6.37e6)
    assert math.hypot(delta[0], delta[1]) / step == pytest.approx(level, abs=2e-6)
    assert origin[2] == pytest.approx(place[2], abs=1e-6)


def test_a_kilometre_away_the_ground_falls_eight_centimetres() -> None:
    frame = LocalFrame(47.0, 8.0, 0.0)
    lon, lat, _ = Geod(ellps="WGS84").fwd(8.0, 47.0, 90.0, 1000.0)
    e, n, u = frame.to_enu(np.array([[lat, lon, 0.0]]))[0]
    assert e == pytest.approx(1000.0, abs=0.01)
    assert abs(n) < 0.2
    assert u == pytest.approx(-(1000.0**2) / (2 * 6.389e6), abs=2e-3)


def test_utm_and_back() -> None:
    frame = LocalFrame(-12.3, 179.9995, 30.0)
    enu = np.random.default_rng(1).uniform(-800, 800, (40, 3))
    np.testing.assert_allclose(frame.from_utm(frame.to_utm(enu)), enu, atol=1e-5)


def test_places_of_a_grid_are_those_of_its_cells() -> None:
    frame = LocalFrame(-12.3, 179.9995, 30.0)
    east, north, _ = frame.to_utm(np.zeros((1, 3)))[0]
    x, y = east + np.linspace(-3000.0, 7000.0, 90), north + np.linspace(2000.0, -800.0, 70)
    height = np.random.default_rng(2).uniform(-50.0, 400.0, (70, 90))
    height[3, 5] = np.nan
    cells = np.stack([*np.meshgrid(x, y), height], axis=-1).reshape(-1, 3)
    found = frame.from_utm_grid(x, y, height)
    assert np.isnan(found[3, 5]).all()
    want = frame.from_utm(np.nan_to_num(cells)).reshape(70, 90, 3)
    want[3, 5] = np.nan
    np.testing.assert_allclose(found, want, atol=3e-3)


def test_utm_agrees_with_a_direct_projection() -> None:
    frame = LocalFrame(59.3, 18.1, 25.0)
    direct = Transformer.from_crs(4326, frame.epsg, always_xy=True).transform(18.1, 59.3)
    np.testing.assert_allclose(frame.to_utm(np.zeros((1, 3)))[0, :2], direct, atol=1e-6)


@pytest.mark.parametrize("lat", [-79.5, 30.0, 66.0])
def test_zone_is_that_of_the_epsg_registry(lat: float) -> None:
    for lon in range(-179, 180, 60):  # each look at the registry takes a tenth of a second
        area = AreaOfInterest(lon, lat, lon, lat)
        codes = {int(c.code) for c in query_utm_crs_info("WGS 84", area)}
        assert utm_epsg(lat, lon) in codes


@pytest.mark.parametrize(
    ("lat", "lon", "epsg"),
    [
        (60.4, 5.3, 32632),  # Bergen
        (78.2, 15.6, 32633),  # Longyearbyen
        (78.2, 8.0, 32631),
        (78.2, 25.0, 32635),
        (85.0, 0.0, 32661),
        (-89.0, 10.0, 32761),
        (10.0, 180.0, 32601),
        (10.0, 359.0, 32630),
    ],
)
def test_special_zones(lat: float, lon: float, epsg: int) -> None:
    assert utm_epsg(lat, lon) == epsg


@pytest.mark.parametrize("bad", [(91.0, 0.0, 0.0), (0.0, math.nan, 0.0), (0.0, 0.0, math.inf)])
def test_an_origin_off_the_globe_is_refused(bad: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match=r"globe|altitude"):
        LocalFrame(*bad)


def test_an_origin_of_numpys_numbers_is_the_same_place() -> None:
    lat, lon, alt = 12.3456, -65.4321, 78.9  # of no other test: the transformer is kept
    frame = LocalFrame(*(np.float64(value) for value in (lat, lon, alt)))
    assert np.abs(frame.to_enu(np.array([[lat, lon, alt]]))).max() < 1e-6


def test_wrong_shape_is_refused() -> None:
    with pytest.raises(ValueError, match=r"\(N, 3\)"):
        LocalFrame(0.0, 0.0, 0.0).to_enu(np.zeros(3))
