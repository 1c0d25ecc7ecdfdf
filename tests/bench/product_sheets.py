"""Products of flights beside those of an older version, the true place and the frames, at 1:1.

    PYTHONPATH=tests/bench python tests/bench/product_sheets.py OUT SCAN FLIGHT [SCAN FLIGHT ...]
        [--before FOLDER ...]

Writes ``OUT/index.html`` and its images, and for each scan one image for the documents,
``OUT/SCAN.webp``: orthophoto, heights and contours before, now and in truth, mesh and splats
before and now, then the roof edges (where there is truth, its own) in two columns: the frame,
orthophotos and heights as above. Products that a scan lacks are made first. ``--before`` is a
folder of products of an older version, one per scan. ``FLIGHT`` is a folder of ``simulate``, or a
video or folder of stills without truth.
"""

from __future__ import annotations

import html
import json
from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from deliverable_scoring import fits_of, view_from_above

from recon import se3
from recon.camera_model import project
from recon.surface.metrics import Fit
from recon.surface.raster import Grid, highest_lowest, hillshade
from recon.surface.texture_views import TextureView
from recon.types import F32, F64, U8, Array, Camera
from service.commands import showing
from service.errors import InputError
from service.georeference import LocalFrame
from service.offline.exports import EXPORTERS
from service.offline.exports.images import shared_images
from service.offline.exports.maps import write_kinds
from service.offline.exports.rasters import NODATA_M, open_map
from service.offline.exports.splats import read_splats
from service.offline.exports.view import ExportOptions, ScanView
from service.offline.view_scoring import by_gaussians, by_rays, frame_scores, means, read_glb
from service.scans.folder import Failures
from service.sim.truth import Truth, heights_below, read_truth

KINDS = ("ortho", "dsm", "contours", "glb", "splat")
WINDOWS, WINDOW_PX = 3, 420
EDGES, EDGE_PX, EDGE_M, EDGE_STEP_M = 20, 150, 3.0, 1.5
"""Roof edges: how many, the side of their images, their least length and height."""
EVERY = 100
"""Of the frames that took no part; each takes seconds."""

WEBP = [cv2.IMWRITE_WEBP_QUALITY, 60]

SIDE_PX = (640, 480)
SIDES = {"above": (0, 90), "the north": (0, 35), "the east": (90, 35), "the south": (180, 35),
         "the west": (270, 35)}  # fmt: skip
"""Where mesh and splats are seen from: degrees from north and above the horizon."""

Images = dict[str, U8]


def from_above(folder: Path, grid: Grid, low_high_m: F64) -> Images:
    """(rows, cols, 3) BGR of orthophoto, surface model and contours on a grid of the map."""
    out = {}
    if (folder / "ortho.tif").is_file():
        out["ortho"] = np.ascontiguousarray(_read(folder / "ortho.tif", grid, 3)[..., ::-1])
    if (folder / "dsm.tif").is_file():
        own, height = _heights(folder)
        lit = relief(height, own.cell_m, low_high_m)
        rows, cols = own.cells(_middles(grid))
        is_there = own.holds(_middles(grid))[:, None]
        out["dsm"] = np.where(is_there, lit[rows, cols], np.uint8(128)).reshape(*grid.shape, 3)
    if (folder / "contours.geojson").is_file() and "ortho" in out:
        out["contours"] = out["ortho"].copy()
        for places in _lines(folder):
            at = np.rint(grid.pixels(places) * 16).astype(np.int32)
            cv2.polylines(out["contours"], [at], False, (0, 220, 255), 1, cv2.LINE_AA, 4)
    return out


def truth_from_above(truth: Truth, fit: Fit, grid: Grid, low_high_m: F64) -> Images:
    """The same of the place that was flown over; ``fit`` takes the scan's places to it."""
    cell_m = grid.cell_m
    places, height = true_heights(truth, fit, grid, float(low_high_m[0]))
    out = {"dsm": relief(height, cell_m, low_high_m)}
    (west, south), (east, north) = places.min(axis=0) - cell_m, places.max(axis=0) + cell_m
    shape = round((north - south) / cell_m) + 1, round((east - west) / cell_m) + 1
    try:
        image = view_from_above(truth.folder, west, north, cell_m, shape)
    except InputError:
        return out
    px = (places - [west, north]) / [cell_m, -cell_m] - 0.5
    return out | {"ortho": _warped(image, px, grid)}


def true_heights(truth: Truth, fit: Fit, grid: Grid, level_m: float) -> tuple[F64, F32]:
    """(rows * cols, 2) true places of a grid of the map, and (rows, cols) the map's heights there;
    the places are those of about ``level_m``."""
    utm = np.column_stack([_middles(grid), np.full(grid.shape[0] * grid.shape[1], level_m)])
    moved = fit.points(truth.frame.from_utm(utm))
    places, off_m = moved[:, :2], float(np.median(utm[:, 2] - moved[:, 2]))
    height = heights_below(truth.surface, places).reshape(grid.shape) + off_m
    return places, height.astype(np.float32)


def _warped(image: U8, px: F64, grid: Grid) -> U8:
    """The image at (rows * cols, 2) pixels, on the grid."""
    u, v = (at.reshape(grid.shape).astype(np.float32) for at in px.T)
    whole = np.ascontiguousarray(image)
    return np.asarray(cv2.remap(whole, u, v, cv2.INTER_CUBIC), np.uint8)


def _read(path: Path, grid: Grid, bands: int) -> Array:
    """(rows, cols, bands) of a GeoTIFF, each cell the nearest of the file's."""
    from rasterio.windows import from_bounds

    with open_map(path, bands) as image:
        where = from_bounds(*grid.bounds, image.transform)
        numbers, shape = list(range(1, bands + 1)), (bands, *grid.shape)
        found = image.read(numbers, window=where, out_shape=shape, boundless=True)
    return np.asarray(found.transpose(1, 2, 0))


def _heights(folder: Path) -> tuple[Grid, F32]:
    """Grid and heights of the surface model; NaN where unknown."""
    with open_map(folder / "dsm.tif") as image:
        grid = Grid(image.transform.c, image.transform.f, image.transform.a, image.shape)
        height = image.read(1)
    height[height == NODATA_M] = np.nan
    return grid, height


def _lines(folder: Path) -> Iterator[F64]:
    """(N, 2) places of each contour on the map of the orthophoto."""
    from pyproj import Transformer

    with open_map(folder / "ortho.tif") as image:
        to_map = Transformer.from_crs("EPSG:4326", image.crs, always_xy=True)
    for feature in json.loads((folder / "contours.geojson").read_text())["features"]:
        parts = feature["geometry"]["coordinates"]
        for part in parts if feature["geometry"]["type"].startswith("Multi") else [parts]:
            lon, lat = np.array([place[:2] for place in part], np.float64).T
            yield np.column_stack(to_map.transform(lon, lat))


def _middles(grid: Grid) -> F64:
    rows, cols = np.mgrid[: grid.shape[0], : grid.shape[1]]
    return grid.centres(rows.ravel(), cols.ravel())


def relief(height_m: F32, cell_m: float, low_high_m: F64) -> U8:
    """(rows, cols, 3) BGR: colour by height, light from the north-west; gray where unknown."""
    share = np.nan_to_num(np.interp(height_m, low_high_m, [0, 255])).astype(np.uint8)
    light = np.nan_to_num(hillshade(height_m, cell_m))[..., None]
    colour = cv2.applyColorMap(share, cv2.COLORMAP_VIRIDIS) * (0.35 + 0.65 * light)
    return np.asarray(np.where(np.isfinite(height_m)[..., None], colour, 128), np.uint8)


def window(middle: F64, cell_m: float, size_px: int) -> Grid:
    """Square cells around a place of the map, their edges on multiples of the cell."""
    west, north = np.round(middle / cell_m) + np.array([-0.5, 0.5]) * size_px
    return Grid(west * cell_m, north * cell_m, cell_m, (size_px, size_px))


def edges(height_m: F32, grid: Grid) -> list[tuple[F64, float]]:
    """Middles on the map and heights of straight steps of a surface (unknown cells are NaN), the
    longest first, apart from each other and from the unknown."""
    high, low = highest_lowest(height_m, 1)
    step = (high - low > EDGE_STEP_M) & (height_m > 0.5 * (high + low))
    least = EDGE_M / grid.cell_m
    found = cv2.HoughLinesP(step.astype(np.uint8), 1, np.pi / 180, int(0.7 * least), None, least, 2)
    lines = np.zeros((0, 4)) if found is None else found.reshape(-1, 4).astype(np.float64)
    out: list[tuple[F64, float]] = []
    for u0, v0, u1, v1 in lines[np.argsort(-np.hypot(*(lines[:, 2:] - lines[:, :2]).T))]:
        row, col = 0.5 * (v0 + v1), 0.5 * (u0 + u1)
        place = grid.centres(np.array([row]), np.array([col]))[0]
        top, left = (max(0, round(at - least)) for at in (row, col))
        near = np.s_[top : round(row + least), left : round(col + least)]
        if np.isfinite(height_m[near]).all() and all(
            np.hypot(*(place - other)) > EDGE_M for other, _ in out
        ):
            out.append((place, float(high[round(row), round(col)])))
    return out[:EDGES]


def frame_on_plane(
    frame: LocalFrame | None, views: Sequence[TextureView], grid: Grid, height_m: float
) -> Images:
    """The frame that sees the grid most steeply, laid on the level of the roof's edge."""
    utm = np.column_stack([_middles(grid), np.full(grid.shape[0] * grid.shape[1], height_m)])
    places = utm if frame is None else frame.from_utm(utm)
    found: list[tuple[float, Images]] = []
    for view in views:
        local = se3.transform(se3.inverse(view.T_world_camera), places)
        px = project(view.K, local)
        h, w = view.bgra.shape[:2]
        if local[:, 2].min() > 0.1 and ((px >= 0) & (px <= [w - 1, h - 1])).all():
            way = view.T_world_camera[:3, 3] - places[len(places) // 2]
            image = _warped(view.bgra[..., :3], px, grid)
            found.append((way[2] / float(np.linalg.norm(way)), {"frame": image}))
    none = {"not in one frame": np.full((*grid.shape, 3), 255, np.uint8)}
    return max(found, key=lambda one: one[0])[1] if found else none


def from_five_sides(folder: Path, target: F64, pixel_m: float) -> Images:
    """Mesh and splats, where they are, from above and from four sides."""
    w, h = SIDE_PX
    camera = Camera(np.array([[w, 0, w / 2], [0, w, h / 2], [0, 0, 1.0]]), np.zeros(5), SIDE_PX)
    draws = {}
    if (folder / "mesh.glb").is_file():
        draws["mesh"] = by_rays(read_glb(folder / "mesh.glb"), camera)
    if (folder / "splat.ply").is_file():
        draws["splats"] = by_gaussians(read_splats(folder / "splat.ply"), camera)
    out = {}
    for what, draw in draws.items():
        for name, (azimuth, elevation) in SIDES.items():
            a, e = np.radians([azimuth, elevation])
            ahead = -np.array([np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), np.sin(e)])
            right = np.array([-np.cos(a), np.sin(a), 0.0])
            R = np.column_stack([right, np.cross(ahead, right), ahead])
            out[f"{what} from {name}"] = draw(se3.compose(R, target - pixel_m * w * ahead))[0]
    return out


def framed(images: Iterable[U8]) -> U8:
    """Images of one height beside each other, each with a black border."""
    return np.hstack([np.pad(one, ((2, 2), (2, 2), (0, 0))) for one in images])


def flowed(images: Sequence[U8], wide_px: int) -> Iterator[U8]:
    """Rows of images of one height in this order, each as long as it may be."""
    for _, alike in groupby(images, key=lambda one: one.shape):
        group = list(alike)
        many = max(1, wide_px // (group[0].shape[1] + 4))
        for first in range(0, len(group), many):
            yield framed(group[first : first + many])


def stacked(rows: Sequence[U8]) -> U8:
    """Images above each other, the narrower ones black on the right."""
    wide = max(one.shape[1] for one in rows)
    return np.vstack([np.pad(one, ((0, 0), (0, wide - one.shape[1]), (0, 0))) for one in rows])


def for_documents(tiles: Sequence[U8], edge_rows: Sequence[U8]) -> U8:
    """One image: the ``tiles``, then the rows of roof edges in two columns."""
    half = -(-len(edge_rows) // 2)
    pairs = stacked([np.hstack(edge_rows[n::half]) for n in range(half)])
    return stacked([*flowed(tiles, pairs.shape[1]), pairs])


class Page:
    """Rows of images, each at one pixel to a pixel of the screen."""

    def __init__(self, out: Path) -> None:
        self.out = out
        style = "img{image-rendering:pixelated} figure{margin:2px} div{display:flex}"
        self.parts = [f"<!doctype html><meta charset=utf-8><style>{style}</style>"]
        out.mkdir(parents=True, exist_ok=True)

    def row(self, images: Images) -> None:
        self.parts.append("<div>")
        for words, image in images.items():
            name = f"{len(self.parts):04d}.png"
            cv2.imwrite(str(self.out / name), image)
            self.parts.append(f"<figure><img src={name}><figcaption>{words}</figcaption></figure>")
        self.parts.append("</div>")

    def write(self) -> Path:
        """The page so far."""
        path = self.out / "index.html"
        path.write_text("\n".join(self.parts), encoding="utf-8")
        return path


def make_products(scan: ScanView) -> None:
    """What the scan lacks of KINDS."""
    folder = scan.folder
    missing = [kind for kind in KINDS if not (folder / EXPORTERS[kind][1]).is_file()]
    failures = Failures(folder)
    write_kinds(scan, missing, lambda kind: folder / EXPORTERS[kind][1], ExportOptions(), failures)
    if failures.first is not None and {"ortho", "dsm"} & set(failures.why):
        raise failures.first


def add_flight(page: Page, scan: ScanView, flight: Path, before: Path | None) -> None:
    """All rows of one scan, which has its products."""
    folder, name = scan.folder, html.escape(scan.folder.name)
    with open_map(folder / "ortho.tif", 3) as image:
        cell_m = float(image.transform.a)
    own, height = _heights(folder)
    low_high_m = np.nanpercentile(height, [1.0, 99.0]).astype(np.float64)
    truth = read_truth(flight / "truth") if (flight / "truth").is_dir() else None
    fits = {} if truth is None else fits_of(folder, truth)
    fit = fits.get("rigid") or fits.get("similarity")
    folders = ({"before": before} if before else {}) | {"now": folder}

    def rows(grid: Grid) -> dict[str, Images]:
        """The images of each product by when it was made."""
        seen = {when: from_above(one, grid, low_high_m) for when, one in folders.items()}
        if truth is not None and fit is not None:
            seen["truth"] = truth_from_above(truth, fit, grid, low_high_m)
        return {
            kind: {f"{kind}, {when}": one[kind] for when, one in seen.items() if kind in one}
            for kind in seen["now"]
        }

    steps = height
    if truth is not None and fit is not None:
        true = true_heights(truth, fit, own, float(low_high_m[0]))[1]
        steps = np.where(np.isfinite(height), true, np.float32(np.nan))
    roofs = edges(steps, own) or [(np.mean(_middles(own), axis=0), float(low_high_m[0]))]
    page.parts.append(f"<h2>{name}: from above, {cell_m:g} m a pixel</h2>")
    chosen: list[F64] = []
    for place, _ in roofs:
        if all(np.abs(place - other).max() > WINDOW_PX * cell_m / 2 for other in chosen):
            chosen.append(place)
    tiles: list[U8] = []
    for place in chosen[:WINDOWS]:
        for images in rows(window(place, cell_m, WINDOW_PX)).values():
            page.row(images)
            if place is chosen[0]:
                tiles += images.values()
    page.parts.append(f"<h2>{name}: roof edges, the frame laid on the roof's level first</h2>")
    views = shared_images(scan, ExportOptions())
    found = []
    for place, height_m in roofs:
        grid = window(place, cell_m, EDGE_PX)
        ours = rows(grid)
        row = frame_on_plane(scan.frame, views, grid, height_m) | ours["ortho"] | ours["dsm"]
        found.append(framed(row.values()))
        page.row(row)
    page.parts.append(f"<h2>{name}: mesh and splats from five sides</h2>")
    utm = np.array([[*chosen[0], low_high_m[0]]])
    target = (utm if scan.frame is None else scan.frame.from_utm(utm))[0]
    sides = {when: from_five_sides(one, target, cell_m) for when, one in folders.items()}
    for side in sides["now"]:
        images = {f"{side}, {when}": one[side] for when, one in sides.items() if side in one}
        page.row(images)
        if side.endswith("the south"):
            tiles += images.values()
    cv2.imwrite(str(page.out / f"{folder.name}.webp"), for_documents(tiles, found), WEBP)
    page.parts.append(f"<h2>{name}: frames that took no part</h2>")
    video = flight / "flight.mp4"
    try:
        scores = means(frame_scores(scan, video if video.is_file() else flight, every=EVERY))
    except InputError as error:  # all frames are keyframes
        page.parts.append(f"<p>{html.escape(str(error))}</p>")
        return
    for what, figures in scores.items():
        words = ", ".join(f"{key} {value}" for key, value in figures.items())
        page.parts.append(f"<p>{what}: {words}</p>")


def main(
    out: Path,
    scans: Annotated[list[Path], typer.Argument(help="SCAN FLIGHT, any number of times")],
    before: Annotated[list[Path] | None, typer.Option(help="older products of each scan")] = None,
) -> None:
    """Write OUT/index.html: products of flights beside older ones, the truth and the frames."""
    if len(scans) % 2 or (before and len(before) != len(scans) // 2):
        raise SystemExit("give SCAN FLIGHT for each flight, and --before for each or none")
    page = Page(out)
    for n, (folder, flight) in enumerate(zip(scans[::2], scans[1::2], strict=True)):
        with showing("sheets") as progress:
            with ScanView(folder, progress=progress) as scan:
                make_products(scan)
            with ScanView(folder, progress=progress) as scan:  # without what they were made from
                add_flight(page, scan, flight, before[n] if before else None)
        page.write()
    print(page.write())


if __name__ == "__main__":
    typer.run(main)
