"""The textured mesh of a scan as binary glTF, as 3D Tiles 1.1 of it, or as OBJ in its UTM zone."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TextIO

import cv2
import numpy as np

from recon.surface.meshing import Mesh, coarser, cut
from recon.surface.raster import grid_over, rasterise
from recon.surface.texture_views import TextureView, doubled_area, ray_scene
from recon.surface.texturing import texture
from recon.surface.volume import volume_mesh
from recon.types import F64, U8
from service.georeference import LocalFrame, map_crs
from service.offline.exports.images import images_key, opened, recording_for, shared_images
from service.offline.exports.view import ExportOptions, ScanView, in_parts
from service.packages import needing
from service.progress import Progress
from service.scans.fused_cloud import Box
from service.scans.main_piece import main_keyframes
from service.scans.writing import writing, writing_folder

log = logging.getLogger(__name__)

LARGEST_ATLAS_PX = 8192
MIN_FACES, MIN_TEXTURE_PX = 500, 256
TILED_ATLAS_PX = 4096
MARGIN_M = 5.0
"""About a tile's mesh, which is then cut exactly at the tile's borders."""

TEXTURE_STEPS = 15
"""Reports of :func:`recon.surface.texturing.texture`."""

COARSER_FACES, COARSER_TEXTURE, LEVELS = 8, 4, 3
"""From one level of detail to the next: triangles, and texels along a side."""

VIEWER_ERROR_PX = 16.0
"""Viewers take finer tiles where an error spans so many pixels (CesiumJS's default); texels are to
span one."""


LARGEST_FACES = 400_000

FINE_CELLS, VOXEL_SAMPLES = 500_000, 1.4
"""Voxels are as large as the ground sample distance, over more cells of it up to so many times as
large: that takes half the time and memory for nearly the same surface."""


def write_glb(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """The mesh that ``skyrelief mesh`` makes by default."""
    write_mesh(scan, out, LARGEST_FACES, options)


def write_mesh(
    scan: ScanView, out: Path, largest_faces: int, options: ExportOptions
) -> dict[str, Any]:
    """Mesh and texture the scan, and write it in local ENU metres; figures of the mesh.

    Raises what :func:`mesh_parts` raises.
    """
    parts, figures = mesh_parts(scan, largest_faces, options)
    scan.progress(f"writing {figures['faces']} triangles")
    source = "store" if figures["pictures"] == "store" else "video"
    with writing(out) as part:
        extras = mesh_extras(scan) | figures | {"pictures": source}
        part.write_bytes(glb([(p.mesh, p.image) for p in parts], extras))
    return figures


def mesh_parts(
    scan: ScanView, largest_faces: int, options: ExportOptions, levels: int = 1
) -> tuple[list[TilePart], dict[str, Any]]:
    """The textured tiles of the scan's mesh in ENU metres with ``levels`` of detail, and their
    figures; made once.

    Raises InputError when there is too little surface or the video does not fit, OutsideError when
    a cluster was named and does not answer.
    """
    key = ("mesh", largest_faces, options.voxel_m, images_key(options), levels)
    return scan.shared(key, lambda: _mesh_parts(scan, largest_faces, options, levels))


def _mesh_parts(
    scan: ScanView, largest_faces: int, options: ExportOptions, levels: int
) -> tuple[list[TilePart], dict[str, Any]]:
    with needing("a mesh file"):
        import fast_simplification  # noqa: F401  # before the long work, not after it
        import open3d  # noqa: F401
        import trimesh  # noqa: F401
    if options.video is not None:
        opened(scan.store.header, options.video).close()  # refused before the work
    count = len(scan.tiling(options, MARGIN_M, on_map=False).tiles)
    make = partial(
        mesh_part,
        largest_faces=max(1000, largest_faces // count),
        largest_px=LARGEST_ATLAS_PX if count == 1 else TILED_ATLAS_PX,
        levels=levels,
    )
    nothing = "cannot be meshed, there is too little surface"
    parts = list(in_parts(scan, make, options, MARGIN_M, on_map=False, nothing=nothing))
    video = recording_for(scan, options).path
    figures = {
        "tiles": len(parts),
        "faces": sum(p.figures["faces"] for p in parts),
        "vertices": sum(p.figures["vertices"] for p in parts),
        "seen": _share("seen", parts),
        "measured": _share("measured", parts),
        "pictures": "store" if video is None else str(video),
        "texture_px": [p.figures["texture_px"] for p in parts],
    }
    return parts, figures


def _share(name: str, parts: Sequence[TilePart]) -> float:
    """Of all triangles."""
    weights = [p.figures["faces"] for p in parts]
    return float(np.average([p.figures[name] for p in parts], weights=weights))


@dataclass(frozen=True, slots=True, eq=False)
class TilePart:
    """A tile's mesh and texture, and what it was made of."""

    mesh: Mesh
    image: U8
    figures: dict[str, Any]
    coarser: tuple[TilePart, ...] = ()  # the same surface in less detail
    error_m: float = 0.0  # of the surface in less detail


def mesh_part(
    scan: ScanView,
    options: ExportOptions,
    box: Box,
    largest_faces: int,
    largest_px: int,
    levels: int = 1,
) -> TilePart | None:
    """The textured mesh in a box of ENU metres; None when there is too little surface in it."""
    progress = scan.progress
    try:
        mesh = cut(closed_surface(scan, largest_faces), box)
    except ValueError as error:
        log.debug("tile %s: %s", box, error)
        return None
    if not len(mesh.faces):
        return None
    with progress.part(f"{len(mesh.faces)} triangles; reading images", 0.25):
        views = shared_images(scan, options)

    def made() -> TilePart:
        with progress.part("texture", 0.8):
            return _textured(mesh, views, largest_px, progress)

    part = scan.shared(("textured mesh", largest_faces, images_key(options)), made)
    coarse = []
    for n in range(1, levels):
        with progress.part("less detail"):
            few = coarser(mesh, max(MIN_FACES, len(mesh.faces) // COARSER_FACES**n))
            px = max(MIN_TEXTURE_PX, max(part.image.shape) // COARSER_TEXTURE**n)
            level = _textured(few, views, px, progress)
            coarse.append(replace(level, error_m=_error(mesh, level)))
    return replace(part, coarser=tuple(coarse))


def _textured(
    mesh: Mesh, views: Sequence[TextureView], largest_px: int, progress: Progress
) -> TilePart:
    done = texture(mesh, views, largest_px, progress.counting(TEXTURE_STEPS))
    figures = {
        "faces": len(done.mesh.faces),
        "vertices": len(done.mesh.vertices_m),
        "seen": round(done.seen_share, 4),
        "measured": round(float(mesh.measured.mean()), 4) if mesh.measured is not None else 1.0,
        "views": done.views_used,
        "charts": done.charts,
        "texture_px": [done.image.shape[1], done.image.shape[0]],
    }
    return TilePart(done.mesh, done.image, figures)


def _error(fine: Mesh, level: TilePart) -> float:
    """What a level of detail is off by, in metres of a viewer's screen error: the distance of 95 %
    of the finest level's vertices, or its texels."""
    mesh = level.mesh
    places: Any = fine.vertices_m.astype(np.float32)
    off_m = ray_scene(mesh.vertices_m, mesh.faces).compute_distance(places).numpy()
    assert mesh.uv is not None
    corners = mesh.vertices_m[mesh.faces]
    uv = mesh.uv[mesh.faces].astype(np.float64) * level.image.shape[1::-1]
    area_m2 = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    texel_m = float(np.sqrt(area_m2.sum() / max(doubled_area(uv).sum(), 1e-9)))
    return max(float(np.quantile(off_m, 0.95)), VIEWER_ERROR_PX * texel_m)


def closed_surface(scan: ScanView, largest_faces: int) -> Mesh:
    """The untextured mesh, with colours at its vertices; made once.

    Raises ValueError when there is too little surface.
    """

    def made() -> Mesh:
        fused, keyframes = scan.fused, main_keyframes(scan.store)
        with scan.progress.part("surface", 0.3):
            xy_m = fused.cloud.xyz_m[:, :2].astype(np.float64)
            grid = grid_over(xy_m, fused.voxel_m, margin_cells=1)
            larger = float(np.clip(np.sqrt(np.prod(grid.shape) / FINE_CELLS), 1.0, VOXEL_SAMPLES))
            raster = rasterise(fused.cloud, grid_over(xy_m, larger * fused.voxel_m, margin_cells=1))
            depths = (k.depth for k in keyframes)
            return volume_mesh(depths, raster, largest_faces, scan.progress)

    return scan.shared(("closed surface", largest_faces), made)


def mesh_extras(scan: ScanView) -> dict[str, Any]:
    """The mesh's origin: x is east, y up, -z north of it."""
    frame = scan.frame
    if frame is None:
        return {"scan": scan.store.header.scan_id, "origin": None}
    origin = [frame.lat_deg, frame.lon_deg, frame.alt_amsl_m]
    return {"scan": scan.store.header.scan_id, "origin_lat_lon_amsl": origin}


LARGEST_TEXTURE_PX = 8192
CLAMP_TO_EDGE, TRILINEAR = 33071, 9987
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963


def glb(parts: Sequence[tuple[Mesh, U8 | None]], extras: dict[str, Any]) -> bytes:
    """The file's bytes: one mesh per part, each with its image.

    An image is (h, w, 3) RGB for the mesh's uv; without one its rgb is used. glTF has y up:
    x stays east, y is up, z is south. ``extras`` go into the asset.
    """
    with needing("a mesh file"):
        import trimesh
        from trimesh.exchange.gltf import export_glb
    scene = trimesh.Scene()
    textures: list[U8 | None] = []
    for number, (mesh, image) in enumerate(parts):
        textures.append(image if mesh.uv is not None else None)
        scene.add_geometry(_geometry(mesh, textures[-1] is not None), f"surface {number}")

    def add_textures(buffers: Any, tree: dict[str, Any]) -> None:
        tree["materials"] = []
        for number, image in enumerate(textures):
            tree["meshes"][number]["primitives"][0]["material"] = number
            surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
            if image is not None:
                tree["images"].append({"bufferView": len(buffers), "mimeType": "image/jpeg"})
                buffers[f"image {number}"] = _jpeg(image)
                surface["baseColorTexture"] = {"index": len(tree["textures"])}
                tree["textures"].append({"source": len(tree["images"]) - 1, "sampler": 0})
            # Unlit and double-sided: the image's colours are shown from both sides.
            unlit: dict[str, Any] = {"KHR_materials_unlit": {}}
            material = {"pbrMetallicRoughness": surface, "extensions": unlit, "doubleSided": True}
            tree["materials"].append(material)
        if tree["textures"]:
            wrap = {"wrapS": CLAMP_TO_EDGE, "wrapT": CLAMP_TO_EDGE}
            tree["samplers"] = [wrap | {"minFilter": TRILINEAR}]
        tree["extensionsUsed"] = ["KHR_materials_unlit"]
        tree["asset"] |= {"generator": "skyrelief", "extras": extras}

    hooks = {"buffer_postprocessor": add_textures, "tree_postprocessor": _name_uses}
    return bytes(export_glb(scene, include_normals=False, **hooks))


def _name_uses(tree: dict[str, Any]) -> None:
    """Mark each view of the buffer that holds vertices or their numbers."""
    accessors, views = tree["accessors"], tree["bufferViews"]
    for mesh in tree["meshes"]:
        for one in mesh["primitives"]:
            for accessor in one["attributes"].values():
                views[accessors[accessor]["bufferView"]]["target"] = ARRAY_BUFFER
            views[accessors[one["indices"]]["bufferView"]]["target"] = ELEMENT_ARRAY_BUFFER


def _geometry(mesh: Mesh, textured: bool) -> Any:
    """The mesh in glTF's axes with uv, or else colours, at its vertices."""
    from trimesh import Trimesh
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    xyz = mesh.vertices_m[:, [0, 2, 1]] * np.array([1.0, 1.0, -1.0])
    made: Any = Trimesh(xyz, mesh.faces, process=False)
    if mesh.measured is not None:
        made.vertex_attributes["_MEASURED"] = mesh.measured.astype(np.float32)
    if textured and mesh.uv is not None:
        uv = mesh.uv.astype(np.float64)
        uv[:, 1] = 1.0 - uv[:, 1]  # trimesh counts v upwards
        made.visual = TextureVisuals(uv, material=PBRMaterial())
    elif mesh.rgb is not None:
        opaque = np.full(len(mesh.rgb), 255, np.uint8)
        made.visual.vertex_colors = np.column_stack([_linear(mesh.rgb), opaque])
    return made


def _linear(rgb: U8) -> U8:
    """Vertex colours are linear in glTF; images are sRGB (IEC 61966-2-1)."""
    s = np.arange(256) / 255.0
    table = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    return np.asarray(np.rint(255.0 * table).astype(np.uint8)[rgb])


def _jpeg(rgb: U8) -> bytes:
    """The texture as JPEG, at most LARGEST_TEXTURE_PX a side, padded to whole words."""
    scale = LARGEST_TEXTURE_PX / max(rgb.shape[:2])
    if scale < 1.0:
        size = (round(rgb.shape[1] * scale), round(rgb.shape[0] * scale))
        rgb = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
    # Charts lie beside each other by chance: with fewer colours than texels they would mix.
    whole = cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444
    _, data = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92, *whole])
    return data.tobytes() + b"\0" * (-data.size % 4)


SPAN_M = 1000.0


def write_mesh_tiles(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """A folder with ``tileset.json`` and a glTF for each tile's level of detail; heights are AMSL
    metres."""
    frame = scan.needs_place("3D Tiles")
    parts, _ = mesh_parts(scan, LARGEST_FACES, options, LEVELS)
    whole = _box([level for part in parts for level in (part, *part.coarser)])
    size_m = float(np.linalg.norm(np.array(whole[3:]).reshape(3, 3).sum(axis=0)))
    with writing_folder(out) as folder:
        children = []
        for number, part in enumerate(parts):
            box, error_m = _box((part, *part.coarser)), 0.0
            below: list[dict[str, Any]] = []
            for level, one in enumerate((part, *part.coarser)):
                name = f"{number}-{level}.glb"
                (folder / name).write_bytes(glb([(one.mesh, one.image)], mesh_extras(scan)))
                error_m = min(max(error_m, one.error_m), size_m)
                tile = _tile(box, error_m) | {"content": {"uri": name}}
                below = [tile | ({"children": below} if below else {})]
            children += below
        transform = on_globe(frame).T.ravel().tolist()  # column by column
        root = _tile(whole, size_m) | {"transform": transform, "children": children}
        tileset = {"asset": {"version": "1.1"}, "geometricError": 2.0 * size_m, "root": root}
        (folder / "tileset.json").write_text(json.dumps(tileset, indent=1), encoding="utf-8")


def _tile(box: list[float], error_m: float) -> dict[str, Any]:
    return {"boundingVolume": {"box": box}, "geometricError": error_m, "refine": "REPLACE"}


def _box(parts: Sequence[TilePart]) -> list[float]:
    """Middle and the three half axes of the box around the parts' vertices."""
    low = np.min([p.mesh.vertices_m.min(axis=0) for p in parts], axis=0)
    high = np.max([p.mesh.vertices_m.max(axis=0) for p in parts], axis=0)
    half = np.maximum(0.5 * (high - low), 1e-3)
    return [float(v) for v in (*(0.5 * (low + high)), *np.diag(half).ravel())]


def on_globe(frame: LocalFrame) -> F64:
    """(4, 4) ENU metres to earth-centred metres, with AMSL heights taken as ellipsoidal."""
    from pyproj import Transformer

    geodetic = frame.to_geodetic(np.vstack([np.zeros(3), SPAN_M * np.eye(3)]))
    to_centre = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    placed = np.column_stack(to_centre.transform(geodetic[:, 1], geodetic[:, 0], geodetic[:, 2]))
    out = np.eye(4)
    out[:3, :3] = (placed[1:] - placed[0]).T / SPAN_M
    out[:3, 3] = placed[0]
    return out


def write_obj(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """A folder with ``mesh.obj``, its material and its JPEG textures; z is up.

    Coordinates are UTM metres and heights less the whole metres in ``mesh_offset.xyz``, because
    many readers keep single precision; ``mesh.prj`` is the coordinate system. Without a
    georeference they are ENU metres.
    """
    parts, _ = mesh_parts(scan, LARGEST_FACES, options)
    frame = scan.frame
    places = [
        p.mesh.vertices_m if frame is None else frame.to_utm(p.mesh.vertices_m) for p in parts
    ]
    offset_m = np.zeros(3) if frame is None else np.floor(places[0].min(axis=0))
    materials, first = [], 1
    with writing_folder(out) as folder:
        with open(folder / "mesh.obj", "w", encoding="ascii") as file:
            file.write("mtllib mesh.mtl\n")
            for number, (part, xyz_m) in enumerate(zip(parts, places, strict=True)):
                name = f"texture{number}"
                file.write(f"o surface{number}\nusemtl {name}\n")
                _write_object(file, part.mesh, xyz_m - offset_m, first)
                first += len(xyz_m)
                materials.append(f"newmtl {name}\nillum 0\nKd 1 1 1\nmap_Kd {name}.jpg\n")
                (folder / f"{name}.jpg").write_bytes(_jpeg(part.image))
        (folder / "mesh.mtl").write_text("".join(materials), encoding="ascii")
        offset = " ".join(f"{v:.0f}" for v in offset_m)
        (folder / "mesh_offset.xyz").write_text(offset + "\n", encoding="ascii")
        if frame is not None:
            wkt = map_crs(frame.epsg).to_wkt("WKT1_ESRI")
            (folder / "mesh.prj").write_text(wkt + "\n", encoding="ascii")


def _write_object(file: TextIO, mesh: Mesh, xyz_m: F64, first: int) -> None:
    """Vertices, texture coordinates and faces; ``first`` is the number of the first vertex."""
    assert mesh.uv is not None
    uv = np.column_stack([mesh.uv[:, 0], 1.0 - mesh.uv[:, 1]])  # v counts upwards
    np.savetxt(file, xyz_m, "v %.3f %.3f %.3f")
    np.savetxt(file, uv, "vt %.6f %.6f")
    np.savetxt(file, np.repeat(mesh.faces + first, 2, axis=1), "f %d/%d %d/%d %d/%d")
