"""3D Tiles of the fused cloud, placed on the globe, for Cesium and three.js viewers."""

from __future__ import annotations

import tempfile
from pathlib import Path

from service.exports.flight import writing_folder
from service.exports.view import ExportOptions, ScanView
from service.scans.las import write_laz

EARTH_CENTRED = 4978


def write_tiles(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """A folder with ``tileset.json`` and its point tiles, in earth-centred metres.

    Heights go in as they are, above mean sea level: a globe with ellipsoidal terrain shows
    the cloud lower or higher by the geoid's height.
    """
    from py3dtiles.convert import convert
    from pyproj import CRS

    frame = scan.needs_place("3D Tiles")
    with writing_folder(out) as part, tempfile.TemporaryDirectory() as work:
        las = Path(work) / "cloud.las"
        write_laz(las, scan.fused.cloud, frame, scan.store.header.started_unix_ns, laz=False)
        convert(
            las,
            outfolder=part,
            overwrite=True,
            jobs=1,
            crs_in=CRS.from_epsg(frame.epsg),
            crs_out=CRS.from_epsg(EARTH_CENTRED),
            force_crs_in=True,
            pyproj_always_xy=True,
            rgb=True,
        )
