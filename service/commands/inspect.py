"""``skyrelief inspect``: every stage of a keyframe as one picture."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from service.errors import InputError


def inspect(
    scan_dir: Annotated[Path, typer.Argument(help="scan folder (holds scan.db)")],
    keyframe: Annotated[
        int | None, typer.Option("--keyframe", help="number of the keyframe; default: a middle one")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="PNG to write; default: in the scan folder")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object at the end")] = False,
) -> None:
    """Raw and rectified frames, anaglyph, disparity, depth and sigma of a keyframe.

    The stages before the depth are there when the scan was made with
    --set scan.keep_debug=true; otherwise what the store holds is shown.
    """
    import cv2
    import numpy as np

    from service.exports.view import ScanView
    from service.scans.drawing import middle_keyframe, stages
    from service.scans.writing import writing

    with ScanView(scan_dir) as scan:
        seqs = scan.store.seqs()
        seq = middle_keyframe(scan_dir, seqs) if keyframe is None else keyframe
        if not seqs or seq is None:
            raise InputError(f"{scan_dir} holds no keyframes yet; nothing to inspect")
        found = scan.store.keyframe(seq) if seq in seqs else None
        if found is None:
            raise InputError(f"{scan_dir}: no keyframe {seq}; there are {seqs[0]} to {seqs[-1]}")
    picture, complete = stages(scan_dir, scan.store.header.scan_id, found)
    path = out or scan_dir / f"keyframe_{seq:06d}.png"
    ok, data = cv2.imencode(".png", picture)
    if not ok:
        raise InputError(f"{path}: OpenCV cannot write PNG on this machine")
    with writing(path) as part:
        part.write_bytes(data.tobytes())
    known = np.isfinite(found.depth.depth_m)
    figures = {
        "keyframe": seq,
        "picture": str(path),
        "stages": complete,
        "points": int(known.sum()),
        "depth_median_m": round(float(np.median(found.depth.depth_m[known])), 3)
        if known.any()
        else None,
        "sigma_median_m": round(float(np.median(found.depth.sigma_m[known])), 4)
        if known.any()
        else None,
    }
    if as_json:
        print(json.dumps(figures))
        return
    print(f"{path}: keyframe {seq}, {figures['points']} points")
    if not complete:
        print("only what the store holds; replay with --set scan.keep_debug=true for every stage")
