"""Links to the outside: serial, UDP and TCP, reopened for ever, stamped at the read.

The only sockets and ports of this package. A link is named as pymavlink does it:

``serial:/dev/serial/by-id/NAME:921600``, ``udpin:0.0.0.0:14550`` (also ``udp:``),
``udpout:192.168.1.2:14550``, ``tcp:HOST:PORT``, ``tcpin:0.0.0.0:5760``.
"""

from __future__ import annotations

import contextlib
import logging
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

log = logging.getLogger(__name__)

READ_S = 0.2  # how long a read may block
LONGEST = 65536
PEER_NS = 60_000_000_000  # a UDP peer not heard for longer is forgotten
MAX_PEERS = 8
BACKOFF_S = (0.2, 5.0)
QUEUE = 512
KEPT_WHILE_DOWN = 8  # older messages for a link that is down are stale
BAUD = 57600
KINDS = ("serial", "udp", "udpin", "udpout", "tcp", "tcpin")


@dataclass(frozen=True, slots=True)
class LinkSpec:
    """A link's address."""

    kind: str
    place: str  # device or host
    number: int  # baud rate or port

    @property
    def name(self) -> str:
        """The address as it is written."""
        return f"{self.kind}:{self.place}:{self.number}"


def parse_link(text: str) -> LinkSpec:
    """The address in a link's notation; ValueError says what is wrong with it."""
    if text.startswith("/dev/"):
        text = "serial:" + text.replace(",", ":")
    kind, _, rest = text.partition(":")
    place, _, number = rest.rpartition(":")
    if kind not in KINDS:
        raise ValueError(f"link {text!r}: use one of {', '.join(KINDS)}, as udpin:0.0.0.0:14550")
    if kind == "serial" and not number.isdigit():
        place, number = rest, str(BAUD)
    if not place or not number.isdigit() or not int(number):
        raise ValueError(f"link {text!r}: needs a place and a number, as {kind}:PLACE:NUMBER")
    if kind != "serial" and int(number) > 65535:
        raise ValueError(f"link {text!r}: no such port")
    return LinkSpec("udpin" if kind == "udp" else kind, place, int(number))


class Port(Protocol):
    """An open link. Failures are OSErrors."""

    is_quick: bool  # writing never waits, so whoever has something to send may do it

    def read(self) -> bytes:
        """What came; empty when nothing did within ``READ_S``."""

    def write(self, data: bytes) -> None:
        """Send to everyone at the other end."""

    def close(self) -> None:
        """Free it."""


class SerialPort:
    """A serial line."""

    is_quick = False

    def __init__(self, spec: LinkSpec) -> None:
        import serial

        self._line = serial.Serial(
            spec.place, spec.number, timeout=READ_S, write_timeout=1.0, exclusive=True
        )

    def read(self) -> bytes:
        """What came."""
        try:
            first: bytes = self._line.read(1)
            return first + self._line.read(self._line.in_waiting) if first else b""
        except TypeError as error:  # pyserial's way to say that it was closed meanwhile
            raise OSError("closed") from error

    def write(self, data: bytes) -> None:
        """Send."""
        try:
            self._line.write(data)
        except TypeError as error:
            raise OSError("closed") from error

    def close(self) -> None:
        """Free the line."""
        self._line.close()


class UdpPort:
    """Datagrams: to a fixed place (out), or to those who were heard (in)."""

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
        """The next datagram."""
        try:
            length, peer = self._socket.recvfrom_into(self._buffer)
        except (TimeoutError, ConnectionRefusedError):
            return b""
        if self._fixed is None and (peer in self._peers or len(self._peers) < MAX_PEERS):
            self._peers[peer] = time.monotonic_ns()
        return bytes(self._buffer[:length])

    def write(self, data: bytes) -> None:
        """Send to all; a peer that is not there is no failure of the link."""
        now = time.monotonic_ns()
        for peer, heard in list(self._peers.items()):
            if now - heard > PEER_NS:
                self._peers.pop(peer, None)
        for peer in [self._fixed] if self._fixed else list(self._peers):
            with contextlib.suppress(OSError):
                self._socket.sendto(data, peer)

    def close(self) -> None:
        """Free the socket."""
        self._socket.close()


class TcpPort:
    """A connection to a server."""

    is_quick = False

    def __init__(self, spec: LinkSpec) -> None:
        self._socket = socket.create_connection((spec.place, spec.number), timeout=3.0)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def read(self) -> bytes:
        """What came."""
        if not select.select([self._socket], [], [], READ_S)[0]:
            return b""
        data = self._socket.recv(LONGEST)
        if not data:
            raise ConnectionResetError("closed by the other end")
        return data

    def write(self, data: bytes) -> None:
        """Send."""
        self._socket.sendall(data)

    def close(self) -> None:
        """Free the socket."""
        self._socket.close()


class TcpServerPort:
    """A server for a few clients at once."""

    is_quick = False

    def __init__(self, spec: LinkSpec) -> None:
        self._server = socket.create_server((spec.place, spec.number))
        self._clients: list[socket.socket] = []

    def read(self) -> bytes:
        """What came from any client."""
        ready = select.select([self._server, *self._clients], [], [], READ_S)[0]
        data = b""
        for source in ready:
            if source is self._server:
                client, _ = self._server.accept()
                client.settimeout(1.0)
                if len(self._clients) < MAX_PEERS:
                    self._clients.append(client)
                else:
                    client.close()
                continue
            try:
                got = source.recv(LONGEST)
            except OSError:
                got = b""
            if not got:
                self._drop(source)
            data += got
        return data

    def write(self, data: bytes) -> None:
        """Send to every client."""
        for client in list(self._clients):
            try:
                client.sendall(data)
            except OSError:
                self._drop(client)

    def _drop(self, client: socket.socket) -> None:
        with contextlib.suppress(ValueError):
            self._clients.remove(client)
        client.close()

    def close(self) -> None:
        """Free all sockets."""
        for client in list(self._clients):
            self._drop(client)
        self._server.close()


PORTS: dict[str, Callable[[LinkSpec], Port]] = {
    "serial": SerialPort,
    "udpin": UdpPort,
    "udpout": UdpPort,
    "tcp": TcpPort,
    "tcpin": TcpServerPort,
}
"""Kind of link to its port. The next kind is one class and one line."""


class Link:
    """A port that is opened again whenever it fails, with a reading and a writing thread.

    ``on_data(data, monotonic_ns)`` is called in the reading thread for whatever comes.
    """

    def __init__(self, spec: LinkSpec, on_data: Callable[[bytes, int], None]) -> None:
        self.spec = spec
        self._on_data = on_data
        self._stop = threading.Event()
        self._wake = threading.Condition()
        self._waiting: deque[bytes] = deque(maxlen=QUEUE)
        self._port: Port | None = None
        self._threads: list[threading.Thread] = []
        self.opened = 0  # how many times
        self.sent_bytes = 0
        self.received_bytes = 0
        self.last_error = ""

    @property
    def is_up(self) -> bool:
        """True while the port is open."""
        return self._port is not None

    def start(self) -> None:
        """Start both threads."""
        for target in (self._read, self._write):
            thread = threading.Thread(
                target=target, name=f"mavlink {self.spec.name} {target.__name__}", daemon=True
            )
            self._threads.append(thread)
            thread.start()

    def stop(self) -> None:
        """Send what waits, close the port and end both threads."""
        deadline = time.monotonic() + 0.5
        while self._waiting and self.is_up and time.monotonic() < deadline:
            time.sleep(0.01)
        self._stop.set()
        with self._wake:
            self._wake.notify_all()
        for thread in self._threads:
            thread.join(timeout=5.0)

    def write(self, data: bytes) -> None:
        """Send or queue data; never waits. The oldest give way on a link that takes nothing."""
        port = self._port
        if port is not None and port.is_quick:
            port.write(data)
            self.sent_bytes += len(data)
            return
        with self._wake:
            self._waiting.append(data)
            while self._port is None and len(self._waiting) > KEPT_WHILE_DOWN:
                self._waiting.popleft()
            self._wake.notify()

    def _read(self) -> None:
        pause_s = BACKOFF_S[0]
        while not self._stop.is_set():
            try:
                port = PORTS[self.spec.kind](self.spec)
            except (OSError, ValueError) as error:
                self._complain(error)
                self._stop.wait(pause_s)
                pause_s = min(BACKOFF_S[1], 2.0 * pause_s)
                continue
            pause_s = BACKOFF_S[0]
            self._serve(port)
            self._stop.wait(pause_s)

    def _serve(self, port: Port) -> None:
        self.opened += 1
        self.last_error = ""
        log.info("link %s is open", self.spec.name)
        with self._wake:
            self._port = port
            self._wake.notify_all()
        try:
            while not self._stop.is_set() and self._port is port:
                data = port.read()
                if data:
                    now_ns = time.monotonic_ns()
                    self.received_bytes += len(data)
                    self._on_data(data, now_ns)
        except OSError as error:
            self._complain(error)
        finally:
            with self._wake:
                self._port = None
            with contextlib.suppress(OSError):
                port.close()

    def _complain(self, error: Exception) -> None:
        text = str(error) or type(error).__name__
        if text != self.last_error:
            log.warning("link %s: %s; trying again", self.spec.name, text)
        self.last_error = text

    def _write(self) -> None:
        while not self._stop.is_set():
            with self._wake:
                while not self._stop.is_set() and not (self._waiting and self._port):
                    self._wake.wait(0.5)
                if self._stop.is_set():
                    return
                port, data = self._port, self._waiting.popleft()
            if port is None:
                continue
            try:
                port.write(data)
                self.sent_bytes += len(data)
            except OSError as error:
                self._complain(error)
                with self._wake:
                    if self._port is port:
                        self._port = None  # the reading thread opens it again
