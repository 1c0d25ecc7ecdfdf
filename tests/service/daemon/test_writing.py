"""The files of a scan that has ended: waited for, unless another scan is to begin."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from loopback import until
from onboard import Onboard

from mavlink.component.control import Answer, Phase, Result, Work
from service.daemon.scan_state import State
from service.daemon.scanning import ScanRun
from service.errors import OutsideError
from service.stream.records import ScanHeader
from service.stream.store import ScanStore


class Slow:
    """Files that are written once they may, or not at all."""

    def __init__(self) -> None:
        self.may_end = threading.Event()
        self.error: Exception | None = None
        self.written: list[str] = []

    def __call__(self, folder: Path, store: ScanStore) -> None:
        self.may_end.wait(30.0)
        if self.error is not None:
            raise self.error
        store.seqs()  # it is still open
        self.written.append(folder.name)


class Landing:
    """A flight that has ended, and what is asked of it then."""

    def __init__(self, folder: Path, files: Slow) -> None:
        header = ScanHeader("s", "d", 1, camera={}, configuration={}, software="test")
        self.store = ScanStore.create(folder / "s" / "scan.db", header)
        self.runs: list[ScanRun] = []
        self.daemon = Onboard(folder, script=self._script, write=files)
        self.ended: list[dict[str, bool]] = []  # how its sender was ended
        self.daemon.scanning.link.end_scan = (  # type: ignore[method-assign]
            lambda _, **how: self.ended.append(how)
        )
        self.daemon.scanning.start()
        until(lambda: self.runs)

    def _script(self, run: ScanRun) -> None:
        """Its first run has a scan to close; the next ones wait for their stop."""
        self.runs.append(run)
        run.stop.wait(60.0)
        if len(self.runs) == 1:
            run.folder, run.store = self.store.path.parent, self.store
            self.daemon.scanning.write_files(run, self.store)

    def finalise(self) -> Work:
        work = self.daemon.scanning.finalise()
        assert work is not None
        until(lambda: len(self.runs[0].workers) == 2)
        return work

    @property
    def is_open(self) -> bool:
        """True until its store is closed."""
        try:
            self.store.seqs()
        except OutsideError:
            return False
        return True


@pytest.fixture
def slow() -> Slow:
    return Slow()


@pytest.fixture
def landing(tmp_path: Path, slow: Slow) -> Landing:
    return Landing(tmp_path, slow)


def test_the_files_are_waited_for(slow: Slow, landing: Landing) -> None:
    scanning, work = landing.daemon.scanning, landing.finalise()
    assert scanning.in_the_making == {"s"}
    before = landing.runs[0].closing_marks()
    assert landing.runs[0].closing_marks() == before
    assert scanning.phase is Phase.FINALISING and work.answer is None
    slow.may_end.set()
    until(lambda: scanning.run is None)
    assert slow.written == ["s"]
    assert landing.ended == [{"is_last": False}]
    assert isinstance(work.answer, Answer) and work.answer.result is Result.ACCEPTED
    assert scanning.phase is Phase.IDLE and not landing.is_open
    until(lambda: not scanning.in_the_making)


def test_what_went_wrong_with_them_is_a_fault(slow: Slow, landing: Landing) -> None:
    scanning, work = landing.daemon.scanning, landing.finalise()
    slow.error = OutsideError("the disk is full")
    slow.may_end.set()
    until(lambda: scanning.run is None)
    assert landing.daemon.vehicle.said == ["Scan failed: the disk is full"]
    assert scanning.fault == "the disk is full"
    assert isinstance(work.answer, Answer) and work.answer.result is Result.FAILED
    assert not landing.is_open


def test_another_scan_does_not_wait_for_them(slow: Slow, landing: Landing) -> None:
    scanning, work = landing.daemon.scanning, landing.finalise()
    scanning.start()
    assert scanning.phase is Phase.WAITING
    until(lambda: scanning.life.state is State.WAITING)
    scanning.start()
    until(lambda: len(landing.runs) == 2)
    assert landing.is_open and work.answer is None
    assert landing.ended == [{"is_next_wanted": True}]
    assert scanning.in_the_making == {"s"}
    slow.may_end.set()
    until(lambda: work.answer)
    assert slow.written == ["s"]
    assert isinstance(work.answer, Answer) and work.answer.result is Result.ACCEPTED
    until(lambda: not scanning.in_the_making)
    assert not landing.is_open and scanning.phase is Phase.SCANNING
    scanning.end()
    assert not landing.daemon.vehicle.said


def test_a_fault_during_another_scan_is_reported(slow: Slow, landing: Landing) -> None:
    scanning, work = landing.daemon.scanning, landing.finalise()
    slow.error = OutsideError("the disk is full")
    scanning.start()
    until(lambda: scanning.life.state is State.WAITING)
    scanning.start()
    until(lambda: len(landing.runs) == 2)
    slow.may_end.set()
    until(lambda: work.answer)
    text = "Scan s is stored, its files are not written: the disk is full"
    assert landing.daemon.vehicle.said == [text]
    assert isinstance(work.answer, Answer) and work.answer.result is Result.FAILED
    assert not landing.is_open and scanning.fault == ""
    scanning.end()


def test_the_service_ends_when_they_are_written(slow: Slow, landing: Landing) -> None:
    scanning = landing.daemon.scanning
    landing.finalise()
    scanning.start()
    until(lambda: scanning.life.state is State.WAITING)
    waits = list[bool]()

    def wait() -> None:
        waits.append(landing.is_open)
        slow.may_end.set()

    scanning.end(wait)
    assert waits[0] and not landing.is_open
    assert scanning.life.state is State.ENDED
