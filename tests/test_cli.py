"""The command line: every command has help, failures have their exit code and one line."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

import service.cli
from service.cli import COMMANDS, app, load_command
from service.errors import InputError, OutsideError, SkyreliefError

HEAVY = ("cv2", "numba", "torch", "open3d", "scipy", "zenoh", "onnxruntime", "av", "pymavlink")
"""Packages that no command may import before it is called: start-up time on the aircraft."""


def run_cli(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "service.cli", *arguments],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_overview_names_every_command() -> None:
    result = CliRunner().invoke(app, ["--help"])
    assert result.exit_code == 0
    for name in COMMANDS:
        assert name in result.output


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help(name: str) -> None:
    result = CliRunner().invoke(app, [name, "--help"])
    assert result.exit_code == 0, result.output
    assert "Usage" in result.output
    command = load_command(name)
    assert command.help, f"{name} says nothing of itself"


def test_no_command_imports_heavy_packages() -> None:
    code = (
        "import sys\n"
        "from service.cli import COMMANDS, load_command\n"
        "for name in COMMANDS:\n"
        "    load_command(name)\n"
        f"    found = [m for m in {HEAVY!r} if m in sys.modules]\n"
        "    assert not found, f'{name} imports {found}'\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


def test_overview_imports_no_command() -> None:
    code = (
        "import sys\n"
        "import service.cli\n"
        "from typer.testing import CliRunner\n"
        "assert CliRunner().invoke(service.cli.app, ['--help']).exit_code == 0\n"
        "assert not [m for m in sys.modules if m.startswith('service.commands.')]\n"
    )
    subprocess.run([sys.executable, "-c", code], timeout=60, check=True)


def test_wrong_usage_is_exit_2() -> None:
    for arguments in (["nonsense"], ["config"], ["config", "check", "--nope"]):
        assert run_cli(*arguments).returncode == 2


def test_input_errors_are_one_line_and_exit_2(tmp_path: Path) -> None:
    done = run_cli("config", "check", str(tmp_path / "none.toml"))
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("skyrelief: ")


@pytest.mark.parametrize(
    ("error", "code"),
    [(InputError("wrong"), 2), (OutsideError("gone"), 3), (SkyreliefError("ours"), 1)],
)
def test_exit_codes(
    error: SkyreliefError,
    code: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(**_: object) -> None:
        raise error

    monkeypatch.setattr(service.cli, "app", fail)
    with pytest.raises(SystemExit) as caught:
        service.cli.main()
    assert caught.value.code == code
    assert capsys.readouterr().err == f"skyrelief: {error}\n"


def test_config_command(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    printed = run_cli("config", "default")
    assert printed.returncode == 0
    path.write_text(printed.stdout)
    assert "good" in run_cli("config", "check", str(path)).stdout
    shown = run_cli("config", "show", str(path), "--set", "compute.labels=24", "--json")
    assert json.loads(shown.stdout.splitlines()[-1])["compute"]["labels"] == 24
    path.write_text("[compute]\nlabels = 48\n")
    merged = run_cli("config", "default", str(path)).stdout
    assert "labels = 48" in merged and len(merged) >= len(printed.stdout)
    assert run_cli("config", "check").returncode == 2
    assert run_cli("config", "chekc", str(path)).returncode == 2
