"""Downloads are pinned by hash, listed with its licence, and never run as root."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import msgspec.toml
import pytest
from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from paths import ROOT

PYTHONS = ("3.10", "3.11", "3.12", "3.13")
PIP = [sys.executable, "-m", "pip", "--disable-pip-version-check"]


def make_wheel(folder: Path, name: str, about: str, **files: str) -> Path:
    """A wheel that pip accepts."""
    path = folder / f"{name}-1.0-py3-none-any.whl"
    info = f"{name}-1.0.dist-info"
    with zipfile.ZipFile(path, "w") as wheel:
        wheel.writestr(f"{name}.py", "")
        wheel.writestr(
            f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n{about}"
        )
        wheel.writestr(
            f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        )
        for where, text in files.items():
            wheel.writestr(where.format(info=info), text)
        wheel.writestr(f"{info}/RECORD", "")
    return path


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    """A bundle of three wheels, with its inventory."""
    wheels = tmp_path / "wheels"
    wheels.mkdir()
    make_wheel(wheels, "skyrelief", "License-Expression: Apache-2.0\n")
    inside = {"video.libs/libx264-1.so.165": "", "{info}/licenses/LICENSE.txt": "Do as you like."}
    make_wheel(wheels, "video", "License-Expression: BSD-3-Clause\n", **inside)
    make_wheel(wheels, "links", "License: LGPLv3\n")
    script = ROOT / "deploy" / "inventory.py"
    subprocess.run([sys.executable, str(script), str(tmp_path)], check=True)
    return tmp_path


def install(bundle: Path) -> subprocess.CompletedProcess[str]:
    """Install the wheels as deploy/install.sh does."""
    return subprocess.run(
        [
            *PIP, "install", "--no-index", "--find-links", str(bundle / "wheels"),
            "--require-hashes", "-r", str(bundle / "requirements.txt"),
            "--target", str(bundle / "installed"),
        ],
        capture_output=True, text=True, timeout=120, check=False,
        env={**os.environ, "PIP_CONFIG_FILE": os.devnull, "PIP_FIND_LINKS": ""},
    )  # fmt: skip


@pytest.mark.slow
def test_a_bundle_installs_and_a_wheel_that_was_exchanged_does_not(bundle: Path) -> None:
    done = install(bundle)
    assert done.returncode == 0, done.stderr
    make_wheel(bundle / "wheels", "links", "License: LGPLv3\n", evil="")
    done = install(bundle)
    assert done.returncode != 0
    assert "DO NOT MATCH THE HASHES" in done.stderr


def test_the_sbom_names_every_wheel_by_its_hash(bundle: Path) -> None:
    document = json.loads((bundle / "sbom.cdx.json").read_text())
    assert (document["bomFormat"], document["specVersion"]) == ("CycloneDX", "1.6")
    own = document["metadata"]["component"]
    listed = {c["purl"]: c["hashes"][0]["content"] for c in [own, *document["components"]]}
    wheels = {path.name.split("-")[0]: path for path in (bundle / "wheels").iterdir()}
    assert listed == {
        f"pkg:pypi/{name}@1.0": hashlib.sha256(path.read_bytes()).hexdigest()
        for name, path in wheels.items()
    }
    assert own["name"] == "skyrelief"


def test_the_notices_say_who_asks_for_more(bundle: Path) -> None:
    text = (bundle / "THIRD_PARTY_NOTICES").read_text()
    asking = text.partition("ask for more")[2].partition("All packages:")[0]
    assert "video 1.0: BSD-3-Clause; contains libx264-1.so.165 (GPL-2.0-or-later)" in asking
    assert "links 1.0: LGPLv3" in asking and "skyrelief" not in asking
    assert "Do as you like." in text


def locked(name: str, python: str) -> dict[str, str]:
    """Package to version of a file in deploy/locked, for one Python."""
    found: dict[str, str] = {}
    text = (ROOT / "deploy" / "locked" / f"{name}.txt").read_text().replace("\\\n", " ")
    for line in filter(lambda line: line and line[0] != "#", text.splitlines()):
        pin, *hashes = re.split(r"\s+--hash=", line.strip())
        assert hashes and all(re.fullmatch(r"sha256:[0-9a-f]{64}", h) for h in hashes), line
        wanted = Requirement(pin)
        if holds(wanted, python):
            (only,) = wanted.specifier
            assert only.operator == "==" and canonicalize_name(wanted.name) not in found
            found[canonicalize_name(wanted.name)] = only.version
    return found


def holds(wanted: Requirement, python: str, extra: str = "") -> bool:
    """True when a requirement is for this Python on Linux."""
    here: dict[str, str] = {**default_environment(), "python_version": python, "extra": extra}  # type: ignore[dict-item]
    here["python_full_version"] = f"{python}.1"
    return wanted.marker is None or wanted.marker.evaluate(here)


@pytest.mark.parametrize("python", PYTHONS)
@pytest.mark.parametrize("extra", ["logs", "ground", "gpu", "onnx", "cluster"])
def test_what_an_extra_installs_is_locked_at_the_version_that_was_tested(
    extra: str, python: str
) -> None:
    project = msgspec.toml.decode((ROOT / "pyproject.toml").read_bytes())["project"]
    pins = locked(extra, python)
    for text in (*project["dependencies"], *project["optional-dependencies"][extra]):
        wanted = Requirement(text)
        if holds(wanted, python):
            assert wanted.specifier.contains(pins[canonicalize_name(wanted.name)], prereleases=True)
    tested: dict[str, str] = {}
    for line in (ROOT / "constraints.txt").read_text().splitlines():
        if "==" in line and holds(constraint := Requirement(line), python):
            (only,) = constraint.specifier
            tested[canonicalize_name(constraint.name)] = only.version
    differing = {n: (v, tested[n]) for n, v in pins.items() if tested.get(n, v) != v}
    assert differing == {}


@pytest.fixture
def page() -> Iterator[Path]:
    """A page to build, and an npm and a node that write down who called them."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o755)
        (folder / "web").mkdir()
        (folder / "bin").mkdir()
        npm = 'mkdir node_modules && echo "$(id -u) $*" >node_modules/called'
        node = 'mkdir dist && echo "$(id -u) $*" >dist/index.html'
        for tool, text in (("npm", npm), ("node", node)):
            path = folder / "bin" / tool
            path.write_text(f"#!/bin/sh\n{text}\n")
            path.chmod(0o755)
        yield folder


def hook() -> ModuleType:
    pytest.importorskip("hatchling")
    spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_npm_runs_no_scripts_and_nothing_as_root(
    page: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", f"{page / 'bin'}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.delenv("SUDO_UID", raising=False)
    made = hook()
    if os.geteuid() == 0:
        made.build_as_other(page / "web")
    else:
        made.build(page / "web", None, {})
    uid, *called = (page / "web" / "node_modules" / "called").read_text().split()
    assert called[:2] == ["ci", "--ignore-scripts"]
    assert uid != "0" and (page / "web" / "dist" / "index.html").read_text().split()[0] != "0"


def test_a_changed_page_is_built_again(page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the packages that are there; their own dist folders are part of them."""
    monkeypatch.setenv("PATH", f"{page / 'bin'}{os.pathsep}{os.environ['PATH']}")
    made, web = hook(), page / "web"
    package = web / "node_modules" / "vite" / "dist" / "cli.js"
    package.parent.mkdir(parents=True)
    package.touch()
    (web / "package-lock.json").touch()
    (web / "node_modules" / ".package-lock.json").touch()
    assert made.is_current(web)
    copy = page / "copy"
    shutil.copytree(web, copy, ignore=made.built_names(web))
    assert (copy / "node_modules" / "vite" / "dist" / "cli.js").is_file()
    assert made.is_current(copy)
    os.utime(web / "package-lock.json", (2e9, 2e9))
    assert not made.is_current(web)


def test_the_bundle_and_the_installer_check_hashes() -> None:
    for script in ("bundle.sh", "install.sh"):
        lines = (ROOT / "deploy" / script).read_text().replace("\\\n", " ").splitlines()
        fetching = [line for line in lines if re.search(r"pip\S* (\"\$@\"|install|download)", line)]
        assert fetching and all("--require-hashes" in line for line in fetching), fetching
