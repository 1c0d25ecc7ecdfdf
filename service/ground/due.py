"""What is yet to be made of the scans in a store: files and meshes, over kills and restarts.

A marker file in a scan's folder says so. It is renamed while that is made and deleted afterwards:
a kill at any time leaves one of the two names, and what changes meanwhile is due again.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from service.errors import InputError, OutsideError
from service.ground.storage import is_regular, scan_files, site_folders
from service.scans.folder import write_deliverables
from service.scans.writing import files_due
from service.stream.store import ScanStore
from service.workers import guarded


@dataclass(frozen=True, slots=True)
class Due:
    """One kind of what is made; a disk that refuses its markers is reported where it refuses the
    scans themselves."""

    mark_name: str
    begun_name: str

    def mark(self, folder: Path) -> None:
        with contextlib.suppress(OSError):
            (folder / self.mark_name).touch()

    def begin(self, folder: Path) -> None:
        with contextlib.suppress(OSError):
            (folder / self.mark_name).replace(folder / self.begun_name)

    def end(self, folder: Path) -> None:
        with contextlib.suppress(OSError):
            (folder / self.begun_name).unlink()

    def folders(self, store: Path, with_begun: bool = True) -> list[Path]:
        """Where it is due, or begun, those of the newest scans first."""
        names = (self.mark_name, self.begun_name) if with_begun else (self.mark_name,)
        of_sites = (folder / name for folder in site_folders(store) for name in names)
        marks = (*scan_files(store, *names), *filter(is_regular, of_sites))
        sound = {path.parent for path in marks if is_regular(path.parent / "scan.db")}
        return sorted(sound, key=lambda folder: folder.name, reverse=True)


FILES, MESH = Due(".files-due", ".files-begun"), Due(".mesh-due", ".mesh-begun")


def deliver(folder: Path) -> None:
    """Write the scan's deliverables; InputError names those which could not be made."""
    with ScanStore.peek(folder / "scan.db") as store:  # others may write
        failed = write_deliverables(folder, store)["failed"]
    if failed:
        why = "; ".join(f"{name} ({reason})" for name, reason in failed.items())
        raise InputError(f"some could not be made: {why}")


def write_files(
    folder: Path, deliver: Callable[[Path], None] = deliver, is_left: bool = False
) -> tuple[str, bool]:
    """Have ``deliver`` write a scan's files; what went wrong, and whether the disk refused one.
    That stays due, whatever an earlier ``scan.json`` says; a fault in the scan would come again."""
    is_refused = False

    def work() -> None:
        nonlocal is_refused
        try:
            if is_left:  # by a former process: what a crash damaged is repaired
                ScanStore.open(folder / "scan.db").close()
            deliver(folder)
        except (OutsideError, OSError):
            is_refused = True
            raise

    FILES.begin(folder)
    trouble = guarded(f"deliverables of {folder}", work)
    if not is_refused and not files_due(folder):
        FILES.end(folder)
    return trouble, is_refused
