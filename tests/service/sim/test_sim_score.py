"""``score`` on scan folders with known errors, made from the truth itself."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from deliverable_scoring import options_of, score_deliverables, view_from_above
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from recon.se3 import so3_exp
from recon.surface.meshing import Mesh
from recon.types import F64, PointCloud
from service.cli import app
from service.errors import InputError
from service.georeference import LocalFrame
from service.offline.exports.model import glb
from service.scans.fused_cloud import write_laz
from service.sim import scoring, shapes
from service.sim.recording import Faults, SimulationOptions, prepare
from service.sim.truth import heights_below, read_surface, read_truth

pytestmark = pytest.mark.slow

TRUTH_AT = LocalFrame(47.3977, 8.5456, 488.0)
SCAN_AT = LocalFrame(47.3980, 8.5450, 540.0)  # another origin, 33 m north and 45 m west


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("score") / "flight"
    arguments = [
        "simulate", "--out", str(folder), "--size", "320x180", "--fps", "2", "--duration-s", "10",
        "--height-m", "40", "--depth-frames", "20", "--no-telemetry",
    ]  # fmt: skip
    result = CliRunner().invoke(app, arguments)
    if result.exception is not None:
        raise result.exception
    return folder


def true_cloud(flight: Path) -> F64:
    """(N, 3) every fourth pixel, each way, of the true depth maps, in the truth's ENU."""
    parts = []
    for path in sorted((flight / "truth").glob("depth_*.npz")):
        with np.load(path) as data:
            depth, K, T = data["depth_m"][::4, ::4], data["K"], data["T_world_camera"]
        v, u = np.mgrid[0:180:4, 0:320:4]
        rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)], -1)
        parts.append((rays * depth[..., None]).reshape(-1, 3) @ T[:3, :3].T + T[:3, 3])
    return np.concatenate(parts)


def write_scan(
    folder: Path, flight: Path, points: F64, place: bool, R: F64, t: F64, sigma_m: float
) -> Path:
    """A scan folder: ``points`` and the true trajectory, both moved by ``R``, ``t``."""
    folder.mkdir()
    rows = np.loadtxt(flight / "truth" / "trajectory.tum")
    centres, turns = (
        rows[:, 1:4] @ R.T + t,
        Rotation.from_matrix(R) * Rotation.from_quat(rows[:, 4:]),
    )
    points = points @ R.T + t
    if place:  # tangent planes 56 m apart differ by 0.0005 degrees: positions through the globe
        points = SCAN_AT.to_enu(TRUTH_AT.to_geodetic(points))
        centres = SCAN_AT.to_enu(TRUTH_AT.to_geodetic(centres))
    count = len(points)
    cloud = PointCloud(
        points.astype(np.float32),
        np.zeros((count, 3), np.uint8),
        np.full(count, sigma_m, np.float32),
        np.full(count, 2, np.uint8),
    )
    write_laz(
        folder / "cloud.laz",
        [(cloud, None, None)],
        SCAN_AT if place else None,
        1_777_629_600 * 10**9,
    )
    table = np.column_stack([rows[:, 0], centres, turns.as_quat()])
    np.savetxt(folder / "trajectory.tum", table, "%.9f")
    origin = {"lat_deg": SCAN_AT.lat_deg, "lon_deg": SCAN_AT.lon_deg, "alt_amsl_m": 540.0}
    summary = {"origin": origin if place else None, "epsg": 32632 if place else None}
    (folder / "scan.json").write_text(json.dumps(summary))
    return folder


def score(scan: Path, truth: Path, *options: str) -> dict[str, Any]:
    result = CliRunner().invoke(app, ["score", str(scan), str(truth), "--json", *options])
    if result.exception is not None:
        raise result.exception
    report = json.loads(result.stdout.strip().splitlines()[-1])
    assert isinstance(report, dict)
    return report


def test_perfect_scan_scores_perfectly(flight: Path, tmp_path: Path) -> None:
    scan = write_scan(
        tmp_path / "scan", flight, true_cloud(flight), True, np.eye(3), np.zeros(3), 0.01
    )
    report = score(scan, flight)  # the flight's own folder is as good as its truth/
    assert report["georeferenced"] and report["poses_compared"] == 20
    assert report["surface"]["raw"]["rms_m"] < 0.003
    assert report["surface"]["rigid"]["rms_m"] < 0.003
    assert report["completeness"]["share"] > 0.97
    assert report["completeness"]["share_near_track"] > 0.97
    assert report["trajectory"]["raw"]["max_m"] < 0.001
    assert report["trajectory"]["raw"]["median_deg"] < 0.01
    assert report["altitude_m"] == pytest.approx(40.0, abs=3.0)
    dsm = report["dsm"]["raw"]
    assert dsm["cells"] > 1000 and dsm["within_30cm"] > 0.9
    assert dsm["rms_away_from_steps_m"] < 0.15 and abs(dsm["median_m"]) < 0.02


def test_ground_near_the_track_counts_apart(flight: Path, tmp_path: Path) -> None:
    """A cloud with a gap below the flight is complete elsewhere."""
    points, track = true_cloud(flight), np.loadtxt(flight / "truth" / "trajectory.tum")[:, 1:3]
    nearby = np.linalg.norm(points[:, None, :2] - track[None], axis=2).min(axis=1) > 6.0
    scan = write_scan(tmp_path / "scan", flight, points[nearby], True, np.eye(3), np.zeros(3), 0.01)
    complete = scoring.score(scan, flight, near_track_m=5.0)["completeness"]
    assert complete["share_near_track"] < 0.15 < 0.5 < complete["share"]


def test_known_displacement_and_noise_are_distinguished(flight: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    points = true_cloud(flight)
    points += 0.1 * rng.normal(size=points.shape)
    turn = so3_exp(np.radians([0.4, -0.3, 0.8]))
    scan = write_scan(
        tmp_path / "scan", flight, points, True, turn, np.array([0.8, -0.5, 1.1]), 0.1
    )
    report = score(scan, flight / "truth")
    raw, rigid = report["surface"]["raw"], report["surface"]["rigid"]
    assert raw["median_m"] > 0.5 and raw["bias_m"] > 0.5
    assert rigid["median_m"] == pytest.approx(0.0674, rel=0.12)  # of |N(0, 0.1)|
    assert abs(rigid["bias_m"]) < 0.01
    assert rigid["honesty"]["within_1_sigma"] == pytest.approx(0.68, abs=0.06)
    assert rigid["fit"]["turn_deg"] == pytest.approx(np.sqrt(0.16 + 0.09 + 0.64), abs=0.05)
    assert rigid["median_percent_of_altitude"] == pytest.approx(
        100 * rigid["median_m"] / report["altitude_m"]
    )
    assert rigid["median_percent_of_distance"] == pytest.approx(100 * 0.0674 / 42.0, rel=0.2)
    assert report["dsm"]["raw"]["median_m"] == pytest.approx(raw["bias_m"], abs=0.35)
    assert abs(report["dsm"]["rigid"]["median_m"]) < 0.1
    assert report["trajectory"]["raw"]["rms_m"] > 0.5
    assert report["trajectory"]["rigid"]["rms_m"] < 0.01
    assert report["trajectory"]["raw"]["drift_percent"] == pytest.approx(1.4, abs=0.4)


def test_scan_without_a_place_is_judged_after_a_similarity_fit(
    flight: Path, tmp_path: Path
) -> None:
    turn = so3_exp(np.array([0.4, -0.2, 1.9]))
    cloud = true_cloud(flight)
    shift = np.array([90.0, -40.0, 7.0])
    scan = write_scan(tmp_path / "scan", flight, cloud, False, turn, shift, 0.01)
    shrink(scan, 0.93)
    report = score(scan, flight / "truth")
    assert not report["georeferenced"] and report["judged_after"] == "similarity"
    assert "raw" not in report["surface"] and "raw" not in report["trajectory"]
    assert report["surface"]["similarity"]["fit"]["scale"] == pytest.approx(1 / 0.93, rel=1e-3)
    assert report["surface"]["similarity"]["median_m"] < 0.01
    assert (
        report["trajectory"]["rigid"]["rms_m"] > 0.5 > report["trajectory"]["similarity"]["rms_m"]
    )
    assert report["completeness"]["share"] > 0.97


def test_a_wrong_scale_of_a_placed_scan_is_told_from_errors_of_its_surface(
    flight: Path, tmp_path: Path
) -> None:
    dsm = {}
    for scale in (1.0, 0.97):
        folder, at = tmp_path / f"{scale}", np.eye(3) * scale
        scan = write_scan(folder, flight, true_cloud(flight), True, at, np.zeros(3), 0.01)
        dsm[scale] = score(scan, flight)["dsm"]
    assert dsm[0.97]["rigid"]["rms_m"] > 1.5 * dsm[1.0]["rigid"]["rms_m"]
    assert dsm[0.97]["similarity"]["rms_m"] < 1.1 * dsm[1.0]["similarity"]["rms_m"]


def shrink(scan: Path, scale: float) -> None:
    """Scale a scan about its origin."""
    import laspy

    las = laspy.read(scan / "cloud.laz")
    las.xyz = np.asarray(las.xyz) * scale
    las.write(scan / "cloud.laz")
    rows = np.loadtxt(scan / "trajectory.tum")
    rows[:, 1:4] *= scale
    np.savetxt(scan / "trajectory.tum", rows, "%.9f")


def test_missing_half_of_the_surface_is_missed(flight: Path, tmp_path: Path) -> None:
    points = true_cloud(flight)
    along = points[:, :2] @ [np.sin(np.radians(35)), np.cos(np.radians(35))]
    points = points[along < np.median(along)]
    scan = write_scan(tmp_path / "scan", flight, points, True, np.eye(3), np.zeros(3), 0.01)
    report = score(scan, flight)
    assert 0.35 < report["completeness"]["share"] < 0.65
    assert report["surface"]["raw"]["median_m"] < 0.003
    text = CliRunner().invoke(app, ["score", str(scan), str(flight)]).stdout
    assert "completeness: " in text and "% of path" in text and "of altitude" in text


@pytest.mark.parametrize(
    ("damage", "word"),
    [
        ("cloud.laz", "no such file"),
        ("scan.json", "no such file"),
        ("trajectory.tum", "no such file"),
        ("cloud.laz:broken", "cannot be read"),
        ("scan.json:broken", "cannot be read"),
        ("trajectory.tum:broken", "cannot be read"),
        ("whole", "no such folder"),
        ("truth", "no such folder"),
        ("points", "no points"),
        ("times", "no pose lies within"),
    ],
)
def test_missing_or_damaged_parts_are_named(
    damage: str, word: str, flight: Path, tmp_path: Path
) -> None:
    points = true_cloud(flight)[::50]
    if damage == "points":
        points = points[:0]
    scan = write_scan(
        tmp_path / "scan", flight, points, damage != "times", np.eye(3), np.zeros(3), 0.01
    )
    truth = flight
    name, _, how = damage.partition(":")
    if how == "broken":
        (scan / name).write_text("neither this nor that")
    elif damage == "whole":
        scan = tmp_path / "elsewhere"
    elif damage == "truth":
        truth = tmp_path / "nowhere"
    elif damage == "times":
        rows = np.loadtxt(scan / "trajectory.tum")
        rows[:, 0] += 1e6
        np.savetxt(scan / "trajectory.tum", rows, "%.9f")
    elif damage != "points":
        (scan / name).unlink()
    with pytest.raises(InputError, match=word) as caught:
        score(scan, truth)
    assert "\n" not in str(caught.value)


def delivered(scan: Path, flight: Path, shift_east_m: float, shift_up_m: float) -> None:
    """Write a DSM, an orthophoto and a mesh made of the truth itself, shifted; the DSM is filled
    but for a metre at the edges of buildings."""
    rasterio = pytest.importorskip("rasterio", exc_type=ImportError)
    pytest.importorskip("trimesh")
    truth = read_truth(flight)
    shape, cell = (200, 240), 0.25
    centre = truth.poses[len(truth.poses) // 2][:3, 3]
    middle = TRUTH_AT.to_utm(np.array([[centre[0], centre[1], 0.0]]))[0]
    west, north = np.floor(middle[:2] + np.array([-30.0, 25.0]))
    row, col = np.indices(shape).reshape(2, -1)
    utm = np.column_stack([west + (col + 0.5) * cell, north - (row + 0.5) * cell, 0 * col + 488.0])
    xy = TRUTH_AT.from_utm(utm)[:, :2]
    height = heights_below(truth.surface, xy) + 488.0 + shift_up_m
    place = {
        "crs": "EPSG:32632", "height": shape[0], "width": shape[1],
        "transform": rasterio.transform.from_origin(west + shift_east_m, north, cell, cell),
    }  # fmt: skip
    options = json.loads((truth.folder / "params.json").read_text())["options"]
    blocks = prepare(options_of(options)).scene.blocks
    houses = blocks[np.isin(blocks[:, shapes.KIND], (shapes.FLAT, shapes.GABLED))]
    x, y = xy.T
    filled = np.any([shapes.inside(house, x, y, 1.0) for house in houses], axis=0)
    bands = np.stack([height, 0 * height, filled]).reshape(3, *shape)
    with rasterio.open(
        scan / "dsm.tif", "w", driver="GTiff", count=3, dtype="float32", nodata=-9999.0, **place
    ) as image:
        image.write(bands.astype(np.float32))
    low, high = xy.min(axis=0) - 1.0, xy.max(axis=0) + 1.0
    size = np.ceil((high - low) / 0.125).astype(int)
    above = view_from_above(truth.folder, low[0], high[1], 0.125, (int(size[1]), int(size[0])))
    at = np.floor((xy - [low[0], high[1]]) / [0.125, -0.125]).astype(int)
    rgba = np.full((4, *shape), 255, np.uint8)
    rgba[:3] = above[at[:, 1], at[:, 0], ::-1].reshape(*shape, 3).transpose(2, 0, 1)
    with rasterio.open(
        scan / "ortho.tif", "w", driver="GTiff", count=4, dtype="uint8", **place
    ) as image:
        image.write(rgba)
    vertices, faces = read_surface(truth.folder / "surface.ply")
    moved = vertices + np.array([shift_east_m, 0.0, shift_up_m])
    mesh = Mesh(SCAN_AT.to_enu(TRUTH_AT.to_geodetic(moved)), faces)
    origin = [SCAN_AT.lat_deg, SCAN_AT.lon_deg, SCAN_AT.alt_amsl_m]
    (scan / "mesh.glb").write_bytes(glb([(mesh, None)], {"origin_lat_lon_amsl": origin}))


def test_files_are_measured_where_they_say_they_are(flight: Path, tmp_path: Path) -> None:
    """Files made of the truth, 0.8 m too far east and 0.3 m too high."""
    scan = write_scan(
        tmp_path / "scan", flight, true_cloud(flight), True, np.eye(3), np.zeros(3), 0.1
    )
    delivered(scan, flight, 0.8, 0.3)
    found = score_deliverables(scan, flight)
    assert {k: v["file"] for k, v in found.items()} == {
        "dsm": "dsm.tif", "ortho": "ortho.tif", "mesh": "mesh.glb", "laz": "cloud.laz",
    }  # fmt: skip
    dsm, ortho, mesh = (found[k]["raw"] for k in ("dsm", "ortho", "mesh"))
    assert dsm["bias_m"] == pytest.approx(0.3, abs=0.02)
    assert dsm["completeness"] > 0.3
    assert 0.3 < dsm["buildings"][0] < 0.9 and dsm["buildings"][1] == 0.0
    assert 0.0 < dsm["objects"][0] < dsm["buildings"][0]
    assert ortho["median_m"] == pytest.approx(0.8, abs=0.05)
    assert ortho["east_m"] == pytest.approx(0.8, abs=0.05)
    assert abs(ortho["north_m"]) < 0.05 and found["ortho"]["matched_share"] > 0.9
    assert 0.2 < mesh["median_m"] < 0.4 and mesh["completeness"] > 0.85
    assert found["laz"]["raw"]["median_m"] < 0.02 and found["laz"]["epsg"] == 32632
    delivered(scan, flight, 0.0, 0.3)
    exact = score_deliverables(scan, flight)["ortho"]["raw"]
    assert exact["psnr_db"] > 30.0 > ortho["psnr_db"] and exact["steps_psnr_db"] > 25.0
    assert ortho["steps_psnr_db"] < ortho["psnr_db"] - 1.0


def test_a_file_that_is_none_is_named(flight: Path, tmp_path: Path) -> None:
    pytest.importorskip("rasterio", exc_type=ImportError)
    scan = write_scan(
        tmp_path / "scan", flight, true_cloud(flight), True, np.eye(3), np.zeros(3), 0.1
    )
    (scan / "dsm.tif").write_bytes(b"II*\0 not much more")
    with pytest.raises(InputError, match=r"dsm\.tif") as refused:
        score_deliverables(scan, flight)
    assert "\n" not in str(refused.value)


def test_options_come_back_from_their_file() -> None:
    options = SimulationOptions(
        faults=Faults(blank=((3, 2),), exposure=((1.0, 0.5),)), photos=Path("mosaic"), seed=7
    )
    values = json.loads(json.dumps(asdict(replace(options, photos=None))))
    assert options_of(values) == replace(options, photos=None)
    assert options_of(values | {"photos": "mosaic", "of later": 1}) == options
