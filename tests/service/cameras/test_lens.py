"""The lens and the upper side of images, by their tags and by a camera model of another size."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import av
import cv2
import numpy as np
import pytest
from paths import SHARED
from PIL import Image
from typer.testing import CliRunner

from mavlink.telemetry.history import VehicleHistory
from mavlink.telemetry.logs import TelemetryLog
from recon.camera_model import rays
from recon.types import DIRECTIONS, F64, U8, Camera, Shutter
from service.cameras import open_camera
from service.cameras.exif import read_tags
from service.cameras.lens import SIGMA_FOCAL, Lens, by_view, fitted, reshaped, turned
from service.cameras.rig import Rig
from service.cameras.source import CameraSource
from service.cli import app
from service.commands.missing_metadata import start_lens
from service.config import CameraConfig, FusionConfig, ScanConfig
from service.errors import InputError

DEWARP = "2020-05-27;3666.66,3665.99,-27.8,30.0,-0.269,0.112,0.0003,-0.0001,-0.033"
DEWARP_1600 = "2022-03-02;1973.1,1955.7,-19.0,-11.4,-0.423,0.369,0.0041,0.0041,-0.264"


def marked(size_px: tuple[int, int]) -> U8:
    """(H, W, 3) with a white mark in the upper left corner."""
    image = np.full((size_px[1], size_px[0], 3), 60, np.uint8)
    image[: size_px[1] // 4, : size_px[0] // 4] = 250
    return image


def write_still(
    path: Path, size_px: tuple[int, int], photo: dict[int, Any] | None = None, xmp: str = "",
    orientation: int = 1,
) -> None:  # fmt: skip
    exif = Image.Exif()
    exif.get_ifd(0x8769).update(photo or {})
    exif[274] = orientation
    image = Image.fromarray(marked(size_px))
    image.save(path, exif=exif, xmp=xmp.encode() if xmp else b"", quality=95)


def xmp_of(names: dict[str, str], space: str = "drone-dji") -> str:
    values = " ".join(f'{space}:{name}="{value}"' for name, value in names.items())
    namespace = "http://pix4d.com/1.0" if space == "Camera" else "x"
    return f'<x:xmpmeta><rdf:Description xmlns:{space}="{namespace}" {values}/></x:xmpmeta>'


@pytest.mark.parametrize(
    ("photo", "xmp", "fx_px", "source"),
    [
        # Canon SX260: 4.5 mm, 16393.44 px per inch on 4000 px; the image was made smaller.
        ({37386: 4.5, 41486: 16393.4426, 41488: 2, 40962: 4000, 40963: 3000}, "", 1161.7, "focal"),
        ({41989: 24}, "", 24 / 43.2666 * 2000, "35 mm"),
        # A program kept the resolution of the full image and dropped its size.
        ({37386: 4.5, 41486: 16393.4426, 41488: 2, 41989: 25}, "", 25 / 43.2666 * 2000, "35 mm"),
        (
            {40962: 5280, 40963: 3956},
            xmp_of({"DewarpData": DEWARP, "DewarpFlag": "0"}),
            3666.66 / 5280 * 1600,
            "maker",
        ),
        (
            {40962: 4000, 40963: 3000},
            xmp_of({"CalibratedFocalLength": "2290.0", "CalibratedOpticalCenterX": "2000.0",
                    "CalibratedOpticalCenterY": "1500.0"}),
            2290 / 4000 * 1600,
            "maker",
        ),
        (
            {41486: 330.0, 41488: 4, 40962: 4608, 40963: 3456},
            xmp_of({"PerspectiveFocalLength": "10.0", "PrincipalPoint": "7.0,5.2"}, "Camera"),
            10.0 * 330.0 / 4608 * 1600,
            "maker",
        ),
        (  # an older RedEdge: pixels, with the principal point in millimetres
            {37386: 5.5, 41486: 266.667, 41488: 4, 40962: 1280, 40963: 960},
            xmp_of({"PerspectiveFocalLength": "1449.358", "PrincipalPoint": "2.35363,1.79947"},
                   "Camera"),
            1449.358 / 1280 * 1600,
            "maker",
        ),
        ({}, xmp_of({"CameraHorizontalFOV": "60/1"}, "exif"), 800 * 3**0.5, "field of view"),
    ],
)  # fmt: skip
def test_the_focal_length_is_read(
    tmp_path: Path, photo: dict[int, Any], xmp: str, fx_px: float, source: str
) -> None:
    write_still(tmp_path / "a.jpg", (1600, 1200), photo, xmp)
    lens = read_tags(tmp_path / "a.jpg").lens
    assert lens is not None and source in lens.source
    assert lens.camera((1600, 1200)).K[0, 0] == pytest.approx(fx_px, rel=1e-3)


@pytest.mark.parametrize(
    ("focal_mm", "full_frame_mm", "whole"),
    [
        (3.61, 20, (4000, 3000)),  # 1/2.3 inch
        (8.8, 24, (5472, 3648)),  # one inch
        (12.29, 24, (5280, 3956)),  # Four Thirds
        (35.0, 35, (8192, 5460)),  # full frame
    ],
)
def test_the_middle_rows_of_a_sensor_have_the_lens_of_all_rows(
    tmp_path: Path, focal_mm: float, full_frame_mm: int, whole: tuple[int, int]
) -> None:
    focal = []
    for rows in (whole[1], whole[0] * 9 // 16 // 2 * 2):
        write_still(tmp_path / "a.jpg", (whole[0], rows), {37386: focal_mm, 41989: full_frame_mm})
        lens = read_tags(tmp_path / "a.jpg").lens
        assert lens is not None
        focal.append(lens.camera((whole[0], rows)).K[0, 0])
    assert focal[0] == pytest.approx(full_frame_mm * np.hypot(*whole) / 43.2666, rel=2e-3)
    assert focal[1] == pytest.approx(focal[0], rel=2e-3)


def test_whole_millimetres_are_less_sure_the_shorter_the_lens(tmp_path: Path) -> None:
    sigma = {}
    for mm in (12, 24, 200):
        write_still(tmp_path / "a.jpg", (1600, 1200), {41989: mm})
        lens = read_tags(tmp_path / "a.jpg").lens
        assert lens is not None
        sigma[mm] = lens.sigma_focal
    assert sigma[12] == pytest.approx(np.hypot(SIGMA_FOCAL, 0.5 / 12 / np.sqrt(3.0)))
    assert sigma[12] > 1.07 * sigma[24] > 1.09 * sigma[200] > 1.09 * SIGMA_FOCAL


def test_the_makers_distortion_and_middle_are_read(tmp_path: Path) -> None:
    photo = {40962: 5280, 40963: 3956}
    for flag, k1 in (("0", -0.269), ("1", 0.0)):
        xmp = xmp_of({"DewarpData": DEWARP, "DewarpFlag": flag})
        write_still(tmp_path / "a.jpg", (5280, 3956), photo, xmp)
        lens = read_tags(tmp_path / "a.jpg").lens
        assert lens is not None
        camera = lens.camera((5280, 3956))
        assert camera.distortion[0] == pytest.approx(k1)
        assert camera.K[0, 2] == pytest.approx(2639.5 - 27.8)
        assert camera.K[1, 2] == pytest.approx(1977.5 + 30.0)


def test_the_images_may_correct_the_makers_calibration(tmp_path: Path) -> None:
    write_still(tmp_path / "a.jpg", (1600, 1200), {}, xmp_of({"DewarpData": DEWARP_1600}))
    start = start_lens(open_camera(str(tmp_path)), None)
    assert start.camera.distortion[0] == pytest.approx(-0.423) and start.assumed == ()
    # Of a real one, the focal length was off by 1 % and the middle by 1.4 % of the width.
    assert start.search.sigma_focal >= 0.01 and start.search.sigma_centre >= 0.014
    assert start.search.sigma_k <= 0.1


def test_the_makers_focal_length_alone_leaves_the_distortion_open(tmp_path: Path) -> None:
    write_still(tmp_path / "a.jpg", (1600, 1200), {}, xmp_of({"CalibratedFocalLength": "1913.3"}))
    start = start_lens(open_camera(str(tmp_path)), None)
    assert start.assumed == ("distortion",)
    assert start.search.max_sigmas * start.search.sigma_k > 0.5  # k1 of that camera: -0.43


@pytest.mark.parametrize(
    "photo", [{}, {37386: 0.0, 41989: 0}, {41989: 4}, {37386: 4.5, 41486: 1e9, 41488: 2}]
)
def test_useless_tags_are_no_lens(tmp_path: Path, photo: dict[int, Any]) -> None:
    write_still(tmp_path / "a.jpg", (1600, 1200), photo, xmp_of({"DewarpData": "x;1,nan,2"}))
    assert read_tags(tmp_path / "a.jpg").lens is None


@pytest.mark.parametrize("clockwise_deg", [90, 180, 270])
def test_a_turned_camera_sees_the_same(clockwise_deg: int) -> None:
    """Against OpenCV's projection of points and NumPy's turn of the image's raster."""
    K = np.array([[900.0, 0, 700.0], [0, 880.0, 410.0], [0, 0, 1]])
    camera = Camera(K, np.array([-0.2, 0.05, 0.002, -0.003, 0.01]), (1280, 720))
    points = np.random.default_rng(1).uniform([-3, -2, 5], [3, 2, 9], (20, 3))
    angle = np.radians(clockwise_deg)
    R = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    there = turned(camera, clockwise_deg)
    seen, expected = (
        cv2.projectPoints(p, np.zeros(3), np.zeros(3), c.K, c.distortion)[0][:, 0]
        for p, c in ((points @ R.T, there), (points, camera))
    )
    rows, columns = np.mgrid[0:720, 0:1280].astype(np.float64)
    turn = -(clockwise_deg // 90)
    for axis, raster in enumerate((columns, rows)):
        source = np.rot90(raster, turn).astype(np.float32)
        u, v = seen.astype(np.float32).T[:, :, None]
        got = cv2.remap(source, u, v, cv2.INTER_LINEAR)
        assert np.abs(got[:, 0] - expected[:, axis]).max() < 0.05


@pytest.mark.parametrize("clockwise_deg", [0, 90, 180, 270])
@pytest.mark.parametrize("direction", DIRECTIONS)
def test_a_turned_camera_reads_its_rows_as_before(clockwise_deg: int, direction: str) -> None:
    camera = replace(Lens(0.75).camera((4, 3)), shutter=Shutter(0.03, direction))
    read_at = {"down": 0, "right": 1, "up": 2, "left": 3}[direction]
    times = np.rot90(np.mgrid[0:9, 0:9][0], read_at)  # of rows of a square, by NumPy's turns
    shutter = turned(camera, clockwise_deg).shutter
    rate = np.gradient(np.rot90(times, -(clockwise_deg // 90)).astype(np.float64))
    assert shutter.readout_s == 0.03
    assert (rate[1 - shutter.axis] == shutter.sign).all()
    assert not rate[shutter.axis].any()


def images(size_px: tuple[int, int], turned_deg: int = 0) -> Any:
    """A source of images of this size."""
    given = {"size_px": size_px, "turned_deg": turned_deg, "is_reshaped": False}
    return Mock(CameraSource, description="gimbal", **given)


def test_a_model_of_another_size_is_scaled_and_of_another_shape_refused() -> None:
    camera = Lens(0.75).camera((4000, 3000))
    assert fitted(camera, images((4000, 3000))) == (camera, [])
    small, notes = fitted(camera, images((1600, 1200)))
    assert small.K[0, 0] == pytest.approx(1200.0) and small.K[0, 2] == pytest.approx(799.5)
    assert notes == ["the camera model is for 4000x3000 images: scaled to 1600x1200"]
    portrait, notes = fitted(camera, images((3000, 4000), 90))
    assert portrait.size_px == (3000, 4000) and notes == []
    for refused in (images((1600, 900)), images((1200, 1600))):
        with pytest.raises(InputError, match="4000x3000 images, gimbal has 1"):
            fitted(camera, refused)


def test_the_model_of_another_shape_sees_as_much_along_the_longer_side() -> None:
    """16:9 of a 4:3 sensor is the rows in its middle; upright images are of a camera turned."""
    camera = Lens(0.75, (0.01, -0.02), (0.1, 0.02, 0.0, 0.0, 0.0)).camera((4000, 3000))
    wide = reshaped(camera, (1280, 720))
    assert wide.size_px == (1280, 720) and wide.sigma_focal == 0.15
    px = np.array([[0.0, 1500.0], [3999.0, 900.0], [2100.0, 2000.0]])
    shown = 0.32 * (px + 0.5) - 0.5 - (0.0, 120.0)  # of 960 rows, 120 are cut off above
    assert np.allclose(rays(camera.K, px), rays(wide.K, shown))
    upright = reshaped(camera, (1500, 2000))
    assert upright.size_px == (1500, 2000) and upright.sigma_focal == camera.sigma_focal
    assert upright.K[1, 1] == pytest.approx(1500.0)
    source = images((1280, 720))
    source.is_reshaped = True
    model, notes = fitted(camera, source)
    assert np.array_equal(model.K, wide.K) and "that of 1280x720 is derived" in notes[0]


def upper_left(image: U8) -> bool:
    H, W = image.shape[:2]
    corners = image[[5, 5, H - 5, H - 5], [5, W - 5, 5, W - 5], 0]
    return bool(corners[0] > 200 and corners[1:].max() < 100)


@pytest.mark.parametrize(("orientation", "turn"), [(1, 0), (3, 2), (6, 1), (8, 3)])
def test_stills_come_with_their_upper_side_up(tmp_path: Path, orientation: int, turn: int) -> None:
    """Stored pixels turned the other way, so that the tag's turn makes them upright."""
    for i in range(2):
        stored = np.ascontiguousarray(np.rot90(marked((64, 48)), turn))
        exif = Image.Exif()
        exif[274] = orientation
        Image.fromarray(stored).save(tmp_path / f"{i}.jpg", exif=exif, quality=95)
    source = open_camera(str(tmp_path))
    frames = list(source)
    assert source.size_px == (64, 48) and len(frames) == 2
    assert all(frame.image.shape == (48, 64, 3) and upper_left(frame.image) for frame in frames)


def test_tags_that_disagree_leave_images_as_stored(tmp_path: Path) -> None:
    for i, orientation in enumerate((1, 6, 8, 6)):
        write_still(tmp_path / f"{i}.jpg", (64, 48), orientation=orientation)
    source = open_camera(str(tmp_path))
    assert all(upper_left(frame.image) for frame in source)
    assert any("different orientations" in warning for warning in source.warnings)


@pytest.mark.parametrize(("quarters", "orientation"), [(1, 6), (3, 8), (1, 1)])
def test_an_image_that_was_stored_on_its_side_is_turned_back(
    tmp_path: Path, quarters: int, orientation: int
) -> None:
    """By its tag; where a program removed that, one way, and its attitude with it."""
    angles = {"GimbalYawDegree": "30", "GimbalPitchDegree": "-60", "GimbalRollDegree": "0"}
    packet = xmp_of(angles).encode()
    for i in range(4):
        stored, exif = marked((64, 48)), Image.Exif()
        if i == 2:
            stored = np.ascontiguousarray(np.rot90(stored, quarters))
            exif[274] = orientation
        Image.fromarray(stored).save(tmp_path / f"{i}.jpg", exif=exif, xmp=packet, quality=95)
    source = open_camera(str(tmp_path))
    frames = list(source)
    assert source.size_px == (64, 48) and len(frames) == 4
    assert any("1 images are 48x64: turned to 64x48" in warning for warning in source.warnings)
    tags = [frame.geotag for frame in frames]
    rolls = [tag.ypr_deg[2] % 360 for tag in tags if tag and tag.ypr_deg]
    if orientation != 1:
        assert all(upper_left(frame.image) for frame in frames)
        assert rolls == [0.0] * 4
        return
    # What its upper left corner shows lies in the direction that attitude and image agree on.
    assert rolls == [0.0, 0.0, 90.0, 0.0]
    rig = Rig(CameraConfig(), ScanConfig(), FusionConfig())
    K = Lens(0.75).camera((48, 64)).K
    upright = rig.prior(None, frames[0].geotag).R_world_camera
    used = rig.prior(None, frames[2].geotag).R_world_camera
    stored_px = np.array([[5.0, 6.0]])
    at = np.zeros((64, 48), np.uint8)
    at[6, 5] = 1
    row, col = np.argwhere(np.rot90(at, -3))[0]
    K_used = Lens(0.75).camera((64, 48)).K
    ray = rays(K_used, np.array([[float(col), float(row)]]))
    assert upright is not None and used is not None
    assert np.allclose(rays(K, stored_px) @ upright.T, ray @ used.T)


def test_another_zoom_is_left_out(tmp_path: Path) -> None:
    for i, focal in enumerate((24, 24, 70, 24)):
        write_still(tmp_path / f"{i}.jpg", (64, 48), {41989: focal})
    source = open_camera(str(tmp_path))
    assert [frame.name for frame in source] == ["0.jpg", "1.jpg", "3.jpg"]
    assert any("focal length" in warning for warning in source.warnings)


def test_another_drones_images_of_the_same_size_are_a_scan_of_their_own(tmp_path: Path) -> None:
    for i, (focal, model) in enumerate(((24, "FC6310"), (28, "L1D 20c"), (24, "FC6310"))):
        exif = Image.Exif()
        exif.get_ifd(0x8769)[41989], exif[272] = focal, model
        Image.fromarray(marked((64, 48))).save(tmp_path / f"{i}.jpg", exif=exif)
    source = open_camera(str(tmp_path))
    assert [frame.name for frame in source] == ["0.jpg", "2.jpg"]
    asked = "images:DIR?camera=L1D 20c"
    assert any(asked in warning for warning in source.warnings)
    other = open_camera(asked.replace("DIR", str(tmp_path)))
    assert [frame.name for frame in other] == ["1.jpg"]


@pytest.mark.parametrize(
    ("focal_35mm", "fx_px", "of"),
    [
        (None, 960 / math.tan(math.radians(35.0)), "70 degrees"),
        (48.0, 48 * 1.25 / 43.2666 * 1920, "48 mm"),
    ],
)
def test_a_video_without_a_model_has_the_lens_of_its_telemetry(
    focal_35mm: float | None, fx_px: float, of: str
) -> None:
    log = TelemetryLog(VehicleHistory(), "video", 0, 1, (), {}, focal_35mm)
    start = start_lens(images((1920, 1080)), log)
    assert start.camera.K[0, 0] == pytest.approx(fx_px, rel=1e-4)
    assert start.camera.K[:2, 2] == pytest.approx((959.5, 539.5))
    assert not start.camera.distortion.any() and start.assumed == ("lens",) and of in start.note
    assert 3.0 * start.search.sigma_focal > 0.05 and 3.0 * start.search.sigma_k > 0.5


def test_a_video_is_turned_as_it_asks_players_to(tmp_path: Path) -> None:
    path = tmp_path / "portrait.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=5)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stored = np.ascontiguousarray(np.rot90(marked((48, 64))))
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(stored, "bgr24")))
        container.mux(stream.encode())
    data = bytearray(path.read_bytes())
    unit = b"".join(n.to_bytes(4, "big") for n in (1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30))
    quarter = b"".join(
        n.to_bytes(4, "big", signed=True) for n in (0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30)
    )
    at = data.index(unit, data.index(b"tkhd"))
    data[at : at + len(unit)] = quarter  # ISO 14496-12, 8.3.2: a quarter turn clockwise
    path.write_bytes(data)
    source = open_camera(str(path))
    assert source.size_px == (48, 64)
    assert all(upper_left(frame.image) for frame in source)


@pytest.mark.slow
def test_replay_takes_the_lens_of_the_tags(tmp_path: Path) -> None:
    for i in range(3):
        write_still(tmp_path / f"{i}.jpg", (320, 240), {41989: 35})
    out = tmp_path / "scan"
    done = CliRunner().invoke(
        app, ["replay", str(tmp_path), "--out", str(out), "--backend", "cpu", "--json"]
    )
    assert done.exit_code == 0, done.output
    scan = json.loads((out / "scan.json").read_text())
    K: F64 = np.array(scan["camera"]["K"]).reshape(3, 3)
    assert K[0, 0] == pytest.approx(35 / 43.2666 * 400.0, rel=1e-3)
    assert any("35 mm equivalent" in note for note in scan["notes"])


@pytest.mark.skipif(not (SHARED / "copr_kap_gcp").is_dir(), reason="copr_kap_gcp is not here")
def test_a_real_kite_camera_tells_its_lens() -> None:
    lens = read_tags(next((SHARED / "copr_kap_gcp" / "images").glob("*.jpg"))).lens
    assert lens is not None
    assert lens.camera((1600, 1067)).K[0, 0] == pytest.approx(2152.0, rel=2e-3)


def test_a_field_of_view_gives_the_lens_of_any_shape() -> None:
    for size_px in ((640, 360), (360, 640)):
        K = by_view(60.0, size_px).camera(size_px).K
        assert math.degrees(2.0 * math.atan(0.5 * size_px[0] / K[0, 0])) == pytest.approx(60.0)
