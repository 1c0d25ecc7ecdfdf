"""``skyrelief site``: several scans as one site."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from service.errors import InputError

ACTIONS = ("align", "compare")


def site(
    action: Annotated[str, typer.Argument(help="align or compare")],
    scans: Annotated[list[Path], typer.Argument(help="scan folders; compare: before and after")],
    out: Annotated[Path, typer.Option("--out", help="folder of the site")],
    cell_m: Annotated[
        float | None, typer.Option("--cell-m", help="compare: cell size; default: pixel on ground")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object at the end")] = False,
) -> None:
    """Join scans that overlap into one site, or measure what changed between two.

    The scans stay as they are. A site's folder is a scan folder: ``export``, ``mesh`` and
    ``refine --gcp`` work on it.
    """
    if action not in ACTIONS:
        raise InputError(f"site {action}: there are {', '.join(ACTIONS)}")
    if action == "align":
        from service.offline.site.alignment import align_site

        figures = align_site(scans, out).document
        print(json.dumps(figures) if as_json else "\n".join(_aligned_lines(out, figures)))
        return
    from service.offline.site.compare import compare
    from service.packages import needing

    if len(scans) != 2:
        raise InputError(f"site compare takes two scans, before and after, not {len(scans)}")
    with needing("a change map"):
        figures = compare(scans[0], scans[1], out, cell_m)
    print(json.dumps(figures) if as_json else "\n".join(_change_lines(out, figures)))


def _aligned_lines(out: Path, figures: dict[str, Any]) -> list[str]:
    lines = [f"{out}: {len(figures['scans'])} scan(s), revision {figures['revision']}"]
    for scan in figures["scans"]:
        east, north, up = scan["moved_m"]
        lines.append(
            f"  {scan['name']:<20}{scan['placed']:<14} moved {east:+.2f} {north:+.2f} {up:+.2f} m, "
            f"{scan['turned_deg']:.2f} deg, scale {scan['scale']:.4f}"
        )
    for pair in figures["pairs"]:
        lines.append(
            f"  {pair['a']} - {pair['b']}: {pair['ties']} ties, "
            f"{pair['apart_before_m']:.2f} -> {pair['apart_after_m']:.2f} m apart"
        )
    return lines + [f"note: {note}" for note in figures["notes"]]


def _change_lines(out: Path, figures: dict[str, Any]) -> list[str]:
    lines = [figures["in_words"]]
    for number, one in enumerate(figures["objects"], 1):
        lines.append(
            f"  {number:>3} {one['kind']:<8} {one['area_m2']:7.1f} m2 {one['volume_m3']:+8.2f} "
            f"+- {1.96 * one['sigma_m3']:.2f} m3 at {one['east_m']:.1f} {one['north_m']:.1f}"
        )
    return [*lines, f"written to {out}: change.tif, change.gpkg, change.html, change.json"] + [
        f"note: {note}" for note in figures["notes"]
    ]
