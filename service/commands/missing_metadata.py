"""What a recording leaves open: its lens, its readout, and when it begins.

The lens is that of its tags, of its log, or of its own images. A lens that bends straight lines by
a few percent turns every view of level ground a little and makes it a sixth too near: the images
can be explained that way too, until the distortion is free.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Collection
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event
from typing import TYPE_CHECKING, Any

from mavlink.telemetry.history import HistoryConfig
from mavlink.telemetry.logs import TelemetryLog, gpmf, klv, load_telemetry, srt
from recon.types import Camera
from service.cameras import open_camera, parse_source
from service.cameras.camera_file import seeks_readout
from service.cameras.dji_metadata import stated_shutter
from service.cameras.images import ImagesSource
from service.cameras.lens import Lens, by_full_frame, by_view
from service.cameras.video import metadata, subtitles
from service.commands.recording_clock import RecordingClock
from service.config import change
from service.errors import InputError
from service.flight.scan import Scan, ScanInputs, check_new, create_store
from service.flight.telemetry_check import STABILISED, turned_note
from service.stream.validity import MAX_TIME_NS, is_time

if TYPE_CHECKING:  # a flight with a camera model does without calibration
    from recon.calibration.flight import SelfCalibrated, SelfCalibrationConfig
    from service.cameras.source import CameraSource
    from service.config import Config
    from service.progress import Progress

log = logging.getLogger(__name__)

VIEWS = 25
"""Number of stills about the middle of a flight, or of a video's first keyframes, that are used."""

MIN_STILLS = 6  # fewer stills do not determine a lens
MAX_FRAMES = 5400  # of a video, in which its first keyframes are sought

ASSUMED = Lens(0.5 / math.tan(math.radians(35.0)), sigma_focal=0.2)
"""70 degrees across; cameras of drones have 60 to 86."""

COARSE = {"compute.stereo_width": 320, "compute.upsample": False, "fusion.loops": False}
"""Poses are all that is needed."""

HOUR_NS = 3_600_000_000_000
HOURS = tuple(range(-12, 15))
HALF_HOURS = -9.5, -3.5, -2.5, 3.5, 4.5, 5.5, 6.5, 9.5, 10.5
"""The zones that there are; with others nearly each flight of the day would fit."""


@dataclass(frozen=True, slots=True, eq=False)
class StartLens:
    """What is known about the lens before its images are looked at."""

    camera: Camera
    note: str
    assumed: tuple[str, ...]  # of "lens", "distortion"
    search: SelfCalibrationConfig  # how the images may change it, and the focal length's sigma


def start_lens(source: CameraSource, telemetry: TelemetryLog | None) -> StartLens:
    """The lens by the images' tags, the log's focal length, or 70 degrees."""
    from service.offline.refine.own_camera import bent, by_tags

    if isinstance(source, ImagesSource) and source.lens is not None and source.camera is not None:
        f, side, known = source.lens.focal, max(source.size_px), source.lens.is_calibrated
        note = f"taken from {source.lens.source} ({f * side:.0f} px)"
        search = by_tags(source.lens.sigma_focal)
        if known:
            return StartLens(source.camera, _advice(note), (), search)
        return StartLens(source.camera, _advice(note), ("distortion",), bent(search))
    lens, of = ASSUMED, "70 degrees"
    if telemetry is not None and telemetry.focal_35mm is not None:
        lens = by_full_frame(telemetry.focal_35mm, source.size_px)
        of = f"{telemetry.focal_35mm:.0f} mm (35 mm equivalent in the telemetry)"
    if telemetry is not None and telemetry.hfov_deg is not None:
        lens = by_view(telemetry.hfov_deg, source.size_px)
        of = f"{telemetry.hfov_deg:.1f} degrees (in the telemetry)"
    note = f"a lens of {of} without distortion is assumed"
    search = bent(by_tags(lens.sigma_focal))
    return StartLens(lens.camera(source.size_px), _advice(note), ("lens",), search)


def _advice(note: str) -> str:
    return f"no camera model given: {note}; make one with 'skyrelief calibrate' for true shapes"


def with_own_lens(
    inputs: ScanInputs, video: str, start: StartLens, find_lens: bool, progress: Progress
) -> ScanInputs:
    """The scan with the lens by its own images, where they determine it, else as it is."""
    found: SelfCalibrated | str = ""
    if find_lens and parse_source(video)[0] in ("file", "images"):
        check_new(inputs.folder)
        progress("finding the lens")
        found = own_lens(inputs, video, start.search)
    if isinstance(found, str):
        refused = (f"the images do not determine their lens: {found}",) if found else ()
        notes = (start.note, *refused, *inputs.notes)
        sigma = start.search.sigma_focal
        return replace(inputs, notes=notes, assumed=start.assumed, sigma_focal=sigma)
    focal = f"{found.camera.K[0, 0]:.0f} px, sigma {100.0 * found.sigma_focal:.1f} %"
    note = f"no camera model given: found from the images themselves ({focal})"
    return replace(
        inputs,
        camera=found.camera,
        notes=(note, *inputs.notes),
        assumed=still_assumed(found),
        sigma_focal=found.sigma_focal,
    )


def own_lens(inputs: ScanInputs, video: str, search: SelfCalibrationConfig) -> SelfCalibrated | str:
    """The camera by a reconstruction of some images, or why they do not determine it.

    ``inputs`` are those of the whole scan, with the lens to begin with; ``video`` is its camera
    source, a recording or a folder of stills.
    """
    from service.offline.refine.own_camera import MIN_IMAGES
    from service.offline.refine.refinement import lens

    source, config = inputs.source, inputs.config
    if isinstance(source, ImagesSource):
        source = source.middle(VIEWS)
        if source.images < MIN_STILLS:
            return f"{source.images} stills are too few; {MIN_STILLS} needed"
    else:
        source = open_camera(video)
    for key, value in COARSE.items():
        config = change(config, key, str(value).lower())
    with closing(source), TemporaryDirectory(prefix="skyrelief-lens-") as temporary:
        folder = Path(temporary) / "scan"
        inputs = replace(
            inputs, source=source, config=config, folder=folder, scan_id="lens", warn=log.info
        )
        store = create_store(inputs)
        try:
            scan = Scan(inputs, store)
            made = scan.recorder
            scan.run(
                Event(), is_enough=lambda _: made.keyframes >= VIEWS or made.frames >= MAX_FRAMES
            )
            scan.close()
        finally:
            store.close()
        if made.keyframes < MIN_IMAGES:
            return f"{made.keyframes} keyframes are too few; {MIN_IMAGES} needed"
        try:
            return lens(folder, Path(parse_source(video)[1]), search)
        except InputError as error:
            return str(error)


def still_assumed(found: SelfCalibrated) -> tuple[str, ...]:
    """What is as good as assumed of a lens that was found: its distortion, where depth at a corner
    is bent by more than MAX_SIGMA_BEND."""
    from recon.calibration.flight import corner_bend
    from service.offline.refine.own_camera import MAX_SIGMA_BEND

    bend = corner_bend(found.camera, found.sigma_k[0])
    return ("distortion",) if bend > MAX_SIGMA_BEND else ()


def with_stated_readout(
    camera: Camera, config: Config, video: str, source: CameraSource, notes: list[str]
) -> tuple[Camera, Config]:
    """Camera and configuration with the readout that the video states, where nothing else does.

    The images refine it.
    """
    kind, path = parse_source(video)[:2]
    is_open = seeks_readout(camera, config.camera) and config.camera.readout_ms != "auto"
    if kind != "file" or not is_open or source.turned_deg != 0:
        return camera, config
    shutter = stated_shutter(path)
    if shutter is None:
        return camera, config
    readout_ms = 1e3 * shutter.readout_s
    notes.append(f"the video states a readout of {readout_ms:.1f} ms, {shutter.direction}")
    return replace(camera, shutter=shutter), change(config, "camera.readout_ms", "auto")


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """What the images of a scan correct, for a scan that is right from its start."""

    of: str  # "readout", "clock", "clock's rate", "mount", "roll"
    changed: dict[str, Any]  # of its inputs


def correction_of(
    scan: Scan, clock: RecordingClock, unsure: Collection[str], has_ended: bool = False
) -> Correction | None:
    """What the images of the scan show by now, of what is ``unsure``; None before they do.
    ``clock`` is that of its recording."""
    if has_ended:
        scan.check.finish()
    off_ms = clock.off_ms(has_ended) if "clock" in unsure else None
    if off_ms is not None:
        return Correction("clock", at_another_time(scan.inputs, off_ms))
    rate = clock.rate(has_ended) if "clock's rate" in unsure else None
    if rate is not None:
        return Correction("clock's rate", at_another_rate(scan.inputs, rate))
    if "mount" in unsure and scan.check.is_stabilised:
        config = change(scan.inputs.config, "camera.mount", "gimbal")
        notes = (*scan.inputs.notes, STABILISED)
        return Correction("mount", {"config": config, "notes": notes})
    if "roll" in unsure and (roll_deg := scan.check.image_roll_deg):
        config = change(scan.inputs.config, "camera.image_roll_deg", f"{roll_deg:.0f}")
        notes = (*scan.inputs.notes, turned_note(roll_deg))
        return Correction("roll", {"config": config, "notes": notes})
    shutter = scan.found_shutter() if "readout" in unsure else None
    if shutter is None:
        return None
    camera = replace(scan.inputs.camera, shutter=shutter)
    config = change(scan.inputs.config, "camera.readout_ms", "auto")  # the search goes on
    return Correction("readout", {"camera": camera, "config": config})


def start_of(
    source: CameraSource, log: TelemetryLog | None, video_epoch: float | None, notes: list[str]
) -> tuple[int, int, bool]:
    """The source's time 0 on the log's clock, from that clock to unix time, in ns, and whether the
    start of a log with a clock of its own is taken for want of better.

    The source's time 0 is as given, the date of the log in it, the container's, the log's start, or
    now. A log without a date begins with the source, unless the time that is given is one of the
    log's own clock.
    """
    is_dated = log is None or log.clock == "unix"
    is_assumed = False
    stated_ns = None if log is None else log.start_unix_ns
    if stated_ns is not None and not is_time(stated_ns):
        stated_ns = None  # a clock that was never set, or a spoilt one
    if video_epoch is not None:
        start_ns = round(video_epoch * 1e9) if math.isfinite(video_epoch) else MAX_TIME_NS
    elif stated_ns is not None:
        start_ns = stated_ns
    elif source.epoch_unix_ns is not None:
        start_ns = source.epoch_unix_ns
        start_ns -= local_zone_ns(start_ns, log, notes) if is_dated else 0
    elif log is not None and is_dated:
        start_ns = round(log.first_ns / 1e6) * 10**6  # autopilots count whole milliseconds
        is_assumed = True
        notes.append("the recording does not say when it began: taken as the start of the log")
    else:
        start_ns = time.time_ns()
        notes.append("the recording does not say when it began: taken as the time of the replay")
    if not is_time(start_ns):
        raise InputError(
            "the recording begins outside the years 1970 to 2106; give the right --video-epoch"
        )
    is_of_log = video_epoch is not None and log is not None and _covers(log, start_ns)
    if log is not None and not is_dated and not is_of_log:
        zero_ns = 0 if log.clock == "video" else log.first_ns
        if stated_ns is None:
            notes.append("the log has no date: it begins with the recording")
        return zero_ns, start_ns - zero_ns, log.clock != "video"
    if log is not None and not _covers(log, start_ns):
        raise InputError(
            f"the telemetry covers {_utc(log.first_ns)} to {_utc(log.last_ns)}, the video begins "
            f"at {_utc(start_ns)}: they do not overlap; give the right --video-epoch"
        )
    return start_ns, 0, is_assumed


def _covers(log: TelemetryLog, start_ns: int) -> bool:
    """True when a video that starts then can be in the log."""
    return log.first_ns - 600e9 < start_ns < log.last_ns


def local_zone_ns(start_ns: int, log: TelemetryLog | None, notes: list[str]) -> int:
    """The hours by which a camera's local time is ahead of the log's UTC; 0 where it is not.

    Cameras write their local time where the format asks for UTC.
    """
    if log is None or _covers(log, start_ns):
        return 0
    for zones in (HOURS, (*HOURS, *HALF_HOURS)):
        fitting = [h for h in zones if _covers(log, start_ns - round(h * HOUR_NS))]
        if len(fitting) == 1:
            (hours,) = fitting
            notes.append(f"the camera's clock is {hours:+g} h off the log's: taken as local time")
            return round(hours * HOUR_NS)
    return 0


def _utc(time_ns: int) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(time_ns / 1e9))


def at_another_time(inputs: ScanInputs, off_ms: float) -> dict[str, Any]:
    """Inputs of the scan of a video whose stamps are late by ``off_ms``.

    Where the log has no date, the video keeps its own.
    """
    off_ns, offset_ns = round(1e6 * off_ms), inputs.unix_offset_ns
    word = "before" if off_ms > 0 else "after"
    of = "start that was assumed" if "start" in inputs.assumed else "time that it states"
    note = (
        f"the video begins {1e-3 * abs(off_ms):.2f} s {word} the {of}, as its images turn with the "
        "log: applied"
    )
    return {
        "epoch_ns": inputs.epoch_ns - off_ns,
        "unix_offset_ns": offset_ns and offset_ns + off_ns,
        "notes": (*inputs.notes, note),
    }


def at_another_rate(inputs: ScanInputs, rate: float) -> dict[str, Any]:
    """Inputs of the scan of a video whose clock gains ``rate`` seconds in each of the log's: the
    log's times become those of the video, from its beginning on."""
    assert inputs.history is not None
    word = "fast" if rate > 0 else "slow"
    note = (
        f"the video's clock runs {100.0 * abs(rate):.2f} % too {word}, as its images turn with the "
        "log: applied"
    )
    history = inputs.history.at_rate(rate, inputs.epoch_ns)
    return {"history": history, "notes": (*inputs.notes, note)}


def load_log(path: Path, config: Config) -> TelemetryLog:
    """The flight log of a file; InputError for one that cannot be used."""
    try:
        return load_telemetry(path, HistoryConfig(yaw_frame=config.mavlink.gimbal_yaw_frame))
    except ValueError as error:
        raise InputError(str(error)) from error


def own_telemetry(video: str, config: Config) -> TelemetryLog | None:
    """The telemetry of a video: in subtitles next to it, under its name, or in the video."""
    kind, name = parse_source(video)[:2]
    if kind != "file":
        return None
    places = [Path(name).with_suffix(end) for end in (".SRT", ".srt")]
    path = next((place for place in places if place.is_file()), None)
    history = HistoryConfig(yaw_frame=config.mavlink.gimbal_yaw_frame)
    try:
        if path is not None:
            found, where = load_telemetry(path, history), f"{path.name}, next to the video"
        elif (inside := telemetry_inside(Path(name), history)) is not None:
            found, where = inside
        else:
            return None
    except (InputError, ValueError) as error:
        log.warning("no telemetry: %s", error)
        return None
    return replace(found, warnings=(f"telemetry from {where}", *found.warnings))


def telemetry_inside(path: Path, config: HistoryConfig) -> tuple[TelemetryLog, str] | None:
    """The telemetry in a video's own streams, and their kind in words; None without any.

    Raises ValueError where they hold none that can be used.
    """
    cues = subtitles(path)
    if (cue := next(cues, None)) is not None:
        return srt.of_cues(path, chain((cue,), cues), config), "the video's own subtitles"
    is_marked = False

    def is_wanted(packet: bytes) -> bool:
        """Of a video's several streams of KLV, some hold times or targets alone."""
        nonlocal is_marked
        is_marked = is_marked or packet.startswith(klv.MARK)
        return packet.startswith(gpmf.MARK) or bool(klv.samples_of(klv.fields_of(packet)))

    packets = metadata(path, is_wanted)
    if (packet := next(packets, None)) is None:
        if is_marked:
            raise ValueError(f"{path}: no attitude and no position of a vehicle in its metadata")
        return None
    every = chain((packet,), packets)
    if packet[2].startswith(gpmf.MARK):
        return gpmf.of_packets(path, every, config), "the camera's own track (GPMF)"
    return klv.of_packets(path, every, config), "the video's own metadata (MISB KLV)"
