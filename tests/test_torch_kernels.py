"""Fused kernels against the NumPy references: compiled on a GPU, else in Triton's interpreter.

Tolerances are those of the parity suite: beliefs equal, upsampled labels 0.01 px.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recon.backends import reference
from recon.belief_propagation import BeliefPropagationConfig
from recon.matching_cost import matching_cost
from recon.types import F32, U8, DisparityMap
from recon.upsampling import UpsamplingConfig, guide_at_taps

torch = pytest.importorskip("torch")


@pytest.fixture
def device(request: pytest.FixtureRequest) -> str:
    """Where the kernels run."""
    return str(request.config.getoption("--device"))


@pytest.fixture
def kernels(device: str) -> Any:
    """The kernels, on a processor by Triton's interpreter, which is chosen at their import."""
    if device == "cpu":
        os.environ["TRITON_INTERPRET"] = "1"
    pytest.importorskip("triton", reason="Triton is not installed; torch for CUDA brings it")
    from recon.backends.torch_kernels import load_kernels

    return load_kernels()


def textured(height: int, width: int, seed: int) -> U8:
    """Grey steps and noise."""
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 40, (height, width)) + 60 * (np.arange(width) // 7 % 3)
    return np.asarray(image, np.uint8)


@pytest.mark.parametrize(
    ("height", "width", "labels", "settings"),
    [
        (9, 13, 5, {"iterations": 3, "levels": 2}),
        (16, 20, 8, {"iterations": 2, "levels": 3}),
        (8, 21, 6, {"smoothness_truncation": 1.0, "edge_floor": 0.1}),
        (8, 8, 2, {"iterations": 1, "levels": 1}),
    ],
)
def test_swept_messages_give_the_beliefs_of_the_reference(
    kernels: Any, device: str, height: int, width: int, labels: int, settings: dict[str, float]
) -> None:
    """Odd sizes, room around the pair, both colours, several levels."""
    from recon.backends.torch_dense import edge_weights, propagate

    config = BeliefPropagationConfig(**settings)  # type: ignore[arg-type]
    left, right = textured(height, width, 1), np.roll(textured(height, width, 2), -2, 1)
    cost = matching_cost(left, right, labels, config.cost)
    want = reference.beliefs(cost, left, config.iterations, config.levels, config.smoothness)
    wide = np.pad(np.moveaxis(cost, 1, 0), ((0, 1), (0, 3), (0, 2)))
    image = torch.from_numpy(np.pad(left, ((0, 3), (0, 2)), mode="edge")).float().to(device)
    true = torch.tensor([height, width, labels], device=device)
    levels = 1
    while levels < config.levels and min(height, width) >> (levels - 1) >= 8:
        levels += 1
    found = propagate(
        torch.from_numpy(wide).float().to(device), edge_weights(image, true, config), true,
        levels, config, torch.int16, kernels.sweep,
    )  # fmt: skip
    got = found[:labels, :height, :width].permute(1, 2, 0).cpu().numpy()
    np.testing.assert_array_equal(got, want)


@pytest.mark.parametrize(
    ("coarse", "fine", "support", "diameter"),
    [((7, 9), (20, 70), 0.5, 4), ((8, 6), (13, 9), 0.0, 10), ((5, 7), (5, 7), 0.3, 3)],
)
def test_upsampling_in_one_kernel_is_the_reference(
    kernels: Any, device: str, coarse: tuple[int, int], fine: tuple[int, int], support: float,
    diameter: int,
) -> None:  # fmt: skip
    """Ratios that are not whole, unknown taps, little support, and room around the pictures."""
    from recon.backends.torch_upsampling import JointBilateral

    config = UpsamplingConfig(min_support=support, diameter_px=diameter)
    rng = np.random.default_rng(0)
    px: F32 = rng.uniform(0, 16, coarse).astype(np.float32)
    px[rng.random(coarse) < 0.3] = np.nan
    sure: F32 = rng.uniform(0, 1, coarse).astype(np.float32)
    guide = np.stack([textured(*fine, seed) for seed in (3, 4, 5)], -1)
    want = reference.upsample(DisparityMap(px, sure), guide, config)
    taps = guide_at_taps(guide, coarse)
    given = [np.pad(a, ((0, 3), (0, 2), *[(0, 0)] * (a.ndim - 2))) for a in (px, sure, taps, guide)]
    tensors = [torch.from_numpy(a).to(device) for a in given]
    true = torch.tensor([*coarse, *fine], device=device)
    found = JointBilateral(config, kernels)(*tensors, true)
    label, trust = (t[: fine[0], : fine[1]].cpu().numpy() for t in found)
    assert (np.isnan(label) != np.isnan(want.px)).mean() <= 0.002
    both = np.isfinite(label) & np.isfinite(want.px)
    assert both.any()
    assert np.abs(label - want.px)[both].max() < 0.01
    assert np.abs(trust - want.confidence)[both].max() < 1e-3


COMPILE = """
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from recon.backends.triton_propagation import CELLS, _sweep
from recon.backends.triton_upsampling import COLUMNS, ROWS, _bilateral

def compiled(kernel, words, constants, capability):
    names = kernel.arg_names
    kinds = dict(zip(names, words.split() + ["constexpr"] * len(constants), strict=True))
    constants = dict(zip(names[-len(constants):], constants, strict=True))
    source = ASTSource(fn=kernel, signature=kinds, constexprs=constants)
    found = triton.compile(source, target=GPUTarget("cuda", capability, 32))
    print(capability, found.name, "cubin" in found.asm, "ld.local" in found.asm["ptx"])

for capability in (87, 90):
    compiled(_sweep, "*i16 *i16 *i16 *i16 i32 i32 i32 i32", [CELLS], capability)
    compiled(
        _bilateral,
        "*fp32 *u8 *i32 *fp32 *i32 *fp32 *fp32 *fp32 i32 i32 i32 i32 fp32 fp32 fp32",
        [10, ROWS, COLUMNS], capability,
    )
"""


def test_kernels_compile_for_orin_and_hopper(tmp_path: Path) -> None:
    """Machine code without a GPU: the interpreter forgives what the compiler does not."""
    pytest.importorskip("triton", reason="Triton is not installed; torch for CUDA brings it")
    settings = os.environ | {"TRITON_INTERPRET": "0", "TRITON_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", COMPILE], env=settings, capture_output=True,
        text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert sorted(done.stdout.splitlines()) == [
        "87 _bilateral True False", "87 _sweep True False",
        "90 _bilateral True False", "90 _sweep True False",
    ]  # fmt: skip


@pytest.fixture
def told(caplog: pytest.LogCaptureFixture) -> Callable[[], str]:
    """What was logged so far."""
    caplog.set_level("INFO", logger="service.compute.fused_kernels")
    return lambda: "\n".join(r.getMessage() for r in caplog.records)


def test_a_kernel_is_used_only_when_it_agrees_and_is_faster(
    device: str, monkeypatch: pytest.MonkeyPatch, told: Callable[[], str]
) -> None:
    """A wrong one, a slow one, one that cannot run, and no Triton at all."""
    from recon.backends.torch_kernels import PLAIN, Kernels
    from recon.backends.torch_upsampling import JointBilateral
    from service.compute import fused_kernels

    def wrong(data: Any, messages: Any, slope: Any, cut: Any, colour: int) -> None:
        messages.add_(colour)

    def right(px: Any, sure: Any, taps: Any, guide: Any, true: Any, config: Any) -> Any:
        return JointBilateral(config)(px, sure, taps, guide, true)

    def broken(*given: Any) -> Any:
        raise RuntimeError("no C compiler\nand more")

    def missing() -> Kernels:
        raise ImportError("No module named 'triton'")

    times = iter([2.0, 1.0, 1.0, 2.0])
    monkeypatch.setattr(fused_kernels, "_least_ms", lambda work, device: next(times))

    def chosen(load: Callable[[], Kernels]) -> Kernels:
        return fused_kernels.choose_kernels(device, load, (40, 24), (80, 48))

    assert chosen(lambda: Kernels(wrong, right)) == Kernels(None, right)
    assert "belief propagation: not used, a number is off by" in told()
    assert "upsampling: used, 1.00 ms beside 2.00 ms of plain torch" in told()
    assert chosen(lambda: Kernels(broken, right)) == PLAIN
    assert "belief propagation: cannot run, no C compiler" in told()
    assert "upsampling: not used, 2.00 ms beside 1.00 ms" in told()
    assert chosen(missing) == PLAIN
    assert "fused kernels: none, No module named 'triton'" in told()


def test_the_backend_computes_with_the_kernels_it_is_given(device: str) -> None:
    """Calls and whole path; what was built before is built anew."""
    from recon.backends.torch_backend import TorchBackend
    from recon.backends.torch_dense import sweep_plainly
    from recon.backends.torch_kernels import Kernels
    from recon.backends.torch_upsampling import JointBilateral

    used: list[str] = []

    def sweep(data: Any, messages: Any, slope: Any, cut: Any, colour: int) -> None:
        used.append("sweep")
        messages.copy_(sweep_plainly(data, messages, slope, cut, colour, 320))

    def bilateral(px: Any, sure: Any, taps: Any, guide: Any, true: Any, config: Any) -> Any:
        used.append("bilateral")
        return JointBilateral(config)(px, sure, taps, guide, true)

    backend = TorchBackend(device)
    left, right = textured(40, 64, 1), np.roll(textured(40, 64, 1), -3, 1)
    guide = np.stack([textured(80, 128, seed) for seed in (3, 4, 5)], -1)
    plain = backend.belief_propagation(left, right, 8, BeliefPropagationConfig())
    fine = backend.upsample(plain, guide, UpsamplingConfig(diameter_px=3))
    assert not used
    backend.use(Kernels(sweep, bilateral))
    again = backend.belief_propagation(left, right, 8, BeliefPropagationConfig())
    np.testing.assert_array_equal(again.px, plain.px)
    finer = backend.upsample(again, guide, UpsamplingConfig(diameter_px=3))
    np.testing.assert_array_equal(finer.px, fine.px)
    assert set(used) == {"sweep", "bilateral"}
