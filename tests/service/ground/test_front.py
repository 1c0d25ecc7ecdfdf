"""The port where drones connect, while strangers hold connections there."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil  # type: ignore[import-untyped]
import pytest
from loopback import free_port, until

from service.config import DatalinkConfig
from service.errors import OutsideError
from service.ground.front import MAX_OF_ADDRESS, Front, behind_fronts
from service.ground.receiver import Receiver, ReceiverConfig
from service.stream.keys import make_keys, tls_files
from service.stream.link import DatalinkSender
from service.stream.records import ScanHeader
from service.stream.session import SessionConfig
from service.stream.store import ScanStore
from service.workers import Workers

pytest.importorskip("cryptography")
pytest.importorskip("zenoh")


@pytest.mark.parametrize("said", [b"", b"no handshake\r\n"], ids=["idle", "malformed"])
def test_strangers_do_not_keep_a_drone_out(
    said: bytes,
    tmp_path: Path,
) -> None:
    make_keys(tmp_path, {"drone": ["red"], "ground": ["base"]})
    port = free_port(socket.SOCK_STREAM)
    endpoint, names = f"tls/127.0.0.1:{port}", ("tls_ca", "tls_certificate", "tls_key")
    keys: list[dict[str, Any]] = [
        dict(zip(names, tls_files(tmp_path / member), strict=True))
        for member in ("ground/base", "drone/red")
    ]
    session = SessionConfig("router", listen=(endpoint,), fleet_rights=True, **keys[0])
    ground = Receiver(ReceiverConfig(tmp_path / "store", session), deliver=lambda _: None)
    with contextlib.ExitStack() as exit_stack:
        ground.start()
        exit_stack.callback(ground.close)
        for _ in range(150):
            source = ("127.0.0.2", 0)
            one = socket.create_connection(("127.0.0.1", port), source_address=source)
            exit_stack.enter_context(one).sendall(said)
        store = exit_stack.enter_context(
            ScanStore.create(tmp_path / "scan.db", ScanHeader("scan-1", "red", 1))
        )
        store.finish({})
        link = DatalinkSender(store, DatalinkConfig(connect=(endpoint,), **keys[1]))
        exit_stack.callback(link.close)
        assert link.drain(8.0)  # Zenoh alone: after 15 s, when malformed


@pytest.fixture
def front() -> Iterator[tuple[Front, int]]:
    """One in service, and its port."""
    port, workers = free_port(socket.SOCK_STREAM), Workers()
    front = Front(f"tcp/127.0.0.1:{port}")
    worker = workers.start("front", front.run)
    yield front, port
    assert worker.join(10.0)
    assert worker.fault == ""


def test_few_of_one_address_are_in_their_handshake(front: tuple[Front, int]) -> None:
    """They wait for one another, and an address with none waits for nobody."""
    address, _, port = front[0].inner.partition("/")[2].partition(":")
    taken: list[socket.socket] = []
    with contextlib.ExitStack() as exit_stack, socket.create_server((address, int(port))) as inner:
        inner.settimeout(0.05)

        def come() -> int:
            with contextlib.suppress(TimeoutError):
                while True:
                    taken.append(exit_stack.enter_context(inner.accept()[0]))
            return len(taken)

        def call(source: str) -> socket.socket:
            where = ("127.0.0.1", front[1])
            one = socket.create_connection(where, timeout=20, source_address=(source, 0))
            one.sendall(b"hello")
            return exit_stack.enter_context(one)

        calls = [call("127.0.0.1") for _ in range(MAX_OF_ADDRESS + 5)]
        until(lambda: come() == MAX_OF_ADDRESS)
        other = call("127.0.0.2")
        until(lambda: come() == MAX_OF_ADDRESS + 1)
        for end in (taken[-1], other, taken[-1], other):  # its handshake, then data both ways
            end.sendall(b"more")
        assert until(lambda: taken[-1].recv(5, socket.MSG_PEEK)) == b"hello"
        assert other.recv(4) == b"more"
        taken.pop(0).close()  # Zenoh refuses one
        until(lambda: come() == MAX_OF_ADDRESS + 1)
        until(lambda: sum(_is_ended(one) for one in calls) == 1)


@pytest.mark.slow
def test_who_takes_no_bytes_and_ends_keeps_no_connection(front: tuple[Front, int]) -> None:
    address, _, port = front[0].inner.partition("/")[2].partition(":")
    with (
        socket.create_server((address, int(port))) as server,
        socket.create_connection(("127.0.0.1", front[1]), timeout=20) as outer,
    ):
        outer.sendall(b"hello")
        inner, _ = server.accept()
        with inner:
            for end, other in ((inner, outer), (outer, inner)):  # with the next it is admitted
                end.sendall(b"reply")
                assert other.recv(5)
            inner.settimeout(1.0)
            with contextlib.suppress(TimeoutError):
                while True:  # until no buffer on the way has room
                    inner.sendall(bytes(1 << 20))
            outer.shutdown(socket.SHUT_WR)
            peer, process = outer.getsockname(), psutil.Process()
            until(lambda: peer not in [one.raddr for one in process.net_connections("tcp4")])


def _is_ended(one: socket.socket) -> bool:
    one.settimeout(0.01)
    try:
        return one.recv(1, socket.MSG_PEEK) == b""
    except TimeoutError:
        return False
    except ConnectionError:
        return True


def test_only_tcp_goes_through_a_front() -> None:
    port = free_port(socket.SOCK_STREAM)
    direct = ("udp/127.0.0.1:7447", f"tcp/127.0.0.1:{port}#iface=lo")
    session, fronts = behind_fronts(SessionConfig(listen=(*direct, f"tcp/127.0.0.1:{port}")))
    assert session.listen == (*direct, fronts[0].inner)
    with pytest.raises(OutsideError, match="another program"):
        behind_fronts(SessionConfig(listen=(f"ws/127.0.0.1:{port}",)))
    fronts[0].close()
