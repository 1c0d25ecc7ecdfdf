"""State of the vehicle link that survives restarts, in one small file."""

from __future__ import annotations

import json
import logging
import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the first heartbeat does not wait for the dialect
    from mavlink.wire.signing import StreamTimes

log = logging.getLogger(__name__)

FILE = "mavlink.json"
BROKEN = (OSError, ArithmeticError, AttributeError, LookupError, TypeError, ValueError)


class Memory:
    """Parameters, signing times and system id, kept in a file over restarts."""

    def __init__(self, folder: Path | None, key: str = "") -> None:
        """``key`` is the fingerprint of the signing key: another key's streams are forgotten."""
        self._key = key
        self._path = None if folder is None else folder / FILE
        self._revision = 0
        self.system: int | None = None
        self.parameters: dict[str, float] = {}
        self.signing_timestamp = 0
        self.signing_streams: StreamTimes = {}
        self._written = self._text()  # equivalent to no file
        if self._path is None or not self._path.is_file():
            return
        try:
            kept = json.loads(self._path.read_text())
            self.parameters = {str(k): float(v) for k, v in kept["parameters"].items()}
            self.signing_timestamp = int(kept["signing_timestamp"])
            of_key = kept["signing_streams"] if kept.get("signing_key") == key else ()
            streams = [tuple(map(int, stream)) for stream in of_key]
            self.signing_streams = {(a, b, c): time for a, b, c, time in streams}
            system = kept.get("system")
            self.system = system if type(system) is int and 1 <= system <= 255 else None
            self._written = self._text()
        except BROKEN as error:
            log.warning("%s is not used: %s", self._path, error)

    def is_stale(self, revision: int, system: int | None) -> bool:
        """True when parameters or the vehicle have changed since the last save."""
        changed = revision != self._revision or system not in (None, self.system)
        return self._path is not None and changed

    def save(
        self,
        values: dict[str, float],
        revision: int,
        timestamp: int,
        streams: StreamTimes,
        system: int | None,
    ) -> None:
        """Save what has changed; a full disk is logged, not raised. A ``system`` of None keeps the
        known one."""
        self._revision, self.system = revision, system or self.system
        self.parameters, self.signing_timestamp, self.signing_streams = values, timestamp, streams
        text = self._text()
        if self._path is None or text == self._written:
            return
        fresh = self._path.with_suffix(".new")
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with fresh.open("w") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())  # a power cut may not leave an empty file
            os.replace(fresh, self._path)
            self._written = text
        except OSError as error:
            log.error("parameters could not be kept: %s", error)

    def _text(self) -> str:
        kept = {
            "parameters": self.parameters,
            "signing_timestamp": self.signing_timestamp,
            "signing_key": self._key,
            "signing_streams": [(*stream, time) for stream, time in self.signing_streams.items()],
            "system": self.system,
        }
        return json.dumps(kept)
