"""An autopilot between the companion and a ground station, as ArduPilot routes and answers."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Iterator
from typing import Any

from autopilot import beat, packed

from mavlink.wire.dialect import dialect
from mavlink.wire.framing import Decoder, Framer, Packet

CAMERA_INFORMATION, LOAD_STATUS, METADATA = 259, 390, 397
ARDUPILOT_DROPS = frozenset({LOAD_STATUS, METADATA})
"""Messages whose checksum ArduPilot 4.6 cannot verify."""
UNSUPPORTED = 3
NAK, NOT_FOUND = 129, 10


class ForwardingAutopilot:
    """1/1 with a camera that it has found: ``repeat`` sends its information as the autopilot's own.

    What is meant for another component goes to the companion alone, broadcasts as well.
    """

    def __init__(self, inner: int, outer: int, drops: frozenset[int] = ARDUPILOT_DROPS) -> None:
        """``inner``: the UDP port that the companion sends to; ``outer``: the ground station's."""
        self._drops = drops
        self.asked: list[Any] = []  # what came for the autopilot itself
        self.camera: Any = None  # its CAMERA_INFORMATION
        self._inside = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._inside.bind(("127.0.0.1", inner))
        self._outside = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._outside.bind(("127.0.0.1", 0))
        self._outer = ("127.0.0.1", outer)
        self._companion: tuple[str, int] | None = None
        self._decoder = Decoder()
        self._closed = threading.Event()
        self._threads = [
            threading.Thread(target=run, daemon=True)
            for run in (self._from_companion, self._from_ground, self._beat)
        ]

    def __enter__(self) -> ForwardingAutopilot:
        for side in (self._inside, self._outside):
            side.settimeout(0.1)
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        for thread in self._threads:
            thread.join()
        self._inside.close()
        self._outside.close()

    def _beat(self) -> None:
        while not self._closed.wait(0.5):
            self._to_ground(packed(beat()))
            self._to_companion(packed(beat()))
            if self.camera is None:
                ask = dialect.MAVLink_command_long_message(
                    1, 100, 512, 0, CAMERA_INFORMATION, 0, 0, 0, 0, 0, 0
                )
                self._to_companion(packed(ask))

    def repeat(self) -> None:
        """Send the camera's information, once it is here, as to a ground station that asks."""
        self._to_ground(packed(self.camera))

    def _to_ground(self, data: bytes) -> None:
        with contextlib.suppress(OSError):
            self._outside.sendto(data, self._outer)

    def _to_companion(self, data: bytes) -> None:
        if self._companion is not None:
            self._inside.sendto(data, self._companion)

    def _packets(self, side: socket.socket) -> Iterator[tuple[Packet, tuple[str, int]]]:
        framer = Framer()
        while not self._closed.is_set():
            with contextlib.suppress(TimeoutError, ConnectionRefusedError):
                data, peer = side.recvfrom(65536)
                for packet in framer.feed(data):
                    yield packet, peer

    def _from_companion(self) -> None:
        for packet, peer in self._packets(self._inside):
            self._companion = peer
            if packet.message_id == CAMERA_INFORMATION:
                self.camera = self._decoder.message(packet)
            if packet.message_id not in self._drops:
                self._to_ground(packet.data)

    def _from_ground(self) -> None:
        for packet, _ in self._packets(self._outside):
            message = self._decoder.message(packet)
            target = getattr(message, "target_component", 0)
            if target != 1:
                self._to_companion(packet.data)
            if target in (0, 1) and message is not None:
                self._answer(message)

    def _answer(self, message: Any) -> None:
        kind = message.get_type()
        self.asked.append(message)
        if kind == "COMMAND_LONG":
            if message.target_component == 1:
                ack = dialect.MAVLink_command_ack_message(message.command, UNSUPPORTED)
                self._to_ground(packed(ack))
        elif kind == "FILE_TRANSFER_PROTOCOL":
            head = bytearray(message.payload)
            head[0:2] = ((head[0] | head[1] << 8) + 1 & 0xFFFF).to_bytes(2, "little")
            head[3], head[4], head[5], head[12] = NAK, 1, head[3], NOT_FOUND
            asker = (message.get_srcSystem(), message.get_srcComponent())
            reply = dialect.MAVLink_file_transfer_protocol_message(0, *asker, list(head))
            self._to_ground(packed(reply))
