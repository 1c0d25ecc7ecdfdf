"""The scan as an MCAP recording for Foxglove and the like."""

from __future__ import annotations

from pathlib import Path

from service.exports.view import ExportOptions, ScanView
from service.scans.writing import writing


def write_mcap(scan: ScanView, out: Path, options: ExportOptions) -> None:
    """Keyframes, poses and corrections of the store as MCAP."""
    from service.stream.mcap_export import export_mcap

    with writing(out) as part:
        export_mcap(scan.store, part)
