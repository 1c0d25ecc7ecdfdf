"""The table of the trials: every trial adds its row, ``make trials`` keeps it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from trial_rig import Row, Table


@pytest.fixture(scope="session")
def table() -> Table:
    """Collects rows; written where SKYRELIEF_TRIALS_TABLE says, rows of before kept."""
    target = os.environ.get("SKYRELIEF_TRIALS_TABLE", "")
    return Table(Path(target) if target else None)


@pytest.fixture
def record(table: Table) -> Row:
    """A row to fill in: ``record(fault, times, outcome, lost, back_s)``."""
    return table.add
