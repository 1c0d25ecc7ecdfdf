"""Places seen before: candidates by overlap or look, each verified before it is accepted.

Verification is independent of the pose graph: corners of one keyframe with their depths are
matched in the other's image (ZSSD), give a pose by EPnP, and the two depth maps must then
agree by ICP.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from recon import se3
from recon.camera_model import project, rays, scaled_K
from recon.mapping.registration import agreed_motion, register_projective
from recon.plane import plane_normal
from recon.posegraph.records import Loop
from recon.posegraph.trajectory import Trajectory
from recon.tracking import matching, pnp
from recon.tracking.sift_features import FEATURE_SHARES, alike, features, match_features, signature
from recon.types import F32, F64, I64, U8, Bool, DepthMap

MIN_RAD, MIN_SHARE = 2e-4, 0.1
"""A loop's sigmas are no less than this, and than this share of its depths' sigma: what the
points of one depth map have in common does not average out."""

SEARCH_SHARE = 0.12  # search radius about what the graph predicts, over the image's width

MIN_MATCHES, MIN_INLIERS, MIN_INLIER_SHARE = 40, 30, 0.5
"""Corners found again, and those of them that the pose explains, and their share."""


@dataclass(frozen=True, slots=True, eq=False)
class LoopEnd:
    """A keyframe as the search for loops needs it."""

    gray: U8  # (H, W) without distortion
    K: F64  # (3, 3) px of the image
    depth: DepthMap  # metres; of the same camera at any size


LoopClosure = tuple[F64, F64, float]
"""A verified motion between two keyframes: T_a_b (4, 4) m, its covariance (6, 6) as a left
perturbation in a's camera frame, and the growth of b's depths that fits a's."""


def ground_seen(depth: DepthMap) -> F64:
    """(N, 3) what a camera sees, in its frame: a grid over the whole image. Unmeasured parts are
    filled by the plane through the measured ones."""
    h, w = depth.depth_m.shape
    u, v = np.meshgrid(np.linspace(0, w - 1, 17), np.linspace(0, h - 1, 11))
    uv = np.column_stack([u.ravel(), v.ravel()])
    at = np.rint(uv).astype(np.int64)
    grid = rays(depth.K, uv)
    z = depth.depth_m[at[:, 1], at[:, 0]].astype(np.float64)
    known = np.isfinite(z)
    if not known.any():
        return np.zeros((0, 3))
    normal = _slope(grid[known] * z[known, None])
    level = float(np.median(np.sum(grid[known] * normal, axis=1) * z[known]))
    slope = grid @ normal
    ahead = slope * np.sign(level) > 1e-3  # the others look above the horizon
    z[~known & ahead] = level / slope[~known & ahead]
    usable = (z > 0) & (z < 5.0 * float(np.median(z[known])))
    return np.asarray(grid[usable] * z[usable, None])


def _slope(points: F64) -> F64:
    """(3,) unit normal of the plane through points (N, 3); the image's where there is none."""
    normal = plane_normal(points)
    return np.array([0.0, 0.0, 1.0]) if normal is None else normal


def candidates(
    poses: Mapping[int, F64], K: F64, size_px: tuple[int, int], ground: F64, min_overlap: float
) -> list[tuple[int, float]]:
    """Keyframes that see at least ``min_overlap`` of what the last one sees, with the share of its
    view, best first.

    ``poses`` are T_world_camera (4, 4) by keyframe number; ``ground`` (N, 3) is what the last one
    sees, in its camera's frame (:func:`ground_seen`).
    """
    W, H = size_px
    if not len(ground):
        return []
    *earlier, newest = poses
    ground = se3.transform(poses[newest], ground)
    found = []
    for seq in earlier:
        there = se3.transform(se3.inverse(poses[seq]), ground)
        seen = project(K, there)
        inside = (seen >= 0).all(axis=1) & (seen <= [W - 1, H - 1]).all(axis=1)
        inside &= there[:, 2] > 0
        share = float(np.mean(inside))
        if share >= min_overlap:
            found.append((seq, share))
    here = poses[newest][:3, 3]
    return sorted(
        found, key=lambda item: (-item[1], float(np.linalg.norm(poses[item[0]][:3, 3] - here)))
    )


def verify(a: LoopEnd, b: LoopEnd, T_a_b_guess: F64) -> LoopClosure | None:
    """The motion between two keyframes that may see the same place, or None when they do not.

    ``T_a_b_guess`` (4, 4) is the pose graph's estimate. Where it is too far off, the features that
    both images share predict instead.
    """
    uv, points = landmarks(a, matching.DEFAULT)
    if len(uv) < MIN_MATCHES:
        return None
    pyramids = [matching.build_pyramid(v.gray) for v in (a, b)]
    T_b_a = se3.inverse(T_a_b_guess)
    for predicted, warp, prior, share in _predictions(a, b, T_b_a, uv, points):
        radius = share * b.gray.shape[1]
        found = matching.match(pyramids[0], uv, pyramids[1], predicted, radius, warp)
        if np.count_nonzero(found.ok) < MIN_MATCHES:
            continue
        seen = found.uv_px[found.ok].astype(np.float64)
        solved = pnp.solve(points[found.ok], seen, b.K, prior, min_inliers=MIN_INLIERS)
        if solved is not None and np.mean(solved.inliers) >= MIN_INLIER_SHARE:
            T_a_b = se3.inverse(solved.T_camera_points)
            return _with_icp(a, b, T_a_b, se3.left_covariance(T_a_b, solved.covariance))
    return None


def _predictions(
    a: LoopEnd, b: LoopEnd, T_b_a: F64, uv: F64, points: F64
) -> Iterator[tuple[F64, F64, F64 | None, float]]:
    """Where b may see a's landmarks (N, 2), how offsets about them change (N, 2, 2), b's pose if it
    is known, and the search radius as a share of the width; made when it is asked for."""
    predicted, warp = project(b.K, se3.transform(T_b_a, points)), warps(a.K, b.K, T_b_a, uv, points)
    yield predicted, warp, T_b_a, SEARCH_SHARE
    shared = match_features(features(a.gray), features(b.gray))
    if shared is not None:
        there, warp = shared.predict(uv)
        for share in FEATURE_SHARES:
            yield there, warp, None, share


def landmarks(end: LoopEnd, config: matching.MatchingConfig) -> tuple[F64, F64]:
    """(N, 2) corners with a known depth and their (N, 3) points in the camera frame."""
    corners = matching.harris_grid(end.gray, config)[:, :2].astype(np.float64)
    points, place, known = on_surface(end, corners)
    known &= ~_at_edge(end.depth.depth_m, place)
    return corners[known], points[known]


def on_surface(end: LoopEnd, uv: F64) -> tuple[F64, I64, Bool]:
    """(N, 3) surface points at pixels (N, 2) of the image, their pixels (N, 2) of the depth, and
    where there is a surface."""
    h, w = end.depth.depth_m.shape
    H, W = end.gray.shape
    at = np.rint((uv + 0.5) * [w / W, h / H] - 0.5)
    inside = ((at >= 0) & (at <= [w - 1, h - 1])).all(axis=1)
    place = np.clip(np.nan_to_num(at), 0, [w - 1, h - 1]).astype(np.int64)
    z = end.depth.depth_m[place[:, 1], place[:, 0]].astype(np.float64)
    return rays(end.K, uv) * z[:, None], place, np.asarray(inside & np.isfinite(z))


def _at_edge(depth: F32, place: I64) -> Bool:
    """(N,) True next to a depth edge or a hole, where a corner's depth is anyone's guess."""
    h, w = depth.shape
    here = depth[place[:, 1], place[:, 0]]
    spread = np.zeros(len(place))
    for dv, du in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        v, u = np.clip(place[:, 1] + dv, 0, h - 1), np.clip(place[:, 0] + du, 0, w - 1)
        spread = np.maximum(spread, np.abs(depth[v, u] - here))
    return np.asarray(~(spread < 0.03 * here))


def warps(K_a: F64, K_b: F64, T_b_a: F64, uv: F64, points: F64) -> F64:
    """(N, 2, 2) maps of offsets about landmarks in a to offsets in b, all of one slope.

    Each landmark's surface is taken to be parallel to the plane that most of them lie on, so
    that two oblique views of the ground from opposite sides still compare like with like.
    """
    normal = _slope(points)
    level = np.sum(points * normal, axis=1)
    out = np.empty((len(uv), 2, 2))
    here = project(K_b, se3.transform(T_b_a, points))
    for axis in range(2):
        ways = rays(K_a, uv + 8.0 * np.eye(2)[axis])
        slope = ways @ normal
        stepped = ways * (level / np.where(np.abs(slope) > 1e-6, slope, np.nan))[:, None]
        out[:, :, axis] = (project(K_b, se3.transform(T_b_a, stepped)) - here) / 8.0
    return out


def _with_icp(a: LoopEnd, b: LoopEnd, T_a_b: F64, covariance: F64) -> LoopClosure | None:
    """The loop refined by ICP of the depth maps; None when they contradict it."""
    growth = _growth(a, b, T_a_b)
    if growth is None:
        return None
    b = replace(b, depth=b.depth.scaled(growth, b.depth.T_world_camera))
    # Depths of one keyframe err together, which the pixels do not show.
    depth = float(np.nanmedian(a.depth.depth_m))
    sigma = float(np.nanmedian(a.depth.sigma_m))
    covariance = covariance + np.diag([(sigma / depth) ** 2 * 0.01] * 3 + [(0.3 * sigma) ** 2] * 3)
    aligned = register_projective(b.depth, a.depth, T_a_b)
    agreed = agreed_motion(T_a_b, covariance, aligned)
    if agreed is None:
        return None
    T, covariance = agreed
    covariance = covariance + np.diag([MIN_RAD**2] * 3 + [(MIN_SHARE * sigma) ** 2] * 3)
    return T, covariance, growth


def _growth(a: LoopEnd, b: LoopEnd, T_a_b: F64) -> float | None:
    """Median ratio of a's depths to b's where both see the same; None with too few."""
    h, w = a.depth.depth_m.shape
    v, u = np.mgrid[0:h:4, 0:w:4].reshape(2, -1)
    depth = a.depth.depth_m[v, u].astype(np.float64)
    known = np.isfinite(depth)
    points = rays(a.depth.K, np.column_stack([u, v])[known].astype(np.float64))
    there = se3.transform(se3.inverse(T_a_b), points * depth[known, None])
    pixel = project(b.depth.K, there)
    h, w = b.depth.depth_m.shape
    inside = (pixel >= 0).all(axis=1) & (pixel <= [w - 1, h - 1]).all(axis=1) & (there[:, 2] > 0)
    at = np.rint(pixel[inside]).astype(np.int64)
    ratio = there[inside, 2] / b.depth.depth_m[at[:, 1], at[:, 0]]
    ratio = ratio[np.isfinite(ratio)]
    return float(np.median(ratio)) if len(ratio) >= 50 else None


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
    depth = depth.every(2 if depth.depth_m.shape[1] >= 2 * MIN_DEPTH_PX else 1)
    z = depth.depth_m
    known = np.isfinite(z)
    far = float(z[known].max()) if known.any() else 1.0
    share = np.where(known, np.maximum(np.rint(z * (65535.0 / far)), 1), 0)
    return _Kept(
        seq, ordinal, segment, np.asarray(image, np.uint8), scaled_K(K, size[0] / W, size[1] / H),
        share.astype(np.uint16), far, depth.sigma_m.astype(np.float16), depth.K, size,
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
            if found is not None and self.trajectory.add_loop(Loop(seq, new.seq, *found)):
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
