"""The drone's end of the datalink: sends the items of its stores to ground stations."""

from __future__ import annotations

import atexit
import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

from service.config import DatalinkConfig
from service.errors import InputError, OutsideError, SkyreliefError
from service.stream.database import Listener
from service.stream.messages import Ask, Held, unpack
from service.stream.naming import ROOT, check_name
from service.stream.outbox import Outbox, Outgoing
from service.stream.ranges import RangeSet, ranges_from_text
from service.stream.reports import TAKE_S, HeldNotes, Reports
from service.stream.session import (
    SessionConfig,
    check_endpoints,
    is_encrypted,
    open_session,
)
from service.stream.store import ScanStore
from service.stream.tunnel import Carrier, RadioSender
from service.workers import Worker, Workers

if TYPE_CHECKING:
    import zenoh

log = logging.getLogger(__name__)

MAX_WAITING_EVENTS = 100_000
CHANNEL = 256  # maximum queued messages between the session and each of our threads
MAX_WAITING_ASKS = 64
RETRY_S = 1.0  # minimum interval between attempts to open a session; a tenth of it after a timeout
SILENCE_S = 5.0
"""When all stations heard on a session are silent for this long, a new one is opened: TCP backs off
before it retries a dead connection."""
LOOK_S = 0.2  # interval between two looks at a session
FIRST_PATIENCE_S, MIN_PATIENCE_S = 10.0, 1.5
PATIENCE = 3.0
"""Timeout of an attempt, as a multiple of the last one: a new session finds a recovered link sooner
than one whose retries have backed off."""
PATIENT_ATTEMPT = 20
CLOSING_S, PROMPT_CLOSING_S = 15.0, 1.0
"""Closing a session over a dead link takes Zenoh 10 s and more; only the process's end waits."""
PRIORITIES = ("REAL_TIME", "INTERACTIVE_HIGH", "DATA_HIGH", "DATA", "DATA_LOW", "BACKGROUND")
"""Zenoh's priority for each lane of the outbox."""


@dataclass(frozen=True, slots=True)
class LinkProgress:
    connected: bool  # a session is open
    listened: bool  # a ground station was heard recently
    items: int  # items in the stores: poses, layers …
    lacking: dict[str, int] = field(default_factory=dict)  # by kind, at the best ground station
    rate_kbit_s: float = 0.0  # allowed now; below the budget when less comes through

    @property
    def complete(self) -> bool:
        """Whether a ground station holds everything."""
        return self.items > 0 and not self.lacking


@dataclass(slots=True, eq=False)
class _LinkSession:
    config: SessionConfig
    session: zenoh.Session | None = None  # while it is open
    heard_at: float | None = None  # on this session; monotonic s

    def is_silent(self, for_s: float) -> bool:
        """Whether those heard on it are silent. Who is called waits for the others to call."""
        at = self.heard_at
        is_caller = not self.config.listen
        return is_caller and at is not None and time.monotonic() - at > for_s


class DatalinkSender:
    """Publishes a scan while it grows, and answers requests of ground stations. All puts happen on
    its own thread. Each endpoint of ``config.connect`` has a client session of its own: as a router
    between two stations the drone would carry their messages over its radio, and its rights at one
    station would decide what the other one gets. Without endpoints in ``config`` nothing is opened.
    Raises InputError when an endpoint or a name cannot be used; a ground station that is not there
    yet is waited for. Between flights ``store`` is None and ``drone`` says whose scans :meth:`add`
    will bring. ``radio`` carries the narrow fallback.
    """

    def __init__(
        self,
        store: ScanStore | None,
        config: DatalinkConfig,
        drone: str = "",
        radio: Carrier | None = None,
        opener: Callable[[SessionConfig], zenoh.Session] = open_session,
    ) -> None:
        self._open_session = opener
        self.silence_s = SILENCE_S
        self._drone = check_name(drone if store is None else store.header.drone, "drone")
        self._connections = [_LinkSession(config) for config in sessions(config)]
        self._lock = threading.Lock()  # of the outbox
        self._outbox = Outbox(_rate(config.budget_kbit_s, config.share), time.monotonic())
        self._stores: list[tuple[ScanStore, Listener, bool]] = []  # True: closed with the sender
        self._events: deque[Callable[[float], None]] = deque(maxlen=MAX_WAITING_EVENTS)
        self._asks: deque[tuple[Any, str, str, RangeSet, Ask]] = deque()
        self._reports, self._notes = Reports(self._outbox), HeldNotes(self._outbox)
        self._heads_are_asked = False  # a ground station asks for the heads
        self._wake = threading.Event()
        self._stop = threading.Event()
        self._workers = Workers()
        self._threads: list[Worker] = []
        self._radio = None
        if store is not None and radio is not None:
            rate_bytes_s = config.radio_baud / 10 * config.radio_share
            self._radio = RadioSender(
                store, rate_bytes_s, radio, lambda: not self._listened(), self._workers
            )
        if store is not None:
            self.add(store)
        if self._connections:
            self._threads.append(self._workers.start("datalink", self._serve))
        for connection in self._connections:
            name = f"datalink {' '.join(connection.config.connect) or 'calls'}"
            self._threads.append(self._workers.start(name, partial(self._keep_open, connection)))
        atexit.register(self.close)  # Zenoh aborts a process that ends around an open session

    def _listened(self) -> bool:
        with self._lock:
            return self._outbox.listened(time.monotonic())

    # The scan's side

    def add(self, store: ScanStore, owned: bool = False) -> None:
        """Offer another scan of this drone too, such as one that the ground still lacks. An
        ``owned`` store is closed with the sender."""
        scan_id = check_name(store.header.name, "scan")

        def on_item(kind: str, number: int) -> None:
            self._post(lambda now: self._outbox.on_item(scan_id, kind, number, now))

        with self._lock:
            self._outbox.add(store, time.monotonic())
        store.listen(on_item)
        self._stores.append((store, on_item, owned))
        self._wake.set()

    def set_budget(self, budget_kbit_s: float, share: float) -> None:
        rate = _rate(budget_kbit_s, share)
        self._post(lambda now: self._outbox.set_rate(rate, now))

    @property
    def progress(self) -> LinkProgress:
        with self._lock:
            items = 0
            lacking: dict[str, int] = {}
            for store, *_ in self._stores:
                items += sum(map(len, store.numbers().values()))
                for kind, numbers in self._outbox.lacking(store.header.name).items():
                    lacking[kind] = lacking.get(kind, 0) + len(numbers)
            listened = self._outbox.listened(time.monotonic())
            rate_kbit_s = self._outbox.bucket.rate_bytes_s / 125
            return LinkProgress(bool(self._open_sessions), listened, items, lacking, rate_kbit_s)

    def drain(self, timeout_s: float) -> bool:
        """Wait until a ground station holds everything; False when the time is up.

        With the narrow radio alone it waits until all was sent once, and is False: the radio
        carries only the coarse map.
        """
        deadline = time.monotonic() + timeout_s
        while not self.progress.complete:
            is_on_its_way = self._threads or (self._radio and not self._radio.all_sent)
            if time.monotonic() >= deadline or not is_on_its_way:
                return False
            time.sleep(0.05)
        return True

    def close(self) -> None:
        """Stop sending; stores that are not owned stay open."""
        atexit.unregister(self.close)
        self._stop.set()
        self._wake.set()
        deadline = time.monotonic() + CLOSING_S
        while self._threads:
            self._threads.pop().join(max(0.0, deadline - time.monotonic()))
        if self._radio is not None:
            self._radio.close()
            self._radio = None
        while self._stores:
            store, listener, owned = self._stores.pop()
            store.unlisten(listener)
            self._notes.keep(store, time.monotonic(), is_last=True)
            if owned:
                store.close()

    def _post(self, event: Callable[[float], None]) -> None:
        self._events.append(event)
        self._wake.set()

    # The link's side

    @property
    def _open_sessions(self) -> list[zenoh.Session]:
        return [c.session for c in self._connections if c.session is not None]

    def _keep_open(self, connection: _LinkSession, _: Worker) -> None:
        """Keep a session open until the stop; a new one follows when its stations fall silent."""
        attempt = 0
        opening_s = FIRST_PATIENCE_S / PATIENCE  # what the last session took to open
        while not self._stop.is_set():
            began = time.monotonic()
            attempt += 1
            patience = max(PATIENCE * opening_s, MIN_PATIENCE_S)
            if attempt % PATIENT_ATTEMPT == 0:  # the link may have become a slower one
                patience = FIRST_PATIENCE_S
            try:
                session = self._open_session(replace(connection.config, open_timeout_s=patience))
            except OutsideError as error:
                log.log(logging.WARNING if attempt == 1 else logging.DEBUG, "%s", error)
                pause = max(RETRY_S / 10, RETRY_S - (time.monotonic() - began))
                self._stop.wait(pause)
                continue
            except SkyreliefError as error:
                log.error("datalink stays closed: %s", error)
                return
            opening_s = time.monotonic() - began
            attempt = 0
            log.info("datalink open")
            pumps: list[Worker] = []
            try:
                pumps = self._listen(connection, session)
                self._begin(connection, session)
                while not self._stop.wait(LOOK_S) and not session.is_closed():
                    if connection.is_silent(self.silence_s):
                        log.info("datalink silent; opening it again")
                        break
            finally:
                connection.session = None
                self._close_session(session, pumps)

    def _begin(self, connection: _LinkSession, session: zenoh.Session) -> None:
        """Send on a session that has just been opened too."""
        now = time.monotonic()
        with self._lock:
            if not self._open_sessions:
                self._outbox.reconnected(now)
            self._outbox.publish_heads(now)
            connection.session, connection.heard_at = session, None
        self._wake.set()

    def _close_session(self, session: zenoh.Session, pumps: list[Worker]) -> None:
        """Close it on a separate thread: over a dead link that takes long."""
        with self._lock:
            if not self._open_sessions:
                self._asks.clear()
                self._outbox.forget_requests()
        closed = threading.Event()

        def wait() -> None:
            closed.wait(CLOSING_S)

        def close(_: Worker) -> None:
            import zenoh

            with contextlib.suppress(zenoh.ZError):
                session.close()
            for pump in pumps:
                pump.join()
            atexit.unregister(wait)
            closed.set()

        atexit.register(wait)
        self._workers.start("datalink closing", close)
        if self._stop.is_set():
            closed.wait(PROMPT_CLOSING_S)

    def _listen(self, connection: _LinkSession, session: zenoh.Session) -> list[Worker]:
        """Workers that take what arrives. They end with the session.

        Channels and threads of our own: a callback's thread would belong to the library, and
        end the process with an abort when it outlives the interpreter.
        """
        import zenoh

        base, channel = f"{ROOT}/{self._drone}", zenoh.handlers.FifoChannel(CHANNEL)
        held = session.declare_subscriber(f"{base}/*/held/*", channel)
        asks = session.declare_queryable(f"{base}/*/item/*/*", channel)
        head_queries = session.declare_queryable(f"{base}/*/head", channel)
        start = self._workers.start
        return [
            start("datalink reports", lambda _: _pump(held, partial(self._on_held, connection))),
            start("datalink requests", lambda _: _pump(asks, partial(self._on_query, connection))),
            start("datalink looks", lambda _: _pump(head_queries, self._on_head_query)),
        ]

    def _serve(self, _: Worker) -> None:
        while not self._stop.is_set():
            self._wake.clear()
            sessions = self._open_sessions
            todo: Outgoing | float = 1.0
            if sessions:
                with self._lock:
                    self._take_in(time.monotonic())
                    todo = self._outbox.next(time.monotonic(), len(sessions))
            if isinstance(todo, Outgoing):
                self._send(sessions, todo)
            else:
                self._wake.wait(min(todo, TAKE_S) if self._reports else todo)

    def _take_in(self, now: float) -> None:
        """Events since the last turn, here and at the ground stations."""
        while self._events:
            self._events.popleft()(now)
        while self._asks:
            query, scan_id, kind, numbers, ask = self._asks.popleft()
            for ended in self._outbox.on_ask(scan_id, kind, numbers, ask, query, now):
                ended.drop()
        if self._heads_are_asked:
            self._heads_are_asked = False
            self._outbox.publish_heads(now)
        reports = self._reports.take(now)
        for scan_id, peer, payload in reports:
            held = unpack(payload, Held)
            if held is not None:
                self._outbox.on_held(scan_id, peer, held, now)
        for store, *_ in list(self._stores) if reports else ():
            self._notes.keep(store, now)

    def _send(self, sessions: list[zenoh.Session], message: Outgoing) -> None:
        """Answer a request, or put a live message on each session."""
        import zenoh

        key = f"{ROOT}/{self._drone}/{message.scan_id}/{message.topic}"
        try:
            if message.token is None:
                for session in sessions:
                    session.put(
                        key,
                        message.payload,
                        priority=getattr(zenoh.Priority, PRIORITIES[message.lane]),
                        congestion_control=zenoh.CongestionControl.DROP,
                        express=message.lane < 2,
                    )
                return
            if message.payload:
                message.token.reply(key, message.payload)
        except zenoh.ZError as error:
            log.debug("datalink dropped %s: %s", key, error)
        if message.last:
            message.token.drop()

    # The threads that take what comes

    def _on_held(self, connection: _LinkSession, sample: zenoh.Sample) -> None:
        connection.heard_at = time.monotonic()
        if self._reports.put(str(sample.key_expr), sample.payload.to_bytes()):
            self._wake.set()

    def _on_head_query(self, query: zenoh.Query) -> None:
        query.drop()
        self._heads_are_asked = True
        self._wake.set()

    def _on_query(self, connection: _LinkSession, query: zenoh.Query) -> None:
        connection.heard_at = time.monotonic()
        parts = str(query.key_expr).split("/")
        ask = unpack(query.payload.to_bytes(), Ask) if query.payload is not None else None
        numbers = ranges_from_text(parts[5]) if len(parts) == 6 else None
        if ask is None or numbers is None or len(self._asks) >= MAX_WAITING_ASKS:
            query.drop()
            return
        self._asks.append((query, parts[2], parts[4], numbers, ask))
        self._wake.set()


def _pump(declared: Any, take: Callable[[Any], None]) -> None:
    """Hand on each message until the subscriber or queryable ends."""
    for message in declared:
        take(message)


def _rate(budget_kbit_s: float, share: float) -> float:
    return budget_kbit_s * 1000 / 8 * share


def sessions(config: DatalinkConfig) -> list[SessionConfig]:
    """A client for each endpoint to connect to, and a router where others connect to us. Raises
    InputError for encrypted endpoints to listen on, and as :func:`check_endpoints`."""
    for endpoint in config.listen:
        if is_encrypted(endpoint):
            raise InputError(
                f"datalink.listen {endpoint}: an aircraft's key cannot serve, because a stolen one "
                "could then pose as a ground station; give the ground station in datalink.connect"
            )
    shared = SessionConfig(
        plain=config.plain,
        tls_ca=config.tls_ca,
        tls_certificate=config.tls_certificate,
        tls_key=config.tls_key,
        rate_bytes_s=_rate(config.budget_kbit_s, config.share),
    )
    found = [replace(shared, connect=(endpoint,)) for endpoint in config.connect]
    if config.listen:
        found.append(replace(shared, mode="router", listen=config.listen))
    for session in found:
        check_endpoints(session)
    return found
