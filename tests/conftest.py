"""Fixtures that all tests share."""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

# Threads of OpenBLAS and torch spin: up to fifty times the processor time. Read at their import.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest

if TYPE_CHECKING:
    from house_flight import HouseFlight
    from trial_rig import Row, Table


pytest_plugins = ["tiers"]


@pytest.fixture(scope="session")
def house() -> HouseFlight:
    """The flight over the house."""
    from house_flight import HouseFlight

    return HouseFlight()


@pytest.fixture(scope="session")
def mesh_libraries() -> None:
    """What a mesh needs; imported by the first test that does, as it takes seconds."""
    pytest.importorskip("open3d", exc_type=ImportError)
    pytest.importorskip("fast_simplification")


def pytest_configure(config: pytest.Config) -> None:
    """Without a GPU Triton interprets its kernels; it decides so when it is imported."""
    if config.getoption("--device") == "cpu":
        os.environ.setdefault("TRITON_INTERPRET", "1")


def pytest_collection() -> None:
    """Hypothesis sets no deadline, as machines are loaded. Here, before the tests are imported, and
    not in the process that only hands them to workers: half a second."""
    from hypothesis import settings

    settings.register_profile("loaded machines", deadline=None)
    settings.load_profile("loaded machines")


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--device cuda`` runs the tests of the backends on a GPU."""
    parser.addoption("--device", default="cpu", choices=("cpu", "cuda"), help="of the backends")


@pytest.fixture
def device(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Where Triton's kernels run, "cuda" or its interpreter; skips where they cannot."""
    chosen = str(request.config.getoption("--device"))
    if find_spec("torch") is None or find_spec("triton") is None:
        pytest.skip("torch or triton is not installed")
    if chosen == "cpu":
        from recon.backends import padding, triton_dense, triton_icp

        for module, name, value in (  # few programs: each takes long here
            (triton_dense, "PIXELS", 512), (triton_dense, "CELLS", 512),
            (triton_dense, "FUSED_PIXELS", 512), (triton_icp, "POINTS", 512),
            (padding, "PAD_PX", 4),
        ):  # fmt: skip
            monkeypatch.setattr(module, name, value)
        # Not SWEPT: a scan takes one element after the other, also those beyond the image.
    return chosen


@pytest.fixture(scope="session")
def table() -> Table:
    """Collects the rows of trials; written where SKYRELIEF_TRIALS_TABLE says, older ones kept."""
    from trial_rig import Table

    target = os.environ.get("SKYRELIEF_TRIALS_TABLE", "")
    return Table(Path(target) if target else None)


@pytest.fixture
def record(table: Table) -> Row:
    """A row to fill in: ``record(fault, times, outcome, lost, back_s)``."""
    return table.add
