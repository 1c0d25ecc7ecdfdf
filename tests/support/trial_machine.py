"""A bare Debian that its own systemd boots, next to ours, for the trials of the installation.

The processes in it share our kernel and our network, and nothing else. Ending its first process
ends all of them at once, which is what a power cut looks like from inside.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

from paths import ROOT

PACKAGES = "python3,python3-venv,systemd,systemd-sysv,udev,dbus,libgl1,libglib2.0-0"
NEEDED = ("systemd-nspawn", "debootstrap", "nsenter")
VERSION = "3.11"
"""Of Python in Debian 12."""


def lacking() -> str:
    """The reason why this machine cannot boot another; empty when it can."""
    missing = [name for name in NEEDED if shutil.which(name, path=_PATH) is None]
    if os.geteuid() != 0:
        missing.append("root")
    if sys.version_info[:2] != tuple(int(part) for part in VERSION.split(".")):
        missing.append(f"Python {VERSION} to make the bundle with")
    return ", ".join(missing)


_PATH = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/sbin"])


class Machine:
    """A root folder that is booted and cut off at will; everything typed in it is written down."""

    def __init__(self, folder: Path) -> None:
        """The root is made by debootstrap, or copied from SKYRELIEF_BOOT_ROOT."""
        self.root = folder / "root"
        given = os.environ.get("SKYRELIEF_BOOT_ROOT", "")
        if given:
            _checked(["cp", "-a", given, str(self.root)])
        else:
            make = ["debootstrap", "--variant=minbase", f"--include={PACKAGES}", "bookworm"]
            _checked([*make, str(self.root)])
        (self.root / "etc" / "hostname").write_text("aircraft\n")
        self.transcript: list[str] = []
        self._console = folder / "console.txt"
        self._outside: subprocess.Popen[bytes] | None = None
        self._first = 0  # pid of the machine's own first process, seen from here

    def boot(self) -> float:
        """Power on; the monotonic time of it. Returns when systemd takes orders."""
        start = time.monotonic()
        with self._console.open("ab") as console:
            self._outside = subprocess.Popen(
                ["systemd-nspawn", "-q", "--register=no", "--keep-unit", "-bD", str(self.root)],
                stdin=subprocess.DEVNULL, stdout=console, stderr=console, start_new_session=True,
            )  # fmt: skip
        children = Path(f"/proc/{self._outside.pid}/task/{self._outside.pid}/children")
        while not (self.root / "run").is_dir() or not self._is_up(children):
            assert self._outside.poll() is None, self._console.read_text()[-2000:]
            assert time.monotonic() < start + 60.0, self._console.read_text()[-2000:]
            time.sleep(0.05)
        return start

    def _is_up(self, children: Path) -> bool:
        found = children.read_text().split()
        if not found:
            return False
        self._first = int(found[0])
        done = self._inside("test -S /run/systemd/private && systemctl list-jobs", 10.0)
        return done.returncode == 0

    def cut(self) -> None:
        """Power off, at once."""
        if self._outside is None:
            return
        with contextlib.suppress(ProcessLookupError):
            os.kill(self._first or self._outside.pid, signal.SIGKILL)
        self._outside.wait(30)
        self._outside, self._first = None, 0

    def run(self, command: str, limit_s: float = 600.0) -> str:
        """Output of a command typed in the machine, with an exit code that is not 0."""
        done = self._inside(command, limit_s)
        said = done.stdout + ("" if done.returncode == 0 else f"(exit code {done.returncode})\n")
        self.transcript += [f"# {command}", said.rstrip("\n")]
        return said

    def ask(self, command: str) -> str:
        """The same, not written down."""
        return self._inside(command, 60.0).stdout.strip()

    def _inside(self, command: str, limit_s: float) -> subprocess.CompletedProcess[str]:
        enter = ["nsenter", "-t", str(self._first), "-m", "-u", "-i", "-p", "-C"]
        clean = ["env", "-i", "PATH=/usr/sbin:/usr/bin:/sbin:/bin", "HOME=/root", "LC_ALL=C.UTF-8"]
        return subprocess.run(
            [*enter, *clean, "bash", "-c", command],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            text=True, errors="replace", timeout=limit_s, check=False,
        )  # fmt: skip


def _checked(command: list[str]) -> None:
    done = subprocess.run(
        command, env={**os.environ, "PATH": _PATH}, stdin=subprocess.DEVNULL,
        capture_output=True, text=True, timeout=1800, check=False,
    )  # fmt: skip
    assert done.returncode == 0, (command, done.stdout[-1000:], done.stderr[-1000:])


def make_bundle(target: Path) -> None:
    """The folder that ``make bundle`` makes for the machine's Python."""
    bundle = ["bash", str(ROOT / "deploy" / "bundle.sh"), "--out", str(target)]
    _checked(["env", f"PYTHON={sys.executable}", *bundle])


def another_release(bundle: Path, target: Path, number: str, start: str = "") -> None:
    """The same bundle as release ``number``, whose package runs the code ``start`` at first."""
    shutil.copytree(bundle, target)
    release = target / "pyproject.toml"
    (old,) = [x for x in release.read_text().splitlines() if x.startswith("version = ")]
    release.write_text(release.read_text().replace(old, f'version = "{number}"'))
    (wheel,) = (target / "wheels").glob("skyrelief-*.whl")
    other = wheel.with_suffix(".part")
    with zipfile.ZipFile(wheel) as source, zipfile.ZipFile(other, "w") as sink:
        for item in source.infolist():
            data = source.read(item)
            sink.writestr(item, data + start.encode() if item.filename == ENTRY else data)
    other.replace(wheel)
    _checked([sys.executable, str(target / "deploy" / "inventory.py"), str(target)])


ENTRY = "service/__init__.py"
