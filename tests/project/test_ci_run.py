"""``.ci/run``: the machine as it is first, then what was skipped, with what could be installed."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from paths import ROOT

ONE_TEST = """
import shutil
import pytest

@pytest.mark.parametrize("name", ["a b", "c[d]"])
def test_with_the_tool(name):
    print("ran", name)
    if shutil.which("ffmpeg") is None:
        pytest.skip("needs the ffmpeg command")
    assert WORKS

def test_of_the_core():
    assert CORE
"""
MODULE = """
import shutil
import pytest
if shutil.which("ffmpeg") is None:
    pytest.skip("needs the ffmpeg command", allow_module_level=True)

def test_of_the_module():
    pass
"""
TOOLS = {
    "make": '#!/bin/bash\nexec "$PYTHON" -m pytest -q "${2#ARGS=}"\n',
    "apt-get": '#!/bin/bash\n[[ $1 != install ]] || ln -s /bin/true "$(dirname "$0")/ffmpeg"\n',
    "id": "#!/bin/bash\necho 0\n",
}


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    """A machine without ffmpeg, whose apt-get installs it, with a small project."""
    for name in ("tools", "project/.ci", "project/.venv/bin", "project/tests"):
        (tmp_path / name).mkdir(parents=True)
    for name in ("bash", "dirname", "mktemp", "rm", "wc", "ln", "env", "sh"):
        (tmp_path / "tools" / name).symlink_to(str(shutil.which(name)))
    for name, text in TOOLS.items():
        path = tmp_path / "tools" / name
        path.write_text(text)
        path.chmod(0o755)
    project = tmp_path / "project"
    shutil.copy(ROOT / ".ci" / "run", project / ".ci" / "run")
    python = project / ".venv" / "bin" / "python"
    python.write_text(f'#!/bin/bash\nexec "{sys.executable}" "$@"\n')
    python.chmod(0o755)
    shutil.copytree(ROOT / "service", project / "service", ignore=shutil.ignore_patterns("web"))
    (project / "tests" / "test_module.py").write_text(MODULE)
    return project


def run(project: Path, core: bool = True, works: bool = True) -> subprocess.CompletedProcess[str]:
    text = ONE_TEST.replace("WORKS", str(works)).replace("CORE", str(core))
    (project / "tests" / "test_one.py").write_text(text)
    tools = project.parent / "tools"
    return subprocess.run(
        [str(project / ".ci" / "run")],
        env={
            "PATH": str(tools), "PYTHON": sys.executable, "HOME": os.environ.get("HOME", "/"),
            "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PYTEST_ADDOPTS": "-p xdist.plugin",
            "PYTEST_XDIST_AUTO_NUM_WORKERS": "1",
        },
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip


def test_only_what_was_skipped_runs_again(machine: Path) -> None:
    done = run(machine)
    assert done.returncode == 0, done.stdout + done.stderr
    first, _, second = done.stdout.partition("once more, with ")
    assert "1 passed, 3 skipped" in first
    assert "ffmpeg" in second.splitlines()[0] and "the 3 that were skipped" in second
    assert "3 passed" in second


@pytest.mark.parametrize("broken", ["core", "works"])
def test_a_failure_of_either_run_fails_it(machine: Path, broken: str) -> None:
    assert run(machine, **{broken: False}).returncode == 1
