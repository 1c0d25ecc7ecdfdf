"""The files of a scan that has ended: waited for, unless another scan is to begin."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from loopback import until

from mavlink.component.control import Answer, Result, Work
from service.daemon.writing import Writings
from service.errors import OutsideError
from service.stream.records import ScanHeader
from service.stream.store import ScanStore


class Slow:
    """Files that are written once they may, or not at all."""

    def __init__(self) -> None:
        self.may_end = threading.Event()
        self.error: Exception | None = None
        self.written: list[str] = []

    def __call__(self, folder: Path, store: ScanStore, extra: object) -> None:
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
        self.reported: list[str] = []
        self.asked: list[str] = []
        self.work = Work()
        self.is_next_wanted = threading.Event()
        self.writings = Writings(self.reported.append, files)

    def write(self) -> None:
        self.writings.write(
            self.store.path.parent,
            self.store,
            self.is_next_wanted.is_set,
            self._land,
            self._hand_over,
        )

    def _land(self) -> None:
        self.asked.append("land")

    def _hand_over(self) -> Work:
        self.asked.append("hand over")
        return self.work

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
    waiting = threading.Thread(target=landing.write)
    waiting.start()
    until(lambda: [uses for uses, _ in landing.writings.marks()] == [0])  # its thread is known
    assert landing.writings.names == {"s"}
    before = landing.writings.marks()
    assert landing.writings.marks() == before
    assert not landing.asked
    slow.may_end.set()
    waiting.join()
    assert slow.written == ["s"]
    assert landing.asked == ["land"]
    assert not landing.is_open
    assert len(landing.writings) == 0
    assert landing.work.answer is None


def test_what_went_wrong_with_them_is_raised(slow: Slow, landing: Landing) -> None:
    slow.error = OutsideError("the disk is full")
    slow.may_end.set()
    with pytest.raises(OutsideError, match="the disk is full"):
        landing.write()
    assert landing.asked == ["land"]
    assert not landing.is_open
    assert not landing.reported


def test_another_scan_does_not_wait_for_them(slow: Slow, landing: Landing) -> None:
    landing.is_next_wanted.set()
    landing.write()
    assert landing.asked == ["hand over"]
    assert landing.is_open
    assert landing.writings.names == {"s"}
    assert landing.work.answer is None
    slow.may_end.set()
    until(lambda: len(landing.writings) == 0)
    assert slow.written == ["s"]
    until(lambda: landing.work.answer)
    assert landing.work.answer is not None and landing.work.answer.result is Result.ACCEPTED
    assert not landing.is_open
    assert not landing.reported


def test_a_fault_during_another_scan_is_reported(slow: Slow, landing: Landing) -> None:
    slow.error = OutsideError("the disk is full")
    landing.is_next_wanted.set()
    landing.write()
    slow.may_end.set()
    until(lambda: landing.work.answer)
    assert landing.reported == ["Scan s is stored, its files are not written: the disk is full"]
    answer = landing.work.answer
    assert isinstance(answer, Answer) and answer.result is Result.FAILED
    assert not landing.is_open
