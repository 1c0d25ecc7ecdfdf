"""``skyrelief refly``: a second flight over what the first saw too little of."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer


def refly(
    scan_dir: Annotated[Path, typer.Argument(help="scan folder (holds scan.db)")],
    out: Annotated[
        Path | None,
        typer.Option(help=".plan (QGroundControl) or .waypoints; default: refly.plan in the scan"),
    ] = None,
    overlap: Annotated[float, typer.Option(help="of neighbouring lines' pictures, 0 to 0.9")] = 0.6,
    views: Annotated[
        int | None, typer.Option(help="pictures below which a place is weak; default 3")
    ] = None,
    sigma_m: Annotated[
        float | None, typer.Option(help="sigma above which it is; default 3 times the median")
    ] = None,
    relative: Annotated[
        bool, typer.Option("--relative", help="heights above home instead of sea level")
    ] = False,
    photos: Annotated[
        bool, typer.Option("--photos", help="photographs at intervals instead of video")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object at the end")] = False,
) -> None:
    """Lines over gaps, places seen too seldom and places of large sigma, as a mission file."""
    from dataclasses import replace

    import numpy as np

    from service.errors import InputError
    from service.exports.view import ScanView
    from service.refine.refly import plan_json, suggest, waypoints_text
    from service.scans.coverage import coverage_of
    from service.scans.writing import writing

    path = out or scan_dir / "refly.plan"
    if path.suffix not in (".plan", ".waypoints"):
        raise InputError(f"--out {path}: name it .plan (QGroundControl) or .waypoints")
    if (views is not None and views < 1) or (sigma_m is not None and not sigma_m > 0):
        raise InputError("--views must be at least 1 and --sigma-m positive")
    with ScanView(scan_dir) as scan:
        found = coverage_of(scan.store)
        if found is None:
            raise InputError(f"{scan_dir} holds no surface; there is nothing to compare with")
        limits = found.limits
        if views is not None:
            limits = replace(limits, least_views=views)
        if sigma_m is not None:
            limits = replace(limits, most_sigma_m=sigma_m)
        found = replace(found, limits=limits)
        heights = [p.agl_m for p in scan.poses if p.agl_m is not None]
        height = float(np.median(heights)) if heights else None
        moving = [p.speed_m_s for p in scan.poses if p.speed_m_s > 0.2]
        speed = float(np.median(moving)) if moving else 3.0
        flight = suggest(found, speed, height, overlap, relative, photos)
    if flight is None:
        nothing = {"lines": 0, "weak_m2": 0.0, "plan": None}
        print(json.dumps(nothing) if as_json else "nothing is weak; no flight is needed")
        return
    text = waypoints_text(flight) if path.suffix == ".waypoints" else plan_json(flight)
    with writing(path) as part:
        part.write_text(text, encoding="utf-8")
    swath = flight.swath
    figures: dict[str, Any] = {
        "plan": str(path),
        "lines": len(flight.lines),
        "patches": flight.patches,
        "weak_m2": round(flight.weak_m2, 1),
        "length_m": round(flight.length_m, 1),
        "seconds": round(flight.length_m / max(swath.speed_m_s, 1.0)),
        "spacing_m": round(flight.spacing_m, 1),
        "altitude_amsl_m": round(swath.altitude_amsl_m, 1),
        "picture_m": [round(swath.across_m, 1), round(swath.along_m, 1)],
    }
    if as_json:
        print(json.dumps(figures))
        return
    print(
        f"{path}: {len(flight.lines)} line(s) over {flight.weak_m2:.0f} m2 in {flight.patches} "
        f"place(s), {flight.length_m:.0f} m, {figures['seconds']} s at {swath.speed_m_s:.1f} m/s, "
        f"{swath.altitude_amsl_m:.0f} m above sea level"
    )
