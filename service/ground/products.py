"""What can be made of a scan, for the portal's export dialog: each product with what it is, the
file that there is, and about how large it becomes and how long it takes."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

from service.ground.state import KINDS, REFINE
from service.ground.storage import folder_bytes, is_regular
from service.offline.exports import EXPORTERS, MAPPED, PACKAGES

PRODUCTS: dict[str, tuple[str, str, float, float, bool]] = {
    "laz": ("Cloud", "Cloud, LAZ", 10.0, 6.0, True),
    "copc": ("Cloud", "Cloud, COPC", 10.0, 7.0, True),
    "ply": ("Cloud", "Cloud, PLY", 32.0, 5.0, True),
    "3dtiles": ("Cloud", "Cloud, 3D Tiles", 15.0, 10.0, True),
    "all": ("Maps", "All maps", 38.0, 25.0, True),
    "ortho": ("Maps", "Orthophoto, GeoTIFF", 11.0, 15.0, False),
    "dsm": ("Maps", "Surface model, GeoTIFF", 7.0, 10.0, True),
    "dtm": ("Maps", "Bare ground, GeoTIFF", 2.5, 6.0, True),
    "contours": ("Maps", "Contours, GeoJSON", 0.05, 6.0, True),
    "gpkg": ("Maps", "Contours, GeoPackage", 0.1, 6.0, True),
    "dxf": ("Maps", "Contours, DXF", 0.06, 6.0, True),
    "coverage": ("Maps", "Coverage, GeoTIFF", 0.2, 2.0, True),
    "kmz": ("Maps", "Orthophoto, KMZ", 3.0, 2.0, False),
    "stac": ("Maps", "STAC item", 0.002, 1.0, False),
    "report": ("Maps", "Report, HTML", 10.0, 5.0, False),
    "glb": ("Models", "Mesh, glTF", 30.0, 60.0, False),
    "obj": ("Models", "Mesh, OBJ", 70.0, 80.0, True),
    "3dtiles-mesh": ("Models", "Mesh, 3D Tiles", 30.0, 100.0, True),
    "splat": ("Models", "3D Gaussians, PLY", 320.0, 100.0, False),
    "geojson": ("Flight", "Track, GeoJSON", 0.04, 1.0, True),
    "kml": ("Flight", "Track, KML", 0.06, 1.0, False),
    "mcap": ("Flight", "Recording, Foxglove", 16.0, 3.0, False),
    "ros2": ("Flight", "Recording, ROS 2", 16.0, 4.0, False),
    "colmap": ("Flight", "Images and poses, COLMAP", 20.0, 10.0, False),
    REFINE: ("Improve", "Refined scan", 10.0, 60.0, False),
}
"""Group, title, bytes of a fused point and seconds of a million of them, on two cores, and whether
its heights can be converted."""

OTHER_JOBS = {"align": "Alignment", "scan": "Replay"}
"""Titles of the jobs that make no product; an upload is replayed to a scan."""

REFINED = "Adjusts all poses to each other once more, then makes the scan's files again."


def products_of(folder: Path, points: int | None, is_placed: bool) -> list[dict[str, Any]]:
    """One entry for each kind of product of the scan in ``folder``, for JSON.

    ``points`` are those of its cloud, None while they are not counted; ``is_placed`` says whether
    it has a georeference.
    """
    kinds = dict.fromkeys((*PRODUCTS, *KINDS))
    return [_product(folder, kind, points, is_placed) for kind in kinds if kind in KINDS]


def job_title(kind: str) -> str:
    """What a job of this kind makes, in the words of the page."""
    found = PRODUCTS.get(kind)
    return OTHER_JOBS.get(kind, kind) if found is None else found[1]


def _product(folder: Path, kind: str, points: int | None, is_placed: bool) -> dict[str, Any]:
    other = ("Other", kind, 0.0, 0.0, False)
    group, title, point_bytes, million_s, has_heights = PRODUCTS.get(kind, other)
    name = "cloud.laz" if kind == REFINE else EXPORTERS[kind][1]
    path = folder / name
    made = path.is_dir() or is_regular(path)
    size = (folder_bytes(path) if path.is_dir() else path.stat().st_size) if made else None
    about = points if point_bytes else None
    return {
        "kind": kind,
        "group": group,
        "title": title,
        "text": REFINED if kind == REFINE else EXPORTERS[kind][2],
        "file": name,
        "bytes": None if kind == REFINE else size,
        "about_bytes": None if about is None else round(about * point_bytes),
        "about_s": None if about is None else max(round(about * 1e-6 * million_s), 1),
        "heights": has_heights,
        "impossible": obstacle(kind, is_placed),
    }


def obstacle(kind: str, is_placed: bool) -> str | None:
    """Why a product cannot be made; None where it can."""
    if kind in MAPPED and not is_placed:
        return "needs a georeference"
    missing = [package for package in PACKAGES.get(kind, ()) if find_spec(package) is None]
    return f"needs the package {missing[0]} on the ground station" if missing else None
