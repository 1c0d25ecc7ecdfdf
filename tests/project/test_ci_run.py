"""``.ci/run``: the quick tier on the machine as it is, then the rest with what it installed."""

from __future__ import annotations

import os
import re
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

@pytest.mark.slow
def test_that_is_slow():
    pass
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
    "make": '#!/bin/bash\n[[ $1 == test ]] && exec "$PYTHON" -m pytest -q -m "not slow"\n'
    'exec "$PYTHON" -m pytest -q "${2#ARGS=}"\n',
    "apt-get": '#!/bin/bash\n[[ $1 != install ]] || ln -s /bin/true "$(dirname "$0")/ffmpeg"\n',
    "id": "#!/bin/bash\necho 0\n",
}


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    """A machine without ffmpeg, whose apt-get installs it, with a small project."""
    for name in ("tools", "project/.ci", "project/.venv/bin", "project/tests/support"):
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
    shutil.copy(ROOT / "tests" / "support" / "tiers.py", project / "tests" / "support")
    (project / "tests" / "conftest.py").write_text('pytest_plugins = ["tiers"]\n')
    (project / "pytest.ini").write_text(
        "[pytest]\npythonpath = tests/support\nmarkers =\n    slow: not in the first run\n"
    )
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
            "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PYTEST_PLUGINS": "pytest_rerunfailures",
        },
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip


@pytest.mark.slow
def test_what_did_not_run_yet_runs_then(machine: Path) -> None:
    done = run(machine)
    assert done.returncode == 0, done.stdout + done.stderr
    first, _, second = done.stdout.partition("all that did not run yet")
    assert "1 passed, 3 skipped, 1 deselected" in first
    assert "4 passed, 1 deselected" in second  # the slow one, and those that ffmpeg kept back


@pytest.mark.slow
def test_what_cannot_be_installed_is_named(machine: Path) -> None:
    (machine.parent / "tools" / "id").write_text("#!/bin/bash\necho 1000\n")
    done = run(machine)
    assert done.returncode == 0 and "no ffmpeg" in done.stderr
    assert "1 passed, 3 skipped, 1 deselected" in done.stdout.partition("run yet")[2]


@pytest.mark.slow
def test_a_test_that_is_late_has_a_second_try(machine: Path) -> None:
    late = "tries = []\ndef test_late():\n    tries.append(1)\n    assert tries[1:]\n"
    (machine / "tests" / "test_late.py").write_text(late)
    done = run(machine)
    assert done.returncode == 0, done.stdout + done.stderr
    first, _, rest = done.stdout.partition("run yet")
    assert "1 rerun" in first and re.search(r"^\| all \| 5 \| \d+ \| 1 \|", rest, re.MULTILINE)


@pytest.mark.slow
@pytest.mark.parametrize("broken", ["core", "works"])
def test_a_failure_of_either_run_fails_it(machine: Path, broken: str) -> None:
    assert run(machine, **{broken: False}).returncode == 1
