"""The scans of one drone at the ground station: messages and events go in, effects come out.

No socket or thread, and decisions by the caller's clock: the owner's worker performs the effects. A
scan is open only while it is in use, and has a folder only once its valid header has arrived.
"""

from __future__ import annotations

import logging
import os
import time
from collections import OrderedDict
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from service.errors import OutsideError, SkyreliefError
from service.ground.due import FILES
from service.ground.intake import FINE, SILENCE_S, SMALL, Introduction, ScanIntake
from service.ground.storage import DiskShare, DroneLimits, drone_folder, scan_folder
from service.stream.messages import Ask, Head, count, pack, unpack
from service.stream.naming import ROOT
from service.stream.radio_messages import RADIO_NOTE
from service.stream.ranges import RangeSet
from service.stream.records import ScanHeader
from service.stream.store import ScanStore

log = logging.getLogger(__name__)

REPORT_S = 1.0
REPORT_IDLE_S = 3.0
BUSY_S = 10.0  # a scan of which something was heard so lately, and that lacks something, stays open
CLOSE_AFTER_S = 600.0  # a scan without data for so long is written and closed; a whole one sooner
REWRITE_S = 60.0  # deliverables that the disk refused are written again after so long
MAX_INTRODUCTIONS = 32
"""Scans without a folder whose header is waited for; a drone offers 21 at once."""
MAX_CLOSED = 200  # closed scans whose last figures are kept
UNREADABLE_REST_S, MAX_UNREADABLE = 60.0, 64


class Item(NamedTuple):
    scan: str
    data: bytes


class Radio(NamedTuple):
    header: ScanHeader
    kind: str
    number: int
    part: int
    data: bytes


class Answered(NamedTuple):
    """The ``serial``-th request of a scan, made in ``slot``, is over."""

    scan: str
    slot: int
    serial: int


class Written(NamedTuple):
    """The deliverables of a scan are written, or why they are not."""

    scan: str
    trouble: str
    is_due: bool = False  # the disk refused a file


Event = Item | Radio | Answered | Written


class Put(NamedTuple):
    key: str
    payload: bytes


class Get(NamedTuple):
    """Ask the drone; the replies are items of a scan, and their end is ``answered``."""

    key: str
    payload: bytes
    answered: Answered


class Write(NamedTuple):
    """Have the scan's deliverables written; :class:`Written` follows."""

    scan: str
    folder: Path
    is_whole: bool = False  # then the scan is aligned with those that show the same ground


class Opened(NamedTuple):
    scan: ReceivedScan


Effect = Put | Get | Write | Opened


class Files(Enum):
    """Those next to the database of an open scan."""

    WRITTEN = "written"
    DUE = "due"  # the scan grew
    BEGUN = "being written"
    BEHIND = "behind"  # being written, and the scan grew meanwhile
    REFUSED = "refused"  # by the disk


class Change(Enum):
    GREW = "grew"
    BEGIN = "begin"
    END = "end"
    REFUSE = "refuse"


TRANSITIONS: dict[Files, dict[Change, Files]] = {
    Files.WRITTEN: {Change.GREW: Files.DUE},
    Files.DUE: {Change.BEGIN: Files.BEGUN},
    Files.BEGUN: {
        Change.GREW: Files.BEHIND, Change.END: Files.WRITTEN, Change.REFUSE: Files.REFUSED
    },
    Files.BEHIND: {Change.END: Files.DUE, Change.REFUSE: Files.REFUSED},
    Files.REFUSED: {Change.BEGIN: Files.BEGUN},
}  # fmt: skip
"""The next state; a change that is not listed changes nothing."""


@dataclass(slots=True, eq=False)
class ReceivedScan:
    """One open scan of one drone; used by the drone's worker alone."""

    drone: str
    name: str  # on the datalink
    folder: Path
    intake: ScanIntake
    used_at: float
    files: Files = Files.WRITTEN
    write_at: float = 0.0  # its files, not before
    changed: bool = True  # since the last report
    reported_at: float = -1e9
    rest_until: float = 0.0
    radio_messages: int = 0
    trouble: str = ""  # why it does not grow, or has no deliverables

    def grew(self) -> None:
        """Something new was stored: its files are due, also for the next process."""
        if not self.is_due:
            FILES.mark(self.folder)
        self.changed = True
        self.note(Change.GREW)

    def note(self, change: Change) -> None:
        self.files = TRANSITIONS[self.files].get(change, self.files)

    @property
    def is_due(self) -> bool:
        """Its files lack something, also once those being written are."""
        return Change.GREW not in TRANSITIONS[self.files]

    @property
    def is_writing(self) -> bool:
        return Change.END in TRANSITIONS[self.files]

    def progress(self) -> dict[str, Any]:
        """Items held and missing, bytes, lags and folder, for people and for JSON."""
        intake = self.intake
        held = intake.store.numbers()
        return {
            "drone": self.drone,
            "scan": self.folder.name,
            "folder": str(self.folder),
            "open": True,
            "held": {kind: len(numbers) for kind, numbers in held.items()},
            "missing": {kind: len(n) for kind, n in intake.missing().items()},
            "finished": "summary" in held,
            "complete": intake.complete and self.files in (Files.WRITTEN, Files.REFUSED),
            "received_bytes": intake.received_bytes,
            "duplicates": intake.duplicates,
            "unsound": intake.unsound,
            "refused": intake.store.refused,
            "radio_messages": self.radio_messages,
            "lag_s": {
                kind: round(median(lags), 3)
                for kind, lags in intake.lag_s.items()
                if lags and kind.startswith("k")
            },
            "heard_unix_s": round(time.time() - (time.monotonic() - self.used_at), 1),
            "trouble": self.trouble or None,
        }


class DroneReceiver:
    """Receives the scans of one drone. Times are the caller's: seconds, monotonic."""

    def __init__(
        self, drone: str, store: Path, station: str, limits: DroneLimits, now: float
    ) -> None:
        """Scans go below ``store``; ``station`` is the name that reports give."""
        self.drone = drone
        self.max_open = limits.open_scans  # scans that may be open now
        self.heard_at = self.news_at = now  # a message, and something new that was stored
        self.dropped = 0  # messages that were malformed, or of a scan without a header
        self.entries: list[dict[str, Any]] = []  # of all scans, for any thread
        self._store, self._station, self._limits = store, station, limits
        self._scans: OrderedDict[str, ReceivedScan] = OrderedDict()  # open, the last used last
        self._closed: OrderedDict[str, dict[str, Any]] = OrderedDict()
        self._introductions: OrderedDict[str, Introduction] = OrderedDict()
        self._unreadable: OrderedDict[str, float] = OrderedDict()  # until when
        self._share = DiskShare(drone_folder(store, drone), limits)
        self._shown_at = self._refresh_at = -1e9
        self._effects: list[Effect] = []

    @property
    def scans(self) -> list[ReceivedScan]:
        return list(self._scans.values())

    def is_idle(self, now: float) -> bool:
        return not self._scans and now - self.heard_at > self._limits.silent_s

    def handle(self, heads: dict[str, bytes], events: list[Event], now: float) -> list[Effect]:
        """Take in the newest head of each scan and what else came; what is to be done about it."""
        if heads:
            self.heard_at = now
        for name, payload in heads.items():
            self._on_head(name, payload, now)
        for event in events:
            match event:
                case Item():
                    self._on_item(*event, now)
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
        if heads or events or now - self._shown_at >= REPORT_S:
            self._show(now)
        effects, self._effects = self._effects, []
        return effects

    def close(self, now: float) -> list[Effect]:
        """Close every scan; the files of those that grew are to be written."""
        scans = self.scans
        for scan in scans:
            self._close(scan)
        self._show(now)
        for scan in scans:
            if scan.files is not Files.WRITTEN:
                self._closed.pop(scan.name, None)  # its files are due when it is opened again
        return [Write(scan.name, scan.folder) for scan in scans if scan.is_due]

    # What comes

    def _on_head(self, name: str, payload: bytes, now: float) -> None:
        head = unpack(payload, Head)
        if head is None:
            self.dropped += 1
            return
        scan = self._scan(name, now)
        if scan is None:
            if name not in self._closed and now >= self._unreadable.get(name, now):
                found = self._introductions.get(name) or Introduction(self.drone, name)
                _keep(self._introductions, name, found, MAX_INTRODUCTIONS)
                found.on_head(head, now)
            return
        if now - scan.intake.head_at > SILENCE_S:
            scan.reported_at = -1e9  # the drone is back: say at once that we listen
        before = scan.intake.missing()
        scan.intake.on_head(head, now)
        scan.changed = scan.changed or count(scan.intake.missing()) != count(before)

    def _on_item(self, name: str, payload: bytes, now: float) -> None:
        self.heard_at = now
        if name in self._introductions:
            self._introduce(name, payload, now)
            return
        is_known = name in self._scans or name in self._closed  # a head or an announcement is first
        scan = self._scan(name, now) if is_known else None
        if scan is None:
            self.dropped += 1
        elif now >= scan.rest_until:
            self._take_in(scan, payload, now)

    def _take_in(self, scan: ReceivedScan, payload: bytes, now: float) -> None:
        try:
            self._share.check(len(payload), now)
            if scan.intake.on_items(payload, now):
                scan.grew()
                self.news_at, scan.trouble = now, ""
        except OutsideError as error:
            self._rest(scan, str(error), now)

    def _on_radio(self, event: Radio, now: float) -> None:
        self.heard_at = now
        header, kind, number, part, data = event
        scan = self._scan(header.name, now, header)
        if scan is None or now < scan.rest_until:
            return
        store = scan.intake.store
        try:
            self._share.check(len(data), now)
            provisional = not store.header.started_unix_ns or RADIO_NOTE in store.header.notes
            if provisional and header != store.header:
                store.put_header(header)
            if kind != "header" and store.radio.add(kind, number, part, data):
                scan.grew()
                self.news_at, scan.radio_messages = now, scan.radio_messages + 1
        except OutsideError as error:
            self._rest(scan, str(error), now)

    def _rest(self, scan: ReceivedScan, trouble: str, now: float) -> None:
        """Pause a scan that cannot be written; missing items are requested later. One whose
        database was deleted is forgotten: the drone's next head begins it again."""
        if trouble != scan.trouble:
            log.error("%s; trying again every %.0f s", trouble, self._limits.full_disk_rest_s)
        scan.trouble, scan.rest_until = trouble, now + self._limits.full_disk_rest_s
        if self._scans.get(scan.name) is scan:
            try:
                os.stat(scan.intake.store.path)
            except FileNotFoundError:
                del self._scans[scan.name]
                scan.intake.store.close()
            except OSError as error:  # the disk is away, the scan may still be there
                log.debug("%s", error)

    def _introduce(self, name: str, payload: bytes, now: float) -> None:
        """Take in an item of a scan without a folder; a valid header makes the folder."""
        introduction = self._introductions[name]
        header = introduction.on_items(payload, now)
        scan = None if header is None else self._scan(name, now, header)
        if scan is None or introduction.head is None:
            return
        del self._introductions[name]
        scan.intake.store.put_record("header", introduction.number, introduction.record)
        scan.intake.on_head(introduction.head, now)
        for message in introduction.kept:
            self._take_in(scan, message, now)

    # Open scans

    def _scan(self, name: str, now: float, header: ScanHeader | None = None) -> ReceivedScan | None:
        """The scan, opened if need be, or made with the ``header``; None where that cannot be."""
        found = self._scans.get(name)
        if found is not None:
            self._scans.move_to_end(name)
            found.used_at = now
            return found
        if now < self._unreadable.get(name, now):
            return None
        if not self._has_room(now):
            self.dropped += 1
            return None
        try:
            path = scan_folder(self._store, self.drone, name) / "scan.db"
            if path.is_file():
                store = ScanStore.open(path, self._limits.scan_bytes)
            elif header is None:
                return None
            else:
                self._share.check(len(header.to_json()), now)
                store = ScanStore.create(path, header, self._limits.scan_bytes)
        except SkyreliefError as error:
            log.error("%s", error)
            _keep(self._unreadable, name, now + UNREADABLE_REST_S, MAX_UNREADABLE)
            return None
        self._unreadable.pop(name, None)
        scan = ReceivedScan(self.drone, name, path.parent, ScanIntake(store, self._station), now)
        closed = self._closed.pop(name, None)
        if closed is None:
            scan.grew()
        else:
            scan.trouble = closed["trouble"] or ""
        self._scans[name] = scan
        self._effects.append(Opened(scan))
        log.info("receiving %s/%s into %s", self.drone, name, scan.folder)
        return scan

    def _has_room(self, now: float) -> bool:
        """Close scans used longest ago until one more may be open; none that is coming in."""
        for scan in self.scans:
            if len(self._scans) < self.max_open:
                return True
            if now - scan.used_at >= BUSY_S or scan.intake.complete:
                self._end(scan, now)
        return len(self._scans) < self.max_open

    def _end(self, scan: ReceivedScan, now: float) -> None:
        """Close a scan, or have its files written first."""
        if scan.files is not Files.WRITTEN:
            self._write(scan, now)
        else:
            self._close(scan)

    def _close(self, scan: ReceivedScan) -> None:
        _keep(self._closed, scan.name, scan.progress() | {"open": False}, MAX_CLOSED)
        del self._scans[scan.name]
        scan.intake.store.close()

    def _write(self, scan: ReceivedScan, now: float) -> None:
        """Have a scan's deliverables written where it grew, one scan of a drone at a time."""
        is_due = scan.is_due and now >= scan.write_at
        if is_due and not any(other.is_writing for other in self.scans):
            scan.changed = True
            scan.note(Change.BEGIN)
            self._effects.append(Write(scan.name, scan.folder, scan.intake.complete))

    def _on_written(self, event: Written, now: float) -> None:
        scan = self._scans.get(event.scan)
        if scan is None or not scan.is_writing:
            return  # it was closed, or deleted and begun again
        scan.trouble = event.trouble
        scan.note(Change.REFUSE if event.is_due else Change.END)
        if event.is_due:
            scan.write_at = now + REWRITE_S

    # What to say

    def _look_after(self, now: float) -> None:
        for name, introduction in list(self._introductions.items()):
            if now - introduction.seen_at > self._limits.silent_s:
                del self._introductions[name]
            elif (wanted := introduction.next_ask(now)) is not None:
                self._get("header", wanted, Ask(self._station), Answered(name, SMALL, 0))
        while sum(scan.intake.held_bytes for scan in self.scans) > self._limits.unfinished_bytes:
            max(self.scans, key=lambda scan: scan.intake.held_bytes).intake.forget_unfinished()
        for scan in self.scans:
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
                self._get(*asked, Answered(scan.name, slot, scan.intake.asked))

    def _get(self, kind: str, numbers: RangeSet, ask: Ask, answered: Answered) -> None:
        key = f"{ROOT}/{self.drone}/{answered.scan}/item/{kind}/{numbers.text()}"
        self._effects.append(Get(key, pack(ask), answered))

    def _show(self, now: float) -> None:
        self._shown_at = now
        self.entries = [*(scan.progress() for scan in self.scans), *self._closed.values()]


def _keep(kept: OrderedDict[str, Any], name: str, value: Any, most: int) -> None:
    """Put a value last; beyond ``most`` the first make way."""
    kept[name] = value
    kept.move_to_end(name)
    while len(kept) > most:
        kept.popitem(last=False)
