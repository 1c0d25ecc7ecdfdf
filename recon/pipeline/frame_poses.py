"""Poses of all frames in the world, each by the keyframe at or before it."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from recon import se3
from recon.pipeline.keyframe_map import KeyframeMap
from recon.posegraph.pose_priors import dead_reckoned
from recon.posegraph.trajectory import carried
from recon.tracking.frame import Frame, Tracking
from recon.types import F64, Pose, PosePrior


class FramePoses:
    """Places frames by the pose of the newest view, so that they never wait for the graph; by the
    graph itself after :meth:`finish`."""

    def __init__(self, keyframes: KeyframeMap, is_settled: Callable[[Frame], bool]) -> None:
        """``is_settled`` marks frames whose reference keyframe is no longer adjusted."""
        self._map, self._is_settled = keyframes, is_settled
        self._views: list[Frame] = []  # reconstructed, in order
        self._settled = 0  # the first so many no longer change
        # By segment, of its last frame with a fix: place in the odometry, fix, sigma, sources.
        self._fallbacks: dict[int, tuple[F64, F64, F64, tuple[str, ...]]] = {}
        self._seen: tuple[PosePrior, Pose] | None = None  # the last frame placed by vision
        self._newest: Pose | None = None  # of a view; None again once all is done

    def add_view(self, view: Frame, pose: Pose) -> None:
        """Let a view that is in the graph, at a pose, carry frames from now on."""
        self._views.append(view)
        self._newest = pose

    def settle(self) -> None:
        """Release the keyframes that no longer change."""
        for i in range(self._settled, len(self._views)):
            if not self._is_settled(self._views[i]):
                return
            self._views[i] = self._views[i].settled()
            self._settled += 1

    def finish(self) -> None:
        """Place frames by the whole graph from now on, all of them again in the order of time."""
        self._newest = self._seen = None
        self._fallbacks.clear()

    def place(self, frame: Frame) -> Pose | None:
        """A new frame in the world, by vision or else by telemetry; None where neither tells."""
        if not frame.is_placed:
            return self._by_telemetry(frame.prior) if frame.state is Tracking.LOST else None
        pose = self._by_vision(frame, self._fallback(frame))
        self._seen = frame.prior, pose
        return pose

    def _fallback(self, frame: Frame) -> Pose:
        """A frame that no keyframe carries: turned as the odometry has it, at its fix, or as far
        from the last one as the odometry has it. Heading and scale of the odometry are not known:
        the sigma grows by the way."""
        at_m, prior = frame.T_odom_camera[:3, 3], frame.prior
        fix, sigma = prior.position_m, prior.sigma_position_m
        if fix is not None and sigma is not None:
            self._fallbacks[frame.segment] = at_m, fix, sigma, ("gnss",)
        start = at_m, at_m, np.ones(3), ("vision",)
        from_m, place_m, sigma_m, sources = self._fallbacks.setdefault(frame.segment, start)
        way_m = at_m - from_m
        sigma_m = np.hypot(sigma_m, np.linalg.norm(way_m))
        T = se3.compose(frame.T_odom_camera[:3, :3], place_m + way_m)
        covariance = se3.about(-T[:3, 3], np.diag(np.r_[np.ones(3), np.square(sigma_m)]))
        return Pose(T, covariance, sources, is_aligned=False)

    def _by_vision(self, frame: Frame, fallback: Pose) -> Pose:
        """A frame carried by the view at or before it where it can. A segment too short to be
        aligned has no scale and no heading: its frames stay at their fixes."""
        view = self._view_of(frame)
        if view is None:
            return fallback
        # In flight no other view than the newest carries a new frame.
        known = self._newest or self._map.trajectory.pose(view.seq)
        if "gnss" in self._fallbacks[frame.segment][3] and not known.is_aligned:
            return fallback
        pose = carried(known, se3.inverse(view.T_odom_camera) @ frame.T_odom_camera)
        after = self._map.graph.refuted.get(view.seq) if self._newest is None else None
        return pose if after is None else self._doubted(pose, view.seq, after)

    def _view_of(self, frame: Frame) -> Frame | None:
        """The view at or before a frame, or its segment's first; None without any."""
        after = bisect_right(self._views, frame.seq, key=lambda view: view.seq)
        for view in self._views[max(after - 1, 0) : after + 1]:
            if view.segment == frame.segment:
                return view
        return None

    def _doubted(self, pose: Pose, before: int, after: int) -> Pose:
        """A frame between two keyframes where vision is wrong: as unsure as its step is long."""
        step_m = self._map.trajectory.step_between(before, after)[:3, 3]
        spread = np.diag(np.r_[np.ones(3), np.full(3, float(step_m @ step_m))])
        about = se3.about(-pose.T_world_camera[:3, 3], spread)
        return replace(pose, covariance=pose.covariance + about)

    def _by_telemetry(self, prior: PosePrior) -> Pose | None:
        """A lost frame where telemetry alone says the camera is; None without attitude, heading
        or position.

        Telemetry's error when vision was lost is subtracted, so that the track continues.
        """
        R, position, sigma = prior.R_world_camera, prior.position_m, prior.sigma_position_m
        if R is None or position is None or sigma is None or prior.sigma_yaw_rad > 1.0:
            return None
        T = se3.compose(R, position)
        if self._seen is not None:
            before, seen = self._seen
            if seen.is_aligned:
                T = dead_reckoned(before, prior, seen.T_world_camera, None, 0.0)
        tilt, yaw = prior.sigma_tilt_rad, prior.sigma_yaw_rad
        covariance = se3.about(-T[:3, 3], np.diag(np.square([tilt, tilt, yaw, *sigma])))
        return Pose(T, covariance, ("attitude", "gnss", "dead reckoning"))
