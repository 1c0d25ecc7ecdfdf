"""``replay`` without a camera model: the lens by the flight's own images."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from painted_ground import SIZE, K, pose, still
from PIL import Image
from typer.testing import CliRunner

from recon.types import U8
from service.cameras.images import open_images
from service.cameras.lens import Lens
from service.cli import app
from service.errors import InputError
from service.stream.store import ScanStore

BENT = 0.1
SPARSE = ("--set", "compute.stereo_width=160", "--set", "compute.guide_width=320")
EXIF_FOCAL = 29  # mm of a 35 mm camera: 402 px


def bent_images(count: int) -> Iterator[U8]:
    """Two strips in opposite directions by a lens that bends."""
    v, u = np.mgrid[0 : SIZE[1], 0 : SIZE[0]].astype(np.float64)
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)[:, None]
    lens = np.array([BENT, 0.0, 0.0, 0.0, 0.0])
    straight = cv2.undistortPoints(pixels, K, lens, P=K).reshape(*u.shape, 2).astype(np.float32)
    half = count // 2
    for k in range(count):
        east, yaw = (6.0 * k, 0.0) if k < half else (6.0 * (count - 1 - k), 180.0)
        image = still(pose(east, yaw, 40.0 + k % 3, seed=k))
        bent = cv2.remap(image, straight[..., 0], straight[..., 1], cv2.INTER_CUBIC)
        yield np.asarray(bent, np.uint8)


def stills(folder: Path, images: Iterable[U8]) -> Path:
    """The images as JPEG files with a focal length."""
    folder.mkdir()
    for k, bent in enumerate(images):
        tags = Image.Exif()
        tags.get_ifd(0x8769)[41989] = EXIF_FOCAL
        Image.fromarray(bent).convert("RGB").save(folder / f"{k:02d}.jpg", quality=97, exif=tags)
    return folder


def video(path: Path, count: int) -> Path:
    """The images as a video without losses (x264 makes others each time), which states no lens."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=2, options={"qp": "0"})
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        for image in bent_images(count):
            frame = av.VideoFrame.from_ndarray(np.dstack([image] * 3), format="bgr24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def replayed(source: str | Path, out: Path, *more: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """The figures of a replay, and the camera that it stored."""
    command = ["replay", str(source), "--out", str(out), "--json", *SPARSE, *more]
    answer = CliRunner().invoke(app, command)
    assert answer.exit_code == 0, answer.output
    with ScanStore.open(out / "scan.db") as store:
        return json.loads(answer.stdout.splitlines()[-1]), store.header.camera


@pytest.mark.parametrize("wanted", [True, False])
@pytest.mark.slow
def test_the_lens_of_a_video_is_found(tmp_path: Path, wanted: bool) -> None:
    """70 degrees are assumed, 343 px; without distortion the ground would be off by metres."""
    more = [] if wanted else ["--no-find-lens"]
    source = f"file:{video(tmp_path / 'flight.mp4', 12)}"
    figures, camera = replayed(source, tmp_path / "scan", *more)
    assert ("lens" in figures["assumed"]) != wanted
    assert camera["distortion"][0] == pytest.approx(BENT if wanted else 0.0, abs=0.01)
    assert camera["K"][0] == pytest.approx(K[0, 0] if wanted else 342.7, rel=0.015)
    sigma = figures["sigma_focal"]  # of the focal length found, or of 70 degrees
    assert abs(camera["K"][0] / K[0, 0] - 1.0) < 2.0 * sigma < (0.12 if wanted else 0.41)


@pytest.mark.parametrize("wanted", [True, False])
@pytest.mark.slow
def test_the_distortion_that_exif_does_not_give_is_found(tmp_path: Path, wanted: bool) -> None:
    folder = stills(tmp_path / "stills", bent_images(10))
    more = [] if wanted else ["--no-find-lens"]
    figures, camera = replayed(f"images:{folder}", tmp_path / "scan", *more)
    notes = figures["warnings"]
    assert any("found from the images themselves" in note for note in notes) == wanted
    assert camera["distortion"][0] == pytest.approx(BENT if wanted else 0.0, abs=0.01)
    given = Lens(EXIF_FOCAL / 43.2666 * 1.25).camera(SIZE)
    assert camera["K"][0] == pytest.approx(K[0, 0] if wanted else given.K[0, 0], rel=0.003)


@pytest.mark.slow
def test_a_lens_that_the_images_do_not_determine_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise InputError("the camera found is too far from the model given")

    monkeypatch.setattr("service.offline.refine.refinement.lens", refuse)
    folder = stills(tmp_path / "stills", bent_images(6))
    figures, _ = replayed(f"images:{folder}", tmp_path / "scan")
    assert "distortion" in figures["assumed"]
    assert any("the camera found is too far" in note for note in figures["warnings"])


def test_images_that_place_no_camera_determine_no_lens(tmp_path: Path) -> None:
    gray = [np.full(SIZE[::-1], 90 + k, np.uint8) for k in range(6)]
    folder = stills(tmp_path / "stills", gray)
    figures, _ = replayed(f"images:{folder}", tmp_path / "scan")
    reason = "the images do not determine their lens: 0 keyframes are too few; 3 needed"
    assert reason in figures["warnings"]


def test_the_stills_about_the_middle(tmp_path: Path) -> None:
    source = open_images(str(stills(tmp_path / "stills", bent_images(6))), {})
    assert [image.name for image in source.middle(3)] == ["01.jpg", "02.jpg", "03.jpg"]
    assert source.middle(9).images == source.images == 6
