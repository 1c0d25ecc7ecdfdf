"""Figure 1 of the paper: pictures and telemetry in, posed depth images out.

The upper half of the figure is here, the lower (stereo to ICP) in :mod:`service.onboard.dense`. No
I/O: :mod:`service.onboard.recorder` writes what comes out, and the commands feed it.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from mavlink.telemetry.samples import VehicleState
from recon import se3
from recon.backends import Backend, MatchingBackend
from recon.camera_model import Undistorter, scaled
from recon.graph.dead_reckoning import carried
from recon.graph.fix_average import FixAverage
from recon.graph.trajectory import Placed
from recon.graph.travel import Odometer
from recon.image_quality import BlurWatch, stretch
from recon.stereo.virtual_stereo import View
from recon.tracking.keyframe_window import landmarks
from recon.tracking.localisation import OdometryConfig
from recon.tracking.odometry import Odometry, Tracked
from recon.types import U8, Camera, Frame, Keyframe, PosePrior
from service.cameras.source import GeoTag
from service.compute.side_by_side import SideBySide
from service.config import ComputeConfig, Config, ScanConfig
from service.onboard.anchorage import VIEW, Anchorage, Carriers, Key
from service.onboard.dense import Dense, Job
from service.onboard.pieces import Pieces
from service.onboard.rig import Rig
from service.onboard.viewpoints import Offer, Viewpoint, Viewpoints
from service.scans.file_ledger import FileLedger


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
    """One scan: feed :meth:`step` every frame in order, then call :meth:`finish`.

    Tracking runs in the caller's thread, reconstruction beside it. ``live`` lets old work give
    way when it cannot keep up, and gives the pose graph a process of its own; otherwise nothing is
    dropped.
    """

    def __init__(
        self,
        camera: Camera,
        config: Config,
        backend: Backend,
        live: bool = False,
        pages: Path | None = None,
    ) -> None:
        """Raises ValueError for an unusable camera model.

        ``pages`` is a folder that the parts of the map flown long ago may go to; beside it what
        is remembered of every view lies in files without a name.
        """
        self.config = config
        self.rig = Rig(config.camera, config.scan, config.fusion)
        self.undistorter = Undistorter(_within_width(camera, int(1.3 * config.compute.guide_width)))
        self.odometry = Odometry(
            _within_width(self.undistorter.camera, 1280),
            OdometryConfig(base_to_height=config.scan.base_to_height),
            backend.matcher() if isinstance(backend, MatchingBackend) else None,
        )
        self._blur = BlurWatch()
        self.viewpoints = Viewpoints(config.scan, config.compute.pairs)
        least = self.viewpoints.least_base_to_height
        self.dense = Dense(config, backend, least, pages, aside=live)
        self.stopwatch = self.dense.stopwatch
        self.refusals: Counter[str] = Counter()
        self._jobs: SideBySide[Job, Keyframe | None] = SideBySide(
            self.dense.reconstruct,
            3,
            live,
            beside=not config.scan.keep_debug,
            threads=config.compute.threads,
        )
        self._waiting: deque[Viewpoint] = deque()
        self._asked: deque[Viewpoint] = deque(maxlen=8)  # whose reconstruction was asked for
        self._views: dict[int, Viewpoint] = {}  # asked for and not done yet
        self._carriers = Carriers(None if pages is None else FileLedger(VIEW, pages.parent))
        self._segment = self.odometry.segment
        self.pieces = Pieces()
        self._fixes = FixAverage()
        self._odometer = Odometer()
        self._priors: dict[int, PosePrior] = {}  # of the views that wait
        self._seen: tuple[int, PosePrior, Placed] | None = None  # what vision placed last
        self._latest: Offer | None = None  # the last tracked frame that did not become a view

    # ---- one frame, as in Figure 1 -----------------------------------------------------

    def step(self, frame: Frame, state: VehicleState | None, tag: GeoTag | None = None) -> Step:
        """Take one frame and what telemetry says of its instant.

        Raises ValueError when the picture is not of the camera model's size.
        """
        prior = self._odometer.take(frame.time_ns, self.rig.prior(state, tag))
        with self.stopwatch("undistort"):
            picture, grey, mask = self._pictures(frame.image)
        with self.stopwatch("track"):  # Harris and ZSSD (Eq. 4-5), EPnP (Eq. 6-7)
            blurred = self._blur.blurred(grey)
            tracked = self.odometry.track(grey, frame.seq, frame.time_ns, prior, mask, blurred)
        if tracked.segment != self._segment:
            self._end_segment()
            self._segment = tracked.segment
        if tracked.T_odom_camera is None:
            self.refusals[tracked.reason] += 1
            placed = self._by_telemetry(frame.seq, prior) if tracked.state == "lost" else None
            return Step(tracked, prior, placed)
        key = self.odometry.keyframes[-1]
        offer = Offer(frame.seq, frame.time_ns, picture, tracked, key, prior, blurred)
        viewpoint = self.viewpoints.offer(offer)
        self._fixes.take(tracked.T_odom_camera, prior)
        if viewpoint is not None:
            self._wait(viewpoint, prior)
        self._latest = offer if viewpoint is None else None
        self._ask_for_ready()
        keyframes = self._collect()
        anchor = Anchorage(frame.seq, key, se3.inverse(key.T_odom_camera) @ tracked.T_odom_camera)
        is_view = viewpoint is not None
        moved = self._moved() if keyframes else ()
        placed = self.place(anchor)
        self._seen = tracked.segment, prior, placed
        return Step(tracked, prior, placed, is_view, anchor, keyframes, moved)

    def set_baseline(self, config: ScanConfig) -> None:
        """Follow another ``scan.baseline`` from the next frame on."""
        self.viewpoints.set_baseline(config)
        self.dense.set_least_base_to_height(self.viewpoints.least_base_to_height)

    def set_effort(self, compute: ComputeConfig) -> None:
        """Follow another ``pairs``, ``stereo_width`` and ``upsample`` from the next view on."""
        self.viewpoints.set_partners(compute.pairs)
        self.dense.set_effort(compute)

    @property
    def dropped(self) -> int:
        """Views that were not reconstructed because newer ones came faster."""
        return self._jobs.dropped

    @property
    def busy_s(self) -> float:
        """Seconds for which one view has been under reconstruction; 0 when none is."""
        return self._jobs.busy_s

    def apart(self) -> list[tuple[int, int]]:
        """First and last keyframe of each stretch that nothing ties to the rest of the scan."""
        with self.dense.lock:
            return self.pieces.apart(self.dense.trajectory.graph)

    def all_refusals(self) -> Counter[str]:
        """Frames and pairs not used, by reason."""
        return self.refusals + self.dense.refusals

    def finish(self) -> Step:
        """The views still waiting for partners, and the last corrections."""
        self._end_segment()
        self._ask_for_ready(everything=True)
        keyframes = self._collect(everything=True)
        self._jobs.close()
        self.dense.forget_map()
        tracked = Tracked("lost", self.odometry.segment, reason="end of the recording")
        return Step(tracked, PosePrior(), keyframes=keyframes, moved=self._moved(final=True))

    def _end_segment(self) -> None:
        """Make a view of a stretch's last frame: only it shows what the camera saw last."""
        viewpoint = self.viewpoints.end_stretch(self._latest)
        if viewpoint is not None:
            self._wait(viewpoint, viewpoint.prior)
        self._fixes.forget()
        self._latest = None

    def _wait(self, viewpoint: Viewpoint, prior: PosePrior) -> None:
        """Keep a view until its partners are there; all fixes since the last one are its own."""
        self._waiting.append(viewpoint)
        self._priors[viewpoint.seq] = self._fixes.given(viewpoint.T_odom_camera, prior)

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

    # ---- reconstruction beside it ------------------------------------------------------

    def _ask_for_ready(self, everything: bool = False) -> None:
        """Hand over the views whose partners are there."""
        while self._waiting and (everything or self.viewpoints.ready(self._waiting[0])):
            viewpoint = self._waiting.popleft()
            prior = self._priors.pop(viewpoint.seq)
            if not self.viewpoints.confirmed(viewpoint):
                self.refusals["seen by two views only"] += 1
                continue
            if viewpoint.blurred:
                self.refusals["blurred"] += 1
                continue
            self._views[viewpoint.seq] = viewpoint
            self._jobs.offer(self._job(viewpoint, prior))
            self._asked.append(viewpoint)

    def _job(self, viewpoint: Viewpoint, prior: PosePrior) -> Job:
        points, _ = landmarks(viewpoint.key)
        segment = viewpoint.key.segment
        assert viewpoint.bgr is not None
        return Job(
            self._view(viewpoint),
            viewpoint.bgr,
            segment,
            prior,
            tuple(self._view(p) for p in self.viewpoints.partners(viewpoint)),
            se3.transform(se3.inverse(viewpoint.T_key_camera), points),
            viewpoint.key.covariance,
            {v.seq: v.T_odom_camera for v in self._asked if v.key.segment == segment},
        )

    def _collect(self, everything: bool = False) -> tuple[Keyframe, ...]:
        """Keyframes that are done, in order."""
        out = []
        for job, keyframe in self._jobs.finished(everything):
            viewpoint = self._views.pop(job.view.seq)
            for seq in [seq for seq in self._views if seq < viewpoint.seq]:
                del self._views[seq]  # gave way
            self._carriers.add(Anchorage(viewpoint.seq, viewpoint.key, viewpoint.T_key_camera))
            if keyframe is not None:
                out.append(keyframe)
                points = int(np.count_nonzero(keyframe.fresh & np.isfinite(keyframe.depth.depth_m)))
                self.pieces.add(keyframe.seq, job.segment, points, job.prior)
        self._carriers.settle(self.is_settled)
        return tuple(out)

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
        T_odom_camera = anchor.T_odom_camera
        carrier = self._carriers.of(anchor)
        if carrier is None:
            return Placed(anchor.key.seq, T_odom_camera, 1.0, np.eye(6), ("vision",))
        moved = se3.inverse(carrier.T_odom_camera) @ T_odom_camera
        with self.dense.lock:
            return self.dense.trajectory.ride(carrier.seq, moved)

    def is_settled(self, key: Key) -> bool:
        """True when the odometry adjusts a keyframe of its no longer."""
        window = self.odometry.keyframes
        return key.segment != self.odometry.segment or not window or key.seq < window[0].seq

    def _by_telemetry(self, seq: int, prior: PosePrior) -> Placed | None:
        """Where telemetry alone says the camera is; None without attitude, heading or position.

        Telemetry is off by as much as it was when vision was lost, so that the track goes on.
        """
        R, position, sigma = prior.R_world_camera, prior.position_m, prior.sigma_position_m
        if R is None or position is None or sigma is None or prior.sigma_yaw_rad > 1.0:
            return None
        T = se3.compose(R, position)
        if self._seen is not None:
            segment, before, seen = self._seen
            with self.dense.lock:
                is_aligned = self.dense.trajectory.similarity(segment) is not None
            if is_aligned:
                T = carried(before, prior, seen.T_world_camera, None, 0.0)
        tilt, yaw = prior.sigma_tilt_rad, prior.sigma_yaw_rad
        covariance = np.diag(np.square([tilt, tilt, yaw, *sigma]))
        told = ("attitude", "gnss", "dead reckoning")
        return Placed(seq, T, 1.0, covariance, told)

    def _moved(self, final: bool = False) -> tuple[Placed, ...]:
        with self.dense.lock:
            moved = self.dense.trajectory.moved(final)
            for placed in moved:
                self.dense.trajectory.tell(placed)
        return tuple(moved)


def _within_width(camera: Camera, width_px: int) -> Camera:
    """The camera, or its picture made smaller when it is wider than ``width_px``."""
    W, H = camera.size_px
    if width_px >= W:
        return camera
    return scaled(camera, (width_px, round(H * width_px / W)))
