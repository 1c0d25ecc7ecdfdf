"""Kernels from numba's cache: code alone, until another one is compiled that calls them."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

KERNELS = """
import numpy as np
from numba import njit


@njit(cache=True)
def inner(x):
    held = np.full((x, x), 3.0)
    return int(np.linalg.norm(held)) + 1


@njit
def outer(x):
    return inner(x) + inner(x + 1)
"""

BOTH = """
import recon.parallel
from kernels import inner, outer
from numba.core.runtime import rtsys
assert inner(2) == 7
assert not rtsys._init  # nothing is compiled
library, = (found.library for found in inner.overloads.values())
print(sum(inner.stats.cache_hits.values()), library._shared_module is None, outer(2))
"""


OTHER_NUMBA = """
import numba
numba.version_info = numba.misc.init_utils.generate_version_info(VERSION)
import recon.parallel
from kernels import inner
from numba.core.runtime import rtsys
assert inner(2) == 7
library, = (found.library for found in inner.overloads.values())
print(sum(inner.stats.cache_hits.values()), library._shared_module is None, rtsys._init)
"""


@pytest.mark.slow
def test_a_kernel_from_the_cache_is_unpacked_for_one_that_calls_it(tmp_path: Path) -> None:
    said = cached(tmp_path)
    assert said(BOTH) == ["1", "True", "17"]


OTHERS = [
    "0+untagged",
    *(pytest.param(v, marks=pytest.mark.slow) for v in ("0.59.1", "0.68.0", "1.63.1")),
]


@pytest.mark.parametrize("version", OTHERS)
def test_another_numba_loads_kernels_its_own_way(tmp_path: Path, version: str) -> None:
    said = cached(tmp_path)
    assert said(OTHER_NUMBA.replace("VERSION", repr(version))) == ["1", "False", "True"]


def cached(tmp_path: Path) -> Callable[[str], list[str]]:
    """What other processes print that find a kernel in the cache, by their code."""
    (tmp_path / "kernels.py").write_text(KERNELS)
    given = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(tmp_path)}

    def said(code: str) -> list[str]:
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, env=given, capture_output=True, text=True, check=True)
        return done.stdout.split()

    said("from kernels import inner; inner(2)")
    return said
