"""Files that appear whole or not at all."""

from __future__ import annotations

import errno
import glob
import json
import os
import re
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from service.errors import InputError, OutsideError, outside

SUMMARY = "scan.json"
PART = re.compile(r"/\.[^/]+\.[0-9]+-[0-9]+\.part(?=/)")


@contextmanager
def writing(path: Path) -> Iterator[Path]:
    """A temporary path of the calling thread for ``path``; renamed onto it on success, and on the
    disk then, otherwise removed. A disk failure becomes an OutsideError."""
    with _beside(path) as part:
        yield part
        sync(part)
        os.replace(part, path)
        sync(path.parent)  # or a power cut within seconds takes the name away


def sync(path: Path) -> None:
    """Write a file, or the names in a folder, through to the disk; OSError when it fails. Some
    network file systems cannot do so for a folder: there the names are written when they are."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP) or not path.is_dir():
            raise
    finally:
        os.close(handle)


def write_whole(path: Path, data: bytes | str) -> None:
    with writing(path) as part:
        part.write_bytes(data.encode() if isinstance(data, str) else data)


@contextmanager
def writing_folder(path: Path) -> Iterator[Path]:
    """An empty folder next to ``path``, renamed onto it on success. An existing folder is replaced
    only then. A disk failure becomes an OutsideError."""
    with _beside(path) as part:
        part.mkdir()
        yield part
        if path.is_dir():
            shutil.rmtree(path)
        os.replace(part, path)


@contextmanager
def filling_folder(path: Path) -> Iterator[Path]:
    """An empty folder inside the folder ``path``, whose content moves there on success; otherwise
    nothing of it stays. A disk failure becomes an OutsideError."""
    is_new = not path.exists()
    try:
        with _beside(path / "new", path) as part:
            part.mkdir()
            yield part
            for one in sorted(part.iterdir(), key=lambda one: one.is_file()):
                os.replace(one, path / one.name)
    finally:
        if is_new:
            with suppress(OSError):  # it holds what was made, or was never there
                path.rmdir()


def check_writable(path: Path, is_folder: bool = False) -> None:
    """Raise InputError, before any work, where no file (or folder) can be written at ``path``.
    OutsideError where rights are missing."""
    if path.exists() and path.is_dir() != is_folder:
        raise InputError(f"{path} is a {'file' if is_folder else 'folder'}; give another --out")
    there = existing(path if path.is_dir() else path.parent)
    if not there.is_dir():
        raise InputError(f"{path}: {there} is a file, not a folder; give another --out")
    if not os.access(there, os.W_OK | os.X_OK):
        raise OutsideError(f"cannot write {path}: no rights to write in {there}")


def existing(folder: Path) -> Path:
    """The folder, or the nearest of its parents that can be found."""
    while not os.path.exists(folder) and folder != folder.parent:
        folder = folder.parent
    return folder


@contextmanager
def _beside(path: Path, named: Path | None = None) -> Iterator[Path]:
    """The temporary path, after those of processes that are gone were removed; errors are of
    ``named``, else of ``path``."""
    part = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}.part")
    try:
        with outside(f"cannot write {final(named or path)}", "check the disk and its rights"):
            path.parent.mkdir(parents=True, exist_ok=True)
            _remove_abandoned(path)
            yield part
    finally:
        with suppress(OSError):  # a disk that cannot be written cannot be cleaned either
            _remove(part)


def final(path: Path) -> Path:
    """Where ``path`` will lie, once the temporary folder that holds it is renamed."""
    return Path(PART.sub("", str(path)))


def _remove_abandoned(path: Path) -> None:
    """Remove what processes that ended by a kill or a power cut left for ``path``."""
    for part in path.parent.glob(f".{glob.escape(path.name)}.*-*.part"):
        writer = re.fullmatch(r"([0-9]{1,9})-[0-9]+\.part", part.name[len(path.name) + 2 :])
        if writer is None:
            continue  # a name that is not ours
        try:
            os.kill(int(writer[1]), 0)
        except ProcessLookupError:
            _remove(part)
        except PermissionError:
            pass  # another user's, alive


def _remove(part: Path) -> None:
    if part.is_dir() and not part.is_symlink():
        shutil.rmtree(part)
    else:
        part.unlink(missing_ok=True)


def files_due(folder: Path) -> bool:
    """Whether the files of a finished scan must still be written, or retried. scan.json is written
    last; it records whether the disk refused another file."""
    try:
        document = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return True
    return not isinstance(document, dict) or document.get("files_due") is True
