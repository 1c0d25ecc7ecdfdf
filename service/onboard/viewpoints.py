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
from recon.tracking.keyframe_window import OdometryKeyframe
from recon.tracking.odometry import Tracked
from recon.types import F64, U8, PosePrior
from service.config import ScanConfig, parse_baseline

LAST_VIEW_SHARE = 0.1
"""A stretch's last frame becomes a view when it is this share of a usual step further on."""


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
    blurred: bool = False  # takes no part in stereo, only in the track

    @property
    def T_odom_camera(self) -> F64:
        """(4, 4) as refined by now."""
        return np.asarray(self.key.T_odom_camera @ self.T_key_camera)


@dataclass(frozen=True, slots=True, eq=False)
class Offer:
    """A tracked frame that may become a view."""

    seq: int
    time_ns: int
    picture: U8  # (H, W, 3) undistorted
    tracked: Tracked  # with a pose
    key: OdometryKeyframe  # the last one when it was tracked
    prior: PosePrior
    blurred: bool = False

    @property
    def T_odom_camera(self) -> F64:
        """(4, 4) as tracked."""
        assert self.tracked.T_odom_camera is not None
        return self.tracked.T_odom_camera


class Viewpoints:
    """Selects views from tracked frames and remembers the last few as partners."""

    def __init__(self, config: ScanConfig, partners: int = 4, kept: int = 6) -> None:
        """``kept`` views are remembered; at most ``partners`` pair up with one of them.

        With more partners than the neighbouring views can be, tracked frames between them
        become partners too.
        """
        self._kept: deque[Viewpoint] = deque(maxlen=kept)
        self._between: deque[Viewpoint] = deque(maxlen=8 * partners if partners > kept - 2 else 0)
        self._recent: deque[Viewpoint] = deque(maxlen=6)  # a quarter of a step apart
        self._extra: tuple[Viewpoint, list[Viewpoint]] | None = None  # a last view's partner
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

    def offer(self, offer: Offer) -> Viewpoint | None:
        """The frame as a view, when it is to be one."""
        wanted = self._take_next or self._wants(offer.seq, offer.tracked)
        if not wanted and not self._between.maxlen and not self._moved_on(offer):
            return None
        view = _viewpoint(offer, wanted)
        if not wanted:
            if self._between.maxlen:
                self._between.append(view)
            else:
                self._recent.append(view)
            return None
        self._take_next = False
        return self._keep(view)

    def end_stretch(self, offer: Offer | None) -> Viewpoint | None:
        """The last frame of a stretch as a view, when it has moved on since the last view.

        ``offer`` is that frame unless it is a view already. The ground that came into view
        last is not in the view before; a frame between the two becomes its partner.
        """
        step = self._step(self._kept[-1].key.segment) if self._kept else None
        if step is None:
            return None
        view = None
        least = LAST_VIEW_SHARE * step
        if offer is not None and not offer.blurred and _apart(offer, self._kept[-1]) >= least:
            view = self._keep(_viewpoint(offer, wanted=True))
        last = self._kept[-1]
        near = [v for v in self._recent if v.key.segment == last.key.segment and not v.blurred]
        near = [v for v in near if 0.5 * step <= _apart(v, last) < 0.9 * step]
        near.sort(key=lambda v: abs(_apart(v, last) - 0.65 * step))
        self._extra = (last, near[:1])
        return view

    def _step(self, segment: int) -> float | None:
        """Distance between the last two views; None unless they are automatic and of it."""
        same = [v for v in self._kept if v.key.segment == segment]
        if self._mode != "auto" or len(same) < 2:
            return None
        return _apart(same[-1], same[-2])

    def _moved_on(self, offer: Offer) -> bool:
        """True a quarter of a step after the last frame that was remembered."""
        step = self._step(offer.key.segment)
        if step is None:
            return False
        last = max([self._kept[-1], *self._recent], key=lambda v: v.seq)
        return last.key.segment == offer.key.segment and _apart(offer, last) > 0.25 * step

    def _keep(self, view: Viewpoint) -> Viewpoint:
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
        segment = view.key.segment
        others = [v for v in candidates if v.key.segment == segment and not v.blurred]
        others = [v for v in others if v is not view]
        if self._mode != "auto":
            others.sort(key=lambda v: (v.seq < view.seq, abs(v.seq - view.seq)))
            return others[:1]
        others.sort(key=lambda v: _apart(v, view))
        if not self._between:
            extra = self._extra[1] if self._extra and self._extra[0] is view else []
            return [*extra, *others[: self._partners]]
        return self._spread(view, others)

    def _spread(self, view: Viewpoint, others: list[Viewpoint]) -> list[Viewpoint]:
        """Partners between half and twice the keyframes' spacing, evenly spread."""
        base = [_apart(v, view) for v in others]
        steps = [b for v, b in zip(others, base, strict=True) if v.bgr is not None]
        spacing = steps[0] if steps else 0.0
        good = [v for v, b in zip(others, base, strict=True) if 0.6 * spacing <= b <= 2.2 * spacing]
        picked = np.unique(np.linspace(0, len(good) - 1, self._partners).round().astype(int))
        return [good[i] for i in picked] if good else []


def _apart(a: Viewpoint | Offer, b: Viewpoint) -> float:
    return float(np.linalg.norm(a.T_odom_camera[:3, 3] - b.T_odom_camera[:3, 3]))


def _viewpoint(offer: Offer, wanted: bool) -> Viewpoint:
    grey = np.asarray(cv2.cvtColor(offer.picture, cv2.COLOR_BGR2GRAY), np.uint8)
    T_key_camera = se3.inverse(offer.key.T_odom_camera) @ offer.T_odom_camera
    bgr = offer.picture if wanted else None
    return Viewpoint(
        offer.seq, offer.time_ns, bgr, grey, offer.key, T_key_camera, offer.prior, offer.blurred
    )


def frames_apart(chosen: int, every: int) -> int:
    """Frames between two views when ``chosen`` of ``every`` frames take part, evenly spread.

    Two of every ten are ten frames apart: at 60 frames a second and 3 m/s the paper's 0.5 m.
    """
    return max(1, round(every / max(chosen - 1, 1)))
