"""From a view and its partners to a keyframe: the dense half of Figure 1."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from recon import se3
from recon.backends import Backend, DenseStages, PathBackend
from recon.camera_model import scaled_K
from recon.clouds.disagreement import Disagreement
from recon.clouds.registration import IcpConfig
from recon.clouds.voxel_map import VoxelMap, VoxelMapConfig
from recon.graph.alignment import height_above, height_below
from recon.graph.pose_graph import PoseGraph, PoseGraphConfig
from recon.graph.riders import KEYFRAME
from recon.graph.trajectory import Trajectory
from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.stereo.reprojection import FusionConfig, PairDepth, fuse, reproject
from recon.stereo.upsampling import UpsamplingConfig
from recon.stereo.virtual_stereo import (
    Refusal,
    View,
    VirtualStereoConfig,
    drop_unseen,
    plane_relief,
    rectify,
)
from recon.types import (
    F64,
    U8,
    Array,
    DepthMap,
    Keyframe,
    Pose,
    PosePrior,
    Registration,
    StereoPair,
)
from service.compute.stopwatch import Stopwatch
from service.config import ComputeConfig, Config
from service.onboard.graph_aside import GraphAside
from service.onboard.loops import LoopSearch
from service.onboard.map_pages import PagedMap
from service.scans.file_ledger import FileLedger

FARTHEST_M = 1e6
"""From the scan's origin."""


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """A view with everything that its reconstruction needs, poses as they are known now."""

    view: View
    bgr: U8  # (H, W, 3) of the view
    segment: int
    prior: PosePrior
    partners: tuple[View, ...]
    points: F64  # (N, 3) landmarks in the view's camera
    covariance: F64  # (6, 6) of the view's pose, left perturbation of camera-from-odometry
    earlier: Mapping[int, F64]  # number to pose (4, 4) of the segment's last few views


class Dense:
    """Reconstructs views one after the other and keeps the chain of keyframes and the map.

    One thread at a time may reconstruct; others may read the trajectory under :attr:`lock`.
    """

    def __init__(
        self,
        config: Config,
        backend: Backend,
        least_base_to_height: float,
        pages: Path | None = None,
        aside: bool = False,
    ) -> None:
        """``pages`` is a folder for the parts of the map flown long ago, beside which keyframes
        are kept; None: forget the map's, and keep keyframes in memory.

        ``aside`` gives the pose graph a process of its own, so that nobody waits for it.
        """
        compute = config.compute
        most = config.fusion.graph_keyframes
        self._aside = GraphAside(most_nodes=most) if aside else None
        self._ledger = None if pages is None else FileLedger(KEYFRAME, pages.parent)
        graph = PoseGraph(PoseGraphConfig(most_nodes=most)) if self._aside is None else self._aside
        self.trajectory = Trajectory(graph=graph, ledger=self._ledger)
        self.lock = threading.Lock()
        self.stopwatch = Stopwatch()
        self.refusals: Counter[str] = Counter()
        self.registrations: Counter[str] = Counter()
        self.pairs = 0
        self.debug: dict[str, Array] = {}
        self.stereo = VirtualStereoConfig(
            least_base_to_height=least_base_to_height,
            width_px=compute.stereo_width,
            guide_width_px=compute.guide_width,
            guided=compute.upsample,
            labels=compute.labels,
        )
        self._backend = backend
        self._keep_debug = config.scan.keep_debug
        self._bp = BeliefPropagationConfig(iterations=compute.iterations)
        self._jbu, self._icp, self._fusion = UpsamplingConfig(), IcpConfig(), FusionConfig()
        self._stages = DenseStages(self._bp, self._jbu, self._fusion)
        self._map: VoxelMap | PagedMap | None = None
        self._pages = pages
        self._resolution_m = config.scan.resolution_m
        self._before: tuple[int, DepthMap | None, F64] | None = None  # seq, depth, T_map_camera
        self._relief = (0.0, 0.0)
        self._disagreement, self._compared = Disagreement(), -1  # within that segment
        self._map_voxels = compute.map_voxels
        self.loops: LoopSearch | None = None
        if config.fusion.loops:
            self.loops = LoopSearch(self.trajectory, self.lock, most_views=config.fusion.loop_views)

    @property
    def held(self) -> dict[str, int]:
        """What memory holds of this scan: the map's voxels, its tiles on disk, views for loops,
        and keyframes in the pose graph."""
        paged = self._map if isinstance(self._map, PagedMap) else None
        return {
            "map_voxels": 0 if self._map is None else len(self._map),
            "map_tiles_on_disk": 0 if paged is None else paged.tiles_on_disk,
            "loop_views": 0 if self.loops is None else len(self.loops),
            "graph_keyframes": len(self.trajectory.graph),
        }

    def forget_map(self) -> None:
        """Count every surface as new again."""
        if isinstance(self._map, PagedMap):
            self._map.close()
        self._map = None

    def close(self) -> None:
        """End what runs beside; call it last. The graph stays readable."""
        if self._aside is not None:
            self._aside.close()
        if self._ledger is not None:
            self._ledger.close()

    def set_least_base_to_height(self, least: float) -> None:
        """Accept baselines as short as ``least`` of the distance."""
        self.stereo = replace(self.stereo, least_base_to_height=least)

    def set_effort(self, compute: ComputeConfig) -> None:
        """Reconstruct at another width, with or without upsampling, from the next view on."""
        self.stereo = replace(self.stereo, width_px=compute.stereo_width, guided=compute.upsample)

    def reconstruct(self, job: Job) -> Keyframe | None:
        """Stereo with every partner, fused, registered and compared with the map."""
        H, W = job.view.grey.shape
        stereo = self.stereo  # may be set anew meanwhile
        size = (stereo.width_px, round(stereo.width_px * H / W))
        K = scaled_K(job.view.K, size[0] / W, size[1] / H)
        pairs = []
        for partner in job.partners:
            with self.stopwatch("rectify"):
                pair = rectify(job.view, partner, job.points, stereo, self._relief)
            if isinstance(pair, Refusal):
                self.refusals[pair.reason] += 1
                continue
            pairs.append(pair)
            if self._keep_debug:
                self.debug = {"raw_left": job.bgr, "raw_right": partner.grey}
        depth = None
        if pairs:
            depth = self._depth(pairs, K, size, job.view.T_odom_camera)
            self._relief = plane_relief(depth, self._relief)
        self._register(job, depth)
        return None if depth is None else self._keyframe(job, depth)

    def _depth(
        self, pairs: list[StereoPair], K: F64, size: tuple[int, int], T_odom_camera: F64
    ) -> DepthMap:
        """The fused depth: at once where the backend has a device for it, else by stages."""
        self.pairs += len(pairs)
        if isinstance(self._backend, PathBackend) and not self._keep_debug:
            with self.stopwatch("dense path"):
                whole = self._backend.fused_depth(pairs, K, size, T_odom_camera, self._stages)
            if whole is not None:
                return whole
        depths = [self._pair_depth(pair, K, size) for pair in pairs]
        with self.stopwatch("fuse"):
            return fuse(depths, K, T_odom_camera, self._fusion)

    def _pair_depth(self, pair: StereoPair, K: F64, size: tuple[int, int]) -> PairDepth:
        """Belief propagation, upsampling and reprojection of one pair."""
        with self.stopwatch("belief propagation"):  # Eq. 1
            coarse = self._backend.belief_propagation(pair.left, pair.right, pair.labels, self._bp)
            coarse = fine = drop_unseen(coarse, pair)
        if pair.guide is not None:
            with self.stopwatch("upsample"):  # Eq. 2
                fine = self._backend.upsample(coarse, pair.guide, self._jbu)
        with self.stopwatch("reproject"):  # Eq. 3
            depth = reproject(fine, pair, K, size)
        if self._keep_debug:
            self.debug |= {
                "rect_left": pair.left,
                "rect_right": pair.right,
                "disparity": coarse.px,
                "upsampled": fine.px,
            }
        return depth

    def _register(self, job: Job, depth: DepthMap | None) -> None:
        """ICP onto the keyframe before; both estimates of the step, weighted, go on the chain."""
        T_map = job.view.T_odom_camera
        covariance = job.covariance + np.diag([1e-4**2] * 3 + [0.005**2] * 3)
        T_before = job.earlier.get(self._before[0]) if self._before is not None else None
        if self._before is not None and T_before is not None:
            step = se3.inverse(T_before) @ job.view.T_odom_camera
            A = se3.adjoint(step)
            covariance = A @ covariance @ A.T
            found = self._icp_step(depth, self._before[1], step)
            if found is not None and found.converged:
                step, covariance = se3.average(
                    step, covariance, found.T_target_source, found.covariance
                )
            T_map = self._before[2] @ step
        self._before = (job.view.seq, depth, T_map)
        up = job.view.T_odom_camera[2, :3]
        below = height_below(depth, up) if depth is not None else None
        height = (below, 0.0) if below is not None else height_above(job.points, up)
        with self.lock:
            self.trajectory.add(
                job.view.seq, job.segment, T_map, job.prior, height, job.view.time_ns, covariance
            )
        if self.loops is not None and depth is not None:
            with self.stopwatch("loops"):
                self.loops.look(job.view.seq, job.segment, job.view.grey, job.view.K, depth)

    def _icp_step(
        self, depth: DepthMap | None, before: DepthMap | None, step: F64
    ) -> Registration | None:
        if depth is None or before is None:
            return None
        with self.stopwatch("icp"):
            found = self._backend.register(depth, before, step, self._icp)
        self.registrations[found.verdict] += 1
        return found

    def _keyframe(self, job: Job, depth: DepthMap) -> Keyframe | None:
        """The keyframe in the world, in metres, with what is new in it marked; None where the
        graph puts it to where nobody flies."""
        seq = job.view.seq
        with self.lock:
            placed = self.trajectory.place(seq)
            if not np.abs(placed.T_world_camera[:3, 3]).max() < FARTHEST_M:
                self.refusals["placed beyond all reach"] += 1
                return None
            self.trajectory.tell(placed)
        with self.stopwatch("map"):
            T_map = self.trajectory.map_pose(seq)
            in_map = DepthMap(depth.depth_m, depth.sigma_m, depth.views, depth.K, T_map)
            if job.segment != self._compared:
                self._disagreement.forget()
                self._compared = job.segment
            wider = np.float32(self._disagreement.take(in_map))
            in_map = replace(in_map, sigma_m=in_map.sigma_m * wider)
            if self._map is None:
                ground_m = float(np.nanmedian(depth.depth_m)) / depth.K[0, 0]
                voxel_m = max(2.0 * ground_m, self._resolution_m, 1e-3)
                fine = VoxelMapConfig(voxel_m=voxel_m)
                pages = self._pages
                self._map = (
                    VoxelMap(fine) if pages is None else PagedMap(fine, pages, self._map_voxels)
                )
            fresh = self._map.fresh(in_map)
            self._map.insert(in_map, fresh)
        h, w = depth.depth_m.shape
        metric = DepthMap(
            depth.depth_m * np.float32(placed.scale),
            in_map.sigma_m * np.float32(placed.scale),
            depth.views,
            depth.K,
            placed.T_world_camera,
        )
        colour = np.asarray(cv2.resize(job.bgr, (w, h), interpolation=cv2.INTER_AREA), np.uint8)
        if self._keep_debug:
            self.debug |= {"depth_m": metric.depth_m, "sigma_m": metric.sigma_m, "bgr": colour}
        pose = Pose(placed.T_world_camera, placed.covariance, placed.sources)
        return Keyframe(seq, job.view.time_ns, metric, colour, pose, fresh)
