"""Positions of stills in a geo.txt, in any coordinate system."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from pyproj import Transformer

from service.cameras import open_camera
from service.cameras.geo_file import read_geo
from service.errors import InputError
from service.georeference import system_of

LAT, LON = 46.84252125, -91.99420961


def write(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize(
    ("head", "epsg", "datum"),
    [
        ("EPSG:4326", 4326, ""),
        ("WGS84 UTM 15N", 32615, ""),
        ("EPSG:26915+5703", 26915, "EPSG:5703"),
        ("+proj=utm +zone=15 +datum=WGS84 +units=m +no_defs", 32615, ""),
        ("EPSG:4979", 4326, "ellipsoid"),
        ("EPSG:32615+5773", 32615, "EGM96"),
    ],
)
def test_positions_in_any_coordinate_system(
    tmp_path: Path, head: str, epsg: int, datum: str
) -> None:
    """East or longitude comes first, whatever the system's own order is."""
    x, y = Transformer.from_crs(4326, epsg, always_xy=True).transform(LON, LAT)
    path = write(
        tmp_path / "geo.txt", head, "# name x y z yaw pitch roll across up label",
        f"DJI_1.JPG {x:.9f} {y:.9f} 198.609 10 -90 0 0.02 0.05 first", "",
        f"DJI_2.JPG {x:.9f} {y:.9f}",
        f"DJI_3.JPG {x:.9f} {y:.9f} 198.609 label 0.5 0.5",
    )  # fmt: skip
    found = read_geo(path)
    for tag in found.values():
        assert (tag.lat_deg, tag.lon_deg) == pytest.approx((LAT, LON), abs=2e-8)
    first, second, third = found.values()
    assert (first.alt_amsl_m, first.sigma_h_m, first.sigma_v_m) == (198.609, 0.02, 0.05)
    assert first.datum == datum and first.is_sigma_h_stated
    assert (second.alt_amsl_m, second.sigma_v_m, second.datum) == (None, None, "")
    assert third.alt_amsl_m == 198.609 and not third.is_sigma_h_stated


@pytest.mark.parametrize(
    "rows",
    [
        "a.jpg,8.5,47.3,412.5,0.02,0.05\r\nb.jpg,8.5,47.3\r\n",
        "a.jpg, 8.5, 47.3, 412.5, 10, -90, 0, 0.02, 0.05\nb.jpg, 8.5, 47.3\n",
        "a.jpg;8,5;47,3;412,5;0,02;0,05\r\nb.jpg;8,5;47,3",
        "a.jpg 8,5 47,3 412,5 10 -90 0 0,02 0,05\nb.jpg 8,5 47,3 label, other\n",
        "a.jpg\t8.5\t47.3\t412.5\t0.02\t0.05\nb.jpg\t8.5\t47.3\n",
        "C:\\flight 1\\A.jpg;8.5;47.3;412.5;0.02;0.05\nimages/b.jpg 8.5 47.3",
    ],
)
def test_what_separates_columns_and_decimals(tmp_path: Path, rows: str) -> None:
    path = tmp_path / "geo.txt"
    path.write_bytes(b"\xef\xbb\xbf" + f"EPSG:4326\r\n\n{rows}".encode())
    found = read_geo(path)
    a, b = found["a.jpg"], found["b.jpg"]
    assert (a.lat_deg, a.lon_deg, a.alt_amsl_m) == (47.3, 8.5, 412.5)
    assert (a.sigma_h_m, a.sigma_v_m) == (0.02, 0.05)
    assert (b.lat_deg, b.alt_amsl_m, b.is_sigma_h_stated) == (47.3, None, False)


@pytest.mark.parametrize("name", ["a,1.jpg", "a;b,2.jpg", "a,1,2.jpg"])
def test_a_name_may_have_what_separates_columns(tmp_path: Path, name: str) -> None:
    found = read_geo(write(tmp_path / "geo.txt", "EPSG:4326", f"{name} 8.5 47.3 412.5"))
    assert list(found) == [name] and found[name].alt_amsl_m == 412.5


@pytest.mark.parametrize(("code", "foot_m"), [(6360, 1200 / 3937), (8228, 0.3048)])
def test_heights_in_feet_are_converted(tmp_path: Path, code: int, foot_m: float) -> None:
    """State plane coordinates, which ODM's own tests have (EPSG:2251): feet up as well."""
    x, y = Transformer.from_crs(4326, 2251, always_xy=True).transform(LON, LAT)
    row = f"a.jpg {x:.5f} {y:.5f} {198.609 / foot_m:.5f}"
    (tag,) = read_geo(write(tmp_path / "geo.txt", f"EPSG:2251+{code}", row)).values()
    assert (tag.lat_deg, tag.lon_deg) == pytest.approx((LAT, LON), abs=2e-8)
    assert tag.alt_amsl_m == pytest.approx(198.609, abs=1e-4)
    assert tag.datum == "EPSG:5703"


@pytest.mark.parametrize(
    ("lines", "what"),
    [
        (["EPSG:2251", "a.jpg 1 2 3"], "line 1: 'EPSG:2251' is in foot; say what its heights are"),
        (["+proj=longlat +datum=WGS84 +vunits=us-ft", "a.jpg 8 47 3"], "is in US survey foot"),
        (["+proj=utm +zone=32 +datum=WGS84 +vunits=ft", "a.jpg 1 2 3"], "is in foot"),
        (["EPSG:4326+5702", "a.jpg 8 47 3"], "line 1: 'EPSG:4326+5702' is in US survey foot"),
        (["nothing"], "line 1: 'nothing' is not a coordinate system"),
        (["EPSG:4326"], "no positions below"),
        (["EPSG:4326", "a.jpg 8"], "line 2: 'a.jpg 8'; give name, x, y and z"),
        (["EPSG:4326", "a.jpg 8 147"], "line 2: 'a.jpg 8 147' is not on the globe"),
        (["EPSG:4326", "a.jpg nan 47"], "line 2"),
        (["EPSG:32632", "a.jpg 1e300 1e300 5"], "line 2"),
        (["EPSG:4326", "a.jpg 8 47 1e9"], "line 2"),
        (["EPSG:4326", "a.jpg 8 47", "A.JPG 8 47", "A.JPG 8 48"], "line 4: a.jpg is elsewhere in"),
    ],
)
def test_what_is_wrong_is_said_with_its_line(tmp_path: Path, lines: list[str], what: str) -> None:
    with pytest.raises(InputError) as caught:
        read_geo(write(tmp_path / "geo.txt", *lines))
    assert what in str(caught.value) and "\n" not in str(caught.value)


def test_systems_of_heights_only_are_none() -> None:
    for text in ("EPSG:5773", "EPSG:999999", "", "WGS84 UTM 99N", "+proj=nothing"):
        with pytest.raises(ValueError, match="coordinate system"):
            system_of(text)


def test_stills_are_where_the_file_says(tmp_path: Path) -> None:
    """It lies in the folder, above one called images, or is named."""
    images = tmp_path / "images"
    images.mkdir()
    for name in ("A.JPG", "B.JPG", "C.JPG"):
        Image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(images / name)
    rows = ["EPSG:4326", "a 8.5 47.3 412.5 0 0 0 0.03 0.05", "B.JPG 8.5 47.4 413"]
    above = write(tmp_path / "geo.txt", *rows)
    for source in (str(images), f"images:{images}?geo={above}"):
        opened = open_camera(source)
        tags = [frame.geotag for frame in opened]
        assert tags[0] is not None and (tags[0].lat_deg, tags[0].alt_amsl_m) == (47.3, 412.5)
        assert tags[1] is not None and tags[1].sigma_h_m == 5.0 and tags[2] is None
        assert opened.warnings[0] == "positions are those of geo.txt: 2 of 3"
    write(images / "geo.txt", "EPSG:4326", "a.jpg 8.5 47.3 412.5")
    assert "states no accuracies" in open_camera(str(images)).warnings[1]
    write(images / "geo.txt", "EPSG:4326", "other.jpg 8.5 47.3")
    with pytest.raises(InputError, match="names none of the images"):
        open_camera(str(images))
