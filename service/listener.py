"""A listening socket with limits against exhaustion.

Descriptors are shared by the whole process: thousands of connections to a web page would stop
the datalink too. So a listener has a limit in total and one per address, and a connection that
waits too long for its request is closed. At a limit the connection that has waited longest is
closed, so that half-open connections lock no operator out. uvicorn's limit counts requests of all
addresses together and answers what exceeds it, so one address can take them all.
"""

from __future__ import annotations

import contextlib
import ipaddress
import logging
import re
import resource
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from service.errors import InputError

log = logging.getLogger(__name__)

Peer = tuple[str, int]  # address and port at the other end
DESCRIPTORS = 8192  # descriptors that a service requests; its systemd unit has the same number


@dataclass(frozen=True, slots=True)
class ListenerLimits:
    """Limits of open connections and of the wait for a request."""

    total: int = 256
    per_address: int = 32  # IPv6: per /64 network
    wait_s: float = 10.0  # for a TLS handshake and a request's whole header

    def __post_init__(self) -> None:
        if not 0 < self.per_address <= self.total or self.wait_s <= 0:
            raise ValueError("listener: 0 < per_address <= total and wait_s > 0 must hold")


@dataclass(slots=True, eq=False)
class _Connection:
    socket: socket.socket
    network: str
    waits_since: float  # monotonic
    is_busy: bool = False  # serves a request or a WebSocket

    def end(self) -> None:
        """Make its owner, which reads from it, close it."""
        with contextlib.suppress(OSError):
            self.socket.shutdown(socket.SHUT_RDWR)


class BoundedListener(socket.socket):
    """A listening TCP socket with limits. Use from one thread. Raises OSError when HOST:PORT is not
    available."""

    def __init__(
        self,
        host: str,
        port: int,
        limits: ListenerLimits | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        both = host == "::" and socket.has_dualstack_ipv6()
        opened = socket.create_server((host, port), family=family, dualstack_ipv6=both)
        super().__init__(fileno=opened.detach())
        self._limits = limits or ListenerLimits()
        self._clock = clock
        self._open: dict[Peer, _Connection] = {}

    def accept(self) -> tuple[socket.socket, Any]:
        """The next connection; ConnectionAbortedError for one over the limits."""
        connection, address = super().accept()
        self._forget_closed()
        network = network_of(address[0])
        if not self._make_room(network):
            connection.close()
            raise ConnectionAbortedError(f"too many connections from {network}")
        self._open[address[:2]] = _Connection(connection, network, self._clock())
        return connection, address

    def begin(self, peer: Peer | None) -> None:
        if peer is not None and (found := self._open.get(peer)):
            found.is_busy = True

    def end(self, peer: Peer | None) -> None:
        if peer is not None and (found := self._open.get(peer)):
            found.is_busy, found.waits_since = False, self._clock()

    def drop(self, peer: Peer | None) -> None:
        if peer is not None and (found := self._open.pop(peer, None)):
            found.end()

    def sweep(self) -> None:
        """Close connections that have waited too long; call it about once a second."""
        self._forget_closed()
        latest = self._clock() - self._limits.wait_s
        for peer, connection in list(self._open.items()):
            if not connection.is_busy and connection.waits_since <= latest:
                self.drop(peer)

    def _make_room(self, network: str) -> bool:
        """Whether one more connection of ``network`` fits, possibly replacing a waiting one."""
        same = [peer for peer, found in self._open.items() if found.network == network]
        if len(same) >= self._limits.per_address:
            return self._drop_longest_waiting(same)
        if len(self._open) >= self._limits.total:
            return self._drop_longest_waiting(list(self._open))
        return True

    def _drop_longest_waiting(self, peers: list[Peer]) -> bool:
        waiting = [peer for peer in peers if not self._open[peer].is_busy]
        if not waiting:
            return False
        self.drop(min(waiting, key=lambda peer: self._open[peer].waits_since))
        return True

    def _forget_closed(self) -> None:
        for peer in [peer for peer, found in self._open.items() if found.socket.fileno() < 0]:
            del self._open[peer]


def network_of(host: str) -> str:
    """The unit of the per-address limit: an IPv4 address, or the /64 network of an IPv6 address."""
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return host
    if isinstance(address, ipaddress.IPv4Address):
        return host
    if address.ipv4_mapped is not None:
        return str(address.ipv4_mapped)
    return str(ipaddress.ip_network((int(address) >> 64 << 64, 64)))


def is_loopback(host: str) -> bool:
    """True when only this machine can reach ``host``."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def parse_address(text: str, what: str) -> tuple[str, int]:
    """(host, port) of ``HOST:PORT``, the value of ``what``; InputError for anything else."""
    host, _, port = text.rpartition(":")
    if not host or not (port.isascii() and port.isdigit() and int(port) < 65536):
        raise InputError(f"{what} {text!r}: give HOST:PORT, such as 127.0.0.1:8080")
    return host.strip("[]"), int(port)


def host_name(header: str) -> str:
    """The name or address in a ``Host`` header, without port and brackets."""
    found = re.fullmatch(r"\[([^\]]*)\](?::\d*)?|([^:\[\]]*)(?::\d*)?", header.strip())
    return "" if found is None else (found[1] or found[2] or "").lower()


def fitting(limits: ListenerLimits, share: int) -> ListenerLimits:
    """``limits``, but at most one connection for every ``share`` descriptors of this process."""
    total = max(1, min(limits.total, raise_descriptor_limit() // share))
    if total < limits.total:
        log.warning("few descriptors: a port takes %d connections; raise ulimit -n", total)
    return replace(limits, total=total, per_address=min(limits.per_address, total))


def raise_descriptor_limit(wanted: int = DESCRIPTORS) -> int:
    """Let this process open ``wanted`` descriptors, or as many as allowed; returns the limit."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    target = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
    if soft >= target:
        return soft
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (target, hard))
    except (OSError, ValueError) as error:
        log.warning("only %d descriptors may be open (%s)", soft, error)
        return soft
    return target


def free_ports(count: int, kind: socket.SocketKind = socket.SOCK_STREAM) -> list[int]:
    """So many TCP or UDP ports of this machine that nothing uses, all of them different."""
    with contextlib.ExitStack() as open_now:
        probes = [open_now.enter_context(socket.socket(socket.AF_INET, kind)) for _ in range(count)]
        for probe in probes:
            probe.bind(("127.0.0.1", 0))
        return [int(probe.getsockname()[1]) for probe in probes]
