"""The folders of a ground station's store: the quota of each drone, the folder of each scan, and
scans copied from a card.

Scans lie in ``drones/DRONE/SCAN``, where nothing else does, because others choose these names;
sites in ``site/NAME``. Drones of earlier versions lie in the store itself and are read there too.

The card may come from a stranger: regular files of known names only, as many bytes as fit. Links in
it are not followed, nothing on it is written, and pipes, devices and symbolic links are left out.
"""

from __future__ import annotations

import logging
import os
import shutil
import stat
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, cast

from service.errors import InputError, OutsideError, outside
from service.offline.site import DRONE
from service.scans.folder import write_deliverables
from service.scans.retention import Claim
from service.scans.writing import existing
from service.stream.naming import check_name, split_scan_name
from service.stream.store import ScanStore, header_of

log = logging.getLogger(__name__)

RESERVE_SHARE, MAX_RESERVE_BYTES = 0.05, 2 << 30
"""Free space kept by default: this share of the disk, at most so much."""
MEASURE_S = 60.0


@dataclass(frozen=True, slots=True)
class DroneLimits:
    """Limits of the drones at the ground station, each for one drone unless it says otherwise."""

    scan_bytes: int | None = None  # of one scan's chunks; beyond it only coarse layers
    drone_share: float = 0.5  # of the disk
    reserve_bytes: int | None = None  # that stay free on the disk; None: by its size
    drones: int = 64  # received at once, of all; more wait until one is silent
    requests: int = 1024  # under way, of all; each takes a thread, each drone an equal share
    open_scans: int = 32  # where the descriptors allow it
    unfinished_bytes: int = 1 << 25  # of records; beyond it the largest make way
    silent_s: float = 30.0  # without a message for so long, it is silent
    close_whole_s: float = 60.0  # a whole scan without data for so long is written and closed
    full_disk_rest_s: float = 10.0  # until a full disk is tried again
    refresh_s: float = 0.0  # write deliverables of growing scans so often; 0: when complete
    look_s: float = 1.0  # between two looks at the disk
    usage: Callable[[Path], tuple[int, int, int]] = shutil.disk_usage  # of a folder's disk


class DiskShare:
    """Space that one drone may still use; use from one thread. Everything in the drone's folder
    counts: coarse layers, poses and deliverables too."""

    def __init__(self, folder: Path, limits: DroneLimits) -> None:
        self._folder, self._limits = folder, limits
        self._used_bytes, self._measured_at = 0, -1e9
        self._total_bytes, self._free_bytes, self._looked_at = 0, 0, -1e9

    def check(self, size_bytes: int, now: float | None = None) -> None:
        """Count ``size_bytes`` that are about to be written. Raises OutsideError when they do not
        fit into the share, or would take from the reserve."""
        now = time.monotonic() if now is None else now
        self._look(now)
        share, reserve_bytes = self._limits.drone_share, self._limits.reserve_bytes
        if self._used_bytes + size_bytes > share * self._total_bytes:
            raise OutsideError(
                f"{self._folder} has reached its share, {100 * share:g} % of the disk; "
                "delete scans or give --drone-share"
            )
        if reserve_bytes is None:
            reserve_bytes = min(int(RESERVE_SHARE * self._total_bytes), MAX_RESERVE_BYTES)
        if self._free_bytes - size_bytes < reserve_bytes:
            raise OutsideError(
                f"the disk of {self._folder} is full but for its reserve of "
                f"{reserve_bytes / 1e6:.0f} MB; free some space or give --reserve-mb"
            )
        self._used_bytes += size_bytes
        self._free_bytes -= size_bytes

    def _look(self, now: float) -> None:
        """Measure the disk, and now and then the folder: others write there too."""
        if now - self._looked_at >= self._limits.look_s:
            self._looked_at = now
            with outside(f"cannot read the disk of {self._folder}"):
                self._total_bytes, _, self._free_bytes = self._limits.usage(existing(self._folder))
        if now - self._measured_at >= MEASURE_S:
            self._measured_at = now
            self._used_bytes = folder_bytes(self._folder)


def folder_bytes(folder: Path) -> int:
    """Bytes of the files below ``folder``; links are not followed."""
    total = 0
    for place, _, names in os.walk(folder):
        for name in names:
            with suppress(OSError):  # deleted meanwhile
                total += os.lstat(os.path.join(place, name)).st_size
    return total


DRONES, SITES = "drones", DRONE  # the folders of the drones, and of the sites, in a store


def drone_folder(store: Path, drone: str) -> Path:
    """The folder of a drone's scans: in the store itself where it has some there already."""
    earlier = store / drone
    if drone != SITES and any(is_regular(scan / "scan.db") for scan in _within(earlier)):
        return earlier
    return store / DRONES / drone


def site_folders(store: Path) -> Iterator[Path]:
    return (folder for folder in _within(store / SITES) if is_regular(folder / "scan.db"))


def scan_files(store: Path, *names: str) -> Iterator[Path]:
    """Regular files of these names in the folders of the drones' scans."""
    earlier = (path for path in _within(store) if path.name != SITES and path.name[0] != ".")
    for drone in (*_within(store / DRONES), *earlier):
        for scan in _within(drone):
            yield from filter(is_regular, (scan / name for name in names))


def _within(folder: Path) -> list[Path]:
    """What is in a folder; nothing where it is deleted meanwhile, or no folder."""
    try:
        return [folder / name for name in os.listdir(folder)]
    except OSError:
        return []


MAX_RUNS = 100  # folders of scans of the same drone and time; more are not made


def scan_folder(store: Path, drone: str, name: str) -> Path:
    """The folder of a drone's scan, called as on the datalink, whether it is there or not.

    The first run of a scan gets the scan's own name, further runs ``<scan>-2`` and so on.
    Raises InputError when there are MAX_RUNS already.
    """
    scan_id, run_id = split_scan_name(name)
    return run_folder(drone_folder(store, drone), scan_id, (drone, scan_id, run_id))


def run_folder(drone: Path, scan: str, identity: tuple[str, str, str]) -> Path:
    """The folder in ``drone`` of the scan with that identity; ``scan`` is what it is called. Raises
    InputError when there are MAX_RUNS of others already."""
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


def copy_files(source: Path, target: Path, names: Iterable[str]) -> set[str]:
    """Copy the regular files called ``names`` from one folder to another; those there were.

    Raises InputError when ``source`` is not a folder, OutsideError for too little room, see
    :func:`check_room`, and for a failing disk.
    """
    try:
        folder = os.open(source, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except (OSError, ValueError) as error:
        raise InputError(f"{_short(source)} is not a folder that can be read") from error
    files: dict[str, int] = {}
    with ExitStack() as opened, outside(f"cannot copy {_short(source)} to {target}"):
        opened.callback(os.close, folder)
        for name in names:
            handle = _open_regular(folder, name)
            if handle is not None:
                opened.callback(os.close, handle)
                files[name] = handle
        sizes = {name: os.fstat(handle).st_size for name, handle in files.items()}
        check_room(sum(sizes.values()), target)
        for name, handle in files.items():
            _copy(handle, target / name, sizes[name])
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


def check_room(size: int, target: Path, room_bytes: int | None = None) -> None:
    """Raise OutsideError when ``size`` bytes do not fit ``room_bytes``; by default a tenth of the
    disk of ``target``, at most 2 GiB, stays free."""
    if room_bytes is None:
        disk = shutil.disk_usage(target)
        room_bytes = disk.free - min(int(KEPT_FREE * disk.total), KEPT_FREE_BYTES)
    if size > room_bytes:
        raise OutsideError(
            f"the scan has {size / 1e6:.0f} MB, the store has room for "
            f"{max(room_bytes, 0) / 1e6:.0f} MB; delete scans or use another disk"
        )


def _copy(handle: int, target: Path, size: int) -> None:
    """The first ``size`` bytes; a file that grows meanwhile takes no more. It stays as old, so that
    a product is still known to be of its scan (:func:`service.ground.scan_facts.is_current`)."""
    written = os.fstat(handle)
    with open(target, "xb") as out:
        while size > 0 and (block := os.read(handle, min(BLOCK_BYTES, size))):
            out.write(block)
            size -= len(block)
    os.utime(target, ns=(written.st_atime_ns, written.st_mtime_ns))


class _Bounded:
    """A file of a stranger, see :func:`bounded`."""

    def __init__(self, file: IO[bytes], max_bytes: int, what: str) -> None:
        self._file, self._max_bytes, self._what = file, max_bytes, what
        self._size = os.fstat(file.fileno()).st_size
        self.seek, self.tell, self.seekable = file.seek, file.tell, file.seekable

    def read(self, size: int = -1) -> bytes:
        left = max(self._size - self.tell(), 0)
        size = left if size < 0 else min(size, left)
        if size > self._max_bytes:
            raise ValueError(f"{self._what} is too large")
        return self._file.read(size)


def bounded(file: IO[bytes], max_bytes: int, what: str) -> IO[bytes]:
    """``file``, of which no read makes room for more than is left; ValueError, which names
    ``what``, for more than ``max_bytes``."""
    return cast(IO[bytes], _Bounded(file, max_bytes, what))


def _short(path: Path) -> str:
    return str(path)[:200]


TAKING = ".taking-"
"""Begins the name of a folder that a scan is copied to, from a card or into the library."""


def take_in(
    store: Path,
    folder: Path,
    deliver: Callable[[Path, ScanStore], object] = write_deliverables,
) -> list[Path]:
    """The scan folders under ``store`` that now hold what those in ``folder`` hold.

    ``folder`` is a scan folder or a folder of them, such as a card's; nothing is written there.
    Items received before by radio or network are kept and completed. A damaged scan is left out
    where there are others. ``deliver`` writes a scan's files. Raises InputError when there is not
    a scan, OutsideError when the disk is full.
    """
    given = Path(os.path.realpath(folder))  # the operator's own link is followed
    paths = [given / STORE_FILES[0], *sorted(given.glob(f"*/{STORE_FILES[0]}"))]
    paths = [path for path in paths if is_regular(path) and not path.parent.is_symlink()]
    if not paths:
        raise InputError(f"{folder} contains no scan; it should hold scan.db, or folders that do")
    taken, faults = [], []
    for path in paths:
        try:
            taken.append(_take(store, path.parent, deliver))
        except InputError as error:
            log.error("%s is not taken: %s", path.parent, error)
            faults.append(error)
    if not taken:
        raise faults[0]
    return taken


def _take(store: Path, folder: Path, deliver: Callable[..., object]) -> Path:
    with workplace(store) as place:
        copy_files(folder, place, STORE_FILES)
        with ScanStore.open(place / STORE_FILES[0]) as source:
            header = source.header
            drone, scan = check_name(header.drone, "drone"), check_name(header.name, "scan")
            path = scan_folder(store, drone, scan) / STORE_FILES[0]
            is_known = path.exists()
            with ScanStore.open(path) if is_known else ScanStore.create(path, header) as target:
                news = merge(source, target)
                deliver(path.parent, target)
    log.info("%s/%s: %d records from %s", drone, scan, news, folder)
    return path.parent


@contextmanager
def workplace(store: Path) -> Iterator[Path]:
    """A folder in the store to copy to, gone afterwards. Raises OutsideError when the disk is
    full, there and for what is done in it."""
    with outside(f"cannot write in {store}"):
        store.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=TAKING, dir=store) as place:
            claim = Claim()
            claim.take(Path(place))
            try:
                yield Path(place)
            finally:
                claim.give_up()


def clear_leftovers(store: Path) -> int:
    """Delete the folders that a process which was killed left in ``store``; how many."""
    cleared = 0
    for left in store.glob(f"{TAKING}*"):
        claim = Claim()
        if left.is_dir() and not left.is_symlink() and claim.take(left):
            shutil.rmtree(left, ignore_errors=True)
            claim.give_up()
            cleared += 1
            log.info("%s was left by a process that was killed; deleted", left)
    return cleared


def merge(source: ScanStore, target: ScanStore) -> int:
    """Put every record of ``source`` that ``target`` lacks into it; how many there were."""
    news = 0
    for kind, numbers in source.numbers().items():
        for number in numbers - target.numbers_of(kind):
            record = source.record(kind, number)
            news += record is not None and target.put_record(kind, number, record)
    return news
