"""Who makes scans in a folder: one service, though two may be started by mistake."""

from __future__ import annotations

import fcntl
import logging
import os
from pathlib import Path

log = logging.getLogger(__name__)


class Claim:
    """That this process, and no other, makes scans in a folder; ends with it, however it ends."""

    def __init__(self) -> None:
        self.is_ours = False
        self._held: int | None = None

    def take(self, folder: Path) -> bool:
        """Make the folder and claim it; False when another process has it.

        Where folders cannot be locked, nobody has.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
            held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        except OSError as error:  # told when a scan is to be made in it
            log.debug("%s cannot be claimed: %s", folder, error.strerror)
            self.is_ours = True
            return True
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(held)
            return False
        except OSError as error:
            log.debug("%s cannot be locked: %s", folder, error.strerror)
        self._held, self.is_ours = held, True
        return True

    def give_up(self) -> None:
        """Let others have it."""
        if self._held is not None:
            os.close(self._held)
        self._held, self.is_ours = None, False
