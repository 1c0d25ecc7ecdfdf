"""Stills adjusted together with their rows and a log, against images drawn row by row."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from threading import Event

import cv2
import numpy as np
import pytest
from painted_ground import CAMERA, DOWN, HEIGHT_M, M_PER_PX, SIZE, K, painted_ground
from tracked_frame import undistorted

from mavlink.telemetry.history import HistoryConfig, VehicleHistory
from mavlink.telemetry.samples import AccuracySample, AttitudeSample, PositionSample
from recon import se3
from recon.calibration.flight import camera_information, network
from recon.calibration.global_bundle import Knowledge, Sightings
from recon.calibration.joint_adjustment import LENS, Turning, adjust_jointly
from recon.camera_model import project, rays
from recon.frames import R_ENU_NED, R_GIMBAL_CAMERA
from recon.rolling_shutter import row_times_s
from recon.types import F64, U8, Camera, PosePrior, Shutter
from service.cameras.images import open_images
from service.commands.adjusted_stills import adjusted_stills, is_torn
from service.compute.backend_choice import open_backend
from service.config import change, load_config
from service.flight.scan import Scan, ScanInputs, create_store
from service.georeference import LocalFrame
from service.stream.store import ScanStore

STEP_S, STILLS, START_S = 0.9, 14, 2.0
READOUT_S = 0.03
EPOCH = datetime(2026, 5, 1, 10, 0, 0, tzinfo=timezone.utc)


def true_pose(t: float) -> F64:
    """(4, 4) T_world_camera of a fixed camera on an aircraft that rolls by up to 25 degrees/s."""
    roll, pitch = 0.1 * np.sin(4.3 * t), 0.04 * np.sin(2.9 * t + 1.0)
    R = (
        DOWN
        @ se3.so3_exp(np.array([0.0, 0.0, -np.pi / 2]))
        @ se3.so3_exp(np.array([pitch, roll, 0.0]))
    )
    return se3.compose(R, np.array([6.0 * t - 45.0, 1.5 * np.sin(0.5 * t), HEIGHT_M]))


def rate_at(t: float) -> F64:
    """(6,) of T_camera_world per s."""
    after, before = (se3.inverse(true_pose(t + d)) for d in (1e-4, -1e-4))
    return se3.log(after @ se3.inverse(before)) / 2e-4


def times() -> F64:
    return np.asarray(START_S + STEP_S * np.arange(STILLS), np.float64)


def sighted(camera: Camera, rng: np.random.Generator, noise_px: float) -> Sightings:
    """Places of rough ground where the rows of each still see them."""
    places = np.column_stack([rng.uniform(-70, 70, (900, 2)), rng.uniform(0.0, 4.0, 900)])
    view, landmark, uv = [], [], []
    for k, t in enumerate(times()):
        at = project(K, se3.transform(se3.inverse(true_pose(t)), places))
        for p in np.flatnonzero(((at > -40) & (at < np.array(SIZE) + 40)).all(axis=1)):
            row = at[p]
            for _ in range(8):
                share = (row[1] + 0.5) / SIZE[1] - 0.5
                T = true_pose(t + camera.shutter.readout_s * share)
                row = project(K, se3.transform(se3.inverse(T), places[p : p + 1]))[0]
            if (row >= 0).all() and (row < SIZE).all():
                view.append(k)
                landmark.append(int(p))
                uv.append(row)
    noise = rng.normal(0.0, noise_px, (len(uv), 2))
    return Sightings(np.array(view), np.array(landmark), np.array(uv) + noise)


def by_log(rng: np.random.Generator, places: int) -> tuple[F64, Knowledge, Turning]:
    """A log of the stills: poses, the same as knowledge, and rates it smooths."""
    poses, known = [], Knowledge.none(STILLS, places)
    for k, t in enumerate(times()):
        T = true_pose(t)
        T[:3, :3] = se3.so3_exp(rng.normal(0.0, 0.01, 3)) @ T[:3, :3]
        T[:3, 3] += rng.normal(0.0, 0.3, 3)
        known.fixes[k], known.sigma_fixes[k] = T[:3, 3], 0.3
        known.attitudes[k], known.sigma_attitudes[k] = T[:3, :3], 0.01
        poses.append(T)
    rates = np.array([rate_at(t) for t in times()])
    rates[:, :3] += rng.normal(0.0, 0.05, (STILLS, 3))
    return np.array(poses), known, Turning(rates, 0.05)


def off_m(poses: F64) -> float:
    """RMS distance of the places."""
    true = np.array([true_pose(t)[:3, 3] for t in times()])
    return float(np.sqrt(np.sum((poses[:, :3, 3] - true) ** 2, axis=1).mean()))


@pytest.mark.parametrize("readout_s", [READOUT_S, -0.02])
@pytest.mark.slow
def test_the_readout_is_found_by_the_turns_of_the_rows(readout_s: float) -> None:
    rng = np.random.default_rng(4)
    seen = sighted(replace(CAMERA, shutter=Shutter(readout_s)), rng, 0.3)
    poses, known, turning = by_log(rng, 900)
    found = adjust_jointly(CAMERA, poses, seen, known, turning, seeks_readout=True)
    assert found.sigma_readout_s < 4e-3
    assert abs(found.readout_s - readout_s) < 3.0 * found.sigma_readout_s
    assert found.camera.shutter == Shutter(abs(found.readout_s), "down" if readout_s > 0 else "up")
    still = network(CAMERA, poses, seen, known, camera_information(CAMERA, LENS))
    assert off_m(found.poses) < 0.7 * off_m(still.solution.poses)
    off = found.rates[:, :3] - [rate_at(t)[:3] for t in times()]
    assert np.sqrt(np.mean(off[:, :2] ** 2)) < np.radians(3.0)
    sigmas = np.sqrt(np.diagonal(found.turn_covariances, axis1=1, axis2=2))
    assert 0.3 < np.sqrt(np.mean((off / sigmas) ** 2)) < 2.0


@pytest.mark.parametrize("share", [0.0, 1e-17])
@pytest.mark.slow
def test_a_log_of_a_steady_camera_shows_no_readout(share: float) -> None:
    rng = np.random.default_rng(4)
    seen = sighted(replace(CAMERA, shutter=Shutter(READOUT_S)), rng, 0.3)
    poses, known, turning = by_log(rng, 900)
    steady = replace(turning, rates=turning.rates * np.repeat([share, 1.0], 3))
    with pytest.raises(ValueError, match="do not show a rolling shutter"):
        adjust_jointly(CAMERA, poses, seen, known, steady, seeks_readout=True)


def test_a_track_that_a_wild_fix_tore_is_seen() -> None:
    poses = np.array([true_pose(t) for t in times()])
    none = PosePrior(np.eye(3), 0.01, 0.05, np.zeros(3), np.full(3, 1.5), HEIGHT_M, 2.0)
    priors = [replace(none, velocity_m_s=np.array([6.0, 0.0, 0.0]))] * STILLS
    assert not is_torn(poses, times(), priors)
    hovering = [replace(none, velocity_m_s=np.zeros(3))] * STILLS
    assert not is_torn(poses[:1] + np.zeros((STILLS, 1, 1)), times(), hovering)
    poses[6, :3, 3] += np.array([70.0, -30.0, 10.0])
    assert is_torn(poses, times(), priors)


@pytest.mark.slow
def test_a_global_shutter_is_none() -> None:
    rng = np.random.default_rng(4)
    seen = sighted(CAMERA, rng, 0.3)
    poses, known, turning = by_log(rng, 900)
    with pytest.raises(ValueError, match="do not show a rolling shutter"):
        adjust_jointly(CAMERA, poses, seen, known, turning, seeks_readout=True)


def drawn(t: float, readout_s: float) -> U8:
    """(H, W) still whose rows are exposed one after the other."""
    W, H = SIZE
    out = np.zeros((H, W, 2), np.float32)
    shutter = replace(CAMERA, shutter=Shutter(readout_s))
    for v, row_s in enumerate(row_times_s(shutter)):
        T = true_pose(t + row_s)
        way = rays(K, np.column_stack([np.arange(W), np.full(W, v)]).astype(float)) @ T[:3, :3].T
        at = T[:3, 3] + way * (-T[2, 3] / way[:, 2:])
        out[v] = (at[:, :2] + 120.0) / M_PER_PX
    image = cv2.remap(painted_ground(), out[..., 0], out[..., 1], cv2.INTER_LINEAR)
    return np.asarray(image, np.uint8)


def logged(hz: float) -> VehicleHistory:
    """The flight's log, its top of the image to the nose."""
    history, frame = VehicleHistory(HistoryConfig()), LocalFrame(-35.0, 149.0, 0.0)
    for t in np.arange(0.0, START_S + STEP_S * STILLS + 3.0, 1.0 / hz).tolist():
        T, ns = true_pose(t), EPOCH_NS + round(1e9 * t)
        R = R_ENU_NED.T @ T[:3, :3] @ R_GIMBAL_CAMERA.T @ NADIR.T
        w, x, y, z = (float(q) for q in se3.quaternion_from_rotation(R))
        history.add(AttitudeSample(None, (w, x, y, z)), ns)
        lat, lon, alt = (float(x) for x in frame.to_geodetic(T[None, :3, 3])[0])
        velocity = R_ENU_NED.T @ (true_pose(t + 1e-3)[:3, 3] - T[:3, 3]) * 1e3
        north, east, down = (float(v) for v in velocity)
        position = PositionSample(None, lat, lon, alt, HEIGHT_M, (north, east, down))
        history.add(position, ns)
        history.add(AccuracySample(None, True, 0.3, 0.4), ns)
    return history


EPOCH_NS = round(EPOCH.timestamp()) * 10**9
NADIR = se3.so3_exp(np.array([0.0, -np.pi / 2, 0.0]))
"""Body to head of a camera that looks down."""


def flown(folder: Path, readout_s: float, hz: float, late_s: float = 0.0) -> ScanInputs:
    """Inputs of a scan of drawn stills whose stamps are ``late_s`` after the exposures."""
    (folder / "stills").mkdir(parents=True)
    for t in times():
        stamp = EPOCH.timestamp() + t + late_s
        name = datetime.fromtimestamp(stamp, timezone.utc).strftime("%Y%m%d%H%M%S%f")[:16]
        cv2.imwrite(str(folder / "stills" / f"{name}Z.png"), drawn(t, readout_s))
    source = open_images(str(folder / "stills"), {})
    assert source.epoch_unix_ns is not None
    config = load_config(None, ["compute.stereo_width=240", "compute.upsample=false"])
    return ScanInputs(
        source, CAMERA, config, open_backend(config.compute, SIZE), folder / "scan", "drawn",
        source.epoch_unix_ns, history=logged(hz),
    )  # fmt: skip


def surface(inputs: ScanInputs) -> tuple[F64, int]:
    """(N,) heights of a scan's points, and how many keyframes have them."""
    with closing(create_store(inputs)) as store:
        scan = Scan(inputs, store)
        scan.run(Event())
        scan.close()
    out = []
    with ScanStore.open(inputs.folder / "scan.db") as store:
        for keyframe in store.keyframes():
            depth = keyframe.depth
            v, u = np.nonzero(np.isfinite(depth.depth_m))
            ray = rays(depth.K, np.column_stack([u, v]).astype(float))
            at = se3.transform(depth.T_world_camera, ray * depth.depth_m[v, u][:, None])
            out.append(at[:, 2])
    return np.concatenate(out), len(out)


@pytest.mark.slow
def test_drawn_stills_that_come_late_with_a_slow_log(tmp_path: Path) -> None:
    """Stamps are 0.2 s late, the log has 4 attitudes a second, and no readout is stated."""
    inputs = flown(tmp_path, READOUT_S, hz=4.0, late_s=0.2)
    found = adjusted_stills(inputs, is_latency_given=False)
    assert abs((inputs.epoch_ns - found.epoch_ns) * 1e-9 - 0.2) < 0.05
    assert abs(found.camera.shutter.readout_s - READOUT_S) < 0.012
    assert found.known is not None
    heights, keyframes = surface(found)
    assert keyframes == STILLS
    assert np.median(np.abs(heights - np.median(heights))) < 0.002 * HEIGHT_M
    gray, rolls = np.zeros(SIZE[::-1], np.uint8), []
    for seq, t in enumerate(times()):
        (frame,) = found.known.track(undistorted(gray, seq, 0, PosePrior()))
        assert frame.row_motion.rows is not None
        rolls.append(frame.row_motion.rows.rate[0] - rate_at(t)[0])
    assert abs(np.degrees(np.mean(rolls))) < 2.0  # hardly shows over flat ground


@pytest.mark.slow
def test_a_global_shutter_keeps_its_odometry(tmp_path: Path) -> None:
    inputs = flown(tmp_path, 0.0, hz=10.0)
    config = change(inputs.config, "camera.readout_ms", "0")
    found = adjusted_stills(replace(inputs, config=config), is_latency_given=False)
    assert found.known is None and found.camera is inputs.camera
