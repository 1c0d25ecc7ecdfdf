"""The wait that the tests share: it ends when progress stops, not by the clock."""

from __future__ import annotations

import itertools
import time

import loopback
import pytest


def test_a_machine_that_stands_still_does_not_end_a_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = itertools.count(0.0, 3600.0)  # each look at the clock finds an hour gone
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    answers = iter([None, 0, "", "it came"])
    assert loopback.until(lambda: next(answers), 5.0) == "it came"


def test_progress_gives_more_time_and_its_end_ends_the_wait() -> None:
    paused: list[float] = []
    with pytest.raises(pytest.fail.Exception, match=r"no progress in 2.0 s, last 7"):
        loopback.until(lambda: False, 2.0, lambda: min(len(paused) // 50, 7), paused.append)
    assert sum(paused) == pytest.approx(7 * 50 * loopback.PAUSE_S + 2.0, abs=0.1)
