"""``camera.source = "sim:"``: the daemon flies with no file and no hardware."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from loopback import free_port, until

from service.cameras import open_camera
from service.config import load_config
from service.daemon.simulated import SimulatedFlight
from service.errors import InputError, OutsideError

SOURCE = "sim:?size=320x180&fps=5&duration_s=4"


class Service:
    """``skyrelief run`` with a simulated flight, and its status."""

    def __init__(self, folder: Path) -> None:
        port = free_port()
        self.url = f"http://127.0.0.1:{port}/status"
        self.log = folder / "run.log"
        settings = [
            f"camera.source={SOURCE}", "compute.backend=cpu", f"health.http=127.0.0.1:{port}",
            f"scan.folder={folder / 'scans'}", "fusion.loops=false", "compute.stereo_width=160",
            "compute.guide_width=320",
        ]  # fmt: skip
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "service.cli", "run"]
                + [part for setting in settings for part in ("--set", setting)],
                env=os.environ | {"XDG_STATE_HOME": str(folder / "state")}, stderr=log,
            )  # fmt: skip

    def status(self) -> dict[str, Any]:
        with contextlib.suppress(OSError), urllib.request.urlopen(self.url, timeout=5) as answer:
            found: dict[str, Any] = json.load(answer)
            return found
        return {}

    def flies(self) -> bool:
        assert self.process.poll() is None, self.log.read_text()
        found = self.status()
        return bool(found.get("frames", 0) > 5 and found["mavlink"]["packets"] > 100)

    def player(self) -> int:
        """Process id of the simulated flight."""
        names = [w["name"] for w in self.status()["workers"]]
        return int(next(n for n in names if n.startswith("simulated flight, ")).split()[-1])


@pytest.fixture
def service(tmp_path: Path) -> Iterator[type[Service]]:
    started: list[Service] = []

    class Kept(Service):
        def __init__(self, folder: Path) -> None:
            super().__init__(folder)
            started.append(self)

    yield Kept
    for one in started:
        one.process.kill()
        one.process.wait()


@pytest.mark.slow
def test_it_flies_and_ends_with_its_camera(tmp_path: Path, service: type[Service]) -> None:
    first = service(tmp_path)
    until(first.flies, 240)
    player = first.player()
    first.process.send_signal(signal.SIGTERM)
    assert first.process.wait(120) == 0
    until(lambda: not Path(f"/proc/{player}").exists(), 20)
    scans = list((tmp_path / "scans").glob("*/scan.json"))
    assert len(scans) == 1
    assert json.loads(scans[0].read_text())["counts"]["poses"] > 0

    rendered = first.log.read_text().count("rendering the simulated flight")
    second = service(tmp_path)  # from the flight that was rendered before
    until(second.flies, 120)
    assert second.log.read_text().count("rendering the simulated flight") == rendered > 0
    player = second.player()
    second.process.kill()
    until(lambda: not Path(f"/proc/{player}").exists(), 20)


def test_the_configuration_leads_to_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    flight = SimulatedFlight(SOURCE, lambda folder, given: None)
    monkeypatch.setattr("os.access", lambda *_: False)
    config = flight.configured(load_config(None, [f"camera.source={SOURCE}"]))
    assert flight.folder == tmp_path / "sim-320x180-5-4-1"
    assert config.camera.source.startswith("stream:udp://127.0.0.1:")
    assert config.camera.model == str(flight.folder / "camera.yaml")
    assert [link.split(":")[0] for link in config.mavlink.links] == ["udpin", "udpout"]
    assert (config.scan.start, config.scan.folder) == ("on-boot", str(tmp_path / "scans"))
    other = load_config(None, ["camera.source=v4l2:/dev/video0"])
    assert flight.configured(other) is other
    chosen = [f"camera.source={SOURCE}", "scan.start=on-arm", f"scan.folder={tmp_path / 'mine'}"]
    scan = flight.configured(load_config(None, chosen)).scan
    assert (scan.start, scan.folder) == ("on-arm", str(tmp_path / "mine"))


@pytest.mark.parametrize("source", ["sim:?size=3x3", "sim:?colour=1", "sim:fast", "sim:?fps=x"])
def test_options_that_cannot_be_are_refused(
    source: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    with pytest.raises(InputError, match="sim"):
        SimulatedFlight(source)
    assert not list(tmp_path.iterdir())


def test_a_full_disk_gets_its_room_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(folder: Path, given: object) -> None:
        (folder / "flight.mp4").write_bytes(bytes(100))
        raise OutsideError("No space left on device")

    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    with pytest.raises(OutsideError, match="No space"):
        SimulatedFlight(SOURCE, full)
    assert not list(tmp_path.iterdir())


def test_it_is_no_camera_alone() -> None:
    with pytest.raises(InputError, match="skyrelief run"):
        open_camera("sim:")
