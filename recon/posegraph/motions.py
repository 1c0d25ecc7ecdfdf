"""Motions between keyframes as factors of the pose graph: vision's, or telemetry's without it.

A segment that has a frame in the world leaves its scale open, block by block of keyframes.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from recon import se3
from recon.posegraph.alignment_readings import has_fix
from recon.posegraph.between_keyframes import carried
from recon.posegraph.readings import BLOCK
from recon.posegraph.records import Node, PoseGraphConfig
from recon.posegraph.segment_frames import SegmentFrames
from recon.posegraph.smoother import NO_SCALE, Smoother, left_covariance
from recon.types import F64, PosePrior

VELOCITY_S = 1.0
FASTEST_M_S = 100.0

OPEN_LENGTH, OPEN_SHARE = 0.005, 3.0
"""Relative sigma of the length of a step, and that over the segment's usual one, from which on
vision's scale may have changed there, as where stills turn and have little in common. Where all
images are noisy, lengths scatter and the scale stays."""

UNKNOWN_SCALE = 1.0
"""Sigma of the logarithm of a scale that no reading measures."""


def _length_sigma(node: Node, last: Node) -> float:
    """Relative sigma of the length of vision's step to a node; 0 for none."""
    step = (se3.inverse(last.T_odom_camera) @ node.T_odom_camera)[:3, 3]
    square = float(step @ step)
    return float(np.sqrt(step @ node.covariance[3:, 3:] @ step)) / square if square > 0.0 else 0.0


def _contradiction(a: PosePrior, b: PosePrior, motion: F64) -> tuple[float, F64]:
    """rad by which vision's ``motion`` (4, 4) from a to b tilts against known attitudes, and (3,) m
    by which it leaves the positions; none where one of both is not known."""
    R_a, R_b, from_m, to_m = a.R_world_camera, b.R_world_camera, a.position_m, b.position_m
    are_assumed = a.is_view_assumed or b.is_view_assumed
    if R_a is None or R_b is None or are_assumed or not (has_fix(a) and has_fix(b)):
        return 0.0, np.zeros(3)
    assert from_m is not None and to_m is not None
    up = R_a @ motion[:3, :3] @ R_b[2]  # where that of b points
    return float(np.hypot(up[0], up[1])), np.abs(R_a @ motion[:3, 3] - (to_m - from_m))


class Motions:
    """Adds the motions of one graph to its smoother, and keeps the scale of each keyframe."""

    def __init__(
        self,
        config: PoseGraphConfig,
        smoother: Smoother,
        segments: SegmentFrames,
        counts: Counter[str],
    ) -> None:
        """``counts`` takes in the stretches without vision."""
        self._config, self._smoother = config, smoother
        self._segments, self._counts = segments, counts
        self.scale_of: list[int] = []  # key of each keyframe's scale, or NO_SCALE
        self._units: dict[int, int] = {}  # key of each segment's first scale
        self.refuted: dict[int, int] = {}  # last keyframe after each refuted step's first
        self._blocks: dict[int, tuple[int, int, int]] = {}
        # by segment, its last scale, that scale's first node, and how many keyframes it stands for
        self._lengths: dict[int, list[float]] = {}  # by segment, relative sigmas of its steps

    def first(self, node: Node) -> tuple[F64, F64]:
        """Pose and covariance of the first keyframe: loose where readings will follow.

        The gauge that no reading ever fixes is held at the start.
        """
        frame = self._segments.frame(node.segment)
        T = frame.pose(node.T_odom_camera)
        sigma_t, sigma_r = 0.01, 1.0 if node.prior.R_world_camera is not None else 0.01
        if "gnss" in frame.sources:  # places along a line leave the roll about it free
            known = float(np.sqrt(np.linalg.eigvalsh(frame.covariance[:3, :3])[-1]))
            sigma_t, sigma_r = 50.0, max(sigma_r, min(known, 1.0))
        sigma = np.array([sigma_r] * 3 + [sigma_t] * 3)
        self._smoother.add_turn("prior", node.key, T[:3, :3], sigma[:3])
        self._smoother.add_place("prior place", node.key, T[:3, 3], sigma[3:])
        return T, left_covariance(T, np.diag(sigma**2))

    def add(self, node: Node, last: Node, T_last: F64) -> tuple[F64, F64, bool]:
        """T_last_node in metres, its (6, 6) covariance, left, in last's frame, and whether vision
        gives it; now a factor."""
        is_seen = node.segment == last.segment
        if is_seen:
            motion, covariance = self._seen(node, last)
            if self._is_refuted(node, last, motion, covariance):
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
        key, since, held = self._blocks.get(node.segment, (NO_SCALE, 0, 0))
        if key == NO_SCALE or node.key - since >= BLOCK or jump:
            before, since = key, node.key
            log = float(self._smoother.logs()[before])
            known = self._segments.frame(node.segment).sigma_scale
            sigma = float(np.clip(known, self._config.sigma_scale, UNKNOWN_SCALE))
            if before != NO_SCALE:
                walk = self._config.sigma_scale_walk * np.sqrt(max(1.0, held / BLOCK))
                sigma = float(np.hypot(walk, jump))
            key, held = self._smoother.append_scale(log), 0
            self._smoother.add_scale("scale", (before, key), 0.0, sigma)
            self._units.setdefault(node.segment, key)
        if self.scale_of[node.key] != key:
            self._blocks[node.segment] = (key, since, held + node.weight)
        self.scale_of[node.key] = key
        return key

    def _jump(self, node: Node, last: Node) -> float:
        """Share by which vision's scale may have changed at a step."""
        lengths = self._lengths.setdefault(node.segment, [])
        lengths.append(_length_sigma(node, last))
        usual = float(np.median(lengths))
        return lengths[-1] if lengths[-1] > max(OPEN_LENGTH, OPEN_SHARE * usual) else 0.0

    def add_loop(self, a: Node, b: Node, T_a_b: F64, covariance: F64) -> None:
        """A motion (4, 4) seen between two nodes, in metres by a's frame, whose lengths grow with
        a's scale; its covariance (6, 6) is of the left perturbation in a's frame."""
        scale, unit = self.scale_of[a.key], self._units.get(a.segment, NO_SCALE)
        # Not robust: two loops agreed, and a late one with a large misclosure would lose weight.
        self._smoother.add_motion("loop", (a.key, b.key), T_a_b, covariance, scale, unit)

    def _is_refuted(self, node: Node, last: Node, motion: F64, covariance: F64) -> bool:
        """True where both attitude and positions contradict vision's motion: two sensors do not
        fail at once by chance, and images that smear do."""
        noise = self._segments.noise(node.segment)
        if noise is None or noise.horizontal is None or noise.vertical is None:
            return False
        a, b = self._segments.freed(last).prior, self._segments.freed(node).prior
        tilt_rad, off_m = _contradiction(a, b, motion)
        passed_s = (node.time_ns - last.time_ns) * 1e-9
        known = (noise.horizontal, noise.horizontal, noise.vertical)
        changed = np.square([one.change(passed_s) for one in known])
        sigma_m = np.sqrt(changed + np.trace(covariance[3:, 3:]) / 3.0)
        sigma_rad = float(np.sqrt(np.trace(covariance[:3, :3]) / 3.0 + b.sigma_tilt_rad**2))
        gate = self._config.gate_sigmas
        return tilt_rad > gate * sigma_rad and bool(np.any(off_m > gate * sigma_m))

    def _connect(self, node: Node, last: Node, motion: F64, covariance: F64, is_seen: bool) -> None:
        """The motion between two keyframes; of an aligned segment, with its scale left open."""
        kind, scale, unit = "vision" if is_seen else "link", NO_SCALE, NO_SCALE
        if node.segment == last.segment and self._segments.known(node.segment) is not None:
            key = self.scale_key(node, self._jump(node, last))
            if is_seen:
                scale, unit = key, self._units[node.segment]
        self._smoother.add_motion(kind, (last.key, node.key), motion, covariance, scale, unit)

    def _seen(self, node: Node, last: Node) -> tuple[F64, F64]:
        """Vision's motion."""
        frame = self._segments.frame(node.segment)
        motion = se3.inverse(frame.pose(last.T_odom_camera)) @ frame.pose(node.T_odom_camera)
        units = np.array([1.0] * 3 + [frame.scale] * 3)
        covariance = node.covariance * np.outer(units, units) + np.diag([1e-10] * 3 + [1e-6] * 3)
        covariance[3:, 3:] += self._config.sigma_step**2 * np.outer(motion[:3, 3], motion[:3, 3])
        return motion, covariance

    def _link(self, node: Node, last: Node, T_last: F64) -> tuple[F64, F64]:
        """Dead reckoning where vision was lost: telemetry's motion, else the last one's, wide."""
        passed_s = (node.time_ns - last.time_ns) * 1e-9
        frame = self._segments.known(node.segment)
        is_new = node.segment != last.segment
        if is_new and frame is not None and self._segments.is_tied(node.segment):
            T = frame.pose(node.T_odom_camera)
        elif node.over is not None:
            T = T_last @ node.over
        else:
            priors = self._segments.at_camera(last), self._segments.at_camera(node)
            T = carried(*priors, T_last, self._velocity(last, T_last), passed_s)
        prior = node.prior
        is_turn_known = prior.R_world_camera is not None and prior.sigma_yaw_rad < 1.0
        sigma_r = self._config.sigma_link_rad if is_turn_known else 1.5
        sigma_m = self._config.sigma_link_m * max(passed_s, 1.0) + 5.0
        motion = se3.inverse(T_last) @ T
        # Translation and rotation are separate: an error of one does not rotate the other.
        apart = np.diag(np.square([sigma_r] * 3 + [sigma_m] * 3))
        return motion, left_covariance(motion, apart)

    def _velocity(self, last: Node, T_last: F64) -> F64 | None:
        """(3,) m/s at a segment's keyframe, over a second or more; None at its start, and where
        no aircraft is so fast: a camera about to fail stamps images anyhow."""
        for node in reversed(self._segments.nodes[last.segment]):
            passed_s = (last.time_ns - node.time_ns) * 1e-9
            if node.key < last.key and passed_s >= VELOCITY_S:
                velocity = (T_last[:3, 3] - self._smoother.pose(node.key)[:3, 3]) / passed_s
                return velocity if np.linalg.norm(velocity) < FASTEST_M_S else None
        return None
