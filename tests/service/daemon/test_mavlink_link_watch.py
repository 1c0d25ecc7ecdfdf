"""Messages missing on open links are reported, each with the setting to change."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from autopilot import attitude, beat, packed
from loopback import free_port, until
from rehearsal import RehearsalControl
from vehicles_around import Net, Vehicle

from mavlink.component.control import Phase
from mavlink.component.link_watch import WatchConfig
from mavlink.component.presence import Health
from mavlink.wire.dialect import dialect
from service.commands.diagnosis import BAD, NOTE, Finding, examine_links
from service.config import load_config

GCS = (255, 190)


def ground_beat() -> Any:
    return dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)


class Watched(Net):
    """A net with a ground station and gimbal angles, each of which may be missing."""

    has_ground = has_gimbal = True
    speaks_v1 = False

    def speak(self) -> None:
        if self.has_ground:
            self.feed(ground_beat(), GCS)
        if self.has_gimbal:
            q = [1.0, 0.0, 0.0, 0.0]
            gimbal = dialect.MAVLink_gimbal_device_attitude_status_message(
                0, 0, 100, 12, q, 0.0, 0.0, 0.0, 0
            )
            self.feed(gimbal, (self.presence.system, 154))
        if self.speaks_v1:
            mouth = dialect.MAVLink(None, 1, 1)
            for packet in self.framer.feed(bytes(beat().pack(mouth, force_mavlink1=True))):
                self.companion.receive(0, packet, self.now_ns)

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds)):
            self.speak()
            super().wait(1.0)

    def troubles(self) -> list[str]:
        return [trouble.what for trouble in self.companion.watch.troubles(self.now_ns)]

    def state(self) -> Health | None:
        self.presence.confirm(Health.STANDBY, self.now_ns)
        return self.presence.health(self.now_ns)

    def said(self) -> str:
        """Everything said so far, its pieces joined."""
        return "".join(self.texts)


def test_nothing_is_missing_where_all_speak() -> None:
    net = Watched(Vehicle(1, 0.002))
    net.wait(90)
    assert net.troubles() == [] and net.texts == [] and net.state() is Health.STANDBY


def test_a_silent_autopilot_is_reported_with_its_settings() -> None:
    net = Watched()
    net.wait(9)
    assert net.troubles() == [] and net.state() is Health.STANDBY  # it may still come
    net.wait(15)
    assert net.troubles() == ["autopilot"] and net.state() is Health.NOT_READY
    assert "No autopilot" in net.said() and "SERIALn_PROTOCOL" in net.said()


def test_a_wrong_system_id_is_reported_with_the_right_one() -> None:
    net = Watched(Vehicle(7, 0.002), given=3)
    net.wait(15)
    assert net.troubles() == ["autopilot"] and net.state() is Health.NOT_READY
    assert "No autopilot of system 3, but of 7: correct mavlink.system_id" in net.said()


def test_a_private_port_is_reported() -> None:
    """SERIALn_OPTIONS = 1024: orders arrive, no heartbeat of a ground station does."""
    net = Watched(Vehicle(1, 0.002))
    net.has_ground = False
    net.wait(65)
    assert net.troubles() == ["ground"] and net.state() is Health.NOT_READY
    assert "remove 1024 from SERIALn_OPTIONS" in net.said()
    net.feed(dialect.MAVLink_timesync_message(0, 1), GCS)  # no order
    assert "1024" in net.companion.watch.troubles(net.now_ns)[0].text
    assert "answers" not in net.companion.watch.troubles(net.now_ns)[0].text
    order = dialect.MAVLink_command_long_message(1, 191, 512, 0, 390, 0, 0, 0, 0, 0, 0)
    net.feed(order, GCS)
    assert "do not reach the ground" in net.companion.watch.troubles(net.now_ns)[0].text
    net.has_ground = True
    net.wait(3)
    assert net.troubles() == [] and net.state() is Health.STANDBY


@pytest.mark.parametrize(("firmware", "troubles"), [(12, ["ground"]), (3, [])])
def test_a_port_of_px4_that_forwards_in_one_direction_is_reported(
    firmware: int, troubles: list[str]
) -> None:
    net = Watched(Vehicle(1, 0.002, firmware=firmware))
    net.wait(65)
    assert net.troubles() == troubles and net.state() is Health.STANDBY
    assert ("MAV_n_FORWARD = 1 on this port" in net.said()) is bool(troubles)
    elsewhere = dialect.MAVLink_command_long_message(1, 1, 512, 0, 259, 0, 0, 0, 0, 0, 0)
    net.feed(elsewhere, GCS)
    assert net.troubles() == troubles
    net.feed(dialect.MAVLink_command_long_message(1, 100, 512, 0, 259, 0, 0, 0, 0, 0, 0), GCS)
    assert net.troubles() == []


@pytest.mark.parametrize(
    ("wanted", "troubles", "state"),
    [
        (True, ["gimbal"], Health.NOT_READY),
        (None, ["gimbal"], Health.STANDBY),
        (False, [], Health.STANDBY),
    ],
)
def test_missing_gimbal_angles_are_reported_where_they_are_expected(
    wanted: bool | None, troubles: list[str], state: Health
) -> None:
    net = Watched(Vehicle(1, 0.002), watch=WatchConfig(gimbal=wanted))
    net.has_gimbal = False
    net.wait(25)
    assert net.troubles() == troubles and net.state() is state
    assert ("MNT1_TYPE" in net.said()) is bool(troubles)


@pytest.mark.parametrize("silent_s", [3, 9, 14])
def test_a_restart_of_the_autopilot_is_no_missing_gimbal(silent_s: int) -> None:
    """Its messages stop together and start one after the other."""
    autopilot = Vehicle(1, 0.002)
    net = Watched(autopilot, watch=WatchConfig(gimbal=True))
    net.wait(20)
    net.feed(attitude(60_000), (1, 1))
    autopilot.is_on = net.has_gimbal = False
    net.wait(silent_s)
    autopilot.is_on = True
    for boot_ms in (500, 600, 700):
        net.feed(attitude(boot_ms), (1, 1))
    net.wait(9)
    net.has_gimbal = True
    net.wait(5)
    assert "Autopilot restarted" in net.said() and "No gimbal angles" not in net.said()
    net.has_gimbal = False
    net.wait(25)
    assert "No gimbal angles" in net.said()


def test_mavlink_1_is_reported_with_the_protocol_to_set() -> None:
    net = Watched()
    net.speaks_v1 = True
    net.wait(25)
    assert net.presence.autopilot == (1, 1)
    assert net.troubles() == ["mavlink 1"] and net.state() is Health.NOT_READY
    assert "set SERIALn_PROTOCOL = 2 (PX4: MAV_PROTO_VER = 2)" in net.said()


def test_a_scan_that_starts_with_something_missing_says_it_again() -> None:
    net = Watched(Vehicle(1, 0.002), watch=WatchConfig(gimbal=True))
    net.has_gimbal = False
    net.wait(50)
    assert net.said().count("No gimbal angles") == 1
    control = net.companion.control
    assert isinstance(control, RehearsalControl)
    control.start_scan()
    assert control.state.phase is Phase.SCANNING
    net.wait(3)
    assert net.said().count("No gimbal angles") == 2


# The doctor


@contextmanager
def speaking(
    port: int, *messages: tuple[Any, tuple[int, int]], v1: bool = False, every_s: float = 0.05
) -> Iterator[None]:
    """Somebody who says all this again and again."""
    ended = threading.Event()

    def run() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            while not ended.wait(every_s):
                for message, source in messages:
                    mouth = dialect.MAVLink(None, *source)
                    data = message.pack(mouth, force_mavlink1=v1)
                    out.sendto(bytes(data), ("127.0.0.1", port))

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def examined(port: int, *settings: str, listen_s: float = 2.0) -> dict[str, Finding]:
    given = [f"mavlink.links=udpin:127.0.0.1:{port}", "health.http=", *settings]
    return {f.what: f for f in examine_links(load_config(None, given), listen_s, None)}


def test_the_doctor_names_what_is_missing() -> None:
    port = free_port()
    with speaking(port, (beat(), (7, 1)), every_s=1.0):
        found = examined(port, "camera.mount=gimbal", listen_s=3.0)
    assert "system 7" in found["autopilot"].text and "system 7" in found["mavlink"].text
    assert found["ground"].verdict == NOTE and "1024" in found["ground"].text
    assert found["gimbal"].verdict == BAD and "MNT1_TYPE" in found["gimbal"].text


def test_the_doctor_names_the_system_id_to_set() -> None:
    port = free_port()
    with speaking(port, (beat(), (7, 1)), (ground_beat(), GCS)):
        found = examined(port, "mavlink.system_id=3")
    assert found["autopilot"].verdict == BAD and "but of 7" in found["autopilot"].text
    assert "ground" not in found


def test_the_doctor_names_mavlink_1() -> None:
    port = free_port()
    with speaking(port, (beat(), (1, 1)), (ground_beat(), GCS), v1=True):
        found = examined(port)
    assert found["mavlink 1"].verdict == BAD and "SERIALn_PROTOCOL = 2" in found["mavlink 1"].text


def test_the_doctor_names_noise() -> None:
    port = free_port()
    ended = threading.Event()

    def hiss() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            while not ended.wait(0.05):
                out.sendto(b"\x00\x80\xf8" * 30, ("127.0.0.1", port))

    thread = threading.Thread(target=hiss, daemon=True)
    thread.start()
    found = examined(port)
    ended.set()
    thread.join()
    assert found["mavlink"].verdict == BAD and "SERIALn_BAUD" in found["mavlink"].text


def test_the_doctor_asks_for_telemetry_as_the_service_does() -> None:
    """A port may carry nothing but heartbeats until somebody asks."""
    port = free_port()
    asked: list[int] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
        autopilot.settimeout(0.05)
        result: dict[str, Finding] = {}
        doctor = threading.Thread(target=lambda: result.update(examined(port)), daemon=True)
        doctor.start()
        ears = dialect.MAVLink(None)
        ears.robust_parsing = True

        def serve() -> bool:
            autopilot.sendto(packed(beat()), ("127.0.0.1", port))
            try:
                heard = ears.parse_buffer(autopilot.recv(65536)) or []
            except TimeoutError:
                heard = []
            orders = [m for m in heard if m.get_type() == "COMMAND_LONG"]
            asked.extend(int(m.param1) for m in orders if m.command == 511)
            return not doctor.is_alive()

        until(serve)
    assert 285 in asked and result["autopilot"].text == "system 1, component 1"


def test_the_doctor_says_what_the_running_service_misses() -> None:
    running = {
        "mavlink": {
            "links_up": 1,
            "packets": 20,
            "troubles": [{"what": "gimbal", "text": "No gimbal angles", "is_grave": False}],
        }
    }
    config = load_config(None, ["mavlink.links=udpin:127.0.0.1:1", "health.http="])
    found = {f.what: f for f in examine_links(config, 1.0, running)}
    assert found["gimbal"] == Finding("gimbal", NOTE, "No gimbal angles")
