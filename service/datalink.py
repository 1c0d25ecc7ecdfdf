"""The sending end of the datalink as a scan uses it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from service.config import Config

if TYPE_CHECKING:
    from service.scan import Datalink
    from service.stream.store import ScanStore


def open_datalink(store: ScanStore, config: Config) -> Datalink | None:
    """A sender of what the store gets, or None when no ground station is configured."""
    if not (config.datalink.connect or config.datalink.listen or config.datalink.radio):
        return None
    from service.stream.link import DatalinkSender

    return DatalinkSender(store, config.datalink)
