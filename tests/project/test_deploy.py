"""Installing on the aircraft: units that hold, a switch that is atomic and can be undone."""

from __future__ import annotations

import configparser
import os
import re
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from paths import ROOT

SCRIPTS = [ROOT / "deploy" / "install.sh", ROOT / "deploy" / "bundle.sh", ROOT / ".ci" / "run"]
UNITS = [ROOT / "systemd" / "skyrelief.service", ROOT / "systemd" / "skyrelief-ground.service"]

needs_systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="needs the systemd-analyze command"
)

STAND_IN = """#!/bin/bash
# Stands in for python3: makes environments of two scripts instead of some hundred megabytes.
case "$*" in
  "-I -m venv "*)
    mkdir -p "${@: -1}/bin"
    cp "$0" "${@: -1}/bin/python"
    printf '#!%s/bin/python\\n' "${@: -1}" > "${@: -1}/bin/skyrelief"
    chmod +x "${@: -1}/bin/skyrelief"
    printf 'command = %s\\n' "${@: -1}" > "${@: -1}/pyvenv.cfg" ;;
  "-I -m pip install"*) exit "${PIP_EXIT:-0}" ;;
  "-I -m service.cli config default"*) printf '[camera]\\n# %s\\n' "${@:6}" ;;
  "-I -c import service.cli"*) exit 0 ;;
  *) exec REAL "$@" ;;
esac
"""


class Machine:
    """A root folder in place of a machine, and a bundle that can be given new contents."""

    def __init__(self, folder: Path) -> None:
        self.root = folder / "root"
        self.python = folder / "python3"
        self.python.write_text(STAND_IN.replace("REAL", sys.executable))
        self.python.chmod(0o755)
        self.bundle = folder / "bundle"
        self.bundle.mkdir()
        for name in ("deploy", "systemd"):
            shutil.copytree(ROOT / name, self.bundle / name)
        shutil.copy(ROOT / "pyproject.toml", self.bundle)
        (self.bundle / "wheels").mkdir()
        (self.bundle / "requirements.txt").touch()

    def install(
        self, *arguments: str, folder: Path | None = None, **more: str
    ) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [str(self.bundle / "deploy" / "install.sh"), "--bundle", str(self.bundle), *arguments],
            env={**os.environ, "SKYRELIEF_ROOT": str(self.root), "PYTHON": str(self.python)} | more,
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )

    def release(self, contents: str) -> None:
        (self.bundle / "wheels" / "skyrelief.whl").write_text(contents)

    @property
    def home(self) -> Path:
        return self.root / "opt" / "skyrelief"

    @property
    def current(self) -> str:
        return (self.home / "current").readlink().name

    @property
    def versions(self) -> set[str]:
        return {p.name for p in (self.home / "versions").iterdir()}


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def test_scripts_are_clean() -> None:
    shellcheck = shutil.which("shellcheck", path=str(Path(sys.executable).parent))
    if shellcheck is None:
        pytest.skip("needs shellcheck (extra 'dev')")
    done = subprocess.run([shellcheck, *SCRIPTS], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_everything_lands_in_its_place(machine: Machine) -> None:
    done = machine.install()
    assert done.returncode == 0, done.stderr
    for name in (
        "etc/skyrelief/skyrelief.toml",
        "etc/systemd/system/skyrelief.service",
        "usr/lib/sysusers.d/skyrelief.conf",
        "usr/lib/tmpfiles.d/skyrelief.conf",
        "etc/udev/rules.d/60-skyrelief.rules",
        "etc/polkit-1/rules.d/50-skyrelief.rules",
        "etc/polkit-1/localauthority/50-local.d/50-skyrelief.pkla",
        "opt/skyrelief/current/bin/skyrelief",
    ):
        assert (machine.root / name).is_file(), name
    configuration = machine.root / "etc/skyrelief/skyrelief.toml"
    assert stat.S_IMODE(configuration.stat().st_mode) == 0o640  # the camera's password
    rules = (machine.root / "usr/lib/tmpfiles.d/skyrelief.conf").read_text().splitlines()
    assert "z /etc/skyrelief/skyrelief.toml 0640 root skyrelief -" in rules
    script = (machine.home / "current" / "bin" / "skyrelief").read_text()
    assert script == f"#!/opt/skyrelief/versions/{machine.current}/bin/python\n"


def test_modules_of_the_current_folder_are_not_run(machine: Machine, tmp_path: Path) -> None:
    card, run = tmp_path / "card", tmp_path / "run"
    card.mkdir()
    for name in ("ensurepip", "venv", "pip", "service", "importlib", "recon"):
        (card / f"{name}.py").write_text(f"open({str(run)!r}, 'w').write({name!r})")
    assert machine.install(folder=card).returncode == 0
    assert not run.exists(), run.read_text()


@pytest.mark.parametrize(
    ("model", "profile"),
    [
        ("NVIDIA Jetson Orin Nano Developer Kit", "orin-nano"),
        ("NVIDIA Jetson Orin NX Engineering Reference Developer Kit", "orin-nx"),
        ("NVIDIA Jetson AGX Orin Developer Kit", "orin-agx"),
        ("Raspberry Pi 5 Model B Rev 1.0", "raspberry-pi-5"),
    ],
)
def test_the_board_is_recognised(machine: Machine, model: str, profile: str) -> None:
    tree = machine.root / "proc" / "device-tree" / "model"
    tree.parent.mkdir(parents=True)
    tree.write_bytes(model.encode() + b"\0")
    done = machine.install()
    assert done.returncode == 0, done.stderr
    assert f"with the settings of {profile}" in done.stdout
    configuration = machine.root / "etc" / "skyrelief" / "skyrelief.toml"
    assert configuration.read_text().endswith(f"/deploy/profiles/{profile}.toml\n")


def test_a_named_profile_must_exist(machine: Machine) -> None:
    done = machine.install("--profile", "orin-mini")
    assert done.returncode != 0
    assert "orin-nano" in done.stderr
    assert not machine.home.exists()
    assert "x86-bench" in machine.install("--profile", "x86-bench").stdout


@pytest.mark.parametrize("profile", sorted((ROOT / "deploy" / "profiles").glob("*.toml")))
def test_profiles_are_configurations(profile: Path) -> None:
    from service.commands.setup import to_toml
    from service.config import load_config

    chosen = load_config(profile)
    assert chosen != load_config(None)
    assert "# " in profile.read_text()
    assert f"least_memory_mib = {chosen.compute.least_memory_mib}" in to_toml(
        chosen.to_dict(), True
    )


def test_running_it_again_changes_nothing(machine: Machine) -> None:
    machine.install()
    configuration = machine.root / "etc" / "skyrelief" / "skyrelief.toml"
    configuration.write_text("[camera]\nsource = 'mine'\n")
    before = machine.current
    made = (machine.home / "versions" / before).stat().st_mtime_ns
    done = machine.install()
    assert done.returncode == 0
    assert "already there" in done.stdout
    assert machine.current == before
    assert (machine.home / "versions" / before).stat().st_mtime_ns == made
    assert "mine" in configuration.read_text()


def test_upgrade_and_rollback(machine: Machine) -> None:
    machine.install()
    first = machine.current
    machine.release("second")
    machine.install()
    second = machine.current
    assert second != first
    assert machine.versions == {first, second}
    assert machine.install("--rollback").returncode == 0
    assert machine.current == first
    assert machine.install("--rollback").returncode == 0
    assert machine.current == second


def test_failed_upgrade_leaves_what_was(machine: Machine) -> None:
    machine.install()
    first = machine.current
    machine.release("broken")
    assert machine.install(PIP_EXIT="1").returncode != 0
    assert machine.current == first
    assert machine.install().returncode == 0
    assert machine.current != first
    assert not [name for name in machine.versions if name.endswith(".part")]


@pytest.mark.slow
def test_three_versions_are_kept(machine: Machine) -> None:
    for contents in "abcde":
        machine.release(contents)
        assert machine.install().returncode == 0
    assert len(machine.versions) == 3
    assert machine.current in machine.versions


def test_uninstall_keeps_scans_and_configuration(machine: Machine) -> None:
    machine.install()
    scans = machine.root / "var" / "lib" / "skyrelief" / "scans"
    scans.mkdir(parents=True)
    assert machine.install("--uninstall").returncode == 0
    assert not machine.home.exists()
    assert not list((machine.root / "etc" / "systemd" / "system").iterdir())
    assert not list((machine.root / "etc").rglob("*0-skyrelief*"))
    assert scans.is_dir()
    assert (machine.root / "etc" / "skyrelief" / "skyrelief.toml").is_file()


def test_both_kinds_of_polkit_allow_the_same() -> None:
    old = configparser.ConfigParser()
    old.optionxform = str  # type: ignore[method-assign,assignment]  # polkit's keys have capitals
    old.read(ROOT / "deploy" / "50-skyrelief.pkla")
    (group,) = old.sections()
    rules = (ROOT / "deploy" / "50-skyrelief.polkit.rules").read_text()
    assert old[group]["Action"].split(";") == re.findall(r'"(org\.[^"]+)"', rules)
    assert old[group]["Identity"] == "unix-user:skyrelief"
    assert {old[group][f"Result{who}"] for who in ("Any", "Inactive", "Active")} == {"yes"}


def test_wrong_usage_is_reported(machine: Machine) -> None:
    assert "no option --nonsense" in machine.install("--nonsense").stderr
    assert "sudo deploy/install.sh" in machine.install("--help").stdout
    assert "no previous version" in machine.install("--rollback").stderr
    shutil.rmtree(machine.bundle / "wheels")
    assert "contains no wheels" in machine.install().stderr
    assert not machine.home.exists()


@needs_systemd
@pytest.mark.parametrize("unit", UNITS, ids=lambda p: p.stem)
def test_units_are_valid(unit: Path, tmp_path: Path) -> None:
    text = unit.read_text().replace("/opt/skyrelief/current/bin/skyrelief", "/bin/true")
    copy = tmp_path / unit.name
    copy.write_text(text)
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(copy)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    reported = [line for line in done.stderr.splitlines() if unit.name in line]
    assert reported == []


@needs_systemd
@pytest.mark.parametrize("unit", UNITS, ids=lambda p: p.stem)
def test_units_are_sandboxed(unit: Path) -> None:
    done = subprocess.run(
        [
            "systemd-analyze",
            "security",
            "--offline=true",
            "--threshold=30",
            "--no-pager",
            str(unit),
        ],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-300:] + done.stderr


def test_units_start_what_exists() -> None:
    from service.cli import COMMANDS

    for unit in UNITS:
        (line,) = [x for x in unit.read_text().splitlines() if x.startswith("ExecStart=")]
        binary, command = line.removeprefix("ExecStart=").split()[:2]
        assert binary == "/opt/skyrelief/current/bin/skyrelief"
        assert command in COMMANDS


def test_a_bundle_without_hashes_is_refused(machine: Machine) -> None:
    (machine.bundle / "requirements.txt").unlink()
    done = machine.install()
    assert done.returncode != 0
    assert "contains no requirements.txt with hashes" in done.stderr
    assert not machine.home.exists()
