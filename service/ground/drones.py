"""The drones that a ground station receives, each with a worker, so that none waits for another."""

from __future__ import annotations

import logging
import resource
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from service.ground.drone import DroneLimits, DroneReceiver, Effect
from service.ground.received import ReceivedScan
from service.workers import Worker, Workers

log = logging.getLogger(__name__)

TICK_S = 0.1
MAX_REST_S = 0.5
"""After each turn a worker rests as long as it computed, at most so long: one drone never
takes more than half of a core."""
DESCRIPTORS_PER_SCAN, DESCRIPTOR_SHARE = 3, 4
"""An open scan holds so many; all of them together get this fraction (1/n) of the limit."""
MAX_RESTING = 256
"""Drones without a worker whose figures are kept."""
STRANGER_S = 1.0
"""A drone without any scan is replaced by another after so long without a message."""
REFUSAL_S = 60.0
"""Interval between two warnings about a drone that is not received."""


class _Present(NamedTuple):
    drone: DroneReceiver
    worker: Worker


class Drones:
    """The table of drones. Safe between threads, but for :meth:`retire` and :meth:`close`."""

    def __init__(
        self,
        store: Path,
        station: str,
        limits: DroneLimits,
        workers: Workers,
        perform: Callable[[DroneReceiver, Effect], None],
    ) -> None:
        """``perform`` carries out an effect, on the drone's worker."""
        self._new = partial(DroneReceiver, store=store, station=station, limits=limits)
        self._workers, self._limits, self._perform = workers, limits, perform
        self._lock = threading.Lock()
        self._present: dict[str, _Present] = {}  # those that have a worker
        self._resting: OrderedDict[str, DroneReceiver] = OrderedDict()
        self._refused_at = -1e9
        self._is_wanted = False  # a drone was refused since the last turn
        self._dropped = 0  # messages of drones that left

    def get(self, name: str) -> DroneReceiver | None:
        """A drone, its worker started if need be; None when there are too many."""
        with self._lock:
            found = self._present.get(name)
            if found is not None:
                return found.drone
            now = time.monotonic()
            if len(self._present) >= self._limits.drones and not self._make_way(now):
                self._is_wanted = True
                if now - self._refused_at > REFUSAL_S:
                    self._refused_at = now
                    log.warning("%s is not received: %d drones are", name, self._limits.drones)
                return None
            drone = self._resting.pop(name, None) or self._new(name, now=now)
            drone.heard_at = now
            worker = self._workers.start(f"drone {name}", partial(self._run, drone))
            self._present[name] = _Present(drone, worker)
            return drone

    def _run(self, drone: DroneReceiver, worker: Worker) -> None:
        """Take in what arrives until the worker stops."""
        while not worker.stop.is_set():
            worker.beat()
            batch = drone.inbox.take(TICK_S)
            began_s = time.thread_time()
            drone.max_open = self._max_open()
            for effect in drone.handle(batch, time.monotonic()):
                self._perform(drone, effect)
            worker.stop.wait(min(time.thread_time() - began_s, MAX_REST_S))
        drone.show(time.monotonic())

    @property
    def all(self) -> list[DroneReceiver]:
        with self._lock:
            return [drone for drone, _ in self._present.values()]

    @property
    def _known(self) -> list[DroneReceiver]:
        with self._lock:
            resting = list(self._resting.values())
        return [*self.all, *resting]

    @property
    def entries(self) -> list[dict[str, Any]]:
        return [entry for drone in self._known for entry in drone.entries]

    @property
    def dropped(self) -> int:
        return self._dropped + sum(_dropped_of(drone) for drone in self.all)

    @property
    def news_at(self) -> float:
        """When something new was stored last; monotonic seconds, or minus infinity."""
        return max((drone.news_at for drone in self._known), default=float("-inf"))

    def _max_open(self) -> int:
        """Scans that one drone may have open now."""
        soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        room = soft // DESCRIPTOR_SHARE // DESCRIPTORS_PER_SCAN
        return max(2, min(self._limits.open_scans, room // max(1, len(self._present))))

    def retire(self, now: float) -> None:
        """End the workers of drones that are silent and have nothing open, or that failed.

        While drones are refused, the silent one with least data is removed, with its scans.
        """
        with self._lock:
            gone = {
                name: one
                for name, one in self._present.items()
                if one.worker.is_done or (not one.drone.scans and self._is_silent(one.drone, now))
            }
            if self._is_wanted and len(self._present) - len(gone) >= self._limits.drones:
                gone |= self._min_silent(now)
            self._is_wanted = False
            for name in gone:
                del self._present[name]
        for name, (drone, worker) in gone.items():
            worker.join()
            drone.close_all()
            with self._lock:
                self._resting.pop(name, None)
                if drone.is_known and not worker.has_failed:
                    self._resting[name] = drone
                else:
                    self._dropped += _dropped_of(drone)
                while len(self._resting) > MAX_RESTING:
                    self._resting.popitem(last=False)

    def close(self) -> list[ReceivedScan]:
        """End all workers; the scans that are open."""
        for _, worker in self._present.values():
            worker.stop.set()
        for _, worker in self._present.values():
            worker.join()
        return [scan for drone in self.all for scan in drone.scans]

    def _is_silent(self, drone: DroneReceiver, now: float) -> bool:
        return now - drone.heard_at > self._limits.silent_s

    def _min_silent(self, now: float) -> dict[str, _Present]:
        """The silent drone that brought least, the one heard longest ago of several; or none."""
        silent = [
            (
                sum(e["received_bytes"] + e["radio_messages"] for e in one.drone.entries),
                one.drone.heard_at,
                name,
            )
            for name, one in self._present.items()
            if self._is_silent(one.drone, now)
            and not any(scan.is_writing for scan in one.drone.scans)
        ]
        return {name: self._present[name] for *_, name in sorted(silent)[:1]}

    def _make_way(self, now: float) -> bool:
        """End the worker of a drone that never had a scan and is silent; False for none."""
        for name, (drone, worker) in self._present.items():
            if not drone.is_known and now - drone.heard_at > STRANGER_S:
                worker.stop.set()
                self._dropped += _dropped_of(drone)
                del self._present[name]
                return True
        return False


def _dropped_of(drone: DroneReceiver) -> int:
    return drone.dropped + drone.inbox.dropped
