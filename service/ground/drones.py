"""The drones that a ground station receives, each with its worker; few at once."""

from __future__ import annotations

import logging
import resource
import threading
import time
from collections import OrderedDict
from typing import TYPE_CHECKING, Any

from service.ground.drone import DroneReceiver
from service.ground.received import ReceivedScan
from service.workers import Workers

if TYPE_CHECKING:
    from service.ground.receiver import Receiver

log = logging.getLogger(__name__)

DESCRIPTORS_PER_SCAN, DESCRIPTOR_SHARE = 3, 4
"""An open scan holds so many; all of them together get this fraction (1/n) of the limit."""
MAX_RESTING = 256
"""Drones without a worker whose figures are kept."""
STRANGER_S = 1.0
"""A drone without any scan is replaced by another after so long without a message."""
REFUSAL_S = 60.0
"""Interval between two warnings about a drone that is not received."""


class Drones:
    """The table of drones. Safe between threads, but for :meth:`retire` and :meth:`close`."""

    def __init__(self, station: Receiver, workers: Workers) -> None:
        self._station, self._workers, self._limits = station, workers, station.limits
        self._lock = threading.Lock()
        self._drones: dict[str, DroneReceiver] = {}  # those that have a worker
        self._resting: OrderedDict[str, DroneReceiver] = OrderedDict()
        self._refused_at = -1e9
        self._is_wanted = False  # a drone was refused since the last turn
        self._dropped = 0  # messages of drones that left

    def get(self, name: str) -> DroneReceiver | None:
        """A drone, its worker started if need be; None when there are too many."""
        with self._lock:
            found = self._drones.get(name)
            if found is not None:
                return found
            if len(self._drones) >= self._limits.drones and not self._make_way():
                self._is_wanted = True
                if time.monotonic() - self._refused_at > REFUSAL_S:
                    self._refused_at = time.monotonic()
                    log.warning("%s is not received: %d drones are", name, self._limits.drones)
                return None
            drone = self._resting.pop(name, None) or DroneReceiver(name, self._station)
            drone.heard_at = time.monotonic()
            drone.worker = self._workers.start(f"drone {name}", drone.run)
            self._drones[name] = drone
            return drone

    def present(self, name: str) -> DroneReceiver | None:
        """A drone that has a worker."""
        return self._drones.get(name)

    @property
    def all(self) -> list[DroneReceiver]:
        """Those that have a worker."""
        with self._lock:
            return list(self._drones.values())

    @property
    def entries(self) -> list[dict[str, Any]]:
        """One entry per scan."""
        with self._lock:
            drones = [*self._drones.values(), *self._resting.values()]
        return [entry for drone in drones for entry in drone.entries]

    @property
    def dropped(self) -> int:
        """Messages that were malformed or too many."""
        return self._dropped + sum(drone.dropped + drone.inbox.dropped for drone in self.all)

    @property
    def max_open(self) -> int:
        """Scans that one drone may have open now."""
        soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        room = soft // DESCRIPTOR_SHARE // DESCRIPTORS_PER_SCAN
        return max(2, min(self._limits.open_scans, room // max(1, len(self._drones))))

    def retire(self, now: float) -> None:
        """End the workers of drones that are silent and have nothing open, or that failed.

        While drones are refused, the silent one with least data is removed, with its scans.
        """
        with self._lock:
            gone = {
                name: drone
                for name, drone in self._drones.items()
                if drone.worker.is_done
                or (not drone.scans and now - drone.heard_at > self._limits.silent_s)
            }
            if self._is_wanted and len(self._drones) - len(gone) >= self._limits.drones:
                gone |= self._min_silent(now)
            self._is_wanted = False
            for name in gone:
                del self._drones[name]
        for name, drone in gone.items():
            drone.worker.join()
            drone.close_all()
            with self._lock:
                self._resting.pop(name, None)
                if drone.is_known and not drone.worker.has_failed:
                    self._resting[name] = drone
                else:
                    self._dropped += drone.dropped + drone.inbox.dropped
                while len(self._resting) > MAX_RESTING:
                    self._resting.popitem(last=False)

    def close(self) -> list[ReceivedScan]:
        """End all workers; the scans that are open."""
        for drone in self._drones.values():
            drone.worker.stop.set()
        for drone in self._drones.values():
            drone.worker.join()
        return [scan for drone in self._drones.values() for scan in drone.scans]

    def _min_silent(self, now: float) -> dict[str, DroneReceiver]:
        """The silent drone that brought least, the one heard longest ago of several; or none."""
        silent = [
            (
                sum(e["received_bytes"] + e["radio_messages"] for e in drone.entries),
                drone.heard_at,
                name,
            )
            for name, drone in self._drones.items()
            if now - drone.heard_at > self._limits.silent_s
            and not any(scan.is_writing for scan in drone.scans)
        ]
        return {name: self._drones[name] for *_, name in sorted(silent)[:1]}

    def _make_way(self) -> bool:
        """End the worker of a drone that never had a scan and is silent; False for none."""
        now = time.monotonic()
        for name, drone in self._drones.items():
            if not drone.is_known and now - drone.heard_at > STRANGER_S:
                drone.worker.stop.set()
                self._dropped += drone.dropped + drone.inbox.dropped
                del self._drones[name]
                return True
        return False
