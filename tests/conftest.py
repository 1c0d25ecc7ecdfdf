"""Fixtures that all tests share."""

from __future__ import annotations

import os
from pathlib import Path

# Threads of OpenBLAS and torch spin: up to fifty times the processor time. Read at their import.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
from house_flight import HouseFlight
from hypothesis import settings
from trial_rig import Row, Table

settings.register_profile("loaded machines", deadline=None)
settings.load_profile("loaded machines")


pytest_plugins = ["tiers"]


@pytest.fixture(scope="session")
def house() -> HouseFlight:
    """The flight over the house."""
    return HouseFlight()


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--device cuda`` runs the tests of the backends on a GPU."""
    parser.addoption("--device", default="cpu", choices=("cpu", "cuda"), help="of the backends")


@pytest.fixture(scope="session")
def table() -> Table:
    """Collects the rows of trials; written where SKYRELIEF_TRIALS_TABLE says, older ones kept."""
    target = os.environ.get("SKYRELIEF_TRIALS_TABLE", "")
    return Table(Path(target) if target else None)


@pytest.fixture
def record(table: Table) -> Row:
    """A row to fill in: ``record(fault, times, outcome, lost, back_s)``."""
    return table.add
