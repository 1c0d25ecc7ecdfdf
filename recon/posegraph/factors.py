"""Factors of the pose graph: telemetry of a keyframe, and motions from one keyframe to the next.

A motion is vision's, or telemetry's where vision has none. docs/pose-graph.md lists all kinds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from recon import se3
from recon.posegraph.ground import height_ratio
from recon.posegraph.pose_priors import MIN_FIX_M, dead_reckoned, has_fix, off_attitudes
from recon.posegraph.records import FRAME_DRIFT, SIGMA_STEP, Loop, Node
from recon.posegraph.segments import Segments
from recon.posegraph.sensor_noise import (
    ALTITUDE_S,
    ATTITUDE_S,
    Noise,
    bias_time_constant_s,
    inflation,
)
from recon.posegraph.sensor_offsets import FRAME_SIGMA_RAD, GATE_SIGMAS
from recon.posegraph.smoother import NO_SCALE, Smoother
from recon.types import F64, PosePrior

HEIGHT_GATE = 0.05  # share by which a height exactly below may be off, once its constant is out
BLOCK = 20  # keyframes that share one scale and one altitude bias

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

SIGMA_SCALE_WALK = 0.003  # sigma of the change of the scale from block to block
BLOCKS_PER_HEIGHT = 2.0  # heights of so many blocks count as one: neighbours see the same relief
HUBER_SIGMAS = 1.5  # from so many of its residual on a reading loses weight
SIGMA_LOOP_SCALE = 0.002  # of the ratio of the depths at a loop's ends
ALTITUDE_SLACK_M = 3.0  # an altitude further beyond its gate has stepped: climbs and gusts do less

LINK_RAD, LINK_WITHOUT_HEADING_RAD, LINK_M, LINK_M_S = 0.3, 1.5, 5.0, 3.0
"""Sigmas of dead reckoning: of its turn, with a heading and without, and of its way at the start
and for each second: about what a drone's speed changes by."""


class GraphFactors:
    """One build of the graph: the factors of its nodes and loops, and their solution."""

    def __init__(self, segments: Segments, nodes: Collection[Node]) -> None:
        """How many readings share a sensor's bias follows from the ``nodes`` known so far."""
        self._segments = segments
        self.smoother = Smoother()
        times_ns = [node.time_ns for node in nodes]
        self._keyframes = max(len(times_ns), 1)
        self._span_s = max((times_ns[-1] - times_ns[0]) * 1e-9 if times_ns else 0.0, 1.0)
        self._inflation = partial(inflation, self._keyframes, self._span_s)
        self._altitude_offset_m = segments.altitude_offset()  # altitude less world z
        self.left_out: Counter[str] = Counter()
        self.sources: list[set[str]] = []  # of each node
        self.path_m: list[float] = []  # flown up to each node
        self.refuted: dict[int, int] = {}  # last keyframe after each refuted step's first
        self.scale_of: list[int] = []  # key of each node's scale, or NO_SCALE
        self._units: dict[int, int] = {}  # by segment, key of its first scale
        # Of the newest segment: the first node of its last scale, the keyframes that this stands
        # for, and the relative sigmas of vision's steps.
        self._since, self._held, self._lengths = 0, 0, list[float]()
        self._prior = PosePrior()  # of the newest node, corrected

    def add(self, node: Node, last: Node | None) -> None:
        """A node's motion since the ``last`` one, and its readings."""
        segment = self._segments[node.segment]
        before, self._prior = self._prior, segment.corrected(node)
        self.scale_of.append(self._scale(node, last))
        if last is None:
            T, spread = self._first(node)
            used, path_m = {"vision"}, 0.0
        else:
            T_last, spread_last = self.smoother.state(last.key)
            motion, covariance, is_seen = self._motion(node, last, T_last, before)
            used = {"vision" if is_seen else "dead reckoning"}
            T = se3.project_to_so3(T_last @ motion)
            path_m = self.path_m[-1] + float(np.linalg.norm(motion[:3, 3]))
            spread = spread_last + se3.left_covariance(T_last, covariance)
        self.smoother.append_pose(T, spread)
        self.path_m.append(path_m)
        node = replace(node, prior=self._prior)
        used |= {"attitude"} if self._attitude(node, T, spread) else set()
        if segment.similarity is not None:
            used |= {"gnss"} if self._position(node, T, spread) else set()
            has_altitude, has_height = self._altitude(node, T, spread), self._height(node)
            used |= {"altitude"} if has_altitude or has_height else set()
        self.sources.append(used)

    def add_loop(self, loop: Loop, a: Node, b: Node) -> None:
        """A loop between two nodes, and the ratio of the depths there, where each has a scale."""
        scale_m, other_m = (self._segments[end.segment].to_world.scale for end in (a, b))
        metric = loop.scaled(scale_m)
        self.sources[b.key].add("loop")
        scales = self.scale_of[a.key], self.scale_of[b.key]
        unit = self._units.get(a.segment, NO_SCALE)
        # Not robust: two loops agreed, and a late one with a large misclosure would lose weight.
        self.smoother.add_motion(
            "loop", (a.key, b.key), metric.T_a_b, metric.covariance, scales[0], unit
        )
        if scales[0] != scales[1] and NO_SCALE not in scales:
            log = float(np.log(loop.ratio * scale_m / other_m))
            self.smoother.add_scale("loop scale", scales, log, SIGMA_LOOP_SCALE, HUBER_SIGMAS)

    # ---- motions -------------------------------------------------------------------------------

    def _first(self, node: Node) -> tuple[F64, F64]:
        """Pose and covariance of the first keyframe: loose where readings will follow. The gauge
        that no reading ever fixes is held at the start."""
        to_world = self._segments[node.segment].to_world
        T = to_world.pose(node.T_odom_camera)
        sigma_t, sigma_r = 0.01, 1.0 if node.prior.R_world_camera is not None else 0.01
        if "gnss" in to_world.sources:  # places along a line leave the roll about it free
            known = float(np.sqrt(np.linalg.eigvalsh(to_world.covariance[:3, :3])[-1]))
            sigma_t, sigma_r = 50.0, max(sigma_r, min(known, 1.0))
        sigma = np.array([sigma_r] * 3 + [sigma_t] * 3)
        self.smoother.add_turn("prior", node.key, T[:3, :3], sigma[:3])
        self.smoother.add_place("prior place", node.key, T[:3, 3], sigma[3:])
        return T, se3.left_covariance(T, np.diag(sigma**2))

    def _motion(
        self, node: Node, last: Node, T_last: F64, before: PosePrior
    ) -> tuple[F64, F64, bool]:
        """T_last_node in metres, its (6, 6) covariance, left, in last's frame, and whether vision
        gives it; now a factor. ``before`` is the last node's corrected prior."""
        keys, is_seen = (last.key, node.key), node.segment == last.segment
        if is_seen:
            motion, covariance = self._seen(node, last)
            noise = self._segments[node.segment].fix_noise
            passed_s = (node.time_ns - last.time_ns) * 1e-9
            if noise is not None and _is_refuted(
                before, self._prior, passed_s, motion, covariance, noise
            ):
                self.refuted[last.seq] = node.seq
                self.left_out["vision off"] += 1
                is_seen = False
        else:
            self.left_out["stretch without vision"] += 1
        if is_seen:
            scale, unit = self.scale_of[node.key], self._units.get(node.segment, NO_SCALE)
            self.smoother.add_motion("vision", keys, motion, covariance, scale, unit)
        else:
            motion, covariance = self._link(node, last, T_last)
            self.smoother.add_motion("link", keys, motion, covariance)
        return motion, covariance, is_seen

    def _scale(self, node: Node, last: Node | None) -> int:
        """Key of the node's scale, made when missing; none before its segment is placed. A new one
        begins every twenty keyframes, and where vision's scale may have changed."""
        segment = self._segments[node.segment]
        if segment.similarity is None:
            return NO_SCALE
        if last is None or last.segment != node.segment:
            before, self._lengths = NO_SCALE, []
            sigma = float(np.clip(segment.to_world.sigma_scale, KNOWN_SCALE, UNKNOWN_SCALE))
        else:
            before, jump = self.scale_of[last.key], self._jump(node, last)
            if node.key - self._since < BLOCK and not jump:
                self._held += node.weight
                return before
            walk = SIGMA_SCALE_WALK * np.sqrt(max(1.0, self._held / BLOCK))
            sigma = float(np.hypot(walk, jump))
        key = self.smoother.append_scale(float(self.smoother.logs()[before]))
        self.smoother.add_scale("scale", (before, key), 0.0, sigma)
        self._units.setdefault(node.segment, key)
        self._since, self._held = node.key, node.weight
        return key

    def _jump(self, node: Node, last: Node) -> float:
        """Share by which vision's scale may have changed at a step."""
        length = _length_sigma(node, last)
        self._lengths.append(length)
        return length if length > max(OPEN_LENGTH, OPEN_SHARE * np.median(self._lengths)) else 0.0

    def _seen(self, node: Node, last: Node) -> tuple[F64, F64]:
        to_world = self._segments[node.segment].to_world
        motion = se3.inverse(to_world.pose(last.T_odom_camera)) @ to_world.pose(node.T_odom_camera)
        covariance = se3.in_units(node.covariance, to_world.scale)
        covariance += np.diag([1e-10] * 3 + [1e-6] * 3)
        covariance[3:, 3:] += SIGMA_STEP**2 * np.outer(motion[:3, 3], motion[:3, 3])
        return motion, covariance

    def _link(self, node: Node, last: Node, T_last: F64) -> tuple[F64, F64]:
        """Dead reckoning where vision was lost: telemetry's motion, else the last one's, wide."""
        passed_s = (node.time_ns - last.time_ns) * 1e-9
        segment = self._segments[node.segment]
        to_world = segment.similarity
        is_new = node.segment != last.segment
        if is_new and to_world is not None and segment.is_tied:
            T = to_world.pose(node.T_odom_camera)
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
        return motion, se3.left_covariance(motion, apart)

    def _velocity(self, last: Node, T_last: F64) -> F64 | None:
        """(3,) m/s at a segment's keyframe, over a second or more; None at its start, and where
        no aircraft is so fast: a camera about to fail stamps images anyhow."""
        for node in reversed(self._segments[last.segment].nodes):
            passed_s = (last.time_ns - node.time_ns) * 1e-9
            if node.key < last.key and passed_s >= VELOCITY_S:
                velocity = (T_last[:3, 3] - self.smoother.pose(node.key)[:3, 3]) / passed_s
                return velocity if np.linalg.norm(velocity) < FASTEST_M_S else None
        return None

    # ---- readings ------------------------------------------------------------------------------

    def _attitude(self, node: Node, T: F64, spread: F64) -> bool:
        prior = node.prior
        if prior.R_world_camera is None:
            return False
        sigma = np.array([prior.sigma_tilt_rad, prior.sigma_tilt_rad, prior.sigma_yaw_rad])
        turn = _turn(T[:3, :3], prior.R_world_camera, prior.sigma_yaw_rad < 1.0)
        sure = np.diag(spread)[:3]
        # The similarity of a segment rests on all attitudes: it is no worse than this.
        if self._segments[node.segment].similarity is not None:
            sure = np.minimum(sure, np.square(FRAME_SIGMA_RAD))
        allowed = GATE_SIGMAS * np.sqrt(sure + sigma**2)
        if abs(turn[2]) > allowed[2]:
            self.left_out["heading off"] += 1
            turn, sigma[2] = _turn(T[:3, :3], prior.R_world_camera, False), np.pi
        if np.any(np.abs(turn[:2]) > allowed[:2]):
            self.left_out["view off" if prior.is_view_assumed else "tilt off"] += 1
            return False
        R = se3.so3_exp(turn) @ T[:3, :3]
        sigma = sigma * self._inflation(ATTITUDE_S)
        self.smoother.add_turn("attitude", node.key, R, sigma, HUBER_SIGMAS)
        return True

    def _position(self, node: Node, T: F64, spread: F64) -> bool:
        prior, noise = node.prior, self._segments[node.segment].fix_noise
        if prior.position_m is None or prior.sigma_position_m is None:
            return False
        sigma = np.maximum(prior.sigma_position_m, MIN_FIX_M)
        # The similarity rests on all fixes: it is no worse than one of them.
        drift_m = FRAME_DRIFT * self.path_m[node.key]
        sure = np.minimum(np.diag(se3.about(T[:3, 3], spread))[3:], sigma**2 + drift_m**2)
        apart = np.abs(prior.position_m - T[:3, 3])
        if np.any(apart > GATE_SIGMAS * np.sqrt(sure + sigma**2)):
            self.left_out["position off"] += 1
            return False
        if noise is not None:
            each = [one.effective_sigma(self._keyframes, self._span_s) for one in noise]
            sigma = np.maximum(each, MIN_FIX_M)
        else:
            sigma = sigma * self._inflation(bias_time_constant_s(float(sigma[0])))
        self.smoother.add_place("position", node.key, prior.position_m, sigma, HUBER_SIGMAS)
        return True

    def _altitude(self, node: Node, T: F64, spread: F64) -> bool:
        """The altitude minus its offset; after a step it continues from the track."""
        prior = node.prior
        if prior.altitude_m is None:
            return False
        if self._altitude_offset_m is None:
            self._altitude_offset_m = prior.altitude_m - T[2, 3]
        z, one = prior.altitude_m - self._altitude_offset_m, prior.sigma_altitude_m
        sure = se3.about(T[:3, 3], spread)[5, 5]
        if abs(z - T[2, 3]) > GATE_SIGMAS * np.sqrt(sure + one**2) + ALTITUDE_SLACK_M:
            self.left_out["altitude off"] += 1
            self._altitude_offset_m = prior.altitude_m - T[2, 3]
            return False
        sigma = np.array([np.inf, np.inf, one * self._inflation(ALTITUDE_S)])
        place = np.array([0.0, 0.0, z])
        self.smoother.add_place("altitude", node.key, place, sigma, HUBER_SIGMAS)
        return True

    def _height(self, node: Node) -> bool:
        """True when the height above ground was taken as a reading of the scale."""
        ratio, log = height_ratio(node), np.log(self._segments[node.segment].to_world.scale)
        if ratio is None or not node.prior.is_agl_measured:
            return False
        if node.slant == 0.0 and abs(ratio[0] - log) > HEIGHT_GATE:
            self.left_out["height off"] += 1  # a tree or a roof under the one sensor alone
            return False
        sigma = ratio[1] * float(np.sqrt(BLOCK * BLOCKS_PER_HEIGHT))
        keys, measured = (NO_SCALE, self.scale_of[node.key]), ratio[0] - float(log)
        self.smoother.add_scale("height", keys, measured, sigma, HUBER_SIGMAS)
        return True


def _turn(R: F64, R_measured: F64, heading: bool) -> F64:
    """(3,) world rotation from ``R`` to the measured attitude; without ``heading``, its tilt."""
    return np.asarray(-off_attitudes(R[None], R_measured[None], np.array([heading]))[0])


def _length_sigma(node: Node, last: Node) -> float:
    """Relative sigma of the length of vision's step to a node; 0 for none."""
    step = (se3.inverse(last.T_odom_camera) @ node.T_odom_camera)[:3, 3]
    square = float(step @ step)
    return float(np.sqrt(step @ node.covariance[3:, 3:] @ step)) / square if square > 0.0 else 0.0


def _is_refuted(
    a: PosePrior, b: PosePrior, passed_s: float, motion: F64, covariance: F64,
    noise: Sequence[Noise],
) -> bool:  # fmt: skip
    """True where both known attitudes and positions contradict vision's ``motion`` (4, 4) from a to
    b: two sensors do not fail at once by chance, and images that smear do. ``noise`` is that of
    positions, by axis."""
    R_a, R_b, from_m, to_m = a.R_world_camera, b.R_world_camera, a.position_m, b.position_m
    are_assumed = a.is_view_assumed or b.is_view_assumed
    if R_a is None or R_b is None or are_assumed or not (has_fix(a) and has_fix(b)):
        return False
    assert from_m is not None and to_m is not None
    up = R_a @ motion[:3, :3] @ R_b[2]  # where that of b points
    sigma_rad = float(np.sqrt(np.trace(covariance[:3, :3]) / 3.0 + b.sigma_tilt_rad**2))
    if not np.hypot(up[0], up[1]) > GATE_SIGMAS * sigma_rad:
        return False
    changed = np.square([one.change(passed_s) for one in noise])
    sigma_m = np.sqrt(changed + np.trace(covariance[3:, 3:]) / 3.0)
    off_m = np.abs(R_a @ motion[:3, 3] - (to_m - from_m))
    return bool(np.any(off_m > GATE_SIGMAS * sigma_m))
