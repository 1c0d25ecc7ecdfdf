"""One drone's scans at the ground station, without socket, thread or clock."""

from __future__ import annotations

import os
import tempfile
import zlib
from errno import EIO, ENOENT
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile_records import sound_layers
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from service.ground.drone import (
    REWRITE_S,
    TRANSITIONS,
    Answered,
    Change,
    DroneReceiver,
    Effect,
    Event,
    Files,
    Get,
    Item,
    Opened,
    Put,
    Write,
    Written,
)
from service.ground.storage import DroneLimits
from service.stream import codec
from service.stream.messages import Head, Held, pack, split, unpack
from service.stream.naming import place_of
from service.stream.ranges import RangeSet, ranges_from_text
from service.stream.records import PoseRecord, ScanHeader
from service.stream.store import ScanStore


class Onboard:
    """The scan of a drone, and the ground's side of it."""

    def __init__(self, folder: Path, limits: DroneLimits | None = None) -> None:
        header = ScanHeader("scan-1", "red", 1, run_id="a" * 32)
        self.store = ScanStore.create(folder / "a.db", header)
        self.name = header.name
        self.ground = DroneReceiver("red", folder / "ground", "base", limits or DroneLimits(), 0.0)
        self.now = 0.0
        self.asked: list[Get] = []
        self.writes: list[Write] = []
        self.held: Held | None = None
        self.opened = 0
        self.aligned: list[Path] = []

    def pass_time(self, seconds: float) -> None:
        self.now += seconds
        self._hand_on({}, [])

    def head(self) -> None:
        """The drone says what it has."""
        payload = pack(Head(self.store.numbers(), {}, self.store.finished))
        self._hand_on({self.name: payload}, [])

    def send(self, kind: str, number: int) -> None:
        """A record, in one part."""
        record = self.store.record(kind, number)
        assert record is not None
        (part,) = split(kind, number, record, 1 << 16)
        self._hand_on({}, [Item(self.name, part.pack())])

    def answer(self) -> None:
        """Send what the oldest request asked for, and say that this was all."""
        asked = self.asked.pop(0)
        *_, kind, numbers = asked.key.split("/")
        ranges = ranges_from_text(numbers)
        assert ranges
        for number in ranges:
            self.send(kind, number)
        self.hear(asked.answered)

    def hear(self, *events: Event) -> None:
        self._hand_on({}, list(events))

    def written(self, trouble: str = "", is_due: bool = False) -> None:
        """The oldest writing of files has ended."""
        scan, folder, is_whole = self.writes.pop(0)
        self.aligned += [folder] if is_whole and not trouble else []
        self.hear(Written(scan, trouble, is_due))

    def _hand_on(self, heads: dict[str, bytes], events: list[Event]) -> None:
        for effect in self.ground.handle(heads, events, self.now):
            self._perform(effect)

    def _perform(self, effect: Effect) -> None:
        match effect:
            case Put(key, payload):
                assert place_of(key) == ("red", self.name) and key.endswith("/held/base")
                self.held = unpack(payload, Held)
            case Get():
                self.asked.append(effect)
            case Write():
                assert not self.writes, "one at a time"
                self.writes.append(effect)
            case Opened():
                self.opened += 1

    def finish(self) -> None:
        """The scan ends, and all of it arrives."""
        self.store.finish({"points": 1})
        self.head()
        for _ in range(20):
            self.pass_time(0.5)
            while self.asked:
                self.answer()

    def close(self) -> None:
        self.ground.close(self.now)
        self.store.close()


@pytest.mark.parametrize("trouble", ["", "no cloud"])
def test_a_scan_is_asked_for_written_and_aligned(trouble: str, tmp_path: Path) -> None:
    one = Onboard(tmp_path)
    one.head()
    assert not list(tmp_path.glob("ground/**/scan.db"))  # a folder is made for a header only
    one.answer()
    one.store.add_pose(PoseRecord(1, np.eye(4), np.eye(6)))
    one.finish()
    assert one.opened == 1
    assert one.held is not None and one.held.numbers == one.store.numbers()
    (entry,) = one.ground.entries
    assert entry["finished"] and not entry["complete"]  # its files are not written yet
    one.written(trouble)
    (entry,) = one.ground.entries
    assert entry["complete"] and entry["trouble"] == (trouble or None)
    assert len(one.aligned) == (trouble == "")
    one.pass_time(5.0)
    assert one.writes == []
    one.pass_time(61.0)
    assert one.ground.scans == [] and one.ground.entries[0]["open"] is False
    one.head()  # opens it again
    assert one.ground.scans and one.ground.entries[0]["trouble"] == (trouble or None)
    one.close()


def test_files_that_a_full_disk_refused_are_written_again(tmp_path: Path) -> None:
    one = Onboard(tmp_path)
    one.head()
    one.answer()
    one.finish()
    for _ in range(2):
        one.written("disk full", is_due=True)
        one.pass_time(REWRITE_S - 1.0)
        assert one.writes == [] and one.ground.scans  # it rests, and stays open
        one.head()
        one.pass_time(2.0)
        assert len(one.writes) == 1
    one.written()
    (entry,) = one.ground.entries
    assert entry["complete"] and entry["trouble"] is None and len(one.aligned) == 1
    one.pass_time(REWRITE_S + 10.0)
    assert one.writes == []
    one.close()


def test_a_growing_scan_is_written_when_that_is_asked_for(tmp_path: Path) -> None:
    one = Onboard(tmp_path, DroneLimits(refresh_s=1.0))
    one.head()
    one.answer()
    one.pass_time(1.0)
    assert len(one.writes) == 1 and not one.writes[0].is_whole
    one.pass_time(1.0)
    assert len(one.writes) == 1  # while it is written, it is not written again
    number = one.store.add_pose(PoseRecord(1, np.eye(4), np.eye(6)))
    one.send("pose", number)
    one.written()
    one.pass_time(1.0)
    assert len(one.writes) == 1
    one.written()
    one.pass_time(1.0)
    assert one.writes == []  # it did not grow
    one.close()


@pytest.mark.parametrize(("error", "is_forgotten"), [(ENOENT, True), (EIO, False)])
def test_a_scan_is_forgotten_when_it_was_deleted_not_when_its_disk_is_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: int, is_forgotten: bool
) -> None:
    usage = (1 << 40, 0, 1 << 40)
    one = Onboard(tmp_path, DroneLimits(look_s=0.0, usage=lambda _: usage))
    one.head()
    one.answer()
    (scan,) = one.ground.scans
    hidden = str(scan.intake.store.path if is_forgotten else scan.folder)
    stat = os.stat

    def away(path: Any, **options: Any) -> os.stat_result:
        if str(path).startswith(hidden):
            raise OSError(error, os.strerror(error), str(path))
        return stat(path, **options)

    monkeypatch.setattr(os, "stat", away)
    usage = (1 << 40, 1 << 40, 0)  # full
    one.send("pose", one.store.add_pose(PoseRecord(1, np.eye(4), np.eye(6))))
    assert one.ground.scans == ([] if is_forgotten else [scan])
    monkeypatch.undo()
    if not is_forgotten:
        scan.intake.store.put_header(scan.intake.store.header)  # it is open
    one.close()


def test_a_first_depth_is_no_growth_of_the_files(tmp_path: Path) -> None:
    layer = sound_layers()[0]
    head = codec.peek(layer)
    assert head is not None
    one = Onboard(tmp_path, DroneLimits(refresh_s=1.0))
    one.head()
    one.answer()
    one.pass_time(1.0)
    one.written()
    one.store.offer_first(head.seq, layer)
    one.send("first", head.seq)
    (scan,) = one.ground.scans
    assert list(scan.intake.store.states()) == [head.seq]
    one.pass_time(1.0)
    assert one.writes == []
    one.close()


def test_an_answer_to_a_scan_that_was_closed_is_nothing(tmp_path: Path) -> None:
    one = Onboard(tmp_path)
    one.hear(Answered("never-seen", 0, 1))
    one.head()
    one.answer()
    assert [scan.name for scan in one.ground.scans] == [one.name]
    one.close()


def test_unfinished_records_of_all_scans_of_a_drone_share_one_bound(tmp_path: Path) -> None:
    part = split("k1", 1, bytes(90_000), 60_000)[0].pack()
    ground = DroneReceiver("evil", tmp_path, "base", DroneLimits(unfinished_bytes=100_000), 0.0)
    for k in range(4):
        record = ScanHeader(f"scan-{k}", "evil", 1).to_json()
        number = zlib.crc32(record)
        head = pack(Head({"header": RangeSet.of([number])}))
        ground.handle({f"scan-{k}": head}, [], 0.0)
        (header,) = split("header", number, record, 1 << 16)
        ground.handle({}, [Item(f"scan-{k}", header.pack())], 0.0)
        ground.handle({}, [Item(f"scan-{k}", part)], 0.0)
    ground.handle({}, [], 1.0)
    assert sum(entry["received_bytes"] > 45_000 for entry in ground.entries) == 4
    assert sum(scan.intake.held_bytes for scan in ground.scans) <= 100_000
    ground.close(0.0)


def test_files_follow_what_grew_and_have_a_way_to_be_written() -> None:
    for state in Files:
        reached = {state}
        while more := {f for at in reached for f in TRANSITIONS[at].values()} - reached:
            reached |= more
        assert Files.WRITTEN in reached


@given(st.lists(st.sampled_from(Change)))
def test_files_are_written_only_after_a_writing_that_began_when_all_had_grown(
    changes: list[Change],
) -> None:
    state, is_writing, lacks, is_covered = Files.WRITTEN, False, False, True
    for change in changes:
        if change is Change.GREW:
            lacks, is_covered = True, False  # by the writing that runs
        elif change is Change.BEGIN:
            is_covered = is_covered if is_writing else True
            is_writing = is_writing or lacks
        elif is_writing:
            is_writing = False
            lacks = change is Change.REFUSE or not is_covered
        state = TRANSITIONS[state].get(change, state)
        assert (state is Files.WRITTEN) == (not lacks and not is_writing)
        assert (Change.END in TRANSITIONS[state]) == is_writing


class AnyOrder(RuleBasedStateMachine):
    """Whatever comes, in any order and however often: the scan arrives whole in the end."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = tempfile.TemporaryDirectory()
        self.one = Onboard(Path(self.folder.name))
        self.most: dict[str, int] = {}

    @rule()
    def grow(self) -> None:
        if not self.one.store.finished:
            self.one.store.add_pose(PoseRecord(1, np.eye(4), np.eye(6)))

    @rule()
    def finish(self) -> None:
        if not self.one.store.finished:
            self.one.store.finish({"points": 1})

    @rule()
    def announce(self) -> None:
        self.one.head()

    @rule(data=st.data())
    def deliver(self, data: st.DataObject) -> None:
        """An item comes without a request, perhaps again."""
        kinds = [(k, n) for k, r in self.one.store.numbers().items() for n in r.newest_first()]
        self.one.send(*data.draw(st.sampled_from(kinds)))

    @rule(junk=st.binary(max_size=40))
    def disturb(self, junk: bytes) -> None:
        self.one.ground.handle({self.one.name: junk}, [], self.one.now)
        self.one.ground.handle({}, [Item(self.one.name, junk)], self.one.now)

    @precondition(lambda self: self.one.asked)
    @rule(lost=st.booleans())
    def answer(self, lost: bool) -> None:
        if lost:
            self.one.asked.pop(0)
        else:
            self.one.answer()

    @precondition(lambda self: self.one.writes)
    @rule(trouble=st.sampled_from(["", "no cloud", "disk full"]))
    def written(self, trouble: str) -> None:
        self.one.written(trouble, is_due=trouble == "disk full")

    @rule(seconds=st.sampled_from([0.1, 5.0, 700.0]))
    def wait(self, seconds: float) -> None:
        self.one.pass_time(seconds)

    @invariant()
    def nothing_held_is_lost(self) -> None:
        for entry in self.one.ground.entries:
            for kind, count in self.most.items():
                assert entry["held"][kind] >= count
            self.most = entry["held"]

    def teardown(self) -> None:
        one = self.one
        self.finish()
        for _ in range(30):
            one.head()
            one.pass_time(5.0)
            while one.asked:
                one.answer()
            if one.writes:
                one.written()
        (entry,) = one.ground.entries
        assert entry["complete"]
        assert one.aligned or entry["trouble"]  # files that could not be written are said
        assert one.held is not None and one.held.numbers == one.store.numbers()
        one.close()
        self.folder.cleanup()


def test_any_order_of_messages_and_events() -> None:
    chosen = settings(max_examples=6, stateful_step_count=15, phases=(Phase.generate,))
    run_state_machine_as_test(AnyOrder, settings=chosen)
