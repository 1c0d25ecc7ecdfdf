"""The vehicle as the service uses it: links, two components and history in one object.

Threads: two per link, one for the protocol, one for heartbeats, one that writes to the disk. Every
call of the service returns at once, but for the end of a log; ``ScanControl`` is called in the
protocol's thread.
"""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from mavlink.component import status as texts
from mavlink.component.camera import KeyframeReport
from mavlink.component.companion import HEARD, Companion, CompanionConfig
from mavlink.component.control import ScanControl
from mavlink.component.link_watch import Trouble
from mavlink.component.memory import Memory
from mavlink.component.presence import Health, Presence, PresenceConfig
from mavlink.component.status import BodyOdometry, ComputerLoad, odometry_message
from mavlink.telemetry.clock import computer_offset_ns
from mavlink.telemetry.decode import READERS
from mavlink.telemetry.history import PATIENCE_S, HistoryConfig, VehicleHistory
from mavlink.wire.dialect import dialect, numbers_of
from mavlink.wire.first_beat import FirstBeats
from mavlink.wire.framing import Packet
from mavlink.wire.link import Job, Link, LinkInbox, parse_link
from mavlink.wire.messages import LinkReport, Links, OutgoingMessage
from mavlink.wire.signing import UNIT_PER_S, Signing, fingerprint, read_key
from mavlink.wire.stand_in import AFTER_S, NICE, StandIn
from mavlink.wire.tlog import TlogRecorder

log = logging.getLogger(__name__)

S = 1_000_000_000
SAVE_EVERY_NS, SAVE_SIGNED_NS = 30 * S, S  # with a key, what a crash forgets could be replayed
SYNC_EVERY_NS = 2 * S  # a power cut costs so much of the log
TELEMETRY = numbers_of(READERS)
STUCK_NS = 10 * S
WAIT_S = 0.5  # of the disk's thread for work
TUNNEL_ROOM = 128


@dataclass(frozen=True, slots=True)
class VehicleConfig:
    links: tuple[str, ...] = ()
    presence: PresenceConfig = field(default_factory=PresenceConfig)
    companion: CompanionConfig = field(default_factory=CompanionConfig)
    history: HistoryConfig = field(default_factory=lambda: HistoryConfig(keep_s=120.0))
    signing_key: Path | None = None  # 32 bytes, mode 600
    odometry: bool = False  # send our motion estimate to the autopilot
    state_dir: Path | None = None  # keeps parameters, signing time and the vehicle's system id
    backlog: int = 10_000  # packets queued for the protocol's thread, and for the disk's
    stand_in: bool = False  # another process sends heartbeats where ours are late
    close_s: float = 5.0  # that the end of a log waits for a disk at most

    def __post_init__(self) -> None:
        for link in self.links:
            parse_link(link)


@dataclass(frozen=True, slots=True)
class VehicleReport:
    links: tuple[LinkReport, ...]
    system: int
    autopilot: tuple[int, int] | None
    is_certain: bool  # False while it was merely the first one heard
    autopilot_age_s: float | None
    is_armed: bool
    timesync_round_trip_ms: float | None
    unverified: int  # packets refused for their signature
    dropped: int  # packets that overflowed the protocol's queue
    troubles: tuple[Trouble, ...]  # what is missing although the links are open


class VehicleLink:
    """Start it, confirm health regularly, and read ``history``."""

    def __init__(
        self,
        config: VehicleConfig,
        control: ScanControl,
        first: FirstBeats | None = None,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """``first`` has opened the links of ``config`` already and sends heartbeats on them."""
        self.config, self._clock_ns = config, clock_ns
        links = None if first is None else first.hand_over()
        now_ns = self._clock_ns()
        self.history = VehicleHistory(config.history, PATIENCE_S)
        self.recorder = TlogRecorder()
        key = None if config.signing_key is None else read_key(config.signing_key)
        self._memory = Memory(config.state_dir, "" if key is None else fingerprint(key))
        self.signing = None
        if key is not None:
            # A crash forgets what was sent in the last second, and by the stand-in after it.
            ours = self._memory.signing_timestamp + round((1.0 + AFTER_S[-1]) * UNIT_PER_S)
            self.signing = Signing(key, ours, self._memory.signing_streams)
        self.presence = Presence(
            config.presence,
            secrets.randbits(32) or 1 if first is None else first.token,
            now_ns,
            None if first is None else round(first.next_s * S),
            self._memory.system,
        )
        self._companion = Companion(
            config.companion,
            control,
            self.presence,
            self.history,
            now_ns,
            self._memory.parameters,
            lambda: (self._clock_ns() + self.unix_offset_ns()) // 1000,
        )
        self._inbox: LinkInbox[tuple[int, Packet, int]] = LinkInbox(config.backlog)
        self._disk: LinkInbox[tuple[bytes, int]] = LinkInbox(config.backlog)  # as a disk may stall
        self._is_saving = False
        self._heard = set(HEARD)  # numbers of handled messages; others are ignored
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []
        self._alive_ns = now_ns
        opened = links or [Link(parse_link(text)) for text in config.links]
        self._stand_in = None if first is None else first.stand_in
        if self._stand_in is None and config.stand_in and config.links:
            self._stand_in = StandIn()
        sequence = 0 if first is None else first.sequence
        self._links = Links(opened, self._on_packet, self.signing, sequence)

    # Called by the service.

    def start(self) -> None:
        """Open the links; the first heartbeat is sent before anything else."""
        self._inbox.put(self._companion.announce_kept)
        for target in (self._beat, self._run, self._write):
            thread = threading.Thread(
                target=target, name=f"mavlink {target.__name__.strip('_')}", daemon=True
            )
            self._threads.append(thread)
            thread.start()
        self._links.start()

    def stop(self) -> None:
        """Send what is queued, then close everything."""
        self._stop.set()
        for inbox in (self._inbox, self._disk):
            inbox.put(lambda: None)
        for thread in self._threads:
            thread.join(timeout=5.0)
        if self._stand_in is not None:
            self._stand_in.close()
        self._links.stop()
        self._flush(0.0)
        self.recorder.close()
        self.save()

    def set_health(self, health: Health) -> None:
        """Confirm that the service lives; call it at least every second."""
        self.presence.confirm(health, self._clock_ns())

    def set_load(self, load: ComputerLoad) -> None:
        self._companion.load = load

    def statustext(self, text: str, severity: int = texts.INFO, is_answer: bool = False) -> None:
        """Send a text to the operator; repetitions are suppressed, except of answers."""
        self._inbox.put(lambda: self._companion.say(severity, text, is_answer))

    def report_keyframe(self, keyframe: KeyframeReport) -> None:
        self._inbox.put(lambda: self._companion.camera.report(keyframe))

    def send_tunnel(self, payload_type: int, payload: bytes) -> None:
        """Send up to 128 bytes to everyone by TUNNEL."""
        padded = list(payload.ljust(TUNNEL_ROOM, b"\0"))
        message = dialect.MAVLink_tunnel_message(0, 0, payload_type, len(payload), padded)
        self._inbox.put(lambda: self._companion.send(message))

    def listen(self, name: str, listener: Callable[[Any], None]) -> None:
        """Call ``listener`` in the protocol's thread with every message of a name, e.g. TUNNEL."""
        self._heard |= numbers_of([name])
        self._inbox.put(lambda: self._companion.listen(name, listener))

    def report_odometry(self, odometry: BodyOdometry, time_ns: int) -> bool:
        """Send our estimate to the autopilot, stamped with its clock at our monotonic time. Returns
        False and sends nothing unless ``odometry`` is enabled and its clock is known."""
        boot_us = self.boot_time_us(time_ns)
        if boot_us is None or not self.config.odometry:
            return False
        self._inbox.put(lambda: self._companion.send(odometry_message(odometry, boot_us)))
        return True

    def parameters(self) -> dict[str, float]:
        return self._companion.parameters.values()

    def show_parameters(self, values: Mapping[str, float]) -> None:
        """Make the configuration's values the defaults, and publish them to ground stations."""
        self._inbox.put(lambda: self._companion.parameters.adopt(values))

    def record(self, path: Path | None, unix_offset_ns: int | None = None) -> None:
        """Write a .tlog of all links to a file from now on, stamped with the monotonic clock plus
        ``unix_offset_ns`` (None: :meth:`unix_offset_ns`); a path of None ends it, and waits for
        what is queued, but not long for a disk that stalls."""
        if path is None:
            closed = threading.Event()
            self._disk.put(self.recorder.close)
            self._disk.put(closed.set)
            if self._threads and not self._stop.is_set():
                closed.wait(self.config.close_s)
            else:
                self._flush(0.0)
        else:
            offset_ns = self.unix_offset_ns() if unix_offset_ns is None else unix_offset_ns
            self.recorder.open(path, offset_ns)

    def unix_offset_ns(self) -> int:
        """Unix time minus our monotonic clock: from this computer, or from the autopilot where the
        two clocks disagree."""
        return self._companion.autopilot.wall_time.correct(computer_offset_ns())

    def boot_time_us(self, time_ns: int) -> int | None:
        """The autopilot's boot clock in us at one of our monotonic times; None when unknown."""
        offset = self._companion.autopilot.boot_offset_ns
        return None if offset is None else (time_ns - offset) // 1000

    @property
    def is_serving(self) -> bool:
        """True while the protocol's thread makes progress."""
        return self._clock_ns() - self._alive_ns < STUCK_NS

    def report(self) -> VehicleReport:
        seen = self.presence.autopilot_seen_ns
        round_trip = self._companion.autopilot.timesync.round_trip_ns
        return VehicleReport(
            self._links.report(),
            self.presence.system,
            self.presence.autopilot,
            self.presence.is_certain,
            None if seen is None else (self._clock_ns() - seen) / S,
            self.presence.is_armed,
            None if round_trip is None else round_trip * 1e-6,
            0 if self.signing is None else self.signing.refused,
            self._inbox.dropped,
            self._companion.watch.troubles(self._clock_ns()),
        )

    # Threads.

    def _on_packet(self, index: int, packet: Packet, now_ns: int) -> None:
        self._record([packet.data], now_ns)
        if packet.message_id in TELEMETRY:
            self._inbox.gather((index, packet, now_ns))
        elif packet.message_id in self._heard:
            self._inbox.put(partial(self._hear, index, packet, now_ns))

    def _hear(self, index: int, packet: Packet, now_ns: int) -> None:
        if self.signing is not None and not self.signing.accepts(packet):
            return
        self._companion.receive(index, packet, now_ns)

    def _run(self) -> None:
        """The protocol's thread, the only one that uses the companion."""
        every_ns = SAVE_EVERY_NS if self.signing is None else SAVE_SIGNED_NS
        save_ns = self._clock_ns() + every_ns
        while not self._stop.is_set():
            self._serve(self._companion.pause_s)
            now_ns = self._alive_ns = self._clock_ns()
            self._guard(self._companion.tick, now_ns)
            self._send(self._companion.take())
            is_stale = self._memory.is_stale(
                self._companion.parameters.revision, self.presence.proven_system
            )
            if (now_ns >= save_ns or is_stale) and not self._is_saving:
                save_ns = now_ns + every_ns
                self._is_saving = True
                self._disk.put(self._saving())
        self._serve(0.0)
        self._send(self._companion.take())

    def _serve(self, wait_s: float) -> None:
        telemetry, jobs = self._inbox.take(wait_s)
        for job in jobs:  # first: a heartbeat identifies the telemetry that follows
            self._guard(job)
        for received in telemetry:
            self._guard(self._hear, *received)

    def _guard(self, job: Callable[..., object], *given: object) -> None:
        """Run a job; a fault in the service's handler must not end the link."""
        try:
            job(*given)
        except Exception:
            log.exception("fault while serving MAVLink")

    def _beat(self) -> None:
        """The heartbeats' thread, with raised priority where the system permits it."""
        if sys.platform == "linux":
            with contextlib.suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)
        while not self._stop.is_set():
            now_ns = self._clock_ns()
            due = self.presence.due(now_ns)
            if now_ns - self._alive_ns < STUCK_NS:  # otherwise nothing would answer: stay silent
                self._send_beats(due, now_ns)
            self._stop.wait(max(0.001, (self.presence.next_ns - self._clock_ns()) / S))

    def _send_beats(self, beats: list[OutgoingMessage], now_ns: int) -> None:
        system, stand_in = self.presence.system, self._stand_in
        if beats and stand_in is not None:
            self._links.skip(stand_in.sent())
        self._record(self._links.send(system, beats), now_ns)
        if beats and stand_in is not None:
            stand_in.plan(self._links.ahead(system, beats, time.monotonic()), self._links.ways)

    def _send(self, messages: list[OutgoingMessage]) -> None:
        if messages:
            self._record(self._links.send(self.presence.system, messages), self._clock_ns())

    def _record(self, packets: list[bytes], now_ns: int) -> None:
        for data in packets:
            self._disk.gather((data, now_ns))

    def _write(self) -> None:
        """The disk's thread. A disk that stalls costs packets of the log, and nothing else."""
        lost, sync_ns = 0, self._clock_ns()
        while not self._stop.is_set():
            self._flush(WAIT_S)
            if self._clock_ns() >= sync_ns:
                sync_ns = self._clock_ns() + SYNC_EVERY_NS
                self.recorder.sync()
            before, lost = lost, self._disk.dropped
            if lost > before:
                log.warning("the telemetry log lacks %d packets: the disk stalled", lost - before)

    def _flush(self, wait_s: float) -> None:
        packets, jobs = self._disk.take(wait_s)
        for packet in packets:  # first: a log ends with what was heard before
            self._guard(self.recorder.write, *packet)
        for job in jobs:
            self._guard(job)

    def save(self) -> None:
        """Write what a restart needs, on this thread."""
        self._saving()()

    def _saving(self) -> Job:
        """Writes what a restart needs: parameters, signing times, the vehicle's system id."""
        parameters = self._companion.parameters
        signing, system = self.signing, self.presence.proven_system
        timestamp, streams = (0, {}) if signing is None else (signing.timestamp, signing.streams)
        kept, revision = parameters.kept(), parameters.revision

        def save() -> None:
            try:
                self._memory.save(kept, revision, timestamp, streams, system)
            finally:
                self._is_saving = False

        return save
