"""The flight for maps: GeoJSON, KML."""

from __future__ import annotations

import datetime as dt
from dataclasses import replace
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

from recon import se3
from recon.types import F64
from service.errors import InputError
from service.georeference import Feature, LocalFrame, geojson_of, height_change, line_geometry
from service.offline.exports.view import ExportOptions, ScanView
from service.scans.main_piece import main_keyframes
from service.scans.writing import write_whole

KML_DATUM = "EGM96"


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
    header = scan.store.header
    features: list[Feature] = []
    if len(geodetic) > 1:
        flown = {"scan": header.scan_id, "drone": header.drone}
        features.append((flown, line_geometry(geodetic[:, [1, 0, 2]])))
    for one in main_keyframes(scan.store):
        place_m = one.depth.T_world_camera[:3, 3]
        lat, lon, alt = frame.to_geodetic(place_m[None])[0]
        properties = {
            "keyframe": one.seq,
            "time": iso_time(one.time_ns),
            "points": int(one.fresh.sum()),
            "sigma_m": round(se3.sigma_at(place_m, one.pose.covariance), 4),
        }
        place = [round(lon, 8), round(lat, 8), round(alt, 3)]
        features.append((properties, {"type": "Point", "coordinates": place}))
    write_whole(out, geojson_of(features))


def write_kml(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """The track with its times; heights above EGM96, as KML demands.

    Heights of another datum that PROJ cannot convert are not shown: the track lies on the ground.
    """
    frame = scan.flown_frame or scan.needs_place("a map of the flight")
    mode, words = "absolute", ""
    try:
        flown = options.vertical_datum or KML_DATUM
        change = height_change(flown, KML_DATUM, frame.lat_deg, frame.lon_deg)
        geodetic = _geodetic(scan, replace(frame, heights=change))
    except InputError as error:
        geodetic, mode = _geodetic(scan, frame), "clampToGround"
        words = f"<description>Without heights: {escape(str(error))}</description>"
    whens = "".join(f"<when>{iso_time(p.time_unix_ns)}</when>" for p in scan.poses)
    places = "".join(f"<gx:coord>{g[1]:.8f} {g[0]:.8f} {g[2]:.3f}</gx:coord>" for g in geodetic)
    name = escape(scan.store.header.scan_id)
    text = (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2">'
        f"<Document><name>{name}</name><Placemark><name>{name}</name>{words}<gx:Track>"
        f"<altitudeMode>{mode}</altitudeMode>{whens}{places}"
        "</gx:Track></Placemark></Document></kml>\n"
    )
    write_whole(out, text)
