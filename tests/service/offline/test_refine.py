"""Refinement of finished scans: control points, revisions, and everything wrong with a CSV."""

from __future__ import annotations

import contextlib
import csv
import json
import re
import struct
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink  # type: ignore[import-untyped]
from typer.testing import CliRunner

from recon import se3
from recon.types import F64, DepthMap, Keyframe, Pose
from service.cli import app
from service.errors import InputError
from service.georeference import LocalFrame
from service.offline.refine.metashape_file import read_metashape
from service.offline.refine.refinement import RefineOptions, refine, undo
from service.offline.refine.revisions import REFINED, Revisions
from service.offline.refine.survey_file import at_times, read_survey
from service.stream.codec import encode
from service.stream.database import is_sound
from service.stream.records import (
    PoseRecord,
    Repose,
    ScanHeader,
    pack_covariance,
    pack_motion,
)
from service.stream.store import ScanStore

FRAME = LocalFrame(47.39, 8.54, 408.0)
DOWN = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
K = np.array([[140.0, 0.0, 79.5], [0.0, 140.0, 44.5], [0.0, 0.0, 1.0]])
SIZE = (160, 90)
START_NS = 1_700_000_000_000_000_000
SHIFT = np.array([1.4, -0.9, 2.1])
TURN = np.array([0.003, -0.004, 0.008])


def ground(x: Any, y: Any) -> Any:
    """True height of gentle country."""
    return 1.5 * np.sin(np.asarray(x) / 17.0) + 1.0 * np.cos(np.asarray(y) / 13.0)


def ground_depth(T: F64) -> F64:
    """(h, w) exact depth of the country, by fixed-point iteration along the rays."""
    w, h = SIZE
    u, v = np.meshgrid(np.arange(w), np.arange(h))
    ways = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones((h, w))], -1)
    ways = ways @ T[:3, :3].T
    d = np.full((h, w), T[2, 3])
    for _ in range(30):
        p = T[:3, 3] + d[..., None] * ways
        d = (ground(p[..., 0], p[..., 1]) - T[2, 3]) / ways[..., 2]
    return np.asarray(d)


@dataclass(eq=False)
class Flight:
    """A scan whose poses are off by one motion, and its truth."""

    folder: Path
    truth: F64  # (N, 4, 4)
    placed: bool = True

    @property
    def scan(self) -> Path:
        return self.folder / "scan"

    def pixel(self, k: int, spot: F64) -> tuple[float, float] | None:
        p = se3.transform(se3.inverse(self.truth[k]), spot[None])[0]
        u, v = K[0, 0] * p[0] / p[2] + K[0, 2], K[1, 1] * p[1] / p[2] + K[1, 2]
        return (float(u), float(v)) if 3 < u < SIZE[0] - 4 and 3 < v < SIZE[1] - 4 else None

    def survey(self, spots: dict[str, tuple[float, float]], **changes: Any) -> list[dict[str, Any]]:
        """Rows of a CSV: each spot (east, north) marked in up to three keyframes."""
        rows = []
        for name, (x, y) in spots.items():
            spot = np.array([x, y, float(ground(x, y))])
            lat, lon, alt = FRAME.to_geodetic(spot[None])[0]
            seen = [k for k in range(len(self.truth)) if self.pixel(k, spot)]
            for k in seen[:: max(1, len(seen) // 3)][:3]:
                uv = self.pixel(k, spot)
                assert uv is not None
                rows.append(
                    {
                        "name": name, "keyframe_seq": 10 * k, "u_px": uv[0], "v_px": uv[1],
                        "lat": lat, "lon": lon, "alt_amsl_m": alt, "sigma_h_m": 0.02,
                        "sigma_v_m": 0.03, "role": "check" if name.startswith("C") else "control",
                    }
                    | changes
                )  # fmt: skip
        return rows


SPOTS = {"A": (4.0, -6.0), "B": (46.0, -4.0), "D": (44.0, 26.0), "E": (5.0, 25.0), "F": (25.0, 9.0),
         "C1": (15.0, 3.0), "C2": (36.0, 18.0)}  # fmt: skip


def wrong(T: F64) -> F64:
    """The pose as the scan has it."""
    return se3.compose(se3.so3_exp(TURN), SHIFT) @ T


@cache
def seen(keyframes: int) -> tuple[F64, list[F64]]:
    """(N, 4, 4) poses on two legs over the country, and the depth from each."""
    half = keyframes // 2
    places = [
        (6.0 * min(k, keyframes - 1 - k), 0.0 if k < half else 20.0, 40.0) for k in range(keyframes)
    ]
    truth = np.array([se3.compose(DOWN, np.array(place)) for place in places])
    return truth, [ground_depth(T) for T in truth]


def fly(folder: Path, placed: bool = True, finished: bool = True, keyframes: int = 16) -> Flight:
    """Two legs over the country, stored with poses that are off."""
    truth, depths = seen(keyframes)
    camera = {"width": SIZE[0], "height": SIZE[1], "K": K.ravel().tolist(), "distortion": [0.0] * 5}
    header = ScanHeader("test-1", "drone-1", START_NS, camera=camera)
    if placed:
        header = replace(
            header, origin_lat_deg=FRAME.lat_deg, origin_lon_deg=FRAME.lon_deg,
            origin_alt_amsl_m=FRAME.alt_amsl_m, epsg=FRAME.epsg, georeference="gnss",
        )  # fmt: skip
    flight = Flight(folder, truth.copy(), placed)
    spread = np.diag([0.01**2] * 3 + [1.5**2] * 3)
    with ScanStore.create(flight.scan / "scan.db", header) as store:
        for k, T in enumerate(truth):
            time_ns = START_NS + k * 10**9
            depth = depths[k].astype(np.float32)
            sigma = np.full(depth.shape, 0.05, np.float32)
            views = np.full(depth.shape, 3, np.uint8)
            bgr = np.full((*depth.shape, 3), 120, np.uint8)
            here = wrong(T)
            one = Keyframe(
                10 * k, time_ns, DepthMap(depth, sigma, views, K, here), bgr,
                Pose(here, spread, ("vision",)), np.ones(depth.shape, np.bool_),
            )  # fmt: skip
            store.add_keyframe(10 * k, encode(one, time_ns))
            for part in (0.0, 0.5):  # a keyframe and a frame after it
                if part and k + 1 >= len(truth):
                    continue
                ahead = se3.compose(
                    np.eye(3), part * (truth[min(k + 1, len(truth) - 1)] - T)[:3, 3]
                )
                store.add_pose(
                    PoseRecord(
                        time_ns + int(part * 1e9),
                        wrong(ahead @ T),
                        spread,
                        sources=("vision",),
                        keyframe_seq=10 * k if part == 0 else None,
                    )
                )
        if finished:
            store.finish({"frames": 2 * keyframes - 1})
    return flight


def write_csv(path: Path, rows: list[dict[str, Any]]) -> Path:
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    return path


def errors(flight: Flight, folder: Path | None = None) -> F64:
    """(N,) metres by which the keyframes' positions are off, in the frame of the truth."""
    with ScanStore.open((folder or flight.scan) / "scan.db") as store:
        own = LocalFrame(*(getattr(store.header, f"origin_{n}") or 0.0
                           for n in ("lat_deg", "lon_deg", "alt_amsl_m")))  # fmt: skip
        out = []
        for k, T in enumerate(flight.truth):
            found = store.keyframe(10 * k)
            assert found is not None
            enu = found.depth.T_world_camera[None, :3, 3]
            if own != FRAME:
                enu = FRAME.to_enu(own.to_geodetic(enu))
            out.append(float(np.linalg.norm(enu[0] - T[:3, 3])))
    return np.array(out)


@pytest.fixture
def flight(tmp_path: Path) -> Flight:
    return fly(tmp_path)


def test_control_points_bring_map_and_track_to_their_place(flight: Flight) -> None:
    gcp = write_csv(flight.folder / "points.csv", flight.survey(SPOTS))
    before = errors(flight)
    figures = refine(flight.scan, RefineOptions(gcp))
    assert before.min() > 2.0 and errors(flight).max() < 0.12
    assert figures["control"]["count"] == 5 and figures["check"]["count"] == 2
    assert figures["check"]["rms_h_before_m"] > 1.0 and figures["check"]["rms_v_before_m"] > 1.5
    assert figures["check"]["rms_h_after_m"] < 0.08 and figures["check"]["rms_v_after_m"] < 0.08
    with ScanStore.open(flight.scan / "scan.db") as store:
        poses = list(store.poses())
        assert len(poses) == 31
        for k in range(15):  # the frame half way between two keyframes
            half = (flight.truth[k] + flight.truth[k + 1])[:3, 3] / 2
            assert np.linalg.norm(poses[2 * k + 1].T_world_camera[:3, 3] - half) < 0.15
        assert poses[3].lat_deg is not None and poses[3].speed_m_s == pytest.approx(6.0, rel=0.05)
    summary = json.loads((flight.scan / "scan.json").read_text())
    assert summary["refinement"]["check"] == figures["check"]
    assert any("control points" in note for note in summary["notes"])


@pytest.mark.slow
def test_marks_by_time_and_points_of_the_cloud_count_too(flight: Flight) -> None:
    rows = []
    for name, (x, y) in SPOTS.items():
        spot = np.array([x, y, float(ground(x, y))])
        lat, lon, alt = FRAME.to_geodetic(spot[None])[0]
        row: dict[str, Any] = dict.fromkeys(("time", "u_px", "v_px", "x", "y", "z"), "")
        row |= {"name": name, "lat": lat, "lon": lon, "alt_amsl_m": alt}
        if name in "ABD":  # two images between keyframes
            for k in [k for k in range(15) if flight.pixel(k, spot)]:
                half = np.array(flight.truth[k])
                half[:3, 3] = (flight.truth[k] + flight.truth[k + 1])[:3, 3] / 2
                p = se3.transform(se3.inverse(half), spot[None])[0]
                seen = {"u_px": K[0, 0] * p[0] / p[2] + K[0, 2],
                        "v_px": K[1, 1] * p[1] / p[2] + K[1, 2]}  # fmt: skip
                if 0 < seen["u_px"] < 159 and 0 < seen["v_px"] < 89:
                    rows.append(row | seen | {"time": START_NS * 1e-9 + k + 0.5})
        else:
            utm = FRAME.to_utm(se3.transform(wrong(np.eye(4)), spot[None]))
            rows.append(row | dict(zip("xyz", utm[0], strict=True)))
    gcp = write_csv(flight.folder / "points.csv", rows)
    figures = refine(flight.scan, RefineOptions(gcp))
    assert [p["refused"] for p in figures["points"]] == [None] * len(SPOTS)
    assert errors(flight).max() < 0.2


@pytest.mark.slow
def test_the_same_input_twice_changes_nothing_and_undo_brings_all_back(flight: Flight) -> None:
    gcp = write_csv(flight.folder / "points.csv", flight.survey(SPOTS))
    with ScanStore.open(flight.scan / "scan.db") as store:
        store.add_reposes([Repose(0, 1, wrong(flight.truth[0]), 1.0, np.eye(6) * 0.01)])
        held = [(k.seq, k.depth.T_world_camera, k.depth.depth_m) for k in store.keyframes()]
        track = [p.T_world_camera for p in store.poses()]
    first = refine(flight.scan, RefineOptions(gcp))
    with ScanStore.open(flight.scan / "scan.db") as store:
        rows = store.numbers()["pose"], store.repose(0)
    again = refine(flight.scan, RefineOptions(gcp))
    assert first["changed"] and not again["changed"]
    assert {k: v for k, v in first.items() if k != "changed"} == {
        k: v for k, v in again.items() if k != "changed"
    }
    with ScanStore.open(flight.scan / "scan.db") as store:
        assert store.numbers()["pose"] == rows[0]
        repose = store.repose(0)
        assert repose is not None and rows[1] is not None
        assert repose.revision == rows[1].revision == REFINED
    undo(flight.scan)
    with ScanStore.open(flight.scan / "scan.db") as store:
        for seq, T, depth in held:
            found = store.keyframe(seq)
            assert found is not None
            assert np.abs(found.depth.T_world_camera - T).max() < 1e-9
            assert np.array_equal(found.depth.depth_m, depth, equal_nan=True)
        for pose, T in zip(store.poses(), track, strict=True):
            assert np.abs(pose.T_world_camera - T).max() < 1e-9
        assert store.refinement is None
    assert json.loads((flight.scan / "scan.json").read_text())["refinement"] is None
    assert refine(flight.scan, RefineOptions(gcp))["changed"]


@pytest.mark.slow
def test_loops_of_the_flight_hold_both_legs_together(tmp_path: Path) -> None:
    flight = fly(tmp_path)
    pairs = [(1, 14), (4, 11), (6, 9)]
    slip = np.array([0.4, 0.5, -0.3])  # the second leg has slipped against the first
    spread = np.diag([1e-3**2] * 3 + [0.02**2] * 3)
    motions = [
        [10 * a, 10 * b, pack_motion(se3.inverse(flight.truth[a]) @ flight.truth[b]),
         pack_covariance(spread)]
        for a, b in pairs
    ]  # fmt: skip
    with ScanStore.open(flight.scan / "scan.db") as store:
        for k in range(8, 16):
            T = se3.compose(np.eye(3), slip) @ wrong(flight.truth[k])
            store.add_reposes([Repose(10 * k, 1, T, 1.0, np.eye(6) * 0.01)])
        store.finish({"graph": {"loops": {"motions": motions}}})
    figures = refine(flight.scan, RefineOptions())
    assert figures["loops"]["used"] == 3

    def step() -> F64:
        with ScanStore.open(flight.scan / "scan.db") as store:
            one, two = (store.keyframe(10 * k) for k in (2, 13))
            assert one is not None and two is not None
            found = se3.inverse(one.depth.T_world_camera) @ two.depth.T_world_camera
        return np.asarray(found - se3.inverse(flight.truth[2]) @ flight.truth[13])[:3, 3]

    after = float(np.linalg.norm(step()))
    undo(flight.scan)
    assert float(np.linalg.norm(step())) > 0.6 and after < 0.35


def test_out_leaves_the_scan_alone(flight: Flight, tmp_path: Path) -> None:
    gcp = write_csv(flight.folder / "points.csv", flight.survey(SPOTS))
    before = (flight.scan / "scan.db").read_bytes()
    refine(flight.scan, RefineOptions(gcp, out=tmp_path / "refined"))
    assert errors(flight, tmp_path / "refined").max() < 0.12
    assert errors(flight).min() > 2.0
    assert len((flight.scan / "scan.db").read_bytes()) == len(before)
    assert (tmp_path / "refined" / "cloud.laz").is_file()
    with pytest.raises(InputError, match="exists"):
        refine(flight.scan, RefineOptions(gcp, out=tmp_path / "refined"))


@pytest.mark.slow
def test_a_scan_without_a_place_gets_it_from_three_points(tmp_path: Path) -> None:
    flight = fly(tmp_path, placed=False)
    rows = flight.survey(SPOTS)
    few = write_csv(flight.folder / "few.csv", [r for r in rows if r["name"] in "AB"])
    with pytest.raises(InputError, match="only 2 usable control points"):
        refine(flight.scan, RefineOptions(few))
    figures = refine(flight.scan, RefineOptions(write_csv(flight.folder / "points.csv", rows)))
    assert errors(flight).max() < 0.15
    assert figures["check"]["rms_v_after_m"] < 0.1
    summary = json.loads((flight.scan / "scan.json").read_text())
    assert summary["georeference"] == "control points" and summary["epsg"] == FRAME.epsg
    undo(flight.scan)
    assert json.loads((flight.scan / "scan.json").read_text())["origin"] is None


def flat_errors(flight: Flight) -> F64:
    """(N,) horizontal distances of the keyframes to the truth."""
    with ScanStore.open(flight.scan / "scan.db") as store:
        own = store.header
        assert own.origin_lat_deg is not None and own.origin_lon_deg is not None
        frame = LocalFrame(own.origin_lat_deg, own.origin_lon_deg, own.origin_alt_amsl_m or 0.0)
        out = []
        for k, T in enumerate(flight.truth):
            found = store.keyframe(10 * k)
            assert found is not None
            place = frame.to_geodetic(found.depth.T_world_camera[None, :3, 3])
            place[0, 2] = FRAME.alt_amsl_m
            out.append(np.linalg.norm((FRAME.to_enu(place)[0] - T[:3, 3])[:2]))
    return np.array(out)


@pytest.mark.slow
@pytest.mark.parametrize("placed", [True, False])
def test_points_without_heights_place_a_scan_horizontally(tmp_path: Path, placed: bool) -> None:
    flight = fly(tmp_path, placed)
    rows = flight.survey(SPOTS, alt_amsl_m="")
    figures = refine(flight.scan, RefineOptions(write_csv(flight.folder / "flat.csv", rows)))
    assert flat_errors(flight).max() < 0.3
    assert figures["check"]["rms_h_after_m"] < 0.1 and figures["check"]["rms_v_after_m"] is None
    assert all(p["after_m"][2] is None for p in figures["points"])
    assert any("no control point has a height" in note for note in figures["notes"]) != placed
    assert "vertically" not in json.loads((flight.scan / "scan.json").read_text())["notes"][-1]


@pytest.mark.slow
def test_the_command_prints_points_without_heights(flight: Flight) -> None:
    gcp = write_csv(flight.folder / "flat.csv", flight.survey(SPOTS, alt_amsl_m=""))
    answer = CliRunner().invoke(app, ["refine", str(flight.scan), "--gcp", str(gcp)])
    assert answer.exit_code == 0, answer.output
    assert "left out" in answer.stdout and "vertical" not in answer.stdout


@pytest.mark.slow
def test_each_control_point_is_distinguished_from_the_others(flight: Flight) -> None:
    """A point that is off by decimetres shows where it is left out, not where it takes part."""
    rows = flight.survey(SPOTS)
    figures = refine(flight.scan, RefineOptions(write_csv(flight.folder / "a.csv", rows)))
    sound = {p["name"]: p["left_out_m"] for p in figures["points"]}
    assert sound["C1"] is None  # a check point
    assert all(np.abs(sound[name]).max() < 0.2 for name in "ABDEF")
    for row in rows:
        if row["name"] == "F":
            row["alt_amsl_m"] += 0.6
    figures = refine(flight.scan, RefineOptions(write_csv(flight.folder / "b.csv", rows)))
    off = {p["name"]: p for p in figures["points"]}["F"]
    assert off["left_out_m"][2] == pytest.approx(-0.6, abs=0.2)
    assert abs(off["left_out_m"][2]) > abs(off["after_m"][2])
    few = [row for row in rows if row["name"] in ("A", "B", "D")]
    figures = refine(flight.scan, RefineOptions(write_csv(flight.folder / "c.csv", few)))
    assert all(p["left_out_m"] is None for p in figures["points"])


@pytest.mark.slow
def test_one_column_less_is_no_fault_and_points_with_heights_still_lift(flight: Flight) -> None:
    rows = [
        {k: v for k, v in row.items() if k != "sigma_v_m"} | ({"alt_amsl_m": ""} if flat else {})
        for row in flight.survey(SPOTS)
        for flat in [row["name"] in "AB"]
    ]
    figures = refine(flight.scan, RefineOptions(write_csv(flight.folder / "some.csv", rows)))
    assert [p["refused"] for p in figures["points"]] == [None] * len(SPOTS)
    assert errors(flight).max() < 0.2
    bare = [{k: v for k, v in row.items() if k != "alt_amsl_m"} for row in rows]
    undo(flight.scan)
    refine(flight.scan, RefineOptions(write_csv(flight.folder / "bare.csv", bare)))
    assert flat_errors(flight).max() < 0.3


def test_a_map_of_another_shape_is_not_called_a_line(tmp_path: Path) -> None:
    flight = fly(tmp_path, placed=False)
    rows = flight.survey({name: SPOTS[name] for name in "ABDE"})
    rng = np.random.default_rng(4)
    moved = {name: rng.normal(0, 3e-4, 2) for name in "ABDE"}  # tens of metres
    rows = [
        r | {"lat": r["lat"] + moved[r["name"]][0], "lon": r["lon"] + moved[r["name"]][1]}
        for r in rows
    ]
    with pytest.raises(InputError, match="no three control points have the same distances"):
        refine(flight.scan, RefineOptions(write_csv(flight.folder / "bent.csv", rows)))


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"lon": -8.54}, "lon has the wrong sign"),
        ({"lat": -47.39}, "lat has the wrong sign"),
        ({"lat": 8.54, "lon": 47.39}, "swapped"),
        ({"lat": 47.41}, "wrong point, zone or sign"),
        ({"alt_amsl_m": 456.0}, "not above the ellipsoid"),
    ],
)
@pytest.mark.slow
def test_an_outlier_is_refused_and_named(
    flight: Flight, change: dict[str, float], why: str
) -> None:
    rows = [r | change if r["name"] == "D" else r for r in flight.survey(SPOTS)]
    figures = refine(flight.scan, RefineOptions(write_csv(flight.folder / "p.csv", rows)))
    refused = {p["name"]: p["refused"] for p in figures["points"] if p["refused"]}
    assert list(refused) == ["D"] and why in refused["D"]
    assert errors(flight).max() < 0.2


@pytest.mark.slow
def test_a_point_two_metres_off_is_distinguished_from_the_others(flight: Flight) -> None:
    rows = flight.survey(SPOTS)
    for row in rows:
        if row["name"] == "B":
            row["lat"] += 2.0 / 111_200
    figures = refine(flight.scan, RefineOptions(write_csv(flight.folder / "p.csv", rows)))
    refused = {p["name"]: p["refused"] for p in figures["points"] if p["refused"]}
    assert list(refused) == ["B"] and "north" in refused["B"]
    assert errors(flight).max() < 0.2


@pytest.mark.slow
def test_points_in_one_corner_are_reported(flight: Flight) -> None:
    corner = {"A": (4.0, -6.0), "B": (14.0, -4.0), "D": (12.0, 6.0), "C1": (36.0, 18.0)}
    gcp = write_csv(flight.folder / "points.csv", flight.survey(corner))
    (note,) = refine(flight.scan, RefineOptions(gcp))["notes"]
    assert "span 10 m of 42 m flown" in note
    gcp = write_csv(flight.folder / "all.csv", flight.survey(SPOTS))
    assert refine(flight.scan, RefineOptions(gcp))["notes"] == []


@pytest.mark.slow
def test_check_points_never_take_part(flight: Flight) -> None:
    rows = flight.survey(SPOTS)
    one = refine(
        flight.scan,
        RefineOptions(write_csv(flight.folder / "a.csv", rows), out=flight.folder / "a"),
    )
    alone = [r for r in rows if r["role"] == "control"]
    moved = alone + [r | {"alt_amsl_m": r["alt_amsl_m"] + 0.5} for r in rows if r not in alone]
    two = refine(
        flight.scan,
        RefineOptions(write_csv(flight.folder / "b.csv", moved), out=flight.folder / "b"),
    )
    assert one["moved_m"] == two["moved_m"] and one["control"] == two["control"]
    assert two["check"]["rms_v_after_m"] == pytest.approx(0.5, abs=0.1)


def test_when_half_contradict_the_rest_nothing_is_changed(flight: Flight) -> None:
    rows = flight.survey({k: SPOTS[k] for k in "AB"})
    for row in rows:
        if row["name"] == "B":
            row["lat"] += 10.0 / 111_200
    with pytest.raises(InputError, match="contradicts"):
        refine(flight.scan, RefineOptions(write_csv(flight.folder / "p.csv", rows)))
    with ScanStore.open(flight.scan / "scan.db") as store:
        assert not Revisions(store).refined


def write_log(flight: Flight, path: Path) -> Path:
    """A .tlog of a level vehicle heading north: attitude, position and its accuracy at 10 Hz."""
    link = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    with path.open("wb") as file:
        for n in range(-20, 10 * len(flight.truth) + 10):
            s = n / 10
            k = int(np.clip(np.floor(s), 0, len(flight.truth) - 2))
            spot = flight.truth[k][:3, 3] + (s - k) * (flight.truth[k + 1] - flight.truth[k])[:3, 3]
            lat, lon, alt = FRAME.to_geodetic(spot[None])[0]
            stamp_us = START_NS // 1000 + n * 100_000
            boot_ms = 60_000 + n * 100
            place = (round(lat * 1e7), round(lon * 1e7), round(alt * 1e3))
            for message in (
                mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3),
                mavlink.MAVLink_attitude_message(boot_ms, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
                mavlink.MAVLink_global_position_int_message(
                    boot_ms, *place, round(1e3 * spot[2]), 0, 0, 0, 0
                ),
                mavlink.MAVLink_gps_raw_int_message(
                    stamp_us, 6, *place, 60, 90, 0, 0, 14, 0, 100, 150, 0, 0, 0
                ),
            ):
                file.write(struct.pack(">Q", stamp_us) + message.pack(link))
    return path


@pytest.mark.parametrize("nearby", [True, False])
def test_the_flights_telemetry_places_the_track(flight: Flight, nearby: bool) -> None:
    log = flight.scan / "link.tlog" if nearby else flight.folder / "flight.tlog"
    write_log(flight, log)
    figures = refine(flight.scan, RefineOptions(telemetry=None if nearby else log))
    assert figures["telemetry"] and {"position", "attitude"} <= set(figures["residuals"])
    assert errors(flight).max() < 0.6


def test_a_broken_log_next_to_the_scan_is_noted_and_a_given_one_refused(flight: Flight) -> None:
    log = flight.scan / "link.tlog"
    log.write_bytes(b"no telemetry at all" * 40)
    figures = refine(flight.scan, RefineOptions())
    assert not figures["telemetry"] and "link.tlog" in figures["notes"][0]
    with pytest.raises(InputError, match=r"link\.tlog"):
        refine(flight.scan, RefineOptions(telemetry=log))


def test_scans_that_cannot_be_refined_say_why(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not finished"):
        refine(fly(tmp_path / "a", finished=False, keyframes=2).scan, RefineOptions())
    with pytest.raises(InputError, match="1 keyframe"):
        refine(fly(tmp_path / "b", keyframes=1).scan, RefineOptions())
    with pytest.raises(InputError, match=r"no scan\.db"):
        refine(tmp_path, RefineOptions())
    with pytest.raises(InputError, match="never refined"):
        undo(fly(tmp_path / "d", keyframes=2).scan)
    local = fly(tmp_path / "c", placed=False, keyframes=3)
    log = tmp_path / "x.tlog"
    log.write_bytes(b"nothing")
    with pytest.raises(InputError, match="no georeference"):
        refine(local.scan, RefineOptions(telemetry=log))
    assert refine(local.scan, RefineOptions())["moved_m"]["most"] < 1e-3


def test_a_damaged_scan_is_repaired_before_it_is_refined(tmp_path: Path) -> None:
    scan = fly(tmp_path, keyframes=6).scan
    path = scan / "scan.db"
    data = bytearray(path.read_bytes())
    middle = len(data) // 2 // 4096 * 4096
    data[middle : middle + 8192] = bytes(8192)
    path.write_bytes(data)
    assert not is_sound(path)
    assert refine(scan, RefineOptions())["moved_m"]["most"] < 1e-3
    assert is_sound(path) and (scan / "scan.db.damaged").is_file()


GOOD = "name,keyframe_seq,u_px,v_px,lat,lon,alt_amsl_m\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "line 1: columns"),
        ("name;lat;lon\n", "separated by commas"),
        ("name,lat,lon,alt_amsl_m,height\n", "height"),
        ("name,lat,lon\nA,47.39,8.54\n", "no point has a mark"),
        ("name,lat,lon,u_px\nA,47.39,8.54,3\n", "line 2: give u_px and v_px"),
        (GOOD, "no points"),
        (GOOD + "A,0,10,10,47.39,,408\n", "line 2: Object missing required field `lon`"),
        (GOOD + "A,0,10,10,47,39,8.54,408\n", "decimals take a point"),
        (GOOD + "A,0,10,ten,47.39,8.54,408\n", "line 2: v_px: Expected `float | null`"),
        (GOOD + "A,0,10,10,97.39,8.54,408\n", "line 2: lat: Expected `float` <= 90.0"),
        (GOOD + "A,0,10,10,47.39,8.54,nan\n", "alt_amsl_m: Expected `float` >= -1000.0"),
        (GOOD + "A,0,10,10,47.39,8.54,40800\n", "alt_amsl_m: Expected `float` <= 10000.0"),
        (GOOD + ",0,10,10,47.39,8.54,408\n", "missing required field `name`"),
        (GOOD + "A,,10,10,47.39,8.54,408\n", "one of keyframe_seq"),
        (GOOD + "A,1.5,10,10,47.39,8.54,408\n", "keyframe_seq: Expected `int | null`"),
        (GOOD + "A,0,1,1,47.39,8.54,408\nA,1,1,1,47.38,8.54,408\n", "differs from line 2"),
        (GOOD + "A,3,10,10,47.39,8.54,408\n", "no keyframe 3; the nearest is 0"),
        (GOOD + "A,0,999,10,47.39,8.54,408\n", "outside the camera's image of 160x90"),
        ("name,x,y,z,lat,lon,alt_amsl_m\nA,1,2,3,47.39,8.54,408\n", "no surface at x,y,z"),
        (
            "name,time,u_px,v_px,lat,lon,alt_amsl_m\nA,5,10,10,47.39,8.54,408\n",
            "no image within 20 ms",
        ),
        (
            "name,x,y,z,u_px,v_px,lat,lon,alt_amsl_m\nA,1,2,3,4,5,47.39,8.54,408\n",
            "with one of keyframe_seq",
        ),
        (
            GOOD.replace("u_px", "u_px,role") + "A,0,10,both,10,47.39,8.54,408\n",
            "role: Invalid enum value 'both'",
        ),
        (
            GOOD.replace("u_px", "u_px,sigma_h_m") + "A,0,1,-1,10,47.39,8.54,408\n",
            "sigma_h_m: Expected `float` > 0.0",
        ),
    ],
)
def test_a_bad_file_is_said_in_one_line(
    tmp_path_factory: pytest.TempPathFactory, small: Path, text: str, said: str
) -> None:
    path = tmp_path_factory.mktemp("csv") / "points.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as raised:
        refine(small, RefineOptions(path))
    assert said in str(raised.value) and str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fly(tmp_path_factory.mktemp("small"), keyframes=2).scan


def test_files_that_are_no_tables(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_survey(tmp_path / "none.csv")
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00name")
    with pytest.raises(InputError, match="UTF-8"):
        read_survey(tmp_path / "bytes.csv")


LIST = "WGS84 UTM 32N\n465000.5 5249000.25 410.5 12.5 30 a.jpg GCP1\n"


def test_a_list_of_odm_is_read_as_a_table_is(tmp_path: Path) -> None:
    """Named and unnamed points, of which images see some twice; heights of 0 are not surveyed."""
    path = tmp_path / "gcp_list.txt"
    path.write_text(
        LIST + "465000.5 5249000.25 410.5 80 7 b.jpg GCP1\n\n# left out\n"
        "465010.5 5249010.25 411.5 1 2 a.jpg\n465010.5 5249010.25 411.5 3 4 b.jpg\n"
    )
    first, second = read_survey(path)
    assert (first.name, second.name) == ("GCP1", "point 2")
    assert [s.image for s in second.sightings] == ["a.jpg", "b.jpg"]
    assert first.sightings[1].uv_px == (80.0, 7.0) and first.alt_amsl_m == 410.5
    place = LocalFrame(first.lat_deg, first.lon_deg, 0.0).to_utm(np.zeros((1, 3)))[0]
    np.testing.assert_allclose(place[:2], (465000.5, 5249000.25), atol=1e-3)
    path.write_text(LIST.replace("410.5", "0.0"))
    assert read_survey(path)[0].alt_amsl_m is None


def test_survey_files_in_feet_give_metres(tmp_path: Path) -> None:
    """A map in feet, as ODM's own tests have it (EPSG:2251), with heights in feet."""
    path, head, feet = tmp_path / "points.txt", "EPSG:2251+8228\n", "26607594.75 -26813.88 563.2"
    read = []
    for row in (f"{feet} 1 2 a.jpg", f"GCP1 {feet}"):
        path.write_text(head + row)
        read += read_survey(path)
    frame = "<a><camera id='0' label='a.jpg'/><marker id='0'><reference x='26607594.75'"
    path.write_text(
        f"{frame} y='-26813.88' z='563.2'/><location camera_id='0' x='1' y='2'/></marker>"
        f"<wkt>{head}</wkt></a>"
    )
    for point in (*read, *read_survey(path)):
        assert (point.lat_deg, point.lon_deg) == pytest.approx((44.7011463, -85.6124687), abs=1e-7)
        assert point.alt_amsl_m == pytest.approx(563.2 * 0.3048)
    path.write_text(f"EPSG:2251\nGCP1 {feet}")
    with pytest.raises(InputError, match=r"line 1: 'EPSG:2251' is in foot; say what its heights"):
        read_survey(path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (LIST.replace("WGS84", "Mars"), "line 1: 'Mars UTM 32N' is not a coordinate system"),
        (LIST.replace("WGS84 UTM 32N", "EPSG:4979"), "not ellipsoidal"),
        (LIST + "1 2 3 4\n", "line 3: 4 columns"),
        (LIST.replace("12.5", "west"), "line 2: could not convert"),
        (LIST.replace("465000.5", "1e300"), "line 2: 1e+300, 5.249e+06 is outside"),
        (LIST.replace("5249000.25", "524900025"), "is outside the coordinate system"),
        (LIST + "465000.5 5249000.25 410.5 1 2 a.jpg GCP1\n1e5 5e6 4 1 2 b.jpg GCP1\n", "differs"),
    ],
)
def test_a_bad_list_is_said_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "gcp_list.txt"
    path.write_text(text)
    with pytest.raises(InputError) as raised:
        read_survey(path)
    assert said in str(raised.value) and str(path) in str(raised.value)


PLACES = "EPSG:32632\nGCP1,465000.5,5249000.25,410.5,0.02,0.04\nunseen;465010;5249010;411\n"
PIXELS = "image,label,x,y\na.jpg,GCP1,12.5,30\nb.jpg,GCP1,80,7,0.5\n"


def test_places_and_marks_of_pix4d_are_two_files(tmp_path: Path) -> None:
    """The coordinate system stands above the places; a point without marks keeps its place."""
    places, marks = tmp_path / "points.csv", tmp_path / "marks.csv"
    places.write_text(PLACES)
    marks.write_text(PIXELS)
    first, second = read_survey(places, marks)
    assert [(s.image, s.uv_px) for s in first.sightings] == [
        ("a.jpg", (12.5, 30.0)),
        ("b.jpg", (80.0, 7.0)),
    ]
    assert (first.alt_amsl_m, first.sigma_h_m, first.sigma_v_m) == (410.5, 0.02, 0.04)
    assert (second.name, second.sightings) == ("unseen", ())
    place = LocalFrame(first.lat_deg, first.lon_deg, 0.0).to_utm(np.zeros((1, 3)))[0]
    np.testing.assert_allclose(place[:2], (465000.5, 5249000.25), atol=1e-3)


@pytest.mark.parametrize(
    ("places", "marks", "said"),
    [
        (PLACES.replace("EPSG:32632\n", ""), PIXELS, "points.csv line 1: 'GCP1"),
        (PLACES.replace("410.5", "high"), PIXELS, "points.csv line 2: name, x, y, z"),
        (PLACES.replace("0.02", "-1"), PIXELS, "points.csv line 2: name, x, y, z"),
        (PLACES + "GCP1,1,2,3\n", PIXELS, "points.csv line 4: GCP1 is also in line 2"),
        (PLACES, PIXELS.replace("GCP1", "K1"), "marks.csv line 2: "),
        (PLACES, PIXELS + "c.jpg,GCP1,left,7\n", "marks.csv line 4: image, point, u and v"),
        (PLACES, PIXELS + "c.jpg,GCP1\n", "marks.csv line 4: image, point, u and v"),
    ],
)
def test_bad_files_of_pix4d_are_said_in_one_line(
    tmp_path: Path, places: str, marks: str, said: str
) -> None:
    (tmp_path / "points.csv").write_text(places)
    (tmp_path / "marks.csv").write_text(marks)
    with pytest.raises(InputError) as raised:
        read_survey(tmp_path / "points.csv", tmp_path / "marks.csv")
    assert said in str(raised.value)


MARKERS = """<?xml version="1.0" encoding="UTF-8"?>
<document version="1.2.0">
  <chunk>
    <cameras>
      <camera id="0" label="DJI_0001"/>
      <camera id="7" label="b.JPG"><reference x="1" y="2" z="3"/></camera>
    </cameras>
    <markers>
      <marker id="0" label="GCP &amp; 1">
        <reference x="465000.5" y="5249000.25" z="410.5" sxy="0.02" sz="0.04" enabled="true"/>
      </marker>
      <marker id="1" label="K1"><reference x="465010" y="5249000" z="411" enabled="0"/></marker>
      <marker id="2" label="tie"/>
    </markers>
    <frames>
      <frame id="0">
        <markers>
          <marker marker_id="0">
            <location camera_id="0" pinned="true" x="13" y="30.5"/>
            <location camera_id="7" pinned="true" x="80.5" y="7.5"/>
            <location camera_id="7" pinned="0" valid="0"/>
          </marker>
          <marker marker_id="1"><location camera_id="7" pinned="true" x="3.5" y="4.5"/></marker>
          <marker marker_id="2"><location camera_id="7" pinned="true" x="3" y="4"/></marker>
        </markers>
      </frame>
    </frames>
    <reference>EPSG:32632</reference>
  </chunk>
</document>
"""


def test_markers_of_metashape_are_read_as_a_table_is(tmp_path: Path) -> None:
    """Its images begin at the corner of the first pixel; a marker without a place is none."""
    path = tmp_path / "markers.xml"
    path.write_text(MARKERS)
    first, second = read_survey(path)
    assert (first.name, second.name) == ("GCP & 1", "K1")
    assert (first.is_check, second.is_check) == (False, True)
    assert (first.alt_amsl_m, first.sigma_h_m, first.sigma_v_m) == (410.5, 0.02, 0.04)
    assert second.sigma_h_m == 0.03  # not stated
    assert [s.uv_px for s in first.sightings] == [(12.5, 30.0), (80.0, 7.0)]
    place = LocalFrame(first.lat_deg, first.lon_deg, 0.0).to_utm(np.zeros((1, 3)))[0]
    np.testing.assert_allclose(place[:2], (465000.5, 5249000.25), atol=1e-3)
    times = {"DJI_0001.JPG": 5.0, "b.JPG": 7.0}
    assert [s.time_unix_s for s in at_times([first], times, path)[0].sightings] == [5.0, 7.0]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("EPSG:32632", "", "names no coordinate system"),
        ("EPSG:32632", "LOCAL_CS[&quot;here&quot;]", "is not a coordinate system"),
        ("EPSG:32632", "EPSG:4979", "not ellipsoidal"),
        ("</frames>", "", "not XML: mismatched tag: line 29"),
        ("<document ", "<!DOCTYPE d [<!ENTITY a 'a'>]><document ", "a document type"),
        ('camera_id="0"', 'camera_id="3"', "line 19: no '3'"),
        ('x="13"', 'x="west"', "line 19: could not convert"),
        ('x="13"', 'x="1e30"', "line 19: u_px: Expected"),
        ('y="5249000.25"', 'y="5249000250"', "line 19: 465000, 5.249e+09 is outside"),
    ],
)
def test_bad_markers_are_said_in_one_line(tmp_path: Path, old: str, new: str, said: str) -> None:
    path = tmp_path / "markers.xml"
    path.write_text(MARKERS.replace(old, new))
    with pytest.raises(InputError) as raised:
        read_survey(path)
    assert said in str(raised.value) and str(path) in str(raised.value)


def test_markers_within_each_other_without_end_are_refused() -> None:
    with pytest.raises(ValueError, match="line 1: more than 32 elements"):
        list(read_metashape("<a>" * 40 + "</a>" * 40))


@given(st.lists(st.sampled_from([*re.findall(r"<[^>]*>|[^<>\\s]+", MARKERS), "<", "&", "\0"])))
def test_any_markers_are_read_or_refused(parts: list[str]) -> None:
    with contextlib.suppress(ValueError):
        for _ in read_metashape("<" + "".join(parts)):
            pass


def test_the_command_reports_and_takes_no_other_video(flight: Flight) -> None:
    gcp = write_csv(flight.folder / "points.csv", flight.survey(SPOTS))
    run = CliRunner().invoke
    answer = run(app, ["refine", str(flight.scan), "--gcp", str(gcp)])
    assert answer.exit_code == 0, answer.output
    assert "check points (2), rms" in answer.stdout
    answer = run(app, ["refine", str(flight.scan), "--gcp", str(gcp), "--json"])
    assert json.loads(answer.stdout.splitlines()[-1])["changed"] is False
    video = flight.folder / "other.mp4"
    video.write_bytes(b"no video")
    refused = run(app, ["refine", str(flight.scan), "--intrinsics", "--video", str(video)])
    assert isinstance(refused.exception, InputError)
    assert "other.mp4" in str(refused.exception)
    assert "nothing was changed" in str(refused.exception)
    assert run(app, ["refine", str(flight.scan), "--undo"]).exit_code == 0
    assert errors(flight).min() > 2.0
