"""The lens from a still's own tags: the maker's calibration, otherwise the focal length.

EXIF 2.32 (CIPA DC-008-2019) sections 4.6.5 (focal plane resolution) and G (35 mm equivalent, by
the diagonal); XMP names as DJI, Pix4D and Parrot write them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from recon.camera_model import check_camera, scaled, scaled_K
from recon.types import Camera
from service.errors import InputError

if TYPE_CHECKING:
    from service.cameras.source import CameraSource

DIAGONAL_35MM = 43.2666
MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
MAX_CROP_ONE_INCH = 3.2  # above this crop factor a sensor is smaller than one inch (2.7)

MIN_FOCAL, MAX_FOCAL = 0.2, 20.0
"""Focal length over the longer side of the image; a tag outside this range is wrong, and
with a view so narrow vision cannot tell a turn of the camera from its distance."""

SAME_SHAPE = 0.005  # relative tolerance of aspect ratios: sizes are whole pixels

SIGMA_FOCAL = 0.05
"""Relative sigma of a focal length in tags: it is that of the lens's model, rounded, and of images
before the camera straightens and crops them (docs/reports/lens.md)."""

SIGMA_K1 = 0.02
"""Sigma of a lens's first radial coefficient where tags give its focal length alone: what is left
in stills that drones straighten themselves."""

SIGMA_OTHER_SHAPE = 0.15
"""Relative sigma of a focal length where a camera goes over to another shape: 16:9 has the rows in
the middle of 4:3, but a program that cuts 4:3 out of 16:9 takes its columns, a third fewer."""

CALIBRATED, FOCAL_ALONE = "the maker's calibration", "the maker's focal length"
AGREEMENT = 0.1
"""A focal length that differs more from the 35 mm equivalent belongs to another size of the image:
programs that shrink images keep such tags unchanged."""


LONGEST_MM = 200.0
"""A longer focal length is one in pixels: of a telephoto lens no drone carries, or 200 px, which
would be a view of half the sphere."""


@dataclass(frozen=True, slots=True)
class Lens:
    """A pinhole camera with distortion, in units of the longer side of the image."""

    focal: float
    principal: tuple[float, float] = (0.0, 0.0)  # offset from the image centre
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    source: str = ""  # CALIBRATED, "the focal length in EXIF", ...
    sigma_focal: float = SIGMA_FOCAL  # as a share

    @property
    def is_calibrated(self) -> bool:
        return self.source == CALIBRATED

    def camera(self, size_px: tuple[int, int]) -> Camera:
        """The camera for images of ``size_px`` (W, H) that are not cropped."""
        side = max(size_px)
        f = self.focal * side
        cx, cy = ((n - 1) / 2 + c * side for n, c in zip(size_px, self.principal, strict=True))
        K = np.array([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]])
        return Camera(K, np.array(self.distortion), size_px)


CLOCKWISE = {"down": "left", "left": "up", "up": "right", "right": "down"}
"""Where the rows of an image are read to once it is rotated clockwise by a quarter."""


def turned(camera: Camera, clockwise_deg: int) -> Camera:
    """The camera of its image rotated clockwise by 0, 90, 180 or 270 degrees."""
    for _ in range(clockwise_deg // 90 % 4):
        (W, H), K = camera.size_px, camera.K
        k1, k2, p1, p2, k3 = camera.distortion
        quarter = [[K[1, 1], 0.0, H - 1 - K[1, 2]], [0.0, K[0, 0], K[0, 2]], [0.0, 0.0, 1.0]]
        bent = np.array([k1, k2, p2, -p1, k3])
        shutter = replace(camera.shutter, direction=CLOCKWISE[camera.shutter.direction])
        camera = replace(
            camera, K=np.array(quarter), distortion=bent, size_px=(H, W), shutter=shutter
        )
    return camera


def same_shape(a_px: tuple[int, int], b_px: tuple[int, int]) -> bool:
    """True for two sizes (W, H) of one aspect ratio."""
    return abs(a_px[0] / a_px[1] / (b_px[0] / b_px[1]) - 1.0) < SAME_SHAPE


def fitted(camera: Camera, source: CameraSource) -> tuple[Camera, list[str]]:
    """The camera model for a source's images, with a note if it is scaled to their size;
    InputError for another aspect ratio, unless the camera went over to it in flight.

    The model may be for the images as stored: some sources turn them when they are read.
    """
    size_px = source.size_px
    (w, h), (W, H) = camera.size_px, size_px
    for clockwise_deg in dict.fromkeys((source.turned_deg, 0)):
        model = turned(camera, clockwise_deg) if clockwise_deg else camera
        if model.size_px == size_px:
            return model, []
        if same_shape(model.size_px, size_px):
            note = f"the camera model is for {w}x{h} images: scaled to {W}x{H}"
            return scaled(model, size_px), [note]
    if source.is_reshaped:
        note = (
            f"the camera model is for {w}x{h} images: that of {W}x{H} is derived from it, as if "
            "both showed as much along their longer side; calibrate at that size"
        )
        return reshaped(camera, size_px), [note]
    raise InputError(
        f"the camera model is for {w}x{h} images, {source.description} has {W}x{H}; "
        "calibrate at that size"
    )


def reshaped(camera: Camera, size_px: tuple[int, int]) -> Camera:
    """The camera for images of another shape: as wide a view along the longer side, about the same
    centre; upright images of a camera that was turned by a quarter."""
    if (size_px[0] > size_px[1]) != (camera.size_px[0] > camera.size_px[1]):
        camera = turned(camera, 90)
    if same_shape(camera.size_px, size_px):
        return scaled(camera, size_px)
    ratio = max(size_px) / max(camera.size_px)
    K = scaled_K(camera.K, ratio, ratio)
    K[:2, 2] += 0.5 * (np.array(size_px) - ratio * np.array(camera.size_px))
    return replace(camera, K=K, size_px=size_px, sigma_focal=SIGMA_OTHER_SHAPE)


def check_width(camera: Camera, what: str) -> None:
    """Raise InputError for a view so narrow that what is made of it lies where it is not."""
    side = max(camera.size_px)
    if camera.K[0, 0] > MAX_FOCAL * side:
        view_deg = 2.0 * math.degrees(math.atan(0.5 * side / camera.K[0, 0]))
        raise InputError(
            f"{what}: the view is {view_deg:.1f} degrees wide; below 3 degrees the images cannot "
            "show how far the ground is apart from how the camera turns, so nothing is made of them"
        )


def lens_of(
    photo: Mapping[int, Any], xmp: Mapping[str, str], size_px: tuple[int, int]
) -> Lens | None:
    """The lens by a still's EXIF (``photo``) and XMP; None without lens tags. ``size_px`` (W, H) is
    the still's current size, which may be smaller than the original."""
    found = [
        _maker(photo, xmp, size_px),
        _pix4d(photo, xmp, size_px),
        _view(xmp, size_px),
        _focal(photo, size_px),
    ]
    sound = [lens for lens in found if lens is not None and _is_sound(lens, size_px)]
    coarse = _full_frame(photo, size_px)
    if coarse is None or not _is_sound(coarse, size_px):
        return sound[0] if sound else None
    near = [lens for lens in sound if abs(math.log(lens.focal / coarse.focal)) < AGREEMENT]
    return near[0] if near else coarse


def _is_sound(lens: Lens, size_px: tuple[int, int]) -> bool:
    if not MIN_FOCAL < lens.focal < MAX_FOCAL or max(map(abs, lens.principal)) > 0.2:
        return False
    try:
        check_camera(lens.camera(size_px))
    except ValueError:
        return False
    return True


def _maker(
    photo: Mapping[int, Any], xmp: Mapping[str, str], size_px: tuple[int, int]
) -> Lens | None:
    """DJI's calibration, or its focal length and centre alone: pixels of the full image."""
    side = _taken_side(photo, size_px)
    numbers = _numbers(xmp.get("DewarpData", "").partition(";")[2], 9)
    is_straight = xmp.get("DewarpFlag", "0").strip() == "1"
    if numbers is not None:
        fx, _, cx, cy, k1, k2, p1, p2, k3 = numbers
        bent = (0.0, 0.0, 0.0, 0.0, 0.0) if is_straight else (k1, k2, p1, p2, k3)
        return Lens(fx / side, (cx / side, cy / side), bent, CALIBRATED)
    focal = _number(xmp.get("CalibratedFocalLength"))
    if focal is None:
        return None
    W, H = (side * n / max(size_px) for n in size_px)
    x, y = (_number(xmp.get(f"CalibratedOpticalCenter{axis}")) for axis in "XY")
    middle = (0.0, 0.0) if x is None or y is None else ((x - W / 2) / side, (y - H / 2) / side)
    return Lens(focal / side, middle, source=FOCAL_ALONE)


def _pix4d(
    photo: Mapping[int, Any], xmp: Mapping[str, str], size_px: tuple[int, int]
) -> Lens | None:
    """Pix4D's names, as Parrot, senseFly and MicaSense write them: millimetres, a focal length of
    older RedEdges pixels."""
    focal = _number(xmp.get("PerspectiveFocalLength"))
    per_mm = _pixels_per_mm(photo)
    if focal is None or per_mm is None:
        return None
    if focal > LONGEST_MM:
        focal /= per_mm
    side = _taken_side(photo, size_px)
    W, H = (side * n / max(size_px) for n in size_px)
    point = _numbers(xmp.get("PrincipalPoint", ""), 2)
    middle = (0.0, 0.0)
    if point is not None:
        middle = ((point[0] * per_mm - W / 2) / side, (point[1] * per_mm - H / 2) / side)
    bent = _numbers(xmp.get("PerspectiveDistortion", ""), 5)
    if bent is None:
        return Lens(focal * per_mm / side, middle, source=FOCAL_ALONE)
    k1, k2, k3, p1, p2 = bent
    return Lens(focal * per_mm / side, middle, (k1, k2, p1, p2, k3), CALIBRATED)


def _view(xmp: Mapping[str, str], size_px: tuple[int, int]) -> Lens | None:
    """By the field of view, as Teal writes it."""
    view_deg = _number(xmp.get("CameraHorizontalFOV"))
    if view_deg is None or not 1.0 < view_deg < 180.0:
        return None
    return replace(by_view(view_deg, size_px), source="the field of view in XMP")


def _focal(photo: Mapping[int, Any], size_px: tuple[int, int]) -> Lens | None:
    focal, per_mm = _number(photo.get(37386)), _pixels_per_mm(photo)
    if focal is None or per_mm is None:
        return None
    return Lens(focal * per_mm / _taken_side(photo, size_px), source="the focal length in EXIF")


def _full_frame(photo: Mapping[int, Any], size_px: tuple[int, int]) -> Lens | None:
    focal = _number(photo.get(41989))
    if focal is None:
        return None
    lens = by_full_frame(focal, size_px, _sensor_aspect(focal, _number(photo.get(37386))))
    return replace(lens, source="the 35 mm equivalent in EXIF")


def by_full_frame(focal_mm: float, size_px: tuple[int, int], sensor_aspect: float = 4 / 3) -> Lens:
    """The lens of a 35 mm equivalent in whole mm, for images as wide as the sensor or narrower."""
    aspect = min(max(size_px) / min(size_px), sensor_aspect)
    share = math.hypot(1.0, 1.0 / aspect) / DIAGONAL_35MM
    rounded = 0.5 / math.sqrt(3.0) / focal_mm
    return Lens(focal_mm * share, sigma_focal=math.hypot(SIGMA_FOCAL, rounded))


def by_view(hfov_deg: float, size_px: tuple[int, int]) -> Lens:
    across = size_px[0] / max(size_px)
    return Lens(0.5 * across / math.tan(0.5 * math.radians(hfov_deg)))


def _sensor_aspect(full_frame_mm: float, focal_mm: float | None) -> float:
    """Width over height of the sensor.

    Cameras give the 35 mm equivalent of the whole sensor also with images that are wider, which
    are its middle rows: 16:9 of a 4:3 sensor by the image's own diagonal is 8 % too short.
    Sensors below one inch and of Four Thirds are 4:3, others 3:2.
    """
    crop = full_frame_mm / focal_mm if focal_mm is not None else 1.0
    return 4 / 3 if crop > MAX_CROP_ONE_INCH or 1.8 < crop < 2.2 else 3 / 2


def _taken_side(photo: Mapping[int, Any], size_px: tuple[int, int]) -> float:
    """Longer side in pixels of the original image."""
    taken = [_number(photo.get(tag)) or 0.0 for tag in (40962, 40963)]
    same_shape = (
        min(taken) > 0 and abs(max(taken) / min(taken) / (max(size_px) / min(size_px)) - 1.0) < 0.02
    )
    return max(taken) if same_shape else float(max(size_px))


def _pixels_per_mm(photo: Mapping[int, Any]) -> float | None:
    resolution = _number(photo.get(41486))
    unit = MM_PER_UNIT.get(int(_number(photo.get(41488)) or 2))
    return resolution / unit if resolution is not None and unit is not None else None


def _numbers(text: str, count: int) -> list[float] | None:
    return finite_numbers(re.split(r"[,\s]+", text.strip()), count)


def _number(value: Any) -> float | None:
    """A positive finite number of an EXIF rational or a text."""
    number = finite_number(value)
    return number if number is not None and number > 0 else None


def finite_numbers(values: Any, count: int) -> list[float] | None:
    """The ``count`` finite numbers of EXIF rationals or texts; None for anything else."""
    try:
        numbers = [n for value in values if (n := finite_number(value)) is not None]
        return numbers if len(numbers) == len(values) == count else None
    except TypeError:
        return None


def finite_number(value: Any) -> float | None:
    """The finite number of an EXIF rational or a text, "3/2" too; None for x/0 and the like."""
    try:
        above, _, below = value.partition("/") if isinstance(value, str) else (value, "", "")
        number = float(above) / float(below or 1.0)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None
