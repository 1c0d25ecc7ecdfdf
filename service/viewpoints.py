"""Which frames become views of the virtual stereo camera, and which of them pair up.

Three ways, as the operator sets ``scan.baseline``: "auto" takes the odometry's keyframes,
spaced by base-to-height; metres takes a frame every so far along the track; "k/m" takes k of
every m frames, evenly, as the paper does (two of every ten).
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass

import cv2
import numpy as np

from recon import se3
from recon.keyframe_window import OdometryKeyframe
from recon.odometry import Tracked
from recon.types import F64, U8, Frame, PosePrior
from service.config import ScanConfig, parse_baseline


@dataclass(frozen=True, slots=True, eq=False)
class Viewpoint:
    """A picture that takes part in stereo; its pose follows its odometry keyframe's."""

    seq: int
    time_ns: int
    bgr: U8 | None  # (H, W, 3) undistorted; None for one that is only a partner
    grey: U8  # (H, W) the same
    key: OdometryKeyframe
    T_key_camera: F64  # (4, 4)
    prior: PosePrior

    @property
    def T_odom_camera(self) -> F64:
        """(4, 4) as refined by now."""
        return np.asarray(self.key.T_odom_camera @ self.T_key_camera)


class Viewpoints:
    """Selects views from tracked frames and remembers the last few as partners."""

    def __init__(self, config: ScanConfig, partners: int = 4, kept: int = 6) -> None:
        """``kept`` views are remembered; at most ``partners`` pair up with one of them.

        With more partners than the neighbouring views can be, tracked frames between them
        become partners too.
        """
        self._kept: deque[Viewpoint] = deque(maxlen=kept)
        self._between: deque[Viewpoint] = deque(maxlen=8 * partners if partners > kept - 2 else 0)
        self._most_partners = partners
        self._views_of: Counter[int] = Counter()  # views by segment
        self._take_next = False
        self.set_baseline(config)

    def set_baseline(self, config: ScanConfig) -> None:
        """Follow another ``scan.baseline`` from the next frame on."""
        self._mode, self._amount, every = parse_baseline(config.baseline)
        self._stride = frames_apart(int(self._amount), every) if self._mode == "frames" else 0
        self._partners = self._most_partners if self._mode == "auto" else 1

    def set_partners(self, most: int) -> None:
        """Pair each view with at most ``most`` others from now on, where the baseline is "auto"."""
        self._most_partners = most
        self._partners = most if self._mode == "auto" else 1

    def take_next(self) -> None:
        """Make the next frame with a pose a view, whatever the baseline asks for."""
        self._take_next = True

    @property
    def least_base_to_height(self) -> float:
        """The shortest baseline that stereo should accept: an operator's choice is kept."""
        return 0.03 if self._mode == "auto" else 0.002

    def offer(
        self,
        frame: Frame,
        picture: U8,
        tracked: Tracked,
        key: OdometryKeyframe,
        prior: PosePrior,
    ) -> Viewpoint | None:
        """The frame as a view, when it is to be one."""
        assert tracked.T_odom_camera is not None
        wanted = self._take_next or self._wants(frame.seq, tracked)
        if not wanted and not self._between.maxlen:
            return None
        grey = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8)
        T_key_camera = se3.inverse(key.T_odom_camera) @ tracked.T_odom_camera
        bgr = picture if wanted else None
        view = Viewpoint(frame.seq, frame.time_ns, bgr, grey, key, T_key_camera, prior)
        if not wanted:
            self._between.append(view)
            return None
        self._take_next = False
        self._kept.append(view)
        self._views_of[view.key.segment] += 1
        return view

    def _wants(self, seq: int, tracked: Tracked) -> bool:
        if tracked.state == "started" or not self._kept:
            return tracked.state in ("started", "keyframe")
        last = self._kept[-1]
        if self._mode == "auto" or last.key.segment != tracked.segment:
            return tracked.state == "keyframe"
        if self._mode == "frames":
            return seq - last.seq >= self._stride
        assert tracked.T_odom_camera is not None
        moved = tracked.T_odom_camera[:3, 3] - last.T_odom_camera[:3, 3]
        return bool(np.linalg.norm(moved) >= self._amount)

    def ready(self, view: Viewpoint) -> bool:
        """True when the view has two neighbours to pair with, or its segment is over."""
        if not self._kept or self._kept[-1] is view:
            return False
        if self._mode != "auto" or self._kept[-1].key.segment != view.key.segment:
            return True
        return sum(v.key.segment == view.key.segment for v in self._kept) >= 3

    def confirmed(self, view: Viewpoint) -> bool:
        """False for a stretch of two views: what one pair alone claims, nothing contradicts.

        Clouds in the sky or a false first motion would otherwise become surface. A baseline
        that the operator fixed pairs each view once and is taken at its word.
        """
        return self._mode != "auto" or self._views_of[view.key.segment] >= 3

    def partners(self, view: Viewpoint) -> list[Viewpoint]:
        """The views to pair it with, the best first.

        Automatic: those nearest to the wanted base-to-height, from both sides; a fixed
        baseline: the neighbour after it, or before it at the end of a segment.
        """
        candidates = [*self._kept, *self._between]
        others = [v for v in candidates if v is not view and v.key.segment == view.key.segment]
        if self._mode != "auto":
            others.sort(key=lambda v: (v.seq < view.seq, abs(v.seq - view.seq)))
            return others[:1]
        centre = view.T_odom_camera[:3, 3]
        others.sort(key=lambda v: float(np.linalg.norm(v.T_odom_camera[:3, 3] - centre)))
        if not self._between:
            return others[: self._partners]
        return self._spread(view, others)

    def _spread(self, view: Viewpoint, others: list[Viewpoint]) -> list[Viewpoint]:
        """Partners between half and twice the keyframes' spacing, evenly spread."""
        centre = view.T_odom_camera[:3, 3]
        base = [float(np.linalg.norm(v.T_odom_camera[:3, 3] - centre)) for v in others]
        steps = [b for v, b in zip(others, base, strict=True) if v.bgr is not None]
        spacing = steps[0] if steps else 0.0
        good = [v for v, b in zip(others, base, strict=True) if 0.6 * spacing <= b <= 2.2 * spacing]
        picked = np.unique(np.linspace(0, len(good) - 1, self._partners).round().astype(int))
        return [good[i] for i in picked] if good else []


def frames_apart(chosen: int, every: int) -> int:
    """Frames between two views when ``chosen`` of ``every`` frames take part, evenly spread.

    Two of every ten are ten frames apart: at 60 frames a second and 3 m/s the paper's 0.5 m.
    """
    return max(1, round(every / max(chosen - 1, 1)))
