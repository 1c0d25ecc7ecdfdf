"""``skyrelief ctl`` against a companion, an impostor, and nothing."""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import sys
import threading
import time
from dataclasses import replace
from typing import Any

import pytest
from loopback import free_port
from rehearsal import RehearsalVehicle

from mavlink.component.camera import KeyframeReport
from mavlink.wire.dialect import dialect
from mavlink.wire.framing import Framer
from service.ground.operator import mavsdk_url


def run_ctl(port: int, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "service.cli", "ctl", *arguments]
    command += ["--connect", f"udpin://127.0.0.1:{port}"]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.slow
def test_ctl_steers_a_scan() -> None:
    pytest.importorskip("mavsdk")
    port = free_port()
    with RehearsalVehicle(f"udpout:127.0.0.1:{port}") as daemon:
        started = run_ctl(port, "start", "--json")
        assert started.returncode == 0, started.stderr
        answer = json.loads(started.stdout.splitlines()[-1])
        assert answer == {"action": "start", "result": "accepted", "system": 1, "component": 100}
        assert run_ctl(port, "baseline", "2.5").returncode == 0
        assert daemon.link.parameters()["SR_BASELINE_M"] == 2.5
        state = daemon.control.state
        daemon.control.state = replace(
            state, distance_m=112.5, camera_latency_ms=70.8, camera_latency_sigma_ms=2.1
        )
        status = json.loads(run_ctl(port, "status", "--json").stdout.splitlines()[-1])
        assert status["distance_m"] == 112.5 and status["speed_m_s"] is None
        assert status["camera_latency_ms"] == pytest.approx(70.8, abs=1e-4)
        assert status["camera_latency_sigma_ms"] == pytest.approx(2.1, abs=1e-4)
        assert status["recording"] is True and status["state"] == "scanning"
        assert status["storage_free_mib"] == 750.0
        refused = run_ctl(port, "selftest")
        assert refused.returncode == 3
        assert "stop the scan before the self-test" in refused.stderr
        assert run_ctl(port, "stop").returncode == 0
        assert daemon.control.asked == ["start_scan", "SR_BASELINE_M=2.5", "stop_scan"]


@pytest.mark.parametrize("as_json", [True, False])
def test_ctl_watches(as_json: bool) -> None:
    pytest.importorskip("mavsdk")
    port = free_port()
    with RehearsalVehicle(f"udpout:127.0.0.1:{port}") as daemon:
        done = threading.Event()

        def talk() -> None:
            k = 0
            while not done.wait(0.2):
                k += 1
                daemon.link.statustext(f"Scan text {k}")
                daemon.link.report_keyframe(KeyframeReport(1, 47.3, 8.5, 512.0, 80.0))

        talker = threading.Thread(target=talk)
        talker.start()
        watched = run_ctl(port, "watch", "--seconds", "2", *(["--json"] if as_json else []))
        done.set()
        talker.join()
    assert watched.returncode == 0, watched.stderr
    lines = watched.stdout.splitlines()
    if as_json:
        messages = {message["message"]: message for message in map(json.loads, lines)}
        assert messages["STATUSTEXT"]["text"].startswith("Scan text")
        assert messages["CAMERA_IMAGE_CAPTURED"]["component"] == 100
    else:
        assert any(line.startswith("Scan text") for line in lines)
        assert any("at 47.3000000, 8.5000000, 512.0 m" in line for line in lines)


def test_ctl_says_when_none_or_the_wrong_one_answers() -> None:
    pytest.importorskip("mavsdk")
    port = free_port()
    unheard = run_ctl(port, "start", "--timeout", "1")
    first, last = unheard.stderr.splitlines()
    assert first == f"ctl: waiting for the vehicle at udpin://127.0.0.1:{port}"
    assert unheard.returncode == 3 and "no skyrelief companion heard" in last
    with Impostor(port):
        wrong = run_ctl(port, "pause")
        assert wrong.returncode == 3
        assert "component 1 of system 1 answered (accepted) instead" in wrong.stderr


@pytest.mark.parametrize(
    ("link", "url"),
    [
        ("udpin:0.0.0.0:14550", "udpin://0.0.0.0:14550"),
        ("tcp:10.0.0.1:5760", "tcpout://10.0.0.1:5760"),
        ("serial:/dev/ttyUSB0:57600", "serial:///dev/ttyUSB0:57600"),
        ("/dev/ttyUSB0", "serial:///dev/ttyUSB0:57600"),
        ("serial:///dev/ttyUSB0:57600", "serial:///dev/ttyUSB0:57600"),
        ("nonsense", "nonsense"),
    ],
)
def test_ctl_takes_links_as_the_configuration_does(link: str, url: str) -> None:
    assert mavsdk_url(link) == url


class Impostor:
    """An autopilot that relays our heartbeats but carries our commands out itself."""

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(0.2)
        self._ground = ("127.0.0.1", port)
        self._open = True
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Impostor:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._open = False
        self._thread.join()
        self._socket.close()

    def _say(self, component: int, message: Any) -> None:
        encoder = dialect.MAVLink(None, 1, component)
        self._socket.sendto(bytes(message.pack(encoder)), self._ground)

    def _run(self) -> None:
        framer, ear = Framer(), dialect.MAVLink(None)
        beat = 0.0
        while self._open:
            if time.monotonic() > beat:
                beat = time.monotonic() + 0.3
                for component, kind in ((1, 2), (191, 18), (100, 30)):
                    autopilot = 3 if component == 1 else 8
                    message = dialect.MAVLink_heartbeat_message(kind, autopilot, 0, 0, 4, 3)
                    self._say(component, message)
            with contextlib.suppress(TimeoutError, ConnectionRefusedError):
                for packet in framer.feed(self._socket.recv(65536)):
                    if packet.message_id == 76:
                        m = ear.decode(bytearray(packet.data))
                        ack = (m.command, 0, 255, 0, packet.system, packet.component)
                        self._say(1, dialect.MAVLink_command_ack_message(*ack))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["fly"], "there are start, stop"),
        (["baseline"], "takes metres"),
        (["start", "3"], "takes metres"),
        (["baseline", "nan"], "0 or more"),
        (["start", "--timeout", "0"], "give seconds"),
    ],
)
def test_ctl_refuses_wrong_usage_in_one_line(arguments: list[str], words: str) -> None:
    done = run_ctl(free_port(), *arguments)
    assert done.returncode == 2 and words in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
