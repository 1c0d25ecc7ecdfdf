"""The scans of one drone at the ground station: messages and events go in, effects come out.

No socket, thread or clock: the owner's worker performs the effects. A scan is open only while it is
in use, and has a folder only once its valid header has arrived.
"""

from __future__ import annotations

import logging
import os
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from service.errors import OutsideError, SkyreliefError
from service.ground.inbox import Answered, Batch, Inbox, Radio, Written
from service.ground.intake import FINE, SILENCE_S, SMALL, Introduction, ScanIntake
from service.ground.received import ReceivedScan
from service.ground.storage import DiskShare, scan_folder, total_and_free
from service.stream.messages import Ask, Head, count, pack, unpack
from service.stream.naming import ROOT
from service.stream.radio_messages import RADIO_NOTE
from service.stream.ranges import RangeSet
from service.stream.records import ScanHeader
from service.stream.store import ScanStore

log = logging.getLogger(__name__)

REPORT_S = 1.0
REPORT_IDLE_S = 3.0
BUSY_S = 10.0
"""A scan of which something was heard so lately, and that lacks something, stays open."""
CLOSE_AFTER_S = 600.0
"""A scan without data for so long is written and closed; a whole one sooner."""
REWRITE_S = 60.0
"""Deliverables that the disk refused are written again after so long."""
MAX_INTRODUCTIONS = 32
"""Scans without a folder whose header is waited for; a drone offers 21 at once."""
MAX_CLOSED = 200
"""Closed scans whose last figures are kept."""
UNREADABLE_REST_S, MAX_UNREADABLE = 60.0, 64


@dataclass(frozen=True, slots=True)
class DroneLimits:
    """Limits of the drones at the ground station, each for one drone unless it says otherwise."""

    scan_bytes: int | None = None  # of one scan's chunks; beyond it only coarse layers
    drone_share: float = 0.5  # of the disk
    reserve_bytes: int | None = None  # that stay free on the disk; None: by its size
    drones: int = 64  # received at once, of all; more wait until one is silent
    open_scans: int = 32  # where the descriptors allow it
    unfinished_bytes: int = 1 << 25  # of records; beyond it the largest make way
    silent_s: float = 30.0  # without a message for so long, it is silent
    close_whole_s: float = 60.0  # a whole scan without data for so long is written and closed
    full_disk_rest_s: float = 10.0  # until a full disk is tried again
    refresh_s: float = 0.0  # write deliverables of growing scans so often; 0: when complete
    look_s: float = 1.0  # between two looks at the disk
    usage: Callable[[Path], tuple[int, int]] = total_and_free  # bytes of a folder's disk


class Put(NamedTuple):
    key: str
    payload: bytes


class Get(NamedTuple):
    """Ask the drone; the replies are items of the scan, and their end an event."""

    scan: str
    key: str
    payload: bytes
    answered: Answered | None


class Write(NamedTuple):
    """Have the scan's deliverables written; :class:`Written` follows."""

    scan: ReceivedScan


class Opened(NamedTuple):
    scan: ReceivedScan


class Align(NamedTuple):
    """Align a finished scan with those that show the same ground."""

    folder: Path


Effect = Put | Get | Write | Opened | Align


class DroneReceiver:
    """Receives the scans of one drone. Times are the caller's: seconds, monotonic."""

    def __init__(
        self, drone: str, store: Path, station: str, limits: DroneLimits, now: float
    ) -> None:
        """Scans go below ``store``; ``station`` is the name that reports give."""
        self.drone = drone
        self.inbox = Inbox()
        self.max_open = limits.open_scans  # scans that may be open now
        self.heard_at = self.news_at = now  # a message, and something new that was stored
        self.dropped = 0  # messages that were malformed, or of a scan without a header
        self.entries: list[dict[str, Any]] = []
        self.is_known = False  # has, or had, a scan here
        self._store, self._station, self._limits = store, station, limits
        self._scans: OrderedDict[str, ReceivedScan] = OrderedDict()  # open, the last used last
        self._closed: OrderedDict[str, dict[str, Any]] = OrderedDict()
        self._introductions: OrderedDict[str, Introduction] = OrderedDict()
        self._unreadable: OrderedDict[str, float] = OrderedDict()
        folder = self._folder("scan").parent
        self._share = DiskShare(
            folder, limits.drone_share, limits.reserve_bytes, limits.usage, limits.look_s
        )
        self._shown_at = self._refresh_at = -1e9
        self._effects: list[Effect] = []

    @property
    def scans(self) -> list[ReceivedScan]:
        return list(self._scans.values())

    def _folder(self, name: str) -> Path:
        return scan_folder(self._store, self.drone, name)

    def handle(self, batch: Batch, now: float) -> list[Effect]:
        """Take in what has come, and look after the scans; what is to be done about it."""
        if batch.heads or batch.items:  # events may be of our own
            self.heard_at = now
        for name, payload in batch.heads.items():
            self._on_head(name, payload, now)
        for name, payload in batch.items:
            self._on_items(name, payload, now)
        for event in batch.events:
            match event:
                case Radio():
                    self._on_radio(event, now)
                case Answered(name, slot, serial) if name in self._scans:
                    self._scans[name].intake.answered(slot, serial, now)
                case Written():
                    self._on_written(event, now)
        if self._limits.refresh_s and now >= self._refresh_at:
            self._refresh_at = now + self._limits.refresh_s
            for scan in self.scans:
                self._write(scan, now)
        self._look_after(now)
        if batch or now - self._shown_at >= REPORT_S:
            self.show(now)
        effects, self._effects = self._effects, []
        return effects

    # What comes

    def _on_head(self, name: str, payload: bytes, now: float) -> None:
        head = unpack(payload, Head)
        if head is None:
            self.dropped += 1
            return
        scan = self._scan(name, now)
        if scan is None:
            if name not in self._closed and now >= self._unreadable.get(name, now):
                self._introduction(name).on_head(head, now)
            return
        if now - scan.intake.head_at > SILENCE_S:
            scan.reported_at = -1e9  # the drone is back: say at once that we listen
        before = scan.intake.missing()
        scan.intake.on_head(head, now)
        scan.changed = scan.changed or count(scan.intake.missing()) != count(before)

    def _on_items(self, name: str, payload: bytes, now: float) -> None:
        if name in self._introductions:
            self._introduce(name, payload, now)
            return
        if name not in self._scans and name not in self._closed:
            self.dropped += 1  # a head or an announcement comes first
            return
        scan = self._scan(name, now)
        if scan is None:
            self.dropped += 1
        elif now >= scan.rest_until:
            self._take_in(scan, payload, now)

    def _take_in(self, scan: ReceivedScan, payload: bytes, now: float) -> None:
        try:
            self._share.check(len(payload), now)
            if scan.intake.on_items(payload, now):
                self._grew(scan, now)
                scan.trouble = ""
        except OutsideError as error:
            self._rest(scan, str(error), now)

    def _rest(self, scan: ReceivedScan, trouble: str, now: float) -> None:
        """Pause a scan that cannot be written; missing items are requested later.

        One whose database was deleted is forgotten: the drone's next head begins it again.
        """
        if trouble != scan.trouble:
            log.error("%s; trying again every %.0f s", trouble, self._limits.full_disk_rest_s)
        scan.trouble, scan.rest_until = trouble, now + self._limits.full_disk_rest_s
        if self._scans.get(scan.name) is scan and not scan.is_writing:
            try:
                os.stat(scan.intake.store.path)
            except FileNotFoundError:
                del self._scans[scan.name]
                scan.intake.store.close()
            except OSError as error:
                log.debug("%s", error)

    def _grew(self, scan: ReceivedScan, now: float) -> None:
        scan.grew()
        self.news_at = now

    def _on_radio(self, event: Radio, now: float) -> None:
        self.heard_at = now
        header, kind, number, part, data = event
        scan = self._scan(header.name, now) or self._open(header.name, now, header)
        if scan is None or now < scan.rest_until:
            return
        store = scan.intake.store
        try:
            self._share.check(len(data), now)
            provisional = not store.header.started_unix_ns or RADIO_NOTE in store.header.notes
            if provisional and header != store.header:
                store.put_header(header)
            if kind != "header" and store.add_radio(kind, number, part, data):
                scan.radio_messages += 1
                self._grew(scan, now)
        except OutsideError as error:
            self._rest(scan, str(error), now)

    # Scans that have no folder yet

    def _introduction(self, name: str) -> Introduction:
        """That of a scan, a new one if need be; the one heard longest ago makes way."""
        found = self._introductions.pop(name, None) or Introduction(self.drone, name)
        self._introductions[name] = found
        while len(self._introductions) > MAX_INTRODUCTIONS:
            self._introductions.popitem(last=False)
        return found

    def _introduce(self, name: str, payload: bytes, now: float) -> None:
        """Take in an item of a scan without a folder; a valid header makes the folder."""
        introduction = self._introductions[name]
        header = introduction.on_items(payload, now)
        scan = None if header is None else self._open(name, now, header)
        if scan is None or introduction.head is None:
            return
        self._introductions.pop(name)
        scan.intake.store.put_record("header", introduction.number, introduction.record)
        scan.intake.on_head(introduction.head, now)
        for message in introduction.kept:
            self._take_in(scan, message, now)

    # Scans that have one

    def _scan(self, name: str, now: float) -> ReceivedScan | None:
        """The scan, opened if need be; None when it has no folder or cannot be opened."""
        found = self._scans.get(name)
        if found is not None:
            self._scans.move_to_end(name)
            found.used_at = now
            return found
        if now < self._unreadable.get(name, now):
            return None
        return self._open(name, now)

    def _store_of(self, name: str, now: float, header: ScanHeader | None) -> ScanStore | None:
        """Its database, made with the ``header`` if need be; None for neither."""
        path, max_bytes = self._folder(name) / "scan.db", self._limits.scan_bytes
        if path.is_file():
            return ScanStore.open(path, max_bytes)
        if header is None:
            return None
        self._share.check(len(header.to_json()), now)
        return ScanStore.create(path, header, max_bytes)

    def _open(self, name: str, now: float, header: ScanHeader | None = None) -> ReceivedScan | None:
        """The scan, opened; None when it has no folder and no ``header``, or cannot be opened."""
        if not self._has_room(now):
            self.dropped += 1
            return None
        try:
            store = self._store_of(name, now, header)
        except SkyreliefError as error:
            log.error("%s", error)
            self._unreadable[name] = now + UNREADABLE_REST_S
            while len(self._unreadable) > MAX_UNREADABLE:
                self._unreadable.popitem(last=False)
            return None
        self._unreadable.pop(name, None)
        if store is None:
            return None
        intake = ScanIntake(store, self._station)
        scan = ReceivedScan(self.drone, name, store.path.parent, intake, used_at=now)
        before = self._closed.pop(name, None)
        scan.is_written = before is not None
        if before is None:
            scan.grew()
        self._scans[name] = scan
        self.is_known = True
        self._effects.append(Opened(scan))
        log.info("receiving %s/%s into %s", self.drone, name, scan.folder)
        return scan

    def _has_room(self, now: float) -> bool:
        """Close the scans used longest ago until one more may be open.

        Those that are coming in just now stay: another scan of this drone waits for its turn.
        """
        for scan in list(self._scans.values()):
            if len(self._scans) < self.max_open:
                return True
            if now - scan.used_at < BUSY_S and not scan.intake.complete:
                continue
            self._end(scan, now)
        return len(self._scans) < self.max_open

    def _end(self, scan: ReceivedScan, now: float) -> None:
        """Close a scan, or have its files written first."""
        if scan.may_close:
            self._close(scan)
        else:
            self._write(scan, now)

    def _close(self, scan: ReceivedScan) -> None:
        self._closed[scan.name] = scan.progress() | {"open": False}
        while len(self._closed) > MAX_CLOSED:
            self._closed.popitem(last=False)
        del self._scans[scan.name]
        scan.intake.store.close()

    def close_all(self) -> None:
        """Close every scan; for use when the worker has ended."""
        for scan in self.scans:
            self._close(scan)
            if not scan.may_close:
                del self._closed[scan.name]  # its files are due when it is opened again

    def _write(self, scan: ReceivedScan, now: float) -> None:
        """Have a scan's deliverables written where it grew, one scan of a drone at a time."""
        is_due = scan.unwritten and now >= scan.write_at
        if is_due and not any(other.is_writing for other in self._scans.values()):
            scan.changed, scan.unwritten, scan.is_writing = True, False, True
            self._effects.append(Write(scan))

    def _on_written(self, event: Written, now: float) -> None:
        scan = event.scan
        scan.is_written, scan.is_writing, scan.trouble = True, False, event.trouble
        if event.is_due:
            scan.unwritten, scan.write_at = True, now + REWRITE_S
        if scan.intake.complete and not scan.trouble:
            self._effects.append(Align(scan.folder))

    # What to say

    def _look_after(self, now: float) -> None:
        for introduction in list(self._introductions.values()):
            if now - introduction.seen_at > self._limits.silent_s:
                del self._introductions[introduction.name]
                continue
            wanted = introduction.next_ask(now)
            if wanted is not None:
                self._get(introduction.name, "header", wanted, Ask(self._station), None)
        while sum(scan.intake.held_bytes for scan in self.scans) > self._limits.unfinished_bytes:
            max(self.scans, key=lambda scan: scan.intake.held_bytes).intake.forget_unfinished()
        for scan in list(self._scans.values()):
            limit_s = CLOSE_AFTER_S
            if scan.intake.complete and not scan.changed:  # and the drone knows it
                limit_s = self._limits.close_whole_s
            if now - scan.used_at > limit_s:
                self._end(scan, now)
            elif now - scan.intake.head_at <= self._limits.silent_s:
                self._tend(scan, now)

    def _tend(self, scan: ReceivedScan, now: float) -> None:
        """Report, request missing items, and write complete scans."""
        pause = REPORT_S if scan.changed else REPORT_IDLE_S
        if now - scan.reported_at >= pause:
            scan.reported_at, scan.changed = now, False
            key = f"{ROOT}/{self.drone}/{scan.name}/held/{self._station}"
            self._effects.append(Put(key, pack(scan.intake.held())))
        if scan.intake.complete:
            self._write(scan, now)
        if now < scan.rest_until:
            return
        for slot in (SMALL, FINE):
            asked = scan.intake.next_ask(slot, now)
            if asked is not None:
                answered = Answered(scan.name, slot, scan.intake.asked)
                self._get(scan.name, *asked, answered)

    def _get(
        self, name: str, kind: str, numbers: RangeSet, ask: Ask, answered: Answered | None
    ) -> None:
        key = f"{ROOT}/{self.drone}/{name}/item/{kind}/{numbers.text()}"
        self._effects.append(Get(name, key, pack(ask), answered))

    def show(self, now: float) -> None:
        self._shown_at = now
        entries = [scan.progress() for scan in self.scans]
        self.entries = entries + list(self._closed.values())
