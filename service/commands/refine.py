"""``skyrelief refine`` and ``refly``: a finished scan adjusted, or flown again where it is weak."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from service.commands import AsJson, ScanDir, showing
from service.errors import InputError


def refine(
    scan_dir: ScanDir,
    gcp: Annotated[
        Path | None,
        typer.Option(help="CSV, gcp_list.txt or Metashape XML of control points (docs/refine.md)"),
    ] = None,
    marks: Annotated[
        Path | None, typer.Option(help="marks of those points as a file of their own, as Pix4D's")
    ] = None,
    telemetry: Annotated[
        Path | None, typer.Option(help="flight log; default: link.tlog next to the scan, if any")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="folder for the refined scan; default: in place")
    ] = None,
    loops: Annotated[bool, typer.Option(help="search for loops")] = True,
    intrinsics: Annotated[
        bool, typer.Option("--intrinsics", help="only estimate the camera model; needs --video")
    ] = False,
    video: Annotated[
        Path | None,
        typer.Option(help="the flight's recording or folder of stills: match its images again"),
    ] = None,
    undo: Annotated[bool, typer.Option("--undo", help="restore the scan as flown")] = False,
    as_json: AsJson = False,
) -> None:
    """Adjust all keyframes at once to loops, telemetry and ground control points.

    Keyframes keep their numbers; --undo restores the poses of the flight. The scan's files are
    written again.
    """
    from service.offline.refine.refinement import RefineOptions
    from service.offline.refine.refinement import intrinsics as run_intrinsics
    from service.offline.refine.refinement import refine as run
    from service.offline.refine.refinement import undo as run_undo
    from service.scans.writing import check_writable

    if marks and not gcp:
        raise InputError("--marks needs --gcp with the points")
    if scan_dir.is_dir() and not intrinsics:
        check_writable(out or scan_dir, is_folder=True)
    lines = _lines
    with showing("refine") as progress:
        if intrinsics:
            if video is None:
                raise InputError("--intrinsics needs --video FILE")
            if gcp or undo:
                raise InputError("--intrinsics takes --video, --telemetry and --out only")
            figures, lines = (
                run_intrinsics(scan_dir, video, telemetry, out, progress),
                _camera_lines,
            )
        elif undo:
            if gcp or marks or telemetry or out or video:
                raise InputError("--undo takes nothing else")
            figures = run_undo(scan_dir)
        else:
            options = RefineOptions(gcp, telemetry, out, loops, video, marks)
            figures = run(scan_dir, options, progress)
    print(json.dumps(figures) if as_json else "\n".join(lines(figures)))


def _camera_lines(figures: dict[str, Any]) -> list[str]:
    (f_old, f_new), (c_old, c_new) = figures["focal_px"], figures["centre_px"]
    (k_old, k_new), (before, after) = figures["k1_k2"], figures["rms_px"]
    p_old, p_new = figures["p1_p2"]
    return [
        f"focal length {f_old:.1f} -> {f_new:.1f} px (+- {figures['sigma_focal_percent']:.2f} %), "
        f"centre {c_old[0]:.1f} {c_old[1]:.1f} -> {c_new[0]:.1f} {c_new[1]:.1f}, "
        f"k1 k2 {k_old[0]:.4f} {k_old[1]:.4f} -> {k_new[0]:.4f} {k_new[1]:.4f}, "
        f"p1 p2 {p_old[0]:.4f} {p_old[1]:.4f} -> {p_new[0]:.4f} {p_new[1]:.4f}; "
        f"pixels off by {before:.2f} -> {after:.2f} (rms)",
        f"written to {figures['camera_file']}; the scan is unchanged: replay the flight with it as "
        "--camera-model",
    ] + [f"note: {note}" for note in figures["notes"]]


def _lines(figures: dict[str, Any]) -> list[str]:
    where, count = figures["scan_folder"], figures["keyframes"]
    if figures.get("undone"):
        return [f"{where}: {count} keyframes are back where the flight left them"]
    moved, found = figures["moved_m"], figures["loops"]
    out = [
        f"{where}: {count} keyframes moved by {moved['median']:.2f} m "
        f"(most {moved['most']:.2f} m), scale {figures['scale']:.4f}; "
        f"loops: {found['used']} used of {found['verified']} verified"
    ]
    if images := figures.get("images"):
        before, after = images["focal_px"]
        out.append(
            f"{images['views']} images tied by {images['sightings']} sightings of "
            f"{images['places']} places; focal length {before:.1f} -> {after:.1f} px"
        )
    if not figures["changed"]:
        out[0] += "; nothing new since the last refinement"
    step = found["step_m"]
    if step is not None:
        out.append(
            f"step where ground was seen twice: {step['before']['median']:.2f} -> "
            f"{step['after']['median']:.2f} m (most {step['before']['most']:.2f} -> "
            f"{step['after']['most']:.2f} m)"
        )
    for p in figures["points"]:
        line = f"  {p['role']:<8}{p['name']:<12}{p['marks']:>3} marks"
        for name in ("before_m", "after_m", "left_out_m"):
            if p[name] is not None and not p["refused"]:
                known = (f"{v:+.2f}" for v in p[name] if v is not None)
                line += f"  {name[:-2].replace('_', ' ')} {' '.join(known)}"
        out.append(line + (f"  REFUSED: {p['refused']}" if p["refused"] else ""))
    for role in ("control", "check"):
        s = figures[role]
        if s:
            line = (
                f"{role} points ({s['count']}), rms: horizontal {s['rms_h_before_m']:.2f} -> "
                f"{s['rms_h_after_m']:.2f} m"
            )
            if s["rms_v_after_m"] is not None:
                line += f", vertical {s['rms_v_before_m']:.2f} -> {s['rms_v_after_m']:.2f} m"
            out.append(line)
    return out + [f"note: {note}" for note in figures["notes"]]


def refly(
    scan_dir: ScanDir,
    out: Annotated[
        Path | None,
        typer.Option(help=".plan (QGroundControl) or .waypoints; default: refly.plan in the scan"),
    ] = None,
    overlap: Annotated[float, typer.Option(help="overlap of neighbouring lines, 0 to 0.9")] = 0.6,
    views: Annotated[
        int | None, typer.Option(help="a place in fewer images is weak; default 3")
    ] = None,
    sigma_m: Annotated[
        float | None, typer.Option(help="a place of larger sigma is weak; default: 3 medians")
    ] = None,
    relative: Annotated[
        bool, typer.Option("--relative", help="heights above home instead of sea level")
    ] = False,
    photos: Annotated[
        bool, typer.Option("--photos", help="photographs at intervals instead of video")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Plan a mission over gaps, places in too few images and places of large sigma."""
    from service.offline.exports.view import ScanView
    from service.offline.refine.refly import NO_FLIGHT, plan_json, suggest, waypoints_text
    from service.scans.coverage import coverage_of
    from service.scans.writing import check_writable, write_whole

    path = out or scan_dir / "refly.plan"
    if path.suffix not in (".plan", ".waypoints"):
        raise InputError(f"--out {path}: name it .plan (QGroundControl) or .waypoints")
    if (views is not None and views < 1) or (sigma_m is not None and not sigma_m > 0):
        raise InputError("--views must be at least 1 and --sigma-m positive")
    if not 0.0 <= overlap <= 0.9:
        raise InputError(f"--overlap {overlap:g}: give 0 to 0.9")
    if scan_dir.is_dir():
        check_writable(path)
    with ScanView(scan_dir) as scan:
        found = coverage_of(scan.store)
        if found is None:
            raise InputError(f"{scan_dir} contains no surface; there is nothing to compare with")
        found = replace(
            found,
            min_views=found.min_views if views is None else views,
            max_sigma_m=found.max_sigma_m if sigma_m is None else sigma_m,
        )
        flight = suggest(found, scan.poses, overlap, relative, photos)
    if flight is None:
        print(json.dumps({"lines": 0, "weak_m2": 0.0, "plan": None}) if as_json else NO_FLIGHT)
        return
    write_whole(path, waypoints_text(flight) if path.suffix == ".waypoints" else plan_json(flight))
    swath, lines = flight.swath, len(flight.lines)
    if as_json:
        figures = {
            "plan": str(path),
            "lines": lines,
            "patches": flight.patches,
            "weak_m2": round(flight.weak_m2, 1),
            "length_m": round(flight.length_m, 1),
            "seconds": flight.seconds,
            "spacing_m": round(flight.spacing_m, 1),
            "altitude_amsl_m": round(swath.altitude_amsl_m, 1),
            "picture_m": [round(swath.across_m, 1), round(swath.along_m, 1)],
        }
        print(json.dumps(figures))
    else:
        print(
            f"{path}: {lines} line(s) over {flight.weak_m2:.0f} m2 in {flight.patches} place(s), "
            f"{flight.length_m:.0f} m, {flight.seconds} s at {swath.speed_m_s:.1f} m/s, "
            f"{swath.altitude_amsl_m:.0f} m above sea level"
        )
