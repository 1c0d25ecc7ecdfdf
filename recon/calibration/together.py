"""All stills of a flight adjusted at once, each with the turn of its rolling shutter's rows.

Stills are too far apart to show how the camera turns within a readout, and telemetry is often too
slow. So that turn is an unknown of each still, about what telemetry says. How the turns grow with
telemetry's rates is the readout, where it is not known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from recon.calibration.flight import SelfCalibrationConfig, camera_information, network
from recon.calibration.global_bundle import (
    Knowledge,
    Problem,
    RowMotion,
    Sightings,
    Solution,
    dispersion,
    solve,
    step_covariances,
)
from recon.types import F64, Camera, Shutter

LENS = SelfCalibrationConfig(sigma_focal=0.003, sigma_centre=0.003, sigma_k=0.01, sigma_p=0.0005)
"""How far a lens may be off that is calibrated, or found by the images. Held as it is, its errors
bend the ground."""

USUAL_S = 0.03
"""Readout that bounds the turns where none is known: cameras have 0 to 50 ms."""

ROUNDS = 5
"""In which the readout and the turns settle."""

MIN_SIGMAS = 3.0
"""A readout that differs from none by less is not used."""


@dataclass(frozen=True, slots=True, eq=False)
class Turning:
    """Motion of N cameras at the middle of their exposures, by telemetry."""

    rates: F64  # (N, 6) of T_camera_world per s: rotation in rad, then translation in m
    sigma_rad_s: float  # of each turn

    def rows(self, readout_s: float, sigma_rad: float) -> RowMotion:
        """The rows' motion within a readout, its turns free by ``sigma_rad``."""
        turns, moves = readout_s * self.rates[:, :3], readout_s * self.rates[:, 3:]
        return RowMotion(turns, moves, turns, np.full(turns.shape, sigma_rad))


@dataclass(frozen=True, slots=True, eq=False)
class Together:
    """The adjusted stills."""

    camera: Camera  # with its shutter
    poses: F64  # (N, 4, 4) T_world_camera of the middle rows
    points: F64  # (P, 3) world, m
    seen: Sightings  # that took part
    rates: F64  # (N, 6) of T_camera_world per s; unused under a global shutter
    steps: F64  # (N, 6, 6) covariance of T_here_before, left perturbation; zero for the first
    sigma_px: float  # of a coordinate, as one of those that err independently
    readout_s: float  # as given or found; negative against the direction given
    sigma_readout_s: float


def together(
    camera: Camera, poses: F64, seen: Sightings, known: Knowledge, turning: Turning,
    seeks_readout: bool = False,
) -> Together:  # fmt: skip
    """The stills adjusted to their sightings and to telemetry.

    Args:
        camera: with its shutter; ``seeks_readout`` where that is not known.
        poses: (N, 4, 4) T_world_camera to begin with.

    Raises ValueError where too few sightings agree.
    """
    adjustment = _Adjustment(camera, poses, seen, known)
    readout_s, sigma_s = camera.shutter.readout_s, 0.0
    if seeks_readout:
        readout_s, sigma_s = adjustment.find_readout(turning)
        if abs(readout_s) < MIN_SIGMAS * sigma_s:
            readout_s = 0.0
    if readout_s:
        adjustment.adjust(turning.rows(readout_s, abs(readout_s) * turning.sigma_rad_s))
    else:
        adjustment.adjust(None)
    return adjustment.result(turning, readout_s, sigma_s)


class _Adjustment:
    """Sightings that weigh as much as independent ones would."""

    def __init__(self, camera: Camera, poses: F64, seen: Sightings, known: Knowledge) -> None:
        self._given, self._start, self._seen, self._known = camera, poses, seen, known
        self._held = camera_information(camera, LENS)
        self._problem: Problem | None = None
        self.found: Solution | None = None

    def adjust(self, rows: RowMotion | None) -> F64:
        """Adjust everything; the turns (N, 3) rad of the rows."""
        if self._problem is None or (rows is None) != (self._problem.rows is None):
            self._begin(rows)
        assert self._problem is not None
        if rows is not None and self._problem.rows is not None:
            rows = replace(rows, turns=self._problem.rows.turns)
        self.found = solve(replace(self._problem, rows=rows))
        s = self.found
        self._problem = replace(
            self._problem, camera=s.camera, poses=s.poses, points=s.points, rows=s.rows
        )
        return np.zeros((len(s.poses), 3)) if s.rows is None else s.rows.turns

    def _begin(self, rows: RowMotion | None) -> None:
        """Leave out wild sightings, and weigh the others."""
        net = network(self._given, self._start, self._seen, self._known, self._held, rows=rows)
        s, pixel = net.solution, np.full(len(net.seen.view), net.sigma_px)
        problem = Problem(
            s.camera, self._given, s.poses, s.points, net.seen, pixel, self._known, self._held,
            rows=s.rows,
        )  # fmt: skip
        wider = max(float(np.sqrt(dispersion(problem))), 1.0)
        self._problem = replace(
            problem, sigma_px=wider * pixel, huber_sigmas=problem.huber_sigmas / wider
        )

    def find_readout(self, turning: Turning) -> tuple[float, float]:
        """The readout by which the rows' turns follow telemetry's rates, and its sigma, s."""
        rates = turning.rates[:, :3]
        free = USUAL_S * float(np.hypot(turning.sigma_rad_s, np.sqrt(np.mean(rates**2))))
        readout_s = sigma_s = 0.0
        for _ in range(ROUNDS):
            readout_s, sigma_s = slope(rates, self.adjust(turning.rows(readout_s, free)))
        return readout_s, sigma_s

    def result(self, turning: Turning, readout_s: float, sigma_s: float) -> Together:
        """The stills as they are adjusted now."""
        assert self._problem is not None and self.found is not None
        s, rates = self.found, turning.rates.copy()
        if s.rows is not None:
            rates[:, :3] = s.rows.turns / readout_s
        way = self._given.shutter.direction
        if readout_s < 0.0:
            way = OPPOSITE[way]
        camera = replace(s.camera, shutter=Shutter(abs(readout_s), way))
        return Together(
            camera, s.poses, s.points, self._problem.seen, rates, step_covariances(self._problem),
            float(self._problem.sigma_px[0]), readout_s, sigma_s,
        )  # fmt: skip


OPPOSITE = {"down": "up", "up": "down", "right": "left", "left": "right"}


def slope(rates: F64, turns: F64) -> tuple[float, float]:
    """Seconds by which turns (N, 3) rad follow rates (N, 3) rad/s, and their sigma.

    The heading takes no part: flat ground shows its turn hardly apart from the pose.
    """
    x, y = rates[:, :2].ravel(), turns[:, :2].ravel()
    power = float(x @ x)
    found = float(x @ y) / power
    off = y - found * x
    return found, float(np.sqrt(off @ off / (len(x) - 1) / power))
