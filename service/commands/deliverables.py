"""``skyrelief export``, ``mesh``, ``inspect`` and ``site``: files of one scan, or of several."""

from __future__ import annotations

import json
import logging
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from service.commands import AsJson, ScanDir, Scheduler, TilePoints, Voxel, choices, one_of, showing
from service.errors import InputError, refusing
from service.offline.exports import EXPORTERS, kind_of
from service.packages import needing

OutFile = Annotated[Path | None, typer.Option(help="file to write; default: in the scan folder")]
Recording = Annotated[
    Path | None,
    typer.Option(help="the flight's video or folder of images; default: as named in scan.json"),
]
StoredImages = Annotated[
    bool, typer.Option("--stored", help="use the scan's own small images, not the recording")
]
RecordingStart = Annotated[
    float | None, typer.Option(help="unix seconds of its start; default: the scan's start")
]


def export(
    scan_dir: ScanDir,
    to: Annotated[
        list[str] | None,
        typer.Option(
            help="what to write, of the list above; may be repeated",
            autocompletion=choices(EXPORTERS),
        ),
    ] = None,
    out: OutFile = None,
    voxel_m: Voxel = None,
    cell_m: Annotated[float | None, typer.Option(help="cell size of dsm, ortho, contours")] = None,
    contour_m: Annotated[float, typer.Option(help="contour interval")] = 1.0,
    strict: Annotated[
        bool,
        typer.Option("--strict", help="surface model: leave unknown what band 3 does not call 0"),
    ] = False,
    video: Recording = None,
    stored: StoredImages = False,
    video_epoch: RecordingStart = None,
    vertical_datum: Annotated[
        str | None,
        typer.Option(help="of the heights as flown, if known: ellipsoid, EGM96, EGM2008, EPSG:n"),
    ] = None,
    to_datum: Annotated[
        str | None, typer.Option(help="convert heights to this vertical datum, by PROJ's grids")
    ] = None,
    tile_points: TilePoints = 20_000_000,
    scheduler: Scheduler = None,
    train_steps: Annotated[
        int,
        typer.Option(min=0, help="splat: steps of training, by gsplat on a CUDA device"),
    ] = 0,
    as_json: AsJson = False,
) -> None:
    """Write deliverables of a scan: clouds, surface model, orthophoto, tiles, mesh, flight."""
    if not to:
        if not as_json:
            print(product_list())
        raise InputError("name what to export with --to, such as --to dsm")
    from service.offline.exports.maps import write_kinds
    from service.offline.exports.view import ExportOptions, ScanView
    from service.scans.folder import Failures

    if out is not None and len(to) > 1:
        raise InputError("--out names one file; give one --to with it")
    for kind in to:
        kind_of(kind, out)
    with refusing("export"):
        options = ExportOptions(
            voxel_m, cell_m, contour_m, strict, video, stored, _epoch_ns(video_epoch),
            vertical_datum, to_datum, tile_points, scheduler, train_steps,
        )  # fmt: skip
    kinds = list(dict.fromkeys(to))
    with showing("export") as progress, ScanView(scan_dir, voxel_m, progress) as scan:
        failures = Failures(scan_dir, logging.DEBUG)
        done = write_kinds(
            scan, kinds, lambda kind: out or scan_dir / EXPORTERS[kind][1], options, failures
        )
    written = {kind: str(done[kind]) for kind in kinds if kind in done}
    report = {"scan": str(scan_dir), "written": written, "failed": failures.why}
    if failures.first is not None:
        failures.first.report = report
    elif as_json:
        print(json.dumps(report))
    if written and not as_json:
        print(*written.values(), sep="\n")
    for kind, why in list(failures.why.items())[1:]:
        print(f"not written: {kind}: {why}", file=sys.stderr)
    if failures.first is not None:
        raise failures.first


def product_list() -> str:
    """A line for each deliverable: its name, its file, what it is."""
    wide = max(map(len, EXPORTERS)) + 2
    return "\n".join(
        f"{kind:<{wide}}{file:<19}{words}" for kind, (_, file, words) in EXPORTERS.items()
    )


export.__doc__ = f"{export.__doc__}\n\n\b\n{product_list()}"


def _epoch_ns(seconds: float | None) -> int | None:
    return None if seconds is None else round(seconds * 1e9)


def mesh(
    scan_dir: ScanDir,
    faces: Annotated[int, typer.Option(min=100, help="triangles at most")] = 400_000,
    voxel_m: Voxel = None,
    video: Recording = None,
    stored: StoredImages = False,
    video_epoch: RecordingStart = None,
    tile_points: TilePoints = 20_000_000,
    scheduler: Scheduler = None,
    out: OutFile = None,
    as_json: AsJson = False,
) -> None:
    """Mesh and texture a scan into one binary glTF file."""
    from service.offline.exports.model import write_mesh
    from service.offline.exports.view import ExportOptions, ScanView
    from service.scans.writing import check_writable

    with refusing("mesh"):
        options = ExportOptions(
            voxel_m=voxel_m, video=video, stored=stored, video_epoch_ns=_epoch_ns(video_epoch),
            tile_points=tile_points, scheduler=scheduler,
        )  # fmt: skip
    if stored and video is not None:
        raise InputError("mesh: give either --video or --stored")
    kind_of("glb", out)
    path = out or scan_dir / "mesh.glb"
    if scan_dir.is_dir():
        check_writable(path)
    started = time.monotonic()
    with showing("mesh") as progress, ScanView(scan_dir, voxel_m, progress) as scan:
        figures = write_mesh(scan, path, faces, options)
    figures["seconds"] = round(time.monotonic() - started, 1)
    if as_json:
        print(json.dumps({"file": str(path)} | figures))
    else:
        print(
            f"{path}: {figures['faces']} triangles in {figures['tiles']} tile(s), "
            f"{figures['measured']:.0%} measured, {figures['seen']:.0%} seen by an image, "
            f"{figures['seconds']} s"
        )


def inspect(
    scan_dir: ScanDir,
    keyframe: Annotated[
        int | None, typer.Option(help="number of the keyframe; default: a middle one")
    ] = None,
    out: OutFile = None,
    as_json: AsJson = False,
) -> None:
    """Draw raw and rectified frames, anaglyph, disparity, depth and sigma of a keyframe.

    The stages before depth need a scan made with --set scan.keep_debug=true; other scans show
    the stored keyframe.
    """
    import cv2
    import numpy as np

    from service.offline.exports.view import ScanView
    from service.scans.drawing import middle_keyframe, stages
    from service.scans.writing import check_writable, write_whole

    if out is not None and out.suffix.lower() != ".png":
        raise InputError(f"{out}: the image is written as .png")
    if scan_dir.is_dir():
        check_writable(out or scan_dir / "keyframe.png")
    with ScanView(scan_dir) as scan:
        seqs = scan.store.seqs()
        seq = middle_keyframe(scan_dir, scan.store, seqs) if keyframe is None else keyframe
        if not seqs or seq is None:
            raise InputError(f"{scan_dir} contains no keyframes yet; nothing to inspect")
        found = scan.store.keyframe(seq) if seq in seqs else None
        if found is None:
            raise InputError(f"{scan_dir}: no keyframe {seq}; there are {seqs[0]} to {seqs[-1]}")
    image, complete = stages(scan_dir, scan.store.header.scan_id, found)
    path = out or scan_dir / f"keyframe_{seq:06d}.png"
    write_whole(path, cv2.imencode(".png", image)[1].tobytes())
    known = np.isfinite(found.depth.depth_m)
    depth_m, sigma_m = (
        round(float(np.median(values[known])), digits) if known.any() else None
        for values, digits in ((found.depth.depth_m, 3), (found.depth.sigma_m, 4))
    )
    figures = {
        "keyframe": seq, "picture": str(path), "stages": complete, "points": int(known.sum()),
        "depth_median_m": depth_m, "sigma_median_m": sigma_m,
    }  # fmt: skip
    if as_json:
        print(json.dumps(figures))
        return
    print(f"{path}: keyframe {seq}, {figures['points']} points")
    if not complete:
        print("only what the store holds; replay with --set scan.keep_debug=true for every stage")


ACTIONS = ("align", "compare")


def site(
    action: Annotated[
        str, typer.Argument(help="align or compare", autocompletion=choices(ACTIONS))
    ],
    scans: Annotated[list[Path], typer.Argument(help="scan folders; compare: before and after")],
    out: Annotated[Path, typer.Option(help="folder of the site")],
    start: Annotated[
        list[str] | None,
        typer.Option(help="align: SCAN:POINTS.json places a scan without georeference"),
    ] = None,
    cell_m: Annotated[
        float | None, typer.Option(help="compare: cell size; default: pixel on ground")
    ] = None,
    bare: Annotated[
        bool, typer.Option("--bare", help="compare: bare ground only, as in `export --to dtm`")
    ] = False,
    tile_points: TilePoints = 20_000_000,
    scheduler: Scheduler = None,
    as_json: AsJson = False,
) -> None:
    """Join scans that overlap into one site, or measure what changed between two.

    The scans are not changed. A site's folder is a scan folder: export, mesh and refine --gcp
    work on it.
    """
    from service.offline.exports.view import ExportOptions

    one_of(action, ACTIONS, "site")
    with refusing("site"):
        options = ExportOptions(cell_m=cell_m, tile_points=tile_points, scheduler=scheduler)
    if action == "align":
        from service.offline.site.alignment import align_site
        from service.offline.site.start import read_start

        pairs = [text.rpartition(":") for text in start or []]
        if not all(scan and points for scan, _, points in pairs):
            raise InputError("--start is SCAN:POINTS.json")
        starts = {Path(scan): read_start(Path(points)) for scan, _, points in pairs}
        with showing("site") as progress:
            made = align_site(scans, out, starts=starts, progress=progress, options=options)
        figures = made.document
        print(json.dumps(figures) if as_json else "\n".join(_aligned_lines(out, figures)))
        return
    from service.offline.site.compare import compare

    if len(scans) != 2:
        raise InputError(f"site compare takes two scans, before and after, not {len(scans)}")
    with needing("a change map"), showing("site") as progress:
        figures = compare(scans[0], scans[1], out, options, bare, progress)
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
