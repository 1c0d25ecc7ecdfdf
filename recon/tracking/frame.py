"""A frame on its way through tracking and stereo, and the landmarks that it shows."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from recon import se3
from recon.rolling_shutter import GLOBAL_SHUTTER, FrameRows
from recon.tracking.matching import Pyramid
from recon.tracking.sift_features import Features
from recon.types import F64, I64, U8, Bool, PosePrior

NO_IMAGE: U8 = np.zeros((0, 0), np.uint8)
NOWHERE, NO_SPREAD = np.full((4, 4), np.nan), np.zeros((6, 6))
UNKNOWN = PosePrior()


TWO_ONLY = "seen by two views only"  # reason why a view is refused: nothing confirms its one pair

CONTRADICTED = "pairs contradict each other"
"""Another: its pairs, or those of most views before it, do not agree on a surface."""


class Tracking(str, Enum):
    STARTED = "started"  # first of a segment
    WAITING = "waiting"  # the camera has not moved enough for a second view
    TRACKED = "tracked"
    KEYFRAME = "keyframe"
    SKIPPED = "skipped"  # too close to the last one
    LOST = "lost"


class Landmarks:
    """Points (x, y, z) of one segment by number; a dropped point is NaN. Numbers only grow;
    :meth:`forget_before` frees those that no keyframe refers to."""

    def __init__(self) -> None:
        self._xyz = np.zeros((0, 3))
        self._first = 0

    def add(self, points: F64) -> I64:
        """Enter points (N, 3); returns their (N,) numbers."""
        end = self._first + len(self._xyz)
        self._xyz = np.vstack([self._xyz, points])
        return np.arange(end, end + len(points), dtype=np.int64)

    def __getitem__(self, numbers: I64) -> F64:
        """(N, 3) points of the (N,) numbers."""
        return np.asarray(self._xyz[numbers - self._first])

    def __setitem__(self, numbers: I64, points: F64 | float) -> None:
        self._xyz[numbers - self._first] = points

    def known(self, numbers: I64) -> Bool:
        """(N,) True for numbers (-1: none) whose point is held and not dropped."""
        held = numbers >= self._first
        out = np.zeros(len(numbers), np.bool_)
        out[held] = np.isfinite(self._xyz[numbers[held] - self._first, 0])
        return out

    def scale_about(self, origin: F64, factor: float) -> None:
        """Stretch all points away from ``origin`` (3,) by ``factor``."""
        self._xyz = origin + (self._xyz - origin) * factor

    def forget_before(self, number: int) -> None:
        gone = min(max(number - self._first, 0), len(self._xyz))
        self._xyz = self._xyz[gone:].copy()
        self._first += gone


@dataclass(slots=True, eq=False)
class Frame:
    """One image of the camera, with what is known of it by now.

    The caller gives the image, its time and number, and telemetry; :class:`Undistort` the images
    without distortion; the odometry the rest. A frame with a pose may take part in stereo, as a
    view or as a view's partner. Its pose follows that of its reference keyframe, the odometry's
    last one then: a frame whose corners have landmarks, and which is adjusted for a while. Images
    that are no longer needed are :data:`NO_IMAGE`.
    """

    image: U8  # (H, W, 3) BGR with distortion
    time_ns: int  # mid-exposure; companion monotonic live, unix nanoseconds in a replay
    seq: int
    prior: PosePrior = UNKNOWN
    gray: U8 = field(default_factory=lambda: NO_IMAGE)  # (H, W) without distortion
    pyramid: Pyramid = ()  # of (h, w) gray, as the odometry takes it
    features: dict[int, Features] = field(default_factory=dict)  # found so far, by their width
    mask: U8 | None = None  # (h, w) non-zero where the image is valid; None: everywhere
    is_blurred: bool = False  # takes no part in stereo, only in the track
    state: Tracking = Tracking.SKIPPED
    segment: int = -1
    T_keyframe_camera: F64 | None = None  # (4, 4) relative to the ``reference``, else T_odom_camera
    reference: Frame | None = None  # None: once it no longer changes, or without a pose
    tracks: int = 0  # corners found
    reason: str = ""  # why it has no pose
    row_motion: FrameRows = GLOBAL_SHUTTER  # better once its neighbours are known
    image_rad_s: F64 | None = None  # (2,) motion of the image's middle; None for stills
    # Of a keyframe, which has no relative pose: its own, refined while it is in the window.
    T_camera_odom: F64 = field(default_factory=lambda: NOWHERE)
    # (6, 6) of the motion from the keyframe before, left of T_camera_before.
    covariance: F64 = field(default_factory=lambda: NO_SPREAD)
    uv: F64 = field(default_factory=lambda: np.zeros((0, 2)))  # (N, 2) corners, as their rows saw
    # (N,) the corners' numbers in ``landmarks``, which are of the segment; -1: none yet.
    landmark: I64 = field(default_factory=lambda: np.zeros(0, np.int64))
    landmarks: Landmarks = field(default_factory=Landmarks)

    @property
    def small(self) -> U8:
        """(h, w) gray, as the odometry takes it."""
        return self.pyramid[0]

    @property
    def is_placed(self) -> bool:
        """True for a frame with a pose in its segment's odometry."""
        return self.T_keyframe_camera is not None

    @property
    def reference_keyframe(self) -> Frame:
        """The keyframe of the odometry, a frame too, that this frame's pose is relative to."""
        assert self.reference is not None, "a frame of stereo is tracked, and not settled"
        return self.reference

    @property
    def T_odom_camera(self) -> F64:
        """(4, 4) as refined by now."""
        T = self.T_keyframe_camera
        if T is not None:
            return T if self.reference is None else np.asarray(self.reference.T_odom_camera @ T)
        assert self.T_camera_odom[3, 3] == 1.0, "the frame is not tracked"  # else NaN
        return se3.inverse(self.T_camera_odom)

    def without_images(self) -> Frame:
        return replace(self, image=NO_IMAGE, gray=NO_IMAGE, pyramid=(), features={}, mask=None)

    def settled(self) -> Frame:
        """Its present pose in the odometry, and nothing else of it: its keyframe holds images."""
        T = self.T_odom_camera
        return Frame(NO_IMAGE, self.time_ns, self.seq, segment=self.segment, T_keyframe_camera=T)

    def known_points(self) -> tuple[Bool, F64]:
        """(N,) which corners of a keyframe have a landmark, and (M, 3) those in its camera, in
        odometry units."""
        known = self.landmarks.known(self.landmark)
        return known, se3.transform(self.T_camera_odom, self.landmarks[self.landmark[known]])
