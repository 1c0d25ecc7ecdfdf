"""The ground station: receives the scans of any number of drones into scan folders.

Each scan lives in ``<store>/<drone>/<scan>/scan.db``, the same database as onboard. When a
finished scan is complete, and when the receiver closes, the deliverables are written beside
it. Everything may be killed at any time and started again.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.errors import InputError, OutsideError, SkyreliefError
from service.ground.intake import FINE, SILENCE_S, SMALL, ScanIntake
from service.ground.placing import scan_folder
from service.ground.received import ReceivedScan, deliver
from service.stream.messages import count, pack_ask, pack_held, unpack_head
from service.stream.naming import ROOT, place_of, split_scan_name, station_name
from service.stream.radio_messages import RADIO_NOTE
from service.stream.records import ScanHeader
from service.stream.session import SessionConfig, check_endpoints, open_session
from service.stream.store import ScanStore
from service.stream.tunnel import TunnelIntake

if TYPE_CHECKING:
    import zenoh

log = logging.getLogger(__name__)

MAX_SCANS = 1000
"""Scans that one receiver takes in; the heads of more are dropped."""
MAX_WAITING = 20_000
ASK_TIMEOUT_S = 120.0
REPORT_S = 1.0
REPORT_IDLE_S = 3.0
DRONE_TIMEOUT_S = 30.0
RETRY_S = 1.0
LOOK_AROUND_S = 3.0
FULL_DISK_REST_S = 10.0


@dataclass(frozen=True, slots=True)
class ReceiverConfig:
    """Where a ground station listens and what it keeps."""

    store: Path
    session: SessionConfig = field(default_factory=lambda: SessionConfig(mode="router"))
    quota_bytes: int | None = None  # of one scan's chunks; beyond it only coarse layers
    name: str = ""  # of this station; empty: made once and kept in the store
    refresh_s: float = 0.0  # write deliverables of growing scans so often; 0: when complete


class Receiver:
    """Receives on threads of its own between :meth:`start` and :meth:`close`.

    Raises InputError for endpoints or a store that cannot be used.
    """

    def __init__(self, config: ReceiverConfig) -> None:
        check_endpoints(config.session)
        self._config = config
        try:
            config.store.mkdir(parents=True, exist_ok=True)
            self._name = config.name or station_name(config.store)
        except OSError as error:
            raise InputError(f"cannot write the store {config.store}: {error.strerror}") from error
        self._scans: dict[tuple[str, str], ReceivedScan] = {}
        self._events: queue.Queue[Callable[[float], None]] = queue.Queue(MAX_WAITING)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="receiver", daemon=True)
        self._writer = ThreadPoolExecutor(1, "deliverables")
        self._session: zenoh.Session | None = None
        self._opened = threading.Event()
        self._failure: SkyreliefError | None = None
        self._tunnel = TunnelIntake()
        self._refresh_at = 0.0
        self.dropped = 0  # messages that were malformed, foreign or too many
        self.last_news_at = time.monotonic()

    def start(self) -> None:
        """Begin; returns when the endpoints are open. Raises OutsideError when they cannot."""
        self._thread.start()
        while not self._opened.wait(0.1):
            if self._failure is not None:
                raise self._failure

    def close(self) -> None:
        """End, and write the deliverables of what has changed."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join()
        for scan in self._scans.values():
            if scan.unwritten and scan.writing is None:
                self._write(scan)
        self._writer.shutdown(wait=True)
        for scan in self._scans.values():
            scan.intake.store.close()

    def folder(self, drone: str, name: str) -> Path:
        """Where a scan is kept that the datalink calls so."""
        return scan_folder(self._config.store, drone, name)

    def add_radio(self, payload: bytes) -> None:
        """Take in a message of the narrow radio; from any thread."""
        self._post(lambda now: self._radio(payload, now))

    def progress(self) -> list[dict[str, Any]]:
        """One entry per scan: drone, scan, items held and missing, bytes, lags, folder."""
        return [scan.progress() for scan in list(self._scans.values())]

    # The worker

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                session = open_session(self._config.session)
            except SkyreliefError as error:
                if self._config.session.listen or isinstance(error, InputError):
                    self._failure = error
                    return
                log.debug("%s", error)
                self._opened.set()  # a station that only connects waits for its router
                self._stop.wait(RETRY_S)
                continue
            self._session = session
            try:
                self._serve(session)
            finally:
                self._session = None
                session.close()

    def _serve(self, session: zenoh.Session) -> None:
        session.declare_subscriber(f"{ROOT}/*/*/head", self._on_head)
        session.declare_subscriber(f"{ROOT}/*/*/item/*/*", self._on_item)
        self._opened.set()
        look_at = 0.0
        while not self._stop.is_set() and not session.is_closed():
            if time.monotonic() >= look_at:
                self._look_around(session)
                look_at = time.monotonic() + LOOK_AROUND_S
            try:
                event = self._events.get(timeout=0.1)
                event(time.monotonic())
                for _ in range(200):
                    self._events.get_nowait()(time.monotonic())
            except queue.Empty:
                pass
            for scan in self._scans.values():
                self._tend(session, scan, time.monotonic())
            self._refresh(time.monotonic())

    def _look_around(self, session: zenoh.Session) -> None:
        """Have the drones that are there say at once what they have."""
        if any(time.monotonic() - s.intake.head_at < LOOK_AROUND_S for s in self._scans.values()):
            return
        import zenoh

        with contextlib.suppress(zenoh.ZError):
            session.get(f"{ROOT}/*/*/head", lambda _: None, timeout=LOOK_AROUND_S)

    def _tend(self, session: zenoh.Session, scan: ReceivedScan, now: float) -> None:
        """Report, ask, and write what is complete."""
        if now - scan.intake.head_at > DRONE_TIMEOUT_S:
            return
        pause = REPORT_S if scan.changed else REPORT_IDLE_S
        if now - scan.reported_at >= pause:
            scan.reported_at, scan.changed = now, False
            self._put(session, f"{scan.key}/held/{self._name}", pack_held(scan.intake.held()))
        if scan.unwritten and scan.intake.complete and scan.idle:
            scan.changed = True
            self._write(scan)
        if now >= scan.rest_until:
            for slot in (SMALL, FINE):
                self._ask(session, scan, slot, now)

    def _put(self, session: zenoh.Session, key: str, payload: bytes) -> None:
        import zenoh

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

    def _ask(self, session: zenoh.Session, scan: ReceivedScan, slot: int, now: float) -> None:
        import zenoh

        wanted = scan.intake.next_ask(slot, now)
        if wanted is None:
            return
        kind, numbers, ask = wanted
        intake = scan.intake
        number_of_ask = intake.progress.asked

        def ended() -> None:
            self._post(lambda at: intake.answered(slot, number_of_ask, at))

        def reply(answer: zenoh.Reply) -> None:
            if answer.ok is not None:
                self._on_item(answer.ok)

        try:
            session.get(
                f"{scan.key}/item/{kind}/{numbers.text()}",
                zenoh.handlers.Callback(reply, ended),
                payload=pack_ask(ask),
                priority=zenoh.Priority.BACKGROUND,
                congestion_control=zenoh.CongestionControl.DROP,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=ASK_TIMEOUT_S,
            )
        except zenoh.ZError as error:
            log.debug("not asked: %s", error)

    def _write(self, scan: ReceivedScan) -> None:
        """Have the scan's deliverables written beside its database."""
        scan.unwritten = False
        scan.writing = self._writer.submit(deliver, scan)

    # What comes

    def _post(self, event: Callable[[float], None]) -> None:
        try:
            self._events.put_nowait(event)
        except queue.Full:
            self.dropped += 1

    def _on_head(self, sample: zenoh.Sample) -> None:
        head = unpack_head(sample.payload.to_bytes())
        place = place_of(str(sample.key_expr))
        if head is None or place is None:
            self.dropped += 1
            return

        def arrived(now: float) -> None:
            scan = self._scan(*place)
            if scan is not None:
                if now - scan.intake.head_at > SILENCE_S:
                    scan.reported_at = -1e9  # the drone is back: say at once that we listen
                before = scan.intake.missing()
                scan.intake.on_head(head, now)
                scan.changed = scan.changed or count(scan.intake.missing()) != count(before)

        self._post(arrived)

    def _on_item(self, sample: zenoh.Sample) -> None:
        payload = sample.payload.to_bytes()
        place = place_of(str(sample.key_expr))
        if place is None:
            self.dropped += 1
            return
        self._post(lambda now: self._items(place, payload, now))

    def _items(self, place: tuple[str, str], payload: bytes, now: float) -> None:
        scan = self._scan(*place)
        if scan is None or now < scan.rest_until:
            return
        try:
            if scan.intake.on_items(payload, now):
                scan.changed = scan.unwritten = True
                self.last_news_at = now
        except OutsideError as error:
            log.error("%s; trying again in %.0f s", error, FULL_DISK_REST_S)
            scan.rest_until = now + FULL_DISK_REST_S

    def _radio(self, payload: bytes, now: float) -> None:
        for header, kind, number, part, data in self._tunnel.receive(payload):
            scan = self._scan(header.drone, header.name)
            if scan is None:
                continue
            store = scan.intake.store
            try:
                provisional = not store.header.started_unix_ns or RADIO_NOTE in store.header.notes
                if provisional and header != store.header:
                    store.put_header(header)
                if kind != "header" and store.add_radio(kind, number, part, data):
                    scan.radio_messages += 1
                    scan.unwritten = True
                    self.last_news_at = now
            except OutsideError as error:
                log.error("%s", error)

    def _refresh(self, now: float) -> None:
        """Write the deliverables of scans that grow, every ``refresh_s``."""
        if not self._config.refresh_s or now < self._refresh_at:
            return
        self._refresh_at = now + self._config.refresh_s
        for scan in self._scans.values():
            if scan.unwritten and scan.idle:
                self._write(scan)

    def _scan(self, drone: str, name: str) -> ReceivedScan | None:
        found = self._scans.get((drone, name))
        if found is not None:
            return found
        if len(self._scans) >= MAX_SCANS:
            self.dropped += 1
            return None
        scan_id, run_id = split_scan_name(name)
        try:
            path = self.folder(drone, name) / "scan.db"
            if path.exists():
                store = ScanStore.open(path, self._config.quota_bytes)
            else:
                header = ScanHeader(scan_id, drone, 0, run_id=run_id)
                store = ScanStore.create(path, header, self._config.quota_bytes)
        except SkyreliefError as error:
            log.error("%s", error)
            self.dropped += 1
            return None
        scan = self._scans[drone, name] = ReceivedScan(
            drone, name, path.parent, ScanIntake(store, self._name)
        )
        scan.unwritten = True
        log.info("receiving %s/%s into %s", drone, name, path.parent)
        return scan
