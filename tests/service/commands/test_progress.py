"""The progress of long work: shares, time left, cancelling, and what a terminal shows of it."""

from __future__ import annotations

import io
import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from contextlib import redirect_stderr
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Lock, Thread
from typing import TYPE_CHECKING, cast
from unittest.mock import Mock

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.commands import on_signals, replay, showing, speaking
from service.offline.exports.view import ExportOptions, ScanView, export
from service.progress import CancelledError, Progress

if TYPE_CHECKING:
    from house_flight import HouseFlight

    from service.flight.scan import Scan


@given(st.recursive(st.integers(0, 5), lambda inner: st.lists(inner, max_size=4), max_leaves=12))
def test_shares_grow_up_to_one_however_parts_are_nested(work: object) -> None:
    seen: list[float] = []
    progress = Progress(lambda now: seen.append(now.share))

    def do(one: object) -> None:
        if isinstance(one, int):
            assert len(list(progress.over(range(one), one))) == one
        elif isinstance(one, list):
            for number, inner in enumerate(one):
                with progress.part("inner", 1.0 / (len(one) - number)):
                    do(inner)

    with progress.part("all"):
        do(work)
    assert progress.share == pytest.approx(1.0)
    assert seen == sorted(seen) and min(seen) >= 0.0 and max(seen) <= 1.0 + 1e-9


def test_branches_share_the_work_of_several_threads() -> None:
    seen: list[float] = []
    progress = Progress(lambda now: seen.append(now.share))

    def do(branch: Progress) -> None:
        for _ in branch.over(range(50), 50):
            pass
        branch.share = 1.0
        branch("done")

    with progress.part("first", 0.5):
        pass
    with progress.part("both at once"):
        branches = progress.branches(2)
        threads = [Thread(target=do, args=(branch,)) for branch in branches]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert progress.share == pytest.approx(1.0) and progress.text == "done"
    assert seen == sorted(seen) and 0.5 < seen[60] < 1.0


def test_a_cancelled_work_stops_in_every_branch() -> None:
    progress = Progress()
    for branch in progress.branches(2):
        branch("goes on")
    progress.cancel()
    for branch in progress.branches(2):
        with pytest.raises(CancelledError):
            branch("ends")


def test_branches_say_what_each_does_until_it_has_ended() -> None:
    said: list[str] = []
    progress = Progress(lambda now: said.append(now.text))
    one, other = progress.branches(2)
    for branch in (one, other, one):
        branch("left" if branch is one else "right")
    with one.part("last of the left"):
        pass
    other("right")
    assert said == ["left", *2 * ["left; right"], "last of the left; right", "right"]


def test_equal_parts_take_equal_shares() -> None:
    progress, ends = Progress(), []
    for left in (4, 3, 2, 1):
        with progress.part("a quarter", 1.0 / left):
            pass
        ends.append(progress.share)
    assert ends == pytest.approx([0.25, 0.5, 0.75, 1.0])


def test_the_rest_takes_as_long_as_the_pace_so_far_says() -> None:
    now = [100.0]
    progress = Progress(clock=lambda: now[0])
    now[0] = 500.0  # it waited in a queue
    progress.begin()
    for _ in progress.over(range(4), 4):
        now[0] += 10.0
    assert progress.share == pytest.approx(0.75)
    assert progress.left_s == pytest.approx(40.0 * 0.25 / 0.75)
    assert Progress().left_s is None


def test_cancelled_work_stops_at_its_next_report_unless_it_is_committed() -> None:
    progress = Progress()
    done = []
    with pytest.raises(CancelledError):
        for n in progress.over(range(9), 9):
            done.append(n)
            if n == 2:
                progress.cancel()
    assert done == [0, 1, 2]
    late = Progress()
    late.commit("writing")
    late.cancel()
    late("still writing")


@pytest.mark.parametrize("after", [1, 4, 12])
def test_a_cancelled_export_leaves_nothing_behind(
    tmp_path: Path, house: HouseFlight, after: int
) -> None:
    house.flown(tmp_path).close()
    before = sorted(p.name for p in tmp_path.iterdir())
    reports = [0]

    def show(now: Progress) -> None:
        reports[0] += 1
        if reports[0] == after:
            now.cancel()

    with (
        pytest.raises(CancelledError),
        ScanView(tmp_path, progress=Progress(show)) as scan,
    ):
        export(scan, "dsm", None, ExportOptions())
    assert sorted(p.name for p in tmp_path.iterdir() if "scan.db" not in p.name) == [
        name for name in before if "scan.db" not in name
    ]


def test_without_a_terminal_steps_and_twentieths_are_lines() -> None:
    text = io.StringIO()
    with redirect_stderr(text), showing("mesh") as progress:
        progress("fusing")
        for _ in progress.over(range(3), 3):
            pass
        progress("texture")
    lines = ["fusing", "fusing, 30 %", "fusing, 65 %", "texture, 65 %"]
    assert text.getvalue().splitlines() == [f"mesh: {line}" for line in lines]


def test_a_long_step_without_a_terminal_is_said_again() -> None:
    text = io.StringIO()
    with redirect_stderr(text), speaking(quiet_s=0.05) as say:
        say("mesh: fusing")
        while text.getvalue().count("\n") < 3:
            time.sleep(0.01)
        say("mesh: texture")
    first, second, *_ = lines = text.getvalue().splitlines()
    assert first == "mesh: fusing" and re.fullmatch(r"mesh: fusing, for \d+ s", second)
    assert "mesh: texture" in lines


def test_ctrl_c_cancels_other_threads_too() -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt), showing("export") as progress:
            try:
                signal.raise_signal(signal.SIGINT)
            finally:
                with pytest.raises(CancelledError):
                    progress.branches(2)[1]("the other branch")
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_what_a_signal_does_may_wait_for_a_lock_that_the_main_thread_holds() -> None:
    """Such as that of the event for which it waits: set in the handler, both waited for ever."""
    lock, is_done = Lock(), Event()

    def act() -> None:
        with lock:
            is_done.set()

    before = signal.getsignal(signal.SIGUSR1)
    on_signals(act, signal.SIGUSR1)
    try:
        with lock:
            signal.raise_signal(signal.SIGUSR1)
        assert is_done.wait(60.0)
    finally:
        signal.signal(signal.SIGUSR1, before)


SCRIPT = """
import time
from service.commands import replay, showing
with showing("export") as progress, progress.part("fusing"):
    for _ in progress.over(range(4), 4):
        time.sleep(0.3)
print("done")
"""


def test_in_a_terminal_there_is_one_bar_with_percent_and_time_left() -> None:
    ours, theirs = pty.openpty()
    env = os.environ | {"TERM": "xterm", "COLUMNS": "100", "PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(
        [sys.executable, "-c", SCRIPT], stderr=theirs, stdout=subprocess.PIPE, env=env
    ) as process:
        os.close(theirs)
        shown = b""
        while select.select([ours], [], [], 30.0)[0]:
            try:
                shown += os.read(ours, 65536)
            except OSError:  # the other end is closed
                break
        assert process.stdout is not None and process.stdout.read() == b"done\n"
    os.close(ours)
    text = shown.decode()
    assert "export: fusing" in text and "75%" in text and "0:00:0" in text


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@dataclass
class Flown:
    """What the bar of a scan reads of it, and of its recorder."""

    frames: int = 2
    distance_m: float = 31.4
    keyframes: int = 1

    @property
    def recorder(self) -> Flown:
        return self


def test_a_replay_shows_its_share_and_its_figures() -> None:
    seen: list[tuple[str, float]] = []
    progress = Progress(lambda now: seen.append((now.text, round(now.share, 3))))
    scan, images, pipe = cast("Scan", Flown()), Mock(images=4), Mock(images=0)
    with redirect_stderr(Terminal()), progress.part("tracking", of_rest=0.9):
        show = replay.show_flown(images, progress)
        for _ in range(4):
            show(scan)
    assert seen[-1] == ("2 images, 31 m flown, 1 keyframes", 0.675)
    assert [share for _, share in seen] == [0.0, 0.0, 0.225, 0.45, 0.675]
    seen.clear()
    with redirect_stderr(Terminal()):
        replay.show_flown(pipe, progress)(scan)
    assert seen == [("2 images, 31 m flown, 1 keyframes", 0.9)]  # no share of a pipe
