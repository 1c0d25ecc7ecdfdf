"""The command line: every command has help, failures have their exit code and one line."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import pytest
from command_line import skyrelief
from PIL import Image, TiffImagePlugin
from typer.testing import CliRunner

import service.cli
from recon.backends import BACKENDS
from service.cli import COMMANDS, app, load_command
from service.commands import AsJson
from service.commands.ground import show_news
from service.errors import InputError, OutsideError, SkyreliefError
from service.offline.exports import EXPORTERS
from service.offline.exports.model import LARGEST_FACES
from service.offline.exports.view import ExportOptions, ScanView
from service.packages import installs
from service.progress import CancelledError, Progress
from service.stream.session import SessionConfig, open_session
from service.version import software

if TYPE_CHECKING:
    from house_flight import HouseFlight

HEAVY = ("cv2", "numba", "torch", "open3d", "scipy", "zenoh", "onnxruntime", "av", "pymavlink")
"""Packages that no command may import before it is called: start-up time on the aircraft."""


def working(command: Callable[..., None], monkeypatch: pytest.MonkeyPatch) -> None:
    """Make ``command`` the command "work"."""
    module = ModuleType("some_work")
    module.command = command  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setitem(COMMANDS, "work", ("some_work:command", "Work."))


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


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_command_that_is_killed_removes_its_temporary_files(
    tmp_path: Path, number: signal.Signals
) -> None:
    (tmp_path / "slow.py").write_text(
        "import tempfile, time\n"
        "from service import cli\n"
        "def slow() -> None:\n"
        "    with tempfile.TemporaryDirectory(dir='.'):\n"
        "        print('works', flush=True)\n"
        "        time.sleep(60)\n"
        "if __name__ == '__main__':\n"
        "    cli.COMMANDS['slow'] = ('slow:slow', 'Work.')\n"
        "    cli.main()\n"
    )
    process = subprocess.Popen(
        [sys.executable, "slow.py", "slow"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(Path(service.cli.__file__).parents[1])},
        stdout=subprocess.PIPE,
        preexec_fn=lambda: signal.signal(number, signal.SIG_DFL),  # nohup ignores SIGHUP
    )
    assert process.stdout is not None
    with process.stdout:
        assert process.stdout.readline() == b"works\n"
        process.send_signal(number)
        assert process.wait(timeout=20) == 128 + number
    assert not list(tmp_path.glob("tmp*"))


@pytest.mark.parametrize("error", [SystemError, ImportError])
@pytest.mark.parametrize(
    "raised, code, said",
    [(KeyboardInterrupt(), 130, "skyrelief: cancelled\n"), (SystemExit(143), 143, "")],
)
def test_a_signal_in_compiled_code_ends_the_command_in_order(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    error: type[Exception],
    raised: BaseException,
    code: int,
    said: str,
) -> None:
    """As numba passes it on, and Open3D while it loads: an error of an error of the signal's
    exception."""

    def kernel() -> None:
        try:
            try:
                raise raised
            except BaseException as signalled:
                raise error("unpickling returned a result with an exception") from signalled
        except error as first:
            raise error("the kernel returned a result with an exception") from first

    working(kernel, monkeypatch)
    with pytest.raises(SystemExit) as ended:
        app(["work"], standalone_mode=False)
    assert ended.value.code == code
    assert capsys.readouterr().err == said


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


def test_matrices_keep_to_one_thread() -> None:
    """On 16 cores OpenBLAS's threads took two thirds of a replay's processor time."""
    script = (
        "import sys\nsys.argv[1:] = ['config', 'default']\nfrom service.cli import main\ntry:\n"
        "    main()\nexcept SystemExit:\n    pass\nimport numpy as np\n"
        "a = np.ones((900, 900))\na @ a\n"
        "print('threads', len(__import__('os').listdir('/proc/self/task')))\n"
    )
    free = {name: value for name, value in os.environ.items() if "NUM_THREADS" not in name}
    done = subprocess.run(
        [sys.executable, "-c", script], env=free, capture_output=True, text=True, check=True
    )
    assert "threads 1" in done.stdout.splitlines()[-1]


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


def test_a_mistyped_command_is_answered_with_the_near_ones() -> None:
    done = run_cli("mehs", "folder")
    assert done.returncode == 2
    assert done.stderr == "skyrelief: no command 'mehs'; did you mean mesh?\n"


def test_the_version_is_printed() -> None:
    assert run_cli("--version").stdout == f"{software()}\n"


def test_a_shell_completes_commands_and_their_options() -> None:
    for typed, wanted in (("skyrelief exp", "export-model"), ("skyrelief mesh --vi", "--video")):
        words = {"COMP_WORDS": typed, "COMP_CWORD": str(typed.count(" "))}
        code = "from service.cli import app; app(prog_name='skyrelief')"
        done = subprocess.run(
            [sys.executable, "-c", code],
            env=os.environ | words | {"_SKYRELIEF_COMPLETE": "complete_bash"},
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert wanted in done.stdout.split(), done.stderr


def test_a_mesh_without_its_package_or_video_fails_before_the_work(
    tmp_path: Path, house: HouseFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    from service.offline.exports import model

    house.flown(tmp_path / "scan").close()
    reported: list[Progress] = []
    missing = ExportOptions(video=tmp_path / "none.mp4")
    with ScanView(tmp_path / "scan", progress=Progress(reported.append)) as scan:
        with pytest.raises(InputError, match=r"none\.mp4: no such file or folder"):
            model.write_mesh(scan, tmp_path / "mesh.glb", LARGEST_FACES, missing)
        monkeypatch.setitem(sys.modules, "trimesh", None)
        with pytest.raises(OutsideError, match="a mesh file needs the package trimesh; pip"):
            model.write_mesh(scan, tmp_path / "mesh.glb", LARGEST_FACES, ExportOptions())
    assert not reported  # the work has not begun


def test_ground_prints_a_line_only_when_it_has_changed(capsys: pytest.CaptureFixture[str]) -> None:
    entry: dict[str, Any] = {
        "drone": "d", "scan": "s", "folder": "/d/s", "held": {"k0": 1, "pose": 2},
        "missing": {}, "complete": False, "received_bytes": 1_000_000,
    }  # fmt: skip
    shown: dict[str, str] = {}
    for keyframes in (1, 1, 2, 2, 2):
        entry["held"]["k0"] = keyframes
        show_news([entry], shown)
    lines = capsys.readouterr().err.splitlines()
    assert [line.split()[1] for line in lines] == ["1", "2"]


def test_a_port_that_is_taken_is_said_in_plain_words() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        config = SessionConfig("router", listen=(f"tcp/127.0.0.1:{port}",))
        with pytest.raises(OutsideError, match="another program has this port"):
            open_session(config)


@pytest.mark.slow
def test_what_libraries_say_of_odd_tags_is_not_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """OpenCV wrote a line for each unknown tag of each image, as a MicaSense has many."""
    monkeypatch.delenv("OPENCV_LOG_LEVEL", raising=False)  # of a command run in this process
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags[48020] = "a maker's own"
    for name in ("a.tif", "b.tif", "c.tif"):
        Image.new("L", (64, 48)).save(tmp_path / name, tiffinfo=tags)
    options = ["--pattern", "9x6", "--square-m", "0.03", "--out", str(tmp_path / "camera.yaml")]
    quiet = run_cli("calibrate", str(tmp_path), *options)
    assert quiet.returncode == 2 and "48020" not in quiet.stderr
    assert "48020" in run_cli("--verbose", "calibrate", str(tmp_path), *options).stderr


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
) -> None:
    def fail() -> None:
        raise error

    working(fail, monkeypatch)
    ended = skyrelief("work")
    assert (ended.returncode, ended.stderr) == (code, f"skyrelief: {error}\n")


def test_a_path_that_may_not_be_looked_at_is_refused_in_a_line() -> None:
    name = "x" * 5000  # as a folder without rights, which root would see
    ended = skyrelief("export", name, "--to", "laz")
    assert ended.returncode == 3 and ended.stderr.count("\n") == 1
    assert ended.stderr.startswith("skyrelief: xxx") and "File name too long" in ended.stderr


@pytest.mark.slow
def test_config_command(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    printed = run_cli("config", "default")
    assert printed.returncode == 0
    path.write_text(printed.stdout)
    onnx = "compute.backend=onnx"
    assert "good" in run_cli("config", "check", str(path), "--set", onnx).stdout
    shown = run_cli("config", "show", str(path), "--set", "compute.labels=24", "--json")
    assert json.loads(shown.stdout.splitlines()[-1])["compute"]["labels"] == 24
    path.write_text("[compute]\nlabels = 48\n")
    merged = run_cli("config", "default", str(path)).stdout
    assert "labels = 48" in merged and len(merged) >= len(printed.stdout)
    for wrong in ("mavlink.links=udp:14550", "camera.source=rstp://a/b", "compute.backend=cuda"):
        checked = run_cli("config", "check", str(path), "--set", wrong)
        assert (checked.returncode, checked.stdout) == (2, "")
        assert wrong.partition("=")[2].partition(":")[0] in checked.stderr
    assert run_cli("config", "check").returncode == 2
    assert run_cli("config", "chekc", str(path)).returncode == 2


def test_a_bare_export_lists_every_product(tmp_path: Path) -> None:
    ended = skyrelief("export", tmp_path)
    lines = ended.stdout.splitlines()
    assert ended.returncode == 2 and "--to" in ended.stderr
    assert [line.split()[0] for line in lines] == list(EXPORTERS)
    assert all(line.rstrip().endswith(".") and len(line) <= 100 for line in lines)


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("export x --to d", {"dsm", "dtm", "dxf"}),
        ("ctl st", {"start", "stop", "status"}),
        ("replay x --backend ", {"auto", *BACKENDS}),
    ],
)
def test_the_shell_is_offered_values(
    words: str, offered: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("_SKYRELIEF_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", f"skyrelief {words}")
    monkeypatch.setenv("COMP_CWORD", str(words.count(" ") + 1))
    found = set(skyrelief().stdout.split())
    assert offered <= found and (not words.split()[-1].isalpha() or found == offered)


@pytest.mark.parametrize("error", [KeyboardInterrupt, CancelledError])
def test_ctrl_c_ends_a_command_in_one_line(
    error: type[BaseException], monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(as_json: AsJson = False) -> None:
        raise error

    working(stopped, monkeypatch)
    ended = skyrelief("work", "--json")
    assert (ended.returncode, ended.stderr) == (130, "skyrelief: cancelled\n")
    assert json.loads(ended.stdout) == {"error": "cancelled", "exit_code": 130}


@pytest.mark.parametrize(
    ("words", "code", "error"),
    [
        (["config", "what", "--json"], 2, "config what: there are check, show, default"),
        (["export", "--json"], 2, "Missing argument"),
        (["nothing", "--json"], 2, "no command 'nothing'"),
    ],
)
def test_errors_are_objects_with_json(words: list[str], code: int, error: str) -> None:
    ended = skyrelief(*words)
    report = json.loads(ended.stdout.splitlines()[-1])
    assert ended.returncode == report["exit_code"] == code and error in report["error"]


def test_long_commands_say_at_once_what_they_do(tmp_path: Path) -> None:
    """Before they read: there is nothing to read here."""
    assert "reading the truth" in skyrelief("score", tmp_path, tmp_path).stderr
    words = ("calibrate", tmp_path, "--pattern", "9x6", "--square-m", "1", "--out", tmp_path / "c")
    assert "looking for the board" in skyrelief(*words).stderr


def test_the_smallest_extra_or_package_is_named() -> None:
    assert installs("starlette") == "'skyrelief[portal]'"
    assert installs("rasterio") == "rasterio" and installs("foxglove") == "foxglove-sdk"


def test_ctl_rounds_what_people_read(capsys: pytest.CaptureFixture[str]) -> None:
    from service.commands.ctl import print_result

    found = {"distance_m": 12.3456789, "lat_deg": 47.123456789, "keyframes": 3, "sigma_m": None}
    print_result(found, as_json=False)
    said = capsys.readouterr().out.splitlines()
    assert said == ["distance m: 12.35", "lat deg: 47.1234568", "keyframes: 3", "sigma m: unknown"]
