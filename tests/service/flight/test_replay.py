"""The main job end to end on a small simulated flight, and what it says to bad input."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from command_line import skyrelief
from loopback import until
from paths import ROOT

from recon.types import Shutter
from service.commands.missing_metadata import own_telemetry
from service.commands.replay import await_dense
from service.config import load_config
from service.flight.scan import Scan
from service.stream.store import ScanStore
from service.workers import Workers

EPOCH = 1777629600  # of the simulated video; a transport stream does not carry it

Run = subprocess.CompletedProcess[str]

SPARSE = ("--set", "compute.stereo_width=320")
SPARSEST = ("--set", "compute.stereo_width=160", "--set", "compute.guide_width=320")


def process(*arguments: str | Path, stdin: Any = subprocess.DEVNULL) -> Run:
    """``skyrelief`` as a process of its own."""
    command = [sys.executable, "-m", "service.cli", *map(str, arguments)]
    return subprocess.run(command, stdin=stdin, capture_output=True, text=True, timeout=500)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated nadir flight of 8 s."""
    folder = tmp_path_factory.mktemp("sim") / "flight"
    made = skyrelief(
        "simulate", "--out", folder, "--size", "320x180", "--fps", "5", "--duration-s", "8",
        "--height-m", "40", "--speed-m-s", "6", "--seed", "3",
    )  # fmt: skip
    assert made.returncode == 0, made.stderr
    return folder


def replay_of(flight: Path, out: Path) -> list[str | Path]:
    """The command that replays the flight with its telemetry."""
    return [
        "replay", flight / "flight.mp4", "--telemetry", flight / "flight.tlog",
        "--camera-model", flight / "camera.yaml", "--out", out, "--json", *SPARSE,
    ]  # fmt: skip


@pytest.fixture(scope="module")
def scan(flight: Path) -> tuple[Path, dict[str, Any]]:
    """The flight replayed with telemetry."""
    out = flight.parent / "scan"
    done = process(*replay_of(flight, out))
    assert done.returncode == 0, done.stderr
    return out, json.loads(done.stdout.splitlines()[-1])


def score(scan: Path, flight: Path) -> dict[str, Any]:
    done = skyrelief("score", scan, flight, "--json")
    assert done.returncode == 0, done.stderr
    report: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return report


def points(folder: Path) -> Any:
    return np.asarray(laspy.read(folder / "cloud.laz").xyz)


def test_a_flight_becomes_a_georeferenced_cloud(scan: tuple[Path, dict[str, Any]]) -> None:
    folder, summary = scan
    assert summary["frames"] == 40 and summary["frames_tagged"] == 40
    assert summary["clouds"] >= 8 and summary["georeference"] == "gnss"
    for name in ("scan.json", "scan.db", "cloud.laz", "trajectory.tum", "trajectory.csv"):
        assert (folder / name).stat().st_size > 0
    with laspy.open(folder / "cloud.laz") as cloud:
        names = set(cloud.header.point_format.dimension_names)
        crs = cloud.header.parse_crs()
    assert {"red", "green", "blue", "sigma_m", "sigma_absolute_m", "views"} <= names
    assert crs is not None and crs.to_epsg() == summary["epsg"] == 32632


def test_the_cloud_is_close_to_the_truth(scan: tuple[Path, dict[str, Any]], flight: Path) -> None:
    report = score(scan[0], flight)
    text = json.dumps(report)
    assert report["surface"]["rigid"]["median_m"] < 0.006 * 40.0, text
    assert report["completeness"]["share"] > 0.8, text
    honesty = report["surface"]["rigid"]["honesty"]
    # More than with a known readout: 20 ms are assumed until the images show that there is none.
    assert 0.58 < honesty["within_1_sigma"] < 0.88, text
    assert honesty["within_2_sigma"] > 0.85, text
    assert report["trajectory"]["raw"]["rms_m"] < 4.0, text


def test_subtitles_next_to_a_video_are_its_telemetry(flight: Path, tmp_path: Path) -> None:
    video = tmp_path / "DJI_0001.MP4"
    shutil.copy(flight / "flight.mp4", video)
    assert own_telemetry(str(video), load_config(None, [])) is None
    subtitles = tmp_path / "DJI_0001.SRT"
    subtitles.write_text("1\n00:00:01,000 --> 00:00:02,000\n- Hello.\n", encoding="utf-8")
    assert own_telemetry(str(video), load_config(None, [])) is None
    place = "[latitude: 47.1] [longitude: 8.5] [rel_alt: 40.000 abs_alt: 450.000]"
    subtitles.write_text(f"1\n00:00:00,000 --> 00:00:00,033\n{place}\n", encoding="utf-8")
    found = own_telemetry(str(video), load_config(None, []))
    assert found is not None and found.counts["positions"] == 1
    assert any("DJI_0001.SRT" in warning for warning in found.warnings)


@pytest.mark.slow
def test_without_telemetry_it_still_reconstructs(flight: Path, tmp_path: Path) -> None:
    out, model = tmp_path / "scan", tmp_path / "camera.yaml"
    model.write_text((flight / "camera.yaml").read_text() + "sigma_focal: 0.04\n")
    done = skyrelief(
        "replay", flight / "flight.mp4", "--camera-model", model, "--out", out, "--json", *SPARSEST,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout.splitlines()[-1])
    assert summary["sigma_focal"] == 0.04
    assert summary["georeference"] == "none" and summary["epsg"] is None
    assert any("scale" in warning for warning in summary["warnings"])
    surface = score(out, flight)["surface"]["similarity"]
    assert surface["median_m"] < 0.006 * 40.0
    assert surface["honesty"]["median_sigma_m"] < 0.02 * 40.0  # the lens moves all points together


@pytest.mark.slow
def test_a_recording_begins_again_once_its_readout_is_found(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[Scan] = []

    def found(scan: Scan) -> Shutter | None:
        if not begun or begun[-1] is not scan:
            begun.append(scan)
        return Shutter(0.002, "up") if scan.recorder.keyframes else None

    monkeypatch.setattr(Scan, "found_shutter", found)
    out = tmp_path / "scan"
    done = skyrelief(
        "replay", flight / "flight.mp4", "--camera-model", flight / "camera.yaml",
        "--out", out, "--json", *SPARSEST,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    first, second = begun
    assert 0 < first.recorder.frames < second.recorder.frames == 40
    assert second.inputs.camera.shutter == Shutter(0.002, "up")
    with ScanStore.open(out / "scan.db", read_only=True) as store:
        times = [pose.time_unix_ns for pose in store.poses()]
        assert times == sorted(set(times)) and len(times) > first.recorder.frames
        assert store.header.camera["readout_ms"] == pytest.approx(2.0)


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="ffmpeg is not installed")
@pytest.mark.parametrize(("name", "coded"), [("DJI_0001.MP4", "mov_text"), ("flight.mkv", "srt")])
@pytest.mark.slow
def test_subtitles_in_a_video_are_its_telemetry(
    flight: Path, tmp_path: Path, name: str, coded: str
) -> None:
    place = "[latitude: 47.1] [longitude: 8.5] [rel_alt: {}.0 abs_alt: 450.0]"
    cue = "{0}\n00:00:0{0},000 --> 00:00:0{0},900\n{1}\n\n"
    text = tmp_path / "text.srt"
    texts = [*(place.format(40 + k) for k in range(3)), 10_000 * "x" + place.format(43)]
    text.write_text("".join(cue.format(k, one) for k, one in enumerate(texts)))
    video = tmp_path / name
    subprocess.run(
        ["ffmpeg", "-loglevel", "error", "-i", str(flight / "flight.mp4"), "-i", str(text),
         "-map", "0:v", "-map", "1:s", "-c:v", "copy", "-c:s", coded, str(video)],
        check=True, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    found = own_telemetry(str(video), load_config(None, []))
    assert found is not None and found.counts["positions"] == 3  # no drone writes 10 kB in a cue
    assert found.warnings[0] == "telemetry from the video's own subtitles"
    for k in range(3):
        state = found.history.state_at(k * 10**9)
        assert state is not None and state.alt_agl_m == pytest.approx(40.0 + k)


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="ffmpeg is not installed")
@pytest.mark.slow
def test_a_pipe_gives_the_same_cloud_as_the_file(
    flight: Path, scan: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    muxed = subprocess.Popen(
        ["ffmpeg", "-loglevel", "error", "-i", str(flight / "flight.mp4"),
         "-c", "copy", "-f", "mpegts", "-"],
        stdout=subprocess.PIPE, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    done = process(
        "replay", "-", "--telemetry", flight / "flight.tlog", "--camera-model",
        flight / "camera.yaml", "--out", tmp_path / "scan", "--json",
        "--video-epoch", str(EPOCH), *SPARSE, stdin=muxed.stdout,
    )  # fmt: skip
    muxed.wait(timeout=20)
    assert done.returncode == 0, done.stderr
    np.testing.assert_array_equal(points(tmp_path / "scan"), points(scan[0]))


def test_a_second_run_into_the_same_folder_is_refused(
    flight: Path, scan: tuple[Path, dict[str, Any]]
) -> None:
    before = points(scan[0])
    again = skyrelief(*replay_of(flight, scan[0]))
    assert again.returncode == 2 and "already holds a scan" in again.stderr
    np.testing.assert_array_equal(points(scan[0]), before)


@pytest.mark.slow
def test_an_interrupt_closes_the_scan(flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "scan"
    command = [
        sys.executable, "-m", "service.cli", "replay", str(flight / "flight.mp4"),
        "--camera-model", str(flight / "camera.yaml"), "--out", str(out), "--realtime", "--json",
        *SPARSEST,
    ]  # fmt: skip
    running = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    until((out / "scan.db").exists, 60.0)
    time.sleep(2.0)
    running.send_signal(signal.SIGINT)
    stdout, stderr = running.communicate(timeout=60)
    assert running.returncode == 0, stderr
    summary = json.loads(stdout.splitlines()[-1])
    assert summary["finished"] is True
    assert (out / "cloud.laz").exists() and (out / "preview.jpg").exists()


def bad_inputs(flight: Path, tmp: Path) -> dict[str, tuple[list[str | Path], str]]:
    """Name to (arguments, what the message must say)."""
    (tmp / "empty.mp4").touch()
    (tmp / "text.mp4").write_text("this is not a video\n" * 50)
    model = (flight / "camera.yaml").read_text()
    (tmp / "small.yaml").write_text(model.replace("image_width: 320", "image_width: 640"))
    (tmp / "negative.yaml").write_text(model.replace("240.0", "-240.0"))
    (tmp / "nan.yaml").write_text(model.replace("240.0", ".nan"))
    (tmp / "file").write_text("in the way")
    video, camera = flight / "flight.mp4", flight / "camera.yaml"
    log = flight / "flight.tlog"
    return {
        "no such file": (["no-such.mp4"], "no such file"),
        "empty file": ([tmp / "empty.mp4"], "empty"),
        "not a video": ([tmp / "text.mp4"], "text.mp4"),
        "model of another size": ([video, "--camera-model", tmp / "small.yaml"], "640x180"),
        "negative focal length": ([video, "--camera-model", tmp / "negative.yaml"], "positive"),
        "NaN in the model": ([video, "--camera-model", tmp / "nan.yaml"], "finite"),
        "no such log": ([video, "--telemetry", tmp / "none.tlog"], "none.tlog"),
        "log of another day": (
            [video, "--camera-model", camera, "--telemetry", log, "--video-epoch", "1000000000"],
            "do not overlap",
        ),
        "begin that is none": ([video, "--camera-model", camera, "--video-epoch", "nan"], "1970"),
        "begin of another age": (
            [video, "--camera-model", camera, "--video-epoch", "1e11"],
            "2106",
        ),
        "unwritable folder": (
            [video, "--camera-model", camera, "--out", tmp / "file" / "scan"],
            "file",
        ),
        "unknown key": ([video, "--set", "scan.basline=2"], "baseline"),
        "unknown backend": ([video, "--backend", "abacus"], "abacus"),
    }


CASES = (
    "no such file", "empty file", "not a video", "model of another size",
    "negative focal length", "NaN in the model", "no such log", "log of another day",
    "begin that is none", "begin of another age", "unwritable folder",
    "unknown key", "unknown backend",
)  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_bad_input_gets_one_line_and_exit_code_two(case: str, flight: Path, tmp_path: Path) -> None:
    arguments, words = bad_inputs(flight, tmp_path)[case]
    more: list[str | Path] = [] if "--out" in arguments else ["--out", tmp_path / "scan"]
    done = (process if case == "unknown key" else skyrelief)("replay", *arguments, *more)
    last = done.stderr.strip().splitlines()[-1]
    assert done.returncode == 2, done.stderr
    assert last.startswith("skyrelief: ") and words in last, last
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_damaged_input_gives_a_smaller_scan_with_a_warning(flight: Path, tmp_path: Path) -> None:
    """Telemetry with bytes knocked out of it, and a transport stream cut in the middle."""
    log = bytearray((flight / "flight.tlog").read_bytes())
    rng = np.random.default_rng(0)
    for at in rng.integers(0, len(log), 40):
        log[at] ^= 0xFF
    (tmp_path / "damaged.tlog").write_bytes(log)
    done = skyrelief(
        "replay", flight / "flight.mp4", "--telemetry", tmp_path / "damaged.tlog",
        "--camera-model", flight / "camera.yaml", "--out", tmp_path / "scan", "--json", *SPARSEST,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout.splitlines()[-1])
    assert summary["frames_tagged"] >= 38
    assert any("checksum" in w or "skipped" in w for w in summary["warnings"]), summary["warnings"]


def test_an_unreadable_folder_loses_nothing(flight: Path, tmp_path: Path) -> None:
    if os.geteuid() == 0:
        pytest.skip("root may write everywhere")
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o500)
    done = skyrelief(*replay_of(flight, closed / "scan"))
    assert done.returncode == 2 and "closed" in done.stderr


@pytest.mark.slow
def test_memory_is_pooled_before_anything_large_is_loaded() -> None:
    script = (
        "import sys\n"
        "sys.argv = ['skyrelief', 'replay', 'no-such-video']\n"
        "import service.memory as memory\n"
        "memory.one_pool = lambda: print('numpy' in sys.modules)\n"
        "from service.cli import main\n"
        "main()\n"
    )
    root = ROOT
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=root)
    assert run.stdout == "False\n" and "no such file" in run.stderr


def test_a_keyframe_that_a_device_still_computes_is_waited_for() -> None:
    """The process was ended at once, its own at-exit work undone."""
    workers, release, left = Workers(), threading.Event(), list[int]()

    def compute(_: object) -> None:
        release.wait(60.0)

    workers.start("dense", compute)
    await_dense(workers.table(), 0.0, left.append)
    assert left == [0]
    release.set()
    await_dense(workers.table(), 60.0, left.append)
    assert left == [0] and all(worker.is_done for worker in workers.table())
