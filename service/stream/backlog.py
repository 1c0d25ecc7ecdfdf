"""Scans of earlier flights that no ground station holds completely yet."""

from __future__ import annotations

import logging
from pathlib import Path

from service.errors import SkyreliefError
from service.stream.messages import missing
from service.stream.store import ScanStore

log = logging.getLogger(__name__)

MOST = 20
"""How many scans are offered at once, the newest."""


def delivered(store: ScanStore) -> bool:
    """Whether some ground station has said that it holds everything."""
    numbers = store.numbers()
    return any(not missing(numbers, held) for held in store.held().values())


def open_undelivered(scans: Path, but: Path | None = None) -> list[ScanStore]:
    """The newest scans under ``scans`` (a folder of scan folders) that were not delivered.

    ``but`` is a database to leave out, such as that of the scan being flown. A scan that was
    cut short by a crash is closed with ``{"interrupted": true}``, so that the ground can tell
    that no more will come. Unreadable ones are passed over with a warning.
    """
    out: list[ScanStore] = []
    for path in sorted(scans.glob("*/scan.db"), key=_changed, reverse=True):
        if len(out) >= MOST:
            break
        if but is not None and path.resolve() == but.resolve():
            continue
        try:
            if _was_delivered(path):
                continue
            store = ScanStore.open(path)
            if not store.finished:
                store.finish({"interrupted": True})
        except SkyreliefError as error:
            log.warning("%s", error)
            continue
        out.append(store)
    return out


def _was_delivered(path: Path) -> bool:
    """Whether the scan is finished and delivered, without reading the whole file for damage."""
    try:
        with ScanStore(path, None, None) as store:
            return store.finished and delivered(store)
    except SkyreliefError:
        return False  # it is opened with more care


def _changed(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0
