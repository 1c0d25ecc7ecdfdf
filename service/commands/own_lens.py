"""The lens of a recording without a camera model: by its tags, its log, or its own images.

A lens that bends straight lines by a few percent turns every view of level ground a little and
makes it a sixth too near: the images can be explained that way too, until the distortion is free.
"""

from __future__ import annotations

import logging
import math
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event
from typing import TYPE_CHECKING

from service.cameras import open_camera, parse_source
from service.cameras.images import ImagesSource
from service.cameras.lens import Lens, by_full_frame
from service.config import change
from service.errors import InputError
from service.offline.refine.own_camera import MAX_SIGMA_BEND, MIN_IMAGES, bent, by_tags

if TYPE_CHECKING:
    from mavlink.telemetry.logs import TelemetryLog
    from recon.calibration.flight import SelfCalibrated, SelfCalibrationConfig
    from recon.types import Camera
    from service.cameras.source import CameraSource
    from service.flight.scan import Scan, ScanInputs

log = logging.getLogger(__name__)

VIEWS = 25
"""Number of stills about the middle of a flight, or of a video's first keyframes, that are used."""

MIN_STILLS = 6
"""Fewer stills do not determine a lens."""

MAX_FRAMES = 5400
"""Of a video, in which its first keyframes are sought."""

ASSUMED = Lens(0.5 / math.tan(math.radians(35.0)), sigma_focal=0.2)
"""70 degrees across; cameras of drones have 60 to 86."""

COARSE = {"compute.stereo_width": 320, "compute.upsample": False, "fusion.loops": False}
"""Poses are all that is needed."""


@dataclass(frozen=True, slots=True, eq=False)
class StartLens:
    """What is known about the lens before its images are looked at."""

    camera: Camera
    note: str
    assumed: tuple[str, ...]  # of "lens", "distortion"
    search: SelfCalibrationConfig  # how the images may change it, and the focal length's sigma


def start_lens(source: CameraSource, telemetry: TelemetryLog | None) -> StartLens:
    """The lens by the images' tags, the log's focal length, or 70 degrees."""
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
    note = f"a lens of {of} without distortion is assumed"
    search = bent(by_tags(lens.sigma_focal))
    return StartLens(lens.camera(source.size_px), _advice(note), ("lens",), search)


def _advice(note: str) -> str:
    return f"no camera model given: {note}; make one with 'skyrelief calibrate' for true shapes"


def own_lens(inputs: ScanInputs, video: str, search: SelfCalibrationConfig) -> SelfCalibrated | str:
    """The camera by a reconstruction of some images, or why they do not determine it.

    ``inputs`` are those of the whole scan, with the lens to begin with; ``video`` is its camera
    source, a recording or a folder of stills.
    """
    from service.flight.scan import Scan, create_store
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
            scan.run(Event(), is_enough=_is_enough)
            scan.close()
        finally:
            store.close()
        if scan.recorder.keyframes < MIN_IMAGES:
            return f"{scan.recorder.keyframes} keyframes are too few; {MIN_IMAGES} needed"
        try:
            return lens(folder, Path(parse_source(video)[1]), search)
        except InputError as error:
            return str(error)


def still_assumed(found: SelfCalibrated) -> tuple[str, ...]:
    """What is as good as assumed of a lens that was found: its distortion, where depth at a corner
    is bent by more than :data:`MAX_SIGMA_BEND`."""
    from recon.calibration.flight import corner_bend

    bend = corner_bend(found.camera, found.sigma_k[0])
    return ("distortion",) if bend > MAX_SIGMA_BEND else ()


def _is_enough(scan: Scan) -> bool:
    return scan.recorder.keyframes >= VIEWS or scan.recorder.frames >= MAX_FRAMES
