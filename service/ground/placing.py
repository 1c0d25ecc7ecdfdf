"""Which folder of a ground station's store a scan belongs in."""

from __future__ import annotations

from pathlib import Path

from service.errors import InputError
from service.stream.naming import split_scan_name
from service.stream.store import header_of

MAX_RUNS = 100
"""Folders of scans of the same drone and time; more are not made."""


def scan_folder(store: Path, drone: str, name: str) -> Path:
    """The folder of a drone's scan, called as on the datalink, whether it is there or not.

    The first run of a scan gets the scan's own name, further runs ``<scan>-2`` and so on.
    Raises InputError when there are MAX_RUNS already.
    """
    scan_id, run_id = split_scan_name(name)
    return run_folder(store / drone, scan_id, (drone, scan_id, run_id))


def run_folder(drone: Path, scan: str, identity: tuple[str, str, str]) -> Path:
    """The folder in ``drone`` of the scan with that identity; ``scan`` is what it is called.

    Raises InputError when there are MAX_RUNS of others already.
    """
    places = [drone / scan, *(drone / f"{scan}-{n}" for n in range(2, MAX_RUNS + 1))]
    free = [place for place in places if not (place / "scan.db").exists()]
    for place in places:
        if place not in free:
            header = header_of(place / "scan.db")
            if header is not None and header.identity == identity:
                return place
    if not free:
        raise InputError(f"{drone} holds {MAX_RUNS} runs of {scan}; move some away to take in more")
    return free[0]
