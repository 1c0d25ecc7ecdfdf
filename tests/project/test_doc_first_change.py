"""CONTRIBUTING's first change works as it is written: it fails, then passes, in a copy."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from doc_pages import text_of
from paths import ROOT

SECTION = (
    text_of(ROOT / "CONTRIBUTING.md").partition("## Your first change")[2].partition("\n## ")[0]
)
CODE = re.findall(r"^```(?:python|markdown)\n(.*?)^```", SECTION, re.MULTILINE | re.DOTALL)
COMMANDS, RESULTS = "test_mavlink_commands.py", "test_mavlink_command_results.py"


def before(path: Path, mark: str, text: str) -> None:
    """Insert the text before the only line that begins with ``mark``."""
    code = text_of(path)
    (line,) = re.findall(rf"^{re.escape(mark)}", code, re.MULTILINE)
    path.write_text(code.replace(f"\n{line}", f"\n{text}{line}", 1), encoding="utf-8")


def ran(copy: Path, *names: str) -> subprocess.CompletedProcess[str]:
    """Run what concerns the command in files of tests/mavlink of the copy."""
    files = [f"tests/mavlink/{name}" for name in names]
    only = ["-k", "user_3 or 31012 or contract or page or unsupported"]
    command = [sys.executable, "-m", "pytest", "-q", "--noconftest", "-p", "no:cacheprovider"]
    return subprocess.run([*command, *only, *files], cwd=copy, capture_output=True, text=True)


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """What the tests of the commands need of the repository."""
    for name in ("mavlink", "tests/mavlink", "tests/support"):
        shutil.copytree(ROOT / name, tmp_path / name)
    (tmp_path / "docs").mkdir()
    for name in ("pyproject.toml", "docs/operators.md"):
        shutil.copy(ROOT / name, tmp_path / name)
    return tmp_path


@pytest.mark.slow
def test_the_first_change_fails_and_then_passes(copy: Path) -> None:
    test, function, line, case, row = CODE
    with (copy / "tests" / "mavlink" / COMMANDS).open("a", encoding="utf-8") as file:
        file.write(f"\n\n{test}")
    failed = ran(copy, COMMANDS)
    assert "1 failed" in failed.stdout and "assert [3] == [0]" in failed.stdout, failed.stdout
    commands = copy / "mavlink" / "component" / "commands.py"
    before(commands, "# Queries.", f"{function}\n\n")
    before(commands, "    2000: Command", line)
    before(copy / "tests" / "mavlink" / RESULTS, "    246: {", case)
    before(copy / "docs" / "operators.md", "| `PREFLIGHT_REBOOT_SHUTDOWN` 246", row)
    passed = ran(copy, COMMANDS, RESULTS)
    assert passed.returncode == 0, passed.stdout
    hints = "import typing, mavlink.component.commands as c; typing.get_type_hints(c.report_space)"
    typed = subprocess.run([sys.executable, "-c", hints], cwd=copy, capture_output=True, text=True)
    assert typed.returncode == 0, typed.stderr
