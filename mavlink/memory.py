"""What the vehicle link keeps over restarts, in one small file."""

from __future__ import annotations

import json
import logging
import os
from pathlib import Path

log = logging.getLogger(__name__)


class Memory:
    """Parameters and signing time, kept in a file over restarts."""

    def __init__(self, folder: Path | None) -> None:
        self._path = None if folder is None else folder / "mavlink.json"
        self._revision = 0
        self._written = _text({}, 0)  # as good as no file
        self.parameters: dict[str, float] = {}
        self.signing_timestamp = 0
        if self._path is None or not self._path.is_file():
            return
        try:
            kept = json.loads(self._path.read_text())
            self.parameters = {str(k): float(v) for k, v in kept["parameters"].items()}
            self.signing_timestamp = int(kept["signing_timestamp"])
            self._written = _text(self.parameters, self.signing_timestamp)
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            log.warning("%s is not used: %s", self._path, error)

    def is_stale(self, revision: int) -> bool:
        """True when parameters have changed since the last save."""
        return self._path is not None and revision != self._revision

    def save(self, values: dict[str, float], revision: int, timestamp: int) -> None:
        """Keep them, where they are new; a full disk is logged, not raised."""
        self._revision = revision
        text = _text(values, timestamp)
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


def _text(values: dict[str, float], timestamp: int) -> str:
    return json.dumps({"parameters": values, "signing_timestamp": timestamp})
