"""The page of a comparison: both dates under a slider, the changed objects drawn and listed."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from typing import Any

import cv2
import numpy as np

from recon.surface.raster import Grid, Raster, hillshade
from recon.types import F64, U8
from service.scans.report_parts import embedded, table

ADDED, REMOVED = (40, 90, 230), (220, 120, 30)  # BGR
PAGE_PX = 1400
"""Width of its images."""

PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title>
<meta name="viewport" content="width=device-width">
<style>body{{font:15px/1.5 system-ui,sans-serif;margin:1.5em;max-width:70em}}
#map{{position:relative;line-height:0}}#map,img{{width:min(1000px,100vw - 3em)}}
#over{{position:absolute;left:0;top:0;height:100%;width:50%;min-width:2em;max-width:100%;
overflow:hidden;resize:horizontal;border-right:3px solid #fff;box-shadow:1px 0 3px #000}}
table{{display:block;overflow-x:auto}}td,th{{padding:.1em .8em;text-align:right}}</style>
<h1>{title}</h1><p>{words}</p>
<p>Left: {before}. Right: {after}. Red: added; blue: removed. Drag the corner at the lower
end of the white line.</p>
<div id="map"><img alt="after" src="{two}"><div id="over"><img alt="before" src="{one}"></div></div>
{table}{notes}</html>
"""


HEAD = "object", "kind", "area, m²", "volume, m³", "95 %, m³", "highest, m"


def page(document: dict[str, Any], images: tuple[U8, U8]) -> str:
    """A page without scripts, as the portal allows none: both dates under a slider, the objects."""
    rows = [
        [
            str(n), one["kind"], f"{one['area_m2']:.1f}", f"{one['volume_m3']:+.2f}",
            f"{1.96 * one['sigma_m3']:.2f}", f"{one['peak_m']:+.2f}",
        ]
        for n, one in enumerate(document["objects"], 1)
    ]  # fmt: skip
    return PAGE.format(
        title=escape(f"Change {document['before']['scan']} to {document['after']['scan']}"),
        words=escape(document["in_words"]),
        before=_utc(document["before"]["started"]),
        after=_utc(document["after"]["started"]),
        one=embedded(images[0], quality=85),
        two=embedded(images[1], quality=85),
        table=table(rows, HEAD),
        notes="".join(f"<p>{escape(note)}</p>" for note in document["notes"]),
    )


def _utc(iso: str) -> str:
    return iso.replace("T", " ").replace("+00:00", " UTC")


def drawn(raster: Raster, rows: slice, cols: slice, size: tuple[int, int]) -> U8:
    """(h, w, 3) BGR of some cells of a surface in its colours and relief; ``size`` is (w, h)."""
    shade = np.nan_to_num(hillshade(raster.height_m, raster.grid.cell_m), nan=1.0)
    image = raster.rgb[..., ::-1] * (0.4 + 0.8 * shade[..., None])
    image[~raster.known] = 255
    part = np.clip(image[rows, cols], 0, 255).astype(np.uint8)
    if not all(size):
        return np.zeros((size[1], size[0], 3), np.uint8)
    return np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_LINEAR), np.uint8)


def shape_of(whole: Grid) -> tuple[int, int]:
    """Rows and columns of the page's image of a grid."""
    return max(1, round(whole.shape[0] * PAGE_PX / whole.shape[1])), PAGE_PX


def place_in(part: Grid, whole: Grid) -> tuple[slice, slice]:
    """Rows and columns of a part of a grid in the page's image."""
    zoom = PAGE_PX / whole.shape[1]
    starts = (
        (whole.north_m - part.north_m) / whole.cell_m,
        (part.west_m - whole.west_m) / whole.cell_m,
    )
    ends = [
        (min(max(round(start * zoom), 0), limit), min(round((start + count) * zoom), limit))
        for start, count, limit in zip(starts, part.shape, shape_of(whole), strict=True)
    ]
    return slice(*ends[0]), slice(*ends[1])


def draw_outlines(image: U8, rings: Iterable[F64], is_added: bool, whole: Grid) -> None:
    """Draw the outline of an object, rings (N, 2) on the map, into the page's image."""
    zoom = PAGE_PX / whole.shape[1]
    for ring in rings:
        at: Any = np.rint((whole.pixels(ring) + 0.5) * zoom).astype(np.int32)
        cv2.polylines(image, [at], True, ADDED if is_added else REMOVED, 2, cv2.LINE_AA)
