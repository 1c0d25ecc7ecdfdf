"""Effect of a level on the frames of a camera, and the messages to the operator."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from threading import Event
from typing import Any, NamedTuple

import numpy as np
import pytest
from onboard import Onboard
from paths import FULL_DISK
from spied import spied

from recon.backends import load_backend
from recon.backends.cpu import CpuBackend
from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.types import U8, DisparityMap
from service.cameras import CameraFrame, open_camera
from service.cameras.source import CameraSource
from service.compute.backend_choice import FallbackBackend
from service.config import Config, load_config
from service.daemon.frame_gate import FrameGate
from service.daemon.load_shedding import Level
from service.daemon.machine import Machine
from service.daemon.stored_image import image_name

START_NS = 1_790_000_000_123_456_000


class Film(CameraSource):
    """A camera of a hundred numbered images, ten a second."""

    def __init__(self, count: int = 100) -> None:
        super().__init__("film")
        self.size_px, self.fps, self.is_live = (64, 48), 10.0, True
        self._count = count

    @property
    def dropped(self) -> int:
        return 7

    def __iter__(self) -> Iterator[CameraFrame]:
        for i in range(self._count):
            image = np.full((48, 64, 3), 2 * i, np.uint8)
            yield CameraFrame(image, 100_000_000 * i, i, None, f"frame {i}")


class Kept(NamedTuple):
    """A gate, and how often it said that it lives."""

    gate: FrameGate
    alive: list[int]


def gate_over(source: CameraSource, folder: Path, level: Level, paused: bool = False) -> Kept:
    alive: list[int] = []
    stopped = Event()
    if paused:
        stopped.set()
    gate = FrameGate(source, folder / "later", START_NS, lambda: alive.append(1), stopped)
    gate.level = level
    return Kept(gate, alive)


@pytest.mark.parametrize("level", [Level.LOWER_RATE, Level.LOWER_RESOLUTION, Level.NO_UPSAMPLING])
def test_lower_rate_passes_every_second_frame(level: Level, tmp_path: Path) -> None:
    gate, alive = gate_over(Film(), tmp_path, level)
    assert [f.seq for f in gate] == list(range(1, 100, 2))
    assert len(alive) == 50
    assert gate.dropped == 7
    full, _ = gate_over(Film(), tmp_path, Level.FULL)
    assert [f.seq for f in full] == list(range(100))
    assert not (tmp_path / "later").exists()


def test_record_only_keeps_images_that_a_replay_can_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    syncs = spied(monkeypatch, os, "fsync")
    gate, alive = gate_over(Film(), tmp_path, Level.RECORD_ONLY)
    assert list(gate) == []
    assert len(alive) == 100
    assert gate.kept == 50  # five of ten a second
    assert "50 images were only stored in later/" in gate.warnings[0]
    again = open_camera(f"images:{tmp_path / 'later'}")
    frames = list(again)
    assert len(frames) == 50
    assert again.epoch_unix_ns == START_NS
    assert [f.time_ns for f in frames] == [200_000_000 * i for i in range(50)]
    assert abs(int(frames[10].image.mean()) - 40) <= 1
    assert not list((tmp_path / "later").glob("*.part"))
    assert not syncs.called  # an overloaded computer does not wait for its disk


def test_levels_change_while_frames_come(tmp_path: Path) -> None:
    gate: FrameGate

    def alive() -> None:
        gate.level = Level.FULL

    gate = FrameGate(Film(), tmp_path / "later", START_NS, alive, Event())
    seen = []
    for frame in gate:
        seen.append(frame.seq)
        if frame.seq == 9:
            gate.level = Level.RECORD_ONLY
    assert seen == [*range(10), *range(11, 100)]
    assert gate.kept == 1


def test_nothing_is_kept_while_paused_or_without_room(tmp_path: Path) -> None:
    gate, _ = gate_over(Film(), tmp_path, Level.RECORD_ONLY, paused=True)
    assert list(gate) == []
    assert (gate.kept, gate.lost) == (0, 0)
    (tmp_path / "later").symlink_to(FULL_DISK)
    full, alive = gate_over(Film(), tmp_path, Level.RECORD_ONLY)
    assert list(full) == []
    assert (full.kept, full.lost, len(alive)) == (0, 50, 100)


def test_names_of_images_are_times() -> None:
    assert image_name(1_533_459_888_480_000_000) == "20180805090448480000Z.jpg"


@pytest.fixture
def daemon(tmp_path: Path) -> Onboard:
    return Onboard(tmp_path)


def test_heat_is_reported_acted_on_and_undone(daemon: Onboard) -> None:
    said = daemon.vehicle.said
    for now_s in range(0, 100, 2):
        daemon.shed_load(Machine("m", temperature_c=97.0), float(now_s))
    assert daemon.scanning.level is Level.RECORD_ONLY
    assert daemon.snapshot()["load"] == {"level": 4, "name": "record only", "reason": "97 degrees"}
    for now_s in range(100, 400, 2):
        daemon.shed_load(Machine("m", temperature_c=60.0), float(now_s))
    assert daemon.snapshot()["load"]["level"] == Level.FULL
    assert said[0] == "Load: lower rate (97 degrees)"
    assert said[3] == "Load: record only (97 degrees)"
    assert said[-1] == "Load: full quality again"
    assert len(said) == 8
    assert daemon.snapshot()["load"]["level"] == 0


class Tuned(Onboard):
    """A daemon whose operator changes a parameter whenever the configuration has been read."""

    changes = 0

    @property
    def config(self) -> Config:
        config, self.changes = super().config, self.changes + 1
        self.actions.parameter_changed("SR_BASELINE_M", float(self.changes))
        return config


def test_a_load_level_leaves_a_parameter_that_changes_meanwhile(tmp_path: Path) -> None:
    daemon = Tuned(tmp_path)
    for now_s in (0.0, 30.0):
        daemon.shed_load(Machine("m", temperature_c=97.0), now_s)
    assert daemon.scanning.level is Level.LOWER_RATE
    assert daemon.scanning.config.scan.baseline == daemon.changes > 0


def test_relief_can_be_switched_off(daemon: Onboard) -> None:
    said = daemon.vehicle.said
    for now_s in range(0, 60, 2):
        daemon.shed_load(Machine("m", temperature_c=97.0), float(now_s))
    assert daemon.snapshot()["load"]["level"] == Level.LOWER_RESOLUTION
    daemon.reload(load_config(None, ["compute.relief=false"]))
    daemon.shed_load(Machine("m", temperature_c=97.0), 60.0)
    assert daemon.snapshot()["load"] == {"level": 0, "name": "full", "reason": ""}
    heard = len(said)
    for now_s in range(62, 200, 2):
        daemon.shed_load(Machine("m", temperature_c=97.0), float(now_s))
        assert daemon.ladder.level is Level.FULL
    assert len(said) == heard


class Dying(CpuBackend):
    """A device that runs out of memory after two pairs."""

    name, device = "torch", "cuda"

    def __init__(self) -> None:
        self.left = 2

    def belief_propagation(
        self, left: U8, right: U8, labels: int, config: BeliefPropagationConfig
    ) -> DisparityMap:
        """As the CPU's, twice."""
        if self.left == 0:
            raise RuntimeError("CUDA out of memory. Tried to allocate 20 MiB\nmore")
        self.left -= 1
        return super().belief_propagation(left, right, labels, config)


def test_a_device_that_fails_is_reported_once_and_the_cpu_goes_on(daemon: Onboard) -> None:
    said = daemon.vehicle.said
    backend = FallbackBackend(Dying())
    daemon.scanning.backend = backend
    gray = np.zeros((48, 64), np.uint8)
    arguments: tuple[Any, ...] = (gray, gray, 4, BeliefPropagationConfig())
    truth = load_backend("cpu").belief_propagation(*arguments).px
    for i in range(4):
        found = backend.belief_propagation(*arguments).px
        np.testing.assert_array_equal(found, truth)
        daemon.shed_load(Machine("m"), float(i))
        assert len(said) == (i >= 2)
    assert said == ["Compute device failed: CUDA out of memory. Tried to allocate 20 MiB"]
    assert daemon.snapshot()["backend"] == "cpu"
    assert "out of memory" in daemon.snapshot()["backend_failure"]


def test_onnx_runtime_out_of_memory_falls_back_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its exceptions are not RuntimeErrors; none may end the scan."""
    state = pytest.importorskip("onnxruntime.capi.onnxruntime_pybind11_state")
    from exported_network import write_network

    from recon.backends.onnx_backend import LearnedStereoBackend, LearnedStereoConfig

    class Full:
        """A session on a device without memory."""

        def run(self, *_: object) -> None:
            """Fails."""
            raise state.RuntimeException("CUDA failure 2: out of memory")

    write_network(tmp_path / "net.onnx", 0.3, size=(48, 64))
    model = (tmp_path / "net.onnx").read_bytes()
    learned = LearnedStereoBackend(model, LearnedStereoConfig(48, 64))
    monkeypatch.setattr(learned, "_model", Full())
    gray = np.zeros((48, 64), np.uint8)
    backend = FallbackBackend(learned)
    backend.belief_propagation(gray, gray, 4, BeliefPropagationConfig())
    assert backend.name == "cpu"
    assert backend.failure is not None and "out of memory" in backend.failure
