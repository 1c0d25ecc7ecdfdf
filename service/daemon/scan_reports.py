"""What a running scan reports over MAVLink: its motion to the autopilot, its keyframes to all."""

from __future__ import annotations

from typing import TYPE_CHECKING

from service.config import Config

if TYPE_CHECKING:
    from collections.abc import Callable

    from mavlink.state import VehicleState
    from mavlink.vehicle import VehicleLink
    from recon.types import Keyframe
    from service.onboard.pipeline import Step
    from service.onboard.scan import Scan


def odometry_reporter(
    config: Config, vehicle: VehicleLink
) -> Callable[[Step, VehicleState | None, int], None] | None:
    """What tells the autopilot how it moves, where that is wanted."""
    if not config.mavlink.odometry:
        return None
    from service.onboard.odometry_report import OdometryReport

    return OdometryReport(config.camera, vehicle.report_odometry).tell


def tell_keyframe(vehicle: VehicleLink, scan: Scan, keyframe: Keyframe) -> None:
    """Tell ground stations of a keyframe, at the pose that it has now."""
    from service.onboard.keyframe_report import keyframe_report

    inputs = scan.inputs
    state = vehicle.history.state_at(keyframe.time_ns)
    agl_m = None if state is None else state.alt_agl_m
    time_ns = keyframe.time_ns + inputs.unix_offset_ns
    T = keyframe.pose.T_world_camera
    vehicle.report_keyframe(keyframe_report(time_ns, T, scan.pipeline.rig.frame, agl_m))
