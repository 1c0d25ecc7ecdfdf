"""Which received scans have files yet to be written, also after the process was killed.

A mark in the scan's folder says that it grew since its files were written. It moves aside while
they are written and goes with them, so a kill at any time leaves one of the two.
"""

from __future__ import annotations

import logging
from pathlib import Path

from service.ground.folder_import import is_regular
from service.scans.folder import files_due, write_deliverables
from service.stream.store import ScanStore

log = logging.getLogger(__name__)

MARK, BEGUN = ".files-due", ".files-begun"


def mark(folder: Path) -> None:
    """The scan in ``folder`` has grown."""
    try:
        (folder / MARK).touch()
    except OSError as error:  # a full disk is reported where the scan itself is written
        log.debug("%s: %s", folder, error)


def begin(folder: Path) -> None:
    """Its files are being written; what comes from now on marks it again."""
    try:
        (folder / MARK).replace(folder / BEGUN)
    except OSError as error:
        log.debug("%s: %s", folder, error)


def end(folder: Path) -> None:
    """Writing has ended; the mark stays where the disk refused a file."""
    if not files_due(folder):
        (folder / BEGUN).unlink(missing_ok=True)


def left(store: Path) -> list[Path]:
    """The folders with files yet to be written, those of the newest scans first."""
    found = {path.parent for name in (MARK, BEGUN) for path in store.glob(f"*/*/{name}")}
    sound = [folder for folder in found if is_regular(folder / "scan.db")]
    return sorted(sound, key=lambda folder: folder.name, reverse=True)


def write_left(folder: Path) -> None:
    """Write the files that a former process could not. Raises what that raises."""
    begin(folder)
    with ScanStore.open(folder / "scan.db") as store:
        write_deliverables(folder, store, {})
    end(folder)
    log.info("%s: files written that a former process had left", folder)
