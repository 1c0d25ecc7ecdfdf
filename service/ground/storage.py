"""Scans from an aircraft's storage, taken into a ground station's after landing."""

from __future__ import annotations

import logging
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from service.errors import InputError, OutsideError
from service.ground.folder_import import is_regular
from service.ground.placing import scan_folder
from service.scans.retention import Claim
from service.stream.naming import check_name
from service.stream.records import ScanHeader
from service.stream.store import ScanStore

log = logging.getLogger(__name__)

FILES = ("scan.db", "scan.db-wal")
TAKING = ".taking-"
"""Begins the name of a folder that a card's scan is copied to."""


def take_in(store: Path, folder: Path) -> list[Path]:
    """The scan folders under ``store`` that now hold what those in ``folder`` hold.

    ``folder`` is a scan folder or a folder of them, such as a card's; nothing is written there.
    What came by radio or network before is kept and completed. Raises InputError when there is
    no scan, OutsideError when the disk is full.
    """
    paths = [folder / FILES[0], *sorted(folder.glob(f"*/{FILES[0]}"))]
    paths = [path for path in paths if is_regular(path)]
    if not paths:
        raise InputError(f"{folder} holds no scan; it should hold scan.db, or folders that do")
    return [_take(store, path.parent) for path in paths]


def _take(store: Path, folder: Path) -> Path:
    with _workplace(store) as place:
        for name in FILES:
            if is_regular(folder / name):
                shutil.copyfile(folder / name, place / name, follow_symlinks=False)
        with ScanStore.open(place / FILES[0]) as source:
            header = source.header
            drone, scan = check_name(header.drone, "drone"), check_name(header.name, "scan")
            path = scan_folder(store, drone, scan) / FILES[0]
            with _open(path, header) as target:
                news = merge(source, target)
                _deliver(path.parent, target)
    log.info("%s/%s: %d records from %s", drone, scan, news, folder)
    return path.parent


@contextmanager
def _workplace(store: Path) -> Iterator[Path]:
    """A folder in the store to copy to, gone afterwards. Raises OutsideError when the disk is
    full, there and for what is done in it."""
    try:
        store.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=TAKING, dir=store) as place:
            claim = Claim()
            claim.take(Path(place))
            try:
                yield Path(place)
            finally:
                claim.give_up()
    except OSError as error:
        raise OutsideError(f"cannot write in {store} ({error.strerror or error})") from error


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


def _open(path: Path, header: ScanHeader) -> ScanStore:
    return ScanStore.open(path) if path.exists() else ScanStore.create(path, header)


def merge(source: ScanStore, target: ScanStore) -> int:
    """Put every record of ``source`` that ``target`` lacks into it; how many there were."""
    news = 0
    for kind, numbers in source.numbers().items():
        for number in numbers - target.numbers_of(kind):
            record = source.record(kind, number)
            news += record is not None and target.put_record(kind, number, record)
    return news


def _deliver(folder: Path, store: ScanStore) -> None:
    from service.scans.folder import write_deliverables

    write_deliverables(folder, store, {})
