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


def open_backlog(config: Config) -> Datalink | None:
    """A sender of earlier scans that the ground lacks, for the time between flights.

    None when no ground station is configured or it has everything. Close it before a scan.
    """
    from pathlib import Path

    from service.stream.backlog import open_undelivered

    if not (config.datalink.connect or config.datalink.listen):
        return None
    stores = open_undelivered(Path(config.scan.folder))
    if not stores:
        return None
    from service.stream.link import DatalinkSender

    sender = DatalinkSender(None, config.datalink, config.scan.drone_name)
    for store in stores:
        sender.add(store, owned=True)
    return sender
