"""``skyrelief replay``: recorded video as a fake camera through the whole onboard path."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Collection, Iterable
from contextlib import closing, nullcontext
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.commands import AsJson, BackendName, ConfigFile, Overrides, showing, stop_by_signals
from service.progress import CancelledError, Progress
from service.workers import PROCESS, Worker, end_processes

if TYPE_CHECKING:
    from mavlink.telemetry.logs import TelemetryLog
    from recon.types import Camera
    from service.cameras.source import CameraSource
    from service.commands.missing_metadata import Correction, StartLens
    from service.config import Config
    from service.flight.scan import Scan, ScanInputs


PATIENCE_S, DEVICE_S = 3.0, 4.0
"""After a stop: for the keyframe that is in work, and then for the files of the scan; and at last
for a device that still computes."""

LATENCY = "camera.latency_ms"
WIDTH, STEREO_WIDTH_PX = "compute.stereo_width", 640
"""Largest stereo width of a replay that is not tied to real time."""


def replay(
    video: Annotated[str, typer.Argument(help="a video, a folder of images, or - for a pipe")],
    telemetry: Annotated[
        Path | None,
        typer.Option(
            help="flight log: .tlog, .BIN, .ulg, .SRT, AirData's .csv; default: the video's own"
        ),
    ] = None,
    camera_model: Annotated[
        Path | None, typer.Option(help="camera_info YAML of 'skyrelief calibrate'")
    ] = None,
    video_epoch: Annotated[
        float | None, typer.Option(help="unix seconds of the video's first instant")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="scan folder to make")] = None,
    backend: Annotated[str | None, BackendName] = None,
    realtime: Annotated[
        bool, typer.Option("--realtime", help="at the video's pace; late frames are dropped")
    ] = False,
    find_lens: Annotated[
        bool, typer.Option(help="without a camera model: estimate it from 25 of the images first")
    ] = True,
    config: ConfigFile = None,
    set_: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Reconstruct a recording (video, folder of images or pipe) into a scan folder."""
    from service.memory import loading, one_pool

    one_pool()
    with loading():
        from service.cameras import open_camera, parse_source
        from service.cameras.camera_file import load_camera
        from service.cameras.source import QueuedSource
        from service.commands.missing_metadata import (
            load_log,
            own_telemetry,
            start_of,
            with_own_lens,
            with_stated_readout,
        )
        from service.compute.backend_choice import open_backend
        from service.config import is_given, load_config
        from service.flight.scan import ScanInputs, check_new
        from service.scans.writing import check_writable

    overrides = list(set_ or [])
    if backend is not None:
        overrides.append(f"compute.backend={backend}")
    chosen = load_config(config, overrides)
    if out is not None:
        check_new(out)
        check_writable(out, is_folder=True)
    model = camera_model or chosen.camera.model
    camera = load_camera(model) if model else None
    log = load_log(telemetry, chosen) if telemetry else own_telemetry(video, chosen)
    source = open_camera(video)
    with closing(QueuedSource(source) if realtime else source) as played:
        if not (realtime or chosen.compute.model or is_given(WIDTH, config, overrides)):
            chosen = denser(chosen, source)
        start, lens, notes = _lens(camera, source, log)
        lens, chosen = with_stated_readout(lens, chosen, video, source, notes)
        epoch_ns, unix_offset_ns, is_assumed = start_of(source, log, video_epoch, notes)
        start_s = (epoch_ns + unix_offset_ns) / 1e9
        scan_id = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(start_s))
        folder = out or Path(f"scan-{scan_id}")
        opened = open_backend(chosen.compute, source.size_px)
        notes += log.warnings if log is not None else ()
        inputs = ScanInputs(
            played, lens, chosen, opened, folder, scan_id, epoch_ns, unix_offset_ns,
            history=log.history if log is not None else None, notes=tuple(notes),
            sigma_focal=lens.sigma_focal,
            extra={"backend": opened.name, "source": source.description},
        )  # fmt: skip
        is_latency_given = is_given(LATENCY, config, overrides)
        unsure: set[str] = set()
        if not realtime and parse_source(video)[0] == "file":
            # What its images may correct; then its scan begins again.
            unsure = {"readout", "mount"}
            unsure |= {"roll"} if chosen.camera.image_roll_deg == "auto" else set()
            is_clock_given = is_latency_given or (video_epoch is not None and not is_assumed)
            is_of_camera = log is None or (log.clock == "video" and not log.may_lag)
            if not (is_of_camera or is_clock_given):
                unsure |= {"clock", "clock's rate"}
        with nullcontext(Progress()) if as_json else showing("replay") as progress:
            if start is not None:
                find = find_lens and not realtime
                inputs = with_own_lens(inputs, video, start, find, progress)
            if is_assumed:
                inputs = replace(inputs, assumed=(*inputs.assumed, "start"))
            if not realtime and parse_source(video)[0] == "images":
                from service.commands.adjusted_stills import adjusted_stills

                inputs = adjusted_stills(inputs, is_latency_given, progress)
            summary = _corrected(inputs, video, unsure, progress)
    report(summary | {"scan_folder": str(folder)}, as_json)
    if summary.get("backend") == "torch":
        await_dense(PROCESS.table())


def await_dense(
    workers: Iterable[Worker],
    patience_s: float = DEVICE_S,
    leave: Callable[[int], object] = os._exit,
) -> None:
    """Wait for a keyframe that was dropped at a stop: torch aborts a process that ends while it
    computes. One that hangs is left, with the process."""
    dense = [worker for worker in workers if worker.row.name in ("dense", "placing")]
    if not all(worker.join(patience_s) for worker in dense):
        sys.stdout.flush()
        end_processes()  # which the end of the interpreter would do
        leave(0)


def denser(config: Config, source: CameraSource) -> Config:
    """Half of the recording's width up to 640, and no more than the guide's.

    Stereo on the recording's own pixels matches their noise and compression as well: on 640
    pixels a width of 640 gives more points than 320, but worse ones.
    """
    from service.config import change

    compute = config.compute
    width = min(STEREO_WIDTH_PX, source.size_px[0] // 2, compute.guide_width)
    return change(config, WIDTH, max(width, compute.stereo_width))


def _lens(
    camera: Camera | None, source: CameraSource, log: TelemetryLog | None
) -> tuple[StartLens | None, Camera, list[str]]:
    """Where the search for a lens starts, None with a camera model; the lens, and notes on it."""
    from service.cameras.lens import check_width, fitted
    from service.commands.missing_metadata import start_lens

    notes: list[str] = []
    if camera is not None:
        start, (lens, notes) = None, fitted(camera, source)
    else:
        start = start_lens(source, log)
        lens = start.camera
    check_width(lens, source.description)
    return start, lens, notes


def _corrected(
    inputs: ScanInputs, video: str, unsure: set[str], progress: Progress
) -> dict[str, Any]:
    """The figures of the scan, begun again for each thing ``unsure`` that its images correct."""
    from service.cameras import open_camera
    from service.commands.missing_metadata import Correction

    stop = stop_by_signals()
    found = fly(inputs, stop, progress, unsure)
    corrected = inputs
    while isinstance(found, Correction):
        progress(f"beginning again with the {found.of} that was found")
        unsure = unsure - {found.of}
        if found.of != "readout":  # one that was sought with another clock is sought once more
            unsure |= {"readout"}
            corrected = inputs = replace(inputs, **found.changed)
        with closing(open_camera(video)) as again:
            corrected = replace(corrected, source=again, **found.changed)
            found = fly(corrected, stop, progress, unsure)
    return found


def fly(
    inputs: ScanInputs, stop: Event, progress: Progress, unsure: Collection[str]
) -> dict[str, Any] | Correction:
    """The scan's figures; or once the images correct something ``unsure``, the correction.

    What came before that is wrong, so such a scan is discarded, unless it goes to the ground.
    """
    from service.commands.missing_metadata import correction_of
    from service.commands.recording_clock import RecordingClock
    from service.daemon.datalink import open_datalink
    from service.daemon.warm_up import has_kernels, load_kernels
    from service.flight.scan import Scan, create_store
    from service.memory import release_memory
    from service.scans.folder import write_deliverables

    store = create_store(inputs)
    link = open_datalink(store, inputs.config)
    unsure = unsure if link is None else ()
    scan = Scan(inputs, store)
    clock = RecordingClock(scan.check)
    scan.worker.end_by(stop, PATIENCE_S)
    correction = None
    try:
        work = "tracking and reconstructing"
        if not has_kernels():
            work = f"compiling kernels, once, a minute or two; {work}"
        elif inputs.backend.name == "cpu":
            scan.worker.prepare(load_kernels)  # the first view is some frames away
        with progress.part(work, of_rest=0.9):
            show = show_flown(inputs.source, progress)
            scan.run(stop, show, is_enough=lambda scan: correction_of(scan, clock, unsure))
            if not stop.is_set():
                correction = correction_of(scan, clock, unsure, has_ended=True)
    finally:
        if correction is not None:
            scan.discard()
        else:
            if stop.is_set():
                progress("stopped: closing the scan")
            summary = scan.close()
            del scan  # its images and its map
            if link is not None:
                progress("sending the rest")
                summary["datalink_complete"] = link.drain(inputs.config.datalink.drain_s)
                link.close()
            release_memory(collect=True)
            try:
                summary |= write_deliverables(
                    inputs.folder, store, progress=_until_stopped(stop, progress)
                )
            except CancelledError:
                summary["failed"] = {"files of the scan": "stopped; exports need scan.db alone"}
            store.close()
    return correction or summary


def _until_stopped(stop: Event, progress: Progress) -> Progress:
    """Progress of work that ends :data:`PATIENCE_S` after a stop, shown by ``progress``."""
    stopped_s: list[float] = []

    def show(now: Progress) -> None:
        progress.share = max(progress.share, 0.9 + 0.1 * now.share)
        progress(now.text)
        if stop.is_set():
            stopped_s.append(time.monotonic())
            if stopped_s[-1] - stopped_s[0] > PATIENCE_S:
                now.cancel()

    return Progress(show)


def show_flown(source: CameraSource, progress: Progress) -> Callable[[Scan], None]:
    """The bar of a scan, whose figures only a terminal shows."""
    say = progress.counting(source.images) if source.images else progress

    def show(scan: Scan) -> None:
        r = scan.recorder
        figures = f"{r.frames} images, {r.distance_m:.0f} m flown, {r.keyframes} keyframes"
        say(figures if sys.stderr.isatty() else progress.text)

    return show


def report(summary: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print(json.dumps(summary))
        return
    for warning in summary["warnings"]:
        print(f"note: {warning}")
    for name, why in summary["failed"].items():
        print(f"not written: {name}: {why}")
    print(
        f"{summary['scan_folder']}: {summary['frames']} frames, "
        f"{summary['distance_m']:.0f} m flown in {summary['segments']} segment(s), "
        f"{summary['pairs']} stereo pairs, {summary['clouds_per_second']:g} a second"
    )
    if summary["refusals"]:
        refused = (f"{why} ({n})" for why, n in summary["refusals"].items())
        print(f"frames, views and pairs not used: {', '.join(refused)}")
    if "quality" in summary:
        trust = summary["quality"]["trust"]
        reasons = "; ".join(trust["reasons"]) or "nothing limits it"
        print(f"trust: {trust['level']}, georeference: {summary['georeference']}: {reasons}")
