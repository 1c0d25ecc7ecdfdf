"""Calibration against rendered boards of a known camera, OpenCV's own result, and real photos."""

from __future__ import annotations

import json
import re
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from paths import DATA, SHARED
from typer.testing import CliRunner

from recon.calibration.board import Board, BoardView, calibrate, find_board
from recon.types import F32, F64, U8
from service.cameras.camera_file import load_camera
from service.cli import app
from service.commands.calibrate import result_text
from service.errors import InputError

HERE = DATA / "chessboards"

K: F64 = np.array([[500.0, 0, 318.0], [0, 503.0, 243.0], [0, 0, 1]])
BENT: F64 = np.array([-0.25, 0.08, 0.0, 0.0, -0.01])
SIZE = (640, 480)
BOARD = Board(9, 6, 0.025)


def board_poses(count: int) -> list[tuple[F64, F64]]:
    """(rotation vector, translation) of boards that fill the view from many sides."""
    rng = np.random.default_rng(5)
    out = []
    for k in range(count):
        turn = rng.uniform(-0.55, 0.55, 3)
        z = rng.uniform(0.26, 0.40)
        place = [(-0.05, 0.05)[k % 2], (-0.04, 0.04)[k // 2 % 2], z]
        centre = cv2.Rodrigues(turn)[0] @ np.array([0.1, 0.0625, 0.0])
        out.append((turn, np.array(place) - centre))
    return out


@cache
def sample_rays() -> F64:
    """(H * W * 9, 3) exact ray of each of 3x3 samples per pixel, row by row."""
    fine = 3
    u, v = np.meshgrid(
        (np.arange(SIZE[0] * fine) + 0.5) / fine - 0.5,
        (np.arange(SIZE[1] * fine) + 0.5) / fine - 0.5,
    )
    pixels = np.stack([u.ravel(), v.ravel()], axis=1).reshape(-1, 1, 2)
    xy = cv2.undistortPoints(pixels, K, BENT).reshape(-1, 2)
    return np.concatenate([xy, np.ones((len(xy), 1))], axis=1)


def rendered(turn: F64, shift: F64) -> U8:
    """An image of the board, the mean of nine samples per pixel, with a little noise."""
    rays = sample_rays()
    R = cv2.Rodrigues(turn)[0]
    depth = (R[:, 2] @ shift) / (rays @ R[:, 2])
    on = (rays * depth[:, None] - shift) @ R / BOARD.square_m  # squares from the first corner
    i, j = np.floor(on[:, 0]).astype(int), np.floor(on[:, 1]).astype(int)
    inside = (i >= -1) & (i < BOARD.columns) & (j >= -1) & (j < BOARD.rows)
    shade = np.where(inside & ((i + j) % 2 == 0), 30.0, 220.0).reshape(3 * SIZE[1], -1)
    small = cv2.resize(shade, SIZE, interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(1).normal(0, 2.0, small.shape)
    return np.asarray(np.clip(small + noise, 0, 255), np.uint8)


def true_corners(turn: F64, shift: F64) -> F32:
    uv, _ = cv2.projectPoints(BOARD.points_m().astype(np.float64), turn, shift, K, BENT)
    return np.asarray(uv.reshape(-1, 2), np.float32)


@pytest.mark.slow
def test_corners_of_a_rendered_board_are_sub_pixel() -> None:
    for turn, shift in board_poses(3):
        corners = find_board(rendered(turn, shift), BOARD)
        assert corners is not None
        truth = true_corners(turn, shift)
        gap = min(float(np.sqrt(np.mean((corners - order) ** 2))) for order in (truth, truth[::-1]))
        assert gap < 0.08


@pytest.mark.slow
def test_known_camera_is_found_from_images() -> None:
    views = []
    for k, (turn, shift) in enumerate(board_poses(12)):
        corners = find_board(rendered(turn, shift), BOARD)
        if corners is not None:
            views.append(BoardView(f"view {k}", corners))
    assert len(views) >= 10
    result = calibrate(views, BOARD, SIZE)
    assert result is not None
    assert result.rms_px < 0.1
    np.testing.assert_allclose(np.diag(result.camera.K)[:2], [500, 503], rtol=4e-3)
    np.testing.assert_allclose(result.camera.K[:2, 2], [318, 243], atol=1.5)
    radius = np.linspace(0, 0.75, 20)
    bend = [
        radius * (1 + d[0] * radius**2 + d[1] * radius**4 + d[4] * radius**6)
        for d in (result.camera.distortion, BENT)
    ]
    np.testing.assert_allclose(500 * bend[0], 500 * bend[1], atol=1.0)
    assert (result.camera.distortion[2:4] == 0).all()


def test_bad_view_is_left_out_with_the_reason() -> None:
    rng = np.random.default_rng(0)
    views = [
        BoardView(f"v{k}", true_corners(*p) + rng.normal(0, 0.05, (54, 2)).astype(np.float32))
        for k, p in enumerate(board_poses(10))
    ]
    wrong = views[4].corners_px + rng.normal(0, 4, (54, 2)).astype(np.float32)
    views[4] = BoardView("v4", wrong)
    result = calibrate(views, BOARD, SIZE)
    assert result is not None
    assert [name for name, _ in result.rejected] == ["v4"]
    assert "rms" in result.rejected[0][1]
    assert len(result.used) == 9 and result.rms_px < 0.1
    np.testing.assert_allclose(np.diag(result.camera.K)[:2], [500, 503], rtol=2e-3)


def test_sigma_covers_the_error_of_the_focal_length() -> None:
    hits = 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        views = [
            BoardView(f"v{k}", true_corners(*p) + rng.normal(0, 0.2, (54, 2)).astype(np.float32))
            for k, p in enumerate(board_poses(8))
        ]
        result = calibrate(views, BOARD, SIZE)
        assert result is not None
        hits += abs(result.camera.K[0, 0] - 500.0) < 2.0 * result.sigma_focal_px
    assert hits >= 8


def test_terms_that_the_corners_leave_open_do_not_fold_the_image() -> None:
    """Boards in the middle alone: with k2 and k3 five of these six models fold over."""
    lens = np.array([0.15, -0.2, 0.0, 0.0, 0.0])
    for seed in range(6):
        rng = np.random.default_rng(seed)
        views = []
        for k, (turn, _) in enumerate(board_poses(10)):
            place = np.array([-0.1, -0.0625, 0.45 + 0.01 * k])
            uv, _ = cv2.projectPoints(BOARD.points_m().astype(float), 0.6 * turn, place, K, lens)
            noisy = uv.reshape(-1, 2) + rng.normal(0, 0.3, (54, 2))
            views.append(BoardView(f"v{k}", noisy.astype(np.float32)))
        result = calibrate(views, BOARD, SIZE)
        assert result is not None and not any("folds" in w for w in result.warnings)
        assert result.camera.K[0, 0] == pytest.approx(500.0, abs=3.0 * result.sigma_focal_px)


def test_weak_sets_are_warned_about() -> None:
    turn, shift = board_poses(1)[0]
    views = [
        BoardView(f"v{k}", true_corners(0.1 * turn + 0.01 * k, shift * [1, 1, 3])) for k in range(5)
    ]
    result = calibrate(views, BOARD, SIZE)
    assert result is not None
    assert any("cover" in w for w in result.warnings)
    assert any("5 views" in w for w in result.warnings)


def test_wrong_input_is_refused() -> None:
    views = [BoardView("v", np.zeros((54, 2), np.float32))] * 3
    with pytest.raises(ValueError, match="too few"):
        calibrate(views, BOARD, SIZE)
    with pytest.raises(ValueError, match="squares"):
        Board(9, 6, -1.0)
    with pytest.raises(ValueError, match="too small"):
        Board(2, 6, 0.1)


def opencv_rms(paths: list[Path], pattern: tuple[int, int]) -> float:
    """Calibration as in OpenCV's sample: classic corners, fixed window, all five coefficients."""
    points, size = [], (0, 0)
    for path in paths:
        gray = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert gray is not None
        size = (gray.shape[1], gray.shape[0])
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = cv2.findChessboardCorners(gray, pattern, flags=flags)
        if found:
            stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.1)
            points.append(cv2.cornerSubPix(gray, corners, (5, 5), (-1, -1), stop))
    board = Board(*pattern, 0.025).points_m()
    rms = cv2.calibrateCamera([board] * len(points), points, size, np.eye(3), np.zeros(5))[0]
    return float(rms)


def run(*arguments: str) -> dict[str, object]:
    result = CliRunner().invoke(app, ["calibrate", *arguments, "--json"])
    if result.exception is not None:
        raise result.exception
    report = json.loads(result.stdout.strip().splitlines()[-1])
    assert isinstance(report, dict)
    shares = [int(share) for share in re.findall(r", (\d+) %", result.stderr)]
    assert shares == sorted(shares) and shares[-1] == 90 and len(set(shares)) > 3  # grows
    return report


def test_command_on_real_photographs(tmp_path: Path) -> None:
    out = tmp_path / "cam.yaml"
    photos = [str(p) for p in sorted(HERE.glob("left*.jpg"))]
    blank = tmp_path / "blank.png"
    cv2.imwrite(str(blank), np.full((480, 640), 128, np.uint8))
    report = run(*photos, str(blank), "--pattern", "9x6", "--square-m", "0.025", "--out", str(out))
    assert isinstance(report["rms_px"], float) and isinstance(report["not_used"], dict)
    assert report["rms_px"] < 1.05 * opencv_rms([Path(p) for p in photos], (9, 6))
    assert "no board" in report["not_used"]["blank.png"]
    camera = load_camera(out)
    assert camera.size_px == (640, 480)
    assert camera.K[0, 0] == pytest.approx(533.0, rel=0.02)  # all 13 photographs give 533
    stated_px = report["sigma_focal_px"]
    assert 0.0 < camera.sigma_focal * camera.K[0, 0] == pytest.approx(stated_px, abs=1e-3)
    assert yaml.safe_load(out.read_text())["calibration"]["rms_px"] == report["rms_px"]
    image = cv2.imread(str(tmp_path / "cam_coverage.png"))
    assert image is not None and image.std() > 10
    assert f"wrote {out} and {tmp_path / 'cam_coverage.png'}" in result_text(report)


@pytest.mark.parametrize(
    ("folder", "glob", "pattern"),
    [
        ("calib_opencv_stereo", "left*.jpg", "9x6"),
        ("calib_opencv_stereo", "right*.jpg", "9x6"),
        ("calib_gopro_wide", "*.jpg", "8x6"),
    ],
)
@pytest.mark.slow
def test_whole_sets_are_as_good_as_opencv(
    folder: str, glob: str, pattern: str, tmp_path: Path
) -> None:
    paths = sorted((SHARED / folder).glob(glob))
    if not paths:
        pytest.skip(f"shared data set {folder} is not here")
    out = str(tmp_path / "cam.yaml")
    report = run(
        *(str(p) for p in paths), "--pattern", pattern, "--square-m", "0.025", "--out", out
    )
    columns, rows = (int(v) for v in pattern.split("x"))
    assert isinstance(report["rms_px"], float)
    assert report["rms_px"] < 1.05 * opencv_rms(paths, (columns, rows))
    if folder == "calib_gopro_wide":
        assert isinstance(report["views"], dict) and len(report["views"]) == 35


@pytest.mark.slow
def test_command_reads_a_video(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    path = tmp_path / "board.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=5)
        stream.width, stream.height, stream.pix_fmt = 640, 480, "yuv420p"
        stream.options = {"crf": "12"}
        for turn, shift in board_poses(6):
            gray = rendered(turn, shift)
            for _ in range(3):
                frame = av.VideoFrame.from_ndarray(np.dstack([gray] * 3), format="bgr24")
                container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    out = tmp_path / "cam.yaml"
    report = run(str(path), "--pattern", "9x6", "--square-m", "0.025", "--out", str(out))
    assert isinstance(report["views"], dict) and len(report["views"]) >= 5
    assert load_camera(out).K[0, 0] == pytest.approx(500.0, rel=0.03)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["nowhere.jpg", "--pattern", "9x6", "--square-m", "0.025"], "no such file"),
        (["{blank}", "--pattern", "9 by 6", "--square-m", "0.025"], "inner corners"),
        (["{blank}", "--pattern", "9x6", "--square-m", "-1"], "squares"),
        (["{blank}", "--pattern", "9x6", "--square-m", "0.025"], "0 of 1"),
        (["{broken}", "--pattern", "9x6", "--square-m", "0.025"], "no readable image"),
        (["{empty}", "--pattern", "9x6", "--square-m", "0.025"], "no images"),
    ],
)
def test_bad_input_is_refused_in_one_line(arguments: list[str], word: str, tmp_path: Path) -> None:
    blank, broken, empty = tmp_path / "blank.png", tmp_path / "broken.jpg", tmp_path / "empty"
    cv2.imwrite(str(blank), np.full((240, 320), 128, np.uint8))
    broken.write_bytes(b"\xff\xd8 not an image")
    empty.mkdir()
    filled = [a.format(blank=blank, broken=broken, empty=empty) for a in arguments]
    with pytest.raises(InputError, match=word) as caught:
        run(*filled, "--out", str(tmp_path / "cam.yaml"))
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "cam.yaml").exists()
