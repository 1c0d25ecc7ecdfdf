"""The installation: three plain packages side by side, layered, with the promised files."""

from __future__ import annotations

import ast
import importlib.util
import re
import subprocess
import sys
import zipfile
from importlib.metadata import version
from pathlib import Path

import msgspec.toml
import pytest
from paths import ROOT

PACKAGES = ("service", "recon", "mavlink")


def test_three_packages_share_a_parent_folder() -> None:
    """A foreign package of one of these names would hide ours without any error."""
    parents = set()
    for name in PACKAGES:
        spec = importlib.util.find_spec(name)
        assert spec is not None
        assert spec.origin is not None
        parents.add(Path(spec.origin).resolve().parent.parent)
    assert len(parents) == 1


def test_layers_hold() -> None:
    done = subprocess.run(
        [sys.executable, "-c", "from importlinter.cli import lint_imports_command as run; run()"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert ", 0 broken" in done.stdout


@pytest.mark.slow
def test_recon_touches_nothing_outside() -> None:
    """No clock, file, socket or environment in the mathematics."""
    forbidden = {"time", "datetime", "os", "io", "pathlib", "socket", "subprocess", "random"}
    found = []
    for path in sorted((ROOT / "recon").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [node.module or ""]
            found += [
                f"{path.relative_to(ROOT)}: {n}" for n in names if n.split(".")[0] in forbidden
            ]
    assert found == []


@pytest.mark.slow
def test_wheel_holds_the_packages_and_nothing_else(tmp_path: Path) -> None:
    pytest.importorskip("hatchling")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        timeout=120,
        check=True,
    )
    (wheel,) = tmp_path.glob("skyrelief-*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert "recon/py.typed" in names  # a program that uses the library is checked against its types
    tops = {name.split("/")[0] for name in names}
    info = f"skyrelief-{version('skyrelief')}"
    assert tops <= {*PACKAGES, f"{info}.dist-info", f"{info}.data"}
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            assert str(path.relative_to(ROOT)) in names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    brought = {name.partition("/share/skyrelief/")[2] for name in names}
    flight = [p for p in (ROOT / "demo").rglob("*") if p.is_file()]
    assert flight and {p.relative_to(ROOT).as_posix() for p in flight} <= brought
    entry = zipfile.ZipFile(wheel).read(f"{info}.dist-info/entry_points.txt").decode()
    assert "skyrelief = service.cli:main" in entry


@pytest.mark.parametrize("source", ["src/jobs.ts", "src/style.css", "index.html"])
def test_make_installs_again_when_the_portal_page_changes(tmp_path: Path, source: str) -> None:
    def said(*options: str) -> str:
        order = ("make", "--dry-run", f"VENV={tmp_path}", *options, str(tmp_path / "core"))
        return subprocess.run(order, cwd=ROOT, capture_output=True, text=True, check=True).stdout

    (tmp_path / "core").touch()
    assert "pip install" not in said()
    assert "pip install" in said("--what-if", f"service/ground/web/{source}")


def test_systemd_folder_is_no_package() -> None:
    """With an __init__.py it would hide the systemd Python package from the repo's root."""
    assert not (ROOT / "systemd" / "__init__.py").exists()
    assert not list((ROOT / "tests").rglob("__init__.py"))


def test_every_dependency_is_pinned() -> None:
    project = msgspec.toml.decode((ROOT / "pyproject.toml").read_bytes())["project"]
    extras = project["optional-dependencies"].values()
    wanted = [*project["dependencies"], *(r for extra in extras for r in extra)]
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pinned = {_plain(line.split("==")[0]) for line in lines if "==" in line}
    missing = [r for r in wanted if _plain(re.split(r"[<>=~!;\[ ]", r)[0]) not in pinned]
    assert missing == []


def test_readme_tells_every_command() -> None:
    from service.cli import COMMANDS

    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    missing = [name for name in COMMANDS if f"`{name}" not in readme]
    assert missing == []


def _plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).strip().lower()
