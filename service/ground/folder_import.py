"""A scan folder copied from a card: regular files of known names only, as many bytes as fit.

The card may come from a stranger. Nothing in it is followed, nothing on it is written, and what
was a pipe, a device or a symbolic link is left out.
"""

from __future__ import annotations

import os
import shutil
import stat
from collections.abc import Iterable
from pathlib import Path

from service.errors import InputError, OutsideError

STORE_FILES = ("scan.db", "scan.db-wal")
OTHER_FILES = ("coverage.json", "library.json", "telemetry.csv", "link.tlog", "camera.refined.yaml")
"""Worth copying though no deliverable; 3D Tiles can be made again."""

KEPT_FREE, KEPT_FREE_BYTES = 0.1, 2 << 30
"""An import leaves free this share of the store's disk, but no more than these bytes."""

BLOCK_BYTES = 1 << 20


def is_regular(path: Path) -> bool:
    """Whether ``path`` is a regular file and no link to one."""
    try:
        return stat.S_ISREG(path.lstat().st_mode)
    except (OSError, ValueError):
        return False


def copy_files(
    source: Path, target: Path, names: Iterable[str], room_bytes: int | None = None
) -> set[str]:
    """Copy the regular files called ``names`` from one folder to another; those there were.

    ``room_bytes`` bounds the copy; by default a tenth of the disk, at most 2 GiB, stays free.
    Raises InputError when ``source`` is no folder, OutsideError for too little room and for a
    failing disk.
    """
    try:
        folder = os.open(source, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except (OSError, ValueError) as error:
        raise InputError(f"{_short(source)} is no folder that can be read") from error
    files: dict[str, int] = {}
    try:
        for name in names:
            handle = _open_regular(folder, name)
            if handle is not None:
                files[name] = handle
        sizes = {name: os.fstat(handle).st_size for name, handle in files.items()}
        _check_room(sum(sizes.values()), target, room_bytes)
        for name, handle in files.items():
            _copy(handle, target / name, sizes[name])
    except OSError as error:
        raise OutsideError(f"cannot copy {_short(source)} to {target} ({error})") from error
    finally:
        for handle in (folder, *files.values()):
            os.close(handle)
    return set(files)


def _open_regular(folder: int, name: str) -> int | None:
    """A descriptor of a regular file in ``folder``; None for a missing file and anything else."""
    flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        handle = os.open(name, flags, dir_fd=folder)
    except OSError:
        return None
    if stat.S_ISREG(os.fstat(handle).st_mode):
        return handle
    os.close(handle)
    return None


def _check_room(size: int, target: Path, room_bytes: int | None) -> None:
    if room_bytes is None:
        disk = shutil.disk_usage(target)
        room_bytes = disk.free - min(int(KEPT_FREE * disk.total), KEPT_FREE_BYTES)
    if size > room_bytes:
        raise OutsideError(
            f"the scan has {size / 1e6:.0f} MB, the store has room for "
            f"{max(room_bytes, 0) / 1e6:.0f} MB; delete scans or use another disk"
        )


def _copy(handle: int, target: Path, size: int) -> None:
    """The first ``size`` bytes; a file that grows meanwhile takes no more."""
    with open(target, "xb") as out:
        while size > 0 and (block := os.read(handle, min(BLOCK_BYTES, size))):
            out.write(block)
            size -= len(block)


def _short(path: Path) -> str:
    return str(path)[:200]
