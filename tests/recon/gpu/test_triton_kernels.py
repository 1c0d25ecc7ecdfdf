"""Every Triton kernel compiles, without a GPU; what they compute is in test_torch_path and _icp."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

pytest.importorskip("torch")
if find_spec("triton") is None:  # its import would choose between interpreter and compiler
    pytest.skip("triton is not installed", allow_module_level=True)

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
compiled(dense.census_kernel, "*u8 *u8 *i32 " + sizes, offsets=dense.CENSUS_OFFSETS, PIXELS=128)
compiled(dense.cost_kernel, "*u8 *u8 *i32 *i64 *i16 *i16 " + sizes * 4 + "i32", LABELS=16, CELLS=32)
compiled(dense.edges_kernel, "*u8 *i64 *i32 i32 i32 fp32 fp32 i32", PIXELS=128)
compiled(dense.coarser_kernel, "*i16 *i32 *i64 *i16 *i32 " + sizes * 2, LABELS=16, CELLS=32)
compiled(dense.finer_kernel, "*i16 *i16 *i64 i32 " + sizes * 2, LABELS=16, CELLS=32)
compiled(dense.sweep_kernel, "*i16 *i16 *i32 " + sizes * 3, 1, LABELS=16, CELLS=16)
compiled(
    dense.select_kernel, "*i16 *i16 *i16 *i64 *fp32 *fp32 i32 i32 i32 fp32 fp32 fp32 fp32",
    radius=3, LABELS=16, CELLS=32,
)
compiled(dense.contrast_kernel, "*u8 *fp64 " + sizes, radius=3, PIXELS=128)
compiled(dense.project_kernel, "*fp32 *fp32 *i64 *i32 *i1 i32 i32 i32 fp32", PIXELS=128)
compiled(dense.compare_kernel, "*fp32 *fp32 *i64 *i32 *i1 i32 i32 i32 fp32", PIXELS=128)
compiled(dense.unseen_kernel, "*fp32 *fp32 *u8 *u8 *i64 *fp32 *fp32 " + sizes, PIXELS=128)
compiled(dense.wander_kernel, "*i32 *i32 *i32 " + sizes * 2, PIXELS=128)
compiled(dense.measure_kernel, "*i32 *i32 *i32 i32 " + sizes * 2, PIXELS=128)
compiled(dense.averaged_kernel, "*u8 *i64 *fp32 " + sizes * 2, PIXELS=128)
compiled(
    dense.bilateral_kernel, "*fp32 *u8 *i64 *fp32 *fp32 i32 i32 i32 i32 fp32 fp32 fp32 fp32",
    diameter=10, ROWS=4, COLUMNS=64,
)
compiled(dense.reproject_kernel, "*fp32 *fp32 *fp64 *i64 *fp32 *fp32 i32 i32 i32 fp32", PIXELS=128)
fuse = "*fp32 *fp32 *fp32 *fp32 *u8 *i32 i32 fp32 fp32 fp32 fp32"
compiled(dense.fuse_kernel, fuse, PAIRS=4, PIXELS=256)
compiled(dense.refute_kernel, "*fp32 *fp32 *u8 *i32 i32", PIXELS=256)
matched = "*fp64 *fp64 *fp64 *fp32 *fp64 *fp64 "
compiled(icp.surface_kernel, "*fp32 *fp32 *fp64 *fp32 i32 i32 fp32 i32", reach=2, PIXELS=128)
compiled(icp.residuals_kernel, matched + "*fp64 *fp64 i32 i32 i32 fp32", 1, POINTS=128)
compiled(icp.scale_kernel, "*fp64 *fp64 *fp64 " + sizes, 8, COUNT=4096)
compiled(
    icp.normal_equations_kernel, matched + "*fp64 *fp64 *fp64 i32 i32 i32 fp32 fp32 i32", 1,
    POINTS=128, ROW=83,
)
compiled(icp.advance_kernel, "*fp64 " * 8 + "fp32 fp32 fp32 i32 i32", 1)
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
    kernels = set(re.findall(r"^def (\w+_kernel)\(", source, re.M))
    assert kernels
    assert set(done.stdout.split()) == kernels
