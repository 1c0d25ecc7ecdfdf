"""Where a camera should be after a stretch without vision."""

from __future__ import annotations

from recon.graph_records import Node
from recon.types import F64


def dead_reckoned(last: Node, node: Node, T_last: F64, step_m_s: F64 | None) -> F64:
    """(4, 4) pose of ``node`` by telemetry's motion since ``last``, else by the last velocity.

    ``T_last`` is where the graph has the last keyframe, ``step_m_s`` (3,) its velocity there.
    """
    T: F64 = T_last.copy()
    a, b = last.prior, node.prior
    if b.R_world_camera is not None and b.sigma_yaw_rad < 1.0:
        T[:3, :3] = b.R_world_camera
    if a.position_m is not None and b.position_m is not None:
        T[:3, 3] = T_last[:3, 3] + b.position_m - a.position_m
    elif step_m_s is not None:
        T[:3, 3] += step_m_s * (node.time_ns - last.time_ns) * 1e-9
    return T
