"""Scans on the disk: who makes them, which were left open by a crash, and which make room."""

from __future__ import annotations

import fcntl
import logging
import os
import shutil
import sqlite3
from collections.abc import Container
from pathlib import Path

from service.errors import SkyreliefError

log = logging.getLogger(__name__)

MIB = 2**20

PAGES = "map-pages"
"""Folder of the map inside a scan's folder; gone when the scan is closed."""


def close_open_scans(folder: Path, ours: Container[str]) -> list[str]:
    """Finish the scans in ``folder`` that a crash or a power cut left open; their names.

    Those called as in ``ours`` are left alone: they are being made. No clock is asked, which a
    power cut may have set back. What the scans hold is kept and their files are written, with
    ``interrupted`` in the summary. One that cannot be read is left as it is, with a warning.
    """
    from service.scans.folder import files_due, write_deliverables
    from service.stream.store import ScanStore

    closed = []
    for path in sorted(folder.glob("*/scan.db")):
        if path.parent.name in ours:
            continue
        try:
            with ScanStore.open(path) as store:
                if store.finished and not files_due(path.parent):
                    continue
                shutil.rmtree(path.parent / PAGES, ignore_errors=True)
                if not store.finished:
                    store.finish({"interrupted": True})
                write_deliverables(path.parent, store, {})
        except (SkyreliefError, ValueError, OSError, sqlite3.Error) as error:
            log.warning("%s cannot be closed: %s", path.parent, error)
            continue
        closed.append(path.parent.name)
        log.info("%s was left open; it is closed and kept", path.parent)
    return closed


def make_room(folder: Path, keep_free_mib: float, keep: Container[str] = ()) -> list[str]:
    """Delete the oldest finished scans until ``keep_free_mib`` are free; names of the deleted.

    Those called as in ``keep`` and those that are still open stay.
    """
    deleted: list[str] = []
    if keep_free_mib <= 0 or not folder.is_dir():
        return deleted
    candidates = [path.parent for path in folder.glob("*/scan.db") if path.parent.name not in keep]
    for scan in sorted(candidates, key=lambda p: p.name):  # names are times
        if shutil.disk_usage(folder).free >= keep_free_mib * MIB:
            break
        if not _finished(scan):
            continue
        shutil.rmtree(scan, ignore_errors=True)
        if not scan.exists():
            deleted.append(scan.name)
            log.warning("the disk is full: deleted the oldest scan, %s", scan)
    return deleted


def _finished(scan: Path) -> bool:
    from service.stream.store import ScanStore

    try:
        with ScanStore.open(scan / "scan.db") as store:
            return store.finished
    except (SkyreliefError, ValueError, OSError, sqlite3.Error):
        return False


class Claim:
    """That this process, and no other, makes scans in a folder; ends with it, however it ends."""

    def __init__(self) -> None:
        self.is_ours = False
        self._held: int | None = None

    def take(self, folder: Path) -> bool:
        """Make the folder and claim it; False when another process has it.

        Where folders cannot be locked, nobody has.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
            held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        except OSError as error:  # told when a scan is to be made in it
            log.debug("%s cannot be claimed: %s", folder, error.strerror)
            self.is_ours = True
            return True
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(held)
            return False
        except OSError as error:
            log.debug("%s cannot be locked: %s", folder, error.strerror)
        self._held, self.is_ours = held, True
        return True

    def give_up(self) -> None:
        """Let others have it."""
        if self._held is not None:
            os.close(self._held)
        self._held, self.is_ours = None, False
