"""A scan that a browser uploads: a ZIP of its folder, its ``scan.db``, an MCAP, or a recording.

The files stream to a folder of their own in the store, which is gone afterwards; the scan takes its
place in one step. They are not a form: Starlette would first collect its parts in the system's
temporary folder, which may have no room for 16 GiB. A recording (a video, and perhaps its flight
log and camera model) is replayed by a process of its own. Of an archive only the names of a
scan's files are unpacked, wherever they lie in it, so that no path in it is ever used.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import struct
import time
import zipfile
import zlib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import IO

from service.errors import InputError, outside
from service.ground.guard import MAX_UPLOAD_BYTES
from service.ground.library import FILES, Library
from service.ground.storage import (
    BLOCK_BYTES,
    OTHER_FILES,
    STORE_FILES,
    TAKING,
    bounded,
    check_room,
    workplace,
)
from service.progress import Progress
from service.workers import python_command, run_to_end

PARTS = {
    **dict.fromkeys((".zip", ".db", ".mcap"), "scan"),
    **dict.fromkeys((".mp4", ".mov", ".mkv", ".avi", ".ts", ".m4v"), "video"),
    **dict.fromkeys((".tlog", ".bin", ".ulg", ".srt", ".csv"), "--telemetry"),
    **dict.fromkeys((".yaml", ".yml"), "--camera-model"),
}
"""What a file is, by its suffix: a scan already, or of a recording the video or an option of
``replay``."""
UPLOADS = (
    ["scan"], ["video"], ["--telemetry", "video"], ["--camera-model", "video"],
    ["--camera-model", "--telemetry", "video"],
)  # fmt: skip
"""A video alone may hold its telemetry."""
Part = tuple[str, int]  # name and size in bytes of one uploaded file
MAX_LISTING_BYTES = 4 << 20  # size of an archive's table of contents, which is read whole
DONE = re.compile(r"(.*?)(?:, (\d{1,2}|100) %)?(?:, for \d+ s)?")
"""A line of progress, as :func:`service.commands.showing` writes it: the step, and what is done."""
OWN_PATH = re.compile(rf"\S*/{re.escape(TAKING)}[^/\s]+/(?:scan/|uploaded/)?")
"""What an error says about the folder that the upload is in for a while."""
NAMES = {*STORE_FILES, *FILES, *OTHER_FILES}
BROKEN = (
    zipfile.BadZipFile, zlib.error, struct.error, EOFError, RuntimeError, ValueError, LookupError,
)  # fmt: skip
"""What a damaged, encrypted or hostile archive raises."""


def check_parts(library: Library, parts: Sequence[Part], room_bytes: int | None = None) -> None:
    """Raise InputError for files that make no scan, OutsideError where they do not fit the disk,
    or ``room_bytes`` of it."""
    suffixes = (PurePosixPath(name).suffix.lower() for name, _ in parts)
    if sorted(PARTS.get(suffix, "") for suffix in suffixes) not in UPLOADS:
        names = ", ".join(name[:100] for name, _ in parts[:5])
        raise InputError(
            f"{names or 'nothing'} cannot be uploaded: give a ZIP of a scan folder, its scan.db, "
            "an .mcap, or a video with its flight log, unless that is inside; of stills "
            "'skyrelief replay FOLDER' makes a scan"
        )
    for name, size in parts:
        if not 0 < size <= MAX_UPLOAD_BYTES:
            most = f"{MAX_UPLOAD_BYTES >> 30} GiB"
            raise InputError(f"{name[:100]}: 1 byte to {most} can be uploaded, not {size} bytes")
    check_room(sum(size for _, size in parts), library.store, room_bytes)


class Upload:
    """Files on their way into the library, one after the other; close it at the end. Not
    thread-safe."""

    def __init__(
        self, library: Library, parts: Sequence[Part], room_bytes: int | None = None
    ) -> None:
        """Raises what :func:`check_parts` raises, and ConflictError while another import runs."""
        check_parts(library, parts, room_bytes)
        self._library = library
        self._waiting = list(parts)
        self._left = 0  # of the file that is being written
        self._file: IO[bytes] | None = None
        self._paths: list[Path] = []
        self._files = contextlib.ExitStack()
        with contextlib.ExitStack() as stack:
            stack.enter_context(library.importing())
            self._place = self._files.enter_context(workplace(library.store))
            self._opened = stack.pop_all()

    @property
    def is_recording(self) -> bool:
        """Whether it is a video, which :meth:`replay` makes a scan of."""
        return any(PARTS[path.suffix] == "video" for path in self._paths)

    @outside("the upload cannot be stored")
    def write(self, data: bytes) -> None:
        """Append to the files. Raises InputError past their size, OutsideError for the disk."""
        while data:
            if not self._left:
                self._next()
            assert self._file is not None
            self._file.write(data[: self._left])
            data, self._left = data[self._left :], max(self._left - len(data), 0)

    def _next(self) -> None:
        if not self._waiting:
            raise InputError("the upload is longer than it said")
        name, self._left = self._waiting.pop(0)
        path = self._place / f"upload{PurePosixPath(name).suffix.lower()}"
        if self._file is not None:
            self._file.close()
        self._file = open(path, "xb")  # noqa: SIM115
        self._files.callback(self._file.close)
        self._paths.append(path)

    def end(self) -> None:
        """All has come. Raises InputError when it has not."""
        left = self._left + sum(size for _, size in self._waiting)
        if left:
            raise InputError(f"the upload ended {left} bytes early")
        if self._file is not None:
            self._file.close()

    @outside("the upload cannot be stored")
    def finish(self) -> tuple[str, str]:
        """Import the scan; its drone and name. InputError when it is none."""
        (path,) = self._paths
        try:
            if path.suffix == ".mcap":
                return self._library.take(path)
            folder = self._place / "uploaded"
            folder.mkdir(0o750)
            if path.suffix == ".zip":
                unpack(path, folder)
                path.unlink()
            else:
                path.rename(folder / STORE_FILES[0])
            return self._library.take(folder)
        except InputError as error:
            raise InputError(OWN_PATH.sub("", str(error))) from error

    def replay(self) -> Callable[[Progress], str]:
        """Work that makes a scan of the recording and imports it; it owns the files from now on.
        It raises InputError with the process's last line when that fails."""
        files, self._files = self._files.pop_all(), contextlib.ExitStack()
        library, folder = self._library, self._place / "replayed"
        of = {PARTS[path.suffix]: path for path in self._paths}
        command = python_command("service.cli", "replay", str(of.pop("video")))
        command += [word for option, path in of.items() for word in (option, str(path))]

        def work(progress: Progress) -> str:
            def goes_on(line: str) -> bool:
                follow(progress, line)
                return True

            with files:
                fault = run_to_end("replay", [*command, "--out", str(folder)], goes_on)
                if fault:
                    raise InputError(OWN_PATH.sub("", fault))
                progress.commit("importing")
                return "/".join(library.take(folder))

        return work

    def close(self) -> None:
        """Delete the files, and let other imports run."""
        with self._opened:
            self._files.close()


def follow(progress: Progress, line: str) -> None:
    """Take step and share from a line that ``replay`` says."""
    if said := DONE.fullmatch(line):
        line, percent = said.groups()
        if percent is not None:
            progress.share = int(percent) / 100
    progress((line or "replay")[:80])


def unpack(archive: Path, folder: Path, room_bytes: int | None = None) -> None:
    """Unpack the scan in a ZIP into ``folder``: the files beside its only ``scan.db``.

    Raises InputError for an archive that is broken or holds no scan or several, OutsideError
    where what it claims to hold does not fit the disk, or ``room_bytes`` of it.
    """
    try:
        with open(archive, "rb") as file:
            found = zipfile.ZipFile(bounded(file, MAX_LISTING_BYTES, "its table of contents"))
            members = _members(found.infolist())
            check_room(sum(member.file_size for member in members.values()), folder, room_bytes)
            for name, member in members.items():
                _copy(found, member, folder / name)
    except BROKEN as error:
        raise InputError(f"the ZIP cannot be read ({error})"[:300]) from error


def _members(entries: Iterable[zipfile.ZipInfo]) -> dict[str, zipfile.ZipInfo]:
    """File name to entry, of the folder in the archive that holds the scan."""
    found: dict[str, dict[str, zipfile.ZipInfo]] = {}
    for entry in entries:
        folder, _, name = entry.filename.rpartition("/")
        if name in NAMES:
            found.setdefault(folder, {})[name] = entry
    scans = [files for files in found.values() if STORE_FILES[0] in files]
    if len(scans) != 1:
        raise InputError(f"the ZIP holds {len(scans) or 'no'} scans; give one scan folder")
    return scans[0]


def _copy(archive: zipfile.ZipFile, member: zipfile.ZipInfo, target: Path) -> None:
    """Unpack one file; at most the bytes that it claims to have."""
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise InputError("the ZIP is compressed by another method than deflate")
    with archive.open(member) as source, open(target, "xb") as out:
        shutil.copyfileobj(source, out, BLOCK_BYTES)  # zipfile reads no more than it claims
    with contextlib.suppress(ValueError, OverflowError):  # of no such day
        packed = time.mktime((*member.date_time, 0, 0, -1))
        os.utime(target, (packed, packed))  # a product stays known to be of its scan
