"""The ground station: receives the scans of any number of drones into scan folders.

Each scan lives in ``<store>/drones/<drone>/<scan>/scan.db``, the same database as onboard. When a
finished scan is complete, and when the receiver closes, the deliverables are written next to
it. Everything may be killed at any time and started again.

Threads, all of the table of workers: one that keeps the session, three that take messages
from it, one per drone (:mod:`service.ground.drones`), one that writes deliverables, and one that
aligns finished scans (:mod:`service.ground.sites`). A process aligns those in flight
(:mod:`service.ground.live_site`).
"""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.errors import InputError, OutsideError, SkyreliefError
from service.ground.drone import Align, DroneLimits, DroneReceiver, Effect, Get, Opened, Put, Write
from service.ground.drones import Drones
from service.ground.front import behind_fronts
from service.ground.inbox import CHANNEL, Inbox, Pending, Radio, Replies, Written
from service.ground.live_site import run as run_live_site
from service.ground.received import (
    ReceivedScan,
    begin_files,
    deliver,
    end_files,
    folders_due,
    write_left,
)
from service.ground.sites import Sites
from service.stream.naming import ROOT, place_of, station_name
from service.stream.session import SessionConfig, check_endpoints, open_session
from service.stream.tunnel import TunnelIntake
from service.workers import Worker, Workers, guarded

if TYPE_CHECKING:
    import zenoh

log = logging.getLogger(__name__)

ASK_TIMEOUT_S = 120.0
RETRY_S = 1.0
LOOK_AROUND_S = 3.0
TURN_S = 0.1


@dataclass(frozen=True, slots=True)
class ReceiverConfig:
    """A ground station's endpoints, store and limits."""

    store: Path
    session: SessionConfig = field(default_factory=lambda: SessionConfig(mode="router"))
    limits: DroneLimits = field(default_factory=DroneLimits)
    name: str = ""  # of this station; empty: made once and kept in the store
    sites: bool = False  # align finished scans that show the same ground


class Receiver:
    """Receives on threads of its own between :meth:`start` and :meth:`close`.

    Raises InputError for endpoints or a store that cannot be used.
    """

    def __init__(
        self,
        config: ReceiverConfig,
        workers: Workers | None = None,
        deliver: Callable[[ReceivedScan], None] = deliver,
        opened: Callable[[ReceivedScan], None] = lambda _: None,
    ) -> None:
        """``deliver`` writes the deliverables of a scan; ``opened`` gets each that is opened."""
        check_endpoints(config.session)
        self._config, self._deliver, self._opened_scan = config, deliver, opened
        try:
            config.store.mkdir(parents=True, exist_ok=True)
            self.name = config.name or station_name(config.store)
        except OSError as error:
            raise InputError(f"cannot write the store {config.store}: {error.strerror}") from error
        self.limits = config.limits
        self.workers = workers or Workers()
        self._drones = Drones(config.store, self.name, config.limits, self.workers, self._perform)
        self._session: zenoh.Session | None = None
        self._replies = Replies()
        self._opened = threading.Event()
        self._failure: SkyreliefError | None = None
        self._tunnel, self._tunnelled = TunnelIntake(), threading.Lock()
        self._writes: queue.Queue[tuple[ReceivedScan, Inbox | None] | None] = queue.Queue()
        self._sites = Sites(config.store, config.limits)
        self._running: list[Worker] = []
        self._fronts: list[Worker] = []
        self._session_config = config.session
        self._dropped = 0
        self._began_at = time.monotonic()

    def start(self) -> None:
        """Begin; returns when the endpoints are open. Raises OutsideError when they cannot."""
        start = self.workers.start
        self._session_config, fronts = behind_fronts(self._config.session)
        self._fronts = [start(f"front {front.endpoint}", front.run) for front in fronts]
        self._running = [
            start("deliverables", self._write_all),
            start("replies", self._replies.run),
            start("receiver", self._run),
            *(self._start_sites() if self._config.sites else ()),
        ]
        while not self._opened.wait(0.1):
            if self._failure is not None:
                self.close()
                raise self._failure

    def _start_sites(self) -> list[Worker]:
        in_flight = partial(run_live_site, self._config.store)
        start = self.workers.start
        return [start("sites", self._sites.run), start("live site", in_flight)]

    def close(self) -> None:
        """End, and write the deliverables of what has changed."""
        if not self._running:
            return
        writer, replies, main, *sites = self._running
        self._running = []
        main.join()
        replies.join()
        for front in self._fronts:
            front.join()
        scans = self._drones.close()
        for scan in scans:
            if scan.unwritten:  # also one that grew while it was being written
                self._writes.put((scan, None))
        self._writes.put(None)
        writer.join()
        for worker in sites:
            worker.join()
        for scan in scans:
            scan.intake.store.close()

    def add_radio(self, payload: bytes) -> None:
        """Take in a message of the narrow radio; from any thread."""
        with self._tunnelled:
            items = self._tunnel.receive(payload)
        for item in items:
            drone = self._drones.get(item[0].drone)
            if drone is None:
                self._dropped += 1
            else:
                drone.inbox.put_event(Radio(*item))

    def progress(self) -> list[dict[str, Any]]:
        """One entry per scan: drone, scan, items held and missing, bytes, lags, folder."""
        return self._drones.entries

    @property
    def dropped(self) -> int:
        """Messages that were malformed, foreign or too many."""
        return self._dropped + self._drones.dropped

    @property
    def last_news_at(self) -> float:
        """When something new was stored last, or this began; monotonic seconds."""
        return max(self._began_at, self._drones.news_at)

    # The session

    def _run(self, worker: Worker) -> None:
        while not worker.stop.is_set():
            worker.beat()
            try:
                session = open_session(self._session_config)
            except SkyreliefError as error:
                if not self._opened.is_set() and (
                    self._config.session.listen or isinstance(error, InputError)
                ):
                    self._failure = error
                    return
                log.debug("%s", error)
                self._opened.set()  # a station that only connects waits for its router
                worker.stop.wait(RETRY_S)
                continue
            try:
                self._serve(session, worker)
            finally:
                self._session = None
                session.close()

    def _serve(self, session: zenoh.Session, worker: Worker) -> None:
        """Take messages until the stop, or until the session ends.

        Channels and threads of our own: a callback's thread would belong to the library, and
        end the process with an abort when it outlives the interpreter.
        """
        import zenoh

        channel = zenoh.handlers.FifoChannel(CHANNEL)
        heads = session.declare_subscriber(f"{ROOT}/*/*/head", channel)
        items = session.declare_subscriber(f"{ROOT}/*/*/item/*/*", channel)
        pumps = [
            self.workers.start("heads", lambda _: self._pump(heads, Inbox.put_head)),
            self.workers.start("items", lambda _: self._pump(items, Inbox.put_item)),
        ]
        self._session = session
        self._opened.set()
        look_at = 0.0
        try:
            while not worker.stop.wait(TURN_S) and not session.is_closed():
                worker.beat()
                now = time.monotonic()
                if now >= look_at:
                    self._look_around(session, now)
                    look_at = now + LOOK_AROUND_S
                self._drones.retire(now)
        finally:
            for subscriber in (heads, items):
                with contextlib.suppress(zenoh.ZError):
                    subscriber.undeclare()
            for pump in pumps:
                pump.join()

    def _pump(
        self,
        subscriber: zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]],
        put: Callable[[Inbox, str, bytes], bool],
    ) -> None:
        """Hand on each message until the subscriber ends."""
        for sample in subscriber:
            place = place_of(str(sample.key_expr))
            drone = None if place is None else self._drones.get(place[0])
            if place is None or drone is None:
                self._dropped += 1
                continue
            put(drone.inbox, place[1], sample.payload.to_bytes())

    def _look_around(self, session: zenoh.Session, now: float) -> None:
        """Ask all present drones for their heads at once."""
        import zenoh

        if any(now - drone.heard_at < LOOK_AROUND_S for drone in self._drones.all):
            return
        with contextlib.suppress(zenoh.ZError):
            session.get(f"{ROOT}/*/*/head", zenoh.handlers.RingChannel(1), timeout=LOOK_AROUND_S)

    # Effects

    def _perform(self, drone: DroneReceiver, effect: Effect) -> None:
        """Carry out what a drone's worker has decided."""
        match effect:
            case Put(key, payload):
                self._put(key, payload)
            case Get():
                self._get(drone.inbox, effect)
            case Write(scan):
                self._writes.put((scan, drone.inbox))
            case Opened(scan):
                self._opened_scan(scan)
            case Align(folder):
                self.align(folder)

    def _put(self, key: str, payload: bytes) -> None:
        """Publish; nothing happens while there is no session."""
        import zenoh

        session = self._session
        if session is None:
            return
        try:
            session.put(
                key,
                payload,
                priority=zenoh.Priority.INTERACTIVE_HIGH,
                congestion_control=zenoh.CongestionControl.DROP,
                express=True,
            )
        except zenoh.ZError as error:
            log.debug("report not sent: %s", error)

    def _get(self, inbox: Inbox, effect: Get) -> None:
        """Ask a drone; what comes, from another thread, goes to its inbox."""
        import zenoh

        session = self._session
        if session is None:
            return
        try:
            replies = session.get(
                effect.key,
                zenoh.handlers.FifoChannel(CHANNEL),
                payload=effect.payload,
                priority=zenoh.Priority.BACKGROUND,
                congestion_control=zenoh.CongestionControl.DROP,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=ASK_TIMEOUT_S,
            )
        except zenoh.ZError as error:
            log.debug("request not sent: %s", error)
            return
        self._replies.add(Pending(replies, inbox, effect.scan, effect.answered))

    def align(self, folder: Path) -> None:
        """Align a finished scan with those that show the same ground, if configured."""
        if self._config.sites:
            self._sites.put(folder)

    def _write_all(self, worker: Worker) -> None:
        """Write requested deliverables, and in between those that a former process left."""
        left = deque(folders_due(self._config.store))
        while True:
            try:
                asked = self._writes.get(block=not left)
            except queue.Empty:
                folder = left.popleft()
                if worker.stop.is_set():
                    left.clear()  # for the next process
                else:
                    guarded(f"files of {folder}", partial(write_left, folder))
                continue
            if asked is None:
                return
            scan, inbox = asked
            written = written_files(scan, self._deliver)
            if inbox is not None:
                inbox.put_event(written)


def written_files(scan: ReceivedScan, deliver: Callable[[ReceivedScan], None]) -> Written:
    """Have ``deliver`` write a scan's files. What the disk refuses stays due, whatever an earlier
    ``scan.json`` says; a fault in the scan itself would only come again."""
    is_refused = False

    def work() -> None:
        nonlocal is_refused
        try:
            deliver(scan)
        except (OutsideError, OSError):
            is_refused = True
            raise

    begin_files(scan.folder)
    trouble = guarded(f"deliverables of {scan.folder}", work)
    if not is_refused:
        end_files(scan.folder)
    return Written(scan, trouble, is_refused)
