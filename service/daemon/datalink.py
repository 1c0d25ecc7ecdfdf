"""The sending end of the datalink: one sender per scan, and one for earlier scans between."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from mavlink.component.status import WARNING
from service.config import Config
from service.errors import SkyreliefError
from service.workers import PROCESS

if TYPE_CHECKING:
    from mavlink.component.vehicle import VehicleLink
    from service.radio import VehicleRadio
    from service.stream.link import DatalinkSender
    from service.stream.store import ScanStore
    from service.stream.tunnel import Carrier

log = logging.getLogger(__name__)

LOOK_S = 1.0  # between two looks at what the ground lacks
OWN_LINKS = "mavlink"  # of ``datalink.radio``: the links of the [mavlink] section


def open_datalink(
    store: ScanStore, config: Config, own_links: Carrier | None = None
) -> DatalinkSender | None:
    """A sender of what the store gets, or None when no ground station is configured. ``own_links``
    are the vehicle's links; without a vehicle, as in a replay, there are none."""
    datalink, radio = config.datalink, own_links
    if datalink.radio != OWN_LINKS:
        radio = None
        if datalink.radio:
            from service.radio import DRONE, RadioLink

            radio = RadioLink(datalink.radio, DRONE)
    if not (datalink.connect or datalink.listen or radio):
        return None
    from service.stream.link import DatalinkSender

    return DatalinkSender(store, datalink, radio=radio)


def open_backlog(config: Config) -> DatalinkSender | None:
    """A sender of earlier scans that the ground lacks, for the time between flights. None when no
    ground station is configured or it has everything. Close it before a scan."""
    from service.stream.reports import open_undelivered

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


def deliver(sender: DatalinkSender, max_s: float, wait: Callable[[], None] = lambda: None) -> None:
    """Wait until a ground station that is heard has everything, and log what is missing. ``wait``
    is called about once a second."""
    end_s = time.monotonic() + max_s
    while not sender.drain(min(LOOK_S, max_s)):
        now = sender.progress
        if time.monotonic() >= end_s or not now.listened:
            break
        wait()
    missing = sum(sender.progress.lacking.values())
    if missing:
        log.warning("the ground lacks %d items; the next start sends them", missing)


class DaemonLink:
    """The datalink over a daemon's life: a scan's sender while one runs, else the backlog. Safe
    between threads; nothing here waits for the link."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.sender: DatalinkSender | None = None  # of the running scan
        self.backlog: DatalinkSender | None = None
        self._wish: object | None = None  # for the backlog, each one of its own
        self._radio: VehicleRadio | None = None

    def begin_scan(self, store: ScanStore, config: Config, vehicle: VehicleLink) -> None:
        """Send a scan, in place of the backlog, to the ground stations that are configured. Where
        that cannot be done, the operator is warned, and the scan is only stored."""
        self.end_backlog()
        if config.datalink.radio == OWN_LINKS and self._radio is None:
            from service.radio import VehicleRadio

            self._radio = VehicleRadio(vehicle)
        try:
            self.sender = open_datalink(store, config, self._radio)
        except SkyreliefError as error:
            log.error("the scan is only stored: %s", error)
            vehicle.statustext(f"Scan is only stored: {error}", WARNING)

    def end_scan(self, config: Config, is_next_wanted: bool = False, is_last: bool = False) -> None:
        """End the scan's sender; the backlog sends the rest.

        By radio alone there is no backlog: wait for the rest, unless another scan
        ``is_next_wanted``. The ``is_last`` scan of the process waits, too (:func:`deliver`).
        """
        sender, self.sender = self.sender, None
        if sender is None:
            return
        has_backlog = config.datalink.connect or config.datalink.listen
        if not (is_next_wanted or has_backlog):
            sender.drain(config.datalink.drain_s)
        elif is_last:
            deliver(sender, config.datalink.drain_s)
        sender.close()

    def offer_backlog(self, config: Config, is_idle: Callable[[], bool] = lambda: True) -> None:
        """Send earlier scans that the ground lacks, while ``is_idle`` is true. Ends with
        :meth:`begin_scan` or :meth:`end_backlog`."""
        with self._lock:
            if self._wish is not None or not is_idle():
                return
            self._wish = wish = object()
        PROCESS.start("backlog", lambda _: self._open_backlog(config, wish))

    def _open_backlog(self, config: Config, wish: object) -> None:
        """Open it, which may read much of the disk, unless it has been cancelled meanwhile."""
        try:
            sender = open_backlog(config)
        except SkyreliefError as error:
            log.error("earlier scans are not offered: %s", error)
            return
        with self._lock:
            if self._wish is wish:
                self.backlog, sender = sender, None
        if sender is not None:
            sender.close()

    def end_backlog(self, deliver_s: float = 0.0, wait: Callable[[], None] = lambda: None) -> None:
        """End the backlog, after :func:`deliver` if it may take a while; a separate thread closes
        the rest."""
        with self._lock:
            self._wish = None
            sender, self.backlog = self.backlog, None
        if sender is not None:
            if deliver_s:
                deliver(sender, deliver_s, wait)
            # The process does not end before it has: Zenoh would abort it.
            PROCESS.start("backlog closing", lambda _: sender.close())

    def configure(self, config: Config) -> None:
        for sender in (self.sender, self.backlog):
            if sender is not None:
                sender.set_budget(config.datalink.budget_kbit_s, config.datalink.share)
