"""Drone and ground protocols joined in memory over a bad link, in a time of the test's own."""

from __future__ import annotations

import heapq
import itertools
import json
import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.types import DepthMap, Keyframe, Pose
from service.errors import OutsideError
from service.ground.intake import FINE, SMALL, ScanIntake
from service.stream import codec
from service.stream.budget import RateEstimate, TokenBucket, wire_bytes
from service.stream.database import Database
from service.stream.messages import (
    Ask,
    Assembler,
    Head,
    Held,
    pack,
    parse,
    split,
    unpack,
)
from service.stream.outbox import COARSE, POSE, STATUS, Outbox, Outgoing
from service.stream.outbox import FINE as LIVE_FINE
from service.stream.ranges import RangeSet
from service.stream.records import PoseRecord, Repose, ScanHeader
from service.stream.store import ScanStore

RATE = 20_000.0


def layers_of(seq: int) -> tuple[bytes, ...]:
    rng = np.random.default_rng(seq)
    w, h = 160, 90
    depth = DepthMap(
        rng.uniform(40, 60, (h, w)).astype(np.float32),
        np.full((h, w), 0.1, np.float32),
        np.full((h, w), 3, np.uint8),
        np.array([[130.0, 0, 79.5], [0, 130.0, 44.5], [0, 0, 1]]),
        np.eye(4),
    )
    bgr = np.full((h, w, 3), 90, np.uint8)
    frame = Keyframe(seq, 0, depth, bgr, Pose(np.eye(4), np.eye(6)), np.ones((h, w), bool))
    return codec.encode(frame, seq)


LAYERS = [layers_of(seq) for seq in range(12)]


@dataclass
class World:
    """One drone, one ground, and a link that delays, loses and is cut."""

    folder: Path
    loss: float = 0.0
    cut: tuple[float, float] = (0.0, 0.0)
    delay_s: float = 0.1
    rate: float = RATE
    now: float = 0.0
    sent: list[tuple[float, Outgoing]] = field(default_factory=list)

    def __post_init__(self) -> None:
        header = ScanHeader("scan", "drone", 1)
        self.onboard = ScanStore.create(self.folder / "a.db", header)
        self.store = ScanStore.create(self.folder / "g.db", ScanHeader("scan", "drone", 0))
        self.outbox = Outbox(self.rate, 0.0)
        self.outbox.add(self.onboard, 0.0)
        self.onboard.listen(
            lambda kind, number: self.outbox.on_item("scan", kind, number, self.now)
        )
        self.ground = ScanIntake(self.store, "base")
        self._random = random.Random(1)
        self._air: list[tuple[float, int, Callable[[], object]]] = []
        self._count = itertools.count()
        self._tokens: dict[int, tuple[int, int]] = {}

    def carry(self, what: Callable[[], object]) -> None:
        """Have something happen at the other end, unless the link loses it."""
        if self.cut[0] <= self.now < self.cut[1] or self._random.random() < self.loss:
            return
        heapq.heappush(self._air, (self.now + self.delay_s, next(self._count), what))

    def _later(self, call: Callable[..., object], *arguments: object) -> Callable[[], object]:
        """The call with the time at which it happens as its last argument."""
        return lambda: call(*arguments, self.now)

    def run(self, seconds: float) -> None:
        """Let time pass."""
        end = self.now + seconds
        while self.now < end:
            while self._air and self._air[0][0] <= self.now:
                heapq.heappop(self._air)[2]()
            self._drone()
            if round(self.now * 100) % 100 == 0:
                report = unpack(pack(self.ground.held()), Held)
                assert report is not None
                self.carry(self._later(self.outbox.on_held, "scan", "base", report))
            for slot in (SMALL, FINE):
                self._ask(slot)
            self.now = round(self.now + 0.01, 2)

    def _drone(self) -> None:
        while isinstance(message := self.outbox.next(self.now), Outgoing):
            self.sent.append((self.now, message))
            if message.topic == "head":
                head = unpack(message.payload, Head)
                assert head is not None
                self.carry(self._later(self.ground.on_head, head))
            else:
                self.carry(self._later(self.ground.on_items, message.payload))
            if message.last and isinstance(message.token, int):
                slot, serial = self._tokens[message.token]
                self.carry(self._later(self.ground.answered, slot, serial))

    def _ask(self, slot: int) -> None:
        wanted = self.ground.next_ask(slot, self.now)
        if wanted is None:
            return
        kind, numbers, ask = wanted
        again = unpack(pack(ask), Ask)
        assert again is not None
        token = next(self._count)
        self._tokens[token] = slot, self.ground.asked
        self.carry(self._later(self.outbox.on_ask, "scan", kind, numbers, again, token))

    def produce(self, first: int, last: int) -> None:
        for seq in range(first, last):
            self.onboard.add_keyframe(seq, LAYERS[seq])
            self.onboard.add_pose(PoseRecord(seq, np.eye(4), np.eye(6)))

    def busiest_second(self) -> float:
        window: deque[tuple[float, int]] = deque()
        held = most = 0
        for at, message in self.sent:
            size = wire_bytes(len(message.payload))
            window.append((at, size))
            held += size
            while window[0][0] <= at - 1.0:
                held -= window.popleft()[1]
            most = max(most, held)
        return most


@pytest.mark.parametrize(
    ("loss", "cut"),
    [(0.0, (0.0, 0.0)), (0.1, (4.0, 24.0)), pytest.param(0.25, (0.0, 9.0), marks=pytest.mark.slow)],
)
def test_everything_arrives_over_a_bad_link_and_within_the_budget(
    tmp_path: Path, loss: float, cut: tuple[float, float]
) -> None:
    world = World(tmp_path, loss, cut)
    for k in range(12):
        world.produce(k, k + 1)
        world.run(0.7)
    world.onboard.add_reposes([Repose(3, 1, np.eye(4), 1.0, np.eye(6))])
    world.onboard.finish({"points": 1})
    for _ in range(40):
        world.run(5.0)
        if world.outbox.complete("scan"):
            break
    assert world.ground.complete
    assert world.store.numbers() == world.onboard.numbers()
    assert world.store.summary == {"points": 1}
    assert world.busiest_second() <= 1.05 * RATE
    if loss == 0.0:
        assert world.ground.duplicates == 0


def test_live_order_is_status_pose_coarse_fine_newest_first(tmp_path: Path) -> None:
    world = World(tmp_path)
    world.run(2.5)  # the ground has reported, so somebody listens
    world.sent.clear()
    world.produce(0, 3)
    world.run(8.0)
    items = [m for _, m in world.sent if m.token is None]
    lanes = [m.lane for m in items if m.lane in (POSE, COARSE, LIVE_FINE)]
    assert lanes == sorted(lanes)
    coarse = [m.topic for m in items if m.lane == COARSE]
    assert list(dict.fromkeys(coarse)) == ["item/k0/2", "item/k0/1", "item/k0/0"]
    assert any(m.lane == STATUS for m in items)


def test_new_coarse_layers_overtake_waiting_detail(tmp_path: Path) -> None:
    world = World(tmp_path, rate=4000.0)
    world.run(2.5)
    world.produce(0, 2)
    world.run(5.0)
    assert world.sent[-1][1].topic.startswith("item/k1")
    world.sent.clear()
    world.produce(2, 3)
    world.run(2.0)
    first = next(m for _, m in world.sent if m.topic.startswith("item/k"))
    assert first.topic == "item/k0/2"


def test_nothing_but_heads_is_sent_while_nothing_listens(tmp_path: Path) -> None:
    world = World(tmp_path, cut=(0.0, 60.0))
    world.produce(0, 4)
    world.run(20.0)
    assert world.sent and all(m.topic == "head" for _, m in world.sent)


def test_a_station_that_is_back_gets_the_newest_coarse_layers_at_once(tmp_path: Path) -> None:
    world = World(tmp_path)
    world.produce(0, 2)
    world.run(4.0)
    world.cut = (world.now, world.now + 20.0)
    world.run(9.0)
    world.produce(2, 12)
    world.run(11.0)
    world.outbox.reconnected(world.now)
    began = world.now
    world.run(4.0)
    ended: dict[str, float] = {}  # in the order in which they began
    for at, message in world.sent:
        if at >= began and "/k" in message.topic:
            ended[message.topic] = at
    assert list(ended)[:10] == [f"item/k0/{seq}" for seq in range(11, 1, -1)]
    assert ended["item/k0/2"] - began < 3.0
    assert world.ground.duplicates == 0


def test_detail_that_does_not_fit_waits_on_disk(tmp_path: Path) -> None:
    world = World(tmp_path, rate=2000.0)
    world.run(2.5)
    world.produce(0, 12)
    world.run(6.0)
    assert len(world.store.numbers().get("k1", RangeSet())) < 12
    assert len(world.onboard.numbers()["k1"]) == 12
    assert len(world.store.numbers().get("k0", RangeSet())) > 0


@pytest.mark.parametrize("rate_bytes_s", [1e3, 1e5, 3e5, 1e7])
def test_a_part_fits_into_the_bucket_with_what_carries_it(rate_bytes_s: float) -> None:
    """Its message costs what the bucket holds and no more; or it is the largest part."""
    bucket = TokenBucket(rate_bytes_s, 0.0)
    part = bucket.part_bytes
    assert wire_bytes(part) <= bucket.depth_bytes
    assert part == 16_384 or wire_bytes(part) > 0.95 * bucket.depth_bytes
    # A header of TCP/IP for each begun segment of 1,400 bytes.
    assert [wire_bytes(size) - size for size in (1, 1320, 1321)] == [132, 132, 184]


def test_a_missing_part_is_asked_for_alone(tmp_path: Path) -> None:
    world = World(tmp_path)
    world.produce(0, 1)
    record = world.onboard.record("k1", 0)
    assert record is not None
    parts = split("k1", 0, record, world.outbox.bucket.part_bytes)
    assert len(parts) > 2
    world.ground.on_head(Head(world.onboard.numbers()), 0.0)
    for part in parts[:1] + parts[2:]:
        world.ground.on_items(part.pack(), 0.1)
    wanted = world.ground.next_ask(FINE, 5.0)
    assert wanted is not None
    assert (wanted[0], list(wanted[1])) == ("k1", [0])
    assert wanted[2].parts is not None and list(wanted[2].parts) == [1]
    world.outbox.on_ask("scan", "k1", wanted[1], wanted[2], 7, 5.0)
    answers: list[Outgoing] = []
    now = 5.0
    while not answers or not answers[-1].last:
        message = world.outbox.next(now)
        now += 0.05
        if isinstance(message, Outgoing) and message.token == 7:
            answers.append(message)
    assert [part.index for m in answers for part in parse(m.payload)] == [1]


def test_a_full_disk_at_the_ground_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = World(tmp_path)
    world.produce(0, 1)
    record = world.onboard.record("k0", 0)
    assert record is not None
    part = split("k0", 0, record, len(record))[0].pack()
    world.ground.on_head(Head(world.onboard.numbers()), 0.0)
    full = OutsideError("disk full")

    def refuse(*_: object) -> int:
        raise full

    with monkeypatch.context() as patch:
        patch.setattr(Database, "write", refuse)
        with pytest.raises(OutsideError):
            world.ground.on_items(part, 0.1)
    assert 0 in world.ground.missing()["k0"]
    assert world.ground.on_items(part, 0.2)
    assert 0 not in world.ground.missing().get("k0", RangeSet())


def test_a_full_disk_onboard_is_said_and_leaves_the_store_sound(tmp_path: Path) -> None:
    with ScanStore.create(tmp_path / "a.db", ScanHeader("s", "d", 1)) as store:
        store.add_keyframe(0, LAYERS[0])
        pages = store.database.one("PRAGMA page_count")
        assert pages is not None
        store.database.one(f"PRAGMA max_page_count = {int(pages[0])}")
        with pytest.raises(OutsideError, match="free some space"):
            for seq in range(1, 12):
                store.add_keyframe(seq, LAYERS[seq])
        kept = store.seqs()
        assert kept == list(store.numbers()["k0"])
    with ScanStore.open(tmp_path / "a.db") as again:
        assert again.seqs() == kept


@given(st.lists(st.tuples(st.floats(0.0, 0.3), st.integers(1, 900)), max_size=80))
def test_the_bucket_never_lets_more_through_than_rate_and_depth(
    steps: list[tuple[float, int]],
) -> None:
    bucket, now, log = TokenBucket(10_000.0, 0.0), 0.0, []
    for pause, size in steps:
        now += pause
        if bucket.ready_in(size, now) == 0.0:
            bucket.take(size, now)
            log.append((now, size))
    for k, (start, _) in enumerate(log):
        for at, _ in log[k:]:
            through = sum(size for t, size in log[k:] if t <= at)
            assert through <= 10_000.0 * (at - start) + bucket.depth_bytes + 900


def test_the_rate_falls_to_what_comes_through_and_climbs_back() -> None:
    estimate = RateEstimate(80_000.0)
    sent = received = now = 0.0
    for _ in range(30):
        now += 1.0
        sent += estimate.rate_bytes_s
        received = min(sent, received + 30_000.0)
        estimate.report(int(sent), int(received), now)
    assert 15_000 < estimate.rate_bytes_s < 45_000
    for _ in range(200):
        now += 1.0
        sent += estimate.rate_bytes_s
        estimate.report(int(sent), int(sent), now)
    assert estimate.rate_bytes_s == 80_000.0


@settings(max_examples=200)
@given(st.binary(max_size=300))
def test_any_bytes_on_the_link_never_raise(data: bytes) -> None:
    assembler = Assembler()
    for message in (data, b"SK\x01" + data):
        for part in parse(message):
            assembler.add(part, 0.0)
    assert unpack(data, Head) is None or isinstance(unpack(data, Head), Head)
    unpack(data, Held)
    unpack(data, Ask)


JSON = st.recursive(
    st.none() | st.integers() | st.text(max_size=3),
    lambda s: st.lists(s, max_size=3) | st.dictionaries(st.text(max_size=8), s, max_size=3),
)


@given(JSON)
def test_any_json_on_the_link_never_raises(value: object) -> None:
    data = json.dumps({"v": 1, "numbers": value, "live": value, "finished": True}).encode()
    unpack(data, Head)
    unpack(data, Held)
    ask = unpack(json.dumps({"v": 1, "peer": value}).encode(), Ask)
    assert ask is None or isinstance(value, str)


def test_unfinished_records_are_bounded() -> None:
    assembler = Assembler()
    for number in range(1000):
        part = split("k1", number, bytes(4000), 2000)[0]
        assembler.add(part, float(number))
    assert sum(assembler.missing_parts("k1", n)[1] > 0 for n in range(1000)) <= 65
    assert assembler.missing_parts("k1", 999) == ([1], 2)
    assert assembler.missing_parts("k1", 0) == ([], 0)


def test_messages_round_trip() -> None:
    ask = unpack(pack(Ask("base", RangeSet([(1, 3)]), 9)), Ask)
    assert ask is not None and ask.parts is not None
    assert (ask.peer, list(ask.parts), ask.parts_of) == ("base", [1, 2, 3], 9)
    held = unpack(pack(Held({"k0": RangeSet([(0, 5)])}, 77)), Held)
    assert held is not None and held.received_bytes == 77 and len(held.numbers["k0"]) == 6
    assert unpack(pack(Head({}, {}, True)), Head) is not None


def test_a_first_depth_shows_a_keyframe_until_its_own_layers_come(tmp_path: Path) -> None:
    world = World(tmp_path, rate=50_000.0)
    world.run(2.5)
    world.onboard.offer_first(5, LAYERS[5][0])
    world.run(0.5)
    assert world.store.states() == {5: (-2, -1)} and world.store.seqs() == []
    shown = world.store.keyframe(5)
    assert shown is not None and shown.depth.depth_m.shape == (45, 80)
    assert not world.onboard.states() and "k0" not in world.store.numbers()
    world.produce(5, 6)
    world.onboard.finish({})
    world.run(5.0)
    whole = world.store.keyframe(5)
    assert world.store.states() == {5: (1, -1)} and world.ground.complete
    assert whole is not None and whole.depth.depth_m.shape == (90, 160)
    assert world.store.numbers() == world.onboard.numbers()
    assert world.ground.unsound == 0


def test_a_first_depth_ends_with_the_next_one_and_with_the_scan(tmp_path: Path) -> None:
    """A view may be refused once all its partners are there."""
    world = World(tmp_path, rate=50_000.0)
    world.run(2.5)
    for seq in (3, 4):
        world.onboard.offer_first(seq, LAYERS[seq][0])
        world.run(0.5)
        assert list(world.store.states()) == [seq]
    world.onboard.finish({})
    world.run(2.0)
    assert world.store.finished and not world.store.states() and world.store.keyframe(4) is None
    world.ground.on_items(split("first", 4, LAYERS[4][0], 9000)[0].pack(), world.now)
    assert not world.store.states()


def test_first_depths_are_not_sent_late_or_over_a_slow_link(tmp_path: Path) -> None:
    world = World(tmp_path, rate=50_000.0)
    world.run(2.5)
    world.onboard.offer_first(1, LAYERS[1][0])
    world.produce(1, 2)  # before a byte of it is sent
    world.outbox.set_rate(RATE, world.now)
    world.onboard.offer_first(2, LAYERS[2][0])
    world.run(3.0)
    assert not [m.topic for _, m in world.sent if "/first/" in m.topic]
    assert list(world.store.states()) == [1]


def test_a_first_depth_of_another_keyframe_or_layer_is_refused(tmp_path: Path) -> None:
    world = World(tmp_path)
    for record in (LAYERS[2][0], LAYERS[1][1], b"junk"):
        world.ground.on_items(split("first", 1, record, 60_000)[0].pack(), 0.0)
    assert not world.store.states() and world.ground.unsound == 3
