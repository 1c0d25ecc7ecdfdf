"""A listening socket that strangers cannot exhaust."""

from __future__ import annotations

import resource
import socket
import subprocess
import sys

import pytest
from clock import Clock

from service.listener import (
    BoundedListener,
    ListenerLimits,
    free_ports,
    host_name,
    is_loopback,
    network_of,
)


def is_closed(one: socket.socket) -> bool:
    """Whether the other end has closed it; waits a moment for that."""
    one.settimeout(0.2)
    try:
        return one.recv(1) == b""
    except TimeoutError:
        return False
    except ConnectionResetError:
        return True


def connect(listener: BoundedListener, source: str = "127.0.0.1") -> socket.socket:
    one = socket.create_connection(listener.getsockname(), source_address=(source, 0))
    listener.accept()
    return one


def test_who_waits_longest_gives_way_and_who_is_served_does_not() -> None:
    clock = Clock()
    with BoundedListener("127.0.0.1", 0, ListenerLimits(4, 2, 10.0), clock) as listener:
        served = connect(listener)
        listener.begin(served.getsockname())
        clock.now += 1
        first = connect(listener)
        clock.now += 1
        second = connect(listener)
        assert is_closed(first) and not is_closed(second) and not is_closed(served)
        other = connect(listener, "127.0.0.2")
        assert not is_closed(second)
        listener.begin(second.getsockname())
        with pytest.raises(ConnectionAbortedError, match=r"127\.0\.0\.1"):
            connect(listener)
        connect(listener, "127.0.0.3")
        clock.now += 1
        connect(listener, "127.0.0.4")  # the fifth: full in total
        assert is_closed(other) and not is_closed(served) and not is_closed(second)


def test_a_request_that_does_not_come_in_time_is_closed() -> None:
    clock = Clock()
    with BoundedListener("127.0.0.1", 0, ListenerLimits(4, 4, 10.0), clock) as listener:
        waits, served = connect(listener), connect(listener)
        listener.begin(served.getsockname())
        clock.now += 9.9
        listener.sweep()
        assert not is_closed(waits)
        clock.now += 0.1
        listener.sweep()
        assert is_closed(waits) and not is_closed(served)
        listener.end(served.getsockname())
        clock.now += 10
        listener.sweep()
        assert is_closed(served)
        assert not any(map(is_closed, [connect(listener) for _ in range(4)]))  # room for all


def test_a_closed_connection_makes_room() -> None:
    with BoundedListener("127.0.0.1", 0, ListenerLimits(2, 2, 10.0), Clock()) as listener:
        for _ in range(5):
            one = socket.create_connection(listener.getsockname())
            accepted, peer = listener.accept()
            listener.begin(peer)
            accepted.close()
            one.close()
        for _ in range(2):
            listener.begin(connect(listener).getsockname())
        with pytest.raises(ConnectionAbortedError):
            connect(listener)


def test_an_unknown_peer_is_ignored() -> None:
    with BoundedListener("127.0.0.1", 0) as listener:
        for peer in (None, ("10.0.0.1", 5)):
            listener.begin(peer)
            listener.end(peer)
            listener.drop(peer)


@pytest.mark.parametrize(("limits", "wanted"), [((256, 4096), 1000), ((256, 512), 512)])
def test_the_limit_of_descriptors_is_raised_as_far_as_it_may(
    limits: tuple[int, int], wanted: int
) -> None:
    code = "from service.listener import raise_descriptor_limit as r; import resource as s;"
    code += "print(r(1000), s.getrlimit(s.RLIMIT_NOFILE)[0], r(100))"
    done = subprocess.run(
        [sys.executable, "-c", code],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, limits),
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split() == [str(wanted)] * 3


@pytest.mark.parametrize(
    ("host", "loopback"),
    [("localhost", True), ("127.3.2.1", True), ("::1", True), ("10.0.0.1", False), ("x", False)],
)
def test_what_only_this_machine_can_reach(host: str, loopback: bool) -> None:
    assert is_loopback(host) is loopback


@pytest.mark.parametrize(
    ("host", "network"),
    [
        ("10.0.0.1", "10.0.0.1"),
        ("2001:db8:1:2:3:4:5:6", "2001:db8:1:2::/64"),
        ("2001:db8:1:2:ffff::1", "2001:db8:1:2::/64"),
        ("::ffff:10.0.0.1", "10.0.0.1"),
        ("odd", "odd"),
    ],
)
def test_an_ipv6_network_counts_as_one(host: str, network: str) -> None:
    assert network_of(host) == network


@pytest.mark.parametrize(
    ("header", "name"),
    [("a:80", "a"), ("[::1]:80", "::1"), ("[::1]", "::1"), ("B", "b"), ("[", ""), ("a:b:c", "")],
)
def test_the_name_in_a_host_header(header: str, name: str) -> None:
    assert host_name(header) == name


@pytest.mark.parametrize("wrong", [(0, 1, 1.0), (4, 5, 1.0), (4, 4, 0.0)])
def test_nonsense_limits_are_refused(wrong: tuple[int, int, float]) -> None:
    with pytest.raises(ValueError, match="listener"):
        ListenerLimits(*wrong)


def test_free_ports_are_different_ones() -> None:
    assert len(set(free_ports(200, socket.SOCK_DGRAM))) == 200
