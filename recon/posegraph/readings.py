"""Telemetry of a keyframe, as factors of the pose graph.

Errors of one sensor wander: readings closer in time than the wander's time constant err
together. All readings of a first-order Gauss-Markov error with time constant tau over a time
T count as 1 + T / (2 tau) of them; each gets the sigma that makes it so.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np

from recon import se3
from recon.posegraph.alignment_readings import MIN_FIX_M, ReadingNoise
from recon.posegraph.anchors import Anchor, height_ratio
from recon.posegraph.records import Node, PoseGraphConfig
from recon.posegraph.sensor_noise import PRECISE_M
from recon.posegraph.smoother import NO_SCALE, Smoother
from recon.types import F64, PosePrior

HEIGHT_GATE = 0.05
"""Share of a height by which one exactly below may be off, once its constant is out."""

MIN_TURN_RAD = 1e-4
"""Sigma that no attitude is better than."""

FRAME_SIGMA_RAD = (0.05, 0.05, 0.15)
"""Smallest sigma of a placed segment's tilt and heading."""

BLOCK = 20
"""Keyframes that share one scale and one altitude bias."""


class Readings:
    """Adds a keyframe's readings to the smoother, and counts what it leaves out."""

    def __init__(
        self,
        config: PoseGraphConfig,
        smoother: Smoother,
        counts: Counter[str],
        keyframes: int = 1,
        span_s: float = 0.0,
        altitude_offset_m: float | None = None,
    ) -> None:
        """``keyframes`` are known so far over ``span_s``; ``altitude_offset_m`` is altitude less
        world z, by default that of the first reading."""
        self._config, self._smoother, self._counts = config, smoother, counts
        self._huber = config.huber_sigmas
        self._keyframes, self._span_s = max(keyframes, 1), max(span_s, 1.0)
        self._offset_m = altitude_offset_m

    def add(
        self,
        node: Node,
        T: F64,
        spread: F64,
        drift_m: float | None,
        noise: ReadingNoise | None = None,
    ) -> set[str]:
        """The sensors that took part; the keyframe is predicted at ``T`` +- ``spread``.

        ``drift_m`` is how far the segment's track may have left its frame. None while there is no
        such frame; then only the attitude is used.
        """
        is_placed = drift_m is not None
        used = {"attitude"} if self._attitude(node, T, spread, is_placed) else set()
        if drift_m is not None:
            place = np.diag(se3.about(T[:3, 3], spread))[3:]
            used |= {"gnss"} if self._position(node, T, place, drift_m, noise) else set()
            used |= {"altitude"} if self._altitude(node, T) else set()
        return used

    def height(self, node: Node, scale_key: int, scale: float) -> bool:
        """True when the height above ground was taken as a reading of the scale."""
        ratio = height_ratio(Anchor(node.T_odom_camera, node.prior, node.height, node.lean))
        if ratio is None or not node.prior.is_agl_measured:
            return False
        if node.lean == 0.0 and abs(ratio[0] - np.log(scale)) > HEIGHT_GATE:
            self._counts["height off"] += 1  # a tree or a roof under the one sensor alone
            return False
        sigma = ratio[1] * float(np.sqrt(BLOCK * self._config.blocks_per_height))
        measured = ratio[0] - float(np.log(scale))
        self._smoother.add_scale(
            "height", (NO_SCALE, scale_key), measured, sigma, self._config.huber_sigmas
        )
        return True

    def _attitude(self, node: Node, T: F64, spread: F64, is_placed: bool) -> bool:
        prior = node.prior
        if prior.R_world_camera is None:
            return False
        sigma = np.array([prior.sigma_tilt_rad, prior.sigma_tilt_rad, prior.sigma_yaw_rad])
        turn = _turn(T[:3, :3], prior.R_world_camera, prior.sigma_yaw_rad < 1.0)
        sure = np.diag(spread)[:3]
        if is_placed:  # the frame rests on all attitudes: it is no worse than this
            sure = np.minimum(sure, np.square(FRAME_SIGMA_RAD))
        allowed = self._config.gate_sigmas * np.sqrt(sure + sigma**2)
        if abs(turn[2]) > allowed[2]:
            self._counts["heading off"] += 1
            turn, sigma[2] = _turn(T[:3, :3], prior.R_world_camera, False), np.pi
        if np.any(np.abs(turn[:2]) > allowed[:2]):
            self._counts["tilt off"] += 1
            return False
        R = se3.so3_exp(turn) @ T[:3, :3]
        sigma = sigma * self._inflated(self._config.attitude_s)
        self._smoother.add_turn("attitude", node.key, R, sigma, self._huber)
        return True

    def _position(
        self, node: Node, T: F64, place: F64, drift_m: float, measured: ReadingNoise | None
    ) -> bool:
        prior = node.prior
        if prior.position_m is None or prior.sigma_position_m is None:
            return False
        sigma = np.maximum(prior.sigma_position_m, MIN_FIX_M)
        # The frame rests on all fixes: it is no worse than one of them.
        sure = np.minimum(place, sigma**2 + drift_m**2)
        apart = np.abs(prior.position_m - T[:3, 3])
        if np.any(apart > self._config.gate_sigmas * np.sqrt(sure + sigma**2)):
            self._counts["position off"] += 1
            return False
        if measured is not None and measured.horizontal and measured.vertical:
            known = (measured.horizontal, measured.horizontal, measured.vertical)
            each = [one.of_each(self._keyframes, self._span_s) for one in known]
            sigma = np.maximum(each, MIN_FIX_M)
        else:
            precise = float(sigma[0]) < PRECISE_M
            seconds = self._config.precise_fix_s if precise else self._config.fix_s
            sigma = sigma * self._inflated(seconds)
        self._smoother.add_place(
            "position", node.key, prior.position_m, sigma, self._config.huber_sigmas
        )
        return True

    def _altitude(self, node: Node, T: F64) -> bool:
        """The altitude minus its offset; after a step it continues from the track."""
        prior = node.prior
        if prior.altitude_m is None:
            return False
        if self._offset_m is None:
            self._offset_m = prior.altitude_m - T[2, 3]
        z, one = prior.altitude_m - self._offset_m, prior.sigma_altitude_m
        if abs(z - T[2, 3]) > self._config.gate_sigmas * one + self._config.altitude_slack_m:
            self._counts["altitude off"] += 1
            self._offset_m = prior.altitude_m - T[2, 3]
            return False
        sigma = np.array([np.inf, np.inf, one * self._inflated(self._config.altitude_s)])
        place = np.array([0.0, 0.0, z])
        self._smoother.add_place("altitude", node.key, place, sigma, self._huber)
        return True

    def _inflated(self, seconds: float) -> float:
        """Factor on a sigma whose error wanders with the time constant ``seconds``."""
        if seconds <= 0:
            return 1.0
        independent = 1.0 + self._span_s / (2.0 * seconds)
        return float(np.sqrt(max(1.0, self._keyframes / independent)))


def sound(prior: PosePrior) -> PosePrior:
    """The prior without readings that are not finite, and no sigma below what a sensor reaches."""
    R, position, sigma = prior.R_world_camera, prior.position_m, prior.sigma_position_m
    has_turn = _are_finite(R, prior.sigma_tilt_rad, prior.sigma_yaw_rad)
    has_agl = _are_finite(prior.agl_m, prior.sigma_agl_m) and (prior.agl_m or 0.0) > 0.0
    has_altitude = _are_finite(prior.altitude_m, prior.sigma_altitude_m)
    has_place = _are_finite(position)
    has_fix = has_place and _are_finite(sigma)
    return replace(
        prior,
        R_world_camera=R if has_turn else None,
        sigma_tilt_rad=max(prior.sigma_tilt_rad, MIN_TURN_RAD),
        sigma_yaw_rad=max(prior.sigma_yaw_rad, MIN_TURN_RAD),
        position_m=position if has_place and (has_fix or sigma is None) else None,
        sigma_position_m=np.maximum(sigma, MIN_FIX_M) if has_fix and sigma is not None else None,
        agl_m=prior.agl_m if has_agl else None,
        sigma_agl_m=max(prior.sigma_agl_m, MIN_FIX_M),
        altitude_m=prior.altitude_m if has_altitude else None,
        sigma_altitude_m=max(prior.sigma_altitude_m, MIN_FIX_M),
        above_m=prior.above_m if _are_finite(prior.above_m) else None,
    )


def _are_finite(*parts: F64 | float | None) -> bool:
    return all(part is not None and bool(np.isfinite(part).all()) for part in parts)


def is_frozen(prior: PosePrior, before: PosePrior) -> bool:
    """True when the receiver only repeats the position that it gave before."""
    if prior.position_m is None or before.position_m is None:
        return False
    return float(np.abs(before.position_m - prior.position_m).max()) <= 1e-6


def _turn(R: F64, R_measured: F64, heading: bool) -> F64:
    """(3,) world rotation from ``R`` to the measured attitude; without ``heading``, its tilt."""
    if heading:
        return se3.so3_log(R_measured @ R.T)
    up = R @ R_measured[2]  # where the reading's up points now
    return np.array([up[1], -up[0], 0.0])
