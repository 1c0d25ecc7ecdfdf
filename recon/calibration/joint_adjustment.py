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
    dispersion,
    solve,
    step_covariances,
    turn_covariances,
)
from recon.tracking.readout_search import MAX_READOUT_S
from recon.types import F64, Camera

LENS = SelfCalibrationConfig(sigma_focal=0.003, sigma_centre=0.003, sigma_k=0.01, sigma_p=0.0005)
"""How far a lens may be off that is calibrated, or found by the images. Held as it is, its errors
bend the ground."""

USUAL_S = 0.03  # readout that bounds the turns where none is known: cameras have 0 to 50 ms
ROUNDS = 5  # in which the readout and the turns settle

PATCHES = 25
"""Of an image, whose sightings share an error. Over flat ground a turn that all images share shows
only in differences far smaller than a pixel, so such errors would decide about it."""

MIN_SIGMAS = 3.0  # a readout that differs from none by less is not used


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
class JointAdjustment:
    camera: Camera  # with its shutter
    poses: F64  # (N, 4, 4) T_world_camera of the middle rows
    points: F64  # (P, 3) world, m
    seen: Sightings  # that took part
    rates: F64  # (N, 6) of T_camera_world per s
    turn_covariances: F64  # (N, 3, 3) of their rotation
    steps: F64  # (N, 6, 6) covariance of T_here_before, left perturbation; zero for the first
    sigma_px: float  # of a coordinate, as one of those that err independently
    readout_s: float  # as given or found; negative against the direction given
    sigma_readout_s: float


def adjust_jointly(
    camera: Camera, poses: F64, seen: Sightings, known: Knowledge, turning: Turning,
    seeks_readout: bool = False,
) -> JointAdjustment:  # fmt: skip
    """The stills adjusted to their sightings and to telemetry.

    Args:
        camera: with its shutter; ``seeks_readout`` where that is not known.
        poses: (N, 4, 4) T_world_camera to begin with.

    Raises ValueError where too few sightings agree, or no readout shows.
    """
    readout_s, sigma_s, rates = camera.shutter.readout_s, 0.0, turning.rates[:, :3]
    free_rad = readout_s * turning.sigma_rad_s
    if seeks_readout:
        free_rad = USUAL_S * float(np.hypot(turning.sigma_rad_s, np.sqrt(np.mean(rates**2))))
    stills = _Adjustment(camera, poses, seen, known, turning.rows(readout_s, free_rad))
    if seeks_readout:
        for _ in range(ROUNDS):
            stills.adjust(turning.rows(readout_s, free_rad))
            readout_s, sigma_s = slope(rates, stills.turns)
            readout_s = float(np.clip(readout_s, -MAX_READOUT_S, MAX_READOUT_S))
    if not readout_s or abs(readout_s) < MIN_SIGMAS * sigma_s:
        found = f"{1e3 * readout_s:.1f} ms, sigma {1e3 * sigma_s:.1f} ms"
        raise ValueError(f"the stills do not show a rolling shutter ({found})")
    stills.weigh_patches()
    stills.adjust(turning.rows(readout_s, abs(readout_s) * turning.sigma_rad_s))
    return stills.result(turning, readout_s, sigma_s)


class _Adjustment:
    """Stills, lens and turns with sightings that weigh as much as independent ones would."""

    def __init__(
        self, camera: Camera, poses: F64, seen: Sightings, known: Knowledge, rows: RowMotion
    ) -> None:
        """Leave out wild sightings, and weigh the others."""
        held = camera_information(camera, LENS)
        net = network(camera, poses, seen, known, held, rows=rows)
        s, pixel = net.solution, np.full(len(net.seen.view), net.sigma_px)
        problem = Problem(
            s.camera, camera, s.poses, s.points, net.seen, pixel, known, held, rows=s.rows
        )
        self._at = problem.widened(max(float(np.sqrt(dispersion(problem))), 1.0))
        crowd = float(np.sqrt(np.median(np.bincount(net.seen.view)) / PATCHES))
        self._of_patches = max(crowd * net.sigma_px / float(self._at.sigma_px[0]), 1.0)

    @property
    def turns(self) -> F64:
        """(N, 3) rad from the first row to the last."""
        assert self._at.rows is not None
        return self._at.rows.turns

    def adjust(self, rows: RowMotion) -> None:
        """Adjust everything again from where it is, with the turns that ``rows`` expects."""
        s = solve(replace(self._at, rows=replace(rows, turns=self.turns)))
        self._at = replace(self._at, camera=s.camera, poses=s.poses, points=s.points, rows=s.rows)

    def weigh_patches(self) -> None:
        """Take all sightings in a patch of an image for one."""
        self._at = self._at.widened(self._of_patches)

    def result(self, turning: Turning, readout_s: float, sigma_s: float) -> JointAdjustment:
        shutter = self._at.camera.shutter.reading(readout_s)
        rates = np.hstack([self.turns / readout_s, turning.rates[:, 3:]])
        return JointAdjustment(
            replace(self._at.camera, shutter=shutter), self._at.poses, self._at.points,
            self._at.seen, rates, turn_covariances(self._at) / readout_s**2,
            step_covariances(self._at), float(self._at.sigma_px[0]), readout_s, sigma_s,
        )  # fmt: skip


def slope(rates: F64, turns: F64) -> tuple[float, float]:
    """Seconds by which turns (N, 3) rad follow rates (N, 3) rad/s, and their sigma.

    Flat ground shows the heading's turn hardly apart from the pose, so it takes no part, nor a turn
    that is common to all images. A steady camera shows nothing: its sigma is infinite.
    """
    x, y = ((a[:, :2] - a[:, :2].mean(axis=0)).ravel() for a in (rates, turns))
    power = float(x @ x)
    if not power:
        return 0.0, np.inf
    found = float(x @ y) / power
    off = y - found * x
    return found, float(np.sqrt(off @ off / (len(x) - 3) / power))
