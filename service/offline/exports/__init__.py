"""Deliverables of a scan: one table, one function per kind of file.

An exporter is ``function(scan: ScanView, out: Path, options: ExportOptions) -> None`` and
writes ``out`` whole or not at all. The next kind is one file and one line in EXPORTERS.
"""

from __future__ import annotations

import re
from pathlib import Path

from service.errors import InputError

EXPORTERS: dict[str, tuple[str, str, str]] = {
    "ply": ("clouds:write_ply", "cloud.ply", "The cloud in UTM, as binary PLY."),
    "laz": ("clouds:write_laz_file", "cloud.laz", "The cloud as LAZ 1.4, with sigma and views."),
    "copc": ("clouds:write_copc", "cloud.copc.laz", "The cloud as a cloud-optimised octree."),
    "dsm": ("rasters:write_dsm", "dsm.tif", "Heights with buildings and trees, as GeoTIFF."),
    "dtm": ("rasters:write_dtm", "dtm.tif", "Heights of the bare ground, as GeoTIFF."),
    "ortho": ("rasters:write_ortho", "ortho.tif", "The true orthophoto, as GeoTIFF."),
    "contours": (
        "contours:write_contours",
        "contours.geojson",
        "Contours as GeoJSON; or .gpkg, .dxf.",
    ),
    "gpkg": ("contours:write_contours_gpkg", "contours.gpkg", "Contours as GeoPackage, in UTM."),
    "dxf": ("contours:write_contours_dxf", "contours.dxf", "Contours as DXF for CAD, in UTM."),
    "coverage": (
        "rasters:write_coverage",
        "coverage.tif",
        "Views and sigma of the ground, as GeoTIFF.",
    ),
    "geojson": ("flight:write_geojson", "flight.geojson", "The track and keyframes, as GeoJSON."),
    "kmz": ("maps:write_kmz", "ortho.kmz", "The orthophoto for Google Earth."),
    "stac": ("maps:write_stac", "stac.json", "A STAC item of the rasters in its folder."),
    "kml": ("flight:write_kml", "flight.kml", "The track for Google Earth."),
    "colmap": ("colmap:write_colmap", "colmap", "Frames, poses and tracks for COLMAP."),
    "3dtiles": ("clouds:write_tiles", "3dtiles", "The cloud as 3D Tiles, for Cesium."),
    "3dtiles-mesh": ("model:write_mesh_tiles", "3dtiles-mesh", "The textured mesh as 3D Tiles."),
    "glb": ("model:write_glb", "mesh.glb", "The textured mesh as binary glTF."),
    "obj": ("model:write_obj", "mesh-obj", "The mesh as OBJ, in UTM less an offset."),
    "splat": ("splats:write_splats", "splat.ply", "3D Gaussians, as PLY; or .spz."),
    "report": (
        "report:write_report",
        "report.html",
        "The report again, with ortho.tif and dsm.tif.",
    ),
    "all": ("maps:write_all", "maps", "laz and all maps, with a manifest."),
    "mcap": ("recording:write_mcap", "flight.mcap", "The scan as a recording for Foxglove."),
    "ros2": ("ros2:write_ros2", "ros2.mcap", "The scan as ROS 2 messages."),
}
"""Name to (``module:function`` of this package, usual name in the folder, one line of help)."""

MAPPED = ("contours", "gpkg", "dxf", "geojson", "kml", "kmz", "stac", "3dtiles", "3dtiles-mesh")
"""Kinds that need a georeference."""

PACKAGES = (
    {
        "copc": ("copclib",),
        "3dtiles": ("py3dtiles",),
        "mcap": ("foxglove",),
        "ros2": ("rosbags", "mcap"),
        "splat": ("open3d",),
    }
    | dict.fromkeys(
        ("dsm", "dtm", "ortho", "coverage", "kmz", "stac", "report", "all"), ("rasterio",)
    )
    | dict.fromkeys(("glb", "obj", "3dtiles-mesh"), ("open3d", "trimesh", "fast_simplification"))
)
"""Optional packages of kinds."""

ENDINGS = {
    "contours": {".json": "contours", ".gpkg": "gpkg", ".dxf": "dxf"},
    "laz": {".las": "laz", ".copc.laz": "copc"},
    "splat": {".spz": "splat"},
} | {kind: {".tiff": kind} for kind in ("dsm", "dtm", "ortho", "coverage")}
"""Endings of a file besides the usual one, with the kind that writes it."""


def kind_of(kind: str, out: Path | None) -> str:
    """The kind that writes ``out``, whose ending decides the format.

    Raises InputError for an unknown kind, and for an ending that is not of this kind.
    """
    if kind not in EXPORTERS:
        raise InputError(f"cannot export to {kind!r}; there are {', '.join(EXPORTERS)}")
    usual = EXPORTERS[kind][1]
    ending = "".join(Path(usual).suffixes)
    if out is None:
        return kind
    if not ending:
        if re.fullmatch(r"\.[a-z]+[0-9]?", out.suffix.lower()):
            raise InputError(f"{out}: {kind} is a folder; give its name without {out.suffix}")
        return kind
    known = {ending: kind} | ENDINGS.get(kind, {})
    fitting = [one for one in known if out.name.lower().endswith(one)]
    if fitting:
        return known[max(fitting, key=len)]
    endings = " or ".join(known)
    others = [k for k, (_, name, _) in EXPORTERS.items() if Path(name).suffix == out.suffix.lower()]
    hint = f"; {out.suffix} is --to {' or '.join(others)}" if others and out.suffix else ""
    raise InputError(f"{out}: {kind} is written as {endings}{hint}")
