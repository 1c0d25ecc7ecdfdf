"""Which images see which triangles of a mesh, how finely, and in what colour.

The first two steps of texturing: visibility by ray casting, and the data term, after
Waechter, Moehrle and Goesele 2014 (doi:10.1007/978-3-319-10602-1_54, sections 3.1 and 4.1).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numba import njit

from recon.camera_model import project
from recon.parallel import parallel_for
from recon.surface.meshing import Mesh, face_neighbours
from recon.types import F32, F64, I32, I64, U8, Bool

Rays = Callable[[F64, F64], F64]
"""Camera (3,) and unit directions (N, 3) to metres (N,) up to the mesh, infinite without a hit."""

CANDIDATES = 6
"""Views kept per triangle, the finest."""

MIN_COSINE = 0.1
"""A flatter view of the surface around a triangle is not used."""

EDGE_PX = 1.0
OUTLIER_LEVELS = 25.0
"""A view's colour of a triangle may differ from the others' median by this, and by OUTLIER_SPREADS
of their spread: beyond, something else was in front of it (a car, a person)."""

OUTLIER_SPREADS = 4.0
MIN_VOTES = 4


@dataclass(frozen=True, slots=True, eq=False)
class TextureView:
    """One image of the surface, without distortion; ``alpha`` 0 where it holds nothing."""

    bgra: U8  # (h, w, 4)
    K: F64  # (3, 3) px of this image
    T_world_camera: F64  # (4, 4)


@dataclass(frozen=True, slots=True, eq=False)
class TriangleViews:
    """The views of each triangle, the finest first; view -1 fills up the rows."""

    view: I32  # (F, CANDIDATES)
    px_per_m: F32  # (F, CANDIDATES) geometric mean resolution on the triangle
    bgr: F32  # (F, CANDIDATES, 3) mean colour of corners and middle

    @staticmethod
    def none(count: int) -> TriangleViews:
        """So many triangles that no view sees."""
        return TriangleViews(
            np.full((count, CANDIDATES), -1, np.int32),
            np.zeros((count, CANDIDATES), np.float32),
            np.zeros((count, CANDIDATES, 3), np.float32),
        )

    def mean_bgr(self) -> F32:
        """(F, 3) mean of what the views of each triangle show; 0 without any."""
        is_seen = self.view >= 0  # views that were dropped leave their colours behind
        total = (self.bgr * is_seen[..., None]).sum(axis=1)
        return np.asarray(total / np.maximum(is_seen.sum(axis=1), 1)[:, None])

    def by_view(self) -> Iterator[tuple[int, I64, I64]]:
        """Each view that sees any, the triangles that it sees, rising, and its slot of each."""
        views = self.view.ravel()
        order = np.argsort(views, kind="stable")[int((views < 0).sum()) :]
        for part in np.split(order, np.flatnonzero(np.diff(views[order])) + 1):
            if len(part):
                yield int(views[part[0]]), *np.divmod(part, self.view.shape[1])


def look(
    mesh: Mesh, views: Sequence[TextureView], progress: Callable[[float], None] = lambda _: None
) -> TriangleViews:
    """The sightings of every triangle of ``mesh``.

    A view sees a triangle when no surface hides its corners and its middle, it faces the camera,
    and at least half of those four places have colour. ``progress`` receives the share done.
    """
    reach = rays_onto(mesh)
    vertices = np.asarray(mesh.vertices_m, np.float64)
    corners = vertices[mesh.faces]
    area, normal = steady_normals(corners, face_neighbours(mesh.faces))
    tolerance = 0.3 * float(np.sqrt(2.0 * np.median(area))) if len(area) else 0.0
    middle = corners.mean(axis=1)
    out = TriangleViews.none(len(mesh.faces))
    for number, view in enumerate(views):
        progress(number / len(views))
        px = projected(view, vertices)
        inside = _inside(px, view)
        inside[inside] = _free(reach, view, vertices[inside], tolerance)
        rows = _facing(mesh.faces, inside, normal, middle, view.T_world_camera)
        rows = rows[_free(reach, view, middle[rows], tolerance)]
        places = np.concatenate([px[mesh.faces[rows]], projected(view, middle[rows])[:, None]], 1)
        _see(
            rows, places, normal, middle, view.bgra, view.K, view.T_world_camera, number, out.view,
            out.px_per_m, out.bgr,
        )  # fmt: skip
    progress(1.0)
    return out


OWN_WEIGHT = 3.0
"""Of a triangle's own normal, as much as three neighbours of its size have together."""

EQUILATERAL = 0.25 * 3.0**0.5
"""Area of an equilateral triangle whose edge is 1."""


def steady_normals(corners: F64, neighbours: I32) -> tuple[F64, F64]:
    """(F,) areas of triangles (F, 3, 3) and (F, 3) unit normals, means with those of their
    ``neighbours`` (F, 3; -1: none): a sliver's own normal is noise, and it would take
    another view than the surface around it.

    A neighbour weighs no more than an equilateral triangle on the edge that both share, so that
    no small triangle of a wall takes the normal of a large roof.
    """
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(doubled, axis=1)
    own = doubled / np.maximum(2.0 * area, 1e-12)[:, None]
    total = OWN_WEIGHT * area[:, None] * own
    for k in range(3):
        edge = corners[:, (k + 1) % 3] - corners[:, k]
        weight = np.minimum(area[neighbours[:, k]], EQUILATERAL * (edge**2).sum(axis=1))
        total += np.where(neighbours[:, k] >= 0, weight, 0.0)[:, None] * own[neighbours[:, k]]
    return area, total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)


def ray_scene(vertices_m: F64, faces: I32 | I64) -> Any:
    """Exact ray casting against triangles and distances to them, by Open3D (Embree)."""
    import open3d as o3d

    scene: Any = cast(Any, o3d.t.geometry).RaycastingScene()
    tensor: Any = o3d.core.Tensor
    scene.add_triangles(
        tensor(np.ascontiguousarray(vertices_m, np.float32)),
        tensor(np.ascontiguousarray(faces, np.uint32)),
    )
    return scene


def rays_onto(mesh: Mesh) -> Rays:
    """Exact ray casting against ``mesh``."""
    scene = ray_scene(mesh.vertices_m, mesh.faces)

    def reach(eye: F64, directions: F64) -> F64:
        rays: Any = np.empty((len(directions), 6), np.float32)
        rays[:, :3], rays[:, 3:] = eye, directions
        return np.asarray(scene.cast_rays(rays)["t_hit"].numpy())

    return reach


def consistent(found: TriangleViews) -> TriangleViews:
    """``found`` without the views whose colour differs from that of most others.

    Needs MIN_VOTES views of a triangle at least; the rest of its row moves up.
    """
    view, px, bgr = found.view.copy(), found.px_per_m.copy(), found.bgr.copy()
    parallel_for(drop_outliers, len(view), view, px, bgr)
    return TriangleViews(view, px, bgr)


@njit(cache=True, nogil=True)
def drop_outliers(begin: int, end: int, view: I32, px: F32, bgr: F32) -> None:
    """Remove the outliers of rows of sightings, whose unused slots are the last ones."""
    slots = view.shape[1]
    off, ordered = np.empty(slots), np.empty(slots)
    for f in range(begin, end):
        count = 0
        while count < slots and view[f, count] >= 0:
            count += 1
        if count < MIN_VOTES:
            continue
        off[:] = 0.0
        for c in range(3):
            middle = _median(bgr[f, :count, c], ordered)
            for k in range(count):
                off[k] = max(off[k], abs(bgr[f, k, c] - middle))
        limit = OUTLIER_LEVELS + OUTLIER_SPREADS * _median(off[:count], ordered)
        kept = 0
        for k in range(count):
            if off[k] <= limit:
                view[f, kept], px[f, kept], bgr[f, kept] = view[f, k], px[f, k], bgr[f, k]
                kept += 1
        view[f, kept:count] = -1


@njit(cache=True, nogil=True)
def _median(values: F32 | F64, ordered: F64) -> float:
    """The median of a few values; ``ordered`` is room for them."""
    count = len(values)
    for n in range(count):
        k = n
        while k > 0 and ordered[k - 1] > values[n]:
            ordered[k] = ordered[k - 1]
            k -= 1
        ordered[k] = values[n]
    return float(0.5 * (ordered[(count - 1) // 2] + ordered[count // 2]))


def projected(view: TextureView, xyz: F64) -> F64:
    """(N, 2) pixels, whole numbers at pixel centres; NaN behind the camera."""
    R, t = view.T_world_camera[:3, :3], view.T_world_camera[:3, 3]
    return project(view.K, (xyz - t) @ R)


def _inside(px: F64, view: TextureView) -> Bool:
    """(N,) places that fall into the image, a pixel away from its border."""
    h, w = view.bgra.shape[:2]
    with np.errstate(invalid="ignore"):
        u = (px[:, 0] >= EDGE_PX) & (px[:, 0] <= w - 1 - EDGE_PX)
        v = (px[:, 1] >= EDGE_PX) & (px[:, 1] <= h - 1 - EDGE_PX)
    return np.asarray(u & v)


def _free(reach: Rays, view: TextureView, xyz: F64, tolerance_m: float) -> Bool:
    """(N,) places with no surface between them and the camera, but for ``tolerance_m``."""
    if not len(xyz):
        return np.zeros(0, np.bool_)
    eye = view.T_world_camera[:3, 3]
    ray = xyz - eye
    distance = np.linalg.norm(ray, axis=1)
    hit = reach(eye, ray / distance[:, None])
    return np.asarray(hit > distance - tolerance_m - 1e-4 * distance)


def doubled_area(px: F64) -> F64:
    """(N,) twice the area of (N, 3, 2) triangles."""
    a, b = px[:, 1] - px[:, 0], px[:, 2] - px[:, 0]
    return np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


@njit(cache=True, nogil=True)
def _facing(faces: I32, inside: Bool, normal: F64, middle: F64, T: F64) -> I64:
    """The triangles whose corners are all ``inside`` (V,) and that face the camera."""
    rows: I64 = np.empty(len(faces), np.int64)
    count = 0
    for f in range(len(faces)):
        if not (inside[faces[f, 0]] and inside[faces[f, 1]] and inside[faces[f, 2]]):
            continue
        facing = squared = 0.0
        for k in range(3):
            towards = T[k, 3] - middle[f, k]
            facing += normal[f, k] * towards
            squared += towards**2
        if facing > MIN_COSINE * np.sqrt(squared):
            rows[count] = f
            count += 1
    return rows[:count]


@njit(cache=True, nogil=True)
def _see(
    rows: I64, places: F64, normal: F64, middle: F64, bgra: U8, K: F64, T: F64, number: int,
    view: I32, px: F32, bgr: F32,
) -> None:  # fmt: skip
    """Put sightings of triangles by a view into their rows: the mean colour of ``places`` (N, P, 2)
    by nearest pixel, where half of these have one."""
    h, w, count = bgra.shape[0], bgra.shape[1], places.shape[1]
    colour = np.empty(3)
    for n in range(len(rows)):
        f = rows[n]
        colour[:] = known = 0.0
        for k in range(count):
            if not np.isfinite(places[n, k, 0]):
                continue
            col = min(max(int(np.rint(places[n, k, 0])), 0), w - 1)
            row = min(max(int(np.rint(places[n, k, 1])), 0), h - 1)
            if bgra[row, col, 3] > 0:
                known += 1.0
                for c in range(3):
                    colour[c] += bgra[row, col, c]
        facing = ahead = 0.0
        for k in range(3):
            towards = T[k, 3] - middle[f, k]
            facing += normal[f, k] * towards
            ahead -= towards * T[k, 2]
        if 2.0 * known >= count and ahead > 0.0:
            resolution = np.float32(np.sqrt(K[0, 0] * K[1, 1] * facing / ahead**3))
            for c in range(3):
                colour[c] /= known
            insert(view[f], px[f], bgr[f], number, resolution, colour)


@njit(cache=True, nogil=True)
def insert(view: I32, px: F32, bgr: F32, number: int, resolution: float, colour: F32 | F64) -> None:
    """Put one sighting into a row, which stays sorted from fine to coarse."""
    k = slots = len(view)
    while k > 0 and (view[k - 1] < 0 or px[k - 1] < resolution):
        k -= 1
    if k == slots:
        return
    for j in range(slots - 1, k, -1):
        view[j], px[j] = view[j - 1], px[j - 1]
        for c in range(3):
            bgr[j, c] = bgr[j - 1, c]
    view[k], px[k] = number, resolution
    for c in range(3):
        bgr[k, c] = colour[c]
