"""A short look at the links: who speaks there, and what is missing.

It says who we are and asks the autopilot for its telemetry, as the service does, because a port
may carry nothing before. It carries out no command.
"""

from __future__ import annotations

import secrets
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from mavlink.autopilot_link import AutopilotLink
from mavlink.decode import READERS
from mavlink.framing import Decoder, Framer, Packet
from mavlink.history import VehicleHistory
from mavlink.inbox import Inbox
from mavlink.link import Link, parse_link
from mavlink.link_watch import LinkWatch, Trouble, WatchConfig
from mavlink.messages import Outbox
from mavlink.packer import Packer
from mavlink.presence import Health, Presence, PresenceConfig
from mavlink.rates import WANTED_HZ
from mavlink.signing import Signing, read_key

S = 1_000_000_000
STEP_S = 0.02
BACKLOG = 10_000
HEARTBEAT, SYSTEM_TIME, TIMESYNC = 0, 2, 111


@dataclass(frozen=True, slots=True)
class LinkFound:
    """What was heard on one link."""

    name: str
    is_up: bool
    packets: dict[int, int]  # by system id
    skipped_bytes: int
    last_error: str


@dataclass(frozen=True, slots=True)
class Found:
    """What a look found."""

    links: tuple[LinkFound, ...]
    autopilot: tuple[int, int] | None  # system and component
    troubles: tuple[Trouble, ...]


class LinkProbe:
    """Opens the links for a while. ValueError for a link or key that cannot be."""

    def __init__(
        self,
        links: Sequence[str],
        system: int | None,
        watch: WatchConfig,
        signing_key: Path | None = None,
    ) -> None:
        signing = None if signing_key is None else Signing(read_key(signing_key), 0)
        now_ns = time.monotonic_ns()
        self._presence = Presence(PresenceConfig(system), secrets.randbits(32) or 1, now_ns)
        self._outbox = Outbox()
        history = VehicleHistory()
        self._autopilot = AutopilotLink(
            self._presence, history, self._outbox, WANTED_HZ, lambda severity, text: None
        )
        self._watch = LinkWatch(watch, self._presence, now_ns)
        self._decoder = Decoder()
        self._inbox: Inbox[tuple[int, Packet, int]] = Inbox(BACKLOG)
        specs = [parse_link(text) for text in links]
        self._framers = [Framer() for _ in specs]
        self._packers = [Packer(i, signing) for i in range(len(specs))]
        self._counts: list[Counter[int]] = [Counter() for _ in specs]
        self._links = [Link(spec, partial(self._on_data, i)) for i, spec in enumerate(specs)]

    def look(self, seconds: float) -> Found:
        """Listen and ask for so long; what was found."""
        for link in self._links:
            link.start()
        end_ns = time.monotonic_ns() + round(seconds * S)
        while time.monotonic_ns() < end_ns:
            self._step(time.monotonic_ns())
            time.sleep(STEP_S)
        found = self._found(time.monotonic_ns())
        for link in self._links:
            link.stop()
        return found

    def _on_data(self, index: int, data: bytes, now_ns: int) -> None:
        for packet in self._framers[index].feed(data):
            self._inbox.gather((index, packet, now_ns))

    def _step(self, now_ns: int) -> None:
        for index, packet, heard_ns in self._inbox.take(0.0)[0]:
            self._counts[index][packet.system] += 1
            self._hear(index, packet, heard_ns)
        self._presence.confirm(Health.STANDBY, now_ns)
        self._presence.look(now_ns)
        self._autopilot.follow()
        self._autopilot.tick(now_ns)
        for outgoing in (*self._presence.due(now_ns), *self._outbox.take()):
            for packer, link in zip(self._packers, self._links, strict=True):
                data = packer.pack(self._presence.system, outgoing, time.time_ns())
                if data is not None:
                    link.write(data)

    def _hear(self, index: int, packet: Packet, now_ns: int) -> None:
        message = self._decoder.message(packet)
        if message is None:
            return
        self._presence.count(packet.system, packet.component)
        if packet.message_id == HEARTBEAT:
            self._presence.hear(message, now_ns)
            self._autopilot.follow()
        elif packet.message_id == TIMESYNC:
            self._autopilot.hear_timesync(message, packet, index, now_ns)
        elif packet.message_id == SYSTEM_TIME:
            self._autopilot.hear_system_time(message, packet, now_ns)
        elif message.get_type() in READERS:
            self._autopilot.hear_telemetry(message.get_type(), message, packet, now_ns)
        self._watch.hear(packet, message, now_ns)

    def _found(self, now_ns: int) -> Found:
        links = tuple(
            LinkFound(
                link.spec.name, link.is_up, dict(counts), framer.skipped_bytes, link.last_error
            )
            for link, counts, framer in zip(self._links, self._counts, self._framers, strict=True)
        )
        return Found(links, self._presence.autopilot, self._watch.troubles(now_ns))
