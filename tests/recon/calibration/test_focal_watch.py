"""The focal length of a camera model against the images: views that turn show it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import skyrelief

from recon import se3
from recon.calibration.focal_watch import FocalWatch
from recon.tracking import bundle
from recon.types import F64, I64

K = np.array([[480.0, 0.0, 320.0], [0.0, 480.0, 180.0], [0.0, 0.0, 1.0]])
DOWN = np.diag([1.0, -1.0, -1.0])
VIEWS, NOISE_PX = 8, 0.2


def window(
    pitch_deg: float, wobble_deg: float, longer: float, seed: int, bent: float = 0.0
) -> tuple[bundle.BundleResult, I64, I64, F64]:
    """Eight views 4 m apart over ground 40 m below, adjusted with a focal length ``longer``.

    The lens moves corners of the image outwards by the share ``bent`` that the model lacks.
    """
    rng = np.random.default_rng(seed)
    turn = [se3.so3_exp(w) for w in np.radians(wobble_deg) * rng.normal(size=(VIEWS, 3))]
    tilt = se3.so3_exp(np.array([np.radians(90.0 + pitch_deg), 0.0, 0.0]))
    T = [
        se3.inverse(se3.compose(tilt @ DOWN @ w, np.array([4.0 * k, 0.0, 40.0])))
        for k, w in enumerate(turn)
    ]
    x, y = rng.uniform(-30, 60, 1500), rng.uniform(-30, 90, 1500)
    X = np.column_stack([x, y, rng.uniform(-2.0, 2.0, 1500)])
    cam, point, uv = [], [], []
    for c, pose in enumerate(T):
        P = se3.transform(pose, X)
        p = P[:, :2] / P[:, 2:] * 480.0 + K[:2, 2]
        seen = np.flatnonzero((P[:, 2] > 1) & (abs(p - K[:2, 2]) < [320, 180]).all(axis=1))
        cam.append(np.full(len(seen), c))
        point.append(seen)
        at_m = p[seen] - K[:2, 2]
        outwards = bent * np.sum(at_m**2, axis=1, keepdims=True) / np.sum(K[:2, 2] ** 2)
        uv.append(p[seen] + outwards * at_m + NOISE_PX * rng.normal(size=(len(seen), 2)))
    number = np.concatenate(point)
    often = np.bincount(number, minlength=len(X)) >= 2
    use, ids = often[number], np.flatnonzero(often)
    camera, at = np.concatenate(cam)[use], np.concatenate(uv)[use]
    index = np.searchsorted(ids, number[use])
    free = np.arange(VIEWS) >= 2
    model = K * [[longer], [longer], [1.0]]
    model[:2, 2] = K[:2, 2]
    poses = np.stack(T)
    done = bundle.adjust(poses, X[ids], camera, index, at, model, free, iterations=20)
    return done, camera, index, at


def estimate(
    pitch_deg: float, wobble_deg: float, longer: float, windows: int = 3, bent: float = 0.0
) -> tuple[float, float]:
    """The change of the focal length that the images ask for, and its sigma."""
    model: F64 = K * [[longer], [longer], [1.0]]
    model[:2, 2] = K[:2, 2]
    watch = FocalWatch(model)
    for seed in range(windows):
        watch.add(window(pitch_deg, wobble_deg, longer, seed, bent))
    found = watch.estimate
    assert found is not None and found[2] == windows
    return found[:2]


@pytest.mark.parametrize("pitch_deg", [-60.0, -45.0])
def test_oblique_views_fit_the_right_focal_length(pitch_deg: float) -> None:
    change, sigma = estimate(pitch_deg, 3.0, 1.0)
    assert abs(change) < 3.0 * sigma < 0.01


@pytest.mark.parametrize("longer", [0.97, 1.02])
def test_oblique_views_show_a_wrong_focal_length(longer: float) -> None:
    change, sigma = estimate(-60.0, 3.0, longer)
    assert np.sign(change) == np.sign(1.0 - longer)
    assert abs(change) == pytest.approx(abs(1.0 - longer), rel=0.1)
    assert abs(change) > 3.0 * sigma


@pytest.mark.parametrize("pitch_deg", [-60.0, -80.0])
@pytest.mark.parametrize("bent", [-0.01, 0.01])
def test_radial_distortion_is_no_focal_length(pitch_deg: float, bent: float) -> None:
    """Corners that are 1 % off looked like a focal length that is 2 % off."""
    change, sigma = estimate(pitch_deg, 3.0, 1.0, bent=bent)
    assert abs(change) < 3.0 * sigma < 0.015


def test_views_that_never_turn_show_nothing() -> None:
    change, sigma = estimate(-60.0, 0.0, 1.03)
    assert abs(change) < 4.0 * sigma and sigma > 0.05


def test_one_window_has_a_sigma_of_its_own() -> None:
    change, sigma = estimate(-60.0, 3.0, 1.0, windows=1)
    assert abs(change) < 3.5 * sigma < 0.02


@pytest.mark.parametrize("broken", ["empty", "pixel", "point", "pose"])
def test_a_window_without_finite_sightings_shows_nothing(broken: str) -> None:
    """The adjustment survives such a window, and so does the flight."""
    done, camera, point, uv_px = window(-60.0, 3.0, 1.0, 0)
    if broken == "empty":
        done, camera = replace(done, points_m=done.points_m[:0]), camera[:0]
        point, uv_px = point[:0], uv_px[:0]
    elif broken == "pixel":
        uv_px[5] = np.nan
    elif broken == "point":
        done.points_m[3] = np.inf
    else:
        done.T_camera_world[4] = np.nan
    watch = FocalWatch(K)
    watch.add((done, camera, point, uv_px))
    assert watch.estimate is None


def test_without_a_window_there_is_no_estimate() -> None:
    assert FocalWatch(K).estimate is None


@pytest.mark.slow
def test_a_camera_model_that_is_too_long_is_reported(tmp_path: Path) -> None:
    made = skyrelief(
        "simulate", "--out", tmp_path / "flight", "--size", "320x180", "--fps", "6",
        "--duration-s", "8", "--height-m", "40", "--wobble-deg", "3",
    )  # fmt: skip
    assert made.returncode == 0, made.stderr
    model = (tmp_path / "flight" / "camera.yaml").read_text()
    assert model.count("240.0") == 4
    (tmp_path / "long.yaml").write_text(model.replace("240.0", "252.0"))
    done = skyrelief(
        "replay", tmp_path / "flight" / "flight.mp4", "--telemetry",
        tmp_path / "flight" / "flight.tlog", "--camera-model", tmp_path / "long.yaml",
        "--out", tmp_path / "scan", "--json", "--set", "compute.stereo_width=160",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    shorter = -found["focal_by_images"]["change"]
    assert 0.02 < shorter < 0.06 and found["sigma_focal"] == pytest.approx(shorter)
    assert any("shorter than the camera model's" in note for note in found["warnings"])
    assert any("focal length is uncertain" in why for why in found["quality"]["trust"]["reasons"])
    assert found["quality"]["scale_sigma"] > shorter
