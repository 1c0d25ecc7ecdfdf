"""``skyrelief site compare``: what changed between two scans: map, polygons, volumes, page."""

from __future__ import annotations

import base64
import datetime as dt
import json
from dataclasses import replace
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
    outlines,
    volumes,
)
from recon.surface.raster import Grid, Raster, fill_holes, grid_over, hillshade
from recon.types import F64, U8, Bool, DepthMap
from service.errors import InputError
from service.georeference import LocalFrame
from service.offline.exports.rasters import NODATA_M, write_cog
from service.offline.exports.view import ScanView
from service.offline.geopackage import write_polygons
from service.offline.site.alignment import AlignedSite, align_site
from service.offline.site.gather import Member, Part
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


def compare(before: Path, after: Path, out: Path, cell_m: float | None = None) -> dict[str, Any]:
    """Align two scans in the folder ``out``, and write what changed from one to the other.

    Returns the content of change.json. Raises InputError for scans that are one flight, that no
    tie joins, or that share no ground.
    """
    site = align_site([before, after], out, deliver=False)
    one, two = _pair(site, before, after)
    with ScanView(out) as view:
        older, newer = surfaces(view, [site.members[one], site.members[two]], cell_m)
        change = change_between(older, newer)
        if change.compared_m2 == 0.0:
            raise InputError(f"{before} and {after} share no ground")
        document = _document(site, change, one, two)
        _write_map(view, out / CHANGE_TIF, change)
        _write_polygons(view, out / CHANGE_GPKG, change)
        with writing(out / CHANGE_PAGE) as part:
            part.write_text(page(document, older, newer, change), encoding="utf-8")
        with writing(out / CHANGE_JSON) as part:
            part.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    hide_changed(out / "scan.db", site.members[one], change)
    with ScanStore.open(out / "scan.db") as store:
        store.update_header(notes=(*store.header.notes, document["in_words"]))
        write_deliverables(out, store, {})
    return document


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


def surfaces(view: ScanView, members: list[Member], cell_m: float | None) -> list[Raster]:
    """The mean surface of each member where the site has it, on one grid of the site's CRS."""
    clouds = [fused_cloud(Part(view.store, member)) for member in members]
    for member, fused in zip(members, clouds, strict=True):
        if not len(fused.cloud):
            raise InputError(f"{member.name} contains no points; nothing to compare")
    places = [placed(fused.cloud, view.frame) for fused in clouds]
    cell = cell_m or max(fused.voxel_m for fused in clouds)
    try:
        grid = grid_over(np.vstack([p[:, :2] for p in places]), cell, margin_cells=1)
    except ValueError as error:
        raise InputError(f"{view.folder}: {error} with --cell-m") from error
    return [
        fill_holes(mean_surface(xyz, fused.cloud.rgb, fused.cloud.sigma_m, grid), HOLE_CELLS)
        for xyz, fused in zip(places, clouds, strict=True)
    ]


def hide_changed(path: Path, earlier: Member, change: Change) -> None:
    """Take what has changed since out of the earlier scan's keyframes in the site's store.

    Otherwise the site's surface would be the mean of both dates. The scan itself keeps it.
    """
    changed = cv2.dilate((change.labels > 0).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    layers: dict[int, tuple[bytes, ...]] = {}
    with ScanStore.open(path, read_only=True) as store:
        frame = local_frame(store.header)
        for seq in earlier.seqs:
            one = store.keyframe(seq)
            coded = [store.chunk(seq, n) for n in range(codec.MAX_LAYERS)]
            own = codec.decode([data for data in coded if data is not None])
            if one is None or own is None:
                continue
            hidden = _inside(one.depth, changed, change.grid, frame)
            if hidden.any():
                depth = replace(own.depth, depth_m=np.where(hidden, np.nan, own.depth.depth_m))
                layers[seq] = codec.encode(replace(own, depth=depth), own.time_ns)
    database = Database(path)
    database.write([("DELETE FROM chunks WHERE seq = ?", (seq,)) for seq in layers])
    database.close()
    with ScanStore.open(path) as store:
        for seq, coded_layers in layers.items():
            store.add_keyframe(seq, coded_layers)


def _inside(depth: DepthMap, cells: Bool, grid: Grid, frame: LocalFrame | None) -> Bool:
    """(h, w) pixels whose surface lies in one of the ``cells`` of the grid."""
    known = np.isfinite(depth.depth_m)
    out = np.zeros(known.shape, np.bool_)
    if not known.any():
        return out
    points, _ = points_of(depth, depth.T_world_camera)
    xy = (points if frame is None else frame.to_utm(points))[:, :2]
    out[known] = grid.holds(xy) & cells[grid.cells(xy)]
    return out


def _document(site: AlignedSite, change: Change, one: int, two: int) -> dict[str, Any]:
    """The content of change.json."""
    found = volumes(change)
    before, after = site.members[one], site.members[two]
    count = len(change.bodies)
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
        "cell_m": round(change.grid.cell_m, 4),
        "compared_m2": round(change.compared_m2, 1),
        "alignment_sigma_m": round(change.alignment_m, 4),
        "volumes_m3": {
            name: {"value": round(v, 2), "sigma": round(s, 2)}
            for name, (v, s) in (("cut", found.cut), ("fill", found.fill), ("net", found.net))
        },
        "objects": [_object(change, body) for body in change.bodies],
        "in_words": words,
        "notes": site.document["notes"],
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


def _write_map(view: ScanView, path: Path, change: Change) -> None:
    """change.tif: signed difference, its sigma, and the number of the object, else 0."""
    layers = (change.height_m, change.sigma_m, change.labels.astype(np.float32))
    known = np.isfinite(change.height_m)
    bands = np.stack([np.where(known, x, NODATA_M) for x in layers]).astype(np.float32)
    names = ("after less before, m", "sigma, m", "object")
    write_cog(view, path, change.grid, bands, names, nodata=NODATA_M)


def _write_polygons(view: ScanView, path: Path, change: Change) -> None:
    objects = [_object(change, body) for body in change.bodies]
    names = ("kind", "area_m2", "volume_m3", "sigma_m3", "mean_m", "peak_m")
    shapes = [outlines(change, body.label) for body in change.bodies]
    columns = {name: [one[name] for one in objects] for name in names}
    write_polygons(path, "changes", view.needs_place("a GeoPackage").epsg, shapes, columns)


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


def page(document: dict[str, Any], before: Raster, after: Raster, change: Change) -> str:
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
        one=_embedded(drawn(before, change)),
        two=_embedded(drawn(after, change)),
        rows=rows,
        notes="".join(f"<p>{escape(note)}</p>" for note in document["notes"]),
    )


def _embedded(image: U8) -> str:
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()
    return "data:image/jpeg;base64," + base64.b64encode(data).decode()


def drawn(raster: Raster, change: Change, width_px: int = 1400) -> U8:
    """(H, W, 3) BGR of a surface in its colours and relief, with the changes outlined."""
    shade = np.nan_to_num(hillshade(raster.height_m, raster.grid.cell_m), nan=1.0)
    image = raster.rgb[..., ::-1] * (0.4 + 0.8 * shade[..., None])
    image[~raster.known] = 255
    zoom = width_px / image.shape[1]
    size = (width_px, max(1, round(image.shape[0] * zoom)))
    out = cv2.resize(np.clip(image, 0, 255).astype(np.uint8), size, interpolation=cv2.INTER_LINEAR)
    for body in change.bodies:
        colour = ADDED if body.volume_m3 > 0 else REMOVED
        for rings in outlines(change, body.label):
            for ring in rings:
                cv2.polylines(out, [_pixels(ring, change.grid, zoom)], True, colour, 2, cv2.LINE_AA)
    return np.asarray(out, np.uint8)


def _pixels(ring: F64, grid: Grid, zoom: float) -> Any:
    return np.rint((grid.pixels(ring) + 0.5) * zoom).astype(np.int32)
