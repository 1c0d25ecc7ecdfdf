"""Stills with a flight log, adjusted all together before any depth is made of them.

Stills come too slowly to show how the camera turns while its rolling shutter reads, and when they
were taken is often known to some tenths of a second. So they are tracked once for their latency,
then matched at full size and adjusted with what the log says.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from mavlink.telemetry.history import VehicleHistory
from mavlink.telemetry.latency import LatencyEstimate
from recon.calibration.adjusted_track import AdjustedTrack, adjusted_still
from recon.calibration.global_bundle import Knowledge
from recon.calibration.joint_adjustment import JointAdjustment, Turning, adjust_jointly
from recon.calibration.tracks import pieces
from recon.camera_model import scaled
from recon.parallel import limit_threads
from recon.pipeline.mapper import Mapper
from recon.rolling_shutter import RowClock, Rows
from recon.tracking.frame import Frame, Landmarks
from recon.types import F64, U8, Camera, PosePrior
from service.cameras.camera_file import seeks_readout, with_shutter
from service.cameras.images import ImagesSource
from service.cameras.rig import Rig, turn_sigma_rad_s
from service.config import change
from service.errors import InputError
from service.flight.pipeline import mapper_config
from service.flight.scan import ScanInputs, check_new
from service.flight.telemetry_check import TelemetryCheck
from service.offline.refine.own_camera import sightings
from service.scans.trust import is_another_latency

log = logging.getLogger(__name__)

MIN_STILLS, MAX_STILLS = 6, 200
"""Fewer determine nothing; the images of more do not fit into memory."""

WIDTH_PX = 1920  # width at which stills are matched, at most
FIX_SIGMAS = 2.0  # what errors of fixes count for: they are common to neighbours

FASTER, SLACK_SIGMAS = 2.0, 5.0
"""Times the vehicle's highest speed that the track between two stills may have, and sigmas of a
fix by which it may exceed that."""


@dataclass(frozen=True, slots=True, eq=False)
class Still:
    """One image with its telemetry, its pose all known."""

    seq: int
    gray: U8  # (H, W) distorted, WIDTH_PX wide at most
    time_ns: int  # its stamp, since the source's time 0
    is_tracked: bool  # by the odometry


def adjusted_stills(
    inputs: ScanInputs, is_latency_given: bool, progress: Callable[[str], None] = log.info
) -> ScanInputs:
    """The scan with the stills' latency, lens, shutter and poses, as far as they are found.

    ``is_latency_given``: by the operator, and kept.
    """
    source, history = inputs.source, inputs.history
    if not isinstance(source, ImagesSource) or history is None:
        return inputs
    if not MIN_STILLS <= source.images <= MAX_STILLS:
        return inputs
    check_new(inputs.folder)
    progress("adjusting all stills together")
    stills, latency = _tracked(inputs, source, history)
    is_late = latency is not None and is_another_latency(latency.latency_ms, latency.sigma_ms, 0.0)
    if latency is not None and is_late and not is_latency_given:
        note = (
            f"the images show that the stills' times are late by {latency.latency_ms:.0f} ms "
            f"(sigma {latency.sigma_ms:.0f} ms): corrected"
        )
        # The scan's start moves, so that whoever looks up an image by its time finds it.
        epoch_ns = inputs.epoch_ns - round(1e6 * latency.latency_ms)
        inputs = replace(inputs, epoch_ns=epoch_ns, notes=(*inputs.notes, note))
    try:
        return _adjusted(inputs, stills, history)
    except (ValueError, RuntimeError, MemoryError, np.linalg.LinAlgError, InputError) as error:
        log.info("the stills are not adjusted together: %s", error)
        return inputs


def _tracked(
    inputs: ScanInputs, source: ImagesSource, history: VehicleHistory
) -> tuple[list[Still], LatencyEstimate | None]:
    """The stills by the odometry, and how long before its stamp each was exposed."""
    limit_threads(inputs.config.compute.threads)
    camera = with_shutter(inputs.camera, inputs.config.camera)
    mapper = Mapper(camera, mapper_config(camera, inputs.config), inputs.backend)
    rig = Rig(inputs.config.camera, inputs.config.scan, inputs.config.fusion)
    check = TelemetryCheck(inputs.config.camera, history, log.info)
    out = list[Still]()
    for frame in source:
        time_ns = inputs.epoch_ns + frame.time_ns
        state = history.state_at(check.exposed_ns(time_ns))
        prior = rig.prior(state, frame.geotag)
        undistorted = mapper.undistort(Frame(frame.image, time_ns, frame.seq, prior))
        *late, tracked = mapper.locate(undistorted)
        check.add(time_ns, tracked)
        if late:
            out[-1] = replace(out[-1], is_tracked=True)
        gray = cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
        H, W = gray.shape
        if W > WIDTH_PX:
            size = WIDTH_PX, round(H * WIDTH_PX / W)
            gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
        small = np.asarray(gray, np.uint8)
        out.append(Still(frame.seq, small, frame.time_ns, tracked.is_placed))
    check.finish()
    return out, check.latency


def _adjusted(inputs: ScanInputs, stills: Sequence[Still], history: VehicleHistory) -> ScanInputs:
    """The scan by the stills' adjustment, where it places as many as the odometry does.

    Raises ValueError where it does not, or where the shutter is global.
    """
    config = inputs.config
    full = with_shutter(inputs.camera, config.camera)
    seeks = seeks_readout(full, config.camera)
    if not seeks and not full.shutter.readout_s:
        raise ValueError("its shutter is global")
    rig = Rig(config.camera, config.scan, config.fusion)
    start_ns = inputs.epoch_ns - round(1e6 * config.camera.latency_ms)
    known = []
    for still in stills:
        time_ns = start_ns + still.time_ns
        prior = rig.prior(history.state_at(time_ns), None)
        turn = rig.turn_at(history.state_at, time_ns)
        if prior.position_m is not None and prior.velocity_m_s is not None and turn is not None:
            known.append((still, replace(prior, turn_rad_s=turn)))
    least = sum(still.is_tracked for still in stills)
    if len(known) < max(least, MIN_STILLS):
        raise ValueError(f"the log places {len(known)} of {len(stills)}")
    priors = [prior for _, prior in known]
    H, W = known[0][0].gray.shape
    camera = scaled(full, (W, H))
    poses = np.tile(np.eye(4), (len(priors), 1, 1))
    poses[:, :3, :3] = np.array([p.R_world_camera for p in priors])
    poses[:, :3, 3] = np.array([p.position_m for p in priors])
    ground_m = float(np.median(poses[:, 2, 3] - [prior.agl_m or 0.0 for prior in priors]))
    images = {k: still.gray for k, (still, _) in enumerate(known)}
    views = sightings(images, camera, poses, ground_m)
    found = adjust_jointly(
        camera, views.poses, views.seen,
        _knowledge(priors, poses, int(views.seen.landmark.max()) + 1),
        _turning(priors, poses, history), seeks,
    )  # fmt: skip
    piece = pieces(found.seen, len(known))
    tied = np.flatnonzero(piece == np.bincount(piece).argmax())
    if len(tied) < least:
        raise ValueError(f"{len(tied)} of {len(stills)} are tied, {least} are tracked")
    times_s = 1e-9 * np.array([still.time_ns for still, _ in known])
    if is_torn(found.poses[tied], times_s[tied], [priors[k] for k in tied]):
        raise ValueError("they would move faster than the vehicle: a fix is far off")
    log.info(
        "%d stills adjusted together: readout %.1f ms, sigma %.1f ms, %.2f px",
        len(tied), 1e3 * found.readout_s, 1e3 * found.sigma_readout_s, found.sigma_px,
    )  # fmt: skip
    lens = scaled(found.camera, full.size_px)
    return replace(
        inputs, camera=lens, config=change(config, "camera.readout_ms", "model"),
        notes=(*inputs.notes, _note(full, lens, found, seeks)),
        known=_track(found, {known[k][0].seq: int(k) for k in tied}, lens),
    )  # fmt: skip


def is_torn(poses: F64, times_s: F64, priors: Sequence[PosePrior]) -> bool:
    """True where a track (N, 4, 4) is faster than the vehicle ever was by its log.

    A fix that is off by more than the height starts a still where it does not find its place.
    """
    apart_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    speeds_m_s = np.linalg.norm(np.array([p.velocity_m_s for p in priors]), axis=1)
    sigma_m = np.array([p.sigma_position_m for p in priors]).max()
    reach_m = FASTER * speeds_m_s.max() * np.diff(times_s) + SLACK_SIGMAS * sigma_m
    return bool((apart_m > reach_m).any())


def _knowledge(priors: Sequence[PosePrior], poses: F64, points: int) -> Knowledge:
    """Fixes and attitudes of the log."""
    out = Knowledge.none(len(priors), points)
    out.fixes[:], out.attitudes[:] = poses[:, :3, 3], poses[:, :3, :3]
    out.sigma_fixes[:] = FIX_SIGMAS * np.array([p.sigma_position_m for p in priors])
    sigmas = [(p.sigma_tilt_rad, p.sigma_tilt_rad, p.sigma_yaw_rad) for p in priors]
    out.sigma_attitudes[:] = np.array(sigmas)
    return out


def _turning(priors: Sequence[PosePrior], poses: F64, history: VehicleHistory) -> Turning:
    """How the camera moved at each exposure, by the log."""
    turns = np.array([p.turn_rad_s for p in priors])
    speeds = np.array([p.velocity_m_s for p in priors])
    in_camera = np.einsum("nji,nj->ni", poses[:, :3, :3], speeds)
    gap_s = 1e-9 * float(np.median(np.diff([t for _, t in history.attitudes()])))
    return Turning(-np.column_stack([turns, in_camera]), turn_sigma_rad_s(gap_s))


def _track(found: JointAdjustment, views: dict[int, int], lens: Camera) -> AdjustedTrack:
    """The track of ``views``: rows of ``found`` by the number of the frame."""
    known = np.asarray(np.isfinite(found.points).all(axis=1))
    number, shown = np.cumsum(known) - 1, known[found.seen.landmark]
    clock, ground, stills = RowClock(lens), Landmarks(), dict[int, Frame]()
    ground.add(found.points[known])
    for seq, k in views.items():
        spread = np.zeros((6, 6))
        spread[:3, :3] = found.turn_covariances[k]
        rows = Rows(clock, found.rates[k], np.zeros(6), spread)
        stills[seq] = adjusted_still(
            seq, found.poses[k], found.steps[k], rows if lens.shutter.readout_s else None,
            number[found.seen.landmark[shown & (found.seen.view == k)]], ground,
        )  # fmt: skip
    return AdjustedTrack(stills, lens, found.sigma_readout_s)


def _note(before: Camera, lens: Camera, found: JointAdjustment, was_sought: bool) -> str:
    """What the operator learns of the lens and its readout."""
    out = "all stills were adjusted together with the log"
    change_share = lens.K[0, 0] / before.K[0, 0] - 1.0
    out += f": focal length {before.K[0, 0]:.0f} px, {100.0 * change_share:+.1f} %"
    if was_sought and lens.shutter.readout_s:
        readout_ms, sigma_ms = 1e3 * lens.shutter.readout_s, 1e3 * found.sigma_readout_s
        way = lens.shutter.direction
        out += f"; a readout of {readout_ms:.0f} ms (sigma {sigma_ms:.0f} ms), {way}, is applied"
    return out
