"""``refine --video``: a scan adjusted by its own images, against a ground that is known exactly."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from painted_ground import SIZE, K, still
from painted_strips import FRAME, depth_of, flown, made
from typer.testing import CliRunner

from recon import se3
from recon.camera_model import project
from recon.types import F64
from service.cli import app
from service.errors import InputError
from service.stream.store import ScanStore

SPOTS = {"A": (-8.0, -7.0), "B": (30.0, -8.0), "D": (28.0, 12.0), "E": (-6.0, 10.0),
         "C1": (10.0, 2.0), "C2": (20.0, -4.0)}  # fmt: skip


def survey(path: Path, truth: F64, by_name: bool = False) -> Path:
    """Each spot marked in up to three keyframes, or stills; names with C are check points."""
    which = "image" if by_name else "keyframe_seq"
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["name", which, "u_px", "v_px", "lat", "lon", "alt_amsl_m", "role"])
        for name, (x, y) in SPOTS.items():
            spot = np.array([[x, y, 0.0]])
            place = FRAME.to_geodetic(spot)[0].tolist()
            seen = [(k, project(K, se3.transform(se3.inverse(T), spot))[0].tolist())
                    for k, T in enumerate(truth)]  # fmt: skip
            inside = [one for one in seen if 5 < one[1][0] < 474 and 5 < one[1][1] < 354]
            for k, uv in inside[:: max(1, len(inside) // 3)][:3]:
                role = "check" if name.startswith("C") else "control"
                table.writerow([name, f"{k}.png" if by_name else k, *uv, *place, role])
    return path


@pytest.mark.slow
def test_images_and_control_points_bring_a_bent_scan_to_the_truth(tmp_path: Path) -> None:
    truth = flown()
    scan, points = made(tmp_path, truth), survey(tmp_path / "points.csv", truth)
    command = ["refine", str(scan), "--video", str(tmp_path / "stills"), "--gcp", str(points)]
    answer = CliRunner().invoke(app, [*command, "--json"])
    assert answer.exit_code == 0, answer.output
    figures = json.loads(answer.stdout.splitlines()[-1])
    assert figures["images"]["views"] == 10 and figures["images"]["sightings"] > 2000
    assert figures["control"]["count"] == 4 and figures["check"]["count"] == 2
    assert figures["check"]["rms_h_after_m"] < 0.05 and figures["check"]["rms_v_after_m"] < 0.1
    alone = [p["left_out_m"] for p in figures["points"] if p["role"] == "control"]
    assert np.abs(np.array(alone)).max() < 0.2
    assert figures["residuals"]["pixels"]["rms"] < 1.5
    with ScanStore.open(scan / "scan.db") as store:
        for k, T in enumerate(truth):
            found = store.keyframe(k)
            assert found is not None
            ours = found.depth.T_world_camera
            assert np.linalg.norm(ours[:3, 3] - T[:3, 3]) < 0.3  # 1.2 m before
            assert np.nanmedian(found.depth.depth_m / depth_of(T)) == pytest.approx(1.0, abs=0.005)
            assert np.sqrt(np.diag(found.pose.covariance)[3:]).max() < 1.0
    back = CliRunner().invoke(app, ["refine", str(scan), "--undo"])
    assert back.exit_code == 0, back.output


@pytest.mark.slow
def test_a_scan_without_a_place_takes_its_images_along(tmp_path: Path) -> None:
    """Points marked in stills by their names; a mark in one that vision lost is left out."""
    truth = flown()
    scan = made(tmp_path, truth, placed=False)
    points = survey(tmp_path / "points.csv", truth, by_name=True)
    lost = still(truth[9])
    assert cv2.imwrite(str(tmp_path / "stills" / "10.png"), lost)
    text = points.read_text(encoding="utf-8")
    row = text.splitlines()[1].split(",")
    points.write_text(text + ",".join([row[0], "10.png", "5", "5", *row[4:]]) + "\n")
    command = ["refine", str(scan), "--video", str(tmp_path / "stills"), "--gcp", str(points)]
    answer = CliRunner().invoke(app, [*command, "--json"])
    assert answer.exit_code == 0, answer.output
    figures = json.loads(answer.stdout.splitlines()[-1])
    assert figures["check"]["rms_h_after_m"] < 0.05 and figures["check"]["rms_v_after_m"] < 0.1
    assert any("not used: 10.png" in note for note in figures["notes"])
    points.write_text(text.replace("0.png", "IMG_0.jpg"), encoding="utf-8")
    for video, why in (([], "needs --video"), (command[2:4], "IMG_0.jpg is not in the folder")):
        refused = CliRunner().invoke(app, ["refine", str(scan), *video, "--gcp", str(points)])
        assert isinstance(refused.exception, InputError) and why in str(refused.exception)


@pytest.mark.slow
def test_a_video_of_something_else_changes_nothing(tmp_path: Path) -> None:
    scan = made(tmp_path, flown())
    for path in (tmp_path / "stills").iterdir():
        assert cv2.imwrite(str(path), np.full((SIZE[1], SIZE[0], 3), 90, np.uint8))
    refused = CliRunner().invoke(app, ["refine", str(scan), "--video", str(tmp_path / "stills")])
    assert isinstance(refused.exception, InputError) and "is this the video" in str(
        refused.exception
    )
