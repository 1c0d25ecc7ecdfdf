"""The meshes of scans that have ended: made unasked, as the portal shows a finished scan by it.

They wait until no scan grows and nothing that was asked for waits, and are made by a process of low
priority, which also stops for what is asked for meanwhile and then begins again.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import psutil  # type: ignore[import-untyped]

from service.errors import InputError, OutsideError, SkyreliefError
from service.ground.due import MESH
from service.ground.library import UNREADABLE
from service.ground.products import PRODUCTS, obstacle
from service.ground.scan_facts import facts_of, is_current
from service.ground.state import Jobs
from service.ground.storage import check_room
from service.ground.upload import follow
from service.progress import Progress
from service.workers import python_command, run_to_end

log = logging.getLogger(__name__)

KIND, FILE = "glb", "mesh.glb"
MAX_POINTS = 20_000_000  # a larger scan has a mesh in tiles, which one page does not hold

BASE_BYTES, POINT_BYTES = 900 << 20, 800
"""Memory that a mesh takes, whatever its size and for each point of the cloud."""

MESH_S = 7200.0  # one mesh may take so long; a scan may come from a stranger


def queue_meshes(jobs: Jobs, store: Path, may_begin: Callable[[], bool]) -> None:
    """Have the meshes that are due made once ``may_begin``, as many as may wait; the rest is for
    another call. The log says why a scan gets none."""
    for folder in MESH.folders(store, with_begun=False):
        try:
            is_wanted = _is_wanted(folder)
        except UNREADABLE as error:
            log.info("%s gets no mesh: %s", folder, error)
            if isinstance(error, OutsideError):  # no room now
                continue
            is_wanted = False
        if not is_wanted:
            drop(folder)
            continue
        try:
            jobs.start(folder, KIND, partial(_make, folder), may_begin=may_begin)
        except SkyreliefError:  # enough wait, or the station ends
            return


def drop(folder: Path) -> None:
    MESH.begin(folder)
    MESH.end(folder)


def _is_wanted(folder: Path) -> bool:
    """Whether the scan is finished and has no mesh. Raises InputError where it can have none,
    OutsideError where there is too little room for one now."""
    facts = facts_of(folder)
    points = facts.get("counts", {}).get("points", 0)
    if not facts["finished"] or is_current(folder / FILE) or not 0 < points <= MAX_POINTS:
        return False
    why = obstacle(KIND, facts["origin"] is not None)
    if why is not None:
        raise InputError(f"it {why}")
    check_room(round(points * PRODUCTS[KIND][2]), folder)
    needed, free = BASE_BYTES + POINT_BYTES * points, psutil.virtual_memory().available
    if needed > free:
        raise OutsideError(f"it takes {needed / 1e9:.1f} GB of memory, {free / 1e9:.1f} are free")
    return True


def _make(folder: Path, progress: Progress) -> str:
    """Run ``skyrelief mesh``; the name of its file. Raises InputError with its last line, or when
    it takes too long."""
    MESH.begin(folder)
    deadline = time.monotonic() + MESH_S

    def goes_on(line: str) -> bool:
        follow(progress, line.removeprefix("mesh: "))
        return time.monotonic() < deadline

    fault = run_to_end("mesh", python_command("service.cli", "mesh", str(folder)), goes_on)
    if fault or time.monotonic() >= deadline:
        raise InputError(fault or f"it takes longer than {MESH_S:.0f} s")
    return FILE
