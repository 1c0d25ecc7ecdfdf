"""Settings of the vehicle link: the [mavlink] section, and the keys that operators tune in flight
as MAVLink parameters."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mavlink.component.companion import CompanionConfig
from mavlink.component.link_watch import WatchConfig
from mavlink.component.parameters import YAW_FRAME
from mavlink.component.presence import PresenceConfig
from mavlink.component.vehicle import VehicleConfig
from mavlink.telemetry.gimbal import YAW_FRAMES
from mavlink.telemetry.history import HistoryConfig
from mavlink.wire.signing import read_key
from service.config import Config, change
from service.errors import InputError

KEEP_S = 120.0  # length of the live history; frames wait for the pipeline for less than that


def vehicle_config(config: Config) -> VehicleConfig:
    """Links, identity, gimbal, signing and memory; InputError when they are invalid."""
    mavlink = config.mavlink
    key = Path(mavlink.signing_key) if mavlink.signing_key else None
    try:
        if key is not None:
            read_key(key)
        return VehicleConfig(
            links=mavlink.links,
            presence=PresenceConfig(system=mavlink.system_id or None),
            companion=CompanionConfig(parameters=parameters_of(config), watch=watch_config(config)),
            history=HistoryConfig(KEEP_S, mavlink.gimbal_yaw_frame),
            signing_key=key,
            odometry=mavlink.odometry,
            state_dir=Path(mavlink.memory or config.scan.folder),
            stand_in=True,
        )
    except ValueError as error:
        raise InputError(f"[mavlink] {error}") from error


def watch_config(
    config: Config,
    wait_s: float = WatchConfig.wait_s,
    ground_wait_s: float = WatchConfig.ground_wait_s,
) -> WatchConfig:
    """Messages that the links must carry for this camera, and how long to wait for them."""
    gimbal = {"auto": None, "gimbal": True, "fixed": False}[config.camera.mount]
    if all(link.startswith("lines:") for link in config.mavlink.links):
        ground_wait_s = math.inf  # no ground station shares the link
    return WatchConfig(gimbal, wait_s, ground_wait_s)


@dataclass(frozen=True, slots=True)
class Tunable:
    """A configuration key and its conversion to a parameter's value."""

    key: str
    to_key: Callable[[float], object] = float
    from_key: Callable[[Any], float | None] = float  # None: not representable as a parameter


def _metres_or_auto(value: object) -> float | None:
    """The baseline as a parameter: 0 for automatic; None for frames."""
    if value == "auto":
        return 0.0
    return float(value) if isinstance(value, int | float) else None


TUNABLES: dict[str, Tunable] = {
    "SR_BASELINE_M": Tunable("scan.baseline", lambda v: v if v > 0.0 else "auto", _metres_or_auto),
    "SR_RESOLUTION_M": Tunable("scan.resolution_m"),
    "SR_LINK_KBIT_S": Tunable("datalink.budget_kbit_s"),
    YAW_FRAME: Tunable(
        "mavlink.gimbal_yaw_frame", lambda v: YAW_FRAMES[round(v)], lambda v: YAW_FRAMES.index(v)
    ),
    "SR_CAM_LATENCY": Tunable("camera.latency_ms"),
    "SR_CAM_LAT_AUTO": Tunable(
        "camera.latency", lambda v: "auto" if v else "fixed", lambda v: float(v == "auto")
    ),
}
"""A new parameter is a line here and one in :data:`mavlink.component.parameters.PARAMETERS`."""


def with_parameter(config: Config, name: str, value: float) -> Config:
    """``config`` with a parameter's value; InputError when the key rejects it."""
    tunable = TUNABLES[name]
    return change(config, tunable.key, tunable.to_key(value))


def parameters_of(config: Config) -> dict[str, float]:
    """The parameters of a configuration; values that are not representable are left out."""
    found = {}
    for name, tunable in TUNABLES.items():
        section, _, field = tunable.key.partition(".")
        value = tunable.from_key(getattr(getattr(config, section), field))
        if value is not None:
            found[name] = float(value)
    return found
