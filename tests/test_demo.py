"""Both ends on one machine: the ground ends up with the very scan that was made onboard."""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import laspy
import numpy as np
import pytest

from recon.camera_model import scaled
from service.cameras.camera_file import load_camera, save_camera

DEMO = Path(__file__).resolve().parents[1] / "demo" / "caliterra"
CPU = ("--set", "compute.backend=cpu")
SPARSE = ("--set", "compute.stereo_width=160")
NAMES = [f"IMG_{n}.jpg" for n in range(9365, 9370)]

needs_ffmpeg = pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs the ffmpeg command")


def skyrelief(*arguments: str, stdin: Any = subprocess.DEVNULL) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "service.cli", *arguments],
        stdin=stdin,
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )


def points(path: Path) -> np.ndarray[Any, np.dtype[np.float64]]:
    """(N, 3) coordinates of a LAZ file, in a fixed order."""
    xyz = np.asarray(laspy.read(path).xyz, dtype=np.float64)
    return np.asarray(xyz[np.lexsort(xyz.T)])


def test_ground_holds_what_was_made_onboard(tmp_path: Path) -> None:
    flight = tmp_path / "flight"
    (flight / "frames").mkdir(parents=True)
    shutil.copy(DEMO / "camera.yaml", flight)
    for name in NAMES:
        shutil.copy(DEMO / "frames" / name, flight / "frames")
    out = tmp_path / "out"
    done = skyrelief("demo", "--flight", str(flight), "--out", str(out), "--json", *CPU, *SPARSE)
    assert done.returncode == 0, done.stderr + (out / "ground.log").read_text()
    report = json.loads(done.stdout.splitlines()[-1])
    assert "[1/3] open this page and see the map grow: http://127.0.0.1:" in done.stderr
    assert "[2/3] flight: 5 images" in done.stderr
    assert "INFO" not in done.stderr
    assert report["points"] > 10_000
    assert report["points"] == report["ground_points"]
    onboard, ground = Path(report["scan_folder"]), Path(report["ground_folder"])
    for name in ("preview.jpg", "scan.json", "trajectory.tum", "trajectory.csv"):
        assert (onboard / name).stat().st_size > 0
        assert (ground / name).stat().st_size > 0
    np.testing.assert_array_equal(points(onboard / "cloud.laz"), points(ground / "cloud.laz"))
    assert (onboard / "trajectory.tum").read_bytes() == (ground / "trajectory.tum").read_bytes()


def test_foreign_folders_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "holiday.jpg").write_text("mine")
    done = skyrelief("demo", "--out", str(tmp_path))
    assert done.returncode == 2
    assert "not empty" in done.stderr
    assert (tmp_path / "holiday.jpg").read_text() == "mine"
    missing = skyrelief("demo", "--flight", str(tmp_path), "--out", str(tmp_path / "out"))
    assert missing.returncode == 2
    assert "camera.yaml" in missing.stderr


@needs_ffmpeg
def test_piped_video_gives_the_cloud_of_the_file(tmp_path: Path) -> None:
    video = tmp_path / "flight.mp4"
    with av.open(str(video), "w") as container:
        stream: Any = container.add_stream("libx264", rate=1)
        stream.width, stream.height, stream.pix_fmt = 800, 600, "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        stream.options = {"crf": "16", "preset": "veryfast"}
        for i, name in enumerate(NAMES):
            image = cv2.imread(str(DEMO / "frames" / name))
            assert image is not None
            small = np.asarray(
                cv2.resize(image, (800, 600), interpolation=cv2.INTER_AREA), np.uint8
            )
            frame = av.VideoFrame.from_ndarray(small, format="bgr24")
            frame.pts, frame.time_base = i * 2100, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    model = tmp_path / "camera.yaml"
    save_camera(model, scaled(load_camera(DEMO / "camera.yaml"), (800, 600)))
    common = ["--camera-model", str(model), "--video-epoch", "1413742874"]
    common += [
        "--set",
        "scan.assumed_agl_m=60",
        "--set",
        "compute.guide_width=640",
        "--json",
        *CPU,
        *SPARSE,
    ]
    by_file = skyrelief("replay", str(video), "--out", str(tmp_path / "file"), *common)
    assert by_file.returncode == 0, by_file.stderr
    command = shlex.split(f"ffmpeg -v error -i {video} -c copy -f mpegts -")
    with subprocess.Popen(command, stdout=subprocess.PIPE) as ffmpeg:
        by_pipe = skyrelief(
            "replay", "-", "--out", str(tmp_path / "pipe"), *common, stdin=ffmpeg.stdout
        )
    assert by_pipe.returncode == 0, by_pipe.stderr
    found = points(tmp_path / "file" / "cloud.laz")
    assert len(found) > 5_000
    np.testing.assert_allclose(points(tmp_path / "pipe" / "cloud.laz"), found, atol=0.002)
