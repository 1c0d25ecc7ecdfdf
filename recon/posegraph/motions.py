"""Motions between keyframes as factors of the pose graph: vision's, or telemetry's without it.

A segment that has a frame in the world leaves its scale open, block by block of keyframes.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from recon import se3
from recon.posegraph.between_keyframes import carried
from recon.posegraph.readings import BLOCK
from recon.posegraph.records import Node, PoseGraphConfig
from recon.posegraph.segment_frames import SegmentFrames
from recon.posegraph.smoother import NO_SCALE, Smoother, left_covariance
from recon.types import F64

VELOCITY_S = 1.0
FASTEST_M_S = 100.0

OPEN_LENGTH = 0.005
"""Relative sigma of the length of a step from which on vision's scale may have changed there, as
where stills turn and have little in common."""


def _length_sigma(node: Node, last: Node) -> float:
    """Relative sigma of the length of vision's step to a node; 0 for none."""
    step = (se3.inverse(last.T_odom_camera) @ node.T_odom_camera)[:3, 3]
    square = float(step @ step)
    return float(np.sqrt(step @ node.covariance[3:, 3:] @ step)) / square if square > 0.0 else 0.0


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
        self._blocks: dict[int, tuple[int, int, int]] = {}
        # by segment, its last scale, that scale's first node, and how many keyframes it stands for

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

    def add(self, node: Node, last: Node, T_last: F64) -> tuple[F64, F64]:
        """T_last_node in metres and its (6, 6) covariance, left, in last's frame; now a factor."""
        if node.segment == last.segment:
            motion, covariance = self._seen(node, last)
        else:
            motion, covariance = self._link(node, last, T_last)
        self._connect(node, last, motion, covariance)
        return motion, covariance

    def scale_key(self, node: Node, jump: float = 0.0) -> int:
        """Key of the node's scale; made when missing.

        A new one begins every twenty keyframes, and where the scale may ``jump`` by that share.
        """
        key, since, held = self._blocks.get(node.segment, (NO_SCALE, 0, 0))
        if key == NO_SCALE or node.key - since >= BLOCK or jump:
            before, since = key, node.key
            log = float(self._smoother.logs()[before])
            sigma = self._config.sigma_scale
            if before != NO_SCALE:
                walk = self._config.sigma_scale_walk * np.sqrt(max(1.0, held / BLOCK))
                sigma = float(np.hypot(walk, jump))
            key, held = self._smoother.append_scale(log), 0
            self._smoother.add_scale("scale", (before, key), 0.0, sigma)
        if self.scale_of[node.key] != key:
            self._blocks[node.segment] = (key, since, held + node.weight)
        self.scale_of[node.key] = key
        return key

    def _connect(self, node: Node, last: Node, motion: F64, covariance: F64) -> None:
        """The motion between two keyframes; of an aligned segment, with its scale left open."""
        kind, scale = "vision" if node.segment == last.segment else "link", NO_SCALE
        if kind == "vision" and self._segments.known(node.segment) is not None:
            jump = _length_sigma(node, last)
            scale = self.scale_key(node, jump if jump > OPEN_LENGTH else 0.0)
        self._smoother.add_motion(kind, (last.key, node.key), motion, covariance, scale)

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
        self._counts["stretch without vision"] += 1
        passed_s = (node.time_ns - last.time_ns) * 1e-9
        frame = self._segments.known(node.segment)
        if frame is not None and self._segments.is_tied(node.segment):
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
