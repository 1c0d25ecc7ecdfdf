"""Folders of stills: times and places from EXIF, XMP and file names."""

from __future__ import annotations

import struct
import time
import tracemalloc
from contextlib import suppress
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from paths import DEMO, SHARED
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from recon.frames import rotation_from_rpy
from service.cameras import open_camera
from service.cameras.exif import name_unix_ns, read_tags
from service.cameras.images import natural_key, open_images
from service.cameras.rig import Rig
from service.cameras.source import GeoTag
from service.config import CameraConfig, FusionConfig, ScanConfig
from service.errors import InputError

FRAMES = DEMO / "frames"

NOON_UTC_NS = 1_717_243_200_000_000_000  # 2024-06-01T12:00:00Z


def write_still(
    path: Path,
    local: str | None = None,
    sub: str | None = None,
    offset: str | None = None,
    gps: dict[int, Any] | None = None,
    size_px: tuple[int, int] = (64, 48),
    xmp: str = "",
    orientation: int | None = None,
    focal_mm: int | None = None,
) -> None:
    """A gray JPEG with the given tags."""
    image = Image.fromarray(np.full((size_px[1], size_px[0], 3), 90, np.uint8))
    exif = Image.Exif()
    photo = exif.get_ifd(0x8769)
    if local:
        photo[36867] = local
    if sub:
        photo[37521] = sub
    if focal_mm:
        photo[41989] = focal_mm
    if offset:
        photo[36881] = offset
    if gps:
        exif.get_ifd(0x8825).update(gps)
    if orientation:
        exif[274] = orientation
    image.save(path, exif=exif, xmp=xmp.encode() if xmp else b"")


def gps_tags(
    lat: float, lon: float, alt: float, clock: tuple[int, int, int], day: str = "2024:06:01"
) -> dict[int, Any]:
    """A GPS block as cameras write it: unsigned degrees, minutes, seconds and letters."""

    def dms(degrees: float) -> tuple[IFDRational, ...]:
        degrees = abs(degrees)
        minutes = (degrees % 1) * 60
        seconds = round((minutes % 1) * 60 * 100_003)
        seconds += (
            degrees > 0 and seconds % 100_003 == 0
        )  # whole ones would be written without their decimals
        return IFDRational(int(degrees)), IFDRational(int(minutes)), IFDRational(seconds, 100_003)

    return {
        1: "N" if lat >= 0 else "S",
        2: dms(lat),
        3: "E" if lon >= 0 else "W",
        4: dms(lon),
        5: b"\0" if alt >= 0 else b"\1",
        6: IFDRational(round(abs(alt) * 10), 10),
        7: tuple(IFDRational(x) for x in clock),
        29: day,
    }


def test_zone_comes_from_the_gps_time(tmp_path: Path) -> None:
    for i in range(3):
        gps = gps_tags(-33.5, 151.25, 42.5, (12, 0, 2 * i))
        write_still(tmp_path / f"IMG_{i}.jpg", f"2024:06:01 22:00:0{2 * i + 1}", "25", gps=gps)
    source = open_camera(str(tmp_path))
    frames = list(source)
    assert source.epoch_unix_ns == NOON_UTC_NS + 1_250_000_000
    assert [f.time_ns for f in frames] == [0, 2_000_000_000, 4_000_000_000]
    assert source.fps == pytest.approx(0.5)
    tag = frames[0].geotag
    assert tag is not None
    assert (tag.lat_deg, tag.lon_deg) == pytest.approx((-33.5, 151.25), abs=1e-7)
    assert tag.alt_amsl_m == pytest.approx(42.5)
    assert tag.sigma_h_m == 5.0
    assert tag.ypr_deg is None
    assert source.warnings == []


def test_written_zone_wins_and_a_wrong_clock_is_corrected(tmp_path: Path) -> None:
    written = tmp_path / "written"
    written.mkdir()
    write_still(written / "a.jpg", "2024:06:01 14:00:00", offset="+02:00")
    assert open_camera(str(written)).epoch_unix_ns == NOON_UTC_NS
    wrong = tmp_path / "wrong"
    wrong.mkdir()
    for i in range(3):  # this camera's clock runs 5 minutes ahead of UTC
        gps = gps_tags(10, 20, 30, (12, 0, i))
        write_still(wrong / f"{i}.jpg", f"2024:06:01 12:05:0{i}", gps=gps)
    assert open_camera(str(wrong)).epoch_unix_ns == NOON_UTC_NS


def test_without_a_zone_local_time_counts_as_utc(tmp_path: Path) -> None:
    for i in range(3):
        write_still(tmp_path / f"{i}.jpg", f"2024:06:01 12:00:0{i}")
    source = open_camera(str(tmp_path))
    assert source.epoch_unix_ns == NOON_UTC_NS
    assert [f.time_ns for f in source] == [0, 10**9, 2 * 10**9]
    assert any("time zone" in w for w in source.warnings)


@pytest.mark.parametrize(
    ("local", "gps"),
    [
        ("9000:01:01 12:00:01", None),
        ("0001:01:01 12:00:01", None),
        (None, {7: (1e18, 0.0, 0.0), 29: "2024:06:01"}),
    ],
)
def test_a_time_that_no_clock_shows_is_none(
    tmp_path: Path, local: str | None, gps: dict[int, Any] | None
) -> None:
    write_still(tmp_path / "0.jpg", "2024:06:01 12:00:00", offset="+00:00")
    write_still(tmp_path / "1.jpg", local, offset="+00:00", gps=gps)
    source = open_camera(str(tmp_path))
    assert [f.time_ns for f in source] == [0, 10**9]
    assert source.epoch_unix_ns == NOON_UTC_NS
    assert any("1 of 2 images have no time" in w for w in source.warnings)


@pytest.mark.parametrize("sub", [None, "00"])
def test_stills_of_one_second_are_spread_over_it(tmp_path: Path, sub: str | None) -> None:
    for i in range(4):
        write_still(tmp_path / f"{i}.jpg", f"2024:06:01 12:00:0{i // 2}", sub, offset="+00:00")
    assert [f.time_ns for f in open_camera(str(tmp_path))] == [0, 5 * 10**8, 10**9, 15 * 10**8]


@pytest.mark.parametrize("offset", ["+00:00", None])
def test_one_time_that_a_tool_wrote_to_all_stills_is_none(
    tmp_path: Path, offset: str | None
) -> None:
    """It dates them."""
    for i in range(12):
        write_still(tmp_path / f"{i}.jpg", "2024:06:01 12:00:00", offset=offset)
    source = open_camera(str(tmp_path))
    assert [f.time_ns for f in source] == [i * 10**9 for i in range(12)]
    assert source.epoch_unix_ns == NOON_UTC_NS
    assert any("one time for all; ordered by" in w for w in source.warnings)


def test_order_is_of_time_not_of_names(tmp_path: Path) -> None:
    for i, name in enumerate(["IMG_9999.jpg", "IMG_0001.jpg", "IMG_0002.jpg"]):
        write_still(tmp_path / name, f"2024:06:01 12:00:0{i}", offset="+00:00")
    names = [f.name for f in open_camera(str(tmp_path))]
    assert names == ["IMG_9999.jpg", "IMG_0001.jpg", "IMG_0002.jpg"]


def test_of_some_moments_no_other_still_is_decoded(tmp_path: Path) -> None:
    for second, name in enumerate("abc"):
        write_still(tmp_path / f"{name}.jpg", f"2024:06:01 12:00:0{second}", offset="+00:00")
    source = open_images(str(tmp_path), {})
    for name in "ab":
        (tmp_path / f"{name}.jpg").unlink()
    source.only_near([2_000_000_000], 5_000_000)
    assert [f.time_ns for f in source] == [2_000_000_000] and not source.warnings


def test_names_order_and_space_stills_without_times(tmp_path: Path) -> None:
    for i in (10, 9, 100):
        write_still(tmp_path / f"f{i}.png")
    source = open_camera(str(tmp_path))
    assert [(f.name, f.time_ns) for f in source] == [
        ("f9.png", 0),
        ("f10.png", 10**9),
        ("f100.png", 2 * 10**9),
    ]
    assert any("have no time" in w for w in source.warnings)
    spaced = open_camera(f"images:{tmp_path}?interval_s=2.5")
    assert [f.time_ns for f in spaced] == [0, 2_500_000_000, 5_000_000_000]
    assert spaced.warnings == []
    with pytest.raises(InputError, match="interval_s"):
        open_camera(f"images:{tmp_path}?interval_s=soon")


@pytest.mark.parametrize(
    ("name", "unix_ns"),
    [
        ("2018080501004480Z.jpg", 1_533_430_844_800_000_000),
        ("20180805T010044Z.jpg", 1_533_430_844_000_000_000),
        ("cam1_20180805_010044.123Z.jpg", 1_533_430_844_123_000_000),
        ("2018080501004480.jpg", None),  # no Z: not known to be UTC
        ("2018139901004480Z.jpg", None),
        ("IMG_9375.jpg", None),
    ],
)
def test_times_in_names(name: str, unix_ns: int | None) -> None:
    assert name_unix_ns(name) == unix_ns


def geotag_of(folder: Path, xmp: str) -> GeoTag | None:
    """That of a still with a position in EXIF and this XMP."""
    path = folder / "DJI_0001.jpg"
    write_still(path, "2024:06:01 14:00:00", gps=gps_tags(47, 8, 129.5, (12, 0, 0)), xmp=xmp)
    return read_tags(path).geotag


def test_dji_xmp_gives_attitude_height_and_accuracy(tmp_path: Path) -> None:
    xmp = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description '
        'drone-dji:AbsoluteAltitude="+129.56" drone-dji:RelativeAltitude="+60.02" '
        'drone-dji:GimbalRollDegree="+0.00" drone-dji:GimbalYawDegree="-91.30" '
        'drone-dji:RtkStdLon="0.012" drone-dji:RtkStdLat="0.015">'
        "<drone-dji:GimbalPitchDegree>-89.90</drone-dji:GimbalPitchDegree>"
        "</rdf:Description></x:xmpmeta>"
    )
    tag = geotag_of(tmp_path, xmp)
    assert tag is not None
    assert tag.ypr_deg == (-91.3, -89.9, 0.0)
    assert tag.relative_alt_m == 60.02
    assert tag.sigma_h_m == 0.015


@pytest.mark.parametrize(
    "block",
    [
        # Autel: DJI's names
        '<rdf:Description drone:GimbalYawDegree="146.5" drone:GimbalPitchDegree="-78.4" '
        'drone:GimbalRollDegree="-0.3"/>',
        # Parrot Anafi, which also counts from straight down
        '<rdf:Description Camera:Yaw="140" Camera:Pitch="11" Camera:Roll="1">'
        "<drone-parrot:CameraRollDegree>-0.3</drone-parrot:CameraRollDegree>"
        "<drone-parrot:CameraPitchDegree>-78.4</drone-parrot:CameraPitchDegree>"
        "<drone-parrot:CameraYawDegree>146.5</drone-parrot:CameraYawDegree></rdf:Description>",
        # Skydio, older and newer, with angles in other frames of reference
        '<drone-skydio:CameraOrientationFLU drone-skydio:Roll="9" drone-skydio:Pitch="9" '
        'drone-skydio:Yaw="9"/><drone-skydio:CameraOrientationNED drone-skydio:Roll="-0.3" '
        'drone-skydio:Pitch="-78.4" drone-skydio:Yaw="146.5"/>',
        '<drone-skydio:CameraOrientationNED rdf:parseType="Resource">'
        "<drone-skydio:Roll>-0.3</drone-skydio:Roll><drone-skydio:Pitch>-78.4</drone-skydio:Pitch>"
        "<drone-skydio:Yaw>146.5</drone-skydio:Yaw></drone-skydio:CameraOrientationNED>"
        '<drone-skydio:CameraOrientationFLU rdf:parseType="Resource">'
        "<drone-skydio:Yaw>9</drone-skydio:Yaw></drone-skydio:CameraOrientationFLU>",
        # Teal 2: rationals
        "<exif:CameraPitch>-78400/1000</exif:CameraPitch><exif:CameraRoll>-3/10</exif:CameraRoll>"
        "<exif:CameraYaw>293/2</exif:CameraYaw><exif:PlatformYaw>31901593/100000</exif:PlatformYaw>",
    ],
)
def test_other_makers_state_the_attitude_too(tmp_path: Path, block: str) -> None:
    tag = geotag_of(tmp_path, f'<x:xmpmeta xmlns:x="adobe:ns:meta/">{block}</x:xmpmeta>')
    assert tag is not None and tag.ypr_deg == (146.5, -78.4, -0.3)


@pytest.mark.parametrize(
    ("namespace", "is_read"),
    [("http://pix4d.com/camera/1.0", True), ("http://pix4d.com/1.0", True), ("Camera/", False)],
    ids=["Sequoia", "RedEdge", "Disco, whose angles are its body's"],
)
def test_angles_of_the_prefix_camera_are_read_where_it_is_pix4ds(
    tmp_path: Path, namespace: str, is_read: bool
) -> None:
    xmp = (
        f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description xmlns:Camera="{namespace}" '
        'Camera:Yaw="18.678" Camera:Pitch="2.054" Camera:Roll="-2.392"/></x:xmpmeta>'
    )
    tag = geotag_of(tmp_path, xmp)
    assert tag is not None and tag.lat_deg is not None
    assert (tag.ypr_deg is not None) == is_read


def test_gimbal_angles_that_are_all_zero_are_unknown(tmp_path: Path) -> None:
    """A DJI Mini 2 that another program flew: the image looks down, the nose to the south."""
    xmp = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description drone-dji:RelativeAltitude="+110.80" '
        'drone-dji:GimbalRollDegree="+0.00" drone-dji:GimbalYawDegree="+0.00" '
        'drone-dji:GimbalPitchDegree="+0.00" drone-dji:FlightYawDegree="+176.50"/></x:xmpmeta>'
    )
    tag = geotag_of(tmp_path, xmp)
    assert tag is not None and tag.relative_alt_m == 110.8
    assert tag.ypr_deg is None


@pytest.mark.parametrize(
    ("ypr_deg", "nose_deg", "is_known"),
    [
        ((34.2, -90, 0), 90.1, False),  # a Mavic 2's thermal camera; the track agrees with the nose
        ((-171, -90, 0), 176.5, True),
        ((-90, -90, 180), 90.1, True),  # the same direction by other angles
        ((88, -20, 0), 90.1, True),
        ((88, 20, 0), 90.1, True),
        ((0, -45, 0), 90.1, False),
    ],
)
def test_headings_that_the_aircraft_contradicts_are_unknown(
    tmp_path: Path, ypr_deg: tuple[float, float, float], nose_deg: float, is_known: bool
) -> None:
    """But for one image out of three, taken in a turn."""
    for i in range(3):
        angles = dict(zip(("GimbalYaw", "GimbalPitch", "GimbalRoll"), ypr_deg, strict=True))
        named = {**angles, "FlightYaw": (nose_deg + 60.0 * (i == 1) + 180.0) % 360.0 - 180.0}
        values = " ".join(f'drone-dji:{name}Degree="{deg:+.2f}"' for name, deg in named.items())
        xmp = f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description {values}/></x:xmpmeta>'
        gps = gps_tags(23, 113, 133, (12, 0, i))
        write_still(tmp_path / f"{i}.jpg", f"2024:06:01 14:00:0{i}", "25", gps=gps, xmp=xmp)
    source = open_camera(str(tmp_path))
    tags = [frame.geotag for frame in source]
    assert [tag and tag.ypr_deg for tag in tags] == [ypr_deg] * 3
    assert [tag and tag.is_yaw_known for tag in tags] == [is_known] * 3
    assert any("off the aircraft's nose" in warning for warning in source.warnings) != is_known


@pytest.mark.parametrize(
    ("pitch_roll_deg", "looks_at_ned"),
    [((0, 0), (0, 0, 1)), ((10, 0), (0, 0.1736, 0.9848)), ((0, 10), (0.1736, 0, 0.9848))],
)
def test_pix4d_xmp_counts_angles_from_straight_down(
    tmp_path: Path, pitch_roll_deg: tuple[int, int], looks_at_ned: tuple[float, ...]
) -> None:
    """Of a vehicle that heads east: nose up, it looks ahead; right wing down, to its left."""
    pitch, roll = pitch_roll_deg
    xmp = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description '
        f'Camera:Yaw="90" Camera:Pitch="{pitch}" Camera:Roll="{roll}" '
        'Camera:GPSXYAccuracy="2.138" Camera:GPSZAccuracy="3.362"/></x:xmpmeta>'
    )
    tag = geotag_of(tmp_path, xmp)
    assert tag is not None and tag.ypr_deg is not None
    assert (tag.sigma_h_m, tag.sigma_v_m) == (2.138, 3.362)
    yaw, pitch, roll = np.radians(tag.ypr_deg)
    head = rotation_from_rpy(roll, pitch, yaw)
    np.testing.assert_allclose(head[:, 0], looks_at_ned, atol=1e-4)
    if pitch_roll_deg == (0, 0):
        np.testing.assert_allclose(-head[:, 2], [0, 1, 0], atol=1e-9)  # its upper side


def test_useless_gps_is_no_position(tmp_path: Path) -> None:
    broken = gps_tags(10, 20, 30, (1, 2, 3))
    broken[2] = (IFDRational(10), IFDRational(0, 0), IFDRational(0))
    cases = {"zero": gps_tags(0, 0, 0, (0, 0, 0)), "broken": broken, "none": {}}
    for name, gps in cases.items():
        path = tmp_path / f"{name}.jpg"
        write_still(path, gps=gps)
        assert read_tags(path).geotag is None, name


def test_a_camera_without_a_fix_still_knows_its_attitude_and_height(tmp_path: Path) -> None:
    """Under a bridge, or before the receiver has found its satellites."""
    xmp = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description drone-dji:RelativeAltitude="+12.50" '
        'drone-dji:GimbalRollDegree="+0.00" drone-dji:GimbalYawDegree="+90.00" '
        'drone-dji:GimbalPitchDegree="-45.00"/></x:xmpmeta>'
    )
    path = tmp_path / "DJI_0001.jpg"
    write_still(path, "2024:06:01 14:00:00", gps=gps_tags(0, 0, 0, (12, 0, 0)), xmp=xmp)
    tag = read_tags(path).geotag
    assert tag is not None and (tag.lat_deg, tag.lon_deg) == (None, None)
    prior = Rig(CameraConfig(), ScanConfig(), FusionConfig()).prior(None, tag)
    assert prior.R_world_camera is not None and not prior.is_view_assumed
    np.testing.assert_allclose(prior.R_world_camera[:, 2], [0.5**0.5, 0, -(0.5**0.5)], atol=1e-9)
    assert prior.position_m is None and prior.agl_m == 12.5


def test_a_position_of_another_day_is_not_used(tmp_path: Path) -> None:
    """The receiver's last place, 20 km off, in the first two; a second site half an hour later."""
    lats = [45.18, 45.18, *(45.0 + 1e-4 * i for i in range(4)), 45.4, 45.4]
    for i, lat in enumerate(lats):
        local = f"2024:06:01 12:{30 * (i > 5):02d}:{2 * i:02d}"
        write_still(
            tmp_path / f"{i}.jpg", local, offset="+00:00", gps=gps_tags(lat, 8, 90, (12, 0, i))
        )
    source = open_camera(str(tmp_path))
    tags = [frame.geotag for frame in source]
    assert [tag is not None and tag.lat_deg is not None for tag in tags] == [False] * 2 + [True] * 6
    assert source.warnings == [
        "2 positions are far off all others: not used",
        "the images are of 2 flights, the second from 6.jpg on: one scan of all; of other places "
        "or days give each flight its own folder",
    ]


def test_stills_that_no_library_decodes_are_named_with_the_remedy(tmp_path: Path) -> None:
    """Of a phone and of a drone's raw format; one beside its JPEG is no loss."""
    for name in ("IMG_1.HEIC", "IMG_2.HEIC"):
        (tmp_path / name).write_bytes(b"\0\0\0\x18ftypheic")
    for source in (tmp_path, tmp_path / "IMG_1.HEIC"):
        with pytest.raises(InputError, match=r"\.heic images are not read: convert") as refused:
            open_camera(str(source))
        assert "magick mogrify -format jpg *.HEIC" in str(refused.value)
    write_still(tmp_path / "IMG_1.jpg", "2024:06:01 12:00:00", offset="+00:00")
    said = open_camera(str(tmp_path)).warnings
    assert said[0].startswith("1 of 2 images are left out: .heic images are not read")
    write_still(tmp_path / "IMG_2.JPG", "2024:06:01 12:00:02", offset="+00:00")
    assert open_camera(str(tmp_path)).warnings == []


def test_odd_ones_are_left_out_and_reported(tmp_path: Path) -> None:
    for i in range(3):
        write_still(tmp_path / f"{i}.jpg", f"2024:06:01 12:00:0{i}", offset="+00:00")
    write_still(tmp_path / "wide.jpg", "2024:06:01 12:00:09", size_px=(96, 48))
    (tmp_path / "bad.jpg").write_bytes(b"no image")
    (tmp_path / "empty.jpg").touch()
    whole = (tmp_path / "1.jpg").read_bytes()
    (tmp_path / "1.jpg").write_bytes(whole[: whole.index(b"\xff\xda")])  # tags, but no pixels
    (tmp_path / "notes.txt").write_text("not looked at")
    source = open_camera(str(tmp_path))
    assert [(f.seq, f.name) for f in source] == [(0, "0.jpg"), (1, "2.jpg")]
    reported = list(source.warnings)
    for name in ("bad.jpg", "empty.jpg", "1.jpg", "not 64x48"):
        assert name in "\n".join(reported)
    assert len(list(source)) == 2 and source.warnings == reported  # once each


def test_of_the_cameras_of_one_drone_that_in_colour_counts(tmp_path: Path) -> None:
    """Beside each image a thermal one, or two of a spectral camera; and what a Mac adds."""
    for i in range(3):
        at = f"2024:06:01 12:00:0{i}"
        write_still(tmp_path / f"DJI_{i}_T.jpg", at, size_px=(64, 51))
        write_still(tmp_path / f"DJI_{i}_MS_G.jpg", at, size_px=(60, 45))
        write_still(tmp_path / f"DJI_{i}_MS_R.jpg", at, size_px=(60, 45))
        write_still(tmp_path / f"DJI_{i}_V.jpg", at, size_px=(80, 60))
        (tmp_path / f"._DJI_{i}_V.jpg").write_bytes(b"\0\5\x16\7")
    write_still(tmp_path / "panorama.jpg", "2024:06:01 12:00:09", size_px=(192, 96))
    source = open_camera(str(tmp_path))
    assert [f.name for f in source] == [f"DJI_{i}_V.jpg" for i in range(3)]
    assert source.warnings[0] == (
        "10 images are not 80x60 like the others; skipped (images:DIR?camera=60x45 takes those)"
    )
    assert not any("readable" in warning for warning in source.warnings)


def dji(**values: object) -> str:
    """An XMP packet as DJI writes it."""
    attributes = " ".join(f'drone-dji:{name}="{value}"' for name, value in values.items())
    return f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description {attributes}/></x:xmpmeta>'


def test_of_several_named_cameras_the_one_that_sees_most_counts(tmp_path: Path) -> None:
    """As DJI's H20T: the zoom camera has more pixels than the wide one, the thermal one few."""
    cameras = {"ZoomCamera": ("Z", (128, 96), 104), "WideCamera": ("W", (64, 48), 26)}
    cameras["InfraredCamera"] = ("T", (32, 24), 20)
    for i in range(3):
        for name, (letter, size_px, focal_mm) in cameras.items():
            write_still(
                tmp_path / f"DJI_{i}_{letter}.jpg", f"2024:06:01 12:00:0{i}", size_px=size_px,
                xmp=dji(ImageSource=name), focal_mm=focal_mm,
            )  # fmt: skip
    source = open_camera(str(tmp_path))
    assert [f.name for f in source] == [f"DJI_{i}_W.jpg" for i in range(3)]
    assert source.warnings[0] == (
        "the camera that sees most is used: WideCamera, 3 of 9 images; "
        "images:DIR?camera=InfraredCamera takes another (InfraredCamera, ZoomCamera)"
    )
    for chosen, letter in (("ZoomCamera", "Z"), ("32x24", "T")):
        names = [f.name for f in open_camera(f"images:{tmp_path}?camera={chosen}")]
        assert names == [f"DJI_{i}_{letter}.jpg" for i in range(3)]
    with pytest.raises(
        InputError, match="of camera 'Wide', but of InfraredCamera, WideCamera, Z"
    ) as e:
        open_camera(f"images:{tmp_path}?camera=Wide")
    assert str(e.value).count("WideCamera") == 1


def test_of_two_unnamed_cameras_of_one_size_the_wider_counts(tmp_path: Path) -> None:
    for i in range(3):
        for letter, focal_mm in (("A", 70), ("B", 24)):
            path = tmp_path / f"{letter}{i}.jpg"
            write_still(path, f"2024:06:01 12:00:0{i}", focal_mm=focal_mm)
    assert [f.name for f in open_camera(str(tmp_path))] == ["B0.jpg", "B1.jpg", "B2.jpg"]


TRUE_LAT, TRUE_LON = 30.1707953, -98.0892133


@pytest.mark.parametrize(
    ("exif", "xmp", "place", "alt_m", "said"),
    [
        ({}, {}, (TRUE_LAT, TRUE_LON), 350.0, ()),
        ({1: "", 2: (0, 0, 0), 3: "", 4: (0, 0, 0)}, {}, (TRUE_LAT, TRUE_LON), 350.0, ()),
        ({6: IFDRational(0)}, {}, (TRUE_LAT, TRUE_LON), 350.0, ("another altitude; that of XMP",)),
        ({2: (30, 10, 14), 4: (98, 5, 21)}, {}, (TRUE_LAT, TRUE_LON), 350.0, ()),  # cut
        ({1: "", 3: ""}, {}, (TRUE_LAT, TRUE_LON), 350.0, ()),
        # Corrected positions in EXIF, the receiver's own in XMP
        ({}, {"GpsLatitude": "+30.1708100"}, (TRUE_LAT, TRUE_LON), 350.0, ("that of EXIF",)),
        ({6: IFDRational(350)}, {"AbsoluteAltitude": "+350.43"}, (TRUE_LAT, TRUE_LON), 350.43, ()),
        ({}, {"AbsoluteAltitude": "+0.00"}, (TRUE_LAT, TRUE_LON), 350.0, ("that of EXIF",)),
    ],
    ids=["same", "zeros", "altitude 0", "cut", "letters", "corrected", "metres", "XMP 0"],
)
def test_of_two_sources_of_one_value_the_better_one_counts(
    tmp_path: Path,
    exif: dict[int, Any],
    xmp: dict[str, str],
    place: tuple[float, float],
    alt_m: float,
    said: tuple[str, ...],
) -> None:
    values = {"GpsLatitude": f"{TRUE_LAT:+.7f}", "GpsLongitude": f"{TRUE_LON:+.7f}"}
    values |= {"AbsoluteAltitude": "+350.00"} | xmp
    gps = gps_tags(TRUE_LAT, TRUE_LON, 350.0, (12, 0, 0)) | exif
    gps |= {k: tuple(map(IFDRational, v)) for k, v in exif.items() if isinstance(v, tuple)}
    write_still(tmp_path / "a.jpg", "2024:06:01 12:00:00", "5", "+00:00", gps, xmp=dji(**values))
    source = open_camera(str(tmp_path))
    (frame,) = source
    tag = frame.geotag
    assert tag is not None
    assert (tag.lat_deg, tag.lon_deg) == pytest.approx(place, abs=2e-7)
    assert tag.alt_amsl_m == pytest.approx(alt_m) and tag.sigma_h_m == pytest.approx(5.0)
    assert [s in w for s, w in zip(said, source.warnings, strict=True)] == [True] * len(said)


def test_a_position_cut_to_seconds_is_as_uncertain(tmp_path: Path) -> None:
    cut = {2: (IFDRational(30), IFDRational(10), IFDRational(14)), 6: IFDRational(350)}
    cut[4] = (IFDRational(98), IFDRational(5), IFDRational(21))
    write_still(tmp_path / "a.jpg", gps=gps_tags(1, 1, 1, (1, 1, 1)) | {1: "N", 3: "W"} | cut)
    tag = read_tags(tmp_path / "a.jpg").geotag
    assert tag is not None and 20.0 < tag.sigma_h_m < 30.0


def test_minutes_with_decimals_have_no_seconds(tmp_path: Path) -> None:
    """As a Nikon D5000 writes them (drewnoakes/metadata-extractor-images): seconds of 0/0."""
    none = IFDRational(0, 0)
    minutes = {
        2: (IFDRational(48), IFDRational(5_332_358, 100_000), none),
        4: (IFDRational(21), IFDRational(3, 1), none),
    }
    gps = gps_tags(1, 1, 1, (1, 1, 1)) | minutes
    write_still(tmp_path / "a.jpg", gps=gps)
    write_still(tmp_path / "b.jpg", gps=gps | {4: (none, IFDRational(3), IFDRational(1))})
    tag = read_tags(tmp_path / "a.jpg").geotag
    assert tag is not None and tag.sigma_h_m > 500.0  # whole minutes of longitude
    assert (tag.lat_deg, tag.lon_deg) == pytest.approx((48.888726, 21.05), abs=1e-6)
    assert read_tags(tmp_path / "b.jpg").geotag is None


def test_a_position_without_its_hemisphere_waits_for_it(tmp_path: Path) -> None:
    """Texas lay in Myanmar."""
    gps = gps_tags(TRUE_LAT, TRUE_LON, 350.0, (12, 0, 0))
    del gps[1], gps[3]
    write_still(tmp_path / "a.jpg", "2024:06:01 12:00:00", "5", "+00:00", gps)
    source = open_camera(str(tmp_path))
    assert [frame.geotag for frame in source] == [None]
    assert source.warnings == [
        "1 positions state no hemisphere (N or S, E or W): not used; "
        "images:DIR?hemisphere=NW gives it"
    ]
    (frame,) = open_camera(f"images:{tmp_path}?hemisphere=nw")
    assert frame.geotag is not None
    assert frame.geotag.lon_deg == pytest.approx(TRUE_LON, abs=1e-7)
    with pytest.raises(InputError, match="NE, NW, SE or SW"):
        open_camera(f"images:{tmp_path}?hemisphere=N")


def test_a_height_of_an_rtk_receiver_is_above_the_ellipsoid(tmp_path: Path) -> None:
    gps = gps_tags(TRUE_LAT, TRUE_LON, 350.0, (12, 0, 0))
    write_still(tmp_path / "a.jpg", gps=gps, xmp=dji(AltitudeType="RtkAlt", RtkFlag=50))
    write_still(tmp_path / "b.jpg", gps=gps, xmp=dji(AltitudeType="GpsFusionAlt"))
    datums = [tag and tag.datum for n in "ab" for tag in [read_tags(tmp_path / f"{n}.jpg").geotag]]
    assert datums == ["ellipsoid", ""]


def test_altitudes_of_a_drone_are_by_air_pressure_but_of_rtk_or_a_survey_not(
    tmp_path: Path,
) -> None:
    gps = gps_tags(TRUE_LAT, TRUE_LON, 350.0, (12, 0, 0))
    for name, kind in (("a", "RtkAlt"), ("b", "GpsFusionAlt")):
        packet = dji(AltitudeType=kind, RelativeAltitude="+50.0")
        write_still(tmp_path / f"{name}.jpg", gps=gps, xmp=packet)
    tags = [read_tags(tmp_path / f"{name}.jpg").geotag for name in "ab"]
    assert [tag and tag.is_pressure_altitude for tag in tags] == [False, True]
    (tmp_path / "geo.txt").write_text(f"EPSG:4326\nb.jpg {TRUE_LON} {TRUE_LAT} 412.5\n")
    tags = [frame.geotag for frame in open_camera(str(tmp_path))]
    assert [tag and (tag.relative_alt_m, tag.is_pressure_altitude) for tag in tags] == [
        (50.0, False)
    ] * 2


@pytest.mark.parametrize("below", [b"\0", b"\1"])
def test_an_altitude_below_zero_in_an_unsigned_number_is_read(tmp_path: Path, below: bytes) -> None:
    """As a Yuneec E10T writes -28.41 m; where the letter says below, too, it is above."""
    gps = gps_tags(31.19, 120.93, 0.0, (12, 0, 0)) | {5: below, 6: IFDRational(77_777, 1000)}
    path = tmp_path / "a.jpg"
    write_still(path, gps=gps)
    data, order = path.read_bytes(), "<" if b"Exif\0\0II" in path.read_bytes() else ">"
    as_written = struct.pack(f"{order}LL", (1 << 32) - 28_410, 1000)
    path.write_bytes(data.replace(struct.pack(f"{order}LL", 77_777, 1000), as_written))
    tag = next(iter(open_camera(str(tmp_path)))).geotag
    assert tag is not None and tag.alt_amsl_m == pytest.approx(28.41 if below == b"\1" else -28.41)


def test_an_altitude_in_fine_steps_is_read_as_stated(tmp_path: Path) -> None:
    """Its numerator alone does not mean that it is below zero."""
    gps = gps_tags(31.19, 120.93, 0.0, (12, 0, 0)) | {6: IFDRational(3_000_000_001, 10_000_000)}
    write_still(tmp_path / "a.jpg", gps=gps)
    tag = read_tags(tmp_path / "a.jpg").geotag
    assert tag is not None and tag.alt_amsl_m == pytest.approx(300.0)


def test_altitudes_of_two_datums_are_not_mixed(tmp_path: Path) -> None:
    """The receiver lost its corrections in one of three."""
    for i, kind in enumerate(("RtkAlt", "GpsFusionAlt", "RtkAlt")):
        gps = gps_tags(TRUE_LAT, TRUE_LON, 350.0, (12, 0, i))
        at = f"2024:06:01 12:00:0{i}"
        write_still(tmp_path / f"{i}.jpg", at, "5", "+00:00", gps, xmp=dji(AltitudeType=kind))
    source = open_camera(str(tmp_path))
    tags = [frame.geotag for frame in source]
    assert [tag and tag.alt_amsl_m for tag in tags] == [350.0, None, 350.0]
    assert source.warnings == [
        "1 altitudes are above another datum than the others' (ellipsoid): not used"
    ]


# Packets and tags that are made to harm


def hostile_still(path: Path, packet: bytes) -> Path:
    """A JPEG with a packet of any length in as many segments as it needs."""
    write_still(path)
    whole, head = path.read_bytes(), b"http://ns.adobe.com/xap/1.0/\0"
    parts = [head + packet[i : i + 65_000] for i in range(0, len(packet), 65_000)]
    segments = [b"\xff\xe1" + (len(p) + 2).to_bytes(2, "big") + p for p in parts]
    path.write_bytes(whole[:2] + b"".join(segments) + whole[2:])
    return path


@pytest.mark.parametrize(
    "packet",
    [
        b"<Camera:a><rdf:Seq>" * 15_000,
        b"<drone-skydio:CameraOrientationNED" * 8_000,
        b"<drone-skydio:CameraOrientationNED>" * 8_000,
        b'<drone-dji:a b="' * 15_000,
        b'<!DOCTYPE a [<!ENTITY a "' + b"a" * 30_000 + b'">]><drone:Yaw>' + b"&a;" * 10_000,
        bytes(range(256)) * 1_000,
    ],
    ids=["lists", "names", "elements", "attributes", "entities", "bytes"],
)
def test_hostile_packets_take_no_time(tmp_path: Path, packet: bytes) -> None:
    """By processor time; the first two took a minute."""
    path = hostile_still(tmp_path / "a.jpg", packet)
    began_s = time.process_time()
    assert read_tags(path).geotag is None
    assert time.process_time() - began_s < 10.0


def test_a_damaged_packet_gives_what_comes_before_the_damage(tmp_path: Path) -> None:
    packet = dji(RelativeAltitude="+12.50", GimbalYawDegree="5", GimbalPitchDegree="-90")
    hostile_still(tmp_path / "a.jpg", packet.encode()[:-12] + b">& <")
    tag = read_tags(tmp_path / "a.jpg").geotag
    assert tag is not None and tag.relative_alt_m == 12.5 and tag.ypr_deg == (5.0, -90.0, 0.0)


def test_tags_of_a_large_tiff_are_read_up_to_a_limit(tmp_path: Path) -> None:
    """A list of a million fractions as a latitude."""
    entries = [(256, 3, 8), (257, 3, 8), (258, 3, 8), (259, 3, 1), (262, 3, 1), (273, 4, 8)]
    entries += [(278, 3, 8), (279, 4, 64), (0x8825, 4, 200)]
    table = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in entries)
    data = b"II*\0" + struct.pack("<I", 72) + bytes(64) + struct.pack("<H", len(entries)) + table
    gps = struct.pack("<HHHIII", 1, 2, 5, 1_000_000, 300, 0)
    path = tmp_path / "a.tif"
    path.write_bytes((data.ljust(200, b"\0") + gps).ljust(300, b"\0") + bytes(8_000_000))
    with (
        pytest.warns(UserWarning, match="tags"),
        pytest.raises(OSError, match="tags are too large"),
    ):
        read_tags(path)


@pytest.mark.filterwarnings("ignore")
def test_tags_that_state_one_place_again_and_again_take_no_memory(tmp_path: Path) -> None:
    """5000 lists in the same 56 kB: 280 MB to read, 35 million fractions."""
    lists = b"".join(struct.pack("<HHII", tag, 5, 7000, 8) for tag in range(5000))
    block = b"II*\0" + struct.pack("<IHHHII", 8, 1, 0x8825, 4, 1, 26) + bytes(4)
    block += struct.pack("<H", 5000) + lists + bytes(4)
    path = tmp_path / "a.jpg"
    Image.new("RGB", (64, 48)).save(path, exif=b"Exif\0\0" + block.ljust(65_000, b"\1"))
    tracemalloc.start()
    try:
        with suppress(OSError):
            assert read_tags(path).geotag is None
        assert tracemalloc.get_traced_memory()[1] < 100_000_000
    finally:
        tracemalloc.stop()


def test_a_still_is_not_skipped_for_want_of_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_still(tmp_path / "a.jpg")
    source = open_camera(str(tmp_path))
    short = cv2.error("Failed to allocate 5760000 bytes")
    short.code = cv2.Error.StsNoMem
    monkeypatch.setattr(cv2, "imdecode", Mock(side_effect=short))
    with pytest.raises(MemoryError, match=r"a\.jpg"):
        list(source)


def test_folders_without_images_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no images"):
        open_camera(str(tmp_path))
    with pytest.raises(InputError, match="no such folder"):
        open_camera(f"images:{tmp_path / 'none'}")


def test_a_folder_of_folders_names_those_with_images(tmp_path: Path) -> None:
    for name in ("100MEDIA", "101MEDIA"):
        (tmp_path / "DCIM" / name).mkdir(parents=True)
        (tmp_path / "DCIM" / name / "DJI_0001.JPG").write_bytes(b"image")
    with pytest.raises(InputError, match=r"give their folder: .*100MEDIA, .*101MEDIA$"):
        open_camera(f"images:{tmp_path}")


def test_natural_order() -> None:
    names = ["b2.jpg", "b10.jpg", "a.jpg", "b1.jpg", "10.jpg", "9.jpg"]
    ordered = sorted((Path(n) for n in names), key=natural_key)
    assert [p.name for p in ordered] == ["9.jpg", "10.jpg", "a.jpg", "b1.jpg", "b2.jpg", "b10.jpg"]


def test_demo_flight_is_tagged() -> None:
    source = open_camera(str(FRAMES))
    frames = list(source)
    assert len(frames) == 41
    assert source.size_px == (1600, 1200)
    assert source.epoch_unix_ns == 1_413_742_872_000_000_000  # 13:21:12 local, UTC-5
    assert all(f.geotag is not None for f in frames)
    assert source.warnings == []


@pytest.mark.skipif(not SHARED.is_dir(), reason="needs ../shared/data")
def test_named_stills_get_utc() -> None:
    source = open_camera(str(SHARED / "cuav_cmac_20180805" / "frames"))
    times = [f.time_ns for f in source]
    assert source.epoch_unix_ns == 1_533_430_844_800_000_000
    assert len(times) == 18
    assert times[-1] == 14_780_000_000


@pytest.mark.parametrize("kind", ["png", "tif"])
def test_temperatures_become_grays_that_are_alike_in_all_images(tmp_path: Path, kind: str) -> None:
    """A thermal camera's counts took two of the 256 grays."""
    v, u = np.mgrid[0:60, 0:80]
    counts = [(7000 + 4 * v + 3 * u + 40 * k).astype(np.uint16) for k in range(6)]
    for k, image in enumerate(counts):
        cv2.imwrite(str(tmp_path / f"{k}.{kind}"), image)
    source = open_camera(str(tmp_path))
    shown = [frame.image.astype(float) for frame in source]
    rate = np.polyfit(np.array(counts).ravel(), np.array(shown)[..., 1].ravel(), 1)
    assert 0.2 < rate[0] < 0.5
    for image, count in zip(shown, counts, strict=True):
        assert np.ptp(image, axis=2).max() == 0.0
        assert np.abs(image[..., 0] - np.polyval(rate, count)).max() < 1.5
    assert [w for w in source.warnings if "are black to white" in w]


def test_degrees_in_floats_are_seen_and_what_is_unknown_is_black(tmp_path: Path) -> None:
    degrees = np.linspace(11.0, 29.0, 4800, dtype=np.float32).reshape(60, 80)
    degrees[:10, :10] = np.nan
    cv2.imwrite(str(tmp_path / "a.tif"), degrees)
    (frame,) = open_camera(str(tmp_path))
    assert frame.image[:10, :10].max() == 0 and np.ptp(frame.image[20:]) > 60


@pytest.mark.parametrize("odd", [np.inf, -np.inf, 3e38])
def test_levels_are_those_of_what_is_known(tmp_path: Path, odd: float) -> None:
    degrees = np.linspace(11.0, 29.0, 4800, dtype=np.float32).reshape(60, 80)
    unlike = degrees.copy()
    unlike[:] = odd  # all of one image
    if not np.isfinite(odd):
        degrees[:10, :10] = odd
    for name, image in (("a", degrees), ("b", unlike), ("c", degrees)):
        cv2.imwrite(str(tmp_path / f"{name}.tif"), image)
    first, _, third = open_camera(str(tmp_path))
    assert np.array_equal(first.image, third.image)
    assert np.isfinite(odd) or np.ptp(first.image[20:]) > 60


@pytest.mark.parametrize("kind", ["png", "tif"])
def test_a_photo_of_16_bits_is_shown_whole(tmp_path: Path, kind: str) -> None:
    photo = np.random.default_rng(0).integers(0, 1 << 16, (60, 80, 3)).astype(np.uint16)
    cv2.imwrite(str(tmp_path / f"a.{kind}"), photo)
    source = open_camera(str(tmp_path))
    (frame,) = source
    assert np.abs(frame.image.astype(int) - (photo >> 8)).max() <= 1
    assert not [w for w in source.warnings if "black" in w]
