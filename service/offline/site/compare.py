"""``skyrelief site compare``: what changed between two scans: map, polygons, volumes, page."""

from __future__ import annotations

import datetime as dt
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from recon.surface.change import (
    Body,
    Change,
    change_between,
    level_filled,
    mean_surface,
    of_tile,
    outlines,
    volumes,
)
from recon.surface.ground import ground_cells
from recon.surface.raster import Grid, Raster
from recon.survey.submap_loops import points_of
from recon.types import F64, U8, Bool, DepthMap
from service.errors import InputError
from service.georeference import LocalFrame
from service.offline.exports.rasters import NODATA_M, Layers, mosaic, over, put, window_in
from service.offline.exports.view import HOLE_CELLS, USUAL, ExportOptions, ScanView, in_parts
from service.offline.geopackage import Layer, write_layers
from service.offline.site.alignment import AlignedSite, align_site, write_files
from service.offline.site.change_page import draw_outlines, drawn, page, place_in, shape_of
from service.offline.site.gather import Member
from service.offline.tiles import grown
from service.progress import Progress
from service.scans.fused_cloud import Box, fused_cloud, placed
from service.scans.main_piece import Piece, main_seqs
from service.scans.track import local_frame
from service.scans.writing import write_whole
from service.stream import codec
from service.stream.database import Database
from service.stream.store import ScanStore

CHANGE_TIF, CHANGE_GPKG = "change.tif", "change.gpkg"
CHANGE_JSON, CHANGE_PAGE = "change.json", "change.html"
COLUMNS = ("kind", "area_m2", "volume_m3", "sigma_m3", "mean_m", "peak_m")  # of the GeoPackage
MARGIN_M = 40.0
"""Around a tile: bending is a mean over 10 m (1 sigma); a smaller object is measured whole."""


Dates = tuple[tuple[int, int], tuple[int, int]]
"""First and last keyframe of both dates."""


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """One changed object."""

    body: Body
    about: dict[str, Any]
    rings: list[list[F64]]  # polygons on the map
    grid: Grid  # around it
    cells: Bool


@dataclass(frozen=True, slots=True, eq=False)
class Changes:
    """What changed on a tile or on all of them, but for the map."""

    objects: list[Found]
    images: tuple[U8, U8]  # BGR, before and after
    cell_m: float
    compared_m2: float
    alignment_m: float  # largest of the tiles


def compare(
    before: Path,
    after: Path,
    out: Path,
    options: ExportOptions = USUAL,
    bare: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Align two scans in the folder ``out``, and write what changed from one to the other.

    With ``bare``, objects on the ground are left out at both dates.
    Returns the content of change.json. Raises InputError for scans that are one flight, that no
    tie joins, or that share no ground.
    """
    progress = progress or Progress()
    with progress.part("aligning", 0.4):
        site = align_site([before, after], out, deliver=False, progress=progress)
    one, two = _pair(site, before, after)
    with ScanView(out, None, progress) as view:
        view.needs_place("a comparison")
        first, last = ((m.first, m.last) for m in (site.members[one], site.members[two]))
        with progress.part("comparing the surfaces", 0.7):
            found = changes(view, out, (first, last), options, bare)
        document = _document(site, found, one, two)
        columns = {name: [each.about[name] for each in found.objects] for name in COLUMNS}
        shapes = [each.rings for each in found.objects]
        layer = Layer("changes", "MULTIPOLYGON", shapes, columns)
        write_layers(out / CHANGE_GPKG, view.needs_place("a GeoPackage").epsg, [layer])
        write_whole(out / CHANGE_PAGE, page(document, found.images))
        write_whole(out / CHANGE_JSON, json.dumps(document, indent=1) + "\n")
    hide_changed(out / "scan.db", site.members[one], out / CHANGE_TIF)
    with ScanStore.open(out / "scan.db") as store:
        store.update_header(notes=(*store.header.notes, document["in_words"]))
    write_files(out, options, progress)
    return document


def changes(
    view: ScanView,
    out: Path,
    parts: Dates,
    options: ExportOptions = USUAL,
    bare: bool = False,
) -> Changes:
    """Compare two dates of a site, ``parts`` of its keyframes, and write change.tif into ``out``.

    Raises InputError where they share no ground.
    """
    cut, whole = view.tiling(options, MARGIN_M), None
    voxels_m: list[float | None] = [None, None]
    if len(cut.tiles) > 1:
        samples_m = [
            [p.ground_sample_m for p in cut.prints if a <= p.seq <= b] or [cut.sample_m]
            for a, b in parts
        ]
        usual_m = [float(np.median(one)) for one in samples_m]
        voxels_m = [*usual_m]
        whole = over(grown(cut.bounds, 2.0), options.cell_m or max(usual_m))
    make = partial(change_part, parts=parts, voxels_m=voxels_m, whole=whole, bare=bare)
    made = in_parts(view, make, options, MARGIN_M, nothing="has no ground that both dates show")
    first = next(made)
    grid = whole or first[0].grid
    blank: U8 = np.full((*shape_of(grid), 3), 255, np.uint8)
    images = blank, blank.copy()
    objects: list[Found] = []
    area, alignment = 0.0, 0.0
    with mosaic(view, out / CHANGE_TIF, grid, first[0]) as map_:
        for layers, part in chain([first], made):
            put(map_, layers)
            rows, cols = place_in(layers.grid, grid)
            for canvas, image in zip(images, part.images, strict=True):
                canvas[rows, cols] = image
            area, alignment = area + part.compared_m2, max(alignment, part.alignment_m)
            objects += part.objects
        objects = _numbered(map_, objects)
        map_.update_tags(HEIGHTS="metres, after less before")
    for image in images:
        for one in objects:
            draw_outlines(image, chain(*one.rings), one.body.volume_m3 > 0, grid)
    return Changes(objects, images, grid.cell_m, area, alignment)


def _numbered(image: Any, objects: list[Found]) -> list[Found]:
    """The objects, their numbers written into the map; of two in one place the first."""
    kept: list[Found] = []
    for one in objects:
        window = window_in(image, one.grid)
        numbers = image.read(3, window=window)
        if (numbers[one.cells] > 0).any():
            continue
        kept.append(one)
        numbers[one.cells] = len(kept)
        image.write(numbers, 3, window=window)
    return kept


def change_part(
    view: ScanView, options: ExportOptions, box: Box, parts: Dates,
    voxels_m: Sequence[float | None], whole: Grid | None, bare: bool,
) -> tuple[Layers, Changes] | None:  # fmt: skip
    """What changed in a box of the site, and its map; None where it has no ground of both dates.

    ``whole`` is the grid of all tiles, None where this is the only one; with ``bare`` only ground
    that is bare at both dates counts.
    """
    made = surfaces(view, parts, voxels_m, options.cell_m if whole is None else whole.cell_m, bare)
    if made is None:
        return None
    site_m2 = None if whole is None else float(np.prod(whole.shape)) * whole.cell_m**2
    change = change_between(*made, ground_m2=site_m2)
    grid = change.grid
    rows, cols = grid.window(box)
    if whole is not None:
        change = of_tile(change, rows, cols, int(MARGIN_M / grid.cell_m))
    known = np.isfinite(change.height_m)
    if not known[rows, cols].any():
        return None
    flat = np.zeros(grid.shape, np.float32)
    bands = np.stack(
        [np.where(known, x, NODATA_M) for x in (change.height_m, change.sigma_m, flat)]
    )
    names = ("after less before, m", "sigma, m", "object")
    layers = Layers(grid, bands.astype(np.float32), names, NODATA_M).within(box)
    place = place_in(layers.grid, whole or layers.grid)
    size = (place[1].stop - place[1].start, place[0].stop - place[0].start)
    one, two = (drawn(raster, rows, cols, size) for raster in made)
    return layers, Changes(
        [_found(change, body, known) for body in change.bodies], (one, two), grid.cell_m,
        float(known[rows, cols].sum()) * grid.cell_m**2, change.alignment_m,
    )  # fmt: skip


def _found(change: Change, body: Body, known: Bool) -> Found:
    r, c = np.nonzero(change.labels == body.label)
    rows, cols = (slice(int(x.min()), int(x.max()) + 1) for x in (r, c))
    cells = (change.labels[rows, cols] == body.label) & known[rows, cols]
    east_m, north_m = change.grid.centres(r.mean(keepdims=True), c.mean(keepdims=True))[0].tolist()
    digits = {"area_m2": 2, "volume_m3": 3, "sigma_m3": 3, "mean_m": 3, "peak_m": 3}
    about = {
        "kind": "added" if body.volume_m3 > 0 else "removed",
        "east_m": round(east_m, 2),
        "north_m": round(north_m, 2),
    } | {name: round(getattr(body, name), places) for name, places in digits.items()}
    grid = change.grid.part(rows, cols)
    return Found(body, about, outlines(change, body.label), grid, cells)


def _pair(site: AlignedSite, before: Path, after: Path) -> tuple[int, int]:
    """The two members; InputError where they cannot be compared."""
    at = {m.folder.resolve(): k for k, m in enumerate(site.members)}
    for folder in (before, after):
        if folder.resolve() not in at:
            raise InputError(f"{folder} cannot be compared: " + "; ".join(site.document["notes"]))
    one, two = at[before.resolve()], at[after.resolve()]
    if one == two:
        raise InputError(f"{before} and {after} are one scan")
    if site.alignment.groups[one] != site.alignment.groups[two]:
        raise InputError(
            f"{before} and {after} have no ties: their differences may be "
            "misalignment (little overlap, another season or light)"
        )
    return one, two


def surfaces(
    view: ScanView, parts: Dates, voxels_m: Sequence[float | None], cell_m: float | None, bare: bool
) -> tuple[Raster, Raster] | None:
    """The mean surface of both dates in the site, on one grid of its CRS; None without points."""
    seqs = main_seqs(view.store)
    clouds = [
        fused_cloud(
            Piece(view.store, [seq for seq in seqs if first <= seq <= last]),
            voxel_m,
            view.progress,
            view.box,
        )
        for (first, last), voxel_m in zip(parts, voxels_m, strict=True)
    ]
    if not all(len(fused.cloud) for fused in clouds):
        return None
    places = [placed(fused.cloud, view.frame) for fused in clouds]
    grid = view.grid_of(np.vstack(places), cell_m or max(fused.voxel_m for fused in clouds))
    one, two = (
        level_filled(mean_surface(xyz, fused.cloud.rgb, fused.cloud.sigma_m, grid), HOLE_CELLS)
        for xyz, fused in zip(places, clouds, strict=True)
    )
    return (_bare(one), _bare(two)) if bare else (one, two)


def _bare(surface: Raster) -> Raster:
    """The surface where it is bare ground."""
    ground = ground_cells(surface)
    return replace(surface, height_m=np.where(ground, surface.height_m, np.float32(np.nan)))


def hide_changed(path: Path, earlier: Member, map_: Path) -> None:
    """Take what has changed since out of the earlier scan's keyframes in the site's store.

    Otherwise the site's surface would be the mean of both dates. The scan itself keeps it.
    """
    import rasterio

    layers: dict[int, tuple[bytes, ...]] = {}
    with ScanStore.open(path, read_only=True) as store, rasterio.open(map_) as image:
        frame = local_frame(store.header)
        for seq in earlier.seqs:
            one = store.keyframe(seq)
            coded = [store.chunk(seq, n) for n in range(codec.MAX_LAYERS)]
            own = codec.decode([data for data in coded if data is not None])
            if one is None or own is None:
                continue
            hidden = _changed(one.depth, image, frame)
            if hidden.any():
                depth = replace(own.depth, depth_m=np.where(hidden, np.nan, own.depth.depth_m))
                layers[seq] = codec.encode(replace(own, depth=depth), own.time_ns)
    database = Database(path)
    sql = "DELETE FROM chunks WHERE seq = ? AND layer != ?"
    database.write([(sql, (seq, codec.IMAGE_LAYER)) for seq in layers])
    database.close()
    with ScanStore.open(path) as store:
        for seq, coded_layers in layers.items():
            store.add_keyframe(seq, coded_layers)


def _changed(depth: DepthMap, image: Any, frame: LocalFrame | None) -> Bool:
    """(h, w) pixels whose surface lies in or next to a cell of an object of the open map."""
    known = np.isfinite(depth.depth_m)
    out = np.zeros(known.shape, np.bool_)
    if not known.any():
        return out
    points, _ = points_of(depth, depth.T_world_camera)
    xy = (points if frame is None else frame.to_utm(points))[:, :2]
    whole = Grid(image.transform.c, image.transform.f, image.transform.a, image.shape)
    west, south = xy.min(axis=0) - 2.0 * whole.cell_m
    east, north = xy.max(axis=0) + 2.0 * whole.cell_m
    rows, cols = whole.window((west, south, east, north))
    if rows.start >= rows.stop or cols.start >= cols.stop:
        return out
    grid = whole.part(rows, cols)
    numbers = image.read(3, window=window_in(image, grid))
    cells = cv2.dilate((numbers > 0).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    out[known] = grid.holds(xy) & cells[grid.cells(xy)]
    return out


def _document(site: AlignedSite, change: Changes, one: int, two: int) -> dict[str, Any]:
    found = volumes([each.body for each in change.objects], change.alignment_m)
    before, after = site.members[one], site.members[two]
    count = len(change.objects)
    net, sigma = found.net
    words = (
        f"Change {before.name} to {after.name}: {count} object(s) on "
        f"{change.compared_m2:.0f} m2; cut {found.cut[0]:.1f}, fill {found.fill[0]:.1f}, "
        f"net {net:+.1f} +- {1.96 * sigma:.1f} m3 (95 %)"
    )
    return {
        "schema": 1,
        "before": _dated(before),
        "after": _dated(after),
        "cell_m": round(change.cell_m, 4),
        "compared_m2": round(change.compared_m2, 1),
        "alignment_sigma_m": round(change.alignment_m, 4),
        "volumes_m3": {
            name: {"value": round(v, 2), "sigma": round(s, 2)}
            for name, (v, s) in (("cut", found.cut), ("fill", found.fill), ("net", found.net))
        },
        "objects": [each.about for each in change.objects],
        "in_words": words,
        "notes": list(site.document["notes"]),
    }


def _dated(member: Member) -> dict[str, Any]:
    when = dt.datetime.fromtimestamp(member.header.started_unix_ns / 1e9, dt.timezone.utc)
    return {"scan": member.name, "started": when.isoformat(timespec="seconds")}
