"""Scans on disk: who makes them, which a crash left open, and which are deleted for space."""

from __future__ import annotations

import fcntl
import logging
import os
import shutil
import sqlite3
from collections.abc import Callable, Container
from pathlib import Path

from service.errors import SkyreliefError
from service.scans.writing import files_due
from service.workers import python_command, run_to_end

log = logging.getLogger(__name__)

MIB = 2**20

PAGES = "map-pages"  # folder of the map inside a scan's folder; removed when the scan is closed


def close_open_scans(
    folder: Path, ours: Container[str], goes_on: Callable[[], bool] = lambda: True
) -> list[str]:
    """Finish the scans in ``folder`` that a crash or a power cut left open; returns their names.

    Scans named in ``ours`` are in progress and left unchanged. The clock is not used, because a
    power cut may have reset it. The stored data is kept and the files are written, with
    ``interrupted`` in the summary. An unreadable scan stays as it is, with a warning. Once
    ``goes_on`` is False the rest waits for the next start.
    """
    from service.stream.store import ScanStore

    closed = []
    for path in sorted(folder.glob("*/scan.db")):
        scan = path.parent
        if scan.name in ours:
            continue
        try:
            with ScanStore.open(path) as store:
                if store.finished and not files_due(scan):
                    continue
                shutil.rmtree(scan / PAGES, ignore_errors=True)
                if not store.finished:
                    store.finish({"interrupted": True})
            # A process of its own: its compiler and clouds would stay with an idle service.
            write = python_command("service.scans.folder", str(scan))
            fault = run_to_end("recover", write, lambda _: goes_on())
        except (SkyreliefError, ValueError, OSError, sqlite3.Error) as error:
            fault = str(error)
        if not goes_on():
            break
        if fault:
            log.warning("%s cannot be closed: %s", scan, fault)
            continue
        closed.append(scan.name)
        log.info("%s was left open; it is now closed", scan)
    return closed


def make_room(
    folder: Path,
    keep_free_mib: float,
    keep: Container[str] = (),
    free: Callable[[Path], int] = lambda folder: shutil.disk_usage(folder).free,
) -> list[str]:
    """Delete the oldest finished scans until ``keep_free_mib`` are free; returns their names. Scans
    in ``keep`` and open ones stay."""
    deleted: list[str] = []
    if keep_free_mib <= 0 or not folder.is_dir():
        return deleted
    candidates = [path.parent for path in folder.glob("*/scan.db") if path.parent.name not in keep]
    for scan in sorted(candidates, key=lambda p: p.name):  # sorted by name, which is a time
        if free(folder) >= keep_free_mib * MIB:
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
    """The exclusive right of this process to make scans in a folder; ends with the process."""

    def __init__(self) -> None:
        self.is_ours = False
        self._held: int | None = None

    def take(self, folder: Path) -> bool:
        """Make the folder and claim it; False when another process has it. Where folders cannot be
        locked, every claim succeeds."""
        try:
            folder.mkdir(parents=True, exist_ok=True)
            held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        except OSError as error:  # reported when a scan is made in it
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
        if self._held is not None:
            os.close(self._held)
        self._held, self.is_ours = None, False
