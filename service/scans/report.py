"""``report.html``: what a client gets: accuracy, maps, flight, and diagnostics in an appendix.

Images and curves are embedded; the file loads and runs nothing. Printed, or saved as PDF by a
browser, each section begins a page.
"""

from __future__ import annotations

import datetime as dt
import math
from collections.abc import Sequence
from dataclasses import replace
from html import escape
from itertools import pairwise
from typing import Any

import cv2
import numpy as np

from recon.camera_model import rays
from recon.surface.raster import Raster
from recon.types import F64, U8, PointCloud
from service.georeference import map_crs
from service.scans.coverage import Coverage
from service.scans.drawing import Maps, draw_maps
from service.scans.report_appendix import appendix
from service.scans.report_map import map_figure
from service.scans.report_parts import area, embedded, figure, height_sigma_m, length, table, within
from service.stream.records import PoseRecord

STYLE = (
    "body{font:15px/1.5 system-ui,sans-serif;color:#20252b;max-width:960px;margin:24px auto;"
    "padding:0 16px}h1{font-size:30px;margin-bottom:0}h2{font-size:20px;margin-top:36px}"
    "h3{font-size:16px;margin-top:26px}table{border-collapse:collapse;display:block;"
    "overflow-x:auto;margin:12px 0}svg{max-width:100%;height:auto}"
    "td,th{overflow-wrap:break-word;padding:3px 14px 3px 0;text-align:left;"
    "border-bottom:1px solid #e3e7eb}"
    "td+td{font-variant-numeric:tabular-nums}img{max-width:100%;border:1px solid #e3e7eb}"
    "figure{margin:14px 0}figcaption{color:#56606a;font-size:13.5px}text{font-size:11px}"
    "@media(max-width:600px){text{font-size:22px}}"
    "@page{margin:16mm 14mm;@bottom-right{content:counter(page);font:9pt system-ui,sans-serif}}"
    "@media print{body{margin:0;max-width:none;padding:0;font-size:12px;"
    "print-color-adjust:exact}figure,table,tr,h2,h3,h4{break-inside:avoid}"
    "h2,h3,h4{break-after:avoid}section{break-before:page}section.first{break-before:auto}"
    "h2{margin-top:0}img,svg{max-height:110mm;width:auto}.map img{max-height:225mm}"
    ".first img{max-height:130mm}.first td:first-child{min-width:17em}}"
)


def report_html(
    summary: dict[str, Any],
    poses: Sequence[PoseRecord],
    cloud: PointCloud,
    raster: Raster | None,
    coverage: Coverage | None = None,
    keyframe: U8 | None = None,
    maps: Maps | None = None,
) -> str:
    """The report of a scan whose scan.json holds ``summary``.

    ``raster`` is its upper surface in metres about its origin, and ``maps`` show that, or
    orthophoto and surface model; ``keyframe`` shows the stages of one keyframe.
    """
    cover, colour, heights = _map_pages(summary, maps)
    flown = _above_ground(poses, raster)
    sections = [
        ("first", [
            f"<h1>{escape(summary['id'])}</h1>",
            f"<p>Survey report, {_when(summary['times']['started_unix_s'])}</p>",
            *cover,
            table(_cover(summary, coverage, flown)),
        ]),
        ("", [
            "<h2>Accuracy</h2>",
            *(f"<p>{escape(text)}</p>" for text in accuracy_words(summary)),
            *surveyed(summary.get("refinement") or {}),
            "<h2>Flight and camera</h2>",
            table(_flown(summary, flown)),
            "<h2>Coverage</h2>",
            map_figure(summary, poses, coverage),
            table(_covered(coverage)),
        ]),
        *(("map", page) for page in (
            ["<h2>Orthophoto</h2>", *colour], ["<h2>Surface model</h2>", *heights]
        ) if colour),
        ("", ["<h2>Appendix: diagnostics</h2>", *appendix(summary, poses, cloud, raster,
              keyframe), *(f"<p>Note: {escape(str(note))}</p>" for note in summary["notes"]),
              f"<p>{escape(summary['software'])}</p>"]),
    ]  # fmt: skip
    body = "".join(
        f"<section class='{name}'>{''.join(parts)}</section>" for name, parts in sections
    )
    head = (
        "<!doctype html><html lang=en><meta charset=utf-8>"
        "<meta name=viewport content='width=device-width, initial-scale=1'>"
        f"<title>{escape(summary['id'])}"
    )
    return f"{head}</title><style>{STYLE}</style><body>{body}</body></html>\n"


def maps_of(summary: dict[str, Any], poses: Sequence[PoseRecord], raster: Raster) -> Maps:
    """``raster``, in metres about the scan's origin, from above with the track of the poses."""
    track = np.array([p.T_world_camera[:3, 3] for p in poses]).reshape(-1, 3)
    zero_m = summary["origin"]["alt_amsl_m"] if summary["origin"] else 0.0
    return draw_maps(raster, track, 1400, zero_m)


def _map_pages(
    summary: dict[str, Any], maps: Maps | None
) -> tuple[list[str], list[str], list[str]]:
    """A small view from above, the orthophoto and the surface model, with scale and colour bars."""
    if maps is None:
        return [], [], []
    colour, heights, cell_m = maps
    cell = f"one cell is {length(cell_m)}"
    half = cv2.resize(colour, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    small = np.asarray(half, np.uint8)
    pages = (
        (small, "From above, with the flight path."),
        (colour, f"From above, with the flight path; {cell}."),
        (heights, f"Heights in {summary['heights']}, over shaded relief; {cell}."),
    )
    cover, ortho, surface = ([figure(embedded(i), words)] for i, words in pages)
    return cover, ortho, surface


def _cover(
    summary: dict[str, Any], coverage: Coverage | None, poses: Sequence[PoseRecord]
) -> list[tuple[str, str]]:
    """What a reader wants to know first."""
    quality = summary["quality"]
    rows = [("area mapped", area(quality["area_m2"]))]
    pixel_m = _pixel_m(summary, poses)
    if pixel_m is not None:
        rows.append(("ground sample of the images, median", length(pixel_m)))
    rows.append(("ground sample of the map", length(quality["voxel_m"])))
    if coverage is not None:
        f = coverage.figures()
        if f["flown_m2"]:
            share = 1.0 - f["gaps_m2"] / f["flown_m2"]
            rows.append(("measured of the area flown", f"{100.0 * share:.1f} %"))
    if quality["sigma_median_m"] is not None:
        rows.append(("relative uncertainty (1 sigma), median", within(quality["sigma_median_m"])))
    absolute_m = quality.get("sigma_absolute_median_m")
    if absolute_m is not None:
        rows.append(("absolute uncertainty of heights (1 sigma), median", within(absolute_m)))
    rows.append(("trust", "; ".join([quality["trust"]["level"], *quality["trust"]["reasons"]])))
    return rows


def accuracy_words(summary: dict[str, Any]) -> list[str]:
    """Paragraphs on how accurate the map is, and what that rests on."""
    quality, refined = summary["quality"], summary.get("refinement") or {}
    level = quality["trust"]["level"]
    check, control = refined.get("check"), refined.get("control")
    out = []
    if check:
        out.append(
            f"{_count(check['count'], 'check point')}, surveyed and not used for the map, "
            f"{'lies' if check['count'] == 1 else 'lie'} within {_apart(check)} of it (RMS). This "
            "is an independent measure of its accuracy."
        )
    elif control:
        out.append(
            f"{_count(control['count'], 'control point')} placed the map; it passes them within "
            f"{_apart(control)} (RMS). Without check points there is no independent measure."
        )
    elif level == "georeferenced":
        h, v = quality["position_sigma_h_median_m"], height_sigma_m(quality)
        how = (
            ""
            if h is None or v is None
            else f": {within(h)} horizontally and {within(v)} vertically (1 sigma)"
        )
        out.append(
            f"No surveyed point was used. The aircraft's own positions place the map{how}. As a "
            "whole it may be off by as much; distances and height differences within it are better."
        )
    else:
        out.append({
            "scaled": "The map is to scale but not placed on the earth: measure distances, areas "
                      "and volumes in it, not positions.",
            "relative": "The map shows shapes of unknown size: measure nothing in it.",
        }.get(level, "Even the shape of the map is uncertain: measure nothing in it."))  # fmt: skip
    if quality["sigma_median_m"] is not None:
        out.append(
            f"Within the map half of the points are known to {within(quality['sigma_median_m'])}, "
            f"90 % to {within(quality['sigma_90_percent_m'])} (1 sigma)."
        )
    scale = quality.get("scale_sigma")
    if scale is not None and level in ("georeferenced", "scaled"):
        out.append(f"Lengths are to scale within ± {100.0 * scale:.1f} % (1 sigma).")
    return out


def _count(number: int, thing: str) -> str:
    return f"{number} {thing}" + ("" if number == 1 else "s")


def _apart(found: dict[str, Any]) -> str:
    flat, up = length(found["rms_h_after_m"]), found["rms_v_after_m"]
    return f"{flat} horizontally" + ("" if up is None else f" and {length(up)} vertically")


def surveyed(refined: dict[str, Any]) -> list[str]:
    """Each control or check point's offset in the map, before and after; empty without any."""
    if not refined.get("points"):
        return []
    rows = []
    for p in refined["points"]:
        offsets = [_offset(p["before_m"]), _offset(p["after_m"])]
        rows.append([p["name"], p["role"], str(p["marks"]), *offsets, p["refused"] or ""])
    for role in ("control", "check"):
        s = refined.get(role)
        if s:
            apart_m = [(s[f"rms_h_{w}_m"], s[f"rms_v_{w}_m"]) for w in ("before", "after")]
            sums = [", ".join(f"{m:.3f} m" for m in two if m is not None) for two in apart_m]
            rows.append([f"rms of {s['count']}", role, "", *sums, "horizontal, vertical"])
    header = ("point", "role", "marks", "map minus survey before: east, north, up, m", "after", "")
    return ["<h3>Surveyed points</h3>", table(rows, header)]


def _flown(summary: dict[str, Any], poses: Sequence[PoseRecord]) -> list[tuple[str, str]]:
    origin, times = summary["origin"], summary["times"]
    rows = [("drone", summary["drone"]), ("began", _when(times["started_unix_s"]))]
    if poses:
        seconds = times["last_pose_unix_s"] - times["first_pose_unix_s"]
        rows += [
            ("duration", f"{seconds:,.0f} s"),
            ("distance", f"{summary['quality']['distance_m']:,.0f} m"),
            ("speed, median", f"{np.median([p.speed_m_s for p in poses]):.1f} m/s"),
        ]
        heights = [p.agl_m for p in poses if p.agl_m is not None]
        if heights:
            rows.append(("height above ground, median", f"{np.median(heights):.1f} m"))
    rows += _camera(summary, poses)
    if origin is None:
        rows.append(("position", "no georeference: metres about the scan's own origin"))
    else:
        rows.append(("origin", f"{origin['lat_deg']:.7f}, {origin['lon_deg']:.7f}"))
        epsg = summary["epsg"]
        rows.append(("coordinates", f"{map_crs(epsg).name} (EPSG:{epsg}), {summary['heights']}"))
    rows.append(("finished", "yes" if summary["finished"] else "no, still growing or cut off"))
    return rows


def _camera(summary: dict[str, Any], poses: Sequence[PoseRecord]) -> list[tuple[str, str]]:
    """Image size, field of view, ground sample and overlap, as far as they are known."""
    camera = _lens(summary)
    rows = [("images used for the map", f"{summary['counts']['keyframes']:,} keyframes")]
    if camera is None:
        return rows
    K, (w, h) = camera
    across = math.degrees(2.0 * math.atan(0.5 * w / K[0, 0]))
    rows.append(("camera", f"{w:,} x {h:,} pixels, {across:.0f}° wide"))
    pixel_m = _pixel_m(summary, poses)
    if pixel_m is not None:
        rows.append(("ground sample of the images, median", length(pixel_m)))
    shared = overlaps(K, (w, h), poses)
    if shared:
        rows.append(
            ("overlap of successive keyframes, median", f"{100.0 * np.median(shared):.0f} %")
        )
    return rows


def _lens(summary: dict[str, Any]) -> tuple[F64, tuple[int, int]] | None:
    """(3, 3) intrinsics and (W, H); None where the scan does not state them."""
    camera = summary.get("camera") or {}
    try:
        K = np.array(camera["K"], np.float64).reshape(3, 3)
        size = int(camera["width"]), int(camera["height"])
    except (KeyError, TypeError, ValueError):
        return None
    return (K, size) if np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0 else None


def _above_ground(poses: Sequence[PoseRecord], raster: Raster | None) -> Sequence[PoseRecord]:
    """The poses, with their height above the middle of the surface where none was measured."""
    if raster is None or not raster.known.any():
        return poses
    level_m = float(np.nanmedian(raster.height_m))
    up_m = [float(p.T_world_camera[2, 3]) - level_m for p in poses]
    return [
        replace(p, agl_m=up) if p.agl_m is None and up > 0.0 else p
        for p, up in zip(poses, up_m, strict=True)
    ]


def _pixel_m(summary: dict[str, Any], poses: Sequence[PoseRecord]) -> float | None:
    camera = _lens(summary)
    heights = [p.agl_m for p in poses if p.agl_m is not None]
    return float(np.median(heights)) / camera[0][0, 0] if camera and heights else None


def overlaps(K: F64, size_px: tuple[int, int], poses: Sequence[PoseRecord]) -> list[float]:
    """Share of the ground in each keyframe's image that the one before shows too, on level ground.
    Images that reach to the horizon are left out."""
    w, h = size_px
    corners = np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]]) - 0.5
    prints = []
    for p in poses:
        if p.keyframe_seq is None or p.agl_m is None:
            continue
        ways = rays(K, corners) @ p.T_world_camera[:3, :3].T
        if (ways[:, 2] < -0.1 * np.linalg.norm(ways, axis=1)).all():
            places = p.T_world_camera[:3, 3] - ways * (p.agl_m / ways[:, 2])[:, None]
            prints.append(places[:, :2].astype(np.float32))
    out = []
    for before, after in pairwise(prints):
        middle = after.mean(axis=0)
        both, _ = cv2.intersectConvexConvex(before - middle, after - middle)
        out.append(float(both) / max(cv2.contourArea(after - middle), 1e-9))
    return out


def _covered(coverage: Coverage | None) -> list[tuple[str, str]]:
    if coverage is None:
        return []
    f = coverage.figures()
    return [
        ("area flown", area(f["flown_m2"])),
        ("of it without a surface", area(f["gaps_m2"])),
        ("of it weak (skyrelief refly plans a flight over it)", area(f["weak_m2"])),
        ("images per place, median", f"{f['views_median']:.0f}"),
    ]


def _when(unix_s: float) -> str:
    when = dt.datetime.fromtimestamp(unix_s, dt.timezone.utc)
    return when.strftime("%Y-%m-%d %H:%M:%S UTC")


def _offset(values: Sequence[float | None] | None) -> str:
    """East, north and, where it was surveyed, up."""
    if values is None or max(abs(v or 0.0) for v in values) > 1e4:
        return ""
    return "  ".join(f"{v:+.3f}" for v in values if v is not None)
