"""The records that the stages hand to each other.

Every record is frozen; arrays in it are shared, so treat them as read-only. Frames of
reference and the meaning of ``T_a_b`` are in :mod:`recon.frames`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]
F32 = npt.NDArray[np.float32]
I64 = npt.NDArray[np.int64]
U8 = npt.NDArray[np.uint8]
U16 = npt.NDArray[np.uint16]
I16 = npt.NDArray[np.int16]
I32 = npt.NDArray[np.int32]
Bool = npt.NDArray[np.bool_]
Array = npt.NDArray[Any]


DIRECTIONS = ("down", "up", "right", "left")  # ways in which a rolling shutter moves over the image

OPPOSITE = {"down": "up", "up": "down", "right": "left", "left": "right"}


@dataclass(frozen=True, slots=True)
class Shutter:
    """When the rows of an image are exposed; the time of an image is that of its middle row."""

    readout_s: float = 0.0  # from the first row to the last; 0: a global shutter
    direction: str = "down"  # of DIRECTIONS; right and left: columns take the part of rows

    @property
    def axis(self) -> int:
        """Coordinate of a pixel that tells its row: 0 where columns take their part, else 1."""
        return 0 if self.direction in ("right", "left") else 1

    @property
    def sign(self) -> float:
        """1 where that coordinate grows with time, else -1."""
        return -1.0 if self.direction in ("up", "left") else 1.0

    def reading(self, readout_s: float) -> Shutter:
        """The same rows read in another time; a negative one turns the direction round."""
        way = OPPOSITE[self.direction] if readout_s < 0.0 else self.direction
        return Shutter(abs(readout_s), way)


GLOBAL_SHUTTER = Shutter()


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A pinhole camera with Brown-Conrady distortion (``plumb_bob``: k1 k2 p1 p2 k3)."""

    K: F64  # (3, 3) px
    distortion: F64  # (5,) k1 k2 p1 p2 k3; zeros for an undistorted image
    size_px: tuple[int, int]  # (W, H)
    shutter: Shutter = GLOBAL_SHUTTER
    sigma_focal: float = 0.0  # of the focal length, as a share; 0: not stated


@dataclass(frozen=True, slots=True, eq=False)
class Travel:
    """A velocity integrated since the start of an unbroken run of readings."""

    metres: F64  # (3,) ENU
    seconds: float
    run: int  # travels of two runs cannot be compared


@dataclass(frozen=True, slots=True, eq=False)
class PosePrior:
    """The camera's pose by telemetry; a missing part is None."""

    R_world_camera: F64 | None = None  # (3, 3)
    sigma_tilt_rad: float = 0.02  # roll and pitch, 1 sigma
    sigma_yaw_rad: float = 0.1
    position_m: F64 | None = None  # (3,) ENU about the scan's origin
    sigma_position_m: F64 | None = None  # (3,) ENU, 1 sigma
    agl_m: float | None = None  # height of the camera above the ground below it
    sigma_agl_m: float = 5.0
    altitude_m: float | None = None  # world z up to a constant, as a barometer gives it
    sigma_altitude_m: float = 1.0
    fix_offset: F64 | None = None  # (3,) from the camera to where position_m was, in its frame, in
    # units of the odometry: the mean of several fixes lies off the track
    gnss_minus_baro_m: float | None = None  # altitude by the GNSS receiver alone less position_m's
    gnss_minus_baro_fixes: int = 0  # whose mean that is
    gnss_minus_baro_ns: int = 0  # time of the newest of them
    is_at_rest: bool = False  # the vehicle stands on the ground: its position repeats rightly
    is_agl_measured: bool = True  # False: above the take-off point, or assumed
    is_agl_assumed: bool = False
    velocity_m_s: F64 | None = None  # (3,) ENU, of the vehicle
    travel: Travel | None = None  # the velocity integrated up to this moment
    turn_rad_s: F64 | None = None  # (3,) angular velocity of the camera, in its own frame
    sigma_turn_rad_s: float = 0.02  # of each axis
    is_sigma_claimed: bool = True  # by the receiver; False: sigma_position_m is a typical one
    is_view_assumed: bool = False  # R_world_camera is the nominal mount on a level vehicle

    def place_of_fix(self, T_odom_camera: F64) -> F64:
        """(3,) where ``position_m`` was, in the odometry, by the camera's pose (4, 4) in it."""
        R, place = T_odom_camera[:3, :3], T_odom_camera[:3, 3]
        return place if self.fix_offset is None else np.asarray(R @ self.fix_offset + place)


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """A camera pose with its uncertainty and its sources."""

    T_world_camera: F64  # (4, 4) m
    covariance: F64  # (6, 6) left perturbation in the world frame: rotation rad, translation m
    sources: tuple[str, ...] = ()  # of "vision", "attitude", "altitude", "gnss"
    scale: float = 1.0  # metres per unit of the odometry: multiplies depths
    is_aligned: bool = True  # False: the scale and heading of its segment are unknown yet


@dataclass(frozen=True, slots=True, eq=False)
class StereoPair:
    """Two frames rectified as left and right views of a virtual stereo camera.

    A left pixel (u, v) with label ``l`` (0 <= l < labels, real valued) has its partner at
    ``right[v, u - l]``. The true disparity ``d`` (of the two pinhole views, before the right
    image was shifted onto the ground plane) is ``d(u, v) = plane . (u, v, 1) + slope * l``,
    and the depth along the rectified left camera's z is ``K[0, 0] * baseline_m / d``.
    """

    left: U8  # (h, w) gray, rectified
    right: U8  # (h, w) gray, rectified, shifted by the disparity plane
    baseline_m: float
    K: F64  # (3, 3) px of the rectified left view at (w, h)
    labels: int
    plane: F64  # (3,) disparity of label 0 as an affine function of the left pixel
    slope: float  # d(disparity) / d(label)
    R_left_keyframe: F64  # (3, 3) keyframe camera to rectified left camera
    guide: U8 | None = None  # (H, W, 3) rectified left in colour, as fine as (h, w) or finer
    left_seen: Bool | None = None  # (h, w) False where the left image has nothing
    right_seen: Bool | None = None  # (h, w) the same of the shifted right image
    noise: float = 1.0  # sigma of a label over the usual one, by motion blur


@dataclass(frozen=True, slots=True, eq=False)
class PolarPair:
    """Two frames flown along the line of sight, in polar coordinates about the baseline.

    Column u of the left view lies ``a = first_rad - u / px_per_rad`` away from the direction to
    the right camera, row v at ``first_row_rad + v / rows_per_rad`` about it, in axes whose z is
    that direction. A left pixel with label ``l`` has its partner at ``right[v, u - l]``: the
    right camera sees the point as it sees the plane at ``a + (first_label + l) / px_per_rad``.
    """

    left: U8  # (h, w) gray
    right: U8  # (h, w) gray, shifted by the plane
    baseline_m: float
    labels: int
    px_per_rad: float
    rows_per_rad: float
    first_rad: float
    first_row_rad: float
    plane: F64  # (3,) n with n . X = 1 on the ground, in the polar axes of the left camera, 1/m
    first_label: float  # columns from the plane to label 0
    relief: tuple[float, float]  # of what is accepted: shares of the distance nearer than the plane
    R_left_keyframe: F64  # (3, 3) keyframe camera to polar axes
    guide: U8 | None = None  # (H, W, 3) left in colour, as fine as (h, w) or finer
    left_seen: Bool | None = None  # (h, w) False where the left view has nothing
    right_seen: Bool | None = None  # (h, w) the same of the shifted right view
    noise: float = 1.0  # sigma of a label over the usual one, by motion blur


RectifiedPair = StereoPair | PolarPair


@dataclass(frozen=True, slots=True, eq=False)
class DisparityMap:
    """Disparity of the left view, in pixels of its own grid; NaN where unknown."""

    px: F32  # (h, w), NaN = unknown
    confidence: F32  # (h, w), 0 to 1


@dataclass(frozen=True, slots=True, eq=False)
class DepthMap:
    """Depth along the camera's z with one sigma per pixel; NaN where unknown.

    Before the pose graph has placed it, its world is the odometry's, in the odometry's units.
    """

    depth_m: F32  # (h, w), NaN = unknown
    sigma_m: F32  # (h, w), NaN where depth is
    views: U8  # (h, w) how many stereo pairs agree; 0 where depth is NaN
    K: F64  # (3, 3) px of this grid, no distortion
    T_world_camera: F64  # (4, 4)

    def scaled(self, factor: float, T_world_camera: F64) -> DepthMap:
        """The depth ``factor`` times as far, seen from that pose."""
        times = np.float32(factor)
        return replace(
            self, depth_m=self.depth_m * times, sigma_m=self.sigma_m * times,
            T_world_camera=T_world_camera,
        )  # fmt: skip

    def every(self, step: int) -> DepthMap:
        """Every so many pixels of it, along both axes from the first: each keeps its place."""
        some = np.s_[::step, ::step]
        return replace(
            self, depth_m=self.depth_m[some], sigma_m=self.sigma_m[some], views=self.views[some],
            K=self.K / np.array([[step], [step], [1.0]]),
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A posed depth image in colour: the unit of the map and of the datalink."""

    seq: int
    time_ns: int
    depth: DepthMap
    bgr: U8  # (h, w, 3) of the same grid as the depth
    pose: Pose
    fresh: Bool  # (h, w) surface that is new or better than what was kept before


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """Points with colour and uncertainty."""

    xyz_m: F32  # (N, 3) world
    rgb: U8  # (N, 3)
    sigma_m: F32  # (N,)
    views: U8  # (N,)
    time_ns: I64 | None = None  # (N,) unix time of the image that knows each point best

    def __len__(self) -> int:
        return int(self.xyz_m.shape[0])


class Verdict(str, Enum):
    """How far a registration may be used."""

    CONVERGED = "converged"
    DEGENERATE = "degenerate"  # some directions are not observed
    REJECTED = "rejected"


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """The outcome of aligning a source cloud onto a target cloud."""

    T_target_source: F64  # (4, 4)
    covariance: F64  # (6, 6) left perturbation in the target frame: rotation rad, translation m
    verdict: Verdict
    rms_m: float  # point-to-plane, inliers
    inlier_share: float  # of the source's valid points
    iterations: int = 0

    @property
    def converged(self) -> bool:
        """True when the alignment may be used, at least in its strong directions."""
        return self.verdict is not Verdict.REJECTED
