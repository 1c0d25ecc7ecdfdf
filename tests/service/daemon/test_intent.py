"""The last order wins: a stop ends every retry, a pause outlasts a fault, one scan at a time."""

from __future__ import annotations

import tempfile
import threading
from pathlib import Path
from types import SimpleNamespace
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
from paths import DEMO

from mavlink.component.control import Phase, Result
from mavlink.component.presence import Health
from mavlink.wire.dialect import dialect
from mavlink.wire.framing import Framer
from recon.backends.cpu import CpuBackend
from service.cameras.camera_file import load_camera
from service.config import load_config
from service.daemon import intent as intent_module
from service.daemon import scanning as scanning_module
from service.daemon.intent import (
    LAST_RETRY_S,
    MARK,
    Intent,
    Landing,
    LandingWatch,
    Left,
    Resumption,
    Wanted,
)
from service.daemon.runtime import Daemon
from service.daemon.scan_run import ScanRun
from service.daemon.scanning import Scanning
from service.errors import OutsideError
from service.init_system import Notifier

MODEL = DEMO / "camera.yaml"
S = 1_000_000_000


def daemon_in(folder: Path, *given: str) -> Daemon:
    return Daemon(load_config(None, [f"scan.folder={folder}", "health.http=", *given]))


# ---- a flight with a camera that the model does not fit ------------------------------------------


class Refused:
    """A daemon that watches over a camera of another aspect ratio than its model's."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, *given: str) -> None:
        self.opened, self.looks, self.texts = 0, 0, list[str]()
        monkeypatch.setattr(intent_module, "FIRST_RETRY_S", 0.0)
        monkeypatch.setattr(intent_module, "LAST_RETRY_S", 0.0)
        monkeypatch.setattr("service.cameras.open_camera", self._open)
        self.daemon = daemon_in(folder, *given)
        daemon, vehicle = self.daemon, self.daemon.vehicle
        daemon.scanning.camera, daemon.scanning._backend = load_camera(MODEL), CpuBackend()
        daemon.actions.is_ready = True
        monkeypatch.setattr(vehicle, "statustext", lambda t, *_, **__: self.texts.append(t))
        monkeypatch.setattr(vehicle, "set_health", self._look)
        self._watch = threading.Thread(target=daemon._watch, args=(Notifier(""),))
        self._framer = Framer()

    def _open(self, _: str) -> Any:
        self.opened += 1
        return SimpleNamespace(
            size_px=(320, 180), description="gimbal", is_live=True, close=lambda: None
        )

    def _look(self, _: Health) -> None:
        self.looks += 1

    def hear(self, message: Any, source: tuple[int, int] = (255, 190)) -> None:
        vehicle = self.daemon.vehicle
        for packet in self._framer.feed(packed(message, source)):
            vehicle._companion.receive(0, packet, vehicle._companion._now_ns + S)

    def command(self, number: int, component: int, *params: float) -> int:
        """Send a command; return its final result."""
        p = [*params, *[0.0] * (7 - len(params))]
        self.hear(dialect.MAVLink_command_long_message(1, component, number, 0, *p))

        def result() -> list[int]:
            self.daemon.vehicle._companion.tick(self.daemon.vehicle._companion._now_ns)
            sent = [o.message for o in self.daemon.vehicle._companion.take()]
            acks = [m for m in sent if m.get_type() == "COMMAND_ACK" and m.command == number]
            return [m.result for m in acks if m.result != Result.IN_PROGRESS]

        return int(until(lambda: [r + 1 for r in result()])[-1]) - 1

    def __enter__(self) -> Refused:
        self._watch.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.daemon.quit()
        self._watch.join()
        self.daemon.scanning.end()


@pytest.mark.parametrize(
    ("number", "component", "params"),
    [(2501, 100, ()), (200, 100, (0, 0, 0, 0)), (31010, 191, (8,)), (31010, 191, (5,))],
)
def test_every_stop_ends_the_retries_of_a_scan_that_fails(
    number: int,
    component: int,
    params: tuple[float, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with Refused(tmp_path, monkeypatch) as refused:
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


def test_a_scan_that_fails_ends_with_its_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Refused(tmp_path, monkeypatch, "scan.start=on-arm", "mavlink.system_id=1") as refused:
        refused.hear(beat(armed=True), (1, 1))
        until(lambda: refused.opened >= 3)
        refused.hear(beat(armed=False), (1, 1))
        until(lambda: refused.daemon.scanning.phase is Phase.IDLE)
        opened, looks = refused.opened, refused.looks
        until(lambda: refused.looks > looks + 4)
        assert refused.opened == opened


# ---- stops that come early -----------------------------------------------------------------------


def test_a_stop_before_the_service_is_ready_holds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon, begun = daemon_in(tmp_path, "scan.start=on-boot"), list[ScanRun]()
    looks: list[Health] = []
    monkeypatch.setattr(ScanRun, "carry_out", begun.append)
    monkeypatch.setattr(daemon.vehicle, "set_health", looks.append)
    monkeypatch.setattr(daemon, "_load", lambda _: daemon.actions.stop_scan())
    thread = threading.Thread(target=daemon.run)
    thread.start()
    until(lambda: len(looks) > 5)
    daemon.quit()
    thread.join()
    assert not begun


def test_a_stop_forgets_a_scan_to_resume(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    boot = tmp_path / "boot"
    boot.write_text("another")
    monkeypatch.setattr("service.daemon.intent.BOOT", boot)
    (tmp_path / MARK).write_text("this")  # a power cut, and no autopilot heard yet
    daemon, begun = daemon_in(tmp_path), list[ScanRun]()
    monkeypatch.setattr(ScanRun, "carry_out", begun.append)
    daemon.actions.is_ready = True
    daemon._resume()
    daemon.actions.stop_scan()
    monkeypatch.setattr(type(daemon.vehicle.presence), "is_armed", True)
    daemon._resume()
    daemon.scanning.follow_intent()
    assert not begun and daemon.scanning.phase is Phase.IDLE


# ---- a pause, a photo, a text --------------------------------------------------------------------


def test_a_pause_outlasts_a_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    daemon, faults = daemon_in(tmp_path), [threading.Event(), threading.Event()]
    paused: list[bool] = []

    def carry_out(run: ScanRun) -> None:
        faults[len(paused)].wait(60.0)
        paused.append(run._host.intent.paused.is_set())
        raise OutsideError("camera gone")

    monkeypatch.setattr(intent_module, "FIRST_RETRY_S", 0.0)
    monkeypatch.setattr(ScanRun, "carry_out", carry_out)
    daemon.scanning.start()
    assert daemon.actions.pause().result is Result.ACCEPTED  # type: ignore[union-attr]
    for fault in faults:
        assert daemon.scanning.phase is Phase.PAUSED
        fault.set()
        until(lambda: daemon.scanning.phase is Phase.WAITING)
        if len(paused) < 2:
            daemon.scanning.follow_intent()
    assert paused == [True, True]
    daemon.actions.resume()
    assert daemon.scanning.intent.wanted is Wanted.SCAN
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
def test_a_refused_photo_says_why(
    phase: Phase, word: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon = daemon_in(tmp_path)
    monkeypatch.setattr(Scanning, "phase", phase)
    monkeypatch.setattr(Scanning, "is_closing", phase is Phase.FINALISING)
    answer: Any = daemon.actions.capture_keyframe()
    assert answer.result is Result.TEMPORARILY_REJECTED and word in answer.text


def test_why_a_start_failed_is_said_each_time_but_not_of_its_retries(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon, said = daemon_in(tmp_path), list[bool]()

    def fail(run: ScanRun) -> None:
        raise OutsideError("camera gone")

    def statustext(text: str, severity: int, is_answer: bool = False) -> None:
        assert text == "Scan failed: camera gone"
        said.append(is_answer)

    monkeypatch.setattr(intent_module, "FIRST_RETRY_S", 0.0)
    monkeypatch.setattr(intent_module, "LAST_RETRY_S", 0.0)
    monkeypatch.setattr(ScanRun, "carry_out", fail)
    monkeypatch.setattr(daemon.vehicle, "statustext", statustext)
    for _ in range(2):
        before = len(said)
        daemon.scanning.start()
        for attempt in range(1, 4):
            expected = before + attempt
            until(lambda: len(said) == expected and not daemon.scanning.is_running)  # noqa: B023
            daemon.scanning.follow_intent()
        until(lambda: not daemon.scanning.is_running)
        daemon.scanning.stop()
        assert said[before:] == [True, False, False, False]


# ---- the end of the service, and of a flight -----------------------------------------------------


def test_the_heartbeat_stays_active_while_the_last_scan_is_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon, end, stopping = daemon_in(tmp_path), threading.Event(), threading.Event()
    confirmed: list[Health] = []

    def carry_out(run: ScanRun) -> None:
        run.stop.wait(60.0)
        end.wait(60.0)

    monkeypatch.setattr(ScanRun, "carry_out", carry_out)
    monkeypatch.setattr(daemon, "_load", lambda _: None)
    monkeypatch.setattr(Notifier, "stopping", lambda _: stopping.set())

    def confirm(health: Health) -> None:
        if stopping.is_set():
            confirmed.append(health)

    monkeypatch.setattr(daemon.vehicle, "set_health", confirm)
    thread = threading.Thread(target=daemon.run)
    thread.start()
    until(lambda: daemon.actions.is_ready)
    daemon.actions.start_scan()
    daemon.quit()
    until(lambda: len(confirmed) >= 3)
    assert set(confirmed) == {Health.ACTIVE}
    monkeypatch.setattr(type(daemon.scanning), "idle_closing_s", 1e6)  # it hangs
    until(lambda: confirmed[-1] is Health.CRITICAL)
    end.set()
    thread.join()


def test_a_scan_that_is_being_closed_is_not_critical(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The camera was silent for long when the stop came."""
    daemon, end = daemon_in(tmp_path), threading.Event()
    monkeypatch.setattr(ScanRun, "carry_out", lambda _: end.wait(60.0))
    daemon.actions.is_ready = True
    daemon.actions.start_scan()
    assert daemon.scanning._run is not None
    daemon.scanning._run.progress_s -= 300.0
    assert daemon._health() is Health.CRITICAL
    daemon.actions.stop_scan()
    assert daemon._health() is Health.ACTIVE
    end.set()
    until(lambda: not daemon.scanning.is_running)


def test_a_scan_by_command_is_closed_after_landing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon, reported, now_s, armed = daemon_in(tmp_path), list[str](), 1000.0, True
    presence = type(daemon.vehicle.presence)
    monkeypatch.setattr(presence, "is_armed", property(lambda _: armed))
    monkeypatch.setattr(presence, "is_disarmed", lambda *_: not armed)
    monkeypatch.setattr("service.daemon.runtime.time.monotonic", lambda: now_s)
    monkeypatch.setattr(daemon.vehicle, "statustext", lambda text, *_, **__: reported.append(text))
    monkeypatch.setattr(ScanRun, "carry_out", lambda run: run.stop.wait(60.0))
    daemon.actions.is_ready = True

    def fly(seconds: float, is_armed: bool) -> None:
        nonlocal now_s, armed
        armed, now_s = is_armed, now_s + seconds
        daemon._close_after_landing()

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


class NoWorkers:
    """A table whose workers the test runs itself."""

    def start(self, *_: object, **__: object) -> None:
        pass


class AnyOrder(RuleBasedStateMachine):
    """Commands, faults and ends of a scan in any order, against what they should come to."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = tempfile.TemporaryDirectory()
        self.daemon = daemon_in(Path(self.folder.name))
        self.scanning, self.wanted, self.begun = self.daemon.scanning, "nothing", 0
        self.daemon.actions.is_ready = True
        self.daemon.scanning.offer_backlog = lambda: None  # type: ignore[method-assign]

    @property
    def run(self) -> ScanRun | None:
        return self.scanning._run

    @rule()
    def start(self) -> None:
        assert self.daemon.actions.start_scan().result is Result.ACCEPTED
        self.wanted = "scan"

    @rule(finalise=st.booleans())
    def stop(self, finalise: bool) -> None:
        actions = self.daemon.actions
        (actions.finalise if finalise else actions.stop_scan)()
        self.wanted = "nothing"
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

        def carry_out() -> None:
            if how != "ends":
                raise OutsideError("camera gone") if how == "outside" else RuntimeError("ours")

        run.carry_out = carry_out  # type: ignore[method-assign]
        self.scanning._carry_out(run)
        assert self.run is None
        assert (self.scanning.fault == "") == (how == "ends")
        if how == "ends" and not was_stopped:
            self.wanted = "nothing"

    @rule(late=st.booleans())
    def tick(self, late: bool) -> None:
        if late:
            self.scanning.intent._due_s = 0.0
        before = self.run
        self.scanning.follow_intent()
        if late and before is None:
            assert (self.run is not None) == (self.wanted != "nothing")
        if before is not None:
            assert self.run is before

    @invariant()
    def what_is_wanted_is_known(self) -> None:
        phase, intent = self.scanning.phase, self.scanning.intent
        assert intent.wanted.value == self.wanted
        assert intent.paused.is_set() == (self.wanted == "pause")
        mark = Path(self.folder.name) / MARK
        assert mark.exists() == (self.wanted != "nothing")
        if self.run is None:
            assert phase is (Phase.IDLE if self.wanted == "nothing" else Phase.WAITING)
        elif self.run.stop.is_set():
            assert phase is (Phase.FINALISING if self.wanted == "nothing" else Phase.WAITING)
            assert self.scanning.is_closing
        else:
            assert self.wanted != "nothing"
            assert phase is (Phase.PAUSED if self.wanted == "pause" else Phase.SCANNING)

    def teardown(self) -> None:
        self.folder.cleanup()


def test_any_order_of_commands_and_faults(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scanning_module, "PROCESS", NoWorkers())
    monkeypatch.setattr(scanning_module, "give_back", lambda **_: None)
    monkeypatch.setattr(scanning_module.log, "exception", lambda *_: None)
    chosen = settings(max_examples=40, stateful_step_count=30)
    run_state_machine_as_test(AnyOrder, settings=chosen)


def test_retries_slow_down_and_start_over() -> None:
    intent = Intent()
    intent.scan(0.0)
    waits = [intent.failed(0.0) for _ in range(6)]
    assert waits == [1.0, 2.0, 4.0, 8.0, 8.0, LAST_RETRY_S]
    assert not intent.is_due(LAST_RETRY_S - 0.1) and intent.is_due(LAST_RETRY_S)
    intent.scan(0.0)
    assert intent.is_due(0.0) and intent.failed(0.0) == 1.0
    intent.end()
    intent.scan(0.0)
    assert not intent.is_due(100.0)
