"""The end of a scan: by TERM, and where closing it hangs."""

from __future__ import annotations

import json
import signal
import socket
import threading
import time
from pathlib import Path

import pytest
from loopback import free_port
from trial_autopilot import Autopilot
from trial_rig import WHOLE, Row, Service, back_limit_s, scan_folders, stored, with_site

from service.stream.store import ScanStore

pytestmark = [pytest.mark.trial, pytest.mark.timeout(900 if WHOLE else 280)]


def test_term_closes_the_scan(tmp_path: Path, record: Row) -> None:
    with Service(tmp_path) as service:
        service.until(lambda: stored(service.scans), "a chunk")
        assert service.stop() == 0
        (folder,) = scan_folders(service.scans)
        with ScanStore.open(folder / "scan.db") as store:
            assert store.finished
            assert store.summary is not None
            assert "interrupted" not in store.summary, service.log.read_text()[-3000:]
        assert (folder / "preview.jpg").is_file()
    record("TERM while scanning", 1, "scan closed, files written", "nothing")


HANGS = """
import os, time
_file = os.environ["TRIAL_HANGS"]
import service.daemon.runtime as _runtime
_runtime.CLOSING_S = 5.0
import service.scans.fused_cloud as _fused
import service.scans.folder as _folder
_right = _fused.fused_cloud
def _hang(*arguments):
    while os.path.exists(_file):
        time.sleep(0.1)
    return _right(*arguments)
_fused.fused_cloud = _folder.fused_cloud = _hang
"""

WATCHDOG_S = 2.0


class Watchdog(threading.Thread):
    """As systemd's: kills a process that has fed it once and then not for so long."""

    def __init__(self, path: Path) -> None:
        super().__init__(daemon=True)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self._socket.settimeout(WATCHDOG_S)
        self.service: Service | None = None
        self.fed = 0
        self.bit = threading.Event()

    def run(self) -> None:
        """Watch until it has bitten."""
        while not self.bit.is_set():
            try:
                self.fed += self._socket.recv(200).startswith(b"WATCHDOG=1")
            except TimeoutError:
                if self.fed and self.service is not None:
                    self.bit.set()
                    self.service.process.send_signal(signal.SIGABRT)
        self._socket.close()


@pytest.mark.skipif(not WHOLE, reason="only in the whole trials")
def test_closing_that_hangs_ends_in_a_restart(tmp_path: Path, record: Row) -> None:
    """The limit is shortened to 5 s; what hangs is the fusing of the cloud, after the store."""
    hangs, notify, link = tmp_path / "hangs", tmp_path / "notify", free_port()
    hangs.touch()
    more = f'[datalink]\ndrain_s = 0\n[mavlink]\nlinks = ["udpin:127.0.0.1:{link}"]\n'
    environment = with_site(tmp_path, HANGS) | {"TRIAL_HANGS": str(hangs)}
    watchdog, autopilot = Watchdog(notify), Autopilot(link, attitude=False)
    watchdog.start()
    autopilot.start()
    heard = environment | {"NOTIFY_SOCKET": str(notify)}
    with Service(tmp_path, "on-arm", heard, more=more) as service:
        watchdog.service = service
        service.until_up()
        autopilot.armed.set()
        service.until(lambda: stored(service.scans), "a chunk")
        time.sleep(2.0)
        acknowledged, fed = stored(service.scans), watchdog.fed
        (scan,) = scan_folders(service.scans)
        autopilot.armed.clear()
        start = time.monotonic()
        while service.process.poll() is None and time.monotonic() < start + 60.0:
            time.sleep(0.05)
        noticed_s = time.monotonic() - start
        autopilot.ended.set()
        assert watchdog.bit.is_set()
        assert watchdog.fed > fed > 3
    hangs.unlink()
    began = time.monotonic()
    with Service(tmp_path, "on-boot", environment, more=more) as again:
        again.until(lambda: again.frames > 0, "frames")
        back_s = time.monotonic() - began
        again.until((scan / "scan.json").is_file, "the files of the scan that hung")
        assert again.stop() == 0
    lost = acknowledged - stored(again.scans)
    record(
        "closing a scan hangs (limit shortened to 5 s)",
        1,
        f"ended by the watchdog after {noticed_s:.0f} s, started again; the scan is kept, closed",
        f"{len(lost)} of {len(acknowledged)} chunks",
        back_s,
    )
    assert not lost
    assert json.loads((scan / "scan.json").read_text())["finished"] is True
    assert (scan / "cloud.laz").stat().st_size > 0
    assert back_s < back_limit_s()


def _state(service: Service) -> tuple[str, bool]:
    """The service's, and whether the scan has keyframes."""
    status = service.get()
    return str(status.get("state")), status.get("clouds", 0) > 0


def test_taking_off_while_files_are_written(tmp_path: Path, record: Row) -> None:
    """The next flight does not wait for them, however long they take."""
    hangs, link = tmp_path / "hangs", free_port()
    hangs.touch()
    more = f'[datalink]\ndrain_s = 0\n[mavlink]\nlinks = ["udpin:127.0.0.1:{link}"]\n'
    environment = with_site(tmp_path, HANGS) | {"TRIAL_HANGS": str(hangs)}
    autopilot = Autopilot(link, attitude=False)
    autopilot.start()
    with Service(tmp_path, "on-arm", environment, more=more) as service:
        service.until_up()
        autopilot.armed.set()
        service.until(lambda: stored(service.scans), "a chunk")
        (first,) = scan_folders(service.scans)
        autopilot.armed.clear()
        service.until(lambda: service.get().get("state") == "finalising", "landing")
        autopilot.armed.set()
        again = ("scanning", True)
        back_s = service.until(lambda: _state(service) == again, "take-off")
        assert service.get()["scan"] != first.name
        assert not (first / "scan.json").exists()
        acknowledged = stored(service.scans)
        hangs.unlink()
        service.until((first / "scan.json").is_file, "the files of the first flight")
        assert service.stop() == 0
        autopilot.ended.set()
    lost = acknowledged - stored(service.scans)
    record(
        "take-off while the last flight's files are written",
        1,
        "scanning in parallel; both scans have their files",
        f"{len(lost)} of {len(acknowledged)} chunks",
        back_s,
    )
    assert not lost
    for folder in scan_folders(service.scans):
        assert json.loads((folder / "scan.json").read_text())["finished"] is True
        assert (folder / "cloud.laz").is_file()
    assert "Scan starts when the previous one is closed" in autopilot.texts
    assert back_s < back_limit_s()
