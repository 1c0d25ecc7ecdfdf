"""Where the scans in flight are shown: a small file that one process writes for the portal."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from recon import se3
from recon.types import F64
from service.errors import InputError
from service.ground.scan_facts import UnixTime
from service.ground.storage import is_regular
from service.offline.site import SAME_VISIT_S
from service.offline.site.live import PlacedScan
from service.scans.writing import writing
from service.small_file import read_json

FILE = ".live-site.json"
MAX_BYTES = 200_000

Number = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
Matrix = Annotated[list[Number], msgspec.Meta(min_length=16, max_length=16)]


class Shown(msgspec.Struct):
    """One scan in the site."""

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
        moved = se3.compose(one.move.growth * one.move.R, one.move.t)
        matrices = (one.T_site_scan.ravel().tolist(), moved.ravel().tolist())
        sigma = (float(v) for v in np.minimum(one.sigma_m, 1e6))
        names = one.folder.parent.name, one.folder.name
        found.append(Shown(*names, one.started_unix_s, *matrices, (*sigma,), one.ties, one.group))  # type: ignore[arg-type]
    with writing(store / FILE) as part:
        part.write_bytes(msgspec.json.encode(found))


class SiteNews:
    """Gives where the scans tied to one scan are shown, in its own coordinates."""

    def __init__(self, folder: Path) -> None:
        self._path = folder.parent.parent / FILE
        self._names = folder.parent.name, folder.name
        self._seen = 0

    def message(self) -> str | None:
        """What the process wrote last, as JSON; None when it is known already.

        ``T`` (16, column by column) takes a scan's coordinates, corrected, to this scan's.
        """
        try:
            written = self._path.lstat().st_mtime_ns
        except OSError:
            written = 0
        if written == self._seen:
            return None
        self._seen = written
        scans = self._read()
        own = next((one for one in scans if (one.drone, one.scan) == self._names), None)
        near = [one for one in scans if own and _is_for(own, one)]
        return json.dumps({"type": "site", "scans": [_entry(own, one) for one in near if own]})

    def _read(self) -> list[Shown]:
        if not is_regular(self._path):
            return []
        try:
            return read_json(self._path, list[Shown], MAX_BYTES, "scans in flight")
        except InputError:
            return []


def _is_for(own: Shown, one: Shown) -> bool:
    """True for a scan tied to this one, and not of a later visit."""
    return one.group == own.group and one.started_unix_s <= own.started_unix_s + SAME_VISIT_S


def _entry(own: Shown, one: Shown) -> dict[str, object]:
    T = se3.inverse(_matrix(own.T_site_scan)) @ _matrix(one.moved) @ _matrix(one.T_site_scan)
    return {
        "drone": one.drone, "scan": one.scan, "own": one is own,
        "earlier": one.started_unix_s < own.started_unix_s - SAME_VISIT_S, "ties": one.ties,
        "sigma_m": one.sigma_m, "T": [round(float(v), 9) for v in T.T.ravel()],
    }  # fmt: skip


def _matrix(numbers: list[float]) -> F64:
    return np.array(numbers, np.float64).reshape(4, 4)
