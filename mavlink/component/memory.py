"""State of the vehicle link that survives restarts, in one small file."""

from __future__ import annotations

import json
import logging
import os
from pathlib import Path

log = logging.getLogger(__name__)

FILE = "mavlink.json"


class Memory:
    """Parameters, signing time and system id, kept in a file over restarts."""

    def __init__(self, folder: Path | None) -> None:
        self._path = None if folder is None else folder / FILE
        self._revision = 0
        self._written = _text({}, 0, None)  # equivalent to no file
        self.parameters: dict[str, float] = {}
        self.signing_timestamp = 0
        self.system: int | None = None
        if self._path is None or not self._path.is_file():
            return
        try:
            kept = json.loads(self._path.read_text())
            self.parameters = {str(k): float(v) for k, v in kept["parameters"].items()}
            self.signing_timestamp = int(kept["signing_timestamp"])
            system = kept.get("system")
            self.system = system if type(system) is int and 1 <= system <= 255 else None
            self._written = _text(self.parameters, self.signing_timestamp, self.system)
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            log.warning("%s is not used: %s", self._path, error)

    def is_stale(self, revision: int, system: int | None) -> bool:
        """True when parameters or the vehicle have changed since the last save."""
        changed = revision != self._revision or system not in (None, self.system)
        return self._path is not None and changed

    def save(
        self, values: dict[str, float], revision: int, timestamp: int, system: int | None
    ) -> None:
        """Save what has changed; a full disk is logged, not raised.

        A ``system`` of None keeps the known one.
        """
        self._revision = revision
        self.system = system or self.system
        text = _text(values, timestamp, self.system)
        if self._path is None or text == self._written:
            return
        fresh = self._path.with_suffix(".new")
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            fresh.write_text(text)
            os.replace(fresh, self._path)
            self._written = text
        except OSError as error:
            log.error("parameters could not be kept: %s", error)


def _text(values: dict[str, float], timestamp: int, system: int | None) -> str:
    kept = {"parameters": values, "signing_timestamp": timestamp, "system": system}
    return json.dumps(kept)
