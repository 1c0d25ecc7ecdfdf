"""``skyrelief site compare``: what changed between two scans: map, polygons, volumes, page."""

from __future__ import annotations

import base64
import datetime as dt
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from recon.posegraph.submap_loops import points_of
from recon.surface.change import (
    Body,
    Change,
    change_between,
    mean_surface,
    of_tile,
    outlines,
    volumes,
)
from recon.surface.raster import Grid, Raster, fill_holes, grid_over, hillshade
from recon.surface.walls import Wall, walls_moved
from recon.types import F32, F64, U8, Bool, DepthMap
from service.errors import InputError
from service.georeference import LocalFrame
from service.offline.exports.rasters import NODATA_M, Layers, mosaic, over, put, window_in
from service.offline.exports.view import ExportOptions, ScanView
from service.offline.geopackage import points, polygons, write_layers
from service.offline.site.alignment import AlignedSite, align_site
from service.offline.site.gather import Member, Part
from service.offline.tiles import TILE_POINTS, Tile, grown, run_tiles
from service.progress import Progress
from service.scans.folder import write_deliverables
from service.scans.fused_cloud import fused_cloud, placed
from service.scans.track import local_frame
from service.scans.writing import writing
from service.stream import codec
from service.stream.database import Database
from service.stream.store import ScanStore

CHANGE_TIF, CHANGE_GPKG = "change.tif", "change.gpkg"
CHANGE_JSON, CHANGE_PAGE = "change.json", "change.html"
HOLE_CELLS = 2
"""Voxels and cells of one size leave lines of cells without a point."""

ADDED, REMOVED = (40, 90, 230), (220, 120, 30)  # BGR


MARGIN_M = 40.0
"""Around a tile: bending is a mean over 10 m (1 sigma); a smaller object is measured whole."""

PAGE_PX = 1400
WALL_COLUMNS = ("moved_m", "sigma_m", "towards_deg", "area_m2")


@dataclass(frozen=True, slots=True)
class ChangeJob:
    """One tile of a comparison, in plain values."""

    tile: Tile
    parts: tuple[tuple[int, int], tuple[int, int]]  # first and last keyframe of both dates
    voxels_m: tuple[float | None, ...]
    cell_m: float | None
    whole: Grid | None  # of all tiles; None: this is the only one
    alignment_m: float  # sigma, horizontal


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """One changed object."""

    body: Body
    about: dict[str, Any]
    rings: list[list[F64]]  # polygons on the map
    grid: Grid  # around it
    cells: Bool


@dataclass(frozen=True, slots=True, eq=False)
class ChangePart:
    """What changed on one tile."""

    layers: Layers
    objects: list[Found]
    walls: list[Wall] | None  # None: py4dgeo is not installed
    pictures: tuple[U8, U8]  # BGR, before and after
    compared_m2: float
    alignment_m: float


def compare(
    before: Path,
    after: Path,
    out: Path,
    cell_m: float | None = None,
    tile_points: int = TILE_POINTS,
    scheduler: str | None = None,
) -> dict[str, Any]:
    """Align two scans in the folder ``out``, and write what changed from one to the other.

    Returns the content of change.json. Raises InputError for scans that are one flight, that no
    tie joins, or that share no ground.
    """
    site = align_site([before, after], out, deliver=False)
    one, two = _pair(site, before, after)
    pair = site.members[one], site.members[two]
    with ScanView(out) as view:
        view.needs_place("a comparison")
        parts = ((pair[0].first, pair[0].last), (pair[1].first, pair[1].last))
        apart = _apart_m(site, one, two)
        found = changes(view, out, parts, apart, cell_m, tile_points, scheduler)
        if found is None:
            raise InputError(f"{before} and {after} share no ground")
        document = _document(site, found, one, two)
        _write_polygons(view, out / CHANGE_GPKG, found)
        with writing(out / CHANGE_PAGE) as part:
            part.write_text(page(document, found), encoding="utf-8")
        with writing(out / CHANGE_JSON) as part:
            part.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    hide_changed(out / "scan.db", site.members[one], out / CHANGE_TIF)
    with ScanStore.open(out / "scan.db") as store:
        store.update_header(notes=(*store.header.notes, document["in_words"]))
        write_deliverables(out, store, {})
    return document


@dataclass(frozen=True, slots=True, eq=False)
class Changes:
    """What changed on all tiles, but for the map, which is in its file."""

    objects: list[Found]
    walls: list[Wall] | None
    pictures: tuple[U8, U8]
    cell_m: float
    compared_m2: float
    alignment_m: float  # largest of the tiles


def changes(
    view: ScanView,
    out: Path,
    parts: tuple[tuple[int, int], tuple[int, int]],
    alignment_m: float,
    cell_m: float | None = None,
    tile_points: int = TILE_POINTS,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> Changes | None:
    """Compare two dates of a site, ``parts`` of its keyframes, and write change.tif into ``out``.

    ``alignment_m`` is what the two are misaligned by (1 sigma). None where they share no ground.
    """
    cut = view.tiling(ExportOptions(tile_points=tile_points), MARGIN_M)
    whole: Grid | None = None
    voxels: tuple[float | None, ...] = (None, None)
    if len(cut.tiles) > 1:
        usual = [
            float(np.median([p.sample_m for p in cut.prints if a <= p.seq <= b] or [cut.sample_m]))
            for a, b in parts
        ]
        voxels, whole = tuple(usual), over(grown(cut.bounds, 2.0), cell_m or max(usual))
    jobs = [ChangeJob(tile, parts, voxels, cell_m, whole, alignment_m) for tile in cut.tiles]
    made = run_tiles(change_tile, jobs, scheduler, progress or Progress())
    compared = (part for part in made if part is not None)
    first = next(compared, None)
    if first is None:
        return None
    grid = whole or first.layers.grid
    blank: U8 = np.full((*_page_shape(grid), 3), 255, np.uint8)
    pictures = blank, blank.copy()
    objects: list[Found] = []
    walls: list[Wall] | None = []
    area, alignment = 0.0, 0.0
    with mosaic(view, out / CHANGE_TIF, grid, first.layers) as image:
        for part in chain([first], compared):
            put(image, part.layers)
            rows, cols = _page_place(part.layers.grid, grid)
            for canvas, picture in zip(pictures, part.pictures, strict=True):
                canvas[rows, cols] = picture
            area, alignment = area + part.compared_m2, max(alignment, part.alignment_m)
            objects += part.objects
            walls = None if walls is None or part.walls is None else [*walls, *part.walls]
        objects = _numbered(image, objects)
    for picture in pictures:
        _outline(picture, objects, grid)
    return Changes(objects, walls, pictures, grid.cell_m, area, alignment) if area else None


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


def change_tile(job: ChangeJob, progress: Progress | None = None) -> ChangePart | None:
    """What changed on one tile; None where it has no ground of both dates."""
    with ScanView(Path(job.tile.folder), None, progress, job.tile) as view:
        made = surfaces(view, job)
        if made is None:
            return None
        both, clouds, voxel_m = made
        site_m2 = None
        if job.whole is not None:
            site_m2 = float(np.prod(job.whole.shape)) * job.whole.cell_m**2
        change = change_between(*both, ground_m2=site_m2)
    grid = change.grid
    rows, cols = grid.window(job.tile.box)
    if rows.start >= rows.stop or cols.start >= cols.stop:
        return None
    if job.whole is not None:
        change = of_tile(change, rows, cols, int(MARGIN_M / grid.cell_m))
    ground_m2 = site_m2 or change.compared_m2
    walls = _walls(clouds, change, voxel_m, job, ground_m2)
    known = np.isfinite(change.height_m)
    flat = np.zeros(grid.shape, np.float32)
    bands = np.stack(
        [np.where(known, x, NODATA_M) for x in (change.height_m, change.sigma_m, flat)]
    )
    names = ("after less before, m", "sigma, m", "object")
    layers = Layers(grid, bands.astype(np.float32), names, NODATA_M).within(job.tile.box)
    place = _page_place(layers.grid, job.whole or layers.grid)
    size = (place[1].stop - place[1].start, place[0].stop - place[0].start)
    one, two = (drawn(raster, rows, cols, size) for raster in both)
    return ChangePart(
        layers, [_found(change, body, known) for body in change.bodies], walls, (one, two),
        float(known[rows, cols].sum()) * grid.cell_m**2, change.alignment_m,
    )  # fmt: skip


def _walls(
    clouds: tuple[tuple[F64, F32], tuple[F64, F32]], change: Change, voxel_m: float,
    job: ChangeJob, ground_m2: float,
) -> list[Wall] | None:  # fmt: skip
    """The walls of the tile that moved, where both dates know the ground; None without py4dgeo."""
    try:
        moved = walls_moved(*clouds, change.grid, voxel_m, job.alignment_m, ground_m2)
    except ImportError:
        return None
    west, south, east, north = job.tile.box
    known = np.isfinite(change.height_m)
    return [
        wall for wall in moved
        if west <= wall.east_m < east and south <= wall.north_m < north
        and known[change.grid.cells(np.array([[wall.east_m, wall.north_m]]))].all()
    ]  # fmt: skip


def _apart_m(site: AlignedSite, one: int, two: int) -> float:
    """Median distance of the ties between the two scans after the alignment, 0 without any."""
    names = {site.members[one].name, site.members[two].name}
    return max((p["apart_after_m"] for p in site.document["pairs"] if {p["a"], p["b"]} == names),
               default=0.0)  # fmt: skip


def _found(change: Change, body: Body, known: Bool) -> Found:
    r, c = np.nonzero(change.labels == body.label)
    rows, cols = (slice(int(x.min()), int(x.max()) + 1) for x in (r, c))
    cells = (change.labels[rows, cols] == body.label) & known[rows, cols]
    return Found(
        body, _object(change, body), outlines(change, body.label),
        change.grid.part(rows, cols), cells,
    )  # fmt: skip


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
    view: ScanView, job: ChangeJob
) -> tuple[tuple[Raster, Raster], tuple[tuple[F64, F32], tuple[F64, F32]], float] | None:
    """The mean surface of both dates in the site, on one grid of its CRS, their points with their
    sigmas, and the size of their voxels; None without points."""
    box = job.tile.wide
    clouds = [
        fused_cloud(Part(view.store, seqs), voxel, view.progress, box)
        for seqs, voxel in zip(job.parts, job.voxels_m, strict=True)
    ]
    if not all(len(fused.cloud) for fused in clouds):
        return None
    places = [placed(fused.cloud, view.frame) for fused in clouds]
    cell = job.cell_m or max(fused.voxel_m for fused in clouds)
    try:
        grid = grid_over(np.vstack([p[:, :2] for p in places]), cell, margin_cells=1)
    except ValueError as error:
        raise InputError(f"{view.folder}: {error} with --cell-m") from error
    one, two = (
        fill_holes(mean_surface(xyz, fused.cloud.rgb, fused.cloud.sigma_m, grid), HOLE_CELLS)
        for xyz, fused in zip(places, clouds, strict=True)
    )
    seen = (places[0], clouds[0].cloud.sigma_m), (places[1], clouds[1].cloud.sigma_m)
    return (one, two), seen, max(fused.voxel_m for fused in clouds)


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
    database.write([("DELETE FROM chunks WHERE seq = ?", (seq,)) for seq in layers])
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
    """The content of change.json."""
    found = volumes([each.body for each in change.objects], change.alignment_m)
    before, after = site.members[one], site.members[two]
    count = len(change.objects)
    net, sigma = found.net
    words = (
        f"Change {before.name} to {after.name}: {count} object(s) on "
        f"{change.compared_m2:.0f} m2; cut {found.cut[0]:.1f}, fill {found.fill[0]:.1f}, "
        f"net {net:+.1f} +- {1.96 * sigma:.1f} m3 (95 %)"
    )
    notes = list(site.document["notes"])
    if change.walls is None:
        notes.append("walls are not compared: pip install 'skyrelief[walls]'")
    elif change.walls:
        words += f"; {len(change.walls)} wall(s) moved"
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
        "walls": [_wall(wall) for wall in change.walls or ()],
        "in_words": words,
        "notes": notes,
    }


def _dated(member: Member) -> dict[str, Any]:
    when = dt.datetime.fromtimestamp(member.header.started_unix_ns / 1e9, dt.timezone.utc)
    return {"scan": member.name, "started": when.isoformat(timespec="seconds")}


def _object(change: Change, body: Body) -> dict[str, Any]:
    rows, cols = np.nonzero(change.labels == body.label)
    grid = change.grid
    return {
        "kind": "added" if body.volume_m3 > 0 else "removed",
        "east_m": round(grid.west_m + (float(cols.mean()) + 0.5) * grid.cell_m, 2),
        "north_m": round(grid.north_m - (float(rows.mean()) + 0.5) * grid.cell_m, 2),
        "area_m2": round(body.area_m2, 2),
        "volume_m3": round(body.volume_m3, 3),
        "sigma_m3": round(body.sigma_m3, 3),
        "mean_m": round(body.mean_m, 3),
        "peak_m": round(body.peak_m, 3),
    }


def _wall(wall: Wall) -> dict[str, Any]:
    return {
        "east_m": round(wall.east_m, 2),
        "north_m": round(wall.north_m, 2),
        "moved_m": round(wall.moved_m, 3),
        "sigma_m": round(wall.sigma_m, 3),
        "towards_deg": round(wall.towards_deg, 1),
        "area_m2": round(wall.area_m2, 2),
    }


def _write_polygons(view: ScanView, path: Path, change: Changes) -> None:
    names = ("kind", "area_m2", "volume_m3", "sigma_m3", "mean_m", "peak_m")
    shapes = [each.rings for each in change.objects]
    columns = {name: [each.about[name] for each in change.objects] for name in names}
    layers = [polygons("changes", shapes, columns)]
    if change.walls:
        rows = [_wall(wall) for wall in change.walls]
        about = {name: [row[name] for row in rows] for name in WALL_COLUMNS}
        places = np.array([[wall.east_m, wall.north_m] for wall in change.walls])
        layers.append(points("walls", places, about))
    write_layers(path, view.needs_place("a GeoPackage").epsg, layers)


# ---- page --------------------------------------------------------------------------------------

PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title>
<meta name="viewport" content="width=device-width">
<style>body{{font:15px/1.5 system-ui,sans-serif;margin:1.5em;max-width:70em}}
#map{{position:relative;line-height:0;width:1000px}}img{{width:1000px}}
#over{{position:absolute;left:0;top:0;height:100%;width:50%;min-width:2em;max-width:100%;
overflow:hidden;resize:horizontal;border-right:3px solid #fff;box-shadow:1px 0 3px #000}}
td,th{{padding:.1em .8em;text-align:right}}</style>
<h1>{title}</h1><p>{words}</p>
<p>Left: {before}. Right: {after}. Red: added; blue: removed. Drag the corner at the lower
end of the white line.</p>
<div id="map"><img alt="after" src="{two}"><div id="over"><img alt="before" src="{one}"></div></div>
<table><tr><th>object<th>kind<th>area, m2<th>volume, m3<th>95 %, m3<th>highest, m</tr>{rows}</table>
{notes}</html>
"""


def page(document: dict[str, Any], change: Changes) -> str:
    """A page without scripts, as the portal allows none: both dates under a slider, the objects."""
    from html import escape

    rows = "".join(
        f"<tr><td>{n}<td>{one['kind']}<td>{one['area_m2']:.1f}<td>{one['volume_m3']:+.2f}"
        f"<td>{1.96 * one['sigma_m3']:.2f}<td>{one['peak_m']:+.2f}</tr>"
        for n, one in enumerate(document["objects"], 1)
    )
    return PAGE.format(
        title=escape(f"Change {document['before']['scan']} to {document['after']['scan']}"),
        words=escape(document["in_words"]),
        before=escape(document["before"]["started"]),
        after=escape(document["after"]["started"]),
        one=_embedded(change.pictures[0]),
        two=_embedded(change.pictures[1]),
        rows=rows,
        notes="".join(f"<p>{escape(note)}</p>" for note in document["notes"]),
    )


def _embedded(image: U8) -> str:
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()
    return "data:image/jpeg;base64," + base64.b64encode(data).decode()


def drawn(raster: Raster, rows: slice, cols: slice, size: tuple[int, int]) -> U8:
    """(h, w, 3) BGR of some cells of a surface in its colours and relief; ``size`` is (w, h)."""
    shade = np.nan_to_num(hillshade(raster.height_m, raster.grid.cell_m), nan=1.0)
    image = raster.rgb[..., ::-1] * (0.4 + 0.8 * shade[..., None])
    image[~raster.known] = 255
    part = np.clip(image[rows, cols], 0, 255).astype(np.uint8)
    if not all(size):
        return np.zeros((size[1], size[0], 3), np.uint8)
    return np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_LINEAR), np.uint8)


def _page_shape(whole: Grid) -> tuple[int, int]:
    """Rows and columns of the page's picture of a grid."""
    return max(1, round(whole.shape[0] * PAGE_PX / whole.shape[1])), PAGE_PX


def _page_place(part: Grid, whole: Grid) -> tuple[slice, slice]:
    """Rows and columns of a part of a grid in the page's picture."""
    zoom = PAGE_PX / whole.shape[1]
    starts = (
        (whole.north_m - part.north_m) / whole.cell_m,
        (part.west_m - whole.west_m) / whole.cell_m,
    )
    ends = [
        (min(max(round(start * zoom), 0), limit), min(round((start + count) * zoom), limit))
        for start, count, limit in zip(starts, part.shape, _page_shape(whole), strict=True)
    ]
    return slice(*ends[0]), slice(*ends[1])


def _outline(picture: U8, objects: Sequence[Found], whole: Grid) -> None:
    """Draw the outlines of the objects into the page's picture."""
    zoom = PAGE_PX / whole.shape[1]
    for one in objects:
        colour = ADDED if one.body.volume_m3 > 0 else REMOVED
        for rings in one.rings:
            for ring in rings:
                at: Any = np.rint((whole.pixels(ring) + 0.5) * zoom).astype(np.int32)
                cv2.polylines(picture, [at], True, colour, 2, cv2.LINE_AA)
