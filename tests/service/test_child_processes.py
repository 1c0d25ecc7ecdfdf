"""Processes that are started in a stranger's folder run none of the code in it."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest
from paths import ROOT

from service.workers import python_command

CHILDREN = {
    "service.cli", "service.commands.demo", "service.ground.live_site", "service.scans.folder"
}  # fmt: skip
"""Modules of ours that run as processes of their own."""


@pytest.fixture
def card(tmp_path: Path) -> Path:
    """A folder whose modules have the names of ours and of libraries."""
    trap = f"open({str(tmp_path / 'ran')!r}, 'a').write(__file__)\n"
    card = tmp_path / "card"
    for package in ("service", "recon"):
        (card / package).mkdir(parents=True)
        (card / package / "__init__.py").write_text(trap)
    for module in ("numpy", "runpy", "typer", "msgspec", "sitecustomize"):
        (card / f"{module}.py").write_text(trap)
    return card


@pytest.mark.parametrize("arguments", [("service.cli", "--version"), ("service.version",)])
def test_a_child_imports_nothing_from_the_current_folder(
    card: Path, arguments: tuple[str, ...]
) -> None:
    done = subprocess.run(python_command(*arguments), cwd=card, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert not (card.parent / "ran").exists()


def test_every_child_is_started_that_way() -> None:
    modules: set[str] = set()
    for path in sorted((ROOT / "service").rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if "sys.exec" in text or "python_c" in text else ():
            if isinstance(node, ast.List | ast.Tuple):
                starts_python = any(ast.unparse(entry) == "sys.executable" for entry in node.elts)
                assert not starts_python or name == "service.workers", f"{path}:{node.lineno}"
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "python_command":
                first = node.args[0]
                modules.add(str(first.value) if isinstance(first, ast.Constant) else name)
    assert modules == CHILDREN


def test_numba_takes_no_settings_from_the_current_folder(tmp_path: Path) -> None:
    (tmp_path / ".numba_config.yaml").write_text("cache_dir: cache\n")
    command = [str(Path(sys.executable).with_name("skyrelief")), "--version"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("skyrelief: .numba_config.yaml") and done.stderr.count("\n") == 1
