"""``refine --video``: a scan adjusted by its own images, against a ground that is known exactly."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from painted_ground import SIZE, K, pose, still
from typer.testing import CliRunner

from recon import se3
from recon.camera_model import project, scaled_K
from recon.types import F64, DepthMap, Keyframe, Pose
from service.cli import app
from service.errors import InputError
from service.georeference import LocalFrame
from service.stream.codec import encode
from service.stream.records import PoseRecord, ScanHeader
from service.stream.store import ScanStore

FRAME = LocalFrame(47.39, 8.54, 408.0)
START_NS = 1_700_000_000_000_000_000
SMALL = (60, 45)
TOO_DEEP = 1.04
SPOTS = {"A": (-8.0, -7.0), "B": (30.0, -8.0), "D": (28.0, 12.0), "E": (-6.0, 10.0),
         "C1": (10.0, 2.0), "C2": (20.0, -4.0)}  # fmt: skip


def flown() -> F64:
    """Truth: two strips in opposite directions that lean and overlap by half."""
    one = [pose(6.0 * k, 0.0, 40.0 + k % 2, seed=k) for k in range(5)]
    two = [pose(24.0 - 6.0 * k, 180.0, 38.0, seed=9 + k) for k in range(5)]
    return np.array([*one, *two])


def depth_of(T: F64) -> F64:
    """(h, w) exact depth of the plane z = 0."""
    k = scaled_K(K, SMALL[0] / SIZE[0], SMALL[1] / SIZE[1])
    v, u = np.mgrid[0 : SMALL[1], 0 : SMALL[0]].astype(np.float64)
    ways = np.stack([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], np.ones_like(u)], -1)
    return np.asarray(-T[2, 3] / (ways @ T[:3, :3].T)[..., 2])


def made(folder: Path, truth: F64, placed: bool = True) -> Path:
    """A scan whose poses err one by one and whose surfaces are 4 % too deep, and its stills."""
    rng = np.random.default_rng(4)
    camera = {"width": SIZE[0], "height": SIZE[1], "K": K.ravel().tolist(), "distortion": [0.0] * 5}
    header = ScanHeader(
        "test-1", "drone-1", START_NS, camera=camera, origin_lat_deg=FRAME.lat_deg,
        origin_lon_deg=FRAME.lon_deg, origin_alt_amsl_m=FRAME.alt_amsl_m, epsg=FRAME.epsg,
        georeference="gnss",
    )  # fmt: skip
    if not placed:
        header = ScanHeader("test-1", "drone-1", START_NS, camera=camera)
    spread = np.diag([0.02**2] * 3 + [1.0] * 3)
    (folder / "stills").mkdir()
    with ScanStore.create(folder / "scan" / "scan.db", header) as store:
        for k, T in enumerate(truth):
            time_ns = START_NS + k * 10**9
            here = T @ se3.exp(rng.normal(size=6) * ([0.01] * 3 + [0.7] * 3))
            depth = (TOO_DEEP * depth_of(T)).astype(np.float32)
            bgr = np.full((*depth.shape, 3), 120, np.uint8)
            K_small = scaled_K(K, SMALL[0] / SIZE[0], SMALL[1] / SIZE[1])
            one = Keyframe(
                k, time_ns,
                DepthMap(depth, np.full_like(depth, 0.05), np.full(depth.shape, 3, np.uint8),
                         K_small, here),
                bgr, Pose(here, spread, ("vision",)), np.ones(depth.shape, np.bool_),
            )  # fmt: skip
            store.add_keyframe(k, encode(one, time_ns))
            store.add_pose(PoseRecord(time_ns, here, spread, sources=("vision",), keyframe_seq=k))
            image = cv2.cvtColor(still(T), cv2.COLOR_GRAY2BGR)
            assert cv2.imwrite(str(folder / "stills" / f"{k}.png"), image)
        store.finish({"frames": len(truth)})
    return folder / "scan"


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


def test_a_video_of_something_else_changes_nothing(tmp_path: Path) -> None:
    scan = made(tmp_path, flown())
    for path in (tmp_path / "stills").iterdir():
        assert cv2.imwrite(str(path), np.full((SIZE[1], SIZE[0], 3), 90, np.uint8))
    refused = CliRunner().invoke(app, ["refine", str(scan), "--video", str(tmp_path / "stills")])
    assert isinstance(refused.exception, InputError) and "is this the video" in str(
        refused.exception
    )
