"""The [mavlink] section as the vehicle link wants it."""

from __future__ import annotations

from pathlib import Path

from mavlink.companion import CompanionConfig
from mavlink.gimbal import GimbalConfig
from mavlink.history import HistoryConfig
from mavlink.link_watch import WatchConfig
from mavlink.presence import PresenceConfig
from mavlink.signing import read_key
from mavlink.vehicle import VehicleConfig
from service.config import Config
from service.daemon.tuning import parameters_of
from service.errors import InputError

KEEP_S = 120.0
"""How long the live history reaches back; frames wait for the pipeline for less than that."""


def vehicle_config(config: Config) -> VehicleConfig:
    """Links, identity, gimbal, signing and memory; InputError when they cannot be."""
    mavlink = config.mavlink
    key = Path(mavlink.signing_key) if mavlink.signing_key else None
    try:
        if key is not None:
            read_key(key)
        return VehicleConfig(
            links=mavlink.links,
            presence=PresenceConfig(system=mavlink.system_id or None),
            companion=CompanionConfig(parameters=parameters_of(config), watch=watch_config(config)),
            history=HistoryConfig(
                keep_s=KEEP_S, gimbal=GimbalConfig(yaw_frame=mavlink.gimbal_yaw_frame)
            ),
            signing_key=key,
            odometry=mavlink.odometry,
            state_dir=Path(mavlink.memory or config.scan.folder),
        )
    except ValueError as error:
        raise InputError(f"[mavlink] {error}") from error


def watch_config(
    config: Config,
    wait_s: float = WatchConfig.wait_s,
    ground_wait_s: float = WatchConfig.ground_wait_s,
) -> WatchConfig:
    """What the links must carry for this camera, and how long it is waited for."""
    gimbal = {"auto": None, "gimbal": True, "fixed": False}[config.camera.mount]
    return WatchConfig(gimbal, wait_s, ground_wait_s)
