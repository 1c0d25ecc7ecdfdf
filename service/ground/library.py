"""The scans kept at a ground station: list, rename, tag, delete to a bin, bring back, import.

A scan is a folder with a ``scan.db`` (:mod:`service.ground.storage` says where); a site is one of
the drone ``site``. Names given by people live in ``library.json`` next to it and are never used as
paths.
"""

from __future__ import annotations

import contextlib
import os
import re
import sqlite3
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from service.errors import InputError, MissingError, SkyreliefError, outside
from service.ground.mcap_import import header_in, store_from_mcap
from service.ground.scan_facts import Labels, facts_of, is_current, read_strictly
from service.ground.storage import (
    OTHER_FILES,
    SITES,
    STORE_FILES,
    clear_leftovers,
    copy_files,
    drone_folder,
    is_regular,
    run_folder,
    scan_files,
    site_folders,
    workplace,
)
from service.offline.site import SITE
from service.scans.folder import PIECE, write_deliverables
from service.scans.writing import write_whole
from service.stream.records import ScanHeader
from service.stream.store import ScanStore

BIN = ".bin"
LABELS = "library.json"
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
"""Valid names of a drone's and a scan's folder."""

MAX_TITLE = 200
MAX_TAGS = 20
UNREADABLE = (SkyreliefError, sqlite3.Error, OSError, ValueError, OverflowError, RecursionError)
"""Errors of a broken scan; the list shows it with the reason."""

FILES: dict[str, str] = {
    "cloud.laz": "fused cloud",
    **{PIECE.format(n): "piece that nothing ties to the rest" for n in range(1, 100)},
    "cloud.copc.laz": "cloud-optimised LAZ",
    "cloud.ply": "fused cloud, PLY",
    "dsm.tif": "surface model",
    "ortho.tif": "orthophoto",
    "dtm.tif": "bare ground",
    "ortho.kmz": "orthophoto, KMZ",
    "contours.geojson": "contours",
    "contours.gpkg": "contours, GeoPackage",
    "contours.dxf": "contours, DXF",
    "stac.json": "STAC item",
    "coverage.tif": "coverage: views, sigma, height",
    "coverage.png": "coverage, image",
    "mesh.glb": "textured mesh",
    "splat.ply": "3D Gaussians",
    "trajectory.tum": "trajectory, TUM",
    "trajectory.csv": "trajectory, table",
    "flight.geojson": "flight, GeoJSON",
    "flight.kml": "flight, KML",
    "flight.mcap": "recording, MCAP",
    "annotations.geojson": "annotations, GeoJSON",
    "gcp.csv": "control points and their marks",
    "report.html": "report",
    "site.json": "site: its scans, motions, ties",
    "change.html": "change, page",
    "change.tif": "change: difference, sigma, object",
    "change.gpkg": "change, polygons",
    "change.json": "change, figures",
    "scan.json": "summary",
    "scan.db": "store",
    "preview.jpg": "preview",
    "thumbnail.webp": "thumbnail",
}
"""Files of a scan folder that may be downloaded, and what they are."""


class ConflictError(InputError):
    """Somebody else was faster, or is at it."""


class Library:
    """The scans below one folder. Safe for several threads."""

    def __init__(self, store: Path) -> None:
        self.store = store
        self._lock = threading.Lock()
        self._import_lock = threading.Lock()
        clear_leftovers(store)

    def scans(self) -> list[dict[str, Any]]:
        """One entry per scan, the newest first; a broken scan is listed with its fault."""
        entries = []
        for drone, scan in self._names():
            with contextlib.suppress(InputError):  # deleted meanwhile
                entries.append(self.entry(drone, scan))
        return sorted(entries, key=lambda e: e["started_unix_s"] or 0.0, reverse=True)

    def folder(self, drone: str, scan: str) -> Path:
        """The folder of a scan. Raises InputError when there is none, whatever the names."""
        if not (NAME.fullmatch(drone) and NAME.fullmatch(scan)):
            raise MissingError("no such scan: a name may hold letters, digits, dots and dashes")
        site = self.store / SITES / scan
        is_site = drone == SITES and is_regular(site / "scan.db")
        folder = site if is_site else drone_folder(self.store, drone) / scan
        if not is_regular(folder / "scan.db"):
            raise MissingError(f"no scan {drone}/{scan}")
        return folder

    def entry(self, drone: str, scan: str) -> dict[str, Any]:
        folder = self.folder(drone, scan)
        labels = read_labels(folder)
        entry: dict[str, Any] = {
            "drone": drone,
            "scan": scan,
            "title": labels.title or scan,
            "tags": list(labels.tags),
            "edition": labels.edition,
            "files": _files(folder),
            "preview": is_regular(folder / "preview.jpg"),
            "thumbnail": is_regular(folder / "thumbnail.webp"),
            "tiles": is_regular(folder / "3dtiles" / "tileset.json"),
            "meshed": is_current(folder / "mesh.glb"),
            "maps": is_regular(folder / "maps" / "manifest.json"),
            "started_unix_s": None,
            "origin": None,
            "finished": False,
            "trouble": None,
        }
        try:
            entry |= facts_of(folder)
        except UNREADABLE as error:
            entry["trouble"] = str(error)[:300] or type(error).__name__
        return entry

    def file(self, drone: str, scan: str, name: str) -> Path:
        """The path of a deliverable. Raises InputError for any other file."""
        path = self.folder(drone, scan) / name
        if name not in FILES or not is_regular(path):
            raise MissingError(f"no file {name} in {drone}/{scan}"[:200])
        return path

    def label(
        self, drone: str, scan: str, title: str | None, tags: list[str] | None, edition: int | None
    ) -> Labels:
        """Rename or tag a scan; what is None stays. Raises InputError for unfit values.

        ``edition`` is that of the labels the change was made on: ConflictError when they have
        changed since, and nothing is written. With None the last of two changes holds.
        """
        with self.changing(drone, scan) as folder:
            old = read_labels(folder)
            if edition is not None and edition != old.edition:
                name = old.title or scan
                raise ConflictError(
                    f"someone else has just changed “{name}”; look again, then change"
                )
            new = Labels(
                old.title if title is None else _title(title),
                old.tags if tags is None else _tags(tags),
                old.edition + 1,
            )
            write_whole(folder / LABELS, msgspec.json.encode(new))
        return new

    @contextlib.contextmanager
    def changing(self, drone: str, scan: str) -> Iterator[Path]:
        """The folder of a scan, which only the caller changes meanwhile."""
        folder = self.folder(drone, scan)
        with self._lock:
            yield folder

    def delete(self, drone: str, scan: str) -> str:
        """Move a scan to the bin; the name it has there."""
        with self.changing(drone, scan) as folder:
            name = f"{drone}~{scan}~{time.time_ns()}"
            _move(folder, self.store / BIN / name)
        with contextlib.suppress(OSError):
            folder.parent.rmdir()  # only when it was the drone's last
        return name

    def bin(self) -> list[str]:
        place = self.store / BIN
        return sorted(p.name for p in place.iterdir()) if place.is_dir() else []

    def restore(self, name: str) -> tuple[str, str]:
        """Bring a scan back from the bin; its drone and scan."""
        parts = name.split("~")
        if name not in self.bin() or len(parts) != 3:
            raise MissingError("no such scan in the bin")
        folder = self.store / BIN / name
        target = self._home(parts[0], folder) / parts[1]
        with self._lock:
            if target.exists():
                raise InputError(f"there is a scan {parts[0]}/{parts[1]}; rename its folder first")
            _move(folder, target)
        return parts[0], parts[1]

    @contextlib.contextmanager
    def importing(self) -> Iterator[None]:
        """The time of one import. Raises ConflictError while another one runs."""
        if not self._import_lock.acquire(blocking=False):
            raise ConflictError("another import is running; try again when it is done")
        try:
            yield
        finally:
            self._import_lock.release()

    def take(self, source: Path) -> tuple[str, str]:
        """Import a scan folder, as it lay on the aircraft's disk, or an MCAP; its drone and scan.
        Raises InputError when it is none or the library has that scan already."""
        with workplace(self.store) as place:
            part = place / "scan"
            part.mkdir(0o750)
            is_recording = source.suffix.lower() == ".mcap"
            header = (self._recorded if is_recording else self._copied)(source, part)
            with self._lock:
                target = self._check_new(header, part)
                _move(part, target)
        return target.parent.name, target.name

    def _recorded(self, source: Path, part: Path) -> ScanHeader:
        """Make a scan folder of an aircraft's MCAP, with its usual files."""
        if not is_regular(source):
            raise InputError(f"{str(source)[:200]} is not a file; give the recording itself")
        header = header_in(source)
        self._check_new(header, source)
        with store_from_mcap(source, part / "scan.db") as store:
            write_deliverables(part, store)
        return header

    def _copied(self, source: Path, part: Path) -> ScanHeader:
        if STORE_FILES[0] not in copy_files(source, part, STORE_FILES):
            raise InputError(f"{str(source)[:200]} contains no scan.db; give a scan folder")
        try:
            with ScanStore.open(part / STORE_FILES[0]) as store:
                header = store.header
        except (sqlite3.Error, ValueError, InputError) as error:
            why = str(error).replace(f"{part}/", "")  # where it lies for a while
            raise InputError(f"{str(source)[:200]} contains no valid scan ({why})") from error
        self._check_new(header, source)
        copy_files(source, part, ({*FILES, *OTHER_FILES} - {*STORE_FILES}))
        return header

    def _home(self, drone: str, source: Path) -> Path:
        """Where the scan in ``source`` belongs: the drone's folder, or that of the sites."""
        is_site = drone == SITES and is_regular(source / SITE)
        return self.store / SITES if is_site else drone_folder(self.store, drone)

    def _check_new(self, header: ScanHeader, source: Path) -> Path:
        """The folder for a scan; InputError when the library has it already."""
        drone, scan = _safe(header.drone, "drone"), _safe(header.scan_id, "scan")
        target = run_folder(self._home(drone, source), scan, header.identity)
        if target.exists():
            raise InputError(f"the library holds {drone}/{target.name} already")
        return target

    def _names(self) -> list[tuple[str, str]]:
        """(drone, scan) of every folder that holds a scan or a site."""
        folders = {path.parent for path in scan_files(self.store, "scan.db")}
        names = {
            (folder.parent.name, folder.name) for folder in (*folders, *site_folders(self.store))
        }
        return sorted(pair for pair in names if all(map(NAME.fullmatch, pair)))


def read_labels(folder: Path) -> Labels:
    """The labels of a scan folder; none when the file is missing or unfit."""
    try:
        found = read_strictly(folder / LABELS, Labels)
        return Labels(_title(found.title), _tags(found.tags), found.edition)
    except InputError:
        return Labels()


def _files(folder: Path) -> list[dict[str, Any]]:
    out, there = [], set[str]()
    with contextlib.suppress(OSError):
        there.update(os.listdir(folder))
    for name, what in FILES.items():
        path = folder / name
        with contextlib.suppress(OSError):  # deleted meanwhile
            if name in there and is_regular(path):
                out.append({"name": name, "what": what, "bytes": path.stat().st_size})
    return out


JOINERS = "\u200c\u200d"  # invisible characters that some scripts need within a word


def _title(title: Any) -> str:
    if not isinstance(title, str) or len(title) > MAX_TITLE:
        raise InputError(f"a title is a text of at most {MAX_TITLE} letters")
    if any(0xD800 <= ord(letter) <= 0xDFFF for letter in title):
        raise InputError("a title holds an invalid character (a lone surrogate)")
    seen = (c if c.isprintable() or c in JOINERS else " " for c in title)  # nothing that hides
    return " ".join("".join(seen).split())


def _tags(tags: Any) -> tuple[str, ...]:
    if not isinstance(tags, (list, tuple)) or len(tags) > MAX_TAGS:
        raise InputError(f"tags are a list of at most {MAX_TAGS} texts")
    return tuple(dict.fromkeys(filter(None, map(_title, tags))))


def _safe(name: str, what: str) -> str:
    out = re.sub(r"[^A-Za-z0-9._-]+", "-", name).lstrip(".-")[:100]
    return out or what


def _move(source: Path, target: Path) -> None:
    with outside(f"cannot move {source.name}"):
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(source, target)
