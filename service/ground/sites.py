"""Sites by themselves: a scan that ends is aligned with the scans that show the same ground.

A site is stored in STORE/site/NAME, like a scan, and grows with each scan that belongs to it. Every
alignment is a process: a damaged scan or a large site takes nothing from reception.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import time
from collections.abc import Collection, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from service.errors import InputError
from service.georeference import LocalFrame
from service.ground.scan_facts import Corner, Ground, Times, ground_in
from service.ground.storage import DiskShare, DroneLimits, is_regular, scan_files
from service.offline.site import DRONE, SAME_VISIT_S, SITE
from service.offline.site.start import KnownSite, Pair
from service.progress import Progress
from service.small_file import read_json
from service.workers import Worker, guarded, python_command, run_to_end

log = logging.getLogger(__name__)

NEAR_M = 500.0  # from where a flight begins to ground that it may see
MIN_SHARED = 0.05  # minimum share of the smaller scan's extent that the other covers as well
SIZES = 3  # a site takes up to so many times the disk of its scans' stores, with its files
ALIGN_S = 7200.0  # one alignment may take so long

MAX_SITE_BYTES = 4_000_000


class Sites:
    """Aligns the scans put in, one after the other, on one thread."""

    def __init__(self, store: Path, limits: DroneLimits) -> None:
        self._store, self._limits = store, limits
        self._waiting: queue.Queue[Path] = queue.Queue()

    def put(self, folder: Path) -> None:
        self._waiting.put(folder)

    def run(self, worker: Worker) -> None:
        """Align until the stop, which also ends an alignment under way."""
        while not worker.stop.is_set():
            with contextlib.suppress(queue.Empty):
                folder = self._waiting.get(timeout=0.5)
                worker.fault = guarded(f"site of {folder}", partial(self._join, folder, worker))

    def _join(self, folder: Path, worker: Worker) -> None:
        """Raises InputError where the scans make no site, OutsideError for the disk."""
        members = [*companions(self._store, folder), folder]
        if len(members) == 1:
            return
        _check_room(self._store, self._limits, members)
        site = site_of(self._store, members)
        words = ["site", "align", *map(str, members), "--out", str(site)]
        deadline = time.monotonic() + ALIGN_S

        def goes_on(_: str) -> bool:
            return not worker.stop.is_set() and time.monotonic() < deadline

        fault = run_to_end("alignment", python_command("service.cli", *words), goes_on)
        if fault:
            raise InputError(f"{site}: {fault}")
        if goes_on(""):
            log.info("%s: %d scans are aligned", site, len(members))


def _check_room(store: Path, limits: DroneLimits, members: Sequence[Path]) -> None:
    """Raise OutsideError when a site of these scans does not fit the sites' share of the disk."""
    sizes = (path.stat().st_size for m in members for path in m.glob("scan.db*"))
    share = DiskShare(store / DRONE, limits)
    share.check(SIZES * sum(sizes))


def align_by_points(
    store: Path,
    limits: DroneLimits,
    other: Path,
    folder: Path,
    start: list[Pair],
    progress: Progress,
) -> str:
    """Align the scan in ``folder``, which points place, with the scan or site ``other``.

    Returns the name of the site's file of ties. Raises InputError for points that place nothing,
    OutsideError when the site does not fit the disk.
    """
    from service.offline.site.alignment import align_site

    members = [other, folder]
    _check_room(store, limits, members)
    site = site_of(store, members)
    scans = [one for one in members if one != site]
    align_site(scans, site, starts={folder: start}, progress=progress)
    return SITE


def companions(store: Path, folder: Path) -> list[Path]:
    """The finished scans of the same visit that share ground with the one in ``folder``."""
    try:
        own = ground_in(folder / "scan.json")
    except InputError:
        return []
    others = ((path, ground) for path, ground in _grounds(store) if path != folder)
    return [
        path for path, ground in others if _is_same_visit(own, ground) and _is_shared(own, ground)
    ]


def references(
    store: Path, started_unix_s: float, known: Collection[Path], at: Corner | None = None
) -> list[Path]:
    """The sites and the scans of no site of one visit, and of the last visit before of the ground
    near ``at`` (latitude, longitude); the newest last, without ``known`` ones."""
    held = {folder.resolve() for folder in known}
    sites = {path: scans for path, scans in _sites(store) if not held & scans}
    members = {member for folders in sites.values() for member in folders}
    grounds = [(ground, path) for path, ground in _grounds(store)]
    for path in sites:
        with contextlib.suppress(InputError):
            grounds.append((ground_in(path / "scan.json"), path))
    grounds = [(g, path) for g, path in grounds if path.resolve() not in held | members]
    own = Ground(Times(started_unix_s), True)
    found = [(g, path) for g, path in grounds if _is_same_visit(own, g)]
    before = [
        (g, path)
        for g, path in grounds
        if g.finished and g.times.started_unix_s < started_unix_s - SAME_VISIT_S and _is_near(g, at)
    ]
    if before:
        last, _ = max(before, key=_start)
        found += [(g, path) for g, path in before if _is_same_visit(last, g)]
    return [path for _, path in sorted(found, key=_start)]


def _start(one: tuple[Ground, Path]) -> tuple[float, Path]:
    return one[0].times.started_unix_s, one[1]


def _is_near(ground: Ground, at: Corner | None) -> bool:
    """True where ground of known extent lies within NEAR_M of a place."""
    if ground.box is None or at is None:
        return False
    nearest = np.clip(at, *ground.box)
    away = LocalFrame(*at, 0.0).to_enu(np.append(nearest, 0.0)[None])[0, :2]
    return float(np.linalg.norm(away)) < NEAR_M


def site_of(store: Path, members: Sequence[Path]) -> Path:
    """The folder of the site that is or has one of the members; else a new one, by the first."""
    known = {member.resolve() for member in members}
    for path, scans in _sites(store):
        if known & {path.resolve(), *scans}:
            return path
    first = min(members, key=lambda folder: (folder.name, folder.parent.name))
    return store / DRONE / f"{first.parent.name}-{first.name}"[:100]


def _sites(store: Path) -> Iterator[tuple[Path, set[Path]]]:
    """The folders of the sites, each with those of its scans."""
    for path in sorted((store / DRONE).glob(f"*/{SITE}")):
        with contextlib.suppress(InputError):
            site = read_json(path, KnownSite, MAX_SITE_BYTES, "site")
            yield path.parent, {Path(scan.folder) for scan in site.scans}


def _grounds(store: Path) -> Iterator[tuple[Path, Ground]]:
    for path in sorted(scan_files(store, "scan.json")):
        if is_regular(path.parent / "scan.db"):
            with contextlib.suppress(InputError):
                yield path.parent, ground_in(path)


def _is_same_visit(a: Ground, b: Ground) -> bool:
    """True for finished scans that began within a day."""
    apart_s = abs(a.times.started_unix_s - b.times.started_unix_s)
    return a.finished and b.finished and apart_s <= SAME_VISIT_S


def _is_shared(a: Ground, b: Ground) -> bool:
    if a.box is None or b.box is None:
        return False
    common, areas = 1.0, [1.0, 1.0]
    for axis in range(2):
        sides = [(box[0][axis], box[1][axis]) for box in (a.box, b.box)]
        common *= max(min(end for _, end in sides) - max(begin for begin, _ in sides), 0.0)
        areas = [area * (end - begin) for area, (begin, end) in zip(areas, sides, strict=True)]
    return common > MIN_SHARED * min(areas)
