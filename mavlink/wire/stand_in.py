"""Heartbeats from a process of its own where ours are late.

Our threads share the interpreter's lock, and who holds it may wait for a core or load a library for
longer than a heartbeat may be late. The other process gets the next heartbeats ahead, packed, with
the open ports, and sends those whose time comes before newer ones replace them: so few that a
service that hangs falls silent. It runs this file, imports little, and ends with us.
"""

from __future__ import annotations

import contextlib
import marshal
import os
import select
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence

Way = tuple[int, tuple[str, int] | None]  # a port's descriptor, and the address of a datagram
Beat = tuple[float, list[tuple[Way, bytes]]]
"""When to send, in monotonic seconds, and what on which way."""

AFTER_S = (1.05, 2.05, 3.05)
"""After a heartbeat of ours, those of the other process are due so late."""
NICE = -10  # needs LimitNICE or root, otherwise the priority stays normal; real time needs more
MAX_BYTES, MAX_PORTS = 1 << 16, 64
CLOSE_S = 2.0


class StandIn:
    """The process, until :meth:`close`. Use from one thread. Where it cannot start, or ends,
    heartbeats are ours alone, and the log says so."""

    def __init__(self, python: str = sys.executable) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._channel, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._channel.setblocking(False)
        with other:
            try:
                self._process = subprocess.Popen(
                    [python, "-IS", __file__, str(other.fileno())],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    pass_fds=[other.fileno()],
                    start_new_session=True,
                )
            except OSError as error:
                _warn(f"does not start: {error}")

    def plan(self, beats: Sequence[Beat], ways: Callable[[], Sequence[Way]]) -> None:
        """Have these sent, in place of those planned before, on those of their ways that ``ways``
        still gives: the number of a port that was closed may be another file's by now."""
        copies: dict[int, int] = {}  # of ports: they stay what they are
        with contextlib.ExitStack() as held:
            for port in sorted({way[0] for _, sent in beats for way, _ in sent})[:MAX_PORTS]:
                with contextlib.suppress(OSError):  # it was closed
                    copies[port] = os.dup(port)
                    held.callback(os.close, copies[port])
            ports = [port for port, _ in ways() if port in copies]
            places = {port: place for place, port in enumerate(dict.fromkeys(ports))}
            text = marshal.dumps([
                (due_s, [(places[port], to, data) for (port, to), data in sent if port in places])
                for due_s, sent in beats
            ])  # fmt: skip
            try:
                socket.send_fds(self._channel, [text], [copies[port] for port in places])
            except OSError:
                self._look()

    def _look(self) -> None:
        """Say it once where the process has ended."""
        if self._process is not None and self._process.poll() is not None:
            _warn(f"has ended with {self._process.returncode}")
            self._process = None

    def sent(self) -> int:
        """How many heartbeats it has sent since the last call."""
        count = 0
        with contextlib.suppress(OSError):
            while self._channel.recv(1):
                count += 1
        return count

    def close(self) -> None:
        self._channel.close()
        process, self._process = self._process, None
        if process is None:
            return
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(CLOSE_S)
        process.kill()  # one that a port or a debugger holds; without effect on one that has ended
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(CLOSE_S)


def _warn(text: str) -> None:
    import logging  # the process itself needs none

    logging.getLogger(__name__).warning("the process for heartbeats that are late %s", text)


def serve(channel: socket.socket) -> None:
    """Send what is planned until the other end closes."""
    beats: list[tuple[float, list[tuple[int, tuple[str, int] | None, bytes]]]] = []
    ports: list[int] = []
    while True:
        wait_s = max(0.0, beats[0][0] - time.monotonic()) if beats else None
        if select.select([channel], [], [], wait_s)[0]:
            try:
                text, received, _, _ = socket.recv_fds(channel, MAX_BYTES, MAX_PORTS)
            except ConnectionResetError:  # it closed before it read all that we sent
                return
            _close(ports)
            if not text:
                return
            beats, ports = marshal.loads(text), received
            continue
        for place, to, data in beats.pop(0)[1]:
            with contextlib.suppress(OSError):
                _send(ports[place], to, data)
        with contextlib.suppress(OSError):
            channel.send(b"1")
        if not beats:  # nothing holds a port for a service that is silent
            _close(ports)


def _close(ports: list[int]) -> None:
    while ports:
        os.close(ports.pop())


def _send(port: int, to: tuple[str, int] | None, data: bytes) -> None:
    if to is None:
        os.write(port, data)
        return
    sender = socket.socket(fileno=port)
    try:
        sender.sendto(data, to)
    finally:
        sender.detach()


if __name__ == "__main__":
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, NICE)
    with contextlib.suppress(OSError, AttributeError):  # AttributeError: not Linux
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    serve(socket.socket(fileno=int(sys.argv[1])))
