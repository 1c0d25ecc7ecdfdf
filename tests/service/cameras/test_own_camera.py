"""The camera found from rendered images of a flight, and what the command refuses."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Literal, cast

import cv2
import numpy as np
import pytest
import scipy.ndimage as ndi
import yaml
from typer.testing import CliRunner

from recon import se3
from recon.backends import Backend
from recon.camera_model import rays
from recon.types import F64, U8, Camera, Shutter
from service.cameras.camera_file import load_camera, save_camera
from service.cameras.images import open_images
from service.cameras.source import CameraSource
from service.cli import app
from service.config import Config, load_config
from service.errors import InputError
from service.flight.scan import ScanInputs, create_store
from service.flight.telemetry_check import TelemetryCheck
from service.offline.refine.own_camera import (
    FILE,
    found_camera,
    images_at,
    sightings,
    write,
)
from service.scans.track import camera_of
from service.stream.store import ScanStore

SIZE = (480, 270)
TRUE = Camera(
    np.array([[360.0, 0.0, 241.0], [0.0, 360.0, 133.0], [0.0, 0.0, 1.0]]), np.zeros(5), SIZE
)
TEXEL_M = 0.16


@cache
def texture() -> F64:
    rng = np.random.default_rng(3)
    layers = [ndi.gaussian_filter(rng.normal(size=(1100, 1100)), 1.3 * 2.0**k) for k in range(5)]
    total = np.asarray(sum(2.0**k * layer / layer.std() for k, layer in enumerate(layers)))
    return np.asarray(128 + 45 * (total - total.mean()) / total.std())


def _height(x: F64, y: F64) -> F64:
    return np.asarray(2.0 * np.sin(x / 9.0) * np.cos(y / 11.0))


def _image(T: F64, seed: int) -> U8:
    """The ground through the true camera, with noise."""
    w, h = SIZE
    v, u = np.mgrid[0:h, 0:w].astype(np.float64)
    ways = rays(TRUE.K, np.column_stack([u.ravel(), v.ravel()])) @ T[:3, :3].T
    z = np.full(len(ways), T[2, 3])
    for _ in range(8):
        p = T[:3, 3] + ways * z[:, None]
        z += (p[:, 2] - _height(p[:, 0], p[:, 1])) / -ways[:, 2]
    p = (T[:3, 3] + ways * z[:, None])[:, :2] / TEXEL_M + 550
    gray = ndi.map_coordinates(texture(), p.T, order=1, mode="reflect").reshape(h, w)
    noise = np.random.default_rng(seed).normal(size=gray.shape)
    return np.asarray(np.clip(gray + noise, 0, 255), np.uint8)


def _pose(x: float, y: float, yaw: float, ahead_deg: float) -> F64:
    R = se3.so3_exp(np.array([0.0, 0.0, -yaw])).T @ np.diag([1.0, -1.0, -1.0])
    R = R @ se3.so3_exp(np.array([np.radians(ahead_deg), 0.0, 0.0]))
    return se3.compose(R, np.array([x, y, 60.0]))


def _flight(ahead_deg: float) -> F64:
    """A half circle, looking ahead of straight down, or straight lines when that is 0."""
    if ahead_deg == 0.0:
        return np.array([_pose(0.0, 5.0 * k - 15.0, 0.0, 0.0) for k in range(7)])
    angles = np.linspace(0.0, np.pi, 13)
    return np.array(
        [_pose(25 * (1 - np.cos(a)) - 25, 25 * np.sin(a), -a, ahead_deg) for a in angles]
    )


WRONG = Camera(TRUE.K * [[1.02, 1, 1], [1, 1.02, 1], [1, 1, 1]], np.zeros(5), SIZE)


def _off(poses: F64) -> F64:
    rng = np.random.default_rng(8)
    return np.array([se3.exp(rng.normal(size=6) * ([3e-3] * 3 + [0.15] * 3)) @ T for T in poses])


@pytest.mark.slow
def test_the_images_of_an_oblique_turn_tell_the_focal_length(tmp_path: Path) -> None:
    poses = _flight(38.0)
    images = {k: _image(T, k) for k, T in enumerate(poses)}
    fixes, sigma = poses[:, :3, 3], np.full((len(poses), 3), 0.5)
    found = found_camera(images, WRONG, _off(poses), 0.0, fixes, sigma)
    assert abs(found.camera.K[0, 0] / 360.0 - 1.0) < 0.003
    assert found.rms_after_px < 0.3 * found.rms_before_px
    figures = write(found, WRONG, tmp_path)
    kept = yaml.safe_load((tmp_path / FILE).read_text(encoding="utf-8"))
    assert kept["camera_matrix"]["data"][0] == pytest.approx(found.camera.K[0, 0])
    assert figures["focal_px"] == [367.2, pytest.approx(360.0, abs=1.1)]


@pytest.mark.slow
def test_a_leg_flown_back_ties_its_images_to_those_of_the_first() -> None:
    """Only views turned to each other show a lens off its axis."""
    out = [_pose(0.0, 9.0 * k, 0.0, 0.0) for k in range(5)]
    back = [_pose(10.0, 36.0 - 9.0 * k, np.pi, 0.0) for k in range(5)]
    poses = np.array([*out, *back])
    images = {k: _image(T, k) for k, T in enumerate(poses)}
    tied = sightings(images, TRUE, poses, 0.0)
    landmarks, seen, own = tied.points, tied.seen, tied.poses
    of = [set(seen.landmark[seen.view == k]) for k in range(10)]
    assert len(of[0] & of[9]) > 20 and len(of[1] & of[7]) > 20
    shared = np.isin(seen.landmark, list(of[0] & of[9])) & (seen.view == 9)
    ahead = se3.transform(se3.inverse(own[9]), landmarks[seen.landmark[shared]])
    there = ahead[:, :2] / ahead[:, 2:] @ TRUE.K[:2, :2].T + TRUE.K[:2, 2]
    off = np.linalg.norm(there - seen.uv_px[shared], axis=1)
    assert np.median(off) < 8.0  # what a camera that straight-down views leave open makes of it
    assert np.linalg.norm(own[:, :2, 3] - poses[:, :2, 3], axis=1).max() < 5.0


def test_a_folder_of_stills_is_a_recording_too(tmp_path: Path) -> None:
    for k in range(4):
        assert cv2.imwrite(str(tmp_path / f"{k}.png"), np.full((60, 80, 3), 40 * k, np.uint8))
    times = [int(2e18) + k * 10**9 for k in range(4)]
    found = images_at(tmp_path, times[0], times)
    assert [int(found[k].mean()) for k in range(4)] == [0, 40, 80, 120]


def test_images_are_found_by_the_times_of_their_exposures(tmp_path: Path) -> None:
    """A keyframe's time is its stamp less the camera's latency."""
    stills = tmp_path / "stills"
    stills.mkdir()
    for k in range(4):
        assert cv2.imwrite(str(stills / f"{k}.png"), np.full((60, 80, 3), 40 * k, np.uint8))
    config, source = load_config(None, ["camera.latency_ms=400"]), open_images(str(stills), {})
    inputs = ScanInputs(
        source, TRUE, config, cast(Backend, None), tmp_path / "scan", "late", int(2e18)
    )
    check = TelemetryCheck(config.camera, None, print)
    times = [check.exposed_ns(inputs.epoch_ns + frame.time_ns) for frame in source]
    with create_store(inputs) as store:
        found = images_at(stills, store.header.started_unix_ns, times)
    assert [int(found[k].mean()) for k in range(4)] == [0, 40, 80, 120]


@pytest.mark.slow
def test_a_straight_line_looking_down_is_refused_in_one_line() -> None:
    poses = _flight(0.0)
    images = {k: _image(T, k) for k, T in enumerate(poses)}
    fixes, sigma = poses[:, :3, 3], np.full((len(poses), 3), 1.0)
    with pytest.raises(InputError, match="does not determine the focal length") as refused:
        found_camera(images, WRONG, _off(poses), 0.0, fixes, sigma)
    assert "\n" not in str(refused.value)


def test_images_of_something_else_are_refused() -> None:
    poses = _flight(0.0)
    blank = {k: np.full((SIZE[1], SIZE[0]), 100, np.uint8) for k in range(len(poses))}
    with pytest.raises(InputError, match="is this the video"):
        sightings(blank, WRONG, poses, 0.0)


@pytest.mark.parametrize(
    "arguments",
    [["--intrinsics"], ["--undo", "--video", "x"], ["--intrinsics", "--video", "x", "--undo"]],
)
def test_the_command_says_what_goes_together(tmp_path: Path, arguments: list[str]) -> None:
    refused = CliRunner().invoke(app, ["refine", str(tmp_path), *arguments])
    assert isinstance(refused.exception, InputError)
    assert any(word in str(refused.exception) for word in ("takes", "needs"))


@pytest.mark.parametrize("asked", ["model", 12.5])
def test_a_refined_camera_keeps_the_readout(
    tmp_path: Path, asked: float | Literal["model"]
) -> None:
    """Of the scan's own camera, through database and camera file."""
    config = Config()
    config = replace(config, camera=replace(config.camera, readout_ms=asked))
    camera = replace(TRUE, shutter=Shutter(0.03, "up"))
    inputs = ScanInputs(
        cast(CameraSource, None), camera, config, cast(Backend, None), tmp_path, "scan-1", 0
    )
    create_store(inputs).close()
    with ScanStore.open(tmp_path / "scan.db") as store:
        found = camera_of(store.header)
    assert found.shutter == (Shutter(0.03, "up") if asked == "model" else Shutter(0.0125, "down"))
    save_camera(tmp_path / FILE, found)
    assert load_camera(tmp_path / FILE).shutter == found.shutter


def test_a_global_shutter_stays_one(tmp_path: Path) -> None:
    inputs = ScanInputs(
        cast(CameraSource, None), TRUE, Config(), cast(Backend, None), tmp_path, "scan-1", 0
    )
    with create_store(inputs) as store:
        assert "readout_ms" not in store.header.camera
        assert camera_of(store.header).shutter == Shutter()
