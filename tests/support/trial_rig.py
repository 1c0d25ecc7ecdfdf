"""Parts of the trials: the service as a process, its faults, and the table of outcomes."""

from __future__ import annotations

import fcntl
import json
import os
import platform
import resource
import signal
import socket
import sqlite3
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

from loopback import free_port
from paths import DEMO, demo_stretch

from recon.camera_model import scaled
from service.cameras.camera_file import load_camera, save_camera

WHOLE = os.environ.get("SKYRELIEF_TRIALS") == "whole"
PATIENCE_S = 120.0
BACK_S = 10.0 if WHOLE else 60.0


def crowd() -> float:
    """Processes that want each core; at least 1."""
    return max(1.0, max(os.getloadavg()[:2]) / (os.cpu_count() or 1))


def back_limit_s() -> float:
    """After a fault's cause is gone the service has to be scanning again within this: a promise on
    a machine of its own, and so many times as long where it shares the cores."""
    return BACK_S * crowd()


def demo_camera() -> str:
    """The demo's images there and back for minutes, no faster than a share of the cores permits."""
    return f"images:{demo_stretch(12)}?interval_s={max(1.0, 0.4 * crowd()):.1f}"


class Row(Protocol):
    """Adds one line to the table."""

    def __call__(
        self, fault: str, times: int, outcome: str, lost: str = "-", back_s: float | None = None
    ) -> None:
        """``lost``: acknowledged data lost; ``back_s``: the longest until scanning again."""
        ...


@dataclass(frozen=True, slots=True)
class Line:
    """One fault that was tried."""

    fault: str
    times: int
    outcome: str
    lost: str
    back_s: float | None
    when: str = "-"  # UTC


class Table:
    """The outcomes, kept as JSON; lines of earlier runs stay until tried again.

    Several runs may fill one table at the same time. docs/report.py makes a page of it.
    """

    def __init__(self, target: Path | None) -> None:
        self._target = target

    def add(
        self, fault: str, times: int, outcome: str, lost: str = "-", back_s: float | None = None
    ) -> None:
        """See :class:`Row`. Written at once: a run that is broken off keeps what it found."""
        if self._target is None:
            return
        now = time.strftime("%Y-%m-%d %H:%M", time.gmtime())
        rounded = None if back_s is None else round(back_s, 1)
        with self._target.open("a+", encoding="utf-8") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            file.seek(0)
            known = json.loads(file.read() or '{"trials": []}')["trials"]
            lines = {line["fault"]: Line(**line) for line in known}
            lines[fault] = Line(fault, times, outcome, lost, rounded, now)
            content = {
                "machine": machine(),
                "trials": [asdict(lines[name]) for name in sorted(lines)],
            }
            self._target.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def machine() -> str:
    """The machine that the trials run on, in words."""
    return f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}"


def answer(port: int, path: str = "/status") -> dict[str, Any]:
    """The JSON answer of a health page; empty while nothing answers."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=5) as page:
            return dict(json.loads(page.read()))
    except urllib.error.HTTPError as error:
        with error:
            return dict(json.loads(error.read()))
    except (OSError, ValueError):
        return {}


class Service:
    """The daemon as a process of its own, looking at the demo flight as its camera."""

    def __init__(
        self,
        folder: Path,
        start: str = "on-boot",
        environment: dict[str, str] | None = None,
        camera: str = "",
        model: Path = DEMO / "camera.yaml",
        largest_file_bytes: int | None = None,
        scans: Path | None = None,
        more: str = "",
        compute: str = "",
    ) -> None:
        """``camera`` is :func:`demo_camera` if none is given; ``more`` sections and lines of
        ``compute`` go into the configuration."""
        self.port = free_port(socket.SOCK_STREAM)
        self.configuration = folder / "skyrelief.toml"
        self.scans = scans or folder / "scans"
        self.configuration.write_text(
            f'[camera]\nsource = "{camera or demo_camera()}"\nmodel = "{model}"\n'
            f'[scan]\nfolder = "{self.scans}"\nstart = "{start}"\n'
            f'[compute]\nbackend = "cpu"\nguide_width = 320\n{compute}'
            f'[health]\nhttp = "127.0.0.1:{self.port}"\n{more}'
        )
        self.log = folder / "log.txt"
        self.began_s = time.monotonic()
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "service.cli", "run", "--config", str(self.configuration)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env={**os.environ, **(environment or {})},
                preexec_fn=lambda: _limit_files(largest_file_bytes),
            )

    def __enter__(self) -> Service:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()

    def get(self, path: str = "/status") -> dict[str, Any]:
        """The JSON answer of the health page; empty while nothing answers."""
        return answer(self.port, path)

    @property
    def frames(self) -> int:
        """Of the scan that runs; 0 when none does."""
        return int(self.get().get("frames", 0))

    def until(self, reached: Callable[[], Any], what: str, limit_s: float = PATIENCE_S) -> float:
        """Seconds until ``reached``; fails with the log when the process ends, or after
        ``limit_s``, which is for a machine of its own."""
        start = time.monotonic()
        while not reached():
            alive = self.process.poll() is None
            late = time.monotonic() > start + limit_s * crowd()
            assert alive and not late, f"{what}:\n{self.log.read_text()[-3000:]}"
            time.sleep(0.05)
        return time.monotonic() - start

    def until_up(self) -> None:
        """Wait for the end of the start."""
        self.until(lambda: self.get().get("state") not in (None, "starting"), "up")

    def until_more_frames(self, what: str) -> float:
        """Seconds until a frame is processed that was not before."""
        before = (self.get().get("scan"), self.frames)
        return self.until(
            lambda: self.frames > 0 and (self.get().get("scan"), self.frames) != before, what
        )

    def said(self, text: str) -> int:
        """How often the log says ``text``."""
        return self.log.read_text(errors="replace").count(text)

    def reload(self, *changes: tuple[str, str]) -> None:
        """Replace texts in the configuration and have it read again."""
        text = self.configuration.read_text()
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        self.configuration.write_text(text)
        self.process.send_signal(signal.SIGHUP)

    def stop(self) -> int:
        """The exit code after a TERM signal."""
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(timeout=PATIENCE_S * crowd())


def _limit_files(largest_bytes: int | None) -> None:
    """In the child: writing beyond ``largest_bytes`` of any file fails, as on a full disk."""
    if largest_bytes is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest_bytes, largest_bytes))


Chunk = tuple[str, int, int, int]


def with_site(folder: Path, code: str) -> dict[str, str]:
    """The environment in which every Python process runs ``code`` at its start."""
    site = folder / "site"
    site.mkdir()
    (site / "sitecustomize.py").write_text(code)
    return {"PYTHONPATH": os.pathsep.join([str(site), os.environ.get("PYTHONPATH", "")])}


def scan_folders(scans: Path) -> list[Path]:
    """The folders of scans by name, if any yet; the service keeps a file of its own among them."""
    return sorted(path for path in scans.glob("*") if path.is_dir())


def stored(scans: Path) -> set[Chunk]:
    """(scan, keyframe, layer, checksum) of every chunk that a store has acknowledged."""
    found: set[Chunk] = set()
    for path in scans.rglob("scan.db"):
        try:
            with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as db:
                rows = db.execute("SELECT seq, layer, crc FROM chunks").fetchall()
        except sqlite3.Error:
            continue  # being made
        found |= {(path.parent.name, *row) for row in rows}
    return found


def burn(processes: int) -> list[subprocess.Popen[bytes]]:
    """So many processes that only take time."""
    return [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(processes)]


def small_model(folder: Path, width: int = 320) -> Path:
    """The demo's camera model for images of ``width`` pixels."""
    path = folder / "camera.yaml"
    save_camera(path, scaled(load_camera(DEMO / "camera.yaml"), (width, width * 3 // 4)))
    return path


def stream_to(port: int, size: str = "320:240", source: str = "") -> subprocess.Popen[bytes]:
    """FFmpeg sending the demo's images, or a video, in a loop by UDP."""
    given = source or f"-framerate 2 -pattern_type glob -i {demo_stretch()}/*.jpg"
    command = (
        f"ffmpeg -v error -re -stream_loop -1 {given} -vf scale={size} -c:v libx264 "
        f"-preset ultrafast -tune zerolatency -g 2 -f mpegts udp://127.0.0.1:{port}?pkt_size=1316"
    )
    return subprocess.Popen(command.split(), stdin=subprocess.DEVNULL)
