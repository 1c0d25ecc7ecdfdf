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

import dense_reference as reference
import numpy as np
import pytest

from recon import se3
from recon.mapping.registration import IcpConfig, register_projective
from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.stereo.matching_cost import matching_cost
from recon.stereo.upsampling import UpsamplingConfig, guide_at_taps
from recon.types import F32, U8, DepthMap, DisparityMap

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
    from recon.backends.torch_stereo import edge_weights, propagate

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
    from recon.backends.torch_depth import JointBilateral

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


@pytest.mark.parametrize(
    ("height", "width", "labels", "first"), [(13, 21, 9, 0), (9, 40, 5, -3), (8, 16, 12, 4)]
)
def test_costs_of_one_kernel_are_the_compiled_ones(
    kernels: Any, device: str, height: int, width: int, labels: int, first: int
) -> None:
    """Census at the borders, partners outside either way, and room around the pair."""
    config = BeliefPropagationConfig(min_disparity=first)
    left, right = textured(height, width, 1), textured(height, width, 2)
    want = matching_cost(left, right, labels, config.cost, first)
    wide = [np.pad(image, ((0, 3), (0, 5)), mode="edge") for image in (left, right)]
    a, b = (torch.from_numpy(image).float().to(device) for image in wide)
    true = torch.tensor([height, width, labels], device=device)
    found = kernels.cost(a, b, labels + 2, true, config).permute(1, 0, 2).cpu().numpy()
    np.testing.assert_array_equal(found[:height, :labels, :width], want)
    assert not found[height:].any() and not found[:, :, width:].any()


def rolling(east_m: float, up_m: float) -> DepthMap:
    """(54, 80) depth of rolling ground, with a hole, from a place of a camera that looks down."""
    v, u = np.mgrid[0:54, 0:80]
    rays = np.stack([(u - 39.5) / 60, (v - 26.5) / 60], -1)
    z = np.full(u.shape, 40.0)
    for _ in range(60):
        x, y = rays[..., 0] * z + east_m, rays[..., 1] * z
        z += 0.7 * (40 + up_m - 3 * np.sin(x / 5) * np.cos(y / 6) - z)
    z = z + np.random.default_rng(int(10 * up_m) + 7).normal(0, 0.02, z.shape)
    z[10:16, 20:30] = np.nan
    K = np.array([[60.0, 0, 39.5], [0, 60.0, 26.5], [0, 0, 1]])
    sigma = np.full(z.shape, 0.02, np.float32)
    return DepthMap(z.astype(np.float32), sigma, np.ones(z.shape, np.uint8), K, np.eye(4))


def test_registration_by_kernels_is_the_compiled_one(kernels: Any, device: str) -> None:
    """Every iteration of both levels; sums, directions and steps as plain torch has them."""
    from recon.backends.torch_icp import DeviceIcp, descend, weigh
    from recon.backends.torch_surface import build, points

    source, target = rolling(0.6, 0.3), rolling(0.0, 0.0)
    config = IcpConfig(strides=(4, 2), iterations=(4, 3))
    want = register_projective(source, target, np.eye(4), config)
    found = DeviceIcp(device, kernels).register(source, target, np.eye(4), config)
    assert found.verdict == want.verdict == "converged"
    between = found.T_target_source @ se3.inverse(want.T_target_source)
    twist = np.r_[se3.so3_log(between[:3, :3]), between[:3, 3]]
    assert np.sqrt(twist @ np.linalg.solve(want.covariance, twist)) < 0.2
    np.testing.assert_allclose(
        np.linalg.eigvalsh(found.covariance), np.linalg.eigvalsh(want.covariance), rtol=0.2
    )
    plain = DeviceIcp(device).register(source, target, np.eye(4), config)
    np.testing.assert_allclose(found.T_target_source, plain.T_target_source, atol=1e-7)
    assert found.iterations == plain.iterations
    surfaces = []
    for depth in (source, target):
        z, sigma = (torch.from_numpy(x).to(device) for x in (depth.depth_m, depth.sigma_m))
        K = torch.tensor([60.0, 60.0, 39.5, 26.5], dtype=torch.float64, device=device)
        surfaces.append(build(z, sigma, K, config.edge_share))
    a, b = surfaces
    T, _, _ = descend(a, b, torch.eye(4, dtype=torch.float64, device=device), config)
    for tukey in (False, True):
        seen = points(a, 3)
        mine, theirs = (look(seen, a, b, T, tukey, config) for look in (kernels.weigh, weigh))
        for name in ("H", "common", "g", "sums", "scale", "residual", "found", "partners"):
            got, wanted = getattr(mine, name).cpu().numpy(), getattr(theirs, name).cpu().numpy()
            np.testing.assert_allclose(got, wanted, rtol=1e-6, atol=1e-6 * np.abs(wanted).max())


COMPILE = """
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from recon.backends.triton_dense import (
    CELLS, COLUMNS, PIXELS, ROWS, _bilateral, _census, _cost, _sweep,
)
from recon.backends.triton_icp import ROW, _advance, _normal_equations, _residuals

def compiled(capability, warps, kernel, words, *constants):
    names = kernel.arg_names
    kinds = dict(zip(names, words.split() + ["constexpr"] * len(constants), strict=True))
    values = dict(zip(names[len(names) - len(constants):], constants, strict=True))
    source = ASTSource(fn=kernel, signature=kinds, constexprs=values)
    target = GPUTarget("cuda", capability, 32)
    found = triton.compile(source, target=target, options={"num_warps": warps})
    print(capability, found.name, "cubin" in found.asm, "ld.local" in found.asm["ptx"])

matched = "*fp64 *fp64 *fp64 *fp32 *fp64 *fp64 "
tables = "*fp32 *u8 *i32 *fp32 *i32 *fp32 *fp32 *fp32 "
compiled(87, 4, _sweep, "*i16 *i16 *i16 *i16 i32 i32 i32 i32", CELLS)
compiled(87, 4, _bilateral, tables + "i32 i32 i32 i32 fp32 fp32 fp32", 10, ROWS, COLUMNS)
compiled(90, 4, _census, "*fp32 *i32 i32 i32 i32", PIXELS)
compiled(
    90, 4, _cost,
    "*fp32 *fp32 *i32 *i64 *fp32 i32 i32 i32 i32 i32 i32 fp32 i32 i32 fp32", PIXELS,
)
compiled(90, 1, _residuals, matched + "*fp64 *fp64 i32 i32 i32 fp32", 32)
compiled(
    90, 1, _normal_equations, matched + "*fp64 *fp64 *fp64 i32 i32 i32 fp32 fp32 i32", 32, ROW
)
compiled(90, 1, _advance, "*fp64 " * 8 + "fp32 fp32 fp32 i32 i32")
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
    names = "_advance _census _cost _normal_equations _residuals"
    want = ["87 _bilateral", "87 _sweep", *(f"90 {name}" for name in names.split())]
    assert sorted(done.stdout.splitlines()) == [f"{name} True False" for name in want]


@pytest.fixture
def told(caplog: pytest.LogCaptureFixture) -> Callable[[], str]:
    """What was logged so far."""
    caplog.set_level("INFO", logger="service.compute.fused_kernels")
    return lambda: "\n".join(r.getMessage() for r in caplog.records)


def test_a_kernel_is_used_only_when_it_agrees_and_is_faster(
    device: str, monkeypatch: pytest.MonkeyPatch, told: Callable[[], str]
) -> None:
    """A wrong one, a slow one, one that cannot run, and no Triton at all."""
    from recon.backends.torch_depth import JointBilateral
    from recon.backends.torch_icp import advance, weigh
    from recon.backends.torch_kernels import PLAIN, Kernels
    from service.compute import fused_kernels

    def wrong(data: Any, messages: Any, slope: Any, cut: Any, colour: int) -> None:
        messages.add_(colour)

    def right(px: Any, sure: Any, taps: Any, guide: Any, true: Any, config: Any) -> Any:
        return JointBilateral(config)(px, sure, taps, guide, true)

    def broken(*given: Any) -> Any:
        raise RuntimeError("no C compiler\nand more")

    def missing() -> Kernels:
        raise ImportError("No module named 'triton'")

    times = iter([2.0, 1.0, 1.0, 2.0, 3.0, 1.0])
    monkeypatch.setattr(fused_kernels, "_least_ms", lambda work, device: next(times))

    def chosen(load: Callable[[], Kernels]) -> Kernels:
        return fused_kernels.choose_kernels(device, load, (40, 24), (80, 48))

    def off(weighed: Any, a: Any, T: Any, state: Any, share: float, config: Any) -> Any:
        moved, state = advance(weighed, a, T, state, share, config)
        return moved + 1e-4, state

    icp = weigh, off
    assert chosen(lambda: Kernels(wrong, right, *icp)) == Kernels(None, right)
    assert "registration: not used, a number is off by" in told()
    assert "belief propagation: not used, a number is off by" in told()
    assert "upsampling: used, 1.00 ms beside 2.00 ms of plain torch" in told()
    icp = weigh, advance
    assert chosen(lambda: Kernels(broken, right, *icp)) == Kernels(None, None, *icp)
    assert "belief propagation: cannot run, no C compiler" in told()
    assert "upsampling: not used, 2.00 ms beside 1.00 ms" in told()
    assert chosen(missing) == PLAIN
    assert "fused kernels: none, No module named 'triton'" in told()


def test_a_backend_on_cuda_is_given_the_kernels_that_pay(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Compiled ones are kept where the service may write; on a processor nothing is tried."""
    from recon.backends.torch_kernels import Kernels
    from service.compute import backend_choice, fused_kernels

    class Device:
        """Takes kernels."""

        name = "torch"

        def __init__(self, device: str) -> None:
            self.device = device
            self.kernels: Kernels | None = None

        def use(self, kernels: Kernels) -> None:
            self.kernels = kernels

    chosen = Kernels()
    monkeypatch.setattr(fused_kernels, "choose_kernels", lambda device: chosen)
    monkeypatch.setenv("CACHE_DIRECTORY", str(tmp_path))
    monkeypatch.setenv("TRITON_CACHE_DIR", "given")
    monkeypatch.delenv("TRITON_CACHE_DIR")
    for device, want in (("cuda", chosen), ("cpu", None)):
        backend = Device(device)
        given: Any = backend
        assert backend_choice.with_kernels(given) is given
        assert backend.kernels is want
    assert os.environ["TRITON_CACHE_DIR"] == str(tmp_path / "engines" / "triton")


def test_the_backend_computes_with_the_kernels_it_is_given(device: str) -> None:
    """Calls and whole path; what was built before is built anew."""
    from recon.backends.torch_backend import TorchBackend
    from recon.backends.torch_depth import JointBilateral
    from recon.backends.torch_kernels import Kernels
    from recon.backends.torch_stereo import sweep_plainly

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
