"""A scan that was started by command goes on after the service, or the computer, fell over.

A small file in the folder of scans says that one runs; its text names the boot of the computer.
"""

from __future__ import annotations

import logging
import os
from enum import Enum
from pathlib import Path

log = logging.getLogger(__name__)

MARK = ".scanning"
BOOT = Path("/proc/sys/kernel/random/boot_id")


class Left(Enum):
    """What the last life of the service left undone."""

    NOTHING = "nothing"
    BY_SERVICE = "the service ended while scanning"
    BY_COMPUTER = "the computer ended while scanning"


class Resumption:
    """What is to be scanned again; known until somebody starts or stops a scan."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / MARK
        self.left = self._read()

    def _read(self) -> Left:
        try:
            boot = self._path.read_text(encoding="utf-8")
        except (OSError, ValueError):
            return Left.NOTHING
        return Left.BY_SERVICE if boot and boot == _boot() else Left.BY_COMPUTER

    def note(self) -> None:
        """A scan runs that must go on after a fall."""
        self.left = Left.NOTHING
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("w", encoding="utf-8") as file:
                file.write(_boot())
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            log.warning("%s: a restart in flight will not scan again: %s", self._path, error)

    def forget(self) -> None:
        """None does any more, or none need go on."""
        self.left = Left.NOTHING
        try:
            self._path.unlink(missing_ok=True)
        except OSError as error:
            log.warning("%s stays: %s", self._path, error.strerror)

    def is_due(self, is_heard: bool, is_armed: bool) -> bool:
        """True when a scan must be started now; asked until it is, or until nothing is left.

        After a power cut only an autopilot that is armed says that it was in flight; one that
        is not (``is_heard``) says that the battery was changed.
        """
        if self.left is Left.BY_COMPUTER and is_heard and not is_armed:
            self.forget()
        return self.left is Left.BY_SERVICE or (self.left is Left.BY_COMPUTER and is_armed)


def _boot() -> str:
    """Names this boot of the computer; empty where the system does not tell."""
    try:
        return BOOT.read_text(encoding="ascii").strip()
    except OSError:
        return ""
