"""The last order wins: a stop ends every retry, a pause outlasts a fault, one scan at a time."""

from __future__ import annotations

import contextlib
import gc
import socket
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from autopilot import beat, packed
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from loopback import until
from onboard import FakeCamera, HeardVehicle, Onboard

from mavlink.component.control import Answer, Phase, Result, Work
from mavlink.component.presence import Health
from mavlink.component.vehicle import VehicleLink
from mavlink.wire.dialect import dialect
from service.daemon.resumption import MARK, Landing, LandingWatch, Left, Resumption
from service.daemon.scan_state import LAST_RETRY_S, TRANSITIONS, Effect, Event, ScanLife, State
from service.daemon.scanning import Scanning, ScanRun
from service.errors import OutsideError
from service.init_system import Notifier
from service.workers import Row, Worker, Workers, row_of

S = 1_000_000_000


# ---- a flight with a camera that the model does not fit ------------------------------------------


class Watched(VehicleLink):
    """Counts the rounds of the watch."""

    looks = 0

    def set_health(self, health: Health) -> None:
        self.looks += 1
        super().set_health(health)


class Refused:
    """A daemon that watches over a camera of another aspect ratio than its model's, and its
    operator on a UDP link."""

    def __init__(self, folder: Path, *given: str) -> None:
        self.opened = 0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.05)
        link = f"mavlink.links=udpout:127.0.0.1:{self._socket.getsockname()[1]}"
        self.daemon = Onboard(folder, link, *given, opener=self._open, link=Watched)
        self.daemon.equip()
        self._watch = threading.Thread(target=self.daemon.watch, args=(Notifier(""),))
        self._ear, self._peer = dialect.MAVLink(None), ("", 0)
        self._ear.robust_parsing = True

    @property
    def looks(self) -> int:
        vehicle: Any = self.daemon.vehicle
        return int(vehicle.looks)

    def _open(self, _: str) -> FakeCamera:
        self.opened += 1
        return FakeCamera((320, 180))

    def _heard(self) -> list[Any]:
        with contextlib.suppress(TimeoutError):
            data, self._peer = self._socket.recvfrom(65536)
            return self._ear.parse_buffer(data) or []
        return []

    def hear(self, message: Any, source: tuple[int, int] = (255, 190)) -> None:
        self._socket.sendto(packed(message, source), self._peer)

    def command(self, number: int, component: int, *params: float) -> int:
        """Send a command; return its final result."""
        p = [*params, *[0.0] * (7 - len(params))]
        self.hear(dialect.MAVLink_command_long_message(1, component, number, 0, *p))

        def result() -> list[int]:
            sent = self._heard()
            acks = [m for m in sent if m.get_type() == "COMMAND_ACK" and m.command == number]
            return [m.result for m in acks if m.result != Result.IN_PROGRESS]

        return int(until(lambda: [r + 1 for r in result()])[-1]) - 1

    def __enter__(self) -> Refused:
        self.daemon.vehicle.start()
        until(self._heard)
        self._watch.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.daemon.quit()
        self._watch.join()
        self.daemon.scanning.end()
        self.daemon.vehicle.stop()
        self._socket.close()


@pytest.mark.parametrize(
    ("number", "component", "params"),
    [(2501, 100, ()), (200, 100, (0, 0, 0, 0)), (31010, 191, (8,)), (31010, 191, (5,))],
)
@pytest.mark.slow
def test_every_stop_ends_the_retries_of_a_scan_that_fails(
    number: int,
    component: int,
    params: tuple[float, ...],
    tmp_path: Path,
) -> None:
    with Refused(tmp_path) as refused:
        assert refused.command(2500, 100) == Result.ACCEPTED
        until(lambda: refused.opened >= 3)  # it is retried
        until(lambda: refused.daemon.scanning.phase is Phase.WAITING)
        assert refused.daemon.actions.status().is_recording
        refused.command(number, component, *params)
        until(lambda: refused.daemon.scanning.phase is Phase.IDLE)
        opened, looks = refused.opened, refused.looks
        until(lambda: refused.looks > looks + 4)
        assert refused.opened == opened
        assert Resumption(tmp_path).left is Left.NOTHING
        assert refused.command(2500, 100) == Result.ACCEPTED  # and a start starts again
        until(lambda: refused.opened > opened)


@pytest.mark.slow
def test_a_scan_that_fails_ends_with_its_flight(tmp_path: Path) -> None:
    with Refused(tmp_path, "scan.start=on-arm") as refused:
        refused.hear(beat(armed=True), (1, 1))
        until(lambda: refused.opened >= 3)
        refused.hear(beat(armed=False), (1, 1))
        until(lambda: refused.daemon.scanning.phase is Phase.IDLE)
        opened, looks = refused.opened, refused.looks
        until(lambda: refused.looks > looks + 4)
        assert refused.opened == opened


# ---- stops that come early -----------------------------------------------------------------------


class StoppedWhileLoading(Scanning):
    """A stop comes while camera model and backend are loaded."""

    def load(self) -> None:
        self.handle(Event.STOP)


def test_a_stop_before_the_service_is_ready_holds(tmp_path: Path) -> None:
    begun = list[ScanRun]()
    daemon = Onboard(tmp_path, "scan.start=on-boot", script=begun.append, of=StoppedWhileLoading)
    thread = threading.Thread(target=daemon.run)
    thread.start()
    until(lambda: len(daemon.vehicle.looks) > 6)  # the first is the start's
    daemon.quit()
    thread.join()
    assert not begun


def test_a_stop_forgets_a_scan_to_resume(tmp_path: Path) -> None:
    boot = tmp_path / "boot"
    boot.write_text("another")
    (tmp_path / MARK).write_text("this")  # a power cut, and no autopilot heard yet
    begun = list[ScanRun]()
    daemon = Onboard(tmp_path, script=begun.append, resumption=Resumption(tmp_path, boot))
    daemon.actions.is_ready = True
    daemon.look()
    assert daemon.scanning.resumption.left is Left.BY_COMPUTER
    daemon.actions.stop_scan()
    daemon.vehicle.arm()
    daemon.look()
    assert not begun and daemon.scanning.phase is Phase.IDLE


class StalledDisk(Resumption):
    """Its folder is on the disk once :attr:`goes_on` is set."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.goes_on, self.waiting = threading.Event(), list[str]()

    def settle(self) -> None:
        self.waiting.append(threading.current_thread().name)
        self.goes_on.wait(60.0)
        super().settle()


@pytest.mark.parametrize("finalise", [False, True])
def test_a_stop_is_accepted_once_the_disk_has_it_and_holds_nobody_up(
    finalise: bool, tmp_path: Path
) -> None:
    resumption = StalledDisk(tmp_path)
    begun = list[ScanRun]()
    daemon = Onboard(tmp_path, script=begun.append, resumption=resumption)
    daemon.actions.is_ready = True
    daemon.actions.start_scan()
    work = daemon.actions.finalise() if finalise else daemon.actions.stop_scan()
    until(lambda: begun)
    assert work.answer is None and not (tmp_path / MARK).exists()
    resumption.goes_on.set()
    until(lambda: work.answer)
    assert isinstance(work.answer, Answer) and work.answer.result is Result.ACCEPTED


def test_a_finalise_as_the_scan_ends_waits_for_the_disk_too(tmp_path: Path) -> None:
    works = list[Work]()

    class Asking(HeardVehicle):
        def statustext(self, text: str, severity: int = 0, is_answer: bool = False) -> None:
            if "camera gone" in text:
                works.append(daemon.actions.finalise())

    def script(_: ScanRun) -> None:
        raise OutsideError("camera gone")

    resumption = StalledDisk(tmp_path)
    daemon = Onboard(tmp_path, script=script, link=Asking, resumption=resumption)
    daemon.actions.is_ready = True
    daemon.actions.start_scan()
    assert until(lambda: {"scan", "stop"} <= set(resumption.waiting))
    assert works[0].answer is None
    resumption.goes_on.set()
    assert until(lambda: works[0].answer)


# ---- a pause, a photo, a text --------------------------------------------------------------------


def test_a_pause_outlasts_a_fault(tmp_path: Path) -> None:
    faults = [threading.Event(), threading.Event()]
    paused: list[bool] = []

    def script(_: ScanRun) -> None:
        faults[len(paused)].wait(60.0)
        paused.append(daemon.scanning.paused.is_set())
        raise OutsideError("camera gone")

    daemon = Onboard(tmp_path, script=script)
    daemon.scanning.start()
    assert daemon.actions.pause().result is Result.ACCEPTED  # type: ignore[union-attr]
    for fault in faults:
        assert daemon.scanning.phase is Phase.PAUSED
        fault.set()
        until(lambda: daemon.scanning.phase is Phase.WAITING)
        if len(paused) < 2:
            daemon.scanning.handle(Event.TICK)
    assert paused == [True, True]
    daemon.actions.resume()
    assert daemon.scanning.life.state is State.WAITING
    daemon.actions.stop_scan()


@pytest.mark.parametrize(
    ("phase", "word"),
    [
        (Phase.IDLE, "start a scan first"),
        (Phase.PAUSED, "paused"),
        (Phase.WAITING, "being retried"),
        (Phase.FINALISING, "being closed"),
        (Phase.SCANNING, "camera is being opened"),
    ],
)
def test_a_refused_photo_says_why(phase: Phase, word: str, tmp_path: Path) -> None:
    end = threading.Event()

    def script(_: ScanRun) -> None:
        if phase is Phase.WAITING:
            raise OutsideError("camera gone")
        end.wait(60.0)

    daemon = Onboard(tmp_path, script=script)
    scanning = daemon.scanning
    if phase is not Phase.IDLE:
        scanning.start()
    if phase is Phase.PAUSED:
        scanning.handle(Event.PAUSE)
    if phase is Phase.FINALISING:
        scanning.handle(Event.STOP)
    until(lambda: scanning.phase is phase)
    answer: Any = daemon.actions.capture_keyframe()
    assert answer.result is Result.TEMPORARILY_REJECTED and word in answer.text
    end.set()
    scanning.end()


@pytest.mark.slow
def test_why_a_start_failed_is_said_each_time_but_not_of_its_retries(tmp_path: Path) -> None:
    def fail(_: ScanRun) -> None:
        raise OutsideError("camera gone")

    daemon = Onboard(tmp_path, script=fail)
    said = daemon.vehicle.answers
    for _ in range(2):
        before = len(said)
        daemon.scanning.start()
        for attempt in range(1, 4):
            expected = before + attempt
            until(lambda: len(said) == expected and daemon.scanning.run is None)  # noqa: B023
            daemon.scanning.handle(Event.TICK)
        until(lambda: daemon.scanning.run is None)
        daemon.scanning.handle(Event.STOP)
        assert said[before:] == [True, False, False, False]
    assert set(daemon.vehicle.said) == {"Scan failed: camera gone"}


# ---- the end of the service, and of a flight -----------------------------------------------------


class Loaded(Scanning):
    """Camera model and backend are there."""

    def load(self) -> None:
        pass


class HeardNotifier(Notifier):
    """Notes that the service is stopping."""

    def __init__(self) -> None:
        super().__init__("")
        self.is_stopping = threading.Event()

    def stopping(self) -> None:
        self.is_stopping.set()


def test_the_heartbeat_stays_active_while_the_last_scan_is_closed(tmp_path: Path) -> None:
    end, notifier, ahead_s = threading.Event(), HeardNotifier(), 0.0

    def script(run: ScanRun) -> None:
        run.stop.wait(60.0)
        end.wait(60.0)

    daemon = Onboard(tmp_path, script=script, of=Loaded, clock_s=lambda: time.monotonic() + ahead_s)
    thread = threading.Thread(target=daemon.run, args=(notifier,))
    thread.start()
    until(lambda: daemon.actions.is_ready)
    daemon.actions.start_scan()
    daemon.quit()
    until(notifier.is_stopping.is_set)
    before = len(daemon.vehicle.looks)
    until(lambda: len(daemon.vehicle.looks) >= before + 3)
    assert set(daemon.vehicle.looks[before:]) == {Health.ACTIVE}
    ahead_s = 1e6  # it hangs
    until(lambda: daemon.vehicle.looks[-1] is Health.CRITICAL)
    end.set()
    thread.join()


def test_a_scan_that_is_being_closed_is_not_critical(tmp_path: Path) -> None:
    """The camera was silent for long when the stop came."""
    end, now_s = threading.Event(), 0.0
    daemon = Onboard(tmp_path, script=lambda _: end.wait(60.0), clock_s=lambda: now_s)
    daemon.actions.is_ready = True
    daemon.actions.start_scan()
    now_s = 300.0
    daemon.look()
    daemon.actions.stop_scan()
    daemon.look()
    assert daemon.vehicle.looks == [Health.CRITICAL, Health.ACTIVE]
    end.set()
    until(lambda: daemon.scanning.run is None)


def test_a_scan_by_command_is_closed_after_landing(tmp_path: Path) -> None:
    now_ns = 1000 * S
    daemon = Onboard(tmp_path, script=lambda run: run.stop.wait(60.0), clock_ns=lambda: now_ns)
    daemon.actions.is_ready = True
    reported = daemon.vehicle.said

    def fly(seconds: float, is_armed: bool) -> None:
        nonlocal now_ns
        now_ns += round(seconds * S)
        daemon.vehicle.arm(is_armed, now_ns)
        daemon.look()

    daemon.actions.start_scan()
    fly(0.0, True)
    fly(600.0, True)
    fly(1.0, False)
    assert reported == ["Landed: scan closes in 60 s unless you arm"]
    fly(30.0, True)  # take-off again
    fly(1.0, False)
    fly(59.0, False)
    assert daemon.scanning.phase is Phase.SCANNING
    fly(1.5, False)
    assert reported[1:] == [reported[0], "Scan closed after landing: no stop command"]
    until(lambda: daemon.scanning.phase is Phase.IDLE)


def landings(watch: LandingWatch, *steps: tuple[float, bool, bool], after_s: float = 60.0) -> str:
    """The result of (time, armed, disarmed) steps, one letter each."""
    letters = {Landing.NOTHING: ".", Landing.LANDED: "L", Landing.CLOSE: "C"}
    return "".join(letters[watch.look(True, a, d, after_s, t)] for t, a, d in steps)


def test_only_a_flight_that_ended_closes_a_scan() -> None:
    bench = [(t, False, True) for t in (0.0, 100.0, 1000.0)]
    assert landings(LandingWatch(), *bench) == "..."  # never armed
    silent = [(0.0, True, False), (10.0, False, False), (500.0, False, False)]
    assert landings(LandingWatch(), *silent) == "..."  # nothing says that it is disarmed
    down = [(0.0, True, False), (10.0, False, True), (69.0, False, False), (70.0, False, False)]
    assert landings(LandingWatch(), *down) == ".L.C"  # the battery is pulled after landing
    assert landings(LandingWatch(), *down, after_s=0.0) == "...."
    watch = LandingWatch()
    assert landings(watch, *down[:2]) == ".L"
    assert watch.look(False, False, True, 60.0, 20.0) is Landing.NOTHING  # stopped
    assert landings(watch, (21.0, False, True), (200.0, False, True)) == ".."  # the next scan


# ---- any order of events -------------------------------------------------------------------------


class NoWorkers(Workers):
    """A table whose last scan the test runs itself; what else it starts is done at once."""

    last: Worker

    def start(self, row: str | Row, work: Any, *_: Any, **__: Any) -> Worker:
        worker = Worker(str(row), row_of(str(row)), work)
        if row == "scan":
            self.last = worker
        else:
            work(worker)
        return worker


class AnyOrder(RuleBasedStateMachine):
    """Commands, faults, ends of a scan, landings and power cuts in any order, against what they
    should come to."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = tempfile.TemporaryDirectory()
        self.boots, self.now_s, self.ending = 0, 0.0, "ends"
        self.works: list[Work] = []  # acknowledged as in progress
        self.boot()
        self.wanted, self.is_left = "nothing", False

    def boot(self) -> None:
        """The computer starts."""
        self.boots += 1
        folder = Path(self.folder.name)
        (folder / "boot").write_text(str(self.boots))
        self.workers = NoWorkers()
        self.daemon = Onboard(
            folder / "scans", script=self.script, workers=self.workers, life=ScanLife(),
            clock_s=lambda: self.now_s, clock_ns=lambda: round(1e9 * self.now_s),
            resumption=Resumption(folder / "scans", folder / "boot"),
        )  # fmt: skip
        self.scanning = self.daemon.scanning
        self.daemon.actions.is_ready = True

    def script(self, _: ScanRun) -> None:
        if self.ending != "ends":
            raise OutsideError("camera gone") if self.ending == "outside" else RuntimeError("ours")

    @property
    def run(self) -> ScanRun | None:
        return self.scanning.run

    @rule()
    def start(self) -> None:
        assert self.daemon.actions.start_scan().result is Result.ACCEPTED
        self.wanted, self.is_left = "scan", False

    @rule(finalise=st.booleans())
    def stop(self, finalise: bool) -> None:
        actions = self.daemon.actions
        answer = actions.finalise() if finalise else actions.stop_scan()
        if finalise and self.run is not None:
            self.works.append(answer)
        self.wanted, self.is_left = "nothing", False
        assert self.run is None or self.run.stop.is_set()

    @rule()
    def pause(self) -> None:
        accepted = self.daemon.actions.pause().result is Result.ACCEPTED  # type: ignore[union-attr]
        assert accepted == (self.wanted != "nothing")
        self.wanted = "pause" if accepted else self.wanted

    @rule()
    def resume(self) -> None:
        accepted = self.daemon.actions.resume().result is Result.ACCEPTED  # type: ignore[union-attr]
        assert accepted == (self.wanted == "pause")
        self.wanted = "scan" if accepted else self.wanted

    @precondition(lambda self: self.run is not None)
    @rule(how=st.sampled_from(["ends", "outside", "ours"]))
    def finish(self, how: str) -> None:
        run = self.run
        assert run is not None
        was_stopped = run.stop.is_set()
        self.ending = how
        self.workers.last.work(self.workers.last)
        assert self.run is None
        assert (self.scanning.fault == "") == (how == "ends")
        if how == "ends" and not was_stopped:
            self.wanted = "nothing"

    @rule(late=st.booleans())
    def tick(self, late: bool) -> None:
        if late:
            self.now_s += 2.0 * LAST_RETRY_S
        before = self.run
        self.scanning.handle(Event.TICK)
        if late and before is None:
            assert (self.run is not None) == (self.wanted != "nothing")
        if before is not None:
            assert self.run is before

    @rule(armed=st.sampled_from([True, False, None]), seconds=st.sampled_from([0.1, 70.0]))
    def fly(self, armed: bool | None, seconds: float) -> None:
        """A heartbeat of the autopilot is heard, or none."""
        self.now_s += seconds
        if armed is not None:
            self.daemon.vehicle.arm(armed, round(1e9 * self.now_s))
        heard = self.daemon.vehicle.report()
        said = len(self.daemon.vehicle.said)
        self.daemon.look()
        resumed = self.is_left and heard.is_armed and heard.is_certain
        assert ("Scan resumed after a restart" in self.daemon.vehicle.said[said:]) == resumed
        if resumed:
            self.wanted, self.is_left = "scan", False
        elif heard.autopilot is not None and heard.is_certain and not heard.is_armed:
            self.is_left = False
        if any("closed after landing" in text for text in self.daemon.vehicle.said[said:]):
            assert self.wanted != "nothing"
            self.wanted = "nothing"

    @rule()
    def power_cut(self) -> None:
        self.is_left |= self.wanted != "nothing"  # the start was acknowledged
        self.wanted = "nothing"
        self.works.clear()
        self.boot()

    @invariant()
    def what_is_wanted_is_known(self) -> None:
        phase, state = self.scanning.phase, self.scanning.life.state
        assert state.is_wanted == (self.wanted != "nothing")
        assert state.is_paused == self.scanning.paused.is_set() == (self.wanted == "pause")
        mark = Path(self.folder.name) / "scans" / MARK
        assert mark.exists() == (self.wanted != "nothing" or self.is_left)
        assert state.has_run == (self.run is not None)
        if self.run is None:
            assert phase is (Phase.IDLE if self.wanted == "nothing" else Phase.WAITING)
            assert all(work.answer is not None for work in self.works)
        elif self.run.stop.is_set():
            assert phase is (Phase.FINALISING if self.wanted == "nothing" else Phase.WAITING)
            assert state.is_closing
        else:
            assert self.wanted != "nothing"
            assert phase is (Phase.PAUSED if self.wanted == "pause" else Phase.SCANNING)

    def teardown(self) -> None:
        self.folder.cleanup()


@pytest.mark.slow
def test_any_order_of_commands_and_faults() -> None:
    gc.freeze()  # each end of a scan collects garbage
    try:
        chosen = settings(max_examples=30, stateful_step_count=30)
        run_state_machine_as_test(AnyOrder, settings=chosen)
    finally:
        gc.unfreeze()


class AnyEvents(RuleBasedStateMachine):
    """The machine alone: any event at any time."""

    def __init__(self) -> None:
        super().__init__()
        self.life, self.now_s, self.marked, self.held, self.runs = ScanLife(), 0.0, False, False, 0

    @rule(event=st.sampled_from(Event), seconds=st.sampled_from([0.0, 0.5, 10.0]))
    def happen(self, event: Event, seconds: float) -> None:
        before, self.now_s = self.life.state, self.now_s + seconds
        if event in (Event.DONE, Event.FAILED, Event.GROWN) and not before.has_run:
            return
        effects = self.life.handle(event, self.now_s)
        after = self.life.state
        self.marked = Effect.MARK in effects or (self.marked and Effect.UNMARK not in effects)
        self.held = Effect.HOLD in effects or (self.held and Effect.RELEASE not in effects)
        self.runs += (Effect.OPEN in effects) - (event in (Event.DONE, Event.FAILED))
        if event in (Event.STOP, Event.END):  # a stop always wins
            assert not after.is_wanted and Effect.OPEN not in effects
            assert (Effect.CLOSE in effects) == before.has_run
        if event is Event.START and before not in (State.ENDING, State.ENDED):
            assert after.is_wanted and not after.is_paused
        if event is Event.FAILED and before.is_wanted:  # a fault cancels nothing
            assert after.is_wanted and after.is_paused == before.is_paused
        if Effect.OPEN in effects:
            assert before.is_wanted and event is Event.TICK and self.now_s >= self.life.due_s

    @invariant()
    def effects_add_up(self) -> None:
        state = self.life.state
        assert self.marked == state.is_wanted and self.held == state.is_paused
        assert self.runs == int(state.has_run)


def test_any_events_in_any_order() -> None:
    chosen = settings(max_examples=100, stateful_step_count=40)
    run_state_machine_as_test(AnyEvents, settings=chosen)


def reached(state: State, *events: Event) -> set[State]:
    """The states that these events lead to, in any order."""
    found = [state]
    for one in found:
        found += [n for e, n in TRANSITIONS[one].items() if e in events and n not in found]
    return set(found)


@pytest.mark.parametrize("state", State)
def test_every_state_has_a_way_out(state: State) -> None:
    assert State.ENDED in reached(state, Event.END, Event.DONE)
    if state not in (State.ENDING, State.ENDED):
        assert State.IDLE in reached(state, Event.STOP, Event.FAILED)
        assert State.SCANNING in reached(state, Event.START, Event.TICK, Event.DONE)
        assert state in reached(State.IDLE, *Event)


def test_a_stop_between_two_attempts_sends_earlier_scans() -> None:
    life = ScanLife()
    for event in (Event.START, Event.TICK, Event.FAILED):
        life.handle(event, 0.0)
    assert Effect.OFFER in life.handle(Event.STOP, 0.0)
    assert Effect.OFFER not in life.handle(Event.STOP, 0.0)


def test_retries_slow_down_and_start_over() -> None:
    life, now_s = ScanLife(), 0.0

    def wait() -> float:
        """Start an attempt that fails; the time until the next one."""
        life.handle(Event.TICK, now_s)
        assert life.state is State.SCANNING
        life.handle(Event.FAILED, now_s)
        return life.due_s - now_s

    life.handle(Event.START, now_s)
    for expected in (1.0, 2.0, 4.0, 8.0, 8.0, LAST_RETRY_S):
        assert wait() == expected
        assert life.handle(Event.TICK, now_s + expected - 0.1) == ()
        now_s += expected
    life.handle(Event.START, now_s)
    assert life.failures == 0 and wait() == 1.0
    now_s += 1.0
    assert life.failures == 1 and wait() == 2.0
    now_s += 2.0
    life.handle(Event.GROWN, now_s)  # it has stored data: the next fault is retried soon
    assert wait() == 1.0
    life.handle(Event.END, now_s)
    life.handle(Event.START, now_s)
    assert life.handle(Event.TICK, now_s + 100.0) == ()
