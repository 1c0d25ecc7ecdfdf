"""One scan, from the first frame of a camera to the closed folder: mapper, telemetry and store."""

from __future__ import annotations

import gc
import logging
import math
import os
import secrets
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Event
from typing import Any

from mavlink.telemetry.history import VehicleHistory
from mavlink.telemetry.samples import VehicleState
from recon.backends import Backend
from recon.calibration.adjusted_track import AdjustedTrack
from recon.pipeline.mapper import Event as MapperEvent
from recon.pipeline.mapper import FramePosed
from recon.posegraph.pose_priors import VelocityIntegrator
from recon.tracking.frame import Frame
from recon.types import Camera, Keyframe, Pose, PosePrior, Shutter
from service.cameras.camera_file import shutter_document, with_shutter
from service.cameras.lens import MAX_FOCAL
from service.cameras.rig import ASSUMED_AGL_M, Rig, turn_sigma_rad_s
from service.cameras.source import CameraFrame, CameraSource, ahead
from service.config import ComputeConfig, Config
from service.errors import InputError
from service.flight.pipeline import Pipeline, spacing_of
from service.flight.recorder import REPLAYED, TAGS_FILE, FrameTags, Recorder
from service.flight.reports import TrackingWatch, blur_note, blur_warning, motion_blur
from service.flight.telemetry_check import TelemetryCheck
from service.redaction import public_configuration, redacted
from service.scans.coverage import covering
from service.scans.retention import PAGES
from service.stream.records import ScanHeader
from service.stream.store import ScanStore
from service.version import software

log = logging.getLogger(__name__)

TIME_STEP_NS = 100_000  # frame times are rounded to this; no camera's clock is finer

MIN_FOCAL_OFF, FOCAL_OFF_SIGMAS = 0.01, 4.0
"""A focal length by the images that differs by both is another one than the camera model's."""


@contextmanager
def short_collections() -> Iterator[None]:
    """The collector of garbage looks only at what is made inside. To look at all that a process has
    loaded stops every thread for 50 ms and more."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


@dataclass(frozen=True, slots=True, eq=False)
class ScanInputs:
    source: CameraSource
    camera: Camera
    config: Config
    backend: Backend
    folder: Path
    scan_id: str
    epoch_ns: int  # of the frames' time 0, on the history's clock
    unix_offset_ns: int = 0  # history's clock to unix time
    history: VehicleHistory | None = None
    notes: tuple[str, ...] = ()
    assumed: tuple[str, ...] = ()  # of "lens", "distortion", "start" (on the history's clock)
    sigma_focal: float = 0.0  # of the focal length, as a share; 0: a calibrated camera
    extra: dict[str, Any] = field(default_factory=dict)  # goes into scan.json
    latency_ms: float | None = None  # the camera's as an earlier scan found it
    known: AdjustedTrack | None = None  # takes the odometry's place
    warn: Callable[[str], None] = log.warning  # the operator
    on_frame: Callable[[FramePosed, VehicleState | None], None] | None = None
    on_keyframe: Callable[[Keyframe], None] | None = None
    on_photo: Callable[[Frame], None] | None = None  # its prior is its tag


def check_new(folder: Path) -> Path:
    """The database of a scan to be made in ``folder``; InputError when it holds one already."""
    path = folder / "scan.db"
    if os.path.exists(path):
        raise InputError(f"{folder} already holds a scan; give another --out, nothing was changed")
    return path


def create_store(inputs: ScanInputs) -> ScanStore:
    """The scan's folder and database; InputError when it holds a scan already."""
    path = check_new(inputs.folder)
    W, H = inputs.camera.size_px
    # Poses have the times of exposures. Whoever looks up an image by its pose's time finds it.
    start_ns = inputs.epoch_ns + inputs.unix_offset_ns
    start_ns -= round(1e6 * inputs.config.camera.latency_ms)
    header = ScanHeader(
        scan_id=inputs.scan_id,
        drone=inputs.config.scan.drone_name,
        started_unix_ns=max(start_ns, 0),
        camera={
            "width": W,
            "height": H,
            "K": inputs.camera.K.ravel().tolist(),
            "distortion": inputs.camera.distortion.tolist(),
            **shutter_document(with_shutter(inputs.camera, inputs.config.camera).shutter),
        },
        configuration=public_configuration(inputs.config.to_dict()),
        software=software(),
        notes=redacted(inputs.notes),
        run_id=secrets.token_hex(16),
    )
    return ScanStore.create(path, header)


class Scan:
    """Runs frames through the pipeline into the store until the source ends or a stop."""

    def __init__(self, inputs: ScanInputs, store: ScanStore) -> None:
        self.inputs, self.store, self.source = inputs, store, inputs.source
        self.epoch_ns = inputs.epoch_ns
        config, live, pages = inputs.config, inputs.source.is_live, inputs.folder / PAGES
        self.pipeline = Pipeline(
            inputs.camera, config, inputs.backend, pages, live=live, known=inputs.known
        )  # fmt: skip
        self.mapper, self.worker = self.pipeline.mapper, self.pipeline.worker
        self.rig = Rig(config.camera, config.scan, config.fusion)
        if inputs.history is not None:
            self.rig.vertical_datum = inputs.history.vertical_datum
            self.rig.is_pressure_altitude = inputs.history.is_pressure_altitude
        self._velocity = VelocityIntegrator()
        self.recorder = Recorder(
            store,
            self.pipeline,
            self.rig,
            inputs.unix_offset_ns,
            inputs.on_keyframe,
            batch=1 if live else REPLAYED,
        )
        self.check = TelemetryCheck(
            inputs.config.camera, inputs.history, inputs.warn, inputs.latency_ms
        )
        self.tracking = TrackingWatch(inputs.warn)
        self._is_blur_reported = False
        self.tags = FrameTags(inputs.folder / TAGS_FILE) if inputs.history is not None else None
        self.tagged = self.odd_sized = self.heights = self.attitudes = 0
        self._photos: deque[None] = deque()  # one for each that was asked for
        self._started = time.monotonic()

    def configure(self, config: Config, compute: ComputeConfig) -> None:
        """Apply the keys of ``config`` that change in flight, with the ``compute`` of its load."""
        self.check.set_camera(config.camera)
        self.mapper.set_spacing(spacing_of(config.scan))  # from the next frame on
        self.mapper.set_effort(compute.pairs, compute.stereo_width, compute.upsample)

    def take_photo(self) -> None:
        """Hand out the next frame as a photo; it becomes a keyframe where it has partners."""
        self._photos.append(None)
        self.mapper.take_next()

    def feed(self, frame: CameraFrame) -> FramePosed | None:
        """One frame through the pipeline; None when its size is not the camera's."""
        inputs = self.inputs
        if frame.size_px != inputs.camera.size_px:
            self.odd_sized += 1
            return None
        time_ns = self.epoch_ns + frame.time_ns
        exposed_ns = self.check.exposed_ns(time_ns)
        # Containers round times by up to 11 us; rounded alike, a pipe and a file agree.
        exposed_ns = round(exposed_ns / TIME_STEP_NS) * TIME_STEP_NS
        state = inputs.history.state_at(exposed_ns) if inputs.history is not None else None
        self.tagged += state is not None
        if self.tags is not None:
            self.tags.write(exposed_ns + inputs.unix_offset_ns, state)
        prior = self.rig.prior(state, frame.geotag)
        self.heights += not prior.is_agl_assumed
        self.attitudes += not prior.is_view_assumed
        prior = self._velocity.add(exposed_ns, prior)
        if self.mapper.odometry.needs_turn(exposed_ns):
            prior = self._turning(prior, exposed_ns)
        is_photo = bool(self._photos)
        events: tuple[MapperEvent, ...] = ()
        if not is_photo:
            events = self.mapper.skip(frame.seq, exposed_ns, prior)
        if not events:
            events = self.mapper.track(Frame(frame.image, exposed_ns, frame.seq, prior))
        posed = events[-1]
        assert isinstance(posed, FramePosed)
        self.check.add(time_ns, posed.frame)
        self.rig.is_stabilised = self.check.is_stabilised
        if self.check.image_roll_deg != self.rig.image_roll_deg:
            self.rig.turn_images(self.check.image_roll_deg)
        self.tracking.add(posed.frame, time_ns)
        self.report_blur()
        for doubt in self.pipeline.new_doubts():
            inputs.warn(doubt)
        self.recorder.write(events, state.alt_agl_m if state is not None else None)
        if is_photo:
            photo = Frame(frame.image, exposed_ns, frame.seq, prior)
            self._hand_out(photo, posed.pose, state.alt_agl_m if state is not None else None)
        if inputs.on_frame is not None:
            inputs.on_frame(posed, state)
        return posed

    @property
    def motion_blur(self) -> dict[str, Any] | None:
        """The strongest blur so far, fit for JSON; None while the images are sharp."""
        finer = float(self.inputs.camera.K[0, 0] / self.mapper.odometry.K[0, 0])
        return motion_blur(self.mapper.views.exposure_time, finer)

    def report_blur(self) -> None:
        """Report to the operator once that the images are blurred, and by what."""
        if not self._is_blur_reported and (blur := self.motion_blur) is not None:
            self._is_blur_reported = True
            self.inputs.warn(blur_warning(blur))

    def _hand_out(self, frame: Frame, pose: Pose | None, agl_m: float | None) -> None:
        """A photo, tagged by telemetry, or by vision where telemetry does not tell."""
        self._photos.popleft()
        prior = frame.prior
        R = None if prior.is_view_assumed else prior.R_world_camera
        position = prior.position_m
        if pose is not None and (R is None or position is None):
            R, position = pose.T_world_camera[:3, :3], pose.T_world_camera[:3, 3]
        if self.inputs.on_photo is not None:
            tag = PosePrior(R_world_camera=R, position_m=position, agl_m=agl_m)
            self.inputs.on_photo(replace(frame, prior=tag))

    def _turning(self, prior: PosePrior, exposed_ns: int) -> PosePrior:
        """The prior with the camera's turn about the moment of exposure, by telemetry."""
        history = self.inputs.history
        if history is None:
            return prior
        turn = self.rig.turn_at(history.state_at, exposed_ns)
        if turn is None:
            return prior
        sigma = turn_sigma_rad_s(history.gap_s(exposed_ns), self.check.doubt_s)
        return replace(prior, turn_rad_s=turn, sigma_turn_rad_s=sigma)

    def run(
        self,
        stop: Event,
        progress: Callable[[Scan], None] | None = None,
        paused: Event | None = None,
        is_enough: Callable[[Scan], object] = lambda scan: False,
    ) -> None:
        """Feed every frame of the source until it ends, ``stop`` is set or it ``is_enough``. Frames
        that come while ``paused`` is set are passed over. A recording is decoded ahead."""
        live = self.source.is_live
        quiet = short_collections() if live else nullcontext()  # stops do a replay no harm
        coverage = covering(self.store) if live else nullcontext()
        source = nullcontext(self.source) if live else closing(ahead(self.source))
        with quiet, coverage, source as frames:
            for frame in frames:
                if stop.is_set():
                    log.info("stopped; closing the scan")
                    break
                if paused is not None and paused.is_set():
                    continue
                self.feed(frame)
                if progress is not None:
                    progress(self)
                if is_enough(self):
                    break

    def close(self) -> dict[str, Any]:
        """Write the remaining results and close the scan in the store; return its figures."""
        elapsed = max(time.monotonic() - self._started, 1e-9)
        self.check.finish()
        if self.tags is not None:
            self.tags.close()
        self.recorder.flush()
        extra = self.check.summary() | {
            "frames_tagged": self.tagged,
            "frames_of_another_size": self.odd_sized,
            "seconds": round(elapsed, 2),
            "warnings": [*self.inputs.notes, *self.inputs.source.warnings, *self._doubts()],
        }
        extra["assumed"] = self._assumed()
        off, by_images = self._focal_by_images()
        extra["sigma_focal"] = round(max(self.inputs.sigma_focal, abs(off)), 4)
        extra["focal_by_images"] = by_images
        extra["camera_readout"] = self._readout()
        extra["motion_blur"] = self.motion_blur
        shutter = self.found_shutter()
        if shutter is not None:
            camera = self.store.header.camera | shutter_document(shutter)
            self.store.update_header(camera=camera)
        extra["clouds_per_second"] = round(self.mapper.pairs / elapsed, 2)
        return self.recorder.close(redacted(extra | self.inputs.extra))

    def discard(self) -> None:
        """End the scan and delete its store; another one may be made in its folder."""
        if self.tags is not None:
            self.tags.close()
        self.store.close()
        self.store.path.unlink()

    def found_shutter(self) -> Shutter | None:
        """The shutter by the images; None where it was not sought or is not sure."""
        search = self.mapper.odometry.readout
        if search is None or not search.is_sure:
            return None
        camera = with_shutter(self.inputs.camera, self.inputs.config.camera)
        return camera.shutter.reading(search.readout_s)

    def _focal_by_images(self) -> tuple[float, dict[str, Any] | None]:
        """Share by which the images contradict the focal length, 0 where they do not; and the
        change that they ask for, None where they show none."""
        found = self.mapper.focal.estimate
        if found is None:
            return 0.0, None
        change, sigma, windows = found
        limit = FOCAL_OFF_SIGMAS * math.hypot(sigma, self.inputs.sigma_focal)
        off = change if abs(change) > max(MIN_FOCAL_OFF, limit) else 0.0
        return off, {"change": round(change, 4), "sigma": round(sigma, 4), "windows": windows}

    def _readout(self) -> dict[str, Any] | None:
        """The readout by the images; None where it was not sought or does not show."""
        search = self.mapper.odometry.readout
        if search is None or not search.windows:
            return None
        return {
            "estimate_ms": round(1e3 * search.readout_s, 2),
            "sigma_ms": round(1e3 * search.sigma_s, 2),
            "windows": search.windows,
            "is_sure": search.is_sure,
        }

    def _assumed(self) -> list[str]:
        """What was assumed in this scan: "lens", "distortion", "start" unless turns confirm it,
        "view", "level", "height", "altitude", with "pressure" where air pressure gave it and
        "no altitude" where nothing did, and with a narrow view "turn", as vision alone cannot
        separate it from distance."""
        out = [w for w in self.inputs.assumed if w != "start" or not self.check.is_clock_sure]
        if self.attitudes == 0 or self.check.is_stabilised:
            out.append("view")
        if self.mapper.keyframe_map.is_levelled:
            out.append("level")
        if self.heights == 0 and self.rig.georeference == "none":
            out.append("height")
        if self.rig.is_altitude_missing:
            out += ["altitude", "no altitude"]
        elif self.rig.is_altitude_assumed:
            out += ["altitude", "pressure"] if self.rig.is_pressure_altitude else ["altitude"]
        if self.inputs.camera.K[0, 0] > MAX_FOCAL * max(self.inputs.camera.size_px):
            out.append("turn")
        return out

    def _doubts(self) -> list[str]:
        """Notes for the reader of this scan."""
        out = [*self.check.reported.values(), *self.pipeline.watch.sentences()]
        if self.odd_sized:
            W, H = self.inputs.camera.size_px
            out.append(f"{self.odd_sized} frames were not {W}x{H} like the camera model: left out")
        if self.inputs.history is not None and self.tagged == 0 and self.recorder.frames:
            out.append("no frame lies inside the telemetry: poses rest on vision alone")
        if (blur := self.motion_blur) is not None:
            out.append(blur_note(blur))
        shutter = self.found_shutter()
        if shutter is not None and self.inputs.known is None:
            out.append(
                f"the images show a readout of {1e3 * shutter.readout_s:.1f} ms, "
                f"{shutter.direction}: set camera.readout_ms and camera.readout_direction"
            )
        off, _ = self._focal_by_images()
        if off:
            by = f"{abs(off):.1%}" if abs(off) < 0.5 else "more than half"
            out.append(
                f"the images show a focal length that is {by} "
                f"{'longer' if off > 0 else 'shorter'} than the camera model's: calibrate the "
                "camera as it records"
            )
        frames = self.recorder.frames
        if frames and "height" in self._assumed():
            out.append(
                f"no telemetry: the scale assumes {ASSUMED_AGL_M:g} m above ground; "
                "set scan.assumed_agl_m to the true height"
            )
        apart = self.mapper.keyframe_map.apart()
        if apart:
            out.append(
                f"left out of the cloud: {len(apart)} of {self.mapper.segments} "
                "segments of the flight, which neither loops nor fixes of known height and scale "
                "tie to the rest; fly with more overlap, or with GNSS that states its accuracy"
            )
        false = sum(len(s.surface) for s in self.mapper.keyframe_map.graph.segments.false())
        if false:
            out.append(
                f"left out of the cloud: {false} of {self.recorder.keyframes} keyframes, as the "
                "depths of most views of the same segment contradict each other"
            )
        if frames and self.recorder.keyframes == false:
            top = self.mapper.refusals().most_common(2)
            why = "; ".join(f"{reason} ({n})" for reason, n in top) or "too few frames"
            few = f"{frames} image{'s' * (frames > 1)}, three that overlap are needed; "
            out.append(f"nothing was reconstructed: {few if frames < 3 else ''}{why}")
        return out
