"""Camera models on disk: YAML as written by ROS's ``camera_info_manager`` and ``calibrate``.

Keys: ``image_width``, ``image_height``, ``camera_matrix.data`` (9, row by row),
``distortion_model: plumb_bob``, ``distortion_coefficients.data`` (k1 k2 p1 p2 k3), of a
rolling shutter ``readout_ms`` and ``readout_direction``, and ``sigma_focal`` of the focal length,
as a share. Other keys of the format are allowed and not read. OpenCV's own calibration writes the
same keys but the model, of five coefficients in its order; a fisheye has four.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import yaml
from msgspec import Meta

from recon.camera_model import check_camera
from recon.types import DIRECTIONS, F64, Camera, Shutter
from service.config import CameraConfig
from service.errors import InputError, OutsideError
from service.small_file import read_small

MODEL = "plumb_bob"
LARGEST_FILE_BYTES = 1 << 20
LONGEST_READOUT_MS = 200.0

Pixels = Annotated[int, Meta(gt=0, le=100_000)]


OPENCV_HEAD = "%YAML:1.0"
"""Which is no YAML; OpenCV 5 writes another one."""

OPENCV_MATRIX = "!!opencv-matrix"


class _Loader(yaml.SafeLoader):
    """Reads OpenCV's matrices as what they are: mappings."""

    def flatten_mapping(self, node: Any) -> None:
        """Merge nothing: a few lines of merges would take all memory."""

    def matrix(self, node: Any) -> dict[Any, Any]:
        return self.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _Loader.matrix)


class _Matrix(msgspec.Struct):
    data: Annotated[list[float], Meta(min_length=9, max_length=9)]


class _Coefficients(msgspec.Struct):
    data: Annotated[list[float], Meta(min_length=5, max_length=5)]


class _CameraInfo(msgspec.Struct):
    """The keys that are read; :func:`shutter_of` checks those of the shutter."""

    image_width: Pixels
    image_height: Pixels
    camera_matrix: _Matrix
    distortion_model: str
    distortion_coefficients: _Coefficients
    readout_ms: Any = 0
    readout_direction: Any = None
    sigma_focal: Annotated[float, Meta(ge=0.0, lt=1.0)] = 0.0


def load_camera(path: str | Path) -> Camera:
    """The camera of a camera_info YAML file; InputError, in one line, when it is unusable."""
    path = Path(path)
    document = _read(path)
    if document.get("distortion_model", MODEL) != MODEL:
        raise InputError(
            f"camera model {path}: distortion_model is {document['distortion_model']!r}, "
            f"only {MODEL!r} is supported; calibrate again with `skyrelief calibrate`"
        )
    try:
        info = msgspec.convert(document, _CameraInfo)
    except msgspec.ValidationError as error:
        raise InputError(f"camera model {path}: {error}; expected ROS camera_info YAML") from error
    K = np.array(info.camera_matrix.data).reshape(3, 3)
    distortion = np.array(info.distortion_coefficients.data)
    size = info.image_width, info.image_height
    try:
        shutter = shutter_of(info.readout_ms, info.readout_direction or "down")
        camera = Camera(K, distortion, size, shutter, info.sigma_focal)
        if not np.allclose(K[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], [0, 0, 0, 0, 1], 0.0, 1e-9):
            raise ValueError("camera_matrix is not of the form [fx 0 cx; 0 fy cy; 0 0 1]")
        check_camera(camera)
    except ValueError as error:
        raise InputError(f"camera model {path}: {error}; calibrate again") from error
    return camera


def shutter_of(readout_ms: object, direction: object) -> Shutter:
    """The shutter of a camera file's or the configuration's words; ValueError for others."""
    if isinstance(readout_ms, bool) or not isinstance(readout_ms, (int, float)):
        raise ValueError(f"readout_ms {readout_ms!r} is not a number of milliseconds")
    if not 0 <= readout_ms <= LONGEST_READOUT_MS:
        raise ValueError(f"readout_ms {readout_ms:g} is not within 0 to {LONGEST_READOUT_MS:g}")
    if direction not in DIRECTIONS:
        raise ValueError(f"readout_direction {direction!r} is not one of {', '.join(DIRECTIONS)}")
    return Shutter(1e-3 * readout_ms, str(direction))


def shutter_document(shutter: Shutter) -> dict[str, Any]:
    """Keys that :func:`shutter_of` reads; empty for a global shutter."""
    if not shutter.readout_s:
        return {}
    return {"readout_ms": 1e3 * shutter.readout_s, "readout_direction": shutter.direction}


def with_shutter(camera: Camera, config: CameraConfig) -> Camera:
    """The camera with the configured shutter, by default its own."""
    if isinstance(config.readout_ms, str):
        return camera
    return replace(camera, shutter=shutter_of(config.readout_ms, config.readout_direction))


def seeks_readout(camera: Camera, config: CameraConfig) -> bool:
    """True where the readout is to be found in flight."""
    is_unknown = config.readout_ms == "model" and not camera.shutter.readout_s
    return config.readout_ms == "auto" or is_unknown


def save_camera(
    path: str | Path, camera: Camera, name: str = "camera", extra: Mapping[str, Any] | None = None
) -> None:
    """Write ``camera`` as camera_info YAML; ``extra`` keys (plain values) go after the model.

    Raises ValueError for an unusable camera or an extra key that the format already has, and
    OutsideError when the file cannot be written.
    """
    check_camera(camera)
    K = np.asarray(camera.K, dtype=np.float64)
    document: dict[str, Any] = {
        "image_width": int(camera.size_px[0]),
        "image_height": int(camera.size_px[1]),
        "camera_name": name,
        "camera_matrix": _matrix(K),
        "distortion_model": MODEL,
        "distortion_coefficients": _matrix(np.asarray(camera.distortion).reshape(1, 5)),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(np.hstack([K, np.zeros((3, 1))])),
    }
    document |= shutter_document(camera.shutter)
    if camera.sigma_focal:
        document["sigma_focal"] = round(camera.sigma_focal, 6)
    clash = sorted(set(document) & set(extra or {}))
    if clash:
        raise ValueError(f"extra keys of the camera model already exist: {', '.join(clash)}")
    document.update(extra or {})
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=100)
    try:
        Path(path).write_text(text, encoding="utf-8")
    except OSError as error:
        raise OutsideError(f"camera model {path} cannot be written: {error.strerror}") from error


def _read(path: Path) -> dict[str, Any]:
    try:
        text = read_small(path, LARGEST_FILE_BYTES, "camera_info YAML file").decode("utf-8")
        document = yaml.load(text.removeprefix(OPENCV_HEAD), _Loader)
    except InputError as error:
        raise InputError(f"camera model {error}") from error
    except (yaml.YAMLError, UnicodeDecodeError, ValueError, RecursionError) as error:
        raise InputError(f"camera model {path}: not a YAML file ({_one_line(error)})") from error
    if not isinstance(document, dict):
        raise InputError(f"camera model {path}: not a camera_info YAML file (no keys at its top)")
    return {"distortion_model": MODEL, **document} if OPENCV_MATRIX in text else document


def _one_line(error: Exception) -> str:
    """The text of ``error`` on one line, shortened."""
    mark = getattr(error, "problem_mark", None)
    if mark is not None:
        return f"line {mark.line + 1}: {getattr(error, 'problem', None) or 'syntax error'}"
    return " ".join(str(error).split())[:120]


def _matrix(M: F64) -> dict[str, Any]:
    rows, cols = M.shape
    return {"rows": rows, "cols": cols, "data": [float(value) for value in M.ravel()]}
