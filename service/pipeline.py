"""Figure 1 of the paper: pictures and telemetry in, posed depth images out.

No I/O, no threads: :mod:`service.recorder` writes what comes out, and the commands feed it.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter, deque
from dataclasses import dataclass, replace

import cv2
import numpy as np

from mavlink.state import VehicleState
from recon import se3
from recon.backends import Backend
from recon.belief_propagation import BeliefPropagationConfig
from recon.camera_model import Undistorter, scaled, scaled_K
from recon.depth_fusion import FusionConfig, fuse
from recon.exposure import stretch
from recon.odometry import Odometry, OdometryConfig, OdometryKeyframe, Tracked
from recon.registration import IcpConfig
from recon.reprojection import PairDepth, reproject
from recon.trajectory import Placed, Trajectory
from recon.types import (
    F64,
    U8,
    Array,
    Camera,
    DepthMap,
    Frame,
    Keyframe,
    Pose,
    PosePrior,
    StereoPair,
)
from recon.upsampling import UpsamplingConfig
from recon.virtual_stereo import (
    Refusal,
    View,
    VirtualStereoConfig,
    drop_unseen,
    plane_relief,
    rectify,
)
from recon.voxel_map import VoxelMap, VoxelMapConfig
from service.cameras.source import GeoTag
from service.config import Config, ScanConfig
from service.rig import Rig
from service.stopwatch import Stopwatch
from service.viewpoints import Viewpoint, Viewpoints


@dataclass(frozen=True, slots=True, eq=False)
class Anchorage:
    """A frame's pose relative to an odometry keyframe, whose own pose gets better."""

    seq: int
    key: OdometryKeyframe
    T_key_camera: F64  # (4, 4)


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """What one frame brought."""

    tracked: Tracked
    prior: PosePrior
    placed: Placed | None = None  # the frame in the world; by telemetry alone when vision fails
    is_view: bool = False  # the frame takes part in stereo and may become a keyframe
    anchor: Anchorage | None = None  # gives the frame's place again, as it is known later
    keyframes: tuple[Keyframe, ...] = ()  # finished depth images, oldest first
    moved: tuple[Placed, ...] = ()  # keyframes told before whose pose is better now


class Pipeline:
    """One scan: feed :meth:`step` every frame in order, then call :meth:`finish`."""

    def __init__(self, camera: Camera, config: Config, backend: Backend) -> None:
        """Raises ValueError for an unusable camera model."""
        self.config = config
        self.rig = Rig(config.camera, config.scan, config.fusion)
        self.undistorter = Undistorter(_within_width(camera, int(1.3 * config.compute.guide_width)))
        self.odometry = Odometry(
            _within_width(self.undistorter.camera, 1280),
            OdometryConfig(base_to_height=config.scan.base_to_height),
        )
        self.viewpoints = Viewpoints(config.scan, config.compute.pairs)
        self.trajectory = Trajectory()
        self.stopwatch = Stopwatch()
        self.refusals: Counter[str] = Counter()
        self.registrations: Counter[str] = Counter()
        self.pairs = 0
        self.debug: dict[str, Array] = {}
        self._backend = backend
        self._stereo = VirtualStereoConfig(
            least_base_to_height=self.viewpoints.least_base_to_height,
            width_px=config.compute.stereo_width,
            guide_width_px=config.compute.guide_width,
            guided=config.compute.upsample,
            labels=config.compute.labels,
        )
        self._bp = BeliefPropagationConfig(iterations=config.compute.iterations)
        self._jbu, self._icp, self._fusion = UpsamplingConfig(), IcpConfig(), FusionConfig()
        self._map: VoxelMap | None = None
        self._waiting: deque[Viewpoint] = deque()
        self._registered: tuple[Viewpoint, DepthMap | None, F64] | None = None
        self._carriers: dict[int, list[Anchorage]] = {}  # per segment, what is on the chain
        self._relief = (0.0, 0.0)

    # ---- one frame, as in Figure 1 -----------------------------------------------------

    def step(self, frame: Frame, state: VehicleState | None, tag: GeoTag | None = None) -> Step:
        """Take one frame and what telemetry says of its instant.

        Raises ValueError when the picture is not of the camera model's size.
        """
        prior = self.rig.prior(state, tag)
        with self.stopwatch("undistort"):
            picture, grey, mask = self._pictures(frame.image)
        with self.stopwatch("track"):  # Harris and ZSSD (Eq. 4-5), EPnP (Eq. 6-7)
            tracked = self.odometry.track(grey, frame.seq, frame.time_ns, prior, mask)
        if tracked.T_odom_camera is None:
            self.refusals[tracked.reason] += 1
            placed = _by_telemetry(frame.seq, prior) if tracked.state == "lost" else None
            return Step(tracked, prior, placed)
        key = self.odometry.keyframes[-1]
        viewpoint = self.viewpoints.offer(frame, picture, tracked, key, prior)
        if viewpoint is not None:
            self._waiting.append(viewpoint)
        keyframes = self._reconstruct_ready()
        anchor = Anchorage(frame.seq, key, se3.inverse(key.T_odom_camera) @ tracked.T_odom_camera)
        is_view = viewpoint is not None
        return Step(tracked, prior, self.place(anchor), is_view, anchor, keyframes, self._moved())

    def set_baseline(self, config: ScanConfig) -> None:
        """Follow another ``scan.baseline`` from the next frame on."""
        self.viewpoints.set_baseline(config)
        least = self.viewpoints.least_base_to_height
        self._stereo = replace(self._stereo, least_base_to_height=least)

    def forget_map(self) -> None:
        """Count every surface as new again."""
        self._map = None

    def finish(self) -> Step:
        """The viewpoints still waiting for partners, and the last corrections."""
        tracked = Tracked("lost", self.odometry.segment, reason="end of the recording")
        keyframes = self._reconstruct_ready(everything=True)
        return Step(tracked, PosePrior(), keyframes=keyframes, moved=self._moved(final=True))

    def _pictures(self, image: U8) -> tuple[U8, U8, U8 | None]:
        """Undistorted picture, its grey version at the odometry's size, and the mask of that."""
        W, H = self.undistorter.camera.size_px
        if image.shape[:2] != (H, W) and image.shape[1] > W:
            image = np.asarray(cv2.resize(image, (W, H), interpolation=cv2.INTER_AREA), np.uint8)
        picture = self.undistorter.image(image)
        size = self.odometry.camera.size_px
        grey, mask = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), self.undistorter.valid
        if size != (W, H):
            grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
            mask = np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST), np.uint8)
        return picture, stretch(np.asarray(grey, np.uint8), mask > 0), None if mask.all() else mask

    # ---- a viewpoint whose partners are there ------------------------------------------

    def _reconstruct_ready(self, everything: bool = False) -> tuple[Keyframe, ...]:
        done = []
        while self._waiting and (everything or self.viewpoints.ready(self._waiting[0])):
            keyframe = self._reconstruct(self._waiting.popleft())
            if keyframe is not None:
                done.append(keyframe)
        return tuple(done)

    def _reconstruct(self, viewpoint: Viewpoint) -> Keyframe | None:
        """Stereo with every partner, fused, registered and compared with the map."""
        view = self._view(viewpoint)
        points, _ = self.odometry.landmarks(viewpoint.key)
        points = se3.transform(se3.inverse(viewpoint.T_key_camera), points)
        W, H = self.undistorter.camera.size_px
        size = (self.config.compute.stereo_width, round(self.config.compute.stereo_width * H / W))
        K = scaled_K(view.K, size[0] / W, size[1] / H)
        depths = []
        for partner in self.viewpoints.partners(viewpoint):
            with self.stopwatch("rectify"):
                pair = rectify(view, self._view(partner), points, self._stereo, self._relief)
            if isinstance(pair, Refusal):
                self.refusals[pair.reason] += 1
                continue
            depths.append(self._pair_depth(pair, K, size, view, partner))
        depth = None
        if depths:
            with self.stopwatch("fuse"):
                depth = fuse(depths, K, view.T_odom_camera, self._fusion)
                self._relief = plane_relief(depth, self._relief)
        self._register(viewpoint, view.T_odom_camera, depth, points)
        return None if depth is None else self._keyframe(viewpoint, depth)

    def _pair_depth(
        self, pair: StereoPair, K: F64, size: tuple[int, int], view: View, partner: Viewpoint
    ) -> PairDepth:
        """Belief propagation, upsampling and reprojection of one pair."""
        self.pairs += 1
        with self.stopwatch("belief propagation"):  # Eq. 1
            coarse = self._backend.belief_propagation(pair.left, pair.right, pair.labels, self._bp)
            coarse = drop_unseen(coarse, pair)
        fine = coarse
        if pair.guide is not None:
            with self.stopwatch("upsample"):  # Eq. 2
                fine = self._backend.upsample(coarse, pair.guide, self._jbu)
        with self.stopwatch("reproject"):  # Eq. 3
            depth = reproject(fine, pair, K, size)
        if self.config.scan.keep_debug:
            self.debug = {
                "raw_left": view.grey if view.bgr is None else view.bgr,
                "raw_right": partner.grey if partner.bgr is None else partner.bgr,
                "rect_left": pair.left,
                "rect_right": pair.right,
                "disparity": coarse.px,
                "upsampled": fine.px,
            }
        return depth

    def _register(
        self, viewpoint: Viewpoint, T_odom_camera: F64, depth: DepthMap | None, points: F64
    ) -> None:
        """ICP onto the keyframe before; both estimates of the step, weighted, go on the chain."""
        T_map = T_odom_camera
        covariance = viewpoint.key.covariance + np.diag([1e-4**2] * 3 + [0.005**2] * 3)
        before = self._registered
        if before is not None and before[0].key.segment == viewpoint.key.segment:
            step = se3.inverse(before[0].T_odom_camera) @ T_odom_camera
            A = se3.adjoint(step)
            covariance = A @ covariance @ A.T
            if depth is not None and before[1] is not None:
                with self.stopwatch("icp"):
                    found = self._backend.register(depth, before[1], step, self._icp)
                self.registrations[found.verdict] += 1
                if found.converged:
                    step, covariance = se3.average(
                        step, covariance, found.T_target_source, found.covariance
                    )
            T_map = before[2] @ step
        self._registered = (viewpoint, depth, T_map)
        self._carriers.setdefault(viewpoint.key.segment, []).append(
            Anchorage(viewpoint.seq, viewpoint.key, viewpoint.T_key_camera)
        )
        up = T_odom_camera[:3, :3].T[:, 2]
        height = -float(np.median(points @ up)) if len(points) else None
        self.trajectory.add(
            viewpoint.seq, viewpoint.key.segment, T_map, covariance, viewpoint.prior, height
        )

    def _keyframe(self, viewpoint: Viewpoint, depth: DepthMap) -> Keyframe:
        """The keyframe in the world, in metres, with what is new in it marked."""
        T_map = self.trajectory.map_pose(viewpoint.seq)
        with self.stopwatch("map"):
            in_map = DepthMap(depth.depth_m, depth.sigma_m, depth.views, depth.K, T_map)
            if self._map is None:
                ground_m = float(np.nanmedian(depth.depth_m)) / depth.K[0, 0]
                self._map = VoxelMap(VoxelMapConfig(voxel_m=max(2.0 * ground_m, 1e-3)))
            fresh = self._map.fresh(in_map)
            self._map.insert(in_map, fresh)
        placed = self.trajectory.place(viewpoint.seq)
        self.trajectory.tell(placed)
        h, w = depth.depth_m.shape
        metric = DepthMap(
            depth.depth_m * np.float32(placed.scale),
            depth.sigma_m * np.float32(placed.scale),
            depth.views,
            depth.K,
            placed.T_world_camera,
        )
        assert viewpoint.bgr is not None
        colour = cv2.resize(viewpoint.bgr, (w, h), interpolation=cv2.INTER_AREA)
        if self.config.scan.keep_debug:
            self.debug |= {"depth_m": metric.depth_m, "sigma_m": metric.sigma_m, "bgr": colour}
        return Keyframe(
            viewpoint.seq,
            viewpoint.time_ns,
            metric,
            np.asarray(colour, np.uint8),
            Pose(placed.T_world_camera, placed.covariance, placed.sources),
            fresh,
        )

    # ---- poses -------------------------------------------------------------------------

    def _view(self, viewpoint: Viewpoint) -> View:
        return View(
            viewpoint.seq,
            viewpoint.time_ns,
            viewpoint.bgr,
            viewpoint.grey,
            self.undistorter.camera.K,
            viewpoint.T_odom_camera,
            self.undistorter.valid,
        )

    def place(self, anchor: Anchorage) -> Placed:
        """A frame in the world, carried by the chain's keyframe at or before it."""
        T_odom_camera = anchor.key.T_odom_camera @ anchor.T_key_camera
        carriers = self._carriers.get(anchor.key.segment)
        if not carriers:
            return Placed(anchor.key.seq, T_odom_camera, 1.0, np.eye(6), ("vision",))
        i = bisect_right(carriers, anchor.seq, key=lambda c: c.seq)
        carrier = carriers[max(i - 1, 0)]
        T_carrier = carrier.key.T_odom_camera @ carrier.T_key_camera
        return self.trajectory.ride(carrier.seq, se3.inverse(T_carrier) @ T_odom_camera)

    def _moved(self, final: bool = False) -> tuple[Placed, ...]:
        moved = self.trajectory.moved(final)
        for placed in moved:
            self.trajectory.tell(placed)
        return tuple(moved)


def _by_telemetry(seq: int, prior: PosePrior) -> Placed | None:
    """Where telemetry alone says the camera is; None without attitude, heading or position."""
    R, position, sigma = prior.R_world_camera, prior.position_m, prior.sigma_position_m
    if R is None or position is None or sigma is None or prior.sigma_yaw_rad > 1.0:
        return None
    tilt, yaw = prior.sigma_tilt_rad, prior.sigma_yaw_rad
    covariance = np.diag(np.square([tilt, tilt, yaw, *sigma]))
    return Placed(seq, se3.compose(R, position), 1.0, covariance, ("attitude", "gnss"))


def _within_width(camera: Camera, width_px: int) -> Camera:
    """The camera, or its picture made smaller when it is wider than ``width_px``."""
    W, H = camera.size_px
    if width_px >= W:
        return camera
    return scaled(camera, (width_px, round(H * width_px / W)))
