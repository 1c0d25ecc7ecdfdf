"""Heartbeats made by hand before the dialect is there, and the handover to the real ones."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from loopback import free_port, until
from paths import ROOT
from rehearsal import RehearsalControl, RehearsalVehicle

from mavlink.component.memory import Memory
from mavlink.component.vehicle import VehicleConfig, VehicleLink
from mavlink.wire.dialect import dialect
from mavlink.wire.first_beat import FirstBeats, heartbeat_packet
from mavlink.wire.framing import Framer, Packet


@pytest.mark.parametrize("component", [191, 100])
@pytest.mark.parametrize(("sequence", "token"), [(0, 1), (255, 0xDEADBEEF), (256, 7)])
def test_the_bytes_are_pymavlinks(component: int, sequence: int, token: int) -> None:
    kind = {191: 18, 100: 30}[component]
    encoder = dialect.MAVLink(None, 7, component)
    encoder.seq = sequence % 256
    theirs = dialect.MAVLink_heartbeat_message(kind, 8, 0, token, 1, 3).pack(encoder)
    assert heartbeat_packet(sequence, 7, component, token) == bytes(theirs)


def beats(ear: socket.socket, count: int, component: int = 191) -> list[Packet]:
    """The next so many heartbeats of a component."""
    framer = Framer()
    found: list[Packet] = []
    while len(found) < count:
        packets = framer.feed(ear.recv(65536))
        found += [p for p in packets if (p.message_id, p.component) == (0, component)]
    return found


def test_the_vehicle_link_takes_over_port_token_and_numbers() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.bind(("127.0.0.1", 0))
        ear.settimeout(10.0)
        address = f"udpout:127.0.0.1:{ear.getsockname()[1]}"
        first = FirstBeats((address,), 1, 4711)
        first.start()
        (early,) = beats(ear, 1)
        link = VehicleLink(VehicleConfig(links=(address,)), RehearsalControl(), first)
        link.start()
        (later,) = beats(ear, 1)
        assert link.report().links[0].opened == 1
        assert early.data[4] == 0 and later.data[4] == first.sequence
        assert early.data[10:14] == later.data[10:14] == (4711).to_bytes(4, "little")
        mouth = dialect.MAVLink(None, 255, 190)
        _, peer = ear.recvfrom(65536)
        start = dialect.MAVLink_command_long_message(1, 100, 2500, 0, 0, 0, 0, 0, 0, 0, 0)
        ear.sendto(bytes(start.pack(mouth)), peer)
        framer = Framer()
        while not any(p.message_id == 77 for p in framer.feed(ear.recv(65536))):
            pass
        link.stop()


def test_it_imports_neither_the_dialect_nor_arrays() -> None:
    program = (
        "import sys, service.cli, service.commands.run, service.config, mavlink.wire.first_beat"
        ", mavlink.component.memory\n"
        "print(*sorted({'numpy', 'pymavlink.dialects', 'rich', 'zenoh', 'cv2'} & set(sys.modules)))"
    )
    root = ROOT
    found = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, cwd=root, check=True
    )
    assert found.stdout.split() == []


def test_the_first_heartbeat_has_the_system_of_the_last_run(tmp_path: Path) -> None:
    """No 1/191 appears at the ground station until the vehicle is heard."""
    kept = {"parameters": {}, "signing_timestamp": 0, "system": 42}
    (tmp_path / "mavlink.json").write_text(json.dumps(kept))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.bind(("127.0.0.1", 0))
        ear.settimeout(30.0)
        links = f"mavlink.links=udpout:127.0.0.1:{ear.getsockname()[1]}"
        command = [sys.executable, "-m", "service.cli", "run", "--set", links, "--set"]
        command += ["health.http=", "--set", f"scan.folder={tmp_path}"]
        with subprocess.Popen(command, stderr=subprocess.PIPE) as run:
            (packet,) = Framer().feed(ear.recv(65536))
            run.communicate(timeout=60)
    assert (packet.message_id, packet.system) == (0, 42)


def test_the_vehicle_of_this_run_is_remembered(tmp_path: Path) -> None:
    with RehearsalVehicle(f"udpin:127.0.0.1:{(port := free_port())}", state_dir=tmp_path):
        mouth = dialect.MAVLink(None, 9, 1)
        beat = dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
            until(
                lambda: (
                    autopilot.sendto(bytes(beat.pack(mouth)), ("127.0.0.1", port)),
                    Memory(tmp_path).system,
                )[1]
            )
    assert Memory(tmp_path).system == 9
    later = VehicleLink(VehicleConfig(state_dir=tmp_path), RehearsalControl())
    assert later.presence.system == 9 and later.presence.autopilot is None


@pytest.mark.parametrize("system", [0, 256, -1, "7", 7.0, True, None, [], 10**30])
def test_a_system_that_cannot_be_is_not_remembered(tmp_path: Path, system: object) -> None:
    kept = {"parameters": {"SR_BASELINE_M": 2.0}, "signing_timestamp": 0, "system": system}
    (tmp_path / "mavlink.json").write_text(json.dumps(kept))
    assert Memory(tmp_path).system is None
    assert Memory(tmp_path).parameters == {"SR_BASELINE_M": 2.0}


@pytest.mark.slow
def test_the_daemon_speaks_before_it_finds_that_it_cannot_work() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.bind(("127.0.0.1", 0))
        ear.settimeout(30.0)
        link = f"mavlink.links=udpout:127.0.0.1:{ear.getsockname()[1]}"
        command = [sys.executable, "-m", "service.cli", "run", "--set", link]
        with subprocess.Popen([*command, "--set", "health.http="], stderr=subprocess.PIPE) as run:
            packets = Framer().feed(ear.recv(65536))
            _, words = run.communicate(timeout=60)
    assert packets[0].message_id == 0 and packets[0].data[17] == 1  # MAV_STATE_BOOT
    assert run.returncode == 2 and b"camera.source is not set" in words
