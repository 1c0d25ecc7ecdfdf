"""What can be checked is refused before the work; what is refused or stopped leaves nothing."""

from __future__ import annotations

import json
import logging
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import command_process, interruptible, skyrelief
from file_modes import bound_by_modes
from house_flight import HouseFlight
from loopback import until

from recon.types import Camera
from service.cameras.camera_file import save_camera
from service.commands import refine, replay
from service.compute import backend_choice
from service.errors import OutsideError
from service.offline.exports import EXPORTERS, kind_of
from service.progress import Progress


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory, house: HouseFlight) -> Path:
    folder = tmp_path_factory.mktemp("before") / "scan"
    house.flown(folder).close()
    return folder


@pytest.mark.parametrize(
    "name", ["flight.mp4", "truth/params.json", "camera.yaml/a"], ids=["flight", "truth", "file"]
)
def test_simulate_refuses_a_folder_in_use_before_it_works(tmp_path: Path, name: str) -> None:
    """Work that has begun says so in a line of its own."""
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).touch()
    out = tmp_path if name != "camera.yaml/a" else tmp_path / name / "below"
    ended = skyrelief("simulate", "--out", out)
    assert ended.returncode == 2 and ended.stderr.count("\n") == 1


@pytest.mark.parametrize("option", ["--seed", "--flight-seed"])
def test_simulate_names_a_seed_that_is_none(tmp_path: Path, option: str) -> None:
    ended = skyrelief("simulate", "--out", tmp_path / "a", option, "-1")
    assert ended.returncode == 2 and option in ended.stderr


def test_replay_refuses_a_view_that_is_too_narrow(tmp_path: Path) -> None:
    """What it would make lies hundreds of metres from where it is."""
    from PIL import Image

    (tmp_path / "stills").mkdir()
    for k in range(2):
        Image.new("RGB", (640, 480), (90 * k, 90, 90)).save(tmp_path / "stills" / f"{k}.png")
    K = np.array([[26_000.0, 0.0, 320.0], [0.0, 26_000.0, 240.0], [0.0, 0.0, 1.0]])
    save_camera(tmp_path / "camera.yaml", Camera(K, np.zeros(5), (640, 480)))
    out = tmp_path / "scan"
    model = ("--camera-model", tmp_path / "camera.yaml")
    ended = skyrelief("replay", tmp_path / "stills", *model, "--out", out)
    assert ended.returncode == 2 and not out.exists()
    assert "the view is 1.4 degrees wide" in ended.stderr


@pytest.mark.slow
def test_a_stopped_simulation_leaves_nothing(tmp_path: Path) -> None:
    place = tmp_path / "place"
    place.mkdir()
    long = ("--duration-s", "20", "--fps", "30", "--size", "64x64", "--density", "0")
    command = ("simulate", "--out", str(place / "flight"), *long)
    with interruptible(), command_process(tmp_path / "log", *command) as simulating:
        assert until(lambda: [*place.rglob("*.mp4")], 120.0)
        simulating.send_signal(signal.SIGINT)
        assert simulating.wait(120.0) != 0
    assert list(place.iterdir()) == []


def test_refine_refuses_a_folder_that_cannot_be_written(scan: Path) -> None:
    scan.chmod(0o555)
    try:
        with pytest.raises(OutsideError, match="no rights to write in"):
            bound_by_modes(lambda: refine.refine(scan))
    finally:
        scan.chmod(0o755)


def test_a_refused_refinement_leaves_no_folder(scan: Path, tmp_path: Path) -> None:
    bad = tmp_path / "bad.csv"
    bad.write_text("name\nA\n")
    for option in ("--gcp", "--telemetry"):
        ended = skyrelief("refine", scan, option, bad, "--out", tmp_path / "new")
        assert ended.returncode == 2 and not (tmp_path / "new").exists()


def test_replay_refuses_a_folder_with_a_scan_before_it_reads_the_log(
    scan: Path, tmp_path: Path
) -> None:
    """There is no such log."""
    words = ("replay", tmp_path, "--telemetry", "flight.tlog", "--out", scan)
    ended = skyrelief(*words)
    assert ended.returncode == 2 and "already holds a scan" in ended.stderr


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["refly", "--overlap", "0.95"], "--overlap 0.95: give 0 to 0.9"),
        (["mesh", "--voxel-m", "-2"], "voxel_m is -2.0, must be positive"),
        (["mesh", "--out", "x.obj"], "glb is written as .glb"),
        (["export", "--to", "dsm", "--out", "x.laz"], "dsm is written as .tif or .tiff; .laz is"),
        (["export", "--to", "gpkg", "--out", "x"], "gpkg is written as .gpkg"),
        (["export", "--to", "laz", "--out", "x.ply"], "laz is written as .laz or .las or .copc"),
        (["export", "--to", "obj", "--out", "x.obj"], "obj is a folder"),
        (["export", "--to", "dsm", "--out", "/dev/null/x.tif"], "/dev/null is a file"),
        (["inspect", "--out", "x.jpg"], "the image is written as .png"),
    ],
)
def test_wrong_usage_is_refused_before_the_work(scan: Path, words: list[str], why: str) -> None:
    ended = skyrelief(words[0], scan, *words[1:])
    assert ended.returncode == 2 and why in ended.stderr and ended.stderr.count("\n") == 1


def test_the_ending_decides_the_format() -> None:
    made = {end: kind_of("contours", Path("x" + end)) for end in (".geojson", ".gpkg", ".dxf")}
    assert made == {".geojson": "contours", ".gpkg": "gpkg", ".dxf": "dxf"}
    clouds = {end: kind_of("laz", Path("x" + end)) for end in (".laz", ".LAS", ".copc.laz")}
    assert clouds == {".laz": "laz", ".LAS": "laz", ".copc.laz": "copc"}
    for kind, (_, usual, _) in EXPORTERS.items():
        assert kind_of(kind, Path(usual)) == kind


def test_a_fault_in_one_product_ends_no_other(
    scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def faulty(*_: Any) -> None:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr("service.offline.exports.flight.line_geometry", faulty)
    out = tmp_path / "maps"
    ended = skyrelief("export", scan, "--to", "geojson", "--to", "ply", "--json")
    report = json.loads(ended.stdout.splitlines()[-1])
    assert ended.returncode == 1
    assert set(report["written"]) == {"ply"}
    assert report["failed"] == {"geojson": "ZeroDivisionError: division by zero"}
    monkeypatch.setattr("service.offline.exports.maps.MAPS", ("geojson", "laz", "coverage"))
    assert skyrelief("export", scan, "--to", "all", "--out", out).returncode == 0
    manifest = json.loads((out / "manifest.json").read_text())
    assert [f["kind"] for f in manifest["files"]] == ["laz", "coverage"]
    assert manifest["failed"] == {"geojson": "ZeroDivisionError: division by zero"}


def test_cancelling_is_no_fault_of_a_product(scan: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from service.offline.exports.view import ExportOptions, ScanView, export
    from service.progress import CancelledError

    progress = Progress()
    with ScanView(scan, progress=progress) as view:
        progress.cancel()
        with pytest.raises(CancelledError):
            export(view, "all", scan / "cancelled", ExportOptions())
    assert not list(scan.glob("*cancelled*"))


def test_replay_ends_with_the_verdict(capsys: pytest.CaptureFixture[str]) -> None:
    trust = {"level": "doubtful", "reasons": ["the lens is assumed", "no attitude"]}
    summary = {
        "warnings": [], "failed": {}, "scan_folder": "scan", "frames": 10, "distance_m": 5.0,
        "segments": 1, "pairs": 3, "clouds_per_second": 1.0, "refusals": {"blurred": 2},
        "quality": {"trust": trust}, "georeference": "none",
    }  # fmt: skip
    replay.report(summary, as_json=False)
    last = capsys.readouterr().out.splitlines()[-1]
    assert last == "trust: doubtful, georeference: none: the lens is assumed; no attitude"


def test_a_backend_without_a_device_warns(caplog: pytest.LogCaptureFixture) -> None:
    class Slow:
        name, device, keeps_pairs = "torch", "cpu", False

    slow: Any = Slow()
    with caplog.at_level(logging.WARNING):
        backend_choice.choose_backend("torch", backend_choice.Choice(lambda _: slow))
    assert "about 12 times the duration" in caplog.text
