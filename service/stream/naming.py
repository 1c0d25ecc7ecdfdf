"""Valid names of drones, scans and stations, and the keys made of them."""

from __future__ import annotations

import re
import socket
import uuid
from pathlib import Path

from service.errors import InputError

ROOT = "skyrelief"  # all keys are skyrelief/<drone>/<scan>/<topic>

MAX_NAME = 64
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")  # pattern of a drone, scan or station name

RUN = re.compile(r"(.+)\.([0-9a-f]{32})")
"""Name of a scan on the datalink: its own name, a dot, and its run."""


def split_scan_name(name: str) -> tuple[str, str]:
    """Scan and run of a name; the run is empty for drones that do not send it."""
    found = RUN.fullmatch(name)
    return (found[1], found[2]) if found else (name, "")


def check_name(name: str, what: str) -> str:
    """``name`` if it may be part of a key; raises InputError when not."""
    if not NAME.fullmatch(name):
        raise InputError(
            f"{what} {name!r} cannot travel on the datalink; "
            "use at most 64 letters, digits, dots, dashes and underscores"
        )
    return name


def place_of(key: str) -> tuple[str, str] | None:
    """(drone, scan) of a key; None when either is not a valid folder name."""
    parts = key.split("/")
    if len(parts) < 4 or not (NAME.fullmatch(parts[1]) and NAME.fullmatch(parts[2])):
        return None
    return parts[1], parts[2]


def station_name(store: Path) -> str:
    """The name of the ground station with this store, created once and kept in it."""
    path = store / "station.txt"
    if path.exists():
        name = path.read_text(encoding="utf-8", errors="replace").strip()
        if NAME.fullmatch(name):
            return name
    host = "".join(c if c.isalnum() else "-" for c in socket.gethostname())[:40].strip("-")
    name = f"{host or 'ground'}-{uuid.uuid4().hex[:8]}"
    path.write_text(name + "\n", encoding="utf-8")
    return name
