"""The constant rotation between the camera and the attitude that telemetry reports of it.

Vision turns with the camera, telemetry with the gimbal or the body. Between flights' headings
the two differ by one rotation in the world (the odometry's frame) and one in the camera (the
boresight); turns separate them, as in hand-eye calibration (Park and Martin 1994,
doi:10.1109/70.326576). About the vertical they stay one as long as the camera only turns about
it: a boresight in heading is then a compass error, which the track of the fixes takes out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from recon import se3
from recon.types import F64, PosePrior

SIGMA_RAD = np.radians(2.0)
"""How well a camera is aligned before anything is known."""

BOUND_RAD = np.radians(5.0)
"""A larger angle is no boresight but another fault."""

LEAST = 8
"""Minimum number of attitudes of a stretch."""

HUBER = 2.5
"""Whitened residuals beyond this lose weight."""

WILD = 5.0
"""Median of the whitened residuals beyond which attitudes and images do not belong together."""

SURE = 9.0
"""Squared sigmas by which a boresight must differ from none before attitudes are corrected."""

ROUNDS = 6


@dataclass(frozen=True, slots=True, eq=False)
class Boresight:
    """``R_world_camera = R_reported @ exp(turn)``."""

    turn: F64 = field(default_factory=lambda: np.zeros(3))  # rad, in the camera's frame
    sigma: F64 = field(default_factory=lambda: np.full(3, SIGMA_RAD))

    @property
    def is_sure(self) -> bool:
        """True when it is significant; otherwise it is not applied."""
        return float(np.sum(np.square(self.turn / self.sigma))) > SURE

    def applied(self, prior: PosePrior) -> PosePrior:
        """The prior with the camera's own attitude, once that is sure to be another."""
        R = prior.R_world_camera
        if R is None or not self.is_sure:
            return prior
        return replace(prior, R_world_camera=R @ se3.so3_exp(self.turn))


@dataclass(frozen=True, slots=True, eq=False)
class Turns:
    """One segment: the camera's rotations and those by telemetry."""

    R_odom: F64  # (N, 3, 3)
    R_reported: F64  # (N, 3, 3) world from camera
    sigma: F64  # (N, 3) rad about the world's axes; a heading over 1 rad is not known

    @staticmethod
    def of(poses: Sequence[F64], priors: Sequence[PosePrior]) -> Turns | None:
        """Of poses (4, 4) in one frame and their priors; None of too few attitudes."""
        rows = [
            (T[:3, :3], p.R_world_camera, (p.sigma_tilt_rad, p.sigma_tilt_rad, p.sigma_yaw_rad))
            for T, p in zip(poses, priors, strict=True)
            if p.R_world_camera is not None
        ]
        if len(rows) < LEAST:
            return None
        odom, reported, sigma = (np.array(c, np.float64) for c in zip(*rows, strict=True))
        return Turns(odom, reported, sigma)


def boresight(stretches: Sequence[Turns], span_s: float, wander_s: float = 40.0) -> Boresight:
    """The boresight by all stretches of a flight of ``span_s``; small where turns are missing.

    Attitudes err together over ``wander_s``, so all of them count as
    1 + span / (2 wander) readings.
    """
    count = sum(len(s.R_odom) for s in stretches)
    if count == 0:
        return Boresight()
    share = min(1.0, (1.0 + span_s / (2.0 * max(wander_s, 1e-3))) / count)
    turn, H, norms = np.zeros(3), np.eye(3), np.zeros(0)
    frames = [_mean_frame(s) for s in stretches]
    for _ in range(ROUNDS):
        H, g, all_norms = np.eye(3) / SIGMA_RAD**2, -turn / SIGMA_RAD**2, []
        for k, stretch in enumerate(stretches):
            frames[k], S, s, norm = _stretch(stretch, frames[k], turn)
            H, g = H + share * S, g + share * s
            all_norms.append(norm)
        norms = np.concatenate(all_norms)
        step = np.linalg.solve(H, g)
        turn = turn + step
        length = float(np.linalg.norm(turn))
        turn *= min(1.0, BOUND_RAD / max(length, 1e-12))
        if np.abs(step).max() < 1e-6:
            break
    if float(np.median(norms)) > WILD:
        return Boresight()
    return Boresight(turn, np.sqrt(np.diag(np.linalg.inv(H))))


def _mean_frame(stretch: Turns) -> F64:
    """(3, 3) a first rotation from the stretch's frame to the world."""
    turns = stretch.R_reported @ stretch.R_odom.transpose(0, 2, 1)
    return np.asarray(Rotation.from_matrix(turns).mean().as_matrix(), np.float64)


def _stretch(stretch: Turns, frame: F64, turn: F64) -> tuple[F64, F64, F64, F64]:
    """One Gauss-Newton step: the segment's better frame, its contribution to the boresight as
    information (3, 3) and right-hand side (3,), and the whitened residuals (N,)."""
    Q = stretch.R_reported @ se3.so3_exp(turn)
    r = Rotation.from_matrix(frame @ stretch.R_odom @ Q.transpose(0, 2, 1)).as_rotvec()
    info = np.where(stretch.sigma < 1.0, stretch.sigma, np.inf) ** -2.0  # (N, 3)
    norms = np.sqrt(np.sum(info * r**2, axis=1))
    info = info * np.minimum(1.0, HUBER / np.maximum(norms, 1e-9))[:, None]
    # r + w - Q b, with the frame's turn w eliminated.
    A_ww = np.diag(info.sum(axis=0) + 1e-9)
    A_wb = -np.einsum("ni,nij->ij", info, Q)
    A_bb = np.einsum("nki,nk,nkj->ij", Q, info, Q)
    g_w, g_b = -np.einsum("ni,ni->i", info, r), np.einsum("nki,nk->i", Q, info * r)
    gain = A_wb.T @ np.linalg.inv(A_ww)
    w = np.linalg.solve(A_ww, g_w)
    return se3.so3_exp(w) @ frame, A_bb - gain @ A_wb, g_b - gain @ g_w, norms
