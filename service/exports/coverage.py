"""The coverage layer as a Cloud Optimized GeoTIFF."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from recon.surface.raster import Grid
from recon.types import Array
from service.errors import InputError
from service.exports.rasters import write_cog
from service.exports.view import ExportOptions, ScanView
from service.georeference import LocalFrame
from service.scans.coverage import coverage_of

NODATA = -9999.0


def write_coverage(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """coverage.tif: views, sigma and height as float32, -9999 where unknown, in the scan's UTM.

    Raises InputError when the scan holds no surface.
    """
    found = coverage_of(scan.store, options.cell_m)
    if found is None:
        raise InputError(f"{scan.folder} holds no points yet; nothing to export")
    layer, grid = found.layer, found.layer.grid
    height = layer.height_m + (0.0 if scan.frame is None else scan.frame.alt_amsl_m)
    bands = np.stack([layer.views.astype(np.float32), layer.sigma_m, height]).astype(np.float32)
    bands[:, ~(layer.known | (layer.views > 0))] = np.nan
    if scan.frame is not None:
        grid, bands = _in_utm(bands, grid, scan.frame)
    bands = np.where(np.isfinite(bands), bands, np.float32(NODATA))
    names = ("views", "sigma, m", "height, m")
    write_cog(scan, out, grid, bands, names, nodata=NODATA)


def _in_utm(bands: Array, grid: Grid, frame: LocalFrame) -> tuple[Grid, Array]:
    """The bands on a north-up grid of the frame's UTM zone, nearest cell taken.

    Over the extent of a scan UTM is an affine map of ENU to within a small part of a cell.
    """
    west, south, east, north = grid.bounds
    corners = np.array([[west, north, 0.0], [east, north, 0.0], [east, south, 0.0],
                        [west, south, 0.0]])  # fmt: skip
    utm = frame.to_utm(corners)[:, :2]
    cell = grid.cell_m
    low = np.floor(utm.min(axis=0) / cell).astype(np.int64)
    high = np.ceil(utm.max(axis=0) / cell).astype(np.int64)
    shape = (int(high[1] - low[1]), int(high[0] - low[0]))
    out = Grid(float(low[0] * cell), float(high[1] * cell), cell, shape)
    # Pixel of the old grid as an affine function of the pixel of the new one.
    A = cv2.getAffineTransform(
        out.pixels(utm[:3]).astype(np.float32), grid.pixels(corners[:3, :2]).astype(np.float32)
    )
    layers = [
        cv2.warpAffine(
            np.ascontiguousarray(band),
            A,
            shape[::-1],
            flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=float("nan"),
        )
        for band in bands
    ]
    return out, np.stack(layers)
