"""The benchmarks of a device: every stage has a figure, a floor and a device's name."""

from __future__ import annotations

import math

import pytest
from command_line import skyrelief

from recon.mapping.registration import IcpConfig
from recon.stereo.belief_propagation import BeliefPropagationConfig
from service.bench import BenchOptions, gpu

pytest.importorskip("torch")
pytest.importorskip("triton")

STAGES = (
    "stereo", "checks of labels", "upsampling", "reprojection", "fusion", "ICP", "cloud",
)  # fmt: skip


def test_every_stage_is_compared_with_its_floor(
    device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Small images here; the figures are those of a GPU."""
    import bench_device

    small = {"SIZE": (20, 12), "LABELS": 8, "GUIDE": (40, 24), "DEPTH": (40, 24)}
    few = {"COPY_MB": 16, "PRODUCT": 16, "PAIRS": 1}
    for module, values in ((gpu, small), (bench_device, small | few)):
        for name, value in values.items():
            monkeypatch.setattr(module, name, value)
    quick = bench_device.MATCHING, bench_device.ALL_POINTS
    if device == "cpu":
        matching = BeliefPropagationConfig(iterations=1, levels=1, speckle_px=1)
        quick = matching, IcpConfig(strides=(1,), iterations=(1,))
    results = bench_device.run(BenchOptions(rounds=1, warm_up=0), device, *quick)
    on_device = {r.what: r for r in results if r.peer == "floor of the device"}
    for stage in STAGES:
        assert any(what.startswith(stage) for what in on_device), stage
    assert all(r.value > 0 and r.peer_value and r.peer_value > 0 for r in on_device.values())
    whole = [r for r in results if r.what.startswith("cloud")]
    assert [r.what.rpartition(", ")[2] for r in whole] == [
        "on the device", "with uploads", "with uploads",
    ]  # fmt: skip
    (named,) = [r for r in results if r.what == "bandwidth of the device"]
    assert named.note and named.value > 0


def test_without_a_device_a_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    (line,) = gpu.run(BenchOptions(rounds=1, warm_up=0))
    assert line.what == "torch" and math.isnan(line.value)
    assert line.note.startswith("cannot run: torch finds no CUDA device")
    ended = skyrelief("bench", "gpu")
    assert ended.returncode == 0 and "cannot run" in ended.stdout


def test_floor_is_the_larger_of_bytes_and_operations() -> None:
    from bench_device import Floor, propagation_work

    floor = Floor(1e9, 1e12)
    assert floor.ms(2e6, 1e6) == pytest.approx(2.0)
    assert floor.ms(1.0, 5e9) == pytest.approx(5.0)
    short, long = (propagation_work(BeliefPropagationConfig(), n) for n in (2, 4))
    assert long[0] == 2 * short[0] > 0
    assert long[1] == short[1] > 0
