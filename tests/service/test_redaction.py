"""A camera's password and a key's place never leave the process."""

from __future__ import annotations

import json
import logging
import pickle
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest

from recon.backends import Backend
from recon.types import Camera
from service.cameras import open_camera
from service.cameras.source import CameraFrame, CameraSource
from service.config import Config, keys, load_config
from service.daemon.health import HealthServer
from service.errors import InputError, OutsideError
from service.flight.scan import ScanInputs, create_store
from service.init_system import PublicFormatter
from service.redaction import SECRET_KEYS, without_credentials
from service.scans.folder import write_deliverables

if TYPE_CHECKING:
    from house_flight import HouseFlight

SOURCE = "rtsp://pilot:s3cret@127.0.0.1:1/main?pwd=s3cret"


@pytest.fixture
def config() -> Config:
    sets = [f"camera.source={SOURCE}", "mavlink.signing_key=/keys/s3cret", "scan.drone=d"]
    return load_config(None, [*sets, "datalink.tls_key=/keys/s3cret.pem"])


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("rtsp://me:s3cret@10.0.0.2:554/main", "rtsp://***@10.0.0.2:554/main"),
        ("rtsp://me@10.0.0.2/main", "rtsp://***@10.0.0.2/main"),
        ("two rtsp://a:s3@cret@h/x and srt://b:s3cret@h2", "two rtsp://***@h/x and srt://***@h2"),
        ("rtsp://me:s3/cret@10.0.0.2/main", "rtsp://***@10.0.0.2/main"),
        ("http://h/cgi?usr=a&pwd=s3cret&c=1", "http://h/cgi?usr=a&pwd=***&c=1"),
        ("rtsp://h/user=a_password=s3cret_channel=1", "rtsp://h/user=a_password=***"),
        ("rtspsrc user-id=a user-pw='s3 cret' ! queue", "rtspsrc user-id=a user-pw=*** ! queue"),
        ("srt://h:9000?passphrase=s3cret", "srt://h:9000?passphrase=***"),
        (
            "tls/h:7447#private_key_base64=s3cret",
            "tls/h:7447#private_key_base64=***",
        ),
    ],
)
def test_credentials_are_hidden(text: str, shown: str) -> None:
    assert without_credentials(text) == shown
    assert str(InputError(f"camera {text} failed")) == f"camera {shown} failed"


@pytest.mark.parametrize(
    "text",
    [
        "rtsp://192.168.144.25:8554/main@1",
        "serial:/dev/serial/by-id/usb-x:921600",
        "write section.key=value",
        "no camera: rtsp://10.0.0.2:554/a; mail me@example.org",
        "bypass=3 pixel_key=4",
    ],
)
def test_what_is_no_secret_stays(text: str) -> None:
    assert without_credentials(text) == text


def test_hostile_text_takes_no_long_time() -> None:
    text = "://a:b" * 20_000 + "password=" * 20_000
    assert len(without_credentials(text)) <= len(text)


def test_every_secret_key_is_a_key() -> None:
    assert {f"{section}.{field.name}" for section, field in keys()} >= SECRET_KEYS


def test_a_failure_of_another_process_keeps_its_kind_text_and_report() -> None:
    for error in (InputError("no flight"), OutsideError("not ready", {"ok": False})):
        came = pickle.loads(pickle.dumps(error))
        assert type(came) is type(error)
        assert (str(came), came.report) == (str(error), error.report)


class Source(CameraSource):
    """A camera that has complained, with its address in the text."""

    def __init__(self) -> None:
        super().__init__("camera")
        self.warnings = [f"cannot be opened: {SOURCE}"]

    def __iter__(self) -> Iterator[CameraFrame]:
        return iter(())


def test_a_scan_and_its_files_hold_no_secret(tmp_path: Path, config: Config) -> None:
    camera = Camera(np.eye(3), np.zeros(5), (4, 3))
    source = Source()
    notes = (f"camera {SOURCE}",)
    inputs = ScanInputs(
        source, camera, config, cast(Backend, None), tmp_path, "scan-1", 0, notes=notes
    )
    with create_store(inputs) as store:
        assert store.header.configuration["camera"]["source"].startswith("rtsp://***@")
        assert store.header.configuration["camera"]["mount"] == "auto"
        write_deliverables(tmp_path, store)
    assert json.loads((tmp_path / "scan.json").read_text())["configuration"]
    for path in tmp_path.iterdir():
        assert b"s3cret" not in path.read_bytes(), path.name


def test_files_of_a_scan_with_a_password_in_its_header_hold_none(
    tmp_path: Path, config: Config, house: HouseFlight
) -> None:
    """What an older version wrote into its store is what it is; its files are new."""
    with house.flown(tmp_path) as store:
        store.update_header(configuration=config.to_dict())
        store.finish({"source": SOURCE})
        write_deliverables(tmp_path, store)
    for path in tmp_path.iterdir():
        assert path.name.startswith("scan.db") or b"s3cret" not in path.read_bytes(), path.name


def test_a_camera_that_fails_says_no_password(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG), pytest.raises(OutsideError) as failure:
        open_camera(SOURCE)
    assert "127.0.0.1" in str(failure.value) and "s3cret" not in str(failure.value)
    assert caplog.records
    assert "s3cret" not in caplog.text


def test_logs_hide_credentials_also_in_tracebacks() -> None:
    try:
        raise ValueError(SOURCE)
    except ValueError:
        record = logging.LogRecord("x", 40, __file__, 1, "at %s", (SOURCE,), sys.exc_info())
    text = PublicFormatter("%(message)s").format(record)
    assert "Traceback" in text and text.count("rtsp://***@127.0.0.1") == 2
    assert "s3cret" not in text


def test_the_health_page_shows_no_secret() -> None:
    snapshot: dict[str, Any] = {"ok": True, "fault": f"no {SOURCE}", "camera": {"at": [SOURCE]}}
    server = HealthServer("127.0.0.1:0", lambda: snapshot)
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{server.port}/status") as answer:
            text = answer.read().decode()
        assert "127.0.0.1:1/main" in text and "s3cret" not in text
    finally:
        server.close()


@pytest.mark.parametrize("options", [[], ["--json"]])
def test_the_shown_configuration_holds_no_secret(options: list[str]) -> None:
    sets = [f"--set=camera.source={SOURCE}", "--set=datalink.tls_key=/keys/s3cret.pem"]
    command = [sys.executable, "-m", "service.cli", "config", "show", *sets, *options]
    shown = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "rtsp://***@127.0.0.1" in shown.stdout and "s3cret" not in shown.stdout


@pytest.mark.parametrize("where", ["main", "aside"])
def test_a_traceback_of_a_command_holds_no_secret(where: str) -> None:
    code = f"""
import sys, threading, types
from service import cli
def main():
    raise ZeroDivisionError("{SOURCE}")
def aside():
    thread = threading.Thread(target=main)
    thread.start()
    thread.join()
sys.modules["broken"] = module = types.ModuleType("broken")
module.main, module.aside = main, aside
cli.COMMANDS["broken"] = ("broken:{where}", "fails")
sys.argv = ["skyrelief", "broken"]
cli.main()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == (1 if where == "main" else 0)
    assert "ZeroDivisionError: rtsp://***@127.0.0.1" in done.stderr
    assert "s3cret" not in done.stderr
