"""Deliverables of a scan: one table, one function per kind of file.

An exporter is ``function(scan: ScanView, out: Path, options: ExportOptions) -> None`` and
writes ``out`` whole or not at all. The next kind is one file and one line in EXPORTERS.
"""

from __future__ import annotations

EXPORTERS: dict[str, tuple[str, str, str]] = {
    "ply": ("service.exports.clouds:write_ply", "cloud.ply", "Fused cloud, binary PLY, UTM."),
    "laz": ("service.exports.clouds:write_laz_file", "cloud.laz", "Fused cloud, LAZ 1.4."),
    "copc": ("service.exports.clouds:write_copc", "cloud.copc.laz", "Cloud-optimised LAZ."),
    "dsm": ("service.exports.rasters:write_dsm", "dsm.tif", "Surface model, GeoTIFF (COG)."),
    "ortho": ("service.exports.rasters:write_ortho", "ortho.tif", "Orthophoto, GeoTIFF (COG)."),
    "contours": (
        "service.exports.rasters:write_contours",
        "contours.geojson",
        "Height contours, GeoJSON.",
    ),
    "coverage": (
        "service.exports.rasters:write_coverage",
        "coverage.tif",
        "Views, sigma, height, COG.",
    ),
    "geojson": ("service.exports.flight:write_geojson", "flight.geojson", "The flight, GeoJSON."),
    "kml": ("service.exports.flight:write_kml", "flight.kml", "The flight, KML."),
    "colmap": (
        "service.exports.flight:write_colmap",
        "colmap",
        "Keyframes as a COLMAP text model with pictures.",
    ),
    "3dtiles": ("service.exports.clouds:write_tiles", "3dtiles", "Point tiles for Cesium."),
    "glb": ("service.exports.model:write_glb", "mesh.glb", "Textured mesh, binary glTF."),
    "mcap": ("service.exports.recording:write_mcap", "flight.mcap", "Recording for Foxglove."),
}
"""Name to (``module:function``, usual name in the scan folder, one line of help)."""
