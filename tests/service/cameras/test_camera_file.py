"""Camera model files: round trip, OpenCV as an independent reader, and every kind of bad file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from recon.types import Camera, Shutter
from service.cameras.camera_file import load_camera, save_camera, seeks_readout, with_shutter
from service.config import CameraConfig
from service.errors import InputError, OutsideError

CAMERA = Camera(
    np.array([[560.25, 0.0, 651.125], [0.0, 561.5, 499.0], [0.0, 0.0, 1.0]]),
    np.array([-0.2327, 0.0616, 1e-17, 0.0001, -0.0072]),
    (1280, 960),
)

TYPICAL = """\
image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [438.0, 0, 305.5, 0, 437.0, 243.7, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.361976, 0.110510, 0.001014, 0.000505, 0.000000]
"""


def document() -> dict[str, Any]:
    loaded = yaml.safe_load(TYPICAL)
    assert isinstance(loaded, dict)
    return loaded


def test_round_trip_is_exact(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    known = replace(CAMERA, sigma_focal=0.012)
    save_camera(path, known, "gopro", {"calibration": {"rms_px": 0.59}})
    back = load_camera(path)
    assert back.sigma_focal == 0.012
    np.testing.assert_array_equal(back.K, CAMERA.K)
    np.testing.assert_array_equal(back.distortion, CAMERA.distortion)
    assert back.size_px == CAMERA.size_px


def test_yaml_written_by_ros_is_read(tmp_path: Path) -> None:
    path = tmp_path / "ros.yaml"
    path.write_text(TYPICAL)
    camera = load_camera(path)
    assert camera.size_px == (640, 480)
    assert camera.K.ravel().tolist() == [438, 0, 305.5, 0, 437, 243.7, 0, 0, 1]
    assert camera.distortion.tolist() == [-0.361976, 0.110510, 0.001014, 0.000505, 0]


OPENCV = """%YAML:1.0
---
image_width: 640
image_height: 480
flags: 2
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5.36e+02, 0., 3.42e+02, 0., 5.36e+02, 2.36e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -2.66e-01, -3.9e-02, 1.8e-03, -2.8e-04, 2.4e-01 ]
avg_reprojection_error: 3.9e-01
"""


@pytest.mark.parametrize("head", ["%YAML:1.0", "%YAML 1.2"])
def test_what_opencv_writes_is_read(tmp_path: Path, head: str) -> None:
    """As its calibration example does; the four coefficients of a fisheye are another model."""
    path = tmp_path / "camera.yml"
    path.write_text(OPENCV.replace("%YAML:1.0", head))
    camera = load_camera(path)
    assert camera.size_px == (640, 480) and camera.K[1].tolist() == [0.0, 536.0, 236.0]
    assert camera.distortion.tolist() == [-0.266, -0.039, 0.0018, -0.00028, 0.24]
    path.write_text(OPENCV.replace(", 2.4e-01", ""))
    with pytest.raises(InputError, match="length >= 5"):
        load_camera(path)


def test_written_file_has_the_ros_form(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    save_camera(path, CAMERA)
    text = path.read_text()
    raw = yaml.safe_load(text)
    assert raw["distortion_model"] == "plumb_bob"
    assert raw["camera_matrix"]["rows"] == 3 and raw["projection_matrix"]["cols"] == 4
    # An independent YAML reader, of the matrices as nested maps.
    storage = cv2.FileStorage(
        "%YAML:1.0\n---\n" + text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY
    )
    data = storage.getNode("camera_matrix").getNode("data")
    assert [data.at(i).real() for i in range(9)] == list(CAMERA.K.ravel())


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "negative focal length": (
        {"camera_matrix": {"data": [-438, 0, 305, 0, 437, 243, 0, 0, 1]}},
        "positive",
    ),
    "nan": ({"camera_matrix": {"data": [float("nan"), 0, 305, 0, 437, 243, 0, 0, 1]}}, "finite"),
    "infinity": ({"distortion_coefficients": {"data": [float("inf"), 0, 0, 0, 0]}}, "finite"),
    "text in numbers": ({"distortion_coefficients": {"data": ["a", 0, 0, 0, 0]}}, "got `str`"),
    "short matrix": ({"camera_matrix": {"data": [438, 0, 305]}}, "length >= 9"),
    "four coefficients": ({"distortion_coefficients": {"data": [0, 0, 0, 0]}}, "length >= 5"),
    "matrix is a list": ({"camera_matrix": [1, 2]}, "camera_matrix"),
    "a number too large": ({"camera_matrix": {"data": [10**400] * 9}}, "out of range"),
    "negative sigma": ({"sigma_focal": -0.01}, "sigma_focal"),
    "sigma nan": ({"sigma_focal": float("nan")}, "sigma_focal"),
    "fisheye": ({"distortion_model": "equidistant"}, "equidistant"),
    "skew": ({"camera_matrix": {"data": [438, 9, 305, 0, 437, 243, 0, 0, 1]}}, "form"),
    "width of zero": ({"image_width": 0}, "image_width"),
    "width in words": ({"image_width": "wide"}, "image_width"),
    "principal point outside": (
        {"camera_matrix": {"data": [438, 0, 9305, 0, 437, 243, 0, 0, 1]}},
        "principal point",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_nonsense_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    changes, word = BAD[name]
    path = tmp_path / "bad.yaml"
    path.write_text(yaml.safe_dump(document() | changes))
    with pytest.raises(InputError, match=word) as caught:
        load_camera(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


@pytest.mark.parametrize("key", ["image_width", "camera_matrix", "distortion_model"])
def test_missing_key_is_named(key: str, tmp_path: Path) -> None:
    raw = document()
    del raw[key]
    path = tmp_path / "bad.yaml"
    path.write_text(yaml.safe_dump(raw))
    with pytest.raises(InputError, match=f"missing required field `{key}`"):
        load_camera(path)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x00\x01\xff\xfe",
        b"{a: [1, 2",
        b"- 1\n- 2\n",
        b"just words",
        b"[" * 1100,
        b"%YAML:1.0\na: !!opencv-matrix 1\n",
        b"%YAML:1.0\nM1: !!opencv-matrix\n   rows: 3\n",
        OPENCV.encode() + b"a: &a {x: 1}\nb: {<<: [*a, *a]}\n",
    ],
    ids=["empty", "bytes", "broken", "list", "words", "deep", "no matrix", "stereo", "merge"],
)
def test_not_a_camera_file(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        load_camera(path)
    assert "\n" not in str(caught.value)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        load_camera(tmp_path / "none.yaml")
    with pytest.raises(InputError, match="cannot be read"):
        load_camera(tmp_path)


def test_save_checks_what_it_writes(tmp_path: Path) -> None:
    bad = Camera(CAMERA.K * -1.0, CAMERA.distortion, CAMERA.size_px)
    with pytest.raises(ValueError, match="positive"):
        save_camera(tmp_path / "c.yaml", bad)
    with pytest.raises(ValueError, match="image_width"):
        save_camera(tmp_path / "c.yaml", CAMERA, extra={"image_width": 3})
    with pytest.raises(OutsideError, match="cannot be written"):
        save_camera(tmp_path / "no" / "folder" / "c.yaml", CAMERA)


def test_a_rolling_shutter_round_trips(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    save_camera(path, replace(CAMERA, shutter=Shutter(0.0213, "left")))
    back = load_camera(path).shutter
    assert back.readout_s == pytest.approx(0.0213) and back.direction == "left"
    save_camera(path, CAMERA)
    assert "readout" not in path.read_text() and load_camera(path).shutter == Shutter()


@pytest.mark.parametrize(
    ("key", "value"),
    [("readout_ms", -1), ("readout_ms", 201), ("readout_ms", "fast"), ("readout_ms", True),
     ("readout_direction", "sideways")],
)  # fmt: skip
def test_an_impossible_shutter_is_refused(tmp_path: Path, key: str, value: object) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(yaml.safe_dump(document() | {key: value}))
    with pytest.raises(InputError, match=key):
        load_camera(path)


def test_the_configuration_overrules_the_camera_file() -> None:
    rolling = replace(CAMERA, shutter=Shutter(0.02, "up"))
    assert with_shutter(rolling, CameraConfig()).shutter == Shutter(0.02, "up")
    assert with_shutter(rolling, CameraConfig(readout_ms=0)).shutter.readout_s == 0
    chosen = CameraConfig(readout_ms=33.0, readout_direction="right")
    assert with_shutter(rolling, chosen).shutter == Shutter(0.033, "right")
    with pytest.raises(ValueError, match=r"camera\.readout_ms"):
        CameraConfig(readout_ms=300.0)


def test_a_readout_that_nobody_states_is_sought() -> None:
    rolling = replace(CAMERA, shutter=Shutter(0.02, "up"))
    sought = [
        seeks_readout(camera, CameraConfig(readout_ms=asked))
        for camera in (CAMERA, rolling)
        for asked in ("model", "auto", 0.0, 20.0)
    ]
    assert sought == [True, True, False, False, False, True, False, False]
