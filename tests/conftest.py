"""What all tests share: fixtures, and the tier that a test belongs to."""

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


@pytest.fixture(scope="session")
def house() -> HouseFlight:
    """The flight over the house."""
    return HouseFlight()


FIRST = (
    "test_replay", "test_pose_graph", "test_graph_hard_flights", "test_graph_dropped",
    "test_graph_thinning", "test_lean", "test_trial_service", "test_doc_commands_run",
    "test_own_lens", "test_trial_attack", "test_refine", "test_refine_images", "test_sim_recording",
    "test_stills_together", "test_replay_backends", "test_trial_soak", "test_bad_images",
    "test_site", "test_sim_score", "test_triton_kernels", "test_trial_ground", "test_bench_site",
    "test_stills", "test_pieces", "test_own_camera", "test_trial_load", "test_rolling_shutter",
    "test_odometry", "test_loop_closure", "test_trial_closing", "test_tiled_products", "test_walls",
    "test_demo", "test_hostile_scans", "test_matching", "test_calibration", "test_ground_hostile",
    "test_simulated", "test_intent", "test_ground_killed", "test_foxglove", "test_ground_receiver",
    "test_backends", "test_bench_gpu", "test_bench_real", "test_mavlink_flight",
    "test_mavlink_latency", "test_mavlink_ctl", "test_ground_live_site", "test_mesh_tiles",
)  # fmt: skip
"""The files that take longest. The first compiles the kernels that the trials' processes load, and
the next five need none of them; files that wait lie between those that compute."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest files, so that no worker is left alone with one of them."""
    place = {name: k for k, name in enumerate(FIRST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(FIRST)))


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
