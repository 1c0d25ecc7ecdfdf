"""When a replayed video begins: as stated, in the camera's own zone, or as its images turn."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any

from service.errors import InputError
from service.stream.validity import MAX_TIME_NS, is_time

if TYPE_CHECKING:
    from mavlink.telemetry.logs import TelemetryLog
    from service.cameras.source import CameraSource
    from service.flight.scan import ScanInputs

HOUR_NS = 3_600_000_000_000


def start_of(
    source: CameraSource, log: TelemetryLog | None, video_epoch: float | None, notes: list[str]
) -> int:
    """Unix ns of the source's time 0: as given, the container's, the log's start, or now."""
    if video_epoch is not None:
        epoch_ns = round(video_epoch * 1e9) if math.isfinite(video_epoch) else MAX_TIME_NS
    elif log is not None and log.clock != "unix":  # time 0 of the video, or of the autopilot
        epoch_ns = 0 if log.clock == "video" else log.first_ns
        notes.append(f"the log has no date: times count from the start of the {log.clock}")
    elif source.epoch_unix_ns is not None:
        epoch_ns = source.epoch_unix_ns - local_zone_ns(source.epoch_unix_ns, log, notes)
    elif log is not None:
        epoch_ns = round(log.first_ns / 1e6) * 10**6  # autopilots count whole milliseconds
        notes.append("the recording does not say when it began: taken as the start of the log")
    else:
        epoch_ns = time.time_ns()
        notes.append("the recording does not say when it began: taken as the time of the replay")
    if not is_time(epoch_ns):
        raise InputError(
            "the recording begins outside the years 1970 to 2106; give the right --video-epoch"
        )
    if log is not None and not _covers(log, epoch_ns):
        raise InputError(
            f"the telemetry covers {_utc(log.first_ns)} to {_utc(log.last_ns)}, the video begins "
            f"at {_utc(epoch_ns)}: they do not overlap; give the right --video-epoch"
        )
    return epoch_ns


def _covers(log: TelemetryLog, start_ns: int) -> bool:
    """True when a video that starts then can be in the log."""
    return log.first_ns - 600e9 < start_ns < log.last_ns


def local_zone_ns(start_ns: int, log: TelemetryLog | None, notes: list[str]) -> int:
    """The hours by which a camera's local time is ahead of the log's UTC; 0 where it is not.

    Cameras write their local time where the format asks for UTC.
    """
    if log is None or _covers(log, start_ns):
        return 0
    for step_ns in (HOUR_NS, HOUR_NS // 2):  # some zones are half an hour off
        zones = range(-12 * HOUR_NS, 14 * HOUR_NS + 1, step_ns)
        fitting = [zone for zone in zones if _covers(log, start_ns - zone)]
        if len(fitting) == 1:
            hours = fitting[0] / HOUR_NS
            notes.append(f"the camera's clock is {hours:+g} h off the log's: taken as local time")
            return fitting[0]
    return 0


def _utc(time_ns: int) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(time_ns / 1e9))


def at_another_time(inputs: ScanInputs, off_ms: float) -> dict[str, Any]:
    """Inputs of the scan of a video whose stamps are late by ``off_ms``."""
    word = "before" if off_ms > 0 else "after"
    note = (
        f"the video begins {1e-3 * abs(off_ms):.2f} s {word} the time that it states, as its "
        "images turn with the log: applied"
    )
    return {"epoch_ns": inputs.epoch_ns - round(1e6 * off_ms), "notes": (*inputs.notes, note)}
