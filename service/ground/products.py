"""What can be made of a scan, for the portal's export dialog: each product with what it is, the
file that there is, and about how large it becomes and how long it takes."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

from service.ground.state import KINDS, REFINE
from service.ground.storage import folder_bytes, is_regular
from service.offline.exports import EXPORTERS, MAPPED, PACKAGES

PRODUCTS: dict[str, tuple[str, str, float, float]] = {
    "laz": ("Cloud", "Cloud, LAZ", 10.0, 6.0),
    "copc": ("Cloud", "Cloud, COPC", 10.0, 7.0),
    "ply": ("Cloud", "Cloud, PLY", 32.0, 5.0),
    "3dtiles": ("Cloud", "Cloud, 3D Tiles", 15.0, 10.0),
    "all": ("Maps", "All maps", 38.0, 25.0),
    "ortho": ("Maps", "Orthophoto, GeoTIFF", 11.0, 15.0),
    "dsm": ("Maps", "Surface model, GeoTIFF", 7.0, 10.0),
    "dtm": ("Maps", "Bare ground, GeoTIFF", 2.5, 6.0),
    "contours": ("Maps", "Contours, GeoJSON", 0.05, 6.0),
    "gpkg": ("Maps", "Contours, GeoPackage", 0.1, 6.0),
    "dxf": ("Maps", "Contours, DXF", 0.06, 6.0),
    "coverage": ("Maps", "Coverage, GeoTIFF", 0.2, 2.0),
    "kmz": ("Maps", "Orthophoto, KMZ", 3.0, 2.0),
    "stac": ("Maps", "STAC item", 0.002, 1.0),
    "report": ("Maps", "Report, HTML", 10.0, 5.0),
    "glb": ("Models", "Mesh, glTF", 30.0, 60.0),
    "obj": ("Models", "Mesh, OBJ", 70.0, 80.0),
    "3dtiles-mesh": ("Models", "Mesh, 3D Tiles", 30.0, 100.0),
    "splat": ("Models", "3D Gaussians, PLY", 320.0, 100.0),
    "geojson": ("Flight", "Track, GeoJSON", 0.04, 1.0),
    "kml": ("Flight", "Track, KML", 0.06, 1.0),
    "mcap": ("Flight", "Recording, Foxglove", 16.0, 3.0),
    "ros2": ("Flight", "Recording, ROS 2", 16.0, 4.0),
    "colmap": ("Flight", "Images and poses, COLMAP", 20.0, 10.0),
    REFINE: ("Improve", "Refined scan", 10.0, 60.0),
}
"""Group, title, bytes of a fused point and seconds of a million of them, on two cores."""

OTHER_JOBS = {"align": "Alignment", "scan": "Replay"}
"""Titles of the jobs that make no product; an upload is replayed to a scan."""

REFINED = "Adjusts all poses to each other once more, then makes the scan's files again."
WITH_HEIGHTS = {
    "laz", "copc", "ply", "dsm", "dtm", "contours", "gpkg", "dxf", "coverage", "all", "obj",
    "3dtiles", "3dtiles-mesh", "geojson",
}  # fmt: skip
"""Products whose heights can be converted."""


def products_of(folder: Path, points: int | None, is_placed: bool) -> list[dict[str, Any]]:
    """One entry for each kind of product of the scan in ``folder``, for JSON.

    ``points`` are those of its cloud, None while they are not counted; ``is_placed`` says whether
    it has a georeference.
    """
    known = [kind for kind in PRODUCTS if kind in KINDS]
    return [
        _product(folder, kind, points, is_placed)
        for kind in (*known, *(kind for kind in KINDS if kind not in PRODUCTS))
    ]


def job_title(kind: str) -> str:
    """What a job of this kind makes, in the words of the page."""
    found = PRODUCTS.get(kind)
    return OTHER_JOBS.get(kind, kind) if found is None else found[1]


def _product(folder: Path, kind: str, points: int | None, is_placed: bool) -> dict[str, Any]:
    group, title, point_bytes, million_s = PRODUCTS.get(kind, ("Other", kind, None, None))
    name = "cloud.laz" if kind == REFINE else EXPORTERS[kind][1]
    path = folder / name
    made = path.is_dir() or is_regular(path)
    size = (folder_bytes(path) if path.is_dir() else path.stat().st_size) if made else None
    about = None if points is None or point_bytes is None or million_s is None else points
    return {
        "kind": kind,
        "group": group,
        "title": title,
        "text": REFINED if kind == REFINE else EXPORTERS[kind][2],
        "file": name,
        "bytes": None if kind == REFINE else size,
        "about_bytes": None if about is None else round(about * (point_bytes or 0.0)),
        "about_s": None if about is None else max(round(about * 1e-6 * (million_s or 0.0)), 1),
        "heights": kind in WITH_HEIGHTS,
        "impossible": _obstacle(kind, is_placed),
    }


def _obstacle(kind: str, is_placed: bool) -> str | None:
    """Why a product cannot be made; None where it can."""
    if kind in MAPPED and not is_placed:
        return "needs a georeference"
    missing = [package for package in PACKAGES.get(kind, ()) if find_spec(package) is None]
    return f"needs the package {missing[0]} on the ground station" if missing else None
