"""The coverage layer of a scan, updated from its store, as image, figures and GeoTIFF.

Drone and ground compute the same layer, because both read the same store. In flight
:class:`LiveCoverage` reads only keyframes that are new or have moved.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from recon.surface.coverage import CoverageGrid, CoverageMap, usual_cell_m
from recon.table import Rows
from recon.types import U8, Array
from service.georeference import LocalFrame
from service.scans.main_piece import Stretch, main_seqs, stretches_apart
from service.scans.track import local_frame
from service.scans.writing import write_whole
from service.stream.store import ScanStore
from service.workers import PROCESS

IMAGE, FIGURES = "coverage.png", "coverage.json"
MIN_VIEWS = 3  # images of a place below which it is weak: two alone can agree on an error
MAX_SIGMAS = 3.0  # a surface is weak where its sigma is this many times the scan's median

GAP, SELDOM, UNSURE = (70, 60, 220), (60, 160, 245), (90, 220, 245)  # BGR
BEST, USUAL = (110, 190, 60), (190, 220, 160)
LEGEND = {
    "gap": "inside the flown area, no surface measured",
    "seldom": "covered by too few images",
    "unsure": "sigma too large",
    "good": "measured; darker is more certain",
}
LARGEST_PX = 1600
WRITE_EVERY_S = 15.0  # interval at which the layer is written in flight


@dataclass(frozen=True, eq=False)
class Coverage:
    """The layer of a scan at one time, in the scan's ENU metres."""

    layer: CoverageGrid
    frame: LocalFrame | None
    places: Rows  # rows of PLACE per keyframe, in order of their number
    min_views: int  # of a surface that is not weak
    max_sigma_m: float

    @cached_property
    def weak(self) -> Array:
        """(rows, cols) bool: cells worth another flight."""
        return self.layer.weak(self.min_views, self.max_sigma_m)

    def corners_lat_lon(self) -> list[tuple[float, float]] | None:
        """(latitude, longitude) of the image's NW, NE, SE and SW corners, if georeferenced."""
        if self.frame is None:
            return None
        west, south, east, north = self.layer.grid.bounds
        enu = np.array([[west, north, 0], [east, north, 0], [east, south, 0], [west, south, 0]])
        rows = self.frame.to_geodetic(enu.astype(np.float64))
        return [(round(float(r[0]), 8), round(float(r[1]), 8)) for r in rows]

    def figures(self) -> dict[str, Any]:
        layer, area = self.layer, self.layer.grid.cell_m**2
        known, inside = layer.known, layer.inside
        sigma, views = layer.sigma_m[known], layer.views[inside]
        some = bool(known.any())
        return {
            "cell_m": layer.grid.cell_m,
            "bounds_m": [round(v, 3) for v in layer.grid.bounds],
            "corners_lat_lon": self.corners_lat_lon(),
            "keyframes": len(self.places),
            "measured_m2": round(float(known.sum()) * area, 1),
            "flown_m2": round(float(inside.sum()) * area, 1),
            "gaps_m2": round(float(layer.gaps.sum()) * area, 1),
            "weak_m2": round(float(self.weak.sum()) * area, 1),
            "views_median": float(np.median(views)) if len(views) else 0.0,
            "sigma_median_m": round(float(np.median(sigma)), 4) if some else None,
            "sigma_90_percent_m": round(float(np.percentile(sigma, 90)), 4) if some else None,
            "least_views": self.min_views,
            "most_sigma_m": round(self.max_sigma_m, 4),
            "legend": LEGEND,
        }

    def image(self) -> U8:
        """(rows, cols, 4) BGRA, north up: weak cells by cause; clear outside the flown area."""
        layer = self.layer
        out = np.zeros((*layer.grid.shape, 4), np.uint8)
        known, inside = layer.known, layer.inside
        with np.errstate(invalid="ignore"):
            share = np.clip(layer.sigma_m / max(self.max_sigma_m, 1e-6), 0.0, 1.0)
        share = np.nan_to_num(share, nan=1.0)[..., None]
        shade = np.array(BEST) * (1 - share) + np.array(USUAL) * share
        out[..., :3] = np.where(known[..., None], shade, 0).astype(np.uint8)
        for cells, colour in (
            (layer.unsure(self.max_sigma_m), UNSURE),
            (layer.seldom(self.min_views), SELDOM),
            (layer.gaps, GAP),
        ):
            out[cells, :3] = colour
        out[..., 3] = np.where(known | inside, 210, 0)
        return out

    def png_bytes(self) -> bytes:
        """The image as PNG with alpha, a pixel per cell (fewer where it is very large)."""
        image = self.image()
        step = -(-max(image.shape[:2]) // LARGEST_PX)
        return cv2.imencode(".png", np.ascontiguousarray(image[::step, ::step]))[1].tobytes()

    def json_bytes(self) -> bytes:
        return (json.dumps(self.figures(), indent=2, sort_keys=True) + "\n").encode()


class LiveCoverage:
    """The layer of an open store; :meth:`refresh` updates it."""

    def __init__(self, store: ScanStore, cell_m: float | None = None) -> None:
        self._store, self._cell_m = store, cell_m
        self.found: Coverage | None = None  # by the last refresh
        self._begin([])

    def _begin(self, apart: list[Stretch]) -> None:
        """Start from nothing, without the keyframes of these stretches."""
        self._apart = apart
        self._map: CoverageMap | None = None
        self._states: dict[int, tuple[int, int]] = {}  # of the keyframes that are in it

    def refresh(self) -> Coverage | None:
        """The layer of the store's current content; None while it contains no surface."""
        self.found = self._layer()
        return self.found

    def _layer(self) -> Coverage | None:
        apart = stretches_apart(self._store)
        if apart != self._apart:  # known once the scan is finished, or refined
            self._begin(apart)
        states = self._store.states()
        for seq in main_seqs(self._store):
            before, now = self._states.get(seq), states.get(seq, (-1, -1))
            if before != now:
                self._states[seq] = now
                self._put(seq, finer=before is not None and before[0] != now[0])
        if self._map is None:
            return None
        stale = ((seq, self._store.keyframe(seq)) for seq in self._map.stale())
        self._map.refill((seq, keyframe.depth) for seq, keyframe in stale if keyframe is not None)
        layer = self._map.grid()
        if layer is None or not layer.known.any():
            return None
        places = self._map.places()
        max_sigma_m = MAX_SIGMAS * float(np.median(layer.sigma_m[layer.known]))
        return Coverage(layer, local_frame(self._store.header), places, MIN_VIEWS, max_sigma_m)

    def _put(self, seq: int, finer: bool) -> None:
        keyframe = self._store.keyframe(seq)
        if keyframe is None:
            return
        if self._map is None:
            cell = self._cell_m or usual_cell_m(keyframe.depth)
            if cell is None:
                return
            self._map = CoverageMap(cell)
        self._map.put(seq, keyframe.time_ns, keyframe.depth, finer)


def coverage_of(store: ScanStore, cell_m: float | None = None) -> Coverage | None:
    """The layer of everything in ``store``; None without any surface. Cells of ``cell_m``; by
    default about four pixels of the first keyframe's depth image."""
    return LiveCoverage(store, cell_m).refresh()


def write_coverage_files(folder: Path, live: LiveCoverage) -> Coverage | None:
    """Write coverage.png and coverage.json into the scan's folder; None without surface."""
    found = live.refresh()
    if found is not None:
        write_whole(folder / IMAGE, found.png_bytes())
        write_whole(folder / FIGURES, found.json_bytes())
    return found


@contextmanager
def covering(store: ScanStore, every_s: float = WRITE_EVERY_S) -> Iterator[None]:
    """Write coverage.png and coverage.json of the growing scan, on a separate thread. Disk failures
    are logged and retried."""
    live = LiveCoverage(store)

    def write() -> None:
        write_coverage_files(store.path.parent, live)

    worker = PROCESS.every("coverage", every_s, write)
    try:
        yield
    finally:
        worker.join()
