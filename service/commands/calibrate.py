"""``skyrelief calibrate``: a camera model from images of a chessboard."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Annotated, Any

import typer

from service.commands import AsJson, showing
from service.errors import InputError, refusing


def calibrate(
    sources: Annotated[list[Path], typer.Argument(help="Images, folders of them, or a video.")],
    pattern: Annotated[str, typer.Option(help="Inner corners of the board: 9x6.")],
    square_m: Annotated[float, typer.Option(help="Side of a square in metres.")],
    out: Annotated[Path, typer.Option(help="Camera model to write (YAML).")],
    tangential: Annotated[bool, typer.Option(help="Fit p1 and p2 too.")] = False,
    name: Annotated[str, typer.Option(help="Name of the camera in the file.")] = "camera",
    as_json: AsJson = False,
) -> None:
    """Estimate intrinsics and radial distortion from a chessboard, as ROS camera_info YAML.

    Also writes an image of the corners found, next to the camera model.
    """
    import cv2

    from recon.calibration.board import MIN_VIEWS, Board
    from recon.calibration.board import calibrate as fit
    from service.cameras.board_images import draw_coverage, find_boards
    from service.cameras.camera_file import save_camera
    from service.scans.writing import check_writable, write_whole

    corners = re.fullmatch(r"(\d{1,3})x(\d{1,3})", pattern.strip())
    if corners is None:
        raise InputError(f"--pattern {pattern!r}: expected inner corners such as 9x6")
    with refusing(f"--pattern {pattern} --square-m {square_m:g}"):
        board = Board(int(corners[1]), int(corners[2]), square_m)
    check_writable(out)
    with showing("calibrate") as progress:
        with progress.part("looking for the board", 0.9):
            boards = find_boards(sources, board, progress)
        if len(boards.views) < MIN_VIEWS:
            raise InputError(
                f"the board was found in {len(boards.views)} of "
                f"{len(boards.views) + len(boards.missed)} images, {MIN_VIEWS} are needed; "
                f"is --pattern {pattern} the number of inner corners?"
            )
        progress(f"fitting the camera to {len(boards.views)} views")
        result = fit(boards.views, board, boards.size_px, tangential)
    if result is None:
        raise InputError("no camera fits these views; take the board from different angles")
    record = {
        "rms_px": round(result.rms_px, 4),
        "pattern": f"{board.columns}x{board.rows}",
        "square_m": board.square_m,
        "sigma_focal_px": round(result.sigma_focal_px, 4),
        "coverage": round(result.coverage, 3),
        "views": {
            view: round(float(rms), 4)
            for view, rms in zip(result.used, result.view_rms_px, strict=True)
        },
        "not_used": dict(boards.missed + result.rejected),
        "warnings": list(result.warnings),
    }
    try:
        save_camera(out, result.camera, name, {"calibration": record})
    except ValueError as error:
        raise InputError(f"the views give no usable camera ({error}); take more views") from error
    image = out.with_name(f"{out.stem}_coverage.png")
    write_whole(image, cv2.imencode(".png", draw_coverage(result, boards.views))[1].tobytes())
    report = record | {
        "out": str(out),
        "coverage_picture": str(image),
        "K": result.camera.K.tolist(),
        "distortion": result.camera.distortion.tolist(),
    }
    print(json.dumps(report) if as_json else result_text(report))


def result_text(report: dict[str, Any]) -> str:
    K, d = report["K"], report["distortion"]
    lines = [
        f"rms {report['rms_px']:.3f} px over {len(report['views'])} views, "
        f"corners in {report['coverage']:.0%} of the image",
        f"fx {K[0][0]:.2f}  fy {K[1][1]:.2f} (sigma {report['sigma_focal_px']:.2f})  "
        f"cx {K[0][2]:.2f}  cy {K[1][2]:.2f} px",
        f"k1 {d[0]:+.5f}  k2 {d[1]:+.5f}  k3 {d[4]:+.5f}  p1 {d[2]:+.6f}  p2 {d[3]:+.6f}",
        "",
        *(f"  {rms:6.3f} px  {view}" for view, rms in report["views"].items()),
        *(f"  not used   {view}: {reason}" for view, reason in report["not_used"].items()),
        *(f"warning: {warning}" for warning in report["warnings"]),
        "",
        f"wrote {report['out']} and {report['coverage_picture']}",
    ]
    return "\n".join(lines)
