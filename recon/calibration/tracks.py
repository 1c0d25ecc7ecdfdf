"""Long tracks: points of the ground that many images show, and their positions.

SIFT features of full-size images are matched pair by pair, checked against the essential matrix,
and joined. They need no prediction, so that poses that are far off do not matter.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from recon import se3
from recon.calibration.global_bundle import RowMotion, Sightings, joint
from recon.camera_model import project, rays
from recon.parallel import run_parallel
from recon.tracking import robust_geometry
from recon.tracking.matching import Pyramid, match
from recon.tracking.sift_features import Features, features, mutual
from recon.types import F64, I64, U8, Camera

WIDTH_PX, FEATURES = 1920, 2500
"""Width of the image in which features are detected, and maximum number of features."""

LIKELY, MIN_ALIKE = 600, 10
"""Number of strongest features compared, and of matches needed, for two images to be alike."""

THRESHOLD_PX = 2.0  # maximum distance to the epipolar line

MIN_MATCHES = 15

MIN_SHARED, RELIEF_PX, REACH_PX = 8, 20.0, 2.5
"""Landmarks that two views share before patches are compared, what relief may move them by
against a plane, and how far a patch is looked for."""

MIN_PARALLAX_RAD = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Image:
    """An image's features without its lens's distortion."""

    features: Features
    flat_px: F64  # (N, 2) undistorted pixels
    place: I64  # (N,) SIFT may describe one place twice: the first feature there


def image_of(gray: U8, camera: Camera) -> Image:
    """The features of a distorted ``gray`` (H, W)."""
    found = features(gray, WIDTH_PX, FEATURES, are_strongest=True)
    _, first, which = np.unique(
        np.round(found.uv_px, 1), axis=0, return_index=True, return_inverse=True
    )
    place = first[which.ravel()].astype(np.int64)
    return Image(found, without_distortion(camera, found.uv_px), place)


MIN_COMMON = 12  # places in both of two images that tie them


def pieces(seen: Sightings, count: int) -> I64:
    """(N,) which piece each of the first ``count`` views is in, tied by a chain of images."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n = max(count, int(seen.view.max(initial=0)) + 1)
    shape = n, int(seen.landmark.max(initial=0)) + 1
    sees = coo_array((np.ones(len(seen.view)), (seen.view, seen.landmark)), shape).tocsr()
    piece = connected_components(sees @ sees.T >= MIN_COMMON, directed=False)[1]
    return np.asarray(piece[:count], np.int64)


def without_distortion(camera: Camera, uv_px: F64) -> F64:
    """(N, 2) pixels that the camera would show without distortion."""
    if len(uv_px) == 0 or not camera.distortion.any():
        return uv_px
    flat = cv2.undistortPoints(uv_px[:, None], camera.K, camera.distortion, None, None, camera.K)
    return np.asarray(flat.reshape(-1, 2), np.float64)


def are_alike(a: Image, b: Image) -> bool:
    """Whether two images show the same ground, by their strongest features."""
    rows, _ = mutual(a.features.descriptors[:LIKELY], b.features.descriptors[:LIKELY])
    return len(rows) >= MIN_ALIKE


def matches(a: Image, b: Image, camera: Camera) -> tuple[I64, I64] | None:
    """Matching features of ``a`` and ``b``; None when too few are verified."""
    rows_a, rows_b = mutual(a.features.descriptors, b.features.descriptors)
    if len(rows_a) < MIN_MATCHES:
        return None
    kept = robust_geometry.on_epipolar_lines(
        a.flat_px[rows_a], b.flat_px[rows_b], camera.K, THRESHOLD_PX
    )
    if kept is None or kept.sum() < MIN_MATCHES:
        return None
    return a.place[rows_a[kept]], b.place[rows_b[kept]]


def joined(
    images: Mapping[int, Image], pairs: Iterable[tuple[int, int]], camera: Camera
) -> Sightings:
    """The tracks through matched ``pairs``; one that meets a view twice is left out."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    views = sorted(images)
    *starts, total = np.cumsum([0, *(len(images[k].place) for k in views)])
    first, pairs = dict(zip(views, starts, strict=True)), list(pairs)
    found = run_parallel(*(partial(matches, images[a], images[b], camera) for a, b in pairs))
    ends = [
        np.column_stack([both[0] + first[a], both[1] + first[b]])
        for (a, b), both in zip(pairs, found, strict=True)
        if both is not None
    ]
    edges = np.concatenate([np.zeros((0, 2), np.int64), *ends])
    graph = coo_matrix((np.ones(len(edges), np.bool_), (edges[:, 0], edges[:, 1])), (total, total))
    used = np.unique(edges)
    label = connected_components(graph, directed=False)[1][used]
    order = np.searchsorted(starts, used, side="right") - 1
    met, often = np.unique(np.column_stack([label, order]), axis=0, return_counts=True)
    kept = ~np.isin(label, met[often > 1, 0])
    _, landmark = np.unique(label[kept], return_inverse=True)
    all_uv = np.concatenate([images[k].features.uv_px for k in views])
    return Sightings(
        np.array(views, np.int64)[order[kept]], landmark.astype(np.int64), all_uv[used[kept]]
    )


def sharpened(pyramid: Callable[[int], Pyramid], camera: Camera, seen: Sightings) -> Sightings:
    """Sightings at the places where the patch about each landmark's middle sighting fits best.
    ``pyramid`` gives a view without distortion. A sighting whose patch is not found stays."""
    flat = without_distortion(camera, seen.uv_px)
    middle = _middles(seen)
    reference = middle[np.searchsorted(seen.landmark[middle], seen.landmark)]
    uv = flat.copy()
    pairs = np.column_stack([seen.view[reference], seen.view])
    views, which = np.unique(pairs, axis=0, return_inverse=True)
    order = np.argsort(which.ravel(), kind="stable")
    rows_of = np.split(order, np.cumsum(np.bincount(which.ravel()))[:-1])

    def sharpen(a: int, b: int, rows: I64) -> None:
        here = flat[reference[rows]]
        found = robust_geometry.homography(here, flat[rows], RELIEF_PX)
        if found is None:
            return
        warp = robust_geometry.by_homography(found[0], here)[1]
        at = match(pyramid(a), here, pyramid(b), flat[rows], REACH_PX, warp)
        uv[rows[at.ok]] = at.uv_px[at.ok]

    run_parallel(*(
        partial(sharpen, int(a), int(b), rows)
        for (a, b), rows in zip(views, rows_of, strict=True)
        if a != b and len(rows) >= MIN_SHARED
    ))  # fmt: skip
    moved = (uv != flat).any(axis=1)
    at_px = seen.uv_px.copy()
    at_px[moved] = with_distortion(camera, uv[moved])
    return replace(seen, uv_px=at_px)


def with_distortion(camera: Camera, uv_px: F64) -> F64:
    """(N, 2) pixels of the camera's own images, from those without distortion."""
    if len(uv_px) == 0 or not camera.distortion.any():
        return uv_px
    zero = np.zeros(3)
    ahead = rays(camera.K, uv_px)[:, None]
    out, _ = cv2.projectPoints(ahead, zero, zero, camera.K, camera.distortion)
    return np.asarray(out.reshape(-1, 2), np.float64)


def crossings(
    poses: F64, camera: Camera, seen: Sightings, count: int, rows: RowMotion | None = None
) -> F64:
    """(P, 3) world points nearest to the rays of each landmark's sightings; NaN where they are
    nearly parallel or the point is behind a camera.

    ``poses`` (N, 4, 4) are T_world_camera, those of the middle rows.
    """
    own = poses[seen.view] if rows is None else rows.by_row(camera, poses, seen)
    flat = without_distortion(camera, seen.uv_px)
    ways = rays(camera.K, flat)
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    ways = np.einsum("mij,mj->mi", own[:, :3, :3], ways)
    centre = own[:, :3, 3]
    across = np.eye(3) - ways[:, :, None] * ways[:, None, :]
    H, g = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(H, seen.landmark, across)
    np.add.at(g, seen.landmark, np.einsum("mij,mj->mi", across, centre))
    out = np.full((count, 3), np.nan)
    some = np.flatnonzero(np.bincount(seen.landmark, minlength=count) >= 2)
    narrow = np.linalg.eigvalsh(H[some])[:, 0] < 0.5 * MIN_PARALLAX_RAD**2
    some = some[~narrow]
    out[some] = np.linalg.solve(H[some], g[some][:, :, None])[:, :, 0]
    ahead = np.einsum("mi,mi->m", out[seen.landmark] - centre, ways) > 0
    out[np.unique(seen.landmark[~ahead])] = np.nan
    return out


def extended(
    pyramid: Callable[[int], Pyramid], given: Camera, found: Camera, poses: F64, points: F64,
    seen: Sightings, overlap: Mapping[int, Iterable[int]],
) -> Sightings:  # fmt: skip
    """With the sightings that adjusted ``poses``, ``points`` and camera predict in other views.

    The patch about each landmark's middle sighting is bent as level ground is, so that views
    turned to each other show it alike. ``pyramid`` gives a view without the distortion of the
    camera ``given``.
    """
    flat = without_distortion(given, seen.uv_px)
    rows = _middles(seen)
    rows = rows[np.isfinite(points[seen.landmark[rows]]).all(axis=1)]
    known = {(int(v), int(p)) for v, p in zip(seen.view, seen.landmark, strict=True)}

    def found_again(a: int, b: int) -> tuple[I64, I64, F64]:
        """Views, landmarks and places that view ``b`` shows of those of view ``a``."""
        mine = rows[seen.view[rows] == a]
        new = np.array([r for r in mine if (b, int(seen.landmark[r])) not in known], np.int64)
        if len(new) < MIN_SHARED:
            return new[:0], new[:0], np.zeros((0, 2))
        spots = points[seen.landmark[new]]
        predicted, warp = _on_level_ground(found, poses[a], poses[b], flat[new], spots)
        shown = without_distortion(given, with_distortion(found, predicted))
        at = match(pyramid(a), flat[new], pyramid(b), shown, REACH_PX, warp)
        again = seen.landmark[new[at.ok]]
        return np.full_like(again, b), again, at.uv_px[at.ok].astype(np.float64)

    pairs = [(a, b) for a, others in overlap.items() for b in others]
    more = run_parallel(*(partial(found_again, a, b) for a, b in pairs))
    if not more:
        return seen
    view, landmark, places = (np.concatenate(parts) for parts in zip(*more, strict=True))
    return joint(seen, Sightings(view, landmark, with_distortion(given, places)))


def _middles(seen: Sightings) -> I64:
    """Row of each landmark's middle sighting in order of views."""
    order = np.lexsort((seen.view, seen.landmark))
    starts = np.flatnonzero(np.diff(seen.landmark[order], prepend=-1))
    lengths = np.diff(np.append(starts, len(order)))
    return np.asarray(order[starts + lengths // 2], np.int64)


def _on_level_ground(camera: Camera, T_a: F64, T_b: F64, uv: F64, spots: F64) -> tuple[F64, F64]:
    """(N, 2) pixels of view b for points ``spots`` (N, 3) that view a shows at ``uv``, and
    (N, 2, 2): what a step in a is in b on level ground through them."""
    T = se3.inverse(T_b)
    predicted = project(camera.K, se3.transform(T, spots))
    steps = []
    for axis in range(2):
        ways = rays(camera.K, uv + 8.0 * np.eye(2)[axis]) @ T_a[:3, :3].T
        far = (spots[:, 2] - T_a[2, 3]) / np.where(np.abs(ways[:, 2]) > 0.1, ways[:, 2], np.nan)
        there = se3.transform(T, T_a[:3, 3] + ways * far[:, None])
        steps.append((project(camera.K, there) - predicted) / 8.0)
    warp = np.nan_to_num(np.stack(steps, axis=2))
    return np.nan_to_num(predicted, nan=-1e6), warp
