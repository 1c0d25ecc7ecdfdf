"""The scans in flight aligned with the site, in a lasting process of its own.

It reads the stores below the receiver's folder and writes one small file, from which the portal
takes where each scan is shown. Nothing is sent to an aircraft, and no scan is changed.
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import select
import sys
import time
from functools import partial
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from recon import se3
from recon.types import F64
from service.errors import InputError, SkyreliefError
from service.ground.scan_facts import UnixTime, read_strictly
from service.ground.sites import references
from service.ground.storage import STORE_FILES, scan_files
from service.offline.site import SAME_VISIT_S
from service.offline.site.live import LiveSite, PlacedScan
from service.scans.writing import write_whole
from service.workers import Worker, guarded, python_command, run_process

log = logging.getLogger(__name__)

FILE = ".live-site.json"  # where the scans in flight are shown; below the receiver's folder

POLL_S = 0.25
GROWING_S = 60.0  # a scan that did not change for so long is no longer in flight
MAX_FLYING, MAX_SCANS = 16, 48  # scans in flight, and all that are followed
REFUSED_S = 3.0  # a scan that cannot be followed yet is looked at again after so long


def run(store: Path, worker: Worker) -> None:
    """Keep the process until the worker's stop."""
    try:
        run_process(worker, "live site", python_command(__name__, str(store)))
    finally:
        with contextlib.suppress(OSError):
            (store / FILE).unlink(missing_ok=True)


class Follower:
    """Follows the scans that grow below ``store``, and the finished ones of the same visit and
    of the last one before.

    A scan that ends is followed until none is in flight: others are tied to it.
    """

    def __init__(self, store: Path) -> None:
        self._store = store
        self._site = LiveSite()
        self._refused: dict[Path, float] = {}  # until when

    def turn(self, now_unix_s: float) -> bool:
        """Compare one keyframe of each scan; False when there was none to compare."""
        scans = self._site.scans
        grown = growing(self._store, now_unix_s)
        for folder in grown:
            if folder not in scans and now_unix_s >= self._refused.get(folder, now_unix_s):
                self._begin(folder, now_unix_s)
        flying = [f for f in grown if f in scans and not scans[f].is_finished]
        for folder in list(scans)[: -MAX_SCANS if flying else None]:
            if folder not in flying:
                self._site.remove(folder)
        return self._advance(now_unix_s)

    def _begin(self, folder: Path, now_unix_s: float) -> None:
        """Follow a scan in flight, and the finished ones that it may meet."""
        self._refused[folder] = now_unix_s + REFUSED_S
        if not self._add(folder, compare=True):
            return
        one = self._site.scans[folder]
        if one.is_finished:  # and only looked at
            self._site.remove(folder)
            return
        header = one.store.header
        at = None
        if header.origin_lat_deg is not None and header.origin_lon_deg is not None:
            at = header.origin_lat_deg, header.origin_lon_deg
        known = self._site.scans
        for other in references(self._store, one.started_unix_s, known, at)[-MAX_SCANS:]:
            self._add(other, compare=False)

    def _add(self, folder: Path, compare: bool) -> bool:
        try:
            self._site.add(folder, compare)
        except SkyreliefError as error:  # without georeference, or not yet
            log.debug("%s is not followed: %s", folder, error)
        return folder in self._site.scans

    def _advance(self, now_unix_s: float) -> bool:
        for folder in list(self._site.scans):
            if guarded(f"{folder} in flight", partial(self._site.refresh, folder)):
                self._site.remove(folder)
                self._refused[folder] = now_unix_s + REFUSED_S
        due = [folder for folder, one in self._site.scans.items() if one.due]
        for folder in due:
            guarded(f"{folder} in flight", partial(self._site.compare, folder))
        placed = self._site.place()
        if placed is not None:
            write_shown(self._store, placed)
        return bool(due)


def growing(store: Path, now_unix_s: float) -> list[Path]:
    """The folder of each drone's newest scan, if it grows; MAX_FLYING of them at most."""
    newest: dict[str, tuple[float, Path]] = {}
    for path in scan_files(store, *STORE_FILES):
        drone, folder = path.parent.parent.name, path.parent
        with contextlib.suppress(OSError):
            changed = path.lstat().st_mtime, folder
            newest[drone] = max(newest.get(drone, (-math.inf, folder)), changed)
    found = sorted(newest.values(), reverse=True)[:MAX_FLYING]
    return [folder for changed, folder in found if changed > now_unix_s - GROWING_S]


def serve(store: Path) -> None:
    """Follow the scans below ``store`` until standard input ends."""
    follower, is_busy = Follower(store), False
    write_shown(store, [])
    while not select.select([sys.stdin], [], [], 0.0 if is_busy else POLL_S)[0]:
        is_busy = follower.turn(time.time())


Number = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
Matrix = Annotated[list[Number], msgspec.Meta(min_length=16, max_length=16)]


class Shown(msgspec.Struct):
    drone: str
    scan: str
    started_unix_s: UnixTime
    T_site_scan: Matrix  # row by row, by the two origins alone
    moved: Matrix  # row by row: in the site, with the scale
    sigma_m: tuple[Number, Number, Number]  # east, north, up
    ties: int
    group: int  # scans that ties join have one number


def write_shown(store: Path, placed: list[PlacedScan]) -> None:
    """Replace the file in ``store``; OutsideError for the disk."""
    found = []
    for one in placed:
        moved = se3.compose(one.move.scale * one.move.R, one.move.t)
        matrices = (one.T_site_scan.ravel().tolist(), moved.ravel().tolist())
        sigma = (float(v) for v in np.minimum(one.sigma_m, 1e6))
        names = one.folder.parent.name, one.folder.name
        found.append(Shown(*names, one.started_unix_s, *matrices, (*sigma,), one.ties, one.group))  # type: ignore[arg-type]
    write_whole(store / FILE, msgspec.json.encode(found))


class SiteNews:
    """Gives where the scans tied to one scan are shown, in its own coordinates."""

    def __init__(self, store: Path, folder: Path) -> None:
        self._path = store / FILE
        self._names = folder.parent.name, folder.name
        self._seen = 0

    def message(self) -> str | None:
        """What the process wrote last, as JSON; None when it is known already. ``T`` (16, column by
        column) takes a scan's coordinates, corrected, to this scan's."""
        try:
            written = self._path.lstat().st_mtime_ns
        except OSError:
            written = 0
        if written == self._seen:
            return None
        self._seen = written
        scans: list[Shown] = []
        with contextlib.suppress(InputError):
            scans = read_strictly(self._path, list[Shown])
        own = next((one for one in scans if (one.drone, one.scan) == self._names), None)
        shown = [
            _entry(own, one)
            for one in scans
            if own is not None and one.group == own.group  # and not of a later visit
            if one.started_unix_s <= own.started_unix_s + SAME_VISIT_S
        ]
        return json.dumps({"type": "site", "scans": shown})


def _entry(own: Shown, one: Shown) -> dict[str, object]:
    T = se3.inverse(_matrix(own.T_site_scan)) @ _matrix(one.moved) @ _matrix(one.T_site_scan)
    return {
        "drone": one.drone, "scan": one.scan, "own": one is own,
        "earlier": one.started_unix_s < own.started_unix_s - SAME_VISIT_S, "ties": one.ties,
        "sigma_m": one.sigma_m, "T": columns(T),
    }  # fmt: skip


def columns(T: F64) -> list[float]:
    """The 16 numbers of a (4, 4) matrix, column by column."""
    return [round(float(v), 9) for v in T.T.ravel()]


def _matrix(numbers: list[float]) -> F64:
    return np.array(numbers, np.float64).reshape(4, 4)


if __name__ == "__main__":
    serve(Path(sys.argv[1]))
