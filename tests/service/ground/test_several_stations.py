"""Several ground stations, with keys and without: each receives the whole scan."""

from __future__ import annotations

import socket
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loopback import free_port, until

from service.commands.ground import GroundOptions
from service.config import DatalinkConfig
from service.errors import InputError
from service.ground.receiver import Receiver
from service.stream.keys import make_keys, tls_files
from service.stream.link import DatalinkSender
from service.stream.messages import Ask, Held
from service.stream.outbox import Outbox, Outgoing
from service.stream.ranges import RangeSet
from service.stream.records import PoseRecord, ScanHeader
from service.stream.store import ScanStore

pytest.importorskip("cryptography")
pytest.importorskip("zenoh")


class StationsAndDrones:
    """Drones and stations of one fleet, with keys or without; all end with the ``exit_stack``."""

    def __init__(self, folder: Path, exit_stack: ExitStack, has_keys: bool) -> None:
        self.folder, self._exit_stack, self._has_keys = folder, exit_stack, has_keys
        if has_keys:
            members = {"drone": ["red", "blue"], "ground": ["base", "van", "hub"]}
            make_keys(folder / "fleet", members)

    def endpoint(self) -> str:
        protocol = "tls" if self._has_keys else "tcp"
        return f"{protocol}/127.0.0.1:{free_port(socket.SOCK_STREAM)}"

    def tls(self, member: str) -> dict[str, Any]:
        if not self._has_keys:
            return {}
        names = ("tls_ca", "tls_certificate", "tls_key")
        return dict(zip(names, tls_files(self.folder / "fleet" / member), strict=True))

    def station(
        self, name: str, listen: Sequence[str] = (), connect: Sequence[str] = ()
    ) -> Receiver:
        keys = self.folder / "fleet" / "ground" / name if self._has_keys else None
        options = GroundOptions(
            listen=list(listen),
            connect=list(connect),
            store=self.folder / name,
            keys=keys,
            sites=False,
        )
        station = Receiver(replace(options.receiver(), name=name), deliver=lambda _: None)
        station.start()
        self._exit_stack.callback(station.close)
        return station

    def drone(
        self, name: str, connect: tuple[str, ...] = (), listen: tuple[str, ...] = ()
    ) -> DatalinkSender:
        store = ScanStore.create(self.folder / f"{name}.db", ScanHeader("scan-1", name, 1))
        for k in range(50):
            store.add_pose(PoseRecord(1000 * k, np.eye(4), np.eye(6), keyframe_seq=k))
        store.finish({})
        config = DatalinkConfig(connect, listen, 20_000.0, **self.tls(f"drone/{name}"))
        link = DatalinkSender(store, config)
        self._exit_stack.callback(store.close)
        self._exit_stack.callback(link.close)
        return link


@pytest.fixture(params=[True, False], ids=["keys", "plain"])
def fleet(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[StationsAndDrones]:
    with ExitStack() as exit_stack:
        yield StationsAndDrones(tmp_path, exit_stack, request.param)


def complete(station: Receiver) -> list[str]:
    return sorted(entry["drone"] for entry in station.progress() if entry["complete"])


def test_a_drone_with_two_stations_delivers_to_both_and_carries_nothing_between_them(
    fleet: StationsAndDrones,
) -> None:
    at_base, at_van, missing = (fleet.endpoint() for _ in range(3))
    base, van = fleet.station("base", [at_base]), fleet.station("van", [at_van])
    fleet.drone("red", connect=(missing, at_base, at_van))  # one that is not there changes nothing
    fleet.drone("blue", connect=(at_van,))
    until(lambda: complete(van) == ["blue", "red"] and "red" in complete(base))
    assert [entry["drone"] for entry in base.progress()] == ["red"]


def test_stations_that_join_another_receive_what_it_does(fleet: StationsAndDrones) -> None:
    endpoint = fleet.endpoint()
    stations = [fleet.station("hub", [endpoint])]
    stations += [fleet.station(name, connect=[endpoint]) for name in ("base", "van")]
    fleet.drone("red", connect=(endpoint,))
    until(lambda: all(complete(station) == ["red"] for station in stations))


def test_what_keys_do_not_allow_is_refused_in_one_line(
    fleet: StationsAndDrones, request: pytest.FixtureRequest
) -> None:
    endpoint, other = fleet.endpoint(), fleet.endpoint()
    if "keys" in request.node.callspec.id:
        with pytest.raises(InputError, match="listens or joins"):
            fleet.station("base", [endpoint], [other])
        with pytest.raises(InputError, match=r"an aircraft's key cannot serve.*datalink\.connect"):
            fleet.drone("red", listen=(endpoint,))
        return
    fleet.drone("red", listen=(endpoint,))
    base = fleet.station("base", connect=[endpoint])
    until(lambda: complete(base) == ["red"])


def sent(outbox: Outbox, sessions: int, now: float) -> list[Outgoing]:
    """What the outbox sends within a second, each message with its time."""
    out, end = [], now + 1.0
    while now < end:
        todo = outbox.next(now, sessions)
        if isinstance(todo, Outgoing):
            out.append(todo)
        else:
            now += min(todo, 0.01)
    return out


def test_the_budget_counts_a_live_message_once_for_each_session(tmp_path: Path) -> None:
    payloads = []
    for sessions in (1, 2):
        with ScanStore.create(tmp_path / f"{sessions}.db", ScanHeader("scan-1", "red", 1)) as store:
            outbox = Outbox(20_000.0, 0.0)
            outbox.add(store, 0.0)
            outbox.on_held("scan-1", "base", Held({}, 0), 0.0)
            for k in range(60):
                store.add_pose(PoseRecord(1000 * k, np.eye(4), np.eye(6), keyframe_seq=k))
                outbox.on_item("scan-1", "pose", k, 0.0)
            messages = [m for m in sent(outbox, sessions, 0.0) if m.token is None]
            payloads.append(sum(len(m.payload) for m in messages))
    assert payloads[1] == pytest.approx(payloads[0] / 2, rel=0.15)


def test_what_another_station_requested_does_not_count_as_lost(tmp_path: Path) -> None:
    with ScanStore.create(tmp_path / "scan.db", ScanHeader("scan-1", "red", 1)) as store:
        for k in range(300):
            store.add_pose(PoseRecord(1000 * k, np.eye(4), np.eye(6), keyframe_seq=k))
        outbox = Outbox(20_000.0, 0.0)
        outbox.add(store, 0.0)
        received = {"base": 0, "van": 0}
        for turn in range(6):
            now = 1.0 * turn
            for k, peer in enumerate(received):
                outbox.on_held("scan-1", peer, Held({}, received[peer]), now)
                first = 50 * turn + 25 * k
                numbers = RangeSet([(first, first + 24)])
                outbox.on_ask("scan-1", "pose", numbers, Ask(peer), f"request of {peer}", now)
            for message in sent(outbox, 2, now):
                if message.token is not None:
                    received[message.token.removeprefix("request of ")] += len(message.payload)
        assert min(received.values()) > 10_000
        assert outbox.bucket.rate_bytes_s == 20_000.0
