"""The search for loops after each keyframe."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from recon.camera_model import scaled_K
from recon.posegraph.loop_closure import LoopEnd, candidates, ground_seen, verify
from recon.posegraph.trajectory import Trajectory
from recon.tracking.sift_features import alike, signature
from recon.types import F64, U8, DepthMap

WIDTH_PX = 640  # width of the images kept; loops need no finer ones
MIN_DEPTH_PX = 120  # a depth image at least twice as wide is kept at half its size

MIN_GAP, MIN_OVERLAP = 10, 0.35
"""Keyframes between the two ends of a loop on one chain, and how much of the later view must lie in
the earlier one."""

TRIES = 2  # verifications per keyframe, at most: each takes some 30 to 120 ms on one core
COMPARED = 20  # keyframes whose look is compared with a new one's, at most: some 4 ms each
MIN_ALIKE = 8  # features that two images of one place have in common, of their strongest

PAUSE = 3
"""Keyframes without a search after a loop was taken, as they would only repeat it; fewer where the
view moves on by :data:`MOVED` of its diagonal."""

MOVED = 0.25  # of the view's diagonal, from which on a loop tells something new


@dataclass(frozen=True, eq=False)
class _Kept:
    """A keyframe packed for later."""

    seq: int
    ordinal: int  # among all keyframes
    segment: int
    image: U8  # JPEG, gray
    K: F64  # (3, 3) px of that image
    depth: npt.NDArray[np.uint16]  # (h, w) share of ``far``, 0 unknown
    far: float  # odometry units
    sigma: npt.NDArray[np.float16]  # (h, w) odometry units
    depth_K: F64
    size_px: tuple[int, int]

    def gray(self) -> U8:
        return np.asarray(cv2.imdecode(self.image, cv2.IMREAD_GRAYSCALE), np.uint8)

    @cached_property
    def signature(self) -> U8:
        return signature(self.gray())

    def unpacked(self, scale: float) -> LoopEnd:
        """The end with its depth in metres."""
        depth = self.depth.astype(np.float32) * np.float32(scale * self.far / 65535.0)
        depth[self.depth == 0] = np.nan
        sigma = self.sigma.astype(np.float32) * np.float32(scale)
        views = np.where(self.depth > 0, 2, 0).astype(np.uint8)
        return LoopEnd(
            self.gray(), self.K,
            DepthMap(depth, sigma, views, self.depth_K, np.eye(4)),
        )  # fmt: skip


def _packed(seq: int, ordinal: int, segment: int, gray: U8, K: F64, depth: DepthMap) -> _Kept:
    H, W = gray.shape
    size = (min(WIDTH_PX, W), round(min(WIDTH_PX, W) * H / W))
    small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    _, image = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 92])
    step = 2 if depth.depth_m.shape[1] >= 2 * MIN_DEPTH_PX else 1
    z, sigma = depth.depth_m[::step, ::step], depth.sigma_m[::step, ::step]
    depth_K = depth.K / np.array([[step], [step], [1.0]])  # every second pixel keeps its place
    known = np.isfinite(z)
    far = float(z[known].max()) if known.any() else 1.0
    share = np.where(known, np.maximum(np.rint(z * (65535.0 / far)), 1), 0)
    return _Kept(
        seq, ordinal, segment, np.asarray(image, np.uint8), scaled_K(K, size[0] / W, size[1] / H),
        share.astype(np.uint16), far, sigma.astype(np.float16), depth_K, size,
    )  # fmt: skip


class LoopSearch:
    """Keeps keyframes, finds earlier ones that see the same, and adds loops to the trajectory."""

    def __init__(
        self, trajectory: Trajectory, max_views: int = 400, min_gap: int = MIN_GAP
    ) -> None:
        """Of more than ``max_views`` keyframes, about 0.1 MB each, every second of the older half
        is forgotten."""
        self._max_views, self._min_gap = max_views, min_gap
        self.trajectory = trajectory
        self._kept: dict[int, _Kept] = {}
        self._tied: _Kept | None = None  # the last end of a loop
        self._turn = 0

    def __len__(self) -> int:
        return len(self._kept)

    def add(self, seq: int, segment: int, gray: U8, K: F64, depth: DepthMap) -> None:
        """Remember a keyframe, and search for loops that end in it.

        Args:
            gray: (H, W) image without distortion, ``K`` (3, 3) px of it.
            depth: of the same camera, in units of its segment's odometry.
        """
        new = _packed(seq, self.trajectory.graph.entered - 1, segment, gray, K, depth)
        self._kept[seq] = new
        if not self._repeats(new, depth):
            self._search(new)
        if len(self._kept) > self._max_views:
            self._thin()

    def _search(self, new: _Kept) -> None:
        end = new.unpacked(self.trajectory.scale(new.seq))
        for seq in self._likely(new, end):
            guess = self.trajectory.step_between(seq, new.seq)
            known = self._kept[seq].unpacked(self.trajectory.scale(seq))
            found = verify(known, end, guess)
            if found is not None and self.trajectory.add_loop(seq, new.seq, *found):
                self._tied = new
                return

    def _repeats(self, new: _Kept, depth: DepthMap) -> bool:
        """True when a loop here would only repeat the last one."""
        tied = self._tied
        if tied is None or tied.segment != new.segment or new.ordinal - tied.ordinal > PAUSE:
            return False
        distance = float(np.nanmedian(depth.depth_m))
        step = self.trajectory.odom_pose(new.seq) - self.trajectory.odom_pose(tied.seq)
        moved = float(np.linalg.norm(step[:3, 3] + distance * step[:3, 2]))
        return moved < MOVED * distance * float(np.hypot(*new.size_px)) / float(new.K[0, 0])

    def _likely(self, new: _Kept, end: LoopEnd) -> list[int]:
        """Earlier keyframes worth a verification, the best first."""
        depth_m = float(np.nanmedian(end.depth.depth_m))
        if not depth_m > 0:
            return []
        seqs = [seq for seq, kept in self._kept.items() if self._is_apart(kept, new)]
        if not seqs:
            return []
        W, H = new.size_px
        reach = depth_m * float(np.hypot(W, H)) / new.K[0, 0]
        *there, here = self.trajectory.places([*seqs, new.seq])
        centres, ways = (np.array(there)[:, :3, k] for k in (3, 2))
        ahead = centres + depth_m * ways
        apart = np.linalg.norm(ahead - (here[:3, 3] + depth_m * here[:3, 2]), axis=1)
        some = {seqs[i]: there[i] for i in np.argsort(apart)[:8] if apart[i] < reach}
        some[new.seq] = here
        found = candidates(some, new.K, new.size_px, ground_seen(end.depth), MIN_OVERLAP)
        by_place = [seq for seq, _ in found]
        return list(dict.fromkeys(self._by_look(new, seqs) + by_place))[:TRIES]

    def _by_look(self, new: _Kept, seqs: list[int]) -> list[int]:
        """Earlier keyframes that look like this one, the most similar first; some of them at a
        time. Where fixes or a loop locate the segment, its place is the better criterion."""
        if self.trajectory.graph.segments[new.segment].is_tied:
            return []
        self._turn += 1
        every = -(-len(seqs) // COMPARED)
        found = []
        for seq in seqs[self._turn % every :: every]:
            count = alike(self._kept[seq].signature, new.signature)
            if count >= MIN_ALIKE:
                found.append((count, seq))
        return [seq for _, seq in sorted(found, reverse=True)]

    def _is_apart(self, one: _Kept, two: _Kept) -> bool:
        gap = two.ordinal - one.ordinal
        return gap >= self._min_gap or one.segment != two.segment

    def _thin(self) -> None:
        for seq in list(self._kept)[: len(self._kept) // 2 : 2]:
            del self._kept[seq]
