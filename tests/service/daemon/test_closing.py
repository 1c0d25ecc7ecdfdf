"""Closing a scan: progress is seen, a hang is found out, the scan is kept."""

from __future__ import annotations

import ctypes
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from loopback import until
from onboard import Onboard, real_scan
from paths import ROOT

from mavlink.component.control import Phase
from service.daemon import runtime
from service.daemon.scan_state import Event
from service.daemon.scanning import ScanRun, sizes
from service.memory import one_pool, release_memory


def test_files_grow_but_not_by_the_work_of_others(tmp_path: Path) -> None:
    assert sizes(tmp_path / "none") == ()
    (tmp_path / ".cloud.laz.part").write_bytes(b"12")
    before = sizes(tmp_path)
    for name in ("scan.db-wal", "scan.db", "link.tlog"):
        (tmp_path / name).write_bytes(b"acknowledged by the ground meanwhile")
    assert sizes(tmp_path) == before
    (tmp_path / ".cloud.laz.part").write_bytes(b"123")
    assert sizes(tmp_path) != before


class Hung:
    """A scan whose closing waits at a gate, then uses its store, then waits for good."""

    def __init__(self, folder: Path) -> None:
        self.scan = real_scan(folder / "s")
        self.store = self.scan.store
        self.closing, self.step, self.end = threading.Event(), threading.Event(), threading.Event()

    def __call__(self, run: ScanRun) -> None:
        run.scan, run.store = self.scan, self.store
        run.stop.wait(60.0)
        self.closing.set()
        self.step.wait(60.0)
        self.store.seqs()
        self.end.wait(60.0)

    def close(self) -> None:
        """End the scan's threads."""
        self.scan.mapper.finish()
        self.store.close()


def test_a_closing_that_hangs_is_no_progress(tmp_path: Path) -> None:
    now_s, hung = 0.0, Hung(tmp_path)
    daemon = Onboard(tmp_path, script=hung, clock_s=lambda: now_s)
    scanning = daemon.scanning
    limit_s = runtime.CLOSING_S + daemon.config.datalink.drain_s
    scanning.start()
    now_s = 10.0 * limit_s
    assert daemon.is_progressing  # scanning, not closing
    scanning.handle(Event.STOP)
    until(hung.closing.is_set)
    assert daemon.is_progressing
    now_s += 0.9 * limit_s
    assert daemon.is_progressing
    hung.store.set_held("ground", {})  # another thread's use of the store is no progress
    now_s += 0.2 * limit_s
    assert not daemon.is_progressing
    hung.step.set()  # a step of the closing itself is
    until(lambda: daemon.is_progressing)
    now_s += 1.1 * limit_s
    assert not daemon.is_progressing
    hung.end.set()
    until(lambda: scanning.run is None)
    assert daemon.is_progressing
    hung.close()


def test_systemd_is_asked_to_wait_only_while_closing_gets_on(tmp_path: Path) -> None:
    now_s, asked, hung = 0.0, list[float](), Hung(tmp_path)
    daemon = Onboard(tmp_path, script=hung, clock_s=lambda: now_s)
    scanning = daemon.scanning
    scanning.start()
    until(lambda: scanning.scan is not None)

    def alive() -> None:
        nonlocal now_s
        asked.append(now_s)
        now_s += 100.0  # no progress from here on
        hung.step.set()
        hung.end.set()

    scanning.end(alive)
    assert asked[0] == 0.0
    assert len(asked) <= 2
    hung.close()


def test_an_arming_while_the_last_scan_is_closed_is_followed_then(tmp_path: Path) -> None:
    hung = Hung(tmp_path)
    daemon = Onboard(tmp_path, "scan.start=on-arm", script=hung)
    scanning, reported = daemon.scanning, daemon.vehicle.said
    daemon.actions.is_ready = True

    def look(arming: bool) -> bool:
        daemon.vehicle.arm(arming)
        daemon.look()
        return daemon.vehicle.report().is_armed

    assert look(True)
    until(lambda: scanning.scan is not None)
    assert not look(False)
    assert scanning.life.state.is_closing
    assert look(True)
    assert reported == ["Scan starts when the previous one is closed"]
    assert not look(False)  # and off again
    hung.step.set()
    assert look(True)
    scanning.handle(Event.TICK)
    assert scanning.life.state.is_closing  # waits
    hung.end.set()
    until(lambda: scanning.run is None)
    hung.end.clear()
    scanning.handle(Event.TICK)
    until(lambda: scanning.run is not None and scanning.phase is Phase.SCANNING)
    daemon.actions.stop_scan()  # by command, in the air
    assert look(True)
    hung.end.set()
    until(lambda: scanning.run is None)
    assert look(True)
    scanning.handle(Event.TICK)
    assert scanning.run is None  # the operator's stop holds until the next take-off
    hung.close()


def test_large_arrays_stay_out_of_the_pool() -> None:
    script = (
        "import ctypes\n"
        "from service.memory import POOLED_BYTES, one_pool\n"
        "one_pool()\n"
        "libc, size = ctypes.CDLL(None), 2 * POOLED_BYTES\n"
        "libc.malloc.restype, libc.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]\n"
        "libc.free.argtypes = [ctypes.c_void_p]\n"
        "libc.free(libc.malloc(3 * size))\n"  # after this the library would pool what is smaller
        "libc.malloc(size)\n"
        "kinds = [('of', ctypes.c_size_t * 10)]\n"
        "info = type('Info', (ctypes.Structure,), {'_fields_': kinds})\n"
        "libc.mallinfo2.restype = info\n"
        "print(libc.mallinfo2().of[4] >= size)\n"
    )
    if not hasattr(ctypes.CDLL(None), "mallinfo2"):
        pytest.skip("the C library does not say what it holds")
    root = ROOT
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=root)
    assert run.stdout == "True\n", run.stderr


def test_memory_settings_are_taken_where_the_library_has_them() -> None:
    assert one_pool()
    assert release_memory() in (True, False)
    assert release_memory(collect=True) in (True, False)


def test_a_scan_is_finished_once(tmp_path: Path) -> None:
    """Whatever is stored is sent: two summaries would pass the radio."""
    scan, kinds = real_scan(tmp_path / "scan"), list[str]()
    scan.store.listen(lambda kind, number: kinds.append(kind))
    summary = scan.close()
    assert kinds.count("summary") == 1 and scan.store.summary == summary
    assert summary["clouds_per_second"] == 0.0
    scan.store.close()
