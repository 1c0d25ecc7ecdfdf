"""Factors of the pose graph: telemetry of a keyframe, and motions from one keyframe to the next.

Each sensor has a bias that wanders: readings closer in time than its time constant err together.
All readings of a first-order Gauss-Markov error with time constant tau over a time T count as
1 + T / (2 tau) of them; each gets the sigma that makes it so.

A motion is vision's, or telemetry's where vision has none. A segment that has a frame in the world
leaves its scale open, block by block of keyframes.
"""

from __future__ import annotations

from collections import Counter
from functools import partial

import numpy as np

from recon import se3
from recon.posegraph.alignment_readings import ReadingNoise
from recon.posegraph.ground_heights import height_ratio
from recon.posegraph.pose_priors import MIN_FIX_M, dead_reckoned, has_fix
from recon.posegraph.records import Node, PoseGraphConfig
from recon.posegraph.segments import Segments
from recon.posegraph.sensor_noise import bias_time_constant_s, inflation
from recon.posegraph.smoother import NO_SCALE, Smoother, left_covariance
from recon.types import F64, PosePrior

HEIGHT_GATE = 0.05
"""Share of a height by which one exactly below may be off, once its constant is out."""

FRAME_SIGMA_RAD = (0.05, 0.05, 0.15)
"""Smallest sigma of a placed segment's tilt and heading."""

BLOCK = 20
"""Keyframes that share one scale and one altitude bias."""

VELOCITY_S, FASTEST_M_S = 1.0, 100.0
"""A speed is taken over this time at least, as errors of two poses would be most of a shorter step;
a faster one is of a wrong pose: no drone with a camera flies so."""

OPEN_LENGTH, OPEN_SHARE = 0.005, 3.0
"""Relative sigma of the length of a step, and that over the segment's usual one, from which on
vision's scale may have changed there, as where stills turn and have little in common. Where all
images are noisy, lengths scatter and the scale stays."""

KNOWN_SCALE, UNKNOWN_SCALE = 0.1, 1.0
"""Sigma of the logarithm of a segment's first scale: at least, as its alignment fits one scale to
a track whose scale drifts; and where no reading measures it."""

BLOCKS_PER_HEIGHT = 2.0
"""Heights above ground of so many blocks count as one: relief is the same under neighbours."""

GATE_SIGMAS, HUBER_SIGMAS = 5.0, 1.5
"""Beyond so many sigmas from the prediction a reading is left out, as noise alone reaches that once
in a million; and from so many of its residual on it loses weight."""

ALTITUDE_SLACK_M = 3.0
"""An altitude further beyond its gate has stepped: pressure by a climb or a gust is less."""

LINK_RAD, LINK_WITHOUT_HEADING_RAD, LINK_M, LINK_M_S = 0.3, 1.5, 5.0, 3.0
"""Sigmas of dead reckoning: of its turn, with a heading and without, and of its way at the start
and for each second: about what a drone's speed changes by."""


class ReadingFactors:
    """Adds a keyframe's readings to the smoother, and counts what it leaves out."""

    def __init__(
        self,
        config: PoseGraphConfig,
        smoother: Smoother,
        counts: Counter[str],
        keyframes: int,
        span_s: float,
        altitude_offset_m: float | None,
    ) -> None:
        """``keyframes`` are known so far over ``span_s``; ``altitude_offset_m`` is altitude less
        world z; None: that of the first reading."""
        self._config, self._smoother, self._counts = config, smoother, counts
        self._keyframes, self._span_s = max(keyframes, 1), max(span_s, 1.0)
        self._inflation = partial(inflation, self._keyframes, self._span_s)
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
        ratio = height_ratio(node)
        if ratio is None or not node.prior.is_agl_measured:
            return False
        if node.lean == 0.0 and abs(ratio[0] - np.log(scale)) > HEIGHT_GATE:
            self._counts["height off"] += 1  # a tree or a roof under the one sensor alone
            return False
        sigma = ratio[1] * float(np.sqrt(BLOCK * BLOCKS_PER_HEIGHT))
        measured = ratio[0] - float(np.log(scale))
        self._smoother.add_scale("height", (NO_SCALE, scale_key), measured, sigma, HUBER_SIGMAS)
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
        allowed = GATE_SIGMAS * np.sqrt(sure + sigma**2)
        if abs(turn[2]) > allowed[2]:
            self._counts["heading off"] += 1
            turn, sigma[2] = _turn(T[:3, :3], prior.R_world_camera, False), np.pi
        if np.any(np.abs(turn[:2]) > allowed[:2]):
            self._counts["view off" if prior.is_view_assumed else "tilt off"] += 1
            return False
        R = se3.so3_exp(turn) @ T[:3, :3]
        sigma = sigma * self._inflation(self._config.attitude_s)
        self._smoother.add_turn("attitude", node.key, R, sigma, HUBER_SIGMAS)
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
        if np.any(apart > GATE_SIGMAS * np.sqrt(sure + sigma**2)):
            self._counts["position off"] += 1
            return False
        if measured is not None and (known := measured.by_axis):
            each = [one.effective_sigma(self._keyframes, self._span_s) for one in known]
            sigma = np.maximum(each, MIN_FIX_M)
        else:
            tau_s = bias_time_constant_s(float(sigma[0]), self._config.fix_s)
            sigma = sigma * self._inflation(tau_s)
        self._smoother.add_place("position", node.key, prior.position_m, sigma, HUBER_SIGMAS)
        return True

    def _altitude(self, node: Node, T: F64) -> bool:
        """The altitude minus its offset; after a step it continues from the track."""
        prior = node.prior
        if prior.altitude_m is None:
            return False
        if self._offset_m is None:
            self._offset_m = prior.altitude_m - T[2, 3]
        z, one = prior.altitude_m - self._offset_m, prior.sigma_altitude_m
        if abs(z - T[2, 3]) > GATE_SIGMAS * one + ALTITUDE_SLACK_M:
            self._counts["altitude off"] += 1
            self._offset_m = prior.altitude_m - T[2, 3]
            return False
        sigma = np.array([np.inf, np.inf, one * self._inflation(self._config.altitude_s)])
        place = np.array([0.0, 0.0, z])
        self._smoother.add_place("altitude", node.key, place, sigma, HUBER_SIGMAS)
        return True


def _turn(R: F64, R_measured: F64, heading: bool) -> F64:
    """(3,) world rotation from ``R`` to the measured attitude; without ``heading``, its tilt."""
    if heading:
        return se3.so3_log(R_measured @ R.T)
    up = R @ R_measured[2]  # where the reading's up points now
    return np.array([up[1], -up[0], 0.0])


def _length_sigma(node: Node, last: Node) -> float:
    """Relative sigma of the length of vision's step to a node; 0 for none."""
    step = (se3.inverse(last.T_odom_camera) @ node.T_odom_camera)[:3, 3]
    square = float(step @ step)
    return float(np.sqrt(step @ node.covariance[3:, 3:] @ step)) / square if square > 0.0 else 0.0


def _is_refuted(
    a: PosePrior, b: PosePrior, passed_s: float, motion: F64, covariance: F64, noise: ReadingNoise
) -> bool:
    """True where both known attitudes and positions contradict vision's ``motion`` (4, 4) from a to
    b: two sensors do not fail at once by chance, and images that smear do."""
    R_a, R_b, from_m, to_m = a.R_world_camera, b.R_world_camera, a.position_m, b.position_m
    are_assumed = a.is_view_assumed or b.is_view_assumed
    if R_a is None or R_b is None or are_assumed or not (has_fix(a) and has_fix(b)):
        return False
    assert from_m is not None and to_m is not None
    if (known := noise.by_axis) is None:
        return False
    up = R_a @ motion[:3, :3] @ R_b[2]  # where that of b points
    sigma_rad = float(np.sqrt(np.trace(covariance[:3, :3]) / 3.0 + b.sigma_tilt_rad**2))
    if not np.hypot(up[0], up[1]) > GATE_SIGMAS * sigma_rad:
        return False
    changed = np.square([one.change(passed_s) for one in known])
    sigma_m = np.sqrt(changed + np.trace(covariance[3:, 3:]) / 3.0)
    off_m = np.abs(R_a @ motion[:3, 3] - (to_m - from_m))
    return bool(np.any(off_m > GATE_SIGMAS * sigma_m))


class MotionFactors:
    """Adds the motions of one graph to its smoother, and keeps the scale of each keyframe."""

    def __init__(
        self, config: PoseGraphConfig, smoother: Smoother, segments: Segments, counts: Counter[str]
    ) -> None:
        """``counts`` takes in the stretches without vision."""
        self._config, self._smoother = config, smoother
        self._segments, self._counts = segments, counts
        self.scale_of: list[int] = []  # key of each keyframe's scale, or NO_SCALE
        self.refuted: dict[int, int] = {}  # last keyframe after each refuted step's first

    def first(self, node: Node) -> tuple[F64, F64]:
        """Pose and covariance of the first keyframe: loose where readings will follow.

        The gauge that no reading ever fixes is held at the start.
        """
        frame = self._segments[node.segment].frame
        T = frame.pose(node.T_odom_camera)
        sigma_t, sigma_r = 0.01, 1.0 if node.prior.R_world_camera is not None else 0.01
        if "gnss" in frame.sources:  # places along a line leave the roll about it free
            known = float(np.sqrt(np.linalg.eigvalsh(frame.covariance[:3, :3])[-1]))
            sigma_t, sigma_r = 50.0, max(sigma_r, min(known, 1.0))
        sigma = np.array([sigma_r] * 3 + [sigma_t] * 3)
        self._smoother.add_turn("prior", node.key, T[:3, :3], sigma[:3])
        self._smoother.add_place("prior place", node.key, T[:3, 3], sigma[3:])
        return T, left_covariance(T, np.diag(sigma**2))

    def add(
        self, node: Node, last: Node, T_last: F64, priors: tuple[PosePrior, PosePrior]
    ) -> tuple[F64, F64, bool]:
        """T_last_node in metres, its (6, 6) covariance, left, in last's frame, and whether vision
        gives it; now a factor. The ``priors`` of last and node have no biases."""
        is_seen = node.segment == last.segment
        if is_seen:
            motion, covariance = self._seen(node, last)
            noise = self._segments[node.segment].noise
            passed_s = (node.time_ns - last.time_ns) * 1e-9
            if noise is not None and _is_refuted(*priors, passed_s, motion, covariance, noise):
                self.refuted[last.seq] = node.seq
                self._counts["vision off"] += 1
                is_seen = False
        else:
            self._counts["stretch without vision"] += 1
        if not is_seen:
            motion, covariance = self._link(node, last, T_last)
        self._connect(node, last, motion, covariance, is_seen)
        return motion, covariance, is_seen

    def scale_key(self, node: Node, jump: float = 0.0) -> int:
        """Key of the node's scale; made when missing.

        A new one begins every twenty keyframes, and where the scale may ``jump`` by that share.
        """
        segment = self._segments[node.segment]
        scales = segment.scales
        if scales.newest == NO_SCALE or node.key - scales.since >= BLOCK or jump:
            before = scales.newest
            log = float(self._smoother.logs()[before])
            known = segment.frame.sigma_scale
            sigma = float(np.clip(known, KNOWN_SCALE, UNKNOWN_SCALE))
            if before != NO_SCALE:
                walk = self._config.sigma_scale_walk * np.sqrt(max(1.0, scales.held / BLOCK))
                sigma = float(np.hypot(walk, jump))
            scales.newest, scales.since = self._smoother.append_scale(log), node.key
            scales.held = 0
            self._smoother.add_scale("scale", (before, scales.newest), 0.0, sigma)
            if before == NO_SCALE:
                scales.unit = scales.newest
        if self.scale_of[node.key] != scales.newest:
            scales.held += node.weight
        self.scale_of[node.key] = scales.newest
        return scales.newest

    def _jump(self, node: Node, last: Node) -> float:
        """Share by which vision's scale may have changed at a step."""
        lengths = self._segments[node.segment].scales.lengths
        lengths.append(_length_sigma(node, last))
        usual = float(np.median(lengths))
        return lengths[-1] if lengths[-1] > max(OPEN_LENGTH, OPEN_SHARE * usual) else 0.0

    def add_loop(self, a: Node, b: Node, T_a_b: F64, covariance: F64) -> None:
        """A motion (4, 4) seen between two nodes, in metres by a's frame, whose lengths grow with
        a's scale; its covariance (6, 6) is of the left perturbation in a's frame."""
        scale, unit = self.scale_of[a.key], self._segments[a.segment].scales.unit
        # Not robust: two loops agreed, and a late one with a large misclosure would lose weight.
        self._smoother.add_motion("loop", (a.key, b.key), T_a_b, covariance, scale, unit)

    def _connect(self, node: Node, last: Node, motion: F64, covariance: F64, is_seen: bool) -> None:
        """The motion between two keyframes; of an aligned segment, with its scale left open."""
        kind, scale, unit = "vision" if is_seen else "link", NO_SCALE, NO_SCALE
        if node.segment == last.segment and self._segments[node.segment].similarity is not None:
            key = self.scale_key(node, self._jump(node, last))
            if is_seen:
                scale, unit = key, self._segments[node.segment].scales.unit
        self._smoother.add_motion(kind, (last.key, node.key), motion, covariance, scale, unit)

    def _seen(self, node: Node, last: Node) -> tuple[F64, F64]:
        frame = self._segments[node.segment].frame
        motion = se3.inverse(frame.pose(last.T_odom_camera)) @ frame.pose(node.T_odom_camera)
        units = np.array([1.0] * 3 + [frame.scale] * 3)
        covariance = node.covariance * np.outer(units, units) + np.diag([1e-10] * 3 + [1e-6] * 3)
        covariance[3:, 3:] += self._config.sigma_step**2 * np.outer(motion[:3, 3], motion[:3, 3])
        return motion, covariance

    def _link(self, node: Node, last: Node, T_last: F64) -> tuple[F64, F64]:
        """Dead reckoning where vision was lost: telemetry's motion, else the last one's, wide."""
        passed_s = (node.time_ns - last.time_ns) * 1e-9
        segment = self._segments[node.segment]
        frame = segment.similarity
        is_new = node.segment != last.segment
        if is_new and frame is not None and segment.is_tied:
            T = frame.pose(node.T_odom_camera)
        elif node.T_prev_segment is not None:
            T = T_last @ node.T_prev_segment
        else:
            priors = self._segments[last.segment].at_camera(last), segment.at_camera(node)
            T = dead_reckoned(*priors, T_last, self._velocity(last, T_last), passed_s)
        prior = node.prior
        is_turn_known = prior.R_world_camera is not None and prior.sigma_yaw_rad < 1.0
        sigma_r = LINK_RAD if is_turn_known else LINK_WITHOUT_HEADING_RAD
        sigma_m = LINK_M_S * max(passed_s, 1.0) + LINK_M
        motion = se3.inverse(T_last) @ T
        # Translation and rotation are separate: an error of one does not rotate the other.
        apart = np.diag(np.square([sigma_r] * 3 + [sigma_m] * 3))
        return motion, left_covariance(motion, apart)

    def _velocity(self, last: Node, T_last: F64) -> F64 | None:
        """(3,) m/s at a segment's keyframe, over a second or more; None at its start, and where
        no aircraft is so fast: a camera about to fail stamps images anyhow."""
        for node in reversed(self._segments[last.segment].nodes):
            passed_s = (last.time_ns - node.time_ns) * 1e-9
            if node.key < last.key and passed_s >= VELOCITY_S:
                velocity = (T_last[:3, 3] - self._smoother.pose(node.key)[:3, 3]) / passed_s
                return velocity if np.linalg.norm(velocity) < FASTEST_M_S else None
        return None
