"""The benchmark of the device: every stage has a figure, a floor and a device's name."""

from __future__ import annotations

import math
import sys
from importlib.util import find_spec

import pytest

from recon.stereo.belief_propagation import BeliefPropagationConfig
from service.bench import BenchOptions, gpu
from service.bench import gpu as bench_gpu
from service.bench.gpu import Floor, propagation_work
from service.cli import main

pytest.importorskip("torch")

STAGES = (
    "stereo", "checks of labels", "upsampling", "reprojection", "fusion", "ICP", "cloud",
)  # fmt: skip


def test_every_stage_is_compared_with_its_floor(
    monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    """Small images here; the figures are those of ``skyrelief bench gpu``."""
    from service.bench import gpu_stages

    for module in (bench_gpu, gpu_stages, gpu):
        monkeypatch.setattr(module, "SIZE", (96, 54))
    for guide in ("GUIDE", "GUIDE_ON_DEVICE", "DEPTH_ON_DEVICE"):
        monkeypatch.setattr(bench_gpu, guide, (192, 108))
    device = str(request.config.getoption("--device"))
    for table in ("COPY_MB", "PRODUCT"):
        monkeypatch.setattr(gpu, table, {device: 16})
    results = bench_gpu.run(BenchOptions(rounds=1, warm_up=0, device=device))
    on_device = {r.what: r for r in results if r.peer == "floor of the device"}
    for stage in STAGES:
        assert any(what.startswith(stage) for what in on_device), stage
    assert all(r.value > 0 and r.peer_value and r.peer_value > 0 for r in on_device.values())
    whole = [r for r in results if r.what.startswith("cloud")]
    assert [r.what.rpartition(", ")[2] for r in whole] == [
        "on the device", "with uploads", "with uploads",
    ]  # fmt: skip
    nearby = [r for r in results if r.peer == "cpu backend"]
    assert all(math.isfinite(r.value) and r.value > 0 for r in nearby)
    assert {r.note.partition(" on ")[0] for r in nearby} >= {"torch"}
    (named,) = [r for r in results if r.what == "bandwidth of the device"]
    assert named.note and named.value > 0


def test_onnx_on_the_processor_is_no_figure_of_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the device is named, what cannot run on it is a line that says so."""
    if find_spec("onnxruntime") is None:
        pytest.skip("onnxruntime is not installed")
    monkeypatch.setattr(bench_gpu, "torch_results", lambda compiled, options: [])
    (line,) = bench_gpu.run(BenchOptions(rounds=1, warm_up=0, device="cuda"))
    assert (line.what, line.note) == ("onnx", "cannot run: ONNX Runtime has no GPU provider")
    assert math.isnan(line.value)


def test_floor_is_the_larger_of_bytes_and_operations() -> None:
    floor = Floor(1e9, 1e12)
    assert floor.ms(2e6, 1e6) == pytest.approx(2.0)
    assert floor.ms(1.0, 5e9) == pytest.approx(5.0)
    short, long = (propagation_work(BeliefPropagationConfig(), n) for n in (2, 4))
    assert long[0] == 2 * short[0] > 0
    assert long[1] == short[1] > 0


def test_an_unknown_device_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["skyrelief", "bench", "gpu", "--device", "abacus"])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 2
    assert "give cuda or cpu" in capsys.readouterr().err
