"""An autopilot for the trials: heartbeats, time, attitude, arming; it hears the status texts."""

from __future__ import annotations

import contextlib
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from loopback import free_port
from pymavlink.dialects.v20 import ardupilotmega as dialect  # type: ignore[import-untyped]
from trial_rig import Service, stream_to

ARMED, CUSTOM = 128, 1
COMPANION = 191
TIMESTAMPS = 35  # SO_TIMESTAMPNS


class Autopilot(threading.Thread):
    """Speaks by UDP to a port of this machine, with a boot clock that can start again."""

    def __init__(self, port: int, attitude: bool = True) -> None:
        """With ``attitude`` it sends that too, not only heartbeats."""
        super().__init__(daemon=True)
        self.port, self.attitude = port, attitude
        self.ended, self.silent, self.armed = (threading.Event() for _ in range(3))
        self.boot_s = time.monotonic() - 1000.0
        self.texts: list[str] = []  # STATUSTEXT that came back
        self.asked: list[Any] = []  # messages to send once
        self.accepted: list[int] = []  # commands that were acknowledged
        self.beats_s: list[
            float
        ] = []  # when the companion's heartbeats came, by the kernel's clock

    def run(self) -> None:
        """Send until :attr:`ended`."""
        link: Any = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
        link.robust_parsing = True
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
            port.setblocking(False)
            port.setsockopt(socket.SOL_SOCKET, TIMESTAMPS, 1)
            while not self.ended.wait(0.1):
                if not self.silent.is_set():
                    for message in self._due():
                        with contextlib.suppress(OSError):  # nothing is there yet
                            port.sendto(message.pack(link), ("127.0.0.1", self.port))
                self._hear(port, link)

    def _due(self) -> list[Any]:
        mode = CUSTOM | (ARMED if self.armed.is_set() else 0)
        boot_ms = int(1e3 * (time.monotonic() - self.boot_s))
        out = [
            dialect.MAVLink_heartbeat_message(2, 3, mode, 0, 4, 3),
            dialect.MAVLink_system_time_message(int(1e6 * time.time()), boot_ms),
        ]
        out += [self.asked.pop() for _ in self.asked[:]]
        if self.attitude:
            out.append(dialect.MAVLink_attitude_message(boot_ms, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0))
        return out

    def _hear(self, port: socket.socket, link: Any) -> None:
        with contextlib.suppress(OSError):
            while True:
                data, ((_, _, stamp), *_), _, _ = port.recvmsg(4096, 64)
                for message in link.parse_buffer(data) or []:
                    if message.get_type() == "STATUSTEXT":
                        self.texts.append(message.text)
                    if message.get_type() == "COMMAND_ACK" and message.result == 0:
                        self.accepted.append(message.command)
                    if (message.get_type(), message.get_srcComponent()) == ("HEARTBEAT", COMPANION):
                        seconds, nanoseconds = struct.unpack("@qq", stamp)
                        self.beats_s.append(seconds + 1e-9 * nanoseconds)


@contextlib.contextmanager
def aircraft(
    folder: Path, streamed: tuple[str, str], model: Path, start: str = "on-boot",
    compute: str = "", more: str = "",
) -> Iterator[tuple[Service, Autopilot, subprocess.Popen[bytes]]]:  # fmt: skip
    """The service, an autopilot that only beats and arms, and the camera: FFmpeg.

    ``streamed`` is the images' size and source, as :func:`trial_rig.stream_to` takes them.
    """
    port, link = free_port(), free_port()
    autopilot = Autopilot(link, attitude=False)
    autopilot.start()
    sender = stream_to(port, *streamed)
    camera = f"stream:udp://127.0.0.1:{port}"
    more += f'[mavlink]\nlinks = ["udpin:127.0.0.1:{link}"]\n'
    try:
        with Service(folder, start, None, camera, model, more=more, compute=compute) as service:
            yield service, autopilot, sender
    finally:
        autopilot.ended.set()
        sender.kill()
        sender.wait()
