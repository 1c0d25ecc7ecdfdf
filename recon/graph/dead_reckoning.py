"""Where a camera should be after a stretch without vision."""

from __future__ import annotations

from recon.types import F64, PosePrior


def carried(
    before: PosePrior, now: PosePrior, T_before: F64, velocity_m_s: F64 | None, seconds: float
) -> F64:
    """(4, 4) pose by telemetry's motion since ``before``, when the camera was at ``T_before``.

    What telemetry was off by then it is taken to be off by now, so that nothing jumps. Without
    positions the camera goes on at ``velocity_m_s`` (3,) over the ``seconds`` between, if known.
    """
    T: F64 = T_before.copy()
    a, b = before.R_world_camera, now.R_world_camera
    if b is not None and now.sigma_yaw_rad < 1.0:
        known = a is not None and before.sigma_yaw_rad < 1.0
        T[:3, :3] = b @ a.T @ T_before[:3, :3] if a is not None and known else b
    if before.position_m is not None and now.position_m is not None:
        T[:3, 3] += now.position_m - before.position_m
    elif velocity_m_s is not None:
        T[:3, 3] += velocity_m_s * seconds
    return T
