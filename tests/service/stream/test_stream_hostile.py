"""Hostile messages on the datalink: nothing in them raises, counts for ever, or is written."""

from __future__ import annotations

import json
import socket
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from loopback import free_port, until

from service.config import DatalinkConfig
from service.stream.link import DatalinkSender
from service.stream.messages import (
    HEAD_BYTES,
    MAX_BYTES,
    MAX_COUNTED,
    Ask,
    Assembler,
    Head,
    Held,
    Part,
    pack,
    parse,
    split_in,
    unpack,
)
from service.stream.outbox import MAX_STATIONS, PEER_TIMEOUT_S, Outbox
from service.stream.ranges import RangeSet
from service.stream.records import PoseRecord, ScanHeader
from service.stream.reports import Reports
from service.stream.session import MAX_MESSAGE_BYTES, SessionConfig, open_session, zenoh_config
from service.stream.store import MAX_HELD_PEERS, ScanStore

if TYPE_CHECKING:
    import zenoh

HEAD = {"v": 1, "numbers": {"k0": [[0, 9]]}, "live": {}, "finished": False}
HELD = {"v": 1, "numbers": {"k0": [[0, 9]]}, "received_bytes": 5}
ASK = {"v": 1, "peer": "base", "parts": [[0, 3]], "parts_of": 8}


def made(document: dict[str, Any], **changes: Any) -> bytes:
    return json.dumps(document | changes).encode()


@pytest.mark.parametrize(
    "changes",
    [
        {"numbers": {"k0": [[0, (1 << 32) - 1]]}},
        {"numbers": {"pose": [[0, MAX_COUNTED + 1]]}},
        {"live": {"repose": [[MAX_COUNTED + 1, MAX_COUNTED + 1]]}},
        {"numbers": {"header": [[1, 2]]}},
        {"numbers": {"summary": [[1, 1], [3, 3]]}},
        {"numbers": {"k0": [[3, 2]]}},
        {"numbers": {"k0": [[-1, 2]]}},
        {"numbers": {"k0": [[0, 10**300]]}},
        {"numbers": {"k0": [[0, 1]] * 4097}},
        {"numbers": {f"x{k}": [] for k in range(65)}},
        {"numbers": {"k0": [[0, 1.5]]}},
        {"v": 2},
    ],
)
def test_a_head_says_only_what_can_be(changes: dict[str, Any]) -> None:
    assert unpack(made(HEAD), Head) is not None
    assert unpack(made(HEAD, **changes), Head) is None


@pytest.mark.parametrize(
    "changes",
    [
        {"received_bytes": -1},
        {"received_bytes": 1 << 60},
        {"received_bytes": 10**400},
        {"numbers": {"k0": [[0, (1 << 32) - 1]]}},
    ],
)
def test_a_report_says_only_what_can_be(changes: dict[str, Any]) -> None:
    assert unpack(made(HELD), Held) is not None
    assert unpack(made(HELD, **changes), Held) is None


@pytest.mark.parametrize(
    "changes",
    [
        {"peer": ""},
        {"peer": "a/b"},
        {"peer": "base\n"},
        {"peer": "x" * 65},
        {"parts": [[0, 65_535]]},
        {"parts_of": 65_536},
        {"parts_of": -1},
    ],
)
def test_a_request_says_only_what_can_be(changes: dict[str, Any]) -> None:
    assert unpack(made(ASK), Ask) is not None
    assert unpack(made(ASK, **changes), Ask) is None


@pytest.mark.parametrize("encoding", ["utf-16", "utf-32", "utf-8-sig"])
def test_json_is_strict_utf_8(encoding: str) -> None:
    assert unpack(json.dumps(HEAD).encode(encoding), Head) is None
    broken = made(HEAD, more="x").replace(b'"x"', b'"\xff"')  # in a field nothing reads
    assert unpack(broken, Head) is None


def test_parts_are_cut_in_one_way_only() -> None:
    whole = split_in("k0", 1, bytes(1000), 3)
    assert [len(part.payload) for part in whole] == [334, 334, 332]
    assert list(parse(b"".join(part.pack() for part in whole))) == whole
    for count, total, index, size in (
        (3, 1000, 0, 333),
        (3, 1000, 2, 334),
        (5, 4, 4, 0),
        (65_535, 1000, 0, 1),
        (2, 0, 0, 0),
    ):
        part = Part("k0", 1, index, count, total, 7, bytes(size))
        assert not list(parse(part.pack())), part
    assert list(parse(Part("k0", 1, 0, 1, 0, 0, b"").pack()))
    assert not list(parse(Part("pose", MAX_COUNTED + 1, 0, 1, 0, 0, b"").pack()))
    assert list(parse(Part("header", MAX_COUNTED + 1, 0, 1, 0, 0, b"").pack()))


def test_small_parts_do_not_take_more_memory_than_they_say() -> None:
    assembler = Assembler(1 << 22)
    for number in range(6):
        for part in split_in("k1", number, bytes(5_000), 5_000)[:-1]:
            assembler.add(part, float(number))
            assert assembler.held_bytes <= 1 << 22
    assert assembler.held_bytes > 1 << 21


@pytest.mark.parametrize("kind", ["header", "summary", "pose", "repose", "k0"])
def test_a_record_is_as_large_as_its_kind_can_be(kind: str) -> None:
    def begins(total: int) -> bool:
        size = -(-total // 16)
        return bool(list(parse(Part(kind, 1, 0, 16, total, 7, bytes(size)).pack())))

    limit = MAX_BYTES.get(kind, 1 << 24)
    assert begins(limit) and not begins(limit + 1)


@pytest.fixture
def onboard(tmp_path: Path) -> ScanStore:
    store = ScanStore.create(tmp_path / "scan.db", ScanHeader("scan", "drone", 1))
    store.add_pose(PoseRecord(1, np.eye(4), np.eye(6)))
    return store


def test_a_drone_serves_few_stations_and_keeps_those_that_listen(onboard: ScanStore) -> None:
    outbox = Outbox(1e6, 0.0)
    outbox.add(onboard, 0.0)
    nothing = Held({})
    assert outbox.on_held("scan", "base", nothing, 0.0)
    served = [outbox.on_held("scan", f"invented-{k}", nothing, 1.0) for k in range(1000)]
    assert sum(served) == MAX_STATIONS - 1
    assert outbox.on_ask("scan", "pose", RangeSet([(1, 1)]), Ask("stranger"), 7, 2.0) == [7]
    assert not outbox.on_ask("scan", "pose", RangeSet([(1, 1)]), Ask("base"), 8, 2.0)
    late = 2.0 + PEER_TIMEOUT_S
    assert outbox.on_held("scan", "base", nothing, late)
    assert outbox.on_held("scan", "newcomer", nothing, late)
    assert outbox.serves("base") and outbox.serves("newcomer")


def test_a_request_for_what_is_no_kind_ends_at_once(onboard: ScanStore) -> None:
    outbox = Outbox(1e6, 0.0)
    outbox.add(onboard, 0.0)
    for kind in ("kx", "nothing", "k9", "poses"):
        assert outbox.on_ask("scan", kind, RangeSet([(1, 1)]), Ask("base"), 7, 0.0) == [7]
    while not isinstance(outbox.next(0.0), float):
        pass


def test_of_many_reports_few_wait_and_a_served_station_is_among_them(onboard: ScanStore) -> None:
    outbox = Outbox(1e6, 0.0)
    outbox.add(onboard, 0.0)
    outbox.on_held("scan", "base", Held({}), 0.0)
    reports = Reports(outbox)
    for k in range(10_000):
        reports.put(f"skyrelief/drone/scan/held/invented-{k}", b"")
        reports.put(f"skyrelief/drone/other-{k}/held/base", b"")
    reports.put("skyrelief/drone/scan/held/base", b"first")
    reports.put("skyrelief/drone/scan/held/base", b"second")
    taken = reports.take(1.0)
    assert len(taken) == MAX_STATIONS + 1
    assert taken[-1] == ("scan", "base", b"second")
    reports.put("skyrelief/drone/scan/held/base", b"third")
    assert not reports.take(1.1) and reports.take(1.3)


def test_the_store_keeps_what_few_stations_hold(onboard: ScanStore) -> None:
    for k in range(30):
        onboard.set_held(f"station-{k}", onboard.numbers())
    assert set(onboard.held()) == {f"station-{k}" for k in range(30 - MAX_HELD_PEERS, 30)}
    onboard.close()


def test_a_flood_of_reports_is_not_written_and_the_real_station_is_served(
    tmp_path: Path,
) -> None:
    pytest.importorskip("zenoh")
    writes: list[str] = []

    class Noting(ScanStore):
        def set_held(self, peer: str, numbers: dict[str, RangeSet]) -> None:
            writes.append(peer)
            super().set_held(peer, numbers)

    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    router = open_session(SessionConfig(mode="router", listen=(endpoint,)))
    store = Noting.create(tmp_path / "scan.db", ScanHeader("scan", "drone", 1))
    for k in range(20):
        store.add_pose(PoseRecord(k, np.eye(4), np.eye(6)))
    store.finish({})
    link = DatalinkSender(store, DatalinkConfig(connect=(endpoint,)))
    some = pack(Held({"pose": RangeSet([(1, 5)])}))
    whole = pack(Held(store.numbers()))
    try:
        until(lambda: _listens(router, link, some))
        for k in range(3000):
            router.put(f"skyrelief/drone/scan/held/invented-{k}", some)
        for kind in ("nothing", "kx"):
            key = f"skyrelief/drone/scan/item/{kind}/1"
            list(router.get(key, payload=pack(Ask("base")), timeout=5.0))
        until(lambda: _complete(router, link, whole))
    finally:
        link.close()
        router.close()
    assert len(writes) <= 3 and writes[-1] == "base"
    assert 1 <= len(store.held()) <= 3
    store.close()


def _listens(session: zenoh.Session, link: DatalinkSender, report: bytes) -> bool:
    session.put("skyrelief/drone/scan/held/base", report)
    return link.progress.listened


def _complete(session: zenoh.Session, link: DatalinkSender, report: bytes) -> bool:
    session.put("skyrelief/drone/scan/held/base", report)
    return link.progress.complete


def test_messages_of_any_size_are_not_put_together() -> None:
    limit = json.loads(zenoh_config(SessionConfig()).get_json("transport/link/rx/max_message_size"))
    assert limit == MAX_MESSAGE_BYTES > HEAD_BYTES


@pytest.mark.parametrize("mode", ["client", "router"])
def test_an_asker_cannot_demand_that_others_wait(mode: str) -> None:
    """Zenoh sends an answer as its query asks: with BLOCK, an asker that reads nothing holds up
    the drone for 5 s. Both ends turn that into DROP as the query arrives."""
    (rule,) = json.loads(zenoh_config(SessionConfig(mode=mode)).get_json("qos/network"))
    assert rule["messages"] == ["query"] and rule["flows"] == ["ingress"]
    assert rule["key_exprs"] is None and rule["interfaces"] is None
    assert rule["overwrite"]["congestion_control"] == "drop"
    assert rule["overwrite"]["priority"] == "background"
