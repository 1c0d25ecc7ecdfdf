"""The simulator's site 3, 120 m across, seen by a camera without distortion."""

from __future__ import annotations

from service.sim.flight import FlightPlan
from service.sim.recording import Simulation, SimulationOptions, prepare


def simulated_place(size_px: tuple[int, int]) -> Simulation:
    return prepare(
        SimulationOptions(
            FlightPlan("hover", 1.0), seed=3, size_px=size_px, site_m=120.0, depth_frames=0,
            distortion=(0.0, 0.0, 0.0, 0.0, 0.0),
        )
    )  # fmt: skip
