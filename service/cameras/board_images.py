"""Chessboard images from files, folders or a video, and the coverage image of a calibration."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from recon.calibration.board import Board, BoardView, Calibration, find_board, fold
from recon.types import F32, U8
from service.errors import InputError
from service.progress import Progress

STILLS = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".pgm")
VIDEO_STEP_S = 0.4
MAX_VIEWS = 80


@dataclass(frozen=True, slots=True, eq=False)
class BoardSet:
    views: tuple[BoardView, ...]
    missed: tuple[tuple[str, str], ...]  # (name, why the image is not used)
    size_px: tuple[int, int]  # (W, H)


def find_boards(
    sources: Sequence[Path], board: Board, progress: Progress | None = None
) -> BoardSet:
    """Find the board in images, folders of images, or videos; InputError when none is usable."""
    views: list[BoardView] = []
    missed: list[tuple[str, str]] = []
    size: tuple[int, int] | None = None
    progress = progress or Progress()
    for name, gray in _images(sources, progress):
        progress(f"{name}: {len(views)} boards so far")
        if gray is None:
            missed.append((name, "cannot be read as an image"))
            continue
        shape = (gray.shape[1], gray.shape[0])
        size = size or shape
        if shape != size:
            missed.append((name, f"is {shape[0]}x{shape[1]}, the first is {size[0]}x{size[1]}"))
            continue
        corners = find_board(gray, board)
        if corners is None:
            missed.append((name, f"no board of {board.columns}x{board.rows} inner corners"))
        elif _is_repeat(corners, views, size):
            missed.append((name, "shows the board at the same place as another view"))
        elif len(views) < MAX_VIEWS:
            views.append(BoardView(name, corners))
    if size is None:
        raise InputError(f"no readable image in {', '.join(str(s) for s in sources)}")
    return BoardSet(tuple(views), tuple(missed), size)


def _is_repeat(corners: F32, views: Sequence[BoardView], size: tuple[int, int]) -> bool:
    """True when the board has hardly moved since an earlier view."""
    limit = 0.004 * float(np.hypot(*size))
    return any(float(np.abs(v.corners_px - corners).max()) < limit for v in views)


def _images(sources: Sequence[Path], progress: Progress) -> Iterator[tuple[str, U8 | None]]:
    """(name, gray image) of every source in turn; None when a file cannot be read."""
    for k, source in enumerate(sources):
        with progress.part(progress.text, 1.0 / (len(sources) - k)):
            if source.is_dir():
                inside = sorted(p for p in source.iterdir() if p.suffix.lower() in STILLS)
                if not inside:
                    raise InputError(f"{source}: no images in this folder ({', '.join(STILLS)})")
                for path in progress.over(inside, len(inside)):
                    yield path.name, _still(path)
            elif not source.exists():
                raise InputError(f"{source}: no such file or folder")
            elif source.suffix.lower() in STILLS:
                yield source.name, _still(source)
            else:
                yield from _video(source, progress)


def _still(path: Path) -> U8 | None:
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imread(str(path), flags)
    return None if image is None else np.asarray(image, np.uint8)


def _video(path: Path, progress: Progress) -> Iterator[tuple[str, U8]]:
    from service.cameras import open_camera

    due_ns = 0
    with closing(open_camera(f"file:{path}")) as camera:
        for frame in progress.over(camera, camera.images):
            if frame.time_ns >= due_ns:
                due_ns = frame.time_ns + round(VIDEO_STEP_S * 1e9)
                gray = cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
                yield f"{path.name} at {frame.time_ns / 1e9:.2f} s", np.asarray(gray, np.uint8)


def draw_coverage(calibration: Calibration, views: Sequence[BoardView]) -> U8:
    """(h, w, 3) BGR image: all corners used, coloured by their view's rms, over the distortion. The
    lines are a straight grid as distorted by the lens."""
    W, H = calibration.camera.size_px
    scale = 1280.0 / W
    out = np.full((round(H * scale) + 60, 1280, 3), 28, np.uint8)
    _draw_bent_grid(out, calibration, scale)
    worst = max(float(calibration.view_rms_px.max()), 1e-9)
    rms = dict(zip(calibration.used, calibration.view_rms_px, strict=True))
    for view in views:
        if view.name in rms:
            share = float(rms[view.name]) / worst
            colour = (int(60 + 40 * (1 - share)), int(230 - 150 * share), int(70 + 180 * share))
            for u, v in view.corners_px:
                at = (round((float(u) + 0.5) * scale), round((float(v) + 0.5) * scale))
                cv2.circle(out, at, 4, colour, -1, cv2.LINE_AA)
    text = (
        f"{len(calibration.used)} views, rms {calibration.rms_px:.3f} px, "
        f"worst view {worst:.3f} px (red), coverage {calibration.coverage:.0%}"
    )
    place = (14, out.shape[0] - 22)
    cv2.putText(out, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.8, (230, 230, 230), 1, cv2.LINE_AA)
    return out


def _draw_bent_grid(out: U8, calibration: Calibration, scale: float) -> None:
    """A grid of straight lines of the scene, as the distorted image shows them."""
    camera = calibration.camera
    W, H = camera.size_px
    inverse = np.linalg.inv(camera.K)
    for count, vertical in ((17, True), (13, False)):
        for k in range(-4, count + 4):
            s = np.linspace(-0.4, 1.4, 200)
            fixed = np.full_like(s, k / (count - 1))
            u, v = (fixed * W, s * H) if vertical else (s * W, fixed * H)
            rays = np.stack([u, v, np.ones_like(u)], axis=1) @ inverse.T
            r2 = rays[:, 0] ** 2 + rays[:, 1] ** 2
            line, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.K, camera.distortion)
            ok = (r2 < fold(camera.distortion)[0] ** 2) & (np.abs(line[:, 0]) < 10 * W).all(axis=1)
            points = np.round(line[ok, 0] * scale).astype(np.int32)
            cv2.polylines(out, [points], False, (70, 70, 70), 1, cv2.LINE_AA)
    cv2.rectangle(out, (0, round(H * scale)), (out.shape[1], out.shape[0]), (28, 28, 28), -1)
