"""Parameters of the operator, from MAVLink packets through the daemon to what they change."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from loopback import until
from onboard import FakeCamera, Onboard, real_scan

from mavlink.component.control import Answer, Power, Result
from mavlink.component.parameters import PARAMETERS
from mavlink.component.vehicle import VehicleLink
from mavlink.wire.dialect import dialect
from mavlink.wire.framing import Framer
from service.commands.run import reread
from service.config import Config, change, load_config
from service.daemon.frame_gate import FrameGate
from service.daemon.vehicle_config import TUNABLES, parameters_of, with_parameter
from service.errors import InputError


class Operator:
    """A ground station's parameter page on a UDP link of a daemon that is not scanning."""

    def __init__(self, folder: Path, *settings: str) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.05)
        port = self._socket.getsockname()[1]
        self.daemon = Onboard(
            folder, f"mavlink.links=udpout:127.0.0.1:{port}", *settings, link=VehicleLink,
            script=lambda run: run.stop.wait(60.0),
        )  # fmt: skip
        self.shown: dict[str, list[float]] = {}
        self._framer, self._ear = Framer(), dialect.MAVLink(None)
        self._mouth = dialect.MAVLink(None, 255, 190)
        self._peer: Any = None

    def __enter__(self) -> Operator:
        self.daemon.vehicle.start()
        until(lambda: self.heard() is not None and self._peer)
        return self

    def __exit__(self, *_: object) -> None:
        self.daemon.vehicle.stop()
        self._socket.close()

    @property
    def config(self) -> Config:
        return self.daemon.config

    def heard(self) -> dict[str, list[float]]:
        """Values shown so far, by parameter."""
        with contextlib.suppress(TimeoutError):
            data, self._peer = self._socket.recvfrom(65536)
            for packet in self._framer.feed(data):
                if packet.message_id == 22:
                    message = self._ear.decode(bytearray(packet.data))
                    self.shown.setdefault(message.param_id, []).append(message.param_value)
        return self.shown

    def set(self, name: str, value: float) -> float:
        """Set it and give the value that stands."""
        before = len(self.shown.get(name, []))
        message = dialect.MAVLink_param_set_message(1, 191, name.encode(), value, 9)
        self._socket.sendto(bytes(message.pack(self._mouth)), self._peer)
        until(lambda: len(self.heard().get(name, [])) > before)
        return self.shown[name][-1]


@pytest.fixture
def operator(tmp_path: Path) -> Iterator[Operator]:
    with Operator(tmp_path) as one:
        yield one


CASES: dict[str, tuple[float, str, object]] = {
    "SR_BASELINE_M": (2.5, "scan.baseline", 2.5),
    "SR_RESOLUTION_M": (0.5, "scan.resolution_m", 0.5),
    "SR_LINK_KBIT_S": (64.0, "datalink.budget_kbit_s", 64.0),
    "SR_YAW_FRAME": (3.0, "mavlink.gimbal_yaw_frame", "body"),
    "SR_CAM_LATENCY": (70.0, "camera.latency_ms", 70.0),
    "SR_CAM_LAT_AUTO": (1.0, "camera.latency", "auto"),
}


def value_of(config: Config, key: str) -> object:
    section, _, field = key.partition(".")
    return getattr(getattr(config, section), field)


def test_every_parameter_has_its_key() -> None:
    assert set(CASES) == set(TUNABLES) == {p.name for p in PARAMETERS if not p.is_constant}


@pytest.mark.parametrize("name", list(CASES))
def test_a_parameter_is_set_refused_out_of_range_and_kept(tmp_path: Path, name: str) -> None:
    value, key, expected = CASES[name]
    (parameter,) = (p for p in PARAMETERS if p.name == name)
    with Operator(tmp_path) as operator:
        assert operator.set(name, value) == pytest.approx(value)
        assert value_of(operator.config, key) == expected
        for wrong in (parameter.high * 2 + 1, parameter.low - 1, float("nan"), float("inf")):
            assert operator.set(name, wrong) == pytest.approx(value)
            assert value_of(operator.config, key) == expected
    with Operator(tmp_path) as again:
        until(lambda: value_of(again.config, key) == expected)
        assert again.daemon.vehicle.parameters()[name] == pytest.approx(value)


def test_nothing_is_written_where_nothing_was_tuned(tmp_path: Path) -> None:
    with Operator(tmp_path) as operator:
        operator.set("SR_BASELINE_M", -1.0)
    assert list(tmp_path.iterdir()) == []


def test_what_the_key_refuses_is_refused_with_the_value_kept(operator: Operator) -> None:
    assert operator.set("SR_RESOLUTION_M", 0.001) == 0.0
    assert operator.config.scan.resolution_m == 0.0
    answer = operator.daemon.actions.parameter_changed("SR_RESOLUTION_M", 0.001)
    assert answer.text.startswith("SR_RESOLUTION_M refused: scan.resolution_m = 0.001 is outside")
    with pytest.raises(InputError, match="resolution_m"):
        with_parameter(operator.config, "SR_RESOLUTION_M", 0.001)


def test_a_refused_reboot_says_what_the_system_says(
    operator: Operator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "systemctl"
    program.write_text("#!/bin/sh\necho 'Interactive authentication required.' >&2\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    answer = operator.daemon.actions.power(Power.REBOOT)
    assert isinstance(answer, Answer) and answer.result is Result.FAILED
    assert answer.text == "systemctl reboot: Interactive authentication required."


def test_parameters_begin_as_the_file_says_and_follow_it(tmp_path: Path) -> None:
    settings = ("scan.baseline=4", "camera.latency_ms=120", "mavlink.gimbal_yaw_frame=servo")
    with Operator(tmp_path, *settings) as operator:
        values = operator.daemon.vehicle.parameters()
        assert values["SR_BASELINE_M"] == 4.0 and values["SR_CAM_LATENCY"] == 120.0
        assert values["SR_YAW_FRAME"] == 4.0
        operator.set("SR_CAM_LATENCY", 80.0)
        wanted = [*settings, "scan.baseline=6", "datalink.budget_kbit_s=9"]
        operator.daemon.reload(load_config(None, wanted))
        until(lambda: operator.heard().get("SR_BASELINE_M") == [6.0])
        until(lambda: operator.heard().get("SR_LINK_KBIT_S") == [9.0])
        assert operator.config.camera.latency_ms == 80.0  # tuned, and the file says as before
    assert "SR_CAM_LATENCY" in (tmp_path / "mavlink.json").read_text()  # next to the scans
    # What was not tuned follows the file.
    with Operator(tmp_path, "scan.resolution_m=0.3", "scan.baseline=2/10") as operator:
        until(lambda: operator.config.camera.latency_ms == 80.0)
        assert operator.daemon.vehicle.parameters()["SR_RESOLUTION_M"] == pytest.approx(0.3)
        assert "SR_BASELINE_M" not in parameters_of(operator.config)
        assert operator.config.scan.baseline == "2/10"


class Budget:
    """A datalink that takes note of its budget."""

    def __init__(self) -> None:
        self.budgets: list[tuple[float, float | None]] = []

    def set_budget(self, budget_kbit_s: float, share: float) -> None:
        self.budgets.append((budget_kbit_s, share))

    def drain(self, timeout_s: float) -> bool:
        return True

    def close(self) -> None:
        pass


def test_a_running_scan_follows_at_once(operator: Operator, tmp_path: Path) -> None:
    operator.set("SR_RESOLUTION_M", 0.5)
    scan = real_scan(
        tmp_path / "scan", config=operator.config, history=operator.daemon.vehicle.history
    )
    with scan.store as store:
        assert store.header.configuration["scan"]["resolution_m"] == 0.5
        scanning, link = operator.daemon.scanning, Budget()
        scanning.start()
        run = scanning.run
        assert run is not None
        run.gate = FrameGate(FakeCamera((160, 90)), tmp_path, 0, run.alive, scanning.paused)
        run.scan, scanning.link.sender = scan, link  # type: ignore[assignment]
        operator.set("SR_LINK_KBIT_S", 64.0)
        assert link.budgets[-1] == (64.0, operator.config.datalink.share)
        operator.set("SR_BASELINE_M", 2.5)
        assert scan.pipeline.mapper.views.selection.min_base_to_height == pytest.approx(0.002)
        scan.check.exposed_ns(10**9)
        operator.set("SR_CAM_LATENCY", 70.0)
        assert scan.check.exposed_ns(3 * 10**9) == 3 * 10**9 - 70_000_000
        operator.set("SR_YAW_FRAME", 2.0)
        assert operator.daemon.vehicle.history.config.yaw_frame == "earth"
        scanning.link.sender = None
        scanning.end()
        scan.mapper.finish()


def test_a_parameter_that_is_set_during_a_reload_stands(tmp_path: Path) -> None:
    """The reload took the configuration before, and put it back without the parameter."""
    daemon = Onboard(tmp_path)
    scanning, between = daemon.scanning, threading.Event()

    def tune() -> None:
        between.set()
        daemon.actions.parameter_changed("SR_RESOLUTION_M", 0.25)

    tuning = threading.Thread(target=tune)

    def slowly(config: Config) -> Config:
        tuning.start()  # waits for this change
        between.wait(60.0)
        return change(config, "datalink.budget_kbit_s", 500)

    scanning.configure(slowly)
    tuning.join()
    assert scanning.config.datalink.budget_kbit_s == 500
    assert scanning.config.scan.resolution_m == 0.25


@pytest.mark.parametrize(
    "wrong", ["[mavlink]\nlinks = ['udp:14550']", "[camera]\nsource = 'rstp://a/b'"]
)
def test_a_reload_that_no_restart_could_use_changes_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, wrong: str
) -> None:
    path, daemon = tmp_path / "sr.toml", Mock()
    path.write_text(wrong)
    reread(daemon, None, path, [])
    assert not daemon.reload.called and f"unchanged: {path}: " in caplog.text


def test_a_reload_without_a_file_names_the_configuration(caplog: pytest.LogCaptureFixture) -> None:
    reread(Mock(), None, None, ["camera.source=rstp://a/b"])
    assert "unchanged: configuration: " in caplog.text


def test_of_two_reloads_the_newest_file_counts(tmp_path: Path) -> None:
    """Each runs on a thread of its own: the earlier one put its older file in force last."""
    path, in_force = tmp_path / "sr.toml", list[float]()
    path.write_text("[datalink]\nbudget_kbit_s = 300\n")

    def take(wanted: Config) -> None:
        if second.ident is None:
            path.write_text("[datalink]\nbudget_kbit_s = 500\n")
            second.start()
            second.join(0.2)  # it waits for this one
        in_force.append(wanted.datalink.budget_kbit_s)

    daemon = Mock(reload=take)
    second = threading.Thread(target=reread, args=(daemon, None, path, []))
    reread(daemon, None, path, [])
    second.join()
    assert in_force == [300.0, 500.0]
