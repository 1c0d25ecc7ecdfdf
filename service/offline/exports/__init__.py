"""Deliverables of a scan: one table, one function per kind of file.

An exporter is ``function(scan: ScanView, out: Path, options: ExportOptions) -> None`` and
writes ``out`` whole or not at all. The next kind is one file and one line in EXPORTERS.
"""

from __future__ import annotations

EXPORTERS: dict[str, tuple[str, str, str]] = {
    "ply": ("clouds:write_ply", "cloud.ply", "Fused cloud, binary PLY, UTM."),
    "laz": ("clouds:write_laz_file", "cloud.laz", "Fused cloud, LAZ 1.4."),
    "copc": ("clouds:write_copc", "cloud.copc.laz", "Cloud-optimised LAZ."),
    "dsm": ("rasters:write_dsm", "dsm.tif", "Surface model, GeoTIFF (COG)."),
    "dtm": ("rasters:write_dtm", "dtm.tif", "Bare ground, GeoTIFF (COG)."),
    "ortho": ("rasters:write_ortho", "ortho.tif", "Orthophoto, GeoTIFF (COG)."),
    "contours": (
        "rasters:write_contours",
        "contours.geojson",
        "Height contours, GeoJSON.",
    ),
    "gpkg": ("maps:write_contours_gpkg", "contours.gpkg", "Contours, GeoPackage, UTM."),
    "dxf": ("maps:write_contours_dxf", "contours.dxf", "Contours, DXF, UTM."),
    "coverage": (
        "rasters:write_coverage",
        "coverage.tif",
        "Views, sigma, height, COG.",
    ),
    "geojson": ("flight:write_geojson", "flight.geojson", "The flight, GeoJSON."),
    "kmz": ("maps:write_kmz", "ortho.kmz", "Orthophoto for Google Earth."),
    "stac": ("maps:write_stac", "stac.json", "STAC item of the rasters."),
    "kml": ("flight:write_kml", "flight.kml", "The flight, KML."),
    "colmap": (
        "colmap:write_colmap",
        "colmap",
        "COLMAP text model: frames, poses, tracks.",
    ),
    "3dtiles": ("clouds:write_tiles", "3dtiles", "Point tiles for Cesium."),
    "3dtiles-mesh": (
        "model:write_mesh_tiles",
        "3dtiles-mesh",
        "Textured mesh, 3D Tiles 1.1.",
    ),
    "glb": ("model:write_glb", "mesh.glb", "Textured mesh, binary glTF."),
    "obj": ("model:write_obj", "mesh-obj", "Textured mesh, OBJ, UTM less an offset."),
    "all": ("maps:write_all", "maps", "Clouds and maps with a manifest, one folder."),
    "mcap": ("recording:write_mcap", "flight.mcap", "Recording for Foxglove."),
    "ros2": ("ros2:write_ros2", "ros2.mcap", "Recording for ROS 2 (CDR)."),
}
"""Name to (``module:function`` of this package, usual name in the folder, one line of help)."""
