"""The [mavlink] section reaches the vehicle link."""

from __future__ import annotations

from pathlib import Path

import pytest

from service.config import load_config
from service.daemon.vehicle_config import vehicle_config, with_parameter
from service.errors import InputError


def test_every_key_reaches_the_link(tmp_path: Path) -> None:
    key = tmp_path / "key"
    key.write_bytes(bytes(32))
    key.chmod(0o600)
    config = load_config(
        None,
        [
            'mavlink.links=["udpin:127.0.0.1:14550", "tcp:10.0.0.1:5760"]',
            "mavlink.system_id=7",
            "mavlink.gimbal_yaw_frame=servo",
            f"mavlink.signing_key={key}",
            "mavlink.odometry=true",
            f"mavlink.memory={tmp_path}",
        ],
    )
    vehicle = vehicle_config(config)
    assert vehicle.links == ("udpin:127.0.0.1:14550", "tcp:10.0.0.1:5760")
    assert vehicle.presence.system == 7 and vehicle.odometry
    assert vehicle.history.yaw_frame == "servo"
    assert vehicle.signing_key == key and vehicle.state_dir == tmp_path


def test_the_default_takes_the_autopilots_system_id() -> None:
    vehicle = vehicle_config(load_config(None, []))
    assert vehicle.presence.system is None and vehicle.links == ()
    assert vehicle.signing_key is None and not vehicle.odometry
    assert vehicle.state_dir == Path("/var/lib/skyrelief/scans")  # next to the scans


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ('mavlink.links=["carrier pigeon"]', "link"),
        ("mavlink.signing_key=/nowhere/key", "no such signing key"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(setting: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        vehicle_config(load_config(None, [setting]))
    assert "\n" not in str(caught.value)


def test_a_baseline_that_no_flight_has_is_refused() -> None:
    config = load_config(None, [])
    assert with_parameter(config, "SR_BASELINE_M", 0.0).scan.baseline == "auto"
    assert with_parameter(config, "SR_BASELINE_M", 0.01).scan.baseline == 0.01
    for metres in (1e-40, 0.009):
        with pytest.raises(InputError, match="to 1000 metres"):
            with_parameter(config, "SR_BASELINE_M", metres)
