"""The flight for maps and for other reconstruction tools: GeoJSON, KML, COLMAP."""

from __future__ import annotations

import datetime as dt
import json
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import cv2
import numpy as np

from recon import se3
from recon.types import F64, Keyframe
from service.georeference import LocalFrame
from service.offline.exports.view import ExportOptions, ScanView
from service.scans.main_piece import main_keyframes
from service.scans.writing import write_whole, writing_folder


def _geodetic(scan: ScanView, frame: LocalFrame) -> F64:
    """(N, 3) latitude, longitude, height of the trajectory."""
    if not scan.poses:
        return np.zeros((0, 3))
    return frame.to_geodetic(np.array([p.T_world_camera[:3, 3] for p in scan.poses]))


def iso_time(time_unix_ns: int) -> str:
    """RFC 3339 to the millisecond."""
    when = dt.datetime.fromtimestamp(time_unix_ns / 1e9, dt.timezone.utc)
    return when.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def write_geojson(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """The track as one line, and a point per keyframe with its time, attitude and sigma."""
    frame = scan.needs_place("a map of the flight")
    geodetic = _geodetic(scan, frame)
    places = [[round(g[1], 8), round(g[0], 8), round(g[2], 3)] for g in geodetic.tolist()]
    header = scan.store.header
    features: list[dict[str, Any]] = []
    if len(places) > 1:
        features.append(
            {
                "type": "Feature",
                "properties": {"scan": header.scan_id, "drone": header.drone},
                "geometry": {"type": "LineString", "coordinates": places},
            }
        )
    for one in main_keyframes(scan.store):
        place_m = one.depth.T_world_camera[:3, 3]
        lat, lon, alt = frame.to_geodetic(place_m[None])[0]
        features.append(
            {
                "type": "Feature",
                "properties": {
                    "keyframe": one.seq,
                    "time": iso_time(one.time_ns),
                    "points": int(one.fresh.sum()),
                    "sigma_m": round(se3.sigma_at(place_m, one.pose.covariance), 4),
                },
                "geometry": {
                    "type": "Point",
                    "coordinates": [round(lon, 8), round(lat, 8), round(alt, 3)],
                },
            }
        )
    write_whole(out, json.dumps({"type": "FeatureCollection", "features": features}))


def write_kml(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """The track with its times; heights above mean sea level, as KML demands."""
    geodetic = _geodetic(scan, scan.flown_frame or scan.needs_place("a map of the flight"))
    whens = "".join(f"<when>{iso_time(p.time_unix_ns)}</when>" for p in scan.poses)
    places = "".join(f"<gx:coord>{g[1]:.8f} {g[0]:.8f} {g[2]:.3f}</gx:coord>" for g in geodetic)
    name = escape(scan.store.header.scan_id)
    text = (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2">'
        f"<Document><name>{name}</name><Placemark><name>{name}</name><gx:Track>"
        f"<altitudeMode>absolute</altitudeMode>{whens}{places}"
        "</gx:Track></Placemark></Document></kml>\n"
    )
    write_whole(out, text)


def write_colmap(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """A folder: ``images/`` and ``sparse/0/`` with cameras, images and points as text.

    World coordinates are the scan's ENU metres. Images are the keyframes as stored,
    without distortion; the points are the fused cloud.
    """
    with writing_folder(out) as part:
        (part / "images").mkdir()
        model = part / "sparse" / "0"
        model.mkdir(parents=True)
        cameras: dict[tuple[float, ...], int] = {}
        with open(model / "images.txt", "w", encoding="ascii") as images:
            for one in main_keyframes(scan.store):
                number = cameras.setdefault(_pinhole(one), len(cameras) + 1)
                images.write(_image_lines(one, number))
                cv2.imwrite(str(part / "images" / _name(one)), one.bgr)
        lines = (
            f"{n} PINHOLE {int(c[0])} {int(c[1])} {c[2]:.9g} {c[3]:.9g} {c[4]:.9g} {c[5]:.9g}\n"
            for c, n in cameras.items()
        )
        (model / "cameras.txt").write_text("".join(lines), encoding="ascii")
        with open(model / "points3D.txt", "w", encoding="ascii") as points:
            cloud = scan.fused.cloud
            rows = zip(cloud.xyz_m.tolist(), cloud.rgb.tolist(), strict=True)
            for n, (xyz, rgb) in enumerate(rows, 1):
                place = f"{xyz[0]:.4f} {xyz[1]:.4f} {xyz[2]:.4f}"
                points.write(f"{n} {place} {rgb[0]} {rgb[1]} {rgb[2]} 0\n")


def _pinhole(one: Keyframe) -> tuple[float, ...]:
    """Width, height, fx, fy, cx, cy in COLMAP's pixels, whose centres lie at halves."""
    h, w = one.depth.depth_m.shape
    K = one.depth.K
    values = (w, h, K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5)
    return tuple(round(float(v), 6) for v in values)


def _name(one: Keyframe) -> str:
    return f"keyframe_{one.seq:06d}.jpg"


def _image_lines(one: Keyframe, camera: int) -> str:
    """The two lines of an image: world to camera, then no 2D points."""
    T = se3.inverse(one.depth.T_world_camera)
    q = se3.quaternion_from_rotation(T[:3, :3])
    numbers = " ".join(f"{v:.9f}" for v in (*q, *T[:3, 3]))
    return f"{one.seq + 1} {numbers} {camera} {_name(one)}\n\n"
