"""The emulated slow board: who is slowed, and what its sheet says."""

from __future__ import annotations

import subprocess
import sys
import time

import psutil  # type: ignore[import-untyped]
from bench_slow_board import Look, figures, slowed


def test_a_slowed_process_stands_still_for_a_while_and_runs_on() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", "while True: pass"], stdin=subprocess.DEVNULL
    ) as busy:
        try:
            seen = psutil.Process(busy.pid)
            with slowed(busy.pid, 0.5):
                while seen.status() != psutil.STATUS_STOPPED:
                    time.sleep(0.001)
                while seen.status() == psutil.STATUS_STOPPED:
                    time.sleep(0.001)
            while seen.status() == psutil.STATUS_STOPPED:
                time.sleep(0.001)
        finally:
            busy.kill()


def test_the_sheet_tells_steps_and_what_is_late_after_them() -> None:
    looks = [
        Look(0.0, 0, "full", 2.0, 10, 90, 1, 1),
        Look(15.0, 1, "lower rate", 1.0, 110, 190, 4, 4),
        Look(40.0, 2, "lower resolution", 0.2, 300, 200, 10, 6),
        Look(60.0, 2, "lower resolution", 0.1, 600, 300, 30, 6),
    ]
    steps, age, missed, dropped = figures("half", looks)
    assert steps.value == 2 and steps.note == "lower rate at 15 s; lower resolution at 40 s"
    assert 0.1 < age.value <= 0.2 and age.ratio is not None and age.ratio < 1
    assert missed.value == 25.0 and missed.note == "300 of 900 in the whole flight"
    assert dropped.value == 0.0 and dropped.note == "30 keyframes in 60 s"
