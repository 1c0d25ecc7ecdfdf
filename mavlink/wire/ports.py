"""Ports: serial, UDP and TCP; the only I/O of this package.

A link is written as in pymavlink:
``serial:/dev/serial/by-id/NAME:921600``, ``udpin:0.0.0.0:14550`` (also ``udp:``),
``udpout:192.168.1.2:14550``, ``tcp:HOST:PORT``, ``tcpin:0.0.0.0:5760``; and ``lines:0.0.0.0:10110``
for NMEA 0183 or CSV on UDP (:mod:`mavlink.wire.lines`). ``serial:///dev/NAME:921600``, as MAVSDK
writes it, is the same.
"""

from __future__ import annotations

import contextlib
import fcntl
import re
import select
import socket
import termios
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from mavlink.wire.stand_in import Way

READ_S = 0.2  # how long a read may block
LONGEST = 65536
PEER_NS = 60_000_000_000  # a UDP peer not heard for longer is forgotten
MAX_PEERS = 8
BAUD = 57600


@dataclass(frozen=True, slots=True)
class LinkSpec:
    kind: str
    place: str  # device or host
    number: int  # baud rate or port

    @property
    def name(self) -> str:
        return f"{self.kind}:{self.place}:{self.number}"


def parse_link(text: str) -> LinkSpec:
    """The address in a link's notation; ValueError names the error."""
    address = re.sub(r",(?=\d+$)", ":", text.replace("://", ":", 1))
    kind, _, rest = (f"serial:{address}" if text.startswith("/dev/") else address).partition(":")
    kind = {"udp": "udpin", "tcpout": "tcp"}.get(kind, kind)
    place, _, number = rest.rpartition(":")
    if kind not in PORTS:
        raise ValueError(f"link {text!r}: use one of {', '.join(PORTS)}, as udpin:0.0.0.0:14550")
    if kind == "serial" and not number.isdigit():
        place, number = rest, str(BAUD)
    if not place or not number.isdigit() or not int(number):
        raise ValueError(f"link {text!r}: needs a place and a number, as {kind}:PLACE:NUMBER")
    if kind != "serial" and int(number) > 65535:
        raise ValueError(f"link {text!r}: no such port")
    return LinkSpec(kind, place, int(number))


class Port(Protocol):
    """An open link. Failures are OSErrors."""

    is_quick: bool  # writing never blocks, so any thread may write

    def read(self) -> bytes:
        """Received data; empty when there is none within ``READ_S``."""

    def write(self, data: bytes) -> None:
        """Send to everyone at the other end."""

    @property
    def ways(self) -> list[Way]:
        """To everyone at the other end, for another process."""

    def close(self) -> None:
        """Release it."""


class SerialPort:
    is_quick = False

    def __init__(self, spec: LinkSpec) -> None:
        import serial

        try:
            self._line = serial.Serial(
                spec.place, spec.number, timeout=READ_S, write_timeout=1.0, exclusive=True
            )
        except termios.error as error:  # unplugged meanwhile; no OSError
            raise OSError(*error.args) from error

    def read(self) -> bytes:
        try:
            first: bytes = self._line.read(1)
            return first + self._line.read(self._line.in_waiting) if first else b""
        except TypeError as error:  # pyserial raises this when it was closed meanwhile
            raise OSError("closed") from error

    def write(self, data: bytes) -> None:
        try:
            self._line.write(data)
        except TypeError as error:
            raise OSError("closed") from error

    @property
    def ways(self) -> list[Way]:
        return [(self._line.fileno(), None)]

    def close(self) -> None:
        with contextlib.suppress(OSError):  # a stand-in may hold the line, and its lock, for longer
            fcntl.flock(self._line.fileno(), fcntl.LOCK_UN)
        self._line.close()


class UdpPort:
    """Datagrams: to a fixed address (out), or to the peers heard (in)."""

    is_quick = True

    def __init__(self, spec: LinkSpec) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._buffer = memoryview(bytearray(LONGEST))
        self._peers: dict[tuple[str, int], int] = {}
        self._fixed: tuple[str, int] | None = None
        try:
            self._socket.settimeout(READ_S)
            if spec.kind == "udpout":
                self._fixed = (socket.gethostbyname(spec.place), spec.number)
            else:
                self._socket.bind((spec.place, spec.number))
        except OSError:
            self._socket.close()
            raise

    def read(self) -> bytes:
        try:
            if self._fixed is not None:
                return self._socket.recv(LONGEST)
            length, peer = self._socket.recvfrom_into(self._buffer)
        except (TimeoutError, ConnectionRefusedError):
            return b""
        if peer not in self._peers and len(self._peers) >= MAX_PEERS:
            last_heard = list(self._peers.items())  # the writing thread drops some
            self._peers.pop(min(last_heard, key=lambda entry: entry[1])[0], None)
        self._peers[peer] = time.monotonic_ns()
        return bytes(self._buffer[:length])

    def write(self, data: bytes) -> None:
        """Send to all; a missing peer is not a failure of the link."""
        now = time.monotonic_ns()
        for peer, heard in list(self._peers.items()):
            if now - heard > PEER_NS:
                self._peers.pop(peer, None)
        for peer in self._targets:
            with contextlib.suppress(OSError):
                self._socket.sendto(data, peer)

    @property
    def _targets(self) -> list[tuple[str, int]]:
        return list(self._peers) if self._fixed is None else [self._fixed]

    @property
    def ways(self) -> list[Way]:
        return [(self._socket.fileno(), peer) for peer in self._targets]

    def close(self) -> None:
        self._socket.close()


class TcpPort:
    """A connection to a server (tcp), or a server for a few clients at once (tcpin)."""

    is_quick = False

    def __init__(self, spec: LinkSpec) -> None:
        place = spec.place, spec.number
        self._servers, self._peers = list[socket.socket](), list[socket.socket]()
        if spec.kind == "tcpin":
            self._servers.append(socket.create_server(place))
        else:
            self._peers.append(socket.create_connection(place, timeout=3.0))
            self._peers[0].setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def read(self) -> bytes:
        data = b""
        for source in _ready([*self._servers, *self._peers]):
            if source in self._servers:
                self._accept(source)
                continue
            try:
                got = source.recv(LONGEST)
                if not got:
                    raise ConnectionResetError("closed by the other end")
                data += got
            except OSError as error:
                self._lose(source, error)
        return data

    def write(self, data: bytes) -> None:
        for peer in list(self._peers):
            try:
                peer.sendall(data)
            except OSError as error:
                self._lose(peer, error)

    @property
    def ways(self) -> list[Way]:
        return [(peer.fileno(), None) for peer in list(self._peers)]

    def _accept(self, server: socket.socket) -> None:
        client, _ = server.accept()
        client.settimeout(1.0)
        if len(self._peers) < MAX_PEERS:
            self._peers.append(client)
        else:
            client.close()

    def _lose(self, peer: socket.socket, error: OSError) -> None:
        """Drop a client; without its server the link has failed."""
        if not self._servers:
            raise error
        with contextlib.suppress(ValueError):
            self._peers.remove(peer)
        _end(peer)

    def close(self) -> None:
        for peer in self._peers:
            _end(peer)
        for server in self._servers:
            server.close()


def _end(peer: socket.socket) -> None:
    """Close a connection at both ends, although a stand-in may hold it for longer."""
    with contextlib.suppress(OSError):
        peer.shutdown(socket.SHUT_RDWR)
    peer.close()


def _ready(sockets: Sequence[socket.socket]) -> list[socket.socket]:
    """Those with something to read within ``READ_S``. Another thread may close one meanwhile, and
    unlike ``select`` its number may be any."""
    numbered = {n: one for one in sockets if (n := one.fileno()) >= 0}
    poll = select.poll()
    for number in numbered:
        poll.register(number, select.POLLIN)
    return [numbered[number] for number, _ in poll.poll(1e3 * READ_S)]


class LinesPort(UdpPort):
    """Lines of NMEA or CSV on UDP, received as MAVLink; what is sent goes nowhere."""

    def __init__(self, spec: LinkSpec) -> None:
        from mavlink.wire.lines import LineReader  # the dialect is slow to import

        super().__init__(spec)
        self._reader = LineReader()

    def read(self) -> bytes:
        data = super().read()
        return self._reader.packets(data, time.monotonic_ns()) if data else b""

    def write(self, data: bytes) -> None:
        """Drop it: nothing at the other end reads MAVLink."""

    @property
    def ways(self) -> list[Way]:
        return []


PORTS: dict[str, Callable[[LinkSpec], Port]] = {
    "serial": SerialPort,
    "udpin": UdpPort,
    "udpout": UdpPort,
    "tcp": TcpPort,
    "tcpin": TcpPort,
    "lines": LinesPort,
}
"""Kind of link to its port. A new kind is one class and one line."""
