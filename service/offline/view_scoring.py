"""How a scan looks to cameras that took no part in it: their frames, drawn from its products.

Each frame is rendered at its own pose and compared with what the camera saw: the share of pixels
that are covered, PSNR and SSIM (Wang et al. 2004, doi:10.1109/TIP.2003.819861) of these, PSNR of
those that the depth images cover too, where alone two products show the same places, and PSNR after
one gain and offset for each channel, as RawNeRF is scored (Mildenhall et al. 2022): no product
knows the exposure of a frame that took no part.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from recon import se3
from recon.camera_model import Undistorter, rays, scaled
from recon.surface.hole_filling import outlined
from recon.surface.splats import COVERED, Splats, rendered
from recon.surface.texture_views import ray_scene
from recon.tracking import pnp
from recon.tracking.sift_features import (
    FINE_MOST,
    FINE_WIDTH_PX,
    Features,
    features,
    match_features,
)
from recon.types import F32, F64, I64, U8, Bool, Camera, Keyframe
from service.cameras.images import ImagesSource
from service.errors import InputError
from service.offline.exports.images import SAME_TIME_NS, frames_at, opened
from service.offline.exports.splats import read_splats
from service.offline.exports.view import ScanView
from service.packages import needing
from service.scans.main_piece import main_keyframes
from service.scans.track import camera_of
from service.stream.records import PoseRecord

EVERY = 10
"""Of the frames that are no keyframe, the first of so many is drawn."""

NEIGHBOURS = 12
"""Keyframes that place a frame which the scan does not know."""

OWN_SHARE = 0.9
"""Share of the keyframes that a folder of stills must hold for its others to be those that took no
part: times are counted from its first one."""

MAX_SLOPE = 0.03
"""Four pixels are one surface where their depths differ by less than this share."""

LEVELS = 4
"""Rounds in which the place on the ground that a pixel looks at is found."""

GRIDS = "surface"
POINT_PX = 3
FLOOR_DB = 60.0  # PSNR of images that are the same

Draw = Callable[[F64], tuple[U8, Bool]]
"""(H, W, 3) BGR and (H, W) covered pixels of the view from a T_world_camera (4, 4)."""


@dataclass(frozen=True, slots=True, eq=False)
class Triangles:
    """What is drawn: triangles with colours at their vertices, or with a texture."""

    vertices_m: F64  # (V, 3)
    faces: I64  # (F, 3)
    bgr: F32 | None = None  # (V, 3)
    uv: F64 | None = None  # (V, 2) from the texture's lower left corner
    texture: U8 | None = None  # (h, w, 3) BGR


class FrameScore(NamedTuple):
    """What a product shows of a frame."""

    covered: float  # share of the pixels that look at the map
    psnr_db: float
    ssim: float
    psnr_on_grids_db: float  # of the pixels that the depth images cover too
    psnr_exposed_db: float  # as the frame is exposed


DIGITS = {"covered": 4, "psnr_db": 2, "ssim": 4, "psnr_on_grids_db": 2, "psnr_exposed_db": 2}


def means(scores: Mapping[str, Sequence[FrameScore]]) -> dict[str, Any]:
    """Of the frames of each product, ready for JSON, and how many they are."""
    return {
        name: {
            "frames": len(rows),
            **{
                figure: round(float(np.mean(values)), DIGITS[figure])
                for figure, values in zip(FrameScore._fields, zip(*rows, strict=True), strict=True)
            },
        }
        for name, rows in scores.items()
    }


def frame_scores(
    scan: ScanView, video: Path, images: Path | None = None, others: Mapping[str, Draw] = {},
    every: int = EVERY, goes_on: Callable[[int], bool] = lambda _: True,
) -> dict[str, list[FrameScore]]:  # fmt: skip
    """Figures of each product, and of ``others``, at every so many frames of ``video`` that took no
    part.

    ``images`` is a folder for each frame beside what was drawn of it, as PNG. ``goes_on`` is asked
    with the number of frames that are done. Raises InputError when the video is not the scan's, or
    has no such frame.
    """
    with needing("score --views"):
        import open3d  # noqa: F401
        from skimage.metrics import structural_similarity
    keyframes, camera = list(main_keyframes(scan.store)), camera_of(scan.store.header)
    products = {**_products(scan, keyframes, camera), **others}
    inside, undistort = looks_inside(scan), Undistorter(camera)
    scores: dict[str, list[FrameScore]] = {name: [] for name in products}
    for n, (T, seen) in enumerate(_seen(scan, keyframes, undistort, video, every)):
        counts = inside(camera, T) & (undistort.valid > 0)
        if counts.mean() < 0.5:
            continue
        if not goes_on(max(map(len, scores.values()))):
            break
        views = {name: draw(T) for name, draw in products.items()}
        grids = views[GRIDS][1].copy()
        for name, (drawn, covered) in views.items():
            covered &= counts
            _, likeness = structural_similarity(
                seen, np.where(covered[..., None], drawn, seen), channel_axis=2, full=True
            )
            if (covered & grids).any():
                scores[name].append(
                    FrameScore(
                        float(covered.sum() / counts.sum()),
                        psnr_db(seen, drawn, covered),
                        float(likeness[covered].mean()),
                        psnr_db(seen, drawn, covered & grids),
                        psnr_db(seen, exposed_as(seen, drawn, covered), covered),
                    )
                )
        if images is not None:
            images.mkdir(parents=True, exist_ok=True)
            row = np.hstack([seen, *(drawn for drawn, _ in views.values())])
            cv2.imwrite(str(images / f"view_{n:04d}.png"), row)
    if not any(scores.values()):
        raise InputError(f"{video}: none of its frames that took no part shows the map")
    return {name: rows for name, rows in scores.items() if rows}


def psnr_db(seen: U8, drawn: U8 | F64, where: Bool) -> float:
    """Of the pixels ``where`` (H, W) of images (H, W, 3); at most FLOOR_DB."""
    error = float(np.mean((seen[where].astype(np.float64) - drawn[where]) ** 2))
    return min(10.0 * float(np.log10(255.0**2 / max(error, 1e-9))), FLOOR_DB)


def exposed_as(seen: U8, drawn: U8, where: Bool) -> F64:
    """``drawn`` (H, W, 3) with the gain and offset of each channel that fit ``seen`` best."""
    fits = [np.polyfit(drawn[where][:, c], seen[where][:, c], 1) for c in range(3)]
    gain, offset = np.array(fits).T
    return np.asarray(np.clip(drawn * gain + offset, 0.0, 255.0))


def _seen(
    scan: ScanView, keyframes: Sequence[Keyframe], undistort: Undistorter, video: Path, every: int
) -> Iterator[tuple[F64, U8]]:
    """T_world_camera (4, 4) and image without distortion of each frame that took no part.

    Stills of a folder that the scan does not know are placed by its surface.
    """
    header, start_ns = scan.store.header, scan.store.header.started_unix_ns
    poses = left_out(scan.poses, {k.time_ns for k in keyframes}, every)
    if poses:
        times = [p.time_unix_ns for p in poses]
        for n, frame in frames_at(times, header, video, None, scan.progress):
            yield poses[n].T_world_camera, undistort.image(frame)
    known = np.array([*(k.time_ns for k in keyframes), *(p.time_unix_ns for p in scan.poses)])

    def took_part(time_ns: int) -> bool:
        return bool(np.abs(known - start_ns - time_ns).min() <= SAME_TIME_NS)

    with closing(opened(header, video)) as source:
        if not isinstance(source, ImagesSource):
            return
        own = sum(took_part(time_ns) for time_ns in source.times.values())
        if own < OWN_SHARE * len(keyframes):
            raise InputError(
                f"{video}: times of its stills do not say which took part; give the folder that "
                "was flown"
            )
        # Stills come in the order of time: the next one is near most of the same keyframes.
        shown = lru_cache(maxsize=2 * NEIGHBOURS)(keyframe_features)
        for still in source:
            if not took_part(still.time_ns):
                image, time_ns = undistort.image(still.image), start_ns + still.time_ns
                T = placed(image, time_ns, keyframes, undistort.camera, shown)
                if T is not None:
                    yield T, image


def keyframe_features(keyframe: Keyframe) -> Features:
    return _features(keyframe.bgr)


def placed(
    image: U8, time_ns: int, keyframes: Sequence[Keyframe], camera: Camera,
    features_of: Callable[[Keyframe], Features] = keyframe_features,
) -> F64 | None:  # fmt: skip
    """(4, 4) T_world_camera of ``image`` (H, W, 3), by features that it shares with keyframes where
    their depth is known; None where these are too few.

    The keyframes next to it in time say where it is, and then those that show the same ground: by
    one strip alone, whose shared ground may be a stripe at the image's edge, it errs by pixels.
    ``features_of`` gives the features of a keyframe's image.
    """
    w = min(camera.size_px[0], 2 * keyframes[0].bgr.shape[1])  # features of much finer ones differ
    small = scaled(camera, (w, round(w * camera.size_px[1] / camera.size_px[0])))
    there = _features(
        np.asarray(cv2.resize(image, small.size_px, interpolation=cv2.INTER_AREA), np.uint8)
    )
    T, apart = None, np.array([abs(k.time_ns - time_ns) for k in keyframes], np.float64)
    ahead_m = np.array([float(np.nanmedian(k.depth.depth_m)) for k in keyframes])
    poses = np.array([k.depth.T_world_camera for k in keyframes])
    for _ in range(2):
        nearest = np.argsort(apart, kind="stable")[:NEIGHBOURS]
        points, pixels = zip(
            *(_shared(keyframes[n], there, features_of) for n in nearest), strict=True
        )
        found = pnp.solve(np.concatenate(points), np.concatenate(pixels), small.K)
        if found is None:
            break
        T = se3.inverse(found.T_camera_points)
        shown = poses[:, :3, 3] + ahead_m[:, None] * poses[:, :3, 2]
        apart = np.linalg.norm(shown - T[:3, 3] - ahead_m[nearest[0]] * T[:3, 2], axis=1)
    return T


def _shared(
    keyframe: Keyframe, there: Features, features_of: Callable[[Keyframe], Features]
) -> tuple[F64, F64]:
    """(N, 3) places that a keyframe and an image both show, and (N, 2) where the image does."""
    shared = match_features(features_of(keyframe), there)
    if shared is None:
        return np.zeros((0, 3)), np.zeros((0, 2))
    depth = keyframe.depth
    u, v = np.rint(shared.uv_a).astype(int).T
    z = np.where(keyframe.fresh, depth.depth_m, np.nan)[v, u]
    known = np.isfinite(z)
    local = rays(depth.K, shared.uv_a[known]) * z[known, None]
    return se3.transform(depth.T_world_camera, local), shared.uv_b[known]


def _features(bgr: U8) -> Features:
    gray = np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY), np.uint8)
    return features(gray, FINE_WIDTH_PX, FINE_MOST, are_strongest=True)


def left_out(
    poses: Sequence[PoseRecord], used_ns: set[int], every: int = EVERY
) -> list[PoseRecord]:
    """Every so many poses of the frames that are no keyframes."""
    return [p for p in poses if p.time_unix_ns not in used_ns and p.keyframe_seq is None][::every]


def _products(scan: ScanView, keyframes: Sequence[Keyframe], camera: Camera) -> dict[str, Draw]:
    """What the scan can be drawn from: its depth images as surfaces and as points, and its mesh."""
    grids = depth_grids(keyframes)
    assert grids.bgr is not None
    places, colours = grids.vertices_m, grids.bgr
    used = np.unique(grids.faces)
    out: dict[str, Draw] = {
        "points": lambda T: draw_points(camera, T, places[used], colours[used]),
        GRIDS: by_rays(grids, camera),
    }
    mesh = scan.folder / "mesh.glb"
    if mesh.is_file():
        out["mesh"] = by_rays(read_glb(mesh), camera)
    gaussians = scan.folder / "splat.ply"
    if gaussians.is_file():
        out["splats"] = by_gaussians(read_splats(gaussians), camera)
    return out


def looks_inside(scan: ScanView) -> Callable[[Camera, F64], Bool]:
    """Which pixels of a view look into the outline of the map: at the height of the cell where they
    would meet the level of the cell before, beginning with the middle one."""
    from scipy.ndimage import distance_transform_edt

    raster = scan.raster(None)
    is_inside = outlined(raster.known)
    near = distance_transform_edt(~raster.known, return_distances=False, return_indices=True)
    height_m = raster.height_m[tuple(near)]
    frame = scan.frame

    def inside(camera: Camera, T: F64) -> Bool:
        w, h = camera.size_px
        ways = _pixel_rays(camera.K, w, h) @ T[:3, :3].T
        middle = T[:3, 3] if frame is None else frame.to_utm(T[None, :3, 3])[0]
        level_m = np.full(len(ways), float(np.nanmedian(raster.height_m)))
        down = np.minimum(ways[:, 2], -0.05)
        for _ in range(LEVELS):
            drop = np.where(ways[:, 2] < -0.05, (level_m - middle[2]) / down, 0.0)
            ground = T[:3, 3] + ways * drop[:, None]
            places = ground if frame is None else frame.to_utm(ground)
            on = raster.grid.holds(places[:, :2]) & (drop > 0)
            rows, cols = raster.grid.cells(np.nan_to_num(places[:, :2]))
            level_m = height_m[rows, cols].astype(np.float64)
        return (on & is_inside[rows, cols]).reshape(h, w)

    return inside


def _pixel_rays(K: F64, w: int, h: int) -> F64:
    """(h * w, 3) rays of all pixels, row by row."""
    v, u = np.mgrid[:h, :w].astype(np.float64)
    return rays(K, np.column_stack([u.ravel(), v.ravel()]))


def depth_grids(keyframes: Sequence[Keyframe]) -> Triangles:
    """Each keyframe's depth image as two triangles per four pixels of one surface."""
    vertices, faces, colours, first = [], [], [], 0
    for k in keyframes:
        z, (h, w) = k.depth.depth_m, k.depth.depth_m.shape
        known = np.nan_to_num(z.ravel()[:, None])
        places = _pixel_rays(k.depth.K, w, h) * known
        vertices.append(se3.transform(k.depth.T_world_camera, places))
        colours.append(k.bgr.reshape(-1, 3).astype(np.float32))
        four = np.stack([z[:-1, :-1], z[:-1, 1:], z[1:, :-1], z[1:, 1:]])
        good = np.isfinite(four).all(axis=0) & (np.ptp(four, axis=0) < MAX_SLOPE * four.min(axis=0))
        good &= k.fresh[:-1, :-1] | k.fresh[1:, 1:]
        at = first + np.arange(h * w).reshape(h, w)
        a, b, c, d = (one[good] for one in (at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]))
        faces += [np.column_stack([a, c, b]), np.column_stack([b, c, d])]
        first += h * w
    return Triangles(np.concatenate(vertices), np.concatenate(faces), np.concatenate(colours))


def read_glb(path: Path) -> Triangles:
    """A textured mesh in one glTF file, in metres east, north and up."""
    import trimesh

    vertices, faces, uv, first, texture = [], [], [], 0, None
    for one in trimesh.load_scene(path).geometry.values():
        shown: Any = one
        x, y, z = shown.vertices.T
        vertices.append(np.column_stack([x, -z, y]))
        faces.append(shown.faces + first)
        uv.append(shown.visual.uv)
        first += len(shown.vertices)
        texture = np.asarray(shown.visual.material.baseColorTexture)[..., 2::-1]
    if len(faces) != 1 or texture is None:
        raise InputError(
            f"{path}: views are drawn of a mesh in one tile; make it with fewer points"
        )
    return Triangles(vertices[0], faces[0], None, uv[0], np.asarray(texture, np.uint8))


def by_rays(shown: Triangles, camera: Camera) -> Draw:
    """Draws triangles by casting a ray through each pixel (Open3D, Embree)."""
    import open3d as o3d

    core: Any = o3d.core
    scene = ray_scene(shown.vertices_m, shown.faces)
    K_corner = camera.K.copy()
    K_corner[:2, 2] += 0.5  # Open3D counts from the corner of a pixel, not from its middle

    def draw(T: F64) -> tuple[U8, Bool]:
        w, h = camera.size_px
        looks = scene.create_rays_pinhole(
            core.Tensor(K_corner), core.Tensor(np.asarray(se3.inverse(T))), w, h
        )
        hit = scene.cast_rays(looks)
        covered: Bool = np.isfinite(hit["t_hit"].numpy())
        corners = shown.faces[np.where(covered, hit["primitive_ids"].numpy(), 0)]
        b, c = np.moveaxis(hit["primitive_uvs"].numpy(), -1, 0)
        weights = np.stack([1.0 - b - c, b, c], axis=-1)[..., None]
        if shown.texture is None:
            assert shown.bgr is not None
            bgr = (shown.bgr[corners] * weights).sum(axis=-2)
        else:
            assert shown.uv is not None
            rows, cols = shown.texture.shape[:2]
            at = (shown.uv[corners] * weights).sum(axis=-2) * [cols, -rows] + [-0.5, rows - 0.5]
            u, v = np.moveaxis(at.astype(np.float32), -1, 0)
            bgr = cv2.remap(shown.texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.where(covered[..., None], np.rint(bgr), 0).astype(np.uint8), covered

    return draw


def by_gaussians(splats: Splats, camera: Camera) -> Draw:
    """Draws Gaussians as viewers do, over black."""

    def view(T: F64) -> tuple[U8, Bool]:
        rgb, opacity = rendered(splats, camera.K, camera.size_px, T)
        return np.clip(np.rint(rgb[..., ::-1]), 0, 255).astype(np.uint8), opacity >= COVERED

    return view


def draw_points(camera: Camera, T: F64, xyz_m: F64, bgr: F32) -> tuple[U8, Bool]:
    """Points as squares of POINT_PX, the near over the far."""
    w, h = camera.size_px
    local = se3.transform(se3.inverse(T), xyz_m)
    ahead = np.flatnonzero(local[:, 2] > 0.1)
    ahead = ahead[np.argsort(-local[ahead, 2], kind="stable")]
    flat = local[ahead] @ camera.K.T
    u, v = np.rint(flat[:, :2] / flat[:, 2:]).T
    reach = POINT_PX // 2
    inside = (u >= reach) & (u < w - reach) & (v >= reach) & (v < h - reach)
    u, v, colour = u[inside].astype(int), v[inside].astype(int), bgr[ahead[inside]]
    out, covered = np.zeros((h, w, 3), np.uint8), np.zeros((h, w), np.bool_)
    for dv, du in product(range(-reach, reach + 1), repeat=2):
        out[v + dv, u + du], covered[v + dv, u + du] = colour, True
    return out, covered
