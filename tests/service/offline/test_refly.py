"""Second flights over weak areas: do the lines cover them, and do other readers take the files?"""

from __future__ import annotations

import json
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from loopback import free_port
from pymavlink import mavutil, mavwp  # type: ignore[import-untyped]
from typer.testing import CliRunner

from recon.surface.coverage import PLACE, CoverageMap
from recon.surface.raster import Grid
from recon.types import F64, DepthMap
from service.cli import app
from service.errors import InputError
from service.georeference import LocalFrame
from service.offline.refine import refly
from service.offline.refine.refly import Refly, plan_json, waypoints_text
from service.scans.coverage import Coverage
from service.stream.records import PoseRecord

if TYPE_CHECKING:
    from house_flight import HouseFlight

FRAME = LocalFrame(47.39, 8.54, 408.0)
HEIGHT_M = 40.0


def looking_down(x: float, y: float, forward: float = 0.0) -> DepthMap:
    """Level ground 40 m below; the image is 64 m across and 32 m along a flight east.

    ``forward``: rad by which the camera looks ahead, to the east.
    """
    w, h = 60, 30
    K = np.array([[37.5, 0.0, (w - 1) / 2], [0.0, 37.5, (h - 1) / 2], [0.0, 0.0, 1.0]])
    # The image's width lies across the flight: camera x to the south, y to the west.
    R = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    c, s = np.cos(forward), np.sin(forward)
    R = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]]) @ R
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, [x, y, HEIGHT_M]
    u, v = np.meshgrid(np.arange(w), np.arange(h))
    ray = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones((h, w))], -1)
    depth = (-HEIGHT_M / (ray @ R.T)[..., 2]).astype(np.float32)
    sigma = np.full((h, w), 0.1, np.float32)
    return DepthMap(depth, sigma, np.full((h, w), 3, np.uint8), K, T)


def covered(depths: list[DepthMap], frame: LocalFrame | None = FRAME) -> Coverage:
    layer = CoverageMap(2.0)
    for seq, depth in enumerate(depths):
        layer.put(seq, seq * 10**9, depth)
    grid = layer.grid()
    assert grid is not None
    return Coverage(grid, frame, layer.places(), 3, 0.3)


def suggest(coverage: Coverage, agl_m: float | None = HEIGHT_M, **how: Any) -> Refly | None:
    pose = PoseRecord(0, np.eye(4), np.eye(6), agl_m=agl_m, speed_m_s=5.0)
    return refly.suggest(coverage, [pose], **how)


def two_lines(apart_m: float = 130.0, forward: float = 0.0) -> list[DepthMap]:
    there = [looking_down(8.0 * k, 0.0, forward) for k in range(25)]
    back = [looking_down(8.0 * k, apart_m, forward) for k in range(25)]
    return there + back


def ground_seen(flight: Refly, overlap_m: float = 0.0) -> list[tuple[F64, F64, float]]:
    """Start and direction of each line and the half width seen from it."""
    half = flight.swath.across_m / 2 - overlap_m
    return [(start, end, half) for start, end in flight.lines]


def is_seen(flight: Refly, spot: F64) -> bool:
    for a, b, half in ground_seen(flight):
        way = (b - a) / np.linalg.norm(b - a)
        a = a + flight.swath.ahead_m * way
        b = b + flight.swath.ahead_m * way
        s, t = (spot - a) @ way, abs((spot - a) @ np.array([-way[1], way[0]]))
        reach = flight.swath.along_m / 2
        if -reach <= s <= np.linalg.norm(b - a) + reach and t <= half:
            return True
    return False


def weak_spots(coverage: Coverage, flight: Refly) -> F64:
    patches = refly.weak_patches(coverage.weak, coverage.layer.grid, flight.swath)
    return np.vstack(patches)


@pytest.mark.parametrize("apart_m", [100.0, 130.0, 260.0])
def test_every_weak_cell_comes_into_the_image(apart_m: float) -> None:
    coverage = covered(two_lines(apart_m))
    flight = suggest(coverage)
    assert flight is not None
    spots = weak_spots(coverage, flight)
    assert 4.0 * len(spots) > 0.7 * 200 * (apart_m - 64)
    assert all(is_seen(flight, spot) for spot in spots[::7])


def test_the_swath_is_the_image_flown() -> None:
    flight = suggest(covered(two_lines()))
    assert flight is not None
    swath = flight.swath
    assert swath.across_m == pytest.approx(64.0, rel=0.02)
    assert swath.along_m == pytest.approx(32.0, rel=0.02)
    assert swath.heading_rad == pytest.approx(0.0, abs=0.02)
    assert swath.altitude_amsl_m == pytest.approx(448.0, abs=0.1)
    assert flight.spacing_m == pytest.approx(0.4 * 64.0, rel=0.02)
    gap_m = 130.0 - 64.0
    assert len(flight.lines) == int(np.ceil(gap_m / flight.spacing_m))
    assert np.linalg.norm(np.diff(flight.lines, axis=1), axis=2).min() > 150.0


def test_more_overlap_takes_more_lines() -> None:
    coverage = covered(two_lines(260.0))
    few, many = suggest(coverage, overlap=0.2), suggest(coverage, overlap=0.8)
    assert few is not None and many is not None
    assert len(many.lines) >= 3 * len(few.lines)


def test_a_camera_that_looks_ahead_flies_behind_its_line() -> None:
    tilt = np.radians(25.0)
    coverage = covered(two_lines(160.0, forward=tilt))
    flight = suggest(coverage)
    assert flight is not None
    assert flight.swath.ahead_m == pytest.approx(HEIGHT_M * np.tan(tilt), rel=0.05)
    spots = weak_spots(coverage, flight)
    assert all(is_seen(flight, spot) for spot in spots[::11])


def test_neighbours_are_flown_back_and_forth() -> None:
    flight = suggest(covered(two_lines(260.0)))
    assert flight is not None
    for a, b in zip(flight.lines, flight.lines[1:], strict=False):
        assert np.linalg.norm(b[0] - a[1]) < 1.5 * flight.spacing_m


def test_the_strips_of_ground_hold_every_weak_cell() -> None:
    coverage = covered(two_lines(forward=0.3))
    flight = suggest(coverage)
    assert flight is not None
    rings = [
        FRAME.to_enu(np.array([[lat, lon, FRAME.alt_amsl_m] for lon, lat in g["coordinates"][0]]))
        for f in json.loads(refly.geojson(flight, FRAME))["features"]
        if (g := f["geometry"])["type"] == "Polygon"
    ]
    assert len(rings) == len(flight.lines)
    for x, y in weak_spots(coverage, flight):
        inside = [
            cv2.pointPolygonTest(r[:, :2].astype(np.float32), (x, y), True) > -0.1 for r in rings
        ]
        assert any(inside)
    assert json.loads(refly.geojson(None, FRAME))["features"] == []


SWATH = refly.Swath(64.0, 32.0, 0.0, np.radians(30.0), 448.0, 5.0, HEIGHT_M)


@pytest.mark.parametrize("heading_deg", [0.0, 30.0, 75.0, 120.0])
def test_lines_in_any_direction_cover_the_cells(heading_deg: float) -> None:
    """A long field along the heading: two lines side by side, over all of it and not far beyond."""
    heading = np.radians(heading_deg)
    way = np.array([np.cos(heading), np.sin(heading)])
    side = np.array([-way[1], way[0]])
    s, t = (a.ravel() for a in np.meshgrid(np.arange(0.0, 300.0, 2.0), np.arange(0.0, 90.0, 2.0)))
    cells = s[:, None] * way + t[:, None] * side
    lines = refly.lines_over(cells, replace(SWATH, heading_rad=heading), 0.2)
    assert len(lines) == 2
    for line in lines:
        assert np.ptp(line @ side) < 1e-9 and np.ptp(line @ way) == pytest.approx(298.0 + 32.0)
    off = np.abs(cells @ side - (lines[:, 0] @ side)[:, None]).min(axis=0)
    assert off.max() == pytest.approx(22.0)


@pytest.mark.parametrize(("side_cells", "kept"), [(10, 0), (20, 1)])
def test_weak_ground_of_a_small_part_of_an_image_is_ignored(side_cells: int, kept: int) -> None:
    swath, grid = replace(SWATH, across_m=400.0, along_m=300.0), Grid(0.0, 200.0, 2.0, (100, 100))
    weak = np.zeros(grid.shape, np.bool_)
    weak[30 : 30 + side_cells, 30 : 30 + side_cells] = True  # of 120,000 m² times 0.5%
    patches = refly.weak_patches(weak, grid, swath)
    assert [len(patch) for patch in patches] == [side_cells**2] * kept


def test_nothing_weak_needs_no_flight() -> None:
    assert suggest(covered(two_lines(30.0))) is None


def test_what_cannot_be_planned_says_why() -> None:
    with pytest.raises(InputError, match="no georeference"):
        suggest(covered(two_lines(), frame=None))
    with pytest.raises(InputError, match="overlap"):
        suggest(covered(two_lines()), overlap=1.0)
    with pytest.raises(InputError, match="height above ground"):
        suggest(covered(two_lines()), None, relative=True)
    with pytest.raises(InputError, match="single keyframe"):
        refly.flown_swath(np.zeros(1, PLACE), FRAME, 1.0, 1.0)
    standing = np.zeros(3, PLACE)
    standing["corners_m"] = np.eye(4, 2)
    with pytest.raises(InputError, match="never moved"):
        refly.flown_swath(standing, FRAME, 1.0, 1.0)


def wanted(flight: Refly) -> list[tuple[int, int, float, float, float]]:
    return [(i.command, i.frame, i.lat_deg, i.lon_deg, i.alt_m) for i in flight.items]


@pytest.mark.parametrize("relative", [False, True])
def test_pymavlink_reads_the_waypoints(tmp_path: Path, relative: bool) -> None:
    flight = suggest(covered(two_lines()), relative=relative, photos=relative)
    assert flight is not None
    path = tmp_path / "refly.waypoints"
    path.write_text(waypoints_text(flight))
    loader = mavwp.MAVWPLoader()
    assert loader.load(str(path)) == len(flight.items) + 1
    home = loader.wp(0)
    assert (home.x, home.y) == pytest.approx(flight.home[:2], abs=1e-7)
    for n, (command, frame, lat, lon, alt) in enumerate(wanted(flight), 1):
        found = loader.wp(n)
        assert (found.command, found.frame) == (command, frame)
        assert (found.x, found.y, found.z) == pytest.approx((lat, lon, alt), abs=1e-7)
    commands = [i.command for i in flight.items]
    on, off = (2000, 2001) if relative else (2500, 2501)
    assert commands[0] == 22 and commands[-1] == 20
    assert commands.index(on) < commands.index(off)
    assert commands.count(16) == 2 * len(flight.lines)


class Autopilot:
    """Heartbeats of a vehicle, so that mavsdk finds a system to import a mission for."""

    def __init__(self, port: int) -> None:
        self._link = mavutil.mavlink_connection(f"udpout:127.0.0.1:{port}", source_system=1)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._beat, daemon=True)
        self._thread.start()

    def _beat(self) -> None:
        while not self._stop.wait(0.1):
            self._link.mav.heartbeat_send(2, 12, 0, 0, 4)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._link.close()


def imported(path: Path) -> Any:
    """The file as mavsdk's reader of QGroundControl plans understands it."""
    mavsdk = pytest.importorskip("mavsdk")
    mission_raw = pytest.importorskip("mavsdk.plugins.mission_raw")

    port = free_port()
    kind = mavsdk.ComponentType.GROUND_STATION
    ground = mavsdk.Mavsdk(mavsdk.Configuration.create_with_component_type(kind))
    ground.add_any_connection(f"udpin://127.0.0.1:{port}")
    vehicle = Autopilot(port)
    try:
        for _ in range(200):
            if ground.get_systems():
                break
            time.sleep(0.05)
        plugin = mission_raw.MissionRaw(ground.get_systems()[0])
        found = plugin.import_qgroundcontrol_mission(str(path))
        plugin.destroy()
        return found
    finally:
        vehicle.close()
        ground.destroy()


def test_mavsdk_reads_the_plan(tmp_path: Path) -> None:
    flight = suggest(covered(two_lines()))
    assert flight is not None
    path = tmp_path / "refly.plan"
    path.write_text(plan_json(flight))
    items = imported(path).mission_items
    assert len(items) == len(flight.items)
    for found, (command, frame, lat, lon, alt) in zip(items, wanted(flight), strict=True):
        assert (found.command, found.frame) == (command, frame)
        if frame != refly.MISSION:
            assert found.x == pytest.approx(lat * 1e7, abs=1) and found.y == pytest.approx(
                lon * 1e7, abs=1
            )
            assert found.z == pytest.approx(alt, abs=0.01)


def test_the_command_writes_both_kinds_and_refuses_in_one_line(
    tmp_path: Path, house: HouseFlight
) -> None:
    with house.flown(tmp_path / "scan"):
        pass
    run = CliRunner().invoke
    answer = run(app, ["refly", str(tmp_path / "scan"), "--sigma-m", "0.01", "--json"])
    assert answer.exit_code == 0, answer.output
    figures = json.loads(answer.stdout.splitlines()[-1])
    assert figures["lines"] >= 1
    plan = json.loads((tmp_path / "scan" / "refly.plan").read_text())
    assert plan["fileType"] == "Plan" and len(plan["mission"]["items"]) > 5
    out = tmp_path / "again.waypoints"
    assert run(app, ["refly", str(tmp_path / "scan"), "--sigma-m", "0.01", "--out", str(out)])
    none = run(app, ["refly", str(tmp_path / "scan"), "--sigma-m", "9", "--views", "1"])
    assert none.stdout == "no weak place is larger than 0.5% of an image; no flight is needed\n"
    assert out.read_text().startswith("QGC WPL 110\n")
    for arguments, match in (
        (["--out", str(tmp_path / "x.kml")], "name it .plan"),
        (["--views", "0"], "at least 1"),
    ):
        refused = run(app, ["refly", str(tmp_path / "scan"), *arguments])
        assert isinstance(refused.exception, InputError) and match in str(refused.exception)
    with house.flown(tmp_path / "local", georeferenced=False):
        pass
    refused = run(app, ["refly", str(tmp_path / "local"), "--sigma-m", "0.01"])
    assert isinstance(refused.exception, InputError) and "georeference" in str(refused.exception)
