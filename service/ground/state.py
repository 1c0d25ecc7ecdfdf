"""What the portal's endpoints share, and how they find it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from starlette.requests import HTTPConnection

from service.ground.jobs import Jobs
from service.ground.library import Library
from service.ground.vehicle import Vehicle
from service.scans.coverage import LiveCoverages


@dataclass(slots=True, eq=False)
class PortalState:
    """The parts behind one portal."""

    library: Library
    jobs: Jobs
    progress: Callable[[], list[dict[str, Any]]]  # one entry per scan being received
    vehicle: Vehicle | None
    coverages: LiveCoverages = field(default_factory=LiveCoverages)
    live_views: int = 0
    views_without_token: int = 0  # of these
    started: float = field(default_factory=time.monotonic)


def state_of(connection: HTTPConnection) -> PortalState:
    """The state of the portal that serves ``connection``."""
    state: PortalState = connection.app.state.portal
    return state


def names_of(connection: HTTPConnection) -> tuple[str, str]:
    """Drone and scan in the path, unchecked."""
    return connection.path_params["drone"], connection.path_params["scan"]
