"""The Triton kernels against plain torch: in Triton's interpreter, on small arrays.

On a GPU (``--device cuda``) the tests of the torch backend run the compiled kernels themselves.
Here costs, labels and masks are equal, and sums of floats agree to their rounding.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recon.mapping.registration import IcpConfig
from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.stereo.reprojection import DepthFusionConfig
from recon.stereo.upsampling import UpsamplingConfig
from recon.types import Array, DepthMap

torch = pytest.importorskip("torch")
if find_spec("triton") is None:  # its import would choose between interpreter and compiler
    pytest.skip("triton is not installed", allow_module_level=True)

Results = tuple[Any, ...]
Both = Callable[[Callable[[], Any], float], Results]


@pytest.fixture
def both(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Both:
    """Computes twice, in plain torch and with the kernels, and compares."""
    if request.config.getoption("--device") != "cpu":
        pytest.skip("the kernels are compiled on a GPU")
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    from recon.backends import torch_plan, triton_dense, triton_icp

    monkeypatch.setattr(torch_plan, "INTERPRETED", True)
    for module, name in (
        (triton_dense, "PIXELS"), (triton_dense, "CELLS"), (triton_dense, "FUSED_PIXELS"),
        (triton_icp, "POINTS"),
    ):  # fmt: skip
        monkeypatch.setattr(module, name, 512)  # few programs: each takes long here
    # Not SWEPT: the scan of a sweep takes one element after the other, also those beyond the image.

    def compared(work: Callable[[], Any], tolerance: float = 0.0) -> Results:
        found = []
        for kernels in (False, True):
            monkeypatch.setattr(torch_plan, "HAS_TRITON", kernels)
            with torch.inference_mode():
                got = work()
            found.append(got if isinstance(got, tuple) else (got,))
        for want, got in zip(*found, strict=True):
            a, b = want.numpy(), got.numpy()
            assert a.dtype == b.dtype
            scale = np.nanmax(np.abs(a), initial=1e-30)
            np.testing.assert_allclose(b, a, rtol=0, atol=tolerance * scale)
        return found[1]

    return compared


def tensors(*arrays: Array) -> Any:
    """The arrays as tensors."""
    return [torch.from_numpy(np.ascontiguousarray(a)) for a in arrays]


def noise(shape: tuple[int, ...], seed: int, top: int = 256) -> Array:
    """Random gray levels."""
    return np.random.default_rng(seed).integers(0, top, shape, np.uint8)


@pytest.mark.parametrize(
    ("size", "labels", "levels", "settings"),
    [
        ((9, 13), 5, 2, {"iterations": 2}),
        ((8, 11), 9, 1, {"iterations": 1, "min_disparity": -2, "min_evidence": 0.0}),
        ((11, 10), 4, 3, {"iterations": 1, "min_disparity": 2, "smoothness_truncation": 1.5}),
    ],
)
def test_stereo(
    both: Both, size: tuple[int, int], labels: int, levels: int, settings: dict[str, float]
) -> None:
    """Odd sizes, room around the pair, partners outside, levels of the pyramid."""
    from recon.backends.torch_stereo import dense_stereo

    config = BeliefPropagationConfig(**settings)  # type: ignore[arg-type]
    h, w = size
    left = np.pad(noise(size, 1), ((0, 3), (0, 2)), mode="edge")
    right = np.pad(np.roll(noise(size, 1), -2, 1), ((0, 3), (0, 2)), mode="edge")
    given = tensors(left, right, np.array([h, w, labels]))
    stereo = partial(dense_stereo, labels=labels + 2, levels=levels, config=config)
    px, confidence = both(lambda: tuple(t[:h, :w] for t in stereo(*given)), 1e-6)
    assert np.isfinite(px.numpy()).mean() > 0.3
    assert (confidence.numpy() > 0).any()


def test_checks_of_labels(both: Both) -> None:
    """Contrast, hidden surfaces, speckles, masks."""
    from recon.backends import torch_stereo as stereo

    rng = np.random.default_rng(4)
    px = rng.choice(np.array([3.2, 3.6, 9.4, 0.5, np.nan], np.float32), (14, 24))
    sure = np.where(np.isnan(px) | (rng.random(px.shape) < 0.1), 0, 0.7).astype(np.float32)
    masks = [(rng.random(px.shape) < 0.9).astype(np.uint8) for _ in range(2)]
    labels, confidence, left, right = tensors(px, sure, *masks)
    true = torch.tensor([14, 22])
    both(lambda: stereo._contrast(tensors(noise((14, 24), 1))[0]), 1e-12)
    for first in (-2, 0, 3):
        config = BeliefPropagationConfig(min_disparity=first)
        (hidden,) = both(lambda c=config: stereo._hidden(labels, confidence, true, c), 0.0)  # type: ignore[misc]
        assert hidden.any() and not hidden.all()
    (speckles,) = both(lambda: stereo._speckles(labels, 6), 0.0)
    assert speckles.any() and not speckles.all()
    found, _ = both(lambda: stereo.drop_unseen(labels, confidence, left, right, true), 0.0)
    assert 0.1 < torch.isnan(found).float().mean() < 0.9


def test_upsampling(both: Both) -> None:
    """Unknown taps, room around both images; means of a ratio that is not whole."""
    from recon.backends.torch_depth import averaged, upsampled

    rng = np.random.default_rng(0)
    px = rng.uniform(0, 16, (9, 11)).astype(np.float32)
    px[rng.random(px.shape) < 0.3] = np.nan
    sure = rng.uniform(0, 1, px.shape).astype(np.float32)
    given = tensors(px, sure, noise((23, 40, 3), 2), np.array([7, 9, 21, 27]))
    stage = partial(upsampled, config=UpsamplingConfig(diameter_px=4))
    label, _ = both(lambda: tuple(t[:21, :27] for t in stage(*given)), 1e-5)
    assert 0.3 < torch.isfinite(label).float().mean() < 1.0
    true = torch.tensor([7, 9, 20, 33])
    both(lambda: averaged(given[2], (9, 11), true)[:7, :9], 0.02)  # halves round either way


def test_depth_and_fusion(both: Both) -> None:
    """Holes, edges and places outside; groups, contradictions, and a map of them alone."""
    from recon.backends.torch_depth import fuse, reproject

    rng = np.random.default_rng(1)
    px = rng.uniform(7, 8, (20, 30)).astype(np.float32)
    px[5:9, 5:12] += 5
    px[rng.random(px.shape) < 0.1] = np.nan
    sure = rng.uniform(0, 1, px.shape).astype(np.float32)
    turn = [1.0, 0.02, -1.5, -0.01, 1.0, 0.8, 1e-3, -1e-3, 1.0]
    geometry = np.array([*turn, 0.01, -0.02, 8.0, 0.99, 400.0, 0.08])
    labels, trust, numbers, true = tensors(px, sure, geometry, np.array([9, 14, 18, 28]))
    depth, _ = both(lambda: reproject(labels, trust, numbers, true, (14, 9)), 1e-6)
    assert 0.2 < torch.isfinite(depth).float().mean() < 1.0
    z = 50 + rng.normal(0, 0.2, (3, 12, 16)) + 5 * (rng.random((3, 12, 16)) < 0.2)
    z[rng.random(z.shape) < 0.3] = np.nan
    sigma = rng.choice(np.array([0.1, 0.2, 3.0]), z.shape)
    for apart, known in ((1.0, True), (1.3, False)):
        z[1:] *= apart
        z[2:] *= apart
        stack = tensors(z.astype(np.float32), sigma.astype(np.float32))
        fused, _, views = both(lambda s=stack: fuse(s[0], s[1], DepthFusionConfig()), 1e-6)  # type: ignore[misc]
        assert bool(torch.isfinite(fused).any()) is known
        assert bool((views > 1).any()) is known


def test_registration(both: Both) -> None:
    """Surfaces, sums, medians and steps of both levels."""
    from recon.backends.torch_icp import DeviceIcp

    v, u = np.mgrid[0:20, 0:26]
    depths: Any = []
    for shift in (0.2, 0.0):
        z = 40 + np.sin((u + shift) / 3) * np.cos(v / 4) + shift
        z = (z + np.random.default_rng(int(9 * shift)).normal(0, 0.02, z.shape)).astype(np.float32)
        z[3:6, 4:9] = np.nan
        K = np.array([[20.0, 0, 12.5], [0, 20.0, 9.5], [0, 0, 1]])
        sigma = np.full(z.shape, 0.02, np.float32)
        depths.append(DepthMap(z, sigma, np.ones(z.shape, np.uint8), K, np.eye(4)))
    icp = DeviceIcp("cpu")
    config = IcpConfig(strides=(2, 1), iterations=(2, 1))

    def work() -> Results:
        found = icp.register(depths[0], depths[1], np.eye(4), config)
        return tuple(tensors(found.T_target_source, found.covariance))

    T, covariance = both(work, 1e-6)
    assert 0.05 < np.linalg.norm(T.numpy()[:3, 3]) < 0.5
    assert np.linalg.eigvalsh(covariance.numpy()).min() > 0


COMPILE = """
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from recon.backends import triton_dense as dense, triton_icp as icp

def compiled(kernel, words, warps=4, **constants):
    kinds = iter(words.split())
    names = {n: "constexpr" if n in constants else next(kinds) for n in kernel.arg_names}
    for p in kernel.params:  # an integer of 1 or a multiple of 16 would be compiled in
        assert names[p.name] != "i32" or p.do_not_specialize, (kernel.__name__, p.name)
    source = ASTSource(fn=kernel, signature=names, constexprs=constants)
    found = triton.compile(
        source, target=GPUTarget("cuda", 87, 32), options={"num_warps": warps}
    )
    assert "ld.local" not in found.asm["ptx"], found.name
    print(found.name)

sizes = "i32 i32 "
compiled(dense._census, "*u8 *u8 *i32 " + sizes, radius=2, PIXELS=128)
compiled(dense._cost, "*u8 *u8 *i32 *i64 *i16 *i16 " + sizes * 4 + "i32", LABELS=16, CELLS=32)
compiled(dense._edges, "*u8 *i64 *i32 i32 i32 fp32 fp32 i32", PIXELS=128)
compiled(dense._coarser, "*i16 *i32 *i64 *i16 *i32 " + sizes * 2, LABELS=16, CELLS=32)
compiled(dense._finer, "*i16 *i16 *i64 i32 " + sizes * 2, LABELS=16, CELLS=32)
compiled(dense._sweep, "*i16 *i16 *i32 " + sizes * 3, 1, LABELS=16, CELLS=16)
compiled(
    dense._select, "*i16 *i16 *i16 *i64 *fp32 *fp32 i32 i32 i32 fp32 fp32 fp32 fp32",
    radius=3, LABELS=16, CELLS=32,
)
compiled(dense._contrast, "*u8 *fp64 " + sizes, radius=3, PIXELS=128)
compiled(dense._project, "*fp32 *fp32 *i64 *i32 *i1 i32 i32 i32 fp32", PIXELS=128)
compiled(dense._compare, "*fp32 *fp32 *i64 *i32 *i1 i32 i32 i32 fp32", PIXELS=128)
compiled(dense._unseen, "*fp32 *fp32 *u8 *u8 *i64 *fp32 *fp32 " + sizes, PIXELS=128)
compiled(dense._wander, "*i32 *i32 *i32 " + sizes * 2, PIXELS=128)
compiled(dense._measure, "*i32 *i32 *i32 i32 " + sizes * 2, PIXELS=128)
compiled(dense._averaged, "*u8 *i64 *fp32 " + sizes * 2, PIXELS=128)
compiled(
    dense._bilateral, "*fp32 *u8 *i64 *fp32 *fp32 i32 i32 i32 i32 fp32 fp32 fp32 fp32",
    diameter=10, ROWS=4, COLUMNS=64,
)
compiled(dense._reproject, "*fp32 *fp32 *fp64 *i64 *fp32 *fp32 i32 i32 i32 fp32", PIXELS=128)
fuse = "*fp32 *fp32 *fp32 *fp32 *u8 *i32 i32 fp32 fp32 fp32 fp32"
compiled(dense._fuse, fuse, PAIRS=4, PIXELS=256)
compiled(dense._refute, "*fp32 *fp32 *u8 *i32 i32", PIXELS=256)
matched = "*fp64 *fp64 *fp64 *fp32 *fp64 *fp64 "
compiled(icp._surface, "*fp32 *fp32 *fp64 *fp32 i32 i32 fp32 i32", reach=2, PIXELS=128)
compiled(icp._residuals, matched + "*fp64 *fp64 i32 i32 i32 fp32", 1, POINTS=128)
compiled(icp._scale, "*fp64 *fp64 *fp64 " + sizes, 8, COUNT=4096)
compiled(
    icp._normal_equations, matched + "*fp64 *fp64 *fp64 i32 i32 i32 fp32 fp32 i32", 1,
    POINTS=128, ROW=83,
)
compiled(icp._advance, "*fp64 " * 8 + "fp32 fp32 fp32 i32 i32", 1)
"""


def test_every_kernel_compiles_for_orin(tmp_path: Path) -> None:
    """Machine code without a GPU: the interpreter allows what the compiler does not."""
    settings = os.environ | {"TRITON_INTERPRET": "0", "TRITON_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", COMPILE], env=settings, capture_output=True,
        text=True, timeout=400, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    source = "".join(p.read_text() for p in Path("recon/backends").glob("triton_*.py"))
    kernels = {
        line[4:].partition("(")[0]
        for line in source.splitlines() if line.startswith("def _")
    } - set(HELPERS)  # fmt: skip
    assert set(done.stdout.split()) == kernels


HELPERS = (
    "_ones", "_cut", "_whole", "_edge", "_halved", "_least", "_envelope", "_at", "_partners",
    "_neighbour", "_extremes", "_span", "_first_tap", "_reading", "_moved", "_partner", "_row",
    "_products", "_product", "_total", "_inverse",
)  # fmt: skip
"""Functions that kernels call."""
