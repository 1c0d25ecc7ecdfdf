"""What earlier scans measured of the camera: its latency and its readout.

The scans on disk are the memory, so it survives a restart, as after a change of the battery.
"""

from __future__ import annotations

import math
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

from recon.types import Shutter
from service.cameras.camera_file import shutter_of
from service.redaction import without_credentials
from service.stream.database import peek_meta
from service.stream.records import ScanHeader
from service.stream.store import header_of
from service.stream.validity import summary_from_json

SCANS = 20  # the latest scans that are looked at


class Measured(NamedTuple):
    """The latest sure figures of one camera; None where no scan is sure."""

    latency_ms: float | None = None
    shutter: Shutter | None = None


def measured(folder: Path, source: str, size_px: tuple[int, int]) -> Measured:
    """What the scans in ``folder`` say about the camera ``source`` at this size of its images."""
    out = Measured()
    for path in islice(sorted(folder.glob("*/scan.db"), reverse=True), SCANS):
        header, text = header_of(path), peek_meta(path, "summary")
        run = None if text is None else summary_from_json(text.encode())
        if header is None or run is None or run.get("source") != without_credentials(source):
            continue
        if (header.camera.get("width"), header.camera.get("height")) != size_px:
            continue
        out = Measured(
            _latency_ms(run) if out.latency_ms is None else out.latency_ms,
            _shutter(run, header) if out.shutter is None else out.shutter,
        )
        if None not in out:
            break
    return out


def _latency_ms(run: dict[str, Any]) -> float | None:
    found = run.get("camera_latency")
    if not isinstance(found, dict) or found.get("is_settled") is not True:
        return None
    value = found.get("estimate_ms")
    return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else None


def _shutter(run: dict[str, Any], header: ScanHeader) -> Shutter | None:
    found = run.get("camera_readout")
    if not isinstance(found, dict) or found.get("is_sure") is not True:
        return None
    camera = header.camera
    return shutter_of(camera.get("readout_ms", 0.0), camera.get("readout_direction", "down"))
