"""The ground station: receives the scans of any number of drones into scan folders.

Each scan lives in ``<store>/drones/<drone>/<scan>/scan.db``, the same database as onboard. When a
finished scan is complete, and when the receiver closes, the deliverables are written next to
it. Everything may be killed at any time and started again.

What a drone's messages ask for is decided in :mod:`service.ground.drone` and carried out here.
Threads, all of the table of workers: one keeps the session; one takes each kind of message, and
the replies to each request; each drone has one, so that none waits for another, until it is silent
and has nothing open; one writes deliverables.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import resource
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import zenoh

from service.errors import InputError, SkyreliefError
from service.ground import drone
from service.ground.drone import ReceivedScan
from service.ground.due import FILES, deliver, write_files
from service.ground.front import behind_fronts
from service.ground.storage import DroneLimits
from service.stream.naming import ROOT, place_of, station_name
from service.stream.session import SessionConfig, check_endpoints, open_session
from service.stream.tunnel import TunnelIntake
from service.workers import Worker, Workers, guarded

log = logging.getLogger(__name__)

ASK_TIMEOUT_S = 120.0
RETRY_S, LOOK_AROUND_S, LOOK_S = 1.0, 3.0, 0.2
DROP = zenoh.CongestionControl.DROP
CHANNEL = 256  # messages that may wait in the session, of one kind or to one request
TICK_S, MAX_REST_S = 0.1, 0.5
"""After each turn a drone's worker rests as long as it computed, at most so long: one drone never
takes more than half of a core."""
DESCRIPTORS_PER_SCAN, DESCRIPTOR_SHARE = 3, 4
"""An open scan holds so many; all of them together get this fraction (1/n) of the limit."""
MAX_ITEM_BYTES, MAX_ITEMS = 8 << 20, 4096
MAX_HEADS = 256  # scans of one drone whose newest head may wait
ITEM_BYTES = 200  # bytes that a kept message takes beyond its payload
MAX_RESTING = 256  # drones without a worker whose figures are kept
STRANGER_S = 1.0  # a drone without any scan is replaced by another after so long without a message
REFUSAL_S = 60.0  # interval between two warnings about a drone that is not received


@dataclass(frozen=True, slots=True)
class ReceiverConfig:
    store: Path
    session: SessionConfig = field(default_factory=lambda: SessionConfig(mode="router"))
    limits: DroneLimits = field(default_factory=DroneLimits)
    name: str = ""  # of this station; empty: made once and kept in the store


class DroneMailbox:
    """What waits for a drone's worker: put in from any thread, and bounded so that no drone takes
    another's memory. And the scans of that drone, which the worker alone changes."""

    worker: Worker

    def __init__(self, scans: drone.DroneReceiver) -> None:
        self.scans = scans
        self._changed = threading.Condition()
        self._heads: dict[str, bytes] = {}  # scan to its newest
        self._events: list[drone.Event] = []
        self._bytes = 0
        self.dropped = 0
        self.requests: list[Worker] = []  # take the replies; of its worker alone

    def put_head(self, scan: str, payload: bytes) -> None:
        """A head; it takes the place of one of the same scan that waits."""
        with self._changed:
            if scan in self._heads or len(self._heads) < MAX_HEADS:
                self._heads[scan] = payload
                self._changed.notify()
            else:
                self.dropped += 1

    def put(self, event: drone.Event) -> None:
        """Anything else; only what a drone sends may be too much, as the rest is of our own."""
        with self._changed:
            if isinstance(event, drone.Item | drone.Radio):
                size = len(event.data) + ITEM_BYTES
                if self._bytes + size > MAX_ITEM_BYTES or len(self._events) >= MAX_ITEMS:
                    self.dropped += 1
                    return
                self._bytes += size
            self._events.append(event)
            self._changed.notify()

    def take(self, timeout_s: float) -> tuple[dict[str, bytes], list[drone.Event]]:
        """Heads and events that wait; without any, those that arrive within the timeout."""
        with self._changed:
            self._changed.wait_for(lambda: self._heads or self._events, timeout_s)
            taken = self._heads, self._events
            self._heads, self._events, self._bytes = {}, [], 0
            return taken

    @property
    def brought(self) -> int:
        return sum(e["received_bytes"] + e["radio_messages"] for e in self.scans.entries)


class Receiver:
    """Receives on threads of its own between :meth:`start` and :meth:`close`. Raises InputError for
    endpoints or a store that cannot be used."""

    def __init__(
        self,
        config: ReceiverConfig,
        workers: Workers | None = None,
        deliver: Callable[[Path], None] = deliver,
        opened: Callable[[ReceivedScan], None] = lambda _: None,
        ended: Callable[[Path], None] = lambda _: None,
    ) -> None:
        """``deliver`` writes the deliverables of a scan; ``opened`` gets each that is opened,
        ``ended`` the folder of each that is whole."""
        check_endpoints(config.session)
        self._config, self._deliver, self._opened = config, deliver, opened
        self._ended = ended
        try:
            config.store.mkdir(parents=True, exist_ok=True)
            self.name = config.name or station_name(config.store)
        except OSError as error:
            raise InputError(f"cannot write the store {config.store}: {error.strerror}") from error
        self.limits, self.workers = config.limits, workers or Workers()
        self._session: zenoh.Session | None = None
        self._session_config = config.session
        self._lock = threading.RLock()  # of the table of mailboxes, and of the radio
        self._mailboxes: dict[str, DroneMailbox] = {}  # the last begun last
        self._tunnel = TunnelIntake()
        self._writes: queue.Queue[tuple[drone.Write, DroneMailbox] | None] = queue.Queue()
        self._left: list[Path] = []  # folders whose files a former process did not write
        self._running: list[Worker] = []
        self._dropped = 0
        self._refused_at = -1e9
        self._began_at = time.monotonic()

    def start(self) -> None:
        """Begin; returns when the endpoints are open. Raises OutsideError when they cannot."""
        start = self.workers.start
        self._session_config, fronts = behind_fronts(self._config.session)
        try:
            self._session = open_session(self._session_config)
        except SkyreliefError as error:
            if self._config.session.listen or isinstance(error, InputError):
                for front in fronts:
                    front.close()
                raise
            log.debug("%s", error)  # a station that only connects waits for its router
        self._left = FILES.folders(self._config.store)
        self._running = [
            start("receiver", self._run),
            *(start(f"front {front.endpoint}", front.run) for front in fronts),
            start("deliverables", self._write_all),
        ]

    def close(self) -> None:
        """End, and write the deliverables of what has changed."""
        for worker in self._running:
            if worker.row.name == "deliverables":  # when nothing more comes
                for mailbox in self._all:
                    mailbox.worker.stop.set()
                for mailbox in self._all:
                    mailbox.worker.join()
                    guarded(f"scans of {mailbox.scans.drone}", partial(self._end, mailbox))
                self._writes.put(None)
            worker.join()
        self._running = []

    def add_radio(self, payload: bytes) -> None:
        """Take in a message of the narrow radio; from any thread."""
        with self._lock:
            for item in self._tunnel.receive(payload):
                mailbox = self._mailbox(item[0].drone)
                if mailbox is not None:
                    mailbox.put(drone.Radio(*item))

    def progress(self) -> list[dict[str, Any]]:
        """One entry per scan: drone, scan, items held and missing, bytes, lags, folder."""
        return [entry for mailbox in self._all for entry in mailbox.scans.entries]

    @property
    def dropped(self) -> int:
        """Messages that were malformed, foreign or too many."""
        return self._dropped + sum(mailbox.dropped + mailbox.scans.dropped for mailbox in self._all)

    @property
    def last_news_at(self) -> float:
        """When something new was stored last, or this began; monotonic seconds."""
        return max((mailbox.scans.news_at for mailbox in self._all), default=self._began_at)

    # The session

    def _run(self, worker: Worker) -> None:
        while self._session is not None or not worker.stop.is_set():
            worker.beat()
            try:
                session = self._session = self._session or open_session(self._session_config)
            except SkyreliefError as error:
                log.debug("%s", error)
                worker.stop.wait(RETRY_S)
                continue
            try:
                self._serve(session, worker)
            finally:
                self._session = None
                session.close()
                for taker in self.workers.table():  # each ends with its request, or the session
                    if taker.row.name == "messages":
                        taker.join()

    def _serve(self, session: zenoh.Session, worker: Worker) -> None:
        """Have messages taken until the stop, or until the session ends."""
        ring = zenoh.handlers.RingChannel(1)
        for key in ("head", "item/*/*"):
            channel = zenoh.handlers.FifoChannel(CHANNEL)
            self._take_from(key, session.declare_subscriber(f"{ROOT}/*/*/{key}", channel))
        look_at = 0.0
        while not (worker.stop.wait(LOOK_S) or session.is_closed()):
            worker.beat()
            now = time.monotonic()
            if now >= look_at:
                look_at = now + LOOK_AROUND_S
                if all(now - mailbox.scans.heard_at > LOOK_AROUND_S for mailbox in self._all):
                    with contextlib.suppress(zenoh.ZError):  # all present drones send their heads
                        session.get(f"{ROOT}/*/*/head", ring, timeout=LOOK_AROUND_S)

    def _take_from(
        self, name: str, source: Any, ended: Callable[[], object] = lambda: None
    ) -> Worker:
        """Have a subscriber's samples, or the replies to a request, taken until their end.

        A worker that starts takes the place of a failed one of its name, so a subscriber's has a
        ``name`` of its own.

        A thread of our own: a callback's would belong to the library, and end the process with an
        abort when it outlives the interpreter.
        """

        def work(_: Worker) -> None:
            for message in source:
                sample = message.ok if isinstance(message, zenoh.Reply) else message
                if sample is not None:
                    self._take(str(sample.key_expr), sample.payload.to_bytes())
            ended()

        return self.workers.start(f"messages {name}", work)

    def _take(self, key: str, payload: bytes) -> None:
        place = place_of(key)
        if place is None:
            with self._lock:
                self._dropped += 1
        elif (mailbox := self._mailbox(place[0])) is not None and key.endswith("/head"):
            mailbox.put_head(place[1], payload)
        elif mailbox is not None:
            mailbox.put(drone.Item(place[1], payload))

    # The drones

    @property
    def _all(self) -> list[DroneMailbox]:
        with self._lock:
            return list(self._mailboxes.values())

    @property
    def _busy(self) -> list[DroneMailbox]:
        return [mailbox for mailbox in self._all if not mailbox.worker.is_done]

    def _mailbox(self, name: str) -> DroneMailbox | None:
        """A drone's mailbox, its worker started if need be; None where one more is too many."""
        with self._lock:
            found, now = self._mailboxes.get(name), time.monotonic()
            if found is not None and not found.worker.is_done:
                return found
            if not self._has_room(now):
                self._dropped += 1
                if now - self._refused_at > REFUSAL_S:
                    self._refused_at = now
                    log.warning("%s is not received: %d drones are", name, self.limits.drones)
                return None
            self._sweep(now)
            mailbox = self._mailboxes.pop(name, None)
            if mailbox is None:
                store = self._config.store
                mailbox = DroneMailbox(
                    drone.DroneReceiver(name, store, self.name, self.limits, now)
                )
            mailbox.scans.heard_at = now
            mailbox.worker = self.workers.start(f"drone {name}", partial(self._receive, mailbox))
            self._mailboxes[name] = mailbox
            return mailbox

    def _has_room(self, now: float) -> bool:
        """Whether one more drone may come. If need be one that never had a scan and is silent makes
        way, else the silent one that brought least is stopped, with its scans."""
        busy = self._busy
        if len(busy) < self.limits.drones:
            return True
        for mailbox in busy:
            if not mailbox.scans.entries and now - mailbox.scans.heard_at > STRANGER_S:
                self._forget(mailbox)
                return True
        silent = [
            mailbox for mailbox in busy if now - mailbox.scans.heard_at > self.limits.silent_s
        ]
        if silent:
            least = min(silent, key=lambda mailbox: (mailbox.brought, mailbox.scans.heard_at))
            least.worker.stop.set()
        return False

    def _sweep(self, now: float) -> None:
        """Forget strangers and faults that have ended, and the oldest of too many others."""
        ended = [mailbox for mailbox in self._all if mailbox.worker.is_done]
        known = [
            mailbox for mailbox in ended if mailbox.scans.entries and not mailbox.worker.has_failed
        ]
        for mailbox in set(ended) - set(known[-MAX_RESTING:]):
            self._end(mailbox)
            self._forget(mailbox)

    def _forget(self, mailbox: DroneMailbox) -> None:
        mailbox.worker.stop.set()
        self._dropped += mailbox.dropped + mailbox.scans.dropped
        del self._mailboxes[mailbox.scans.drone]

    def _receive(self, mailbox: DroneMailbox, worker: Worker) -> None:
        """Take in what arrives from one drone, until the stop or until nothing more comes."""
        scans, now = mailbox.scans, time.monotonic()
        while not (worker.stop.is_set() or scans.is_idle(now)):
            worker.beat()
            came = mailbox.take(TICK_S)
            began_s, now = time.thread_time(), time.monotonic()
            descriptors, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
            room = descriptors // DESCRIPTOR_SHARE // DESCRIPTORS_PER_SCAN
            room //= max(1, len(self._busy))
            scans.max_open = max(2, min(self.limits.open_scans, room))
            for effect in scans.handle(*came, now):
                self._perform(mailbox, effect)
            worker.stop.wait(min(time.thread_time() - began_s, MAX_REST_S))
        self._end(mailbox)

    def _end(self, mailbox: DroneMailbox) -> None:
        """Close the scans of a drone whose worker ends, or has ended by a fault."""
        for effect in mailbox.scans.close(time.monotonic()):
            self._perform(mailbox, effect)

    # Effects

    def _perform(self, mailbox: DroneMailbox, effect: drone.Effect) -> None:
        """Carry out what a drone's worker has decided; what follows is put into it. Without a
        session nothing is sent: what it was for is due again."""
        session, high = self._session, zenoh.Priority.INTERACTIVE_HIGH
        match effect:
            case drone.Write():
                self._writes.put((effect, mailbox))
            case drone.Opened(scan):
                self._opened(scan)
            case drone.Put() | drone.Get() if session is not None:
                try:
                    if isinstance(effect, drone.Get):
                        self._ask(session, mailbox, effect)
                    else:
                        session.put(*effect, priority=high, congestion_control=DROP, express=True)
                except zenoh.ZError as error:
                    log.debug("%s is not sent: %s", effect.key, error)

    def _ask(self, session: zenoh.Session, mailbox: DroneMailbox, request: drone.Get) -> None:
        """Send a request. One beyond the drone's share is over at once, so that it is made again
        after a pause."""
        mailbox.requests = [taker for taker in mailbox.requests if not taker.is_done]
        if len(mailbox.requests) >= self.limits.requests // max(1, len(self._busy)):
            mailbox.put(request.answered)
            return
        replies = session.get(
            request.key,
            zenoh.handlers.FifoChannel(CHANNEL),
            payload=request.payload,
            priority=zenoh.Priority.BACKGROUND,
            congestion_control=DROP,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=ASK_TIMEOUT_S,
        )
        answered = partial(mailbox.put, request.answered)
        mailbox.requests.append(self._take_from("replies", replies, answered))

    def _write_all(self, worker: Worker) -> None:
        """Write deliverables until the end: those asked for first, and between them what a former
        process left, which at the end is for the next."""
        while True:
            try:
                asked = self._writes.get(block=not self._left)
            except queue.Empty:
                write_files(self._left.pop(0), self._deliver, is_left=True)
                continue
            if asked is None:
                return
            effect, mailbox = asked
            trouble, is_due = write_files(effect.folder, self._deliver)
            mailbox.put(drone.Written(effect.scan, trouble, is_due))
            if effect.is_whole and not trouble:
                guarded(f"end of {effect.folder}", partial(self._ended, effect.folder))
