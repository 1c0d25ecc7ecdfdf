"""Frames' poses after their keyframes have moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from recon import se3
from recon.graph.ground_control import Adjusted
from recon.types import F64
from service.georeference import LocalFrame
from service.onboard.rig import attitude_of
from service.refine.revisions import KeyframeState
from service.stream.records import PoseRecord


def grown(T: F64, scale: float) -> F64:
    """The motion ``T`` (4, 4) with its length times ``scale``."""
    return se3.compose(T[:3, :3], scale * T[:3, 3])


def moved_frames(
    frames: Sequence[PoseRecord],
    states: Sequence[KeyframeState],
    found: Adjusted,
    place: LocalFrame | None,
) -> list[PoseRecord]:
    """Every frame's pose, carried by the keyframes before and after it."""
    keys = np.array([s.time_ns for s in states])
    out: list[PoseRecord] = []
    before: PoseRecord | None = None
    distance = 0.0
    for frame in frames:
        b = int(np.clip(np.searchsorted(keys, frame.time_unix_ns), 1, len(keys) - 1))
        one, two = (_carried(frame, states[k], found, k) for k in (b - 1, b))
        share = (frame.time_unix_ns - keys[b - 1]) / max(int(keys[b] - keys[b - 1]), 1)
        share = float(np.clip(share, 0.0, 1.0))
        T = one @ se3.exp(share * se3.log(se3.inverse(one) @ two))
        near = b - 1 if share < 0.5 else b
        step = 0.0
        if before is not None:
            step = float(np.linalg.norm(T[:3, 3] - before.T_world_camera[:3, 3]))
        distance += step
        moved = _record(frame, T, found.covariances[near], place, distance)
        if before is not None and frame.time_unix_ns > before.time_unix_ns:
            seconds = (frame.time_unix_ns - before.time_unix_ns) * 1e-9
            moved = replace(moved, speed_m_s=step / seconds)
        out.append(moved)
        before = moved
    return out


def _carried(frame: PoseRecord, state: KeyframeState, found: Adjusted, k: int) -> F64:
    """A frame's pose as one keyframe carries it along."""
    relative = se3.inverse(state.T_world_camera) @ frame.T_world_camera
    return np.asarray(found.poses[k] @ grown(relative, float(found.scales[k])))


def _record(
    frame: PoseRecord, T: F64, spread: F64, place: LocalFrame | None, distance_m: float
) -> PoseRecord:
    roll, pitch, yaw = attitude_of(T)
    lat = lon = alt = None
    if place is not None:
        lat, lon, alt = (float(v) for v in place.to_geodetic(T[None, :3, 3])[0])
    lever = np.hstack([-se3.hat(T[:3, 3]), np.eye(3)])
    sigma = float(np.sqrt(np.trace(lever @ spread @ lever.T)))
    return replace(
        frame, T_world_camera=T, covariance=spread, lat_deg=lat, lon_deg=lon, alt_amsl_m=alt,
        roll_rad=roll, pitch_rad=pitch, yaw_rad=yaw, distance_m=distance_m, sigma_m=sigma,
    )  # fmt: skip
