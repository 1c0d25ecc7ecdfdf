"""Detects what is missing on open links, and names the setting to change.

ArduPilot does not forward a ground station's heartbeats to a port with private traffic, so a
ground station that is never heard does not hear us either. PX4 forwards each direction
independently; there the symptom is that no ground station ever queries our camera.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mavlink.component.autopilot_link import AutopilotLink
from mavlink.component.presence import Health, Presence, PresenceConfig
from mavlink.telemetry.history import VehicleHistory
from mavlink.wire.dialect import numbers_of
from mavlink.wire.first_beat import TYPES
from mavlink.wire.framing import MAGIC_V1, Decoder, Packet
from mavlink.wire.link import Inbox, Link, parse_link
from mavlink.wire.messages import LinkReport, Links, Outbox
from mavlink.wire.signing import Signing, read_key

S = 1_000_000_000
TYPE_GCS = 6
GIMBAL = numbers_of(("GIMBAL_DEVICE_ATTITUDE_STATUS", "MOUNT_ORIENTATION", "MOUNT_STATUS"))
TO_ONE = numbers_of(
    (
        "COMMAND_LONG",
        "COMMAND_INT",
        "FILE_TRANSFER_PROTOCOL",
        "PARAM_REQUEST_LIST",
        "PARAM_REQUEST_READ",
        "PARAM_SET",
        "PARAM_EXT_REQUEST_LIST",
        "PARAM_EXT_REQUEST_READ",
        "PARAM_EXT_SET",
    )
)
"""Messages that name their target component."""
ASK_WAIT_S = 60.0
PX4 = 12  # MAV_AUTOPILOT

SILENT = "No autopilot: check mavlink.links, SERIALn_PROTOCOL and SERIALn_BAUD (PX4: MAV_n_CONFIG)"
MAVLINK_1 = "Autopilot sends MAVLink 1: set SERIALn_PROTOCOL = 2 (PX4: MAV_PROTO_VER = 2)"
NO_GIMBAL = (
    "No gimbal angles: set up the mount (MNT1_TYPE; PX4: MNT_MODE_OUT), or camera.mount = fixed"
)
NO_GROUND = "No ground station heard: remove 1024 from SERIALn_OPTIONS (PX4: MAV_n_FORWARD = 1)"
UNANSWERED = (
    "Answers do not reach the ground: remove 1024 from SERIALn_OPTIONS (PX4: MAV_n_FORWARD = 1)"
)
NEVER_ASKED = "Ground station does not query the camera: set MAV_n_FORWARD = 1 on this port"


@dataclass(frozen=True, slots=True)
class Trouble:
    """Something that a flight needs and the links lack."""

    what: str  # autopilot, mavlink 1, gimbal or ground
    text: str
    is_known: bool = False  # another text has reported it already
    is_grave: bool = True  # not ready to fly with it


@dataclass(frozen=True)
class WatchConfig:
    """The messages expected on the links, and how long to wait for them."""

    gimbal: bool | None = None  # True: its angles are required; None: optional
    wait_s: float = 10.0
    ground_wait_s: float = 60.0  # ground stations join later and leave radio range


class LinkWatch:
    """Gets every received packet; ``presence`` identifies our vehicle."""

    def __init__(self, config: WatchConfig, presence: Presence, now_ns: int) -> None:
        self._config, self._presence = config, presence
        self._first_autopilot_ns: int | None = None
        self._modern_ns = self._old_ns = self._gimbal_ns = -(1 << 62)  # never
        self._start_ns = self._ground_ns = now_ns
        self._asked_ns: int | None = None  # when a ground station addressed one of our components
        self._is_ground_heard = False
        self._announced: frozenset[str] = frozenset()

    def hear(self, packet: Packet, message: Any, now_ns: int) -> None:
        """Process one packet and its message."""
        system = self._presence.system
        if (packet.system, packet.component) == self._presence.autopilot:
            if self._first_autopilot_ns is None:
                self._first_autopilot_ns = now_ns
            if packet.data[0] == MAGIC_V1:
                self._old_ns = now_ns
            else:
                self._modern_ns = now_ns
        if packet.message_id in GIMBAL and packet.system == system:
            self._gimbal_ns = now_ns
        elif packet.message_id == 0 and message.type == TYPE_GCS:
            self._is_ground_heard, self._ground_ns = True, now_ns
        elif packet.message_id in TO_ONE and packet.system != system:
            is_ours = message.target_component in TYPES
            self._asked_ns = now_ns if is_ours else self._asked_ns

    def troubles(self, now_ns: int) -> tuple[Trouble, ...]:
        """Whatever is missing now, the most severe first."""
        found = (self._autopilot(now_ns) or self._telemetry(now_ns), self._ground(now_ns))
        return tuple(trouble for trouble in found if trouble is not None)

    def _is_stale(self, since_ns: int, wait_s: float, now_ns: int) -> bool:
        return now_ns - max(since_ns, self._start_ns) >= wait_s * S

    def _autopilot(self, now_ns: int) -> Trouble | None:
        seen_ns = self._presence.autopilot_seen_ns
        since_ns = self._start_ns if seen_ns is None else seen_ns
        if not self._is_stale(since_ns, self._config.wait_s, now_ns):
            return None
        others = self._presence.autopilots.others(now_ns)
        if not others:
            return Trouble("autopilot", SILENT)
        names = ", ".join(map(str, others))
        given = self._presence.config.system
        if given is None:
            text = f"Several autopilots ({names}): set mavlink.system_id"
            return Trouble("autopilot", text, is_known=True)
        text = f"No autopilot of system {given}, but of {names}: correct mavlink.system_id"
        return Trouble("autopilot", text)

    def _telemetry(self, now_ns: int) -> Trouble | None:
        """Messages that the autopilot does not send."""
        first_ns, wait_s = self._first_autopilot_ns, self._config.wait_s
        if first_ns is None or not self._is_stale(first_ns, wait_s, now_ns):
            return None
        if self._old_ns > self._modern_ns and self._is_stale(self._modern_ns, wait_s, now_ns):
            return Trouble("mavlink 1", MAVLINK_1)
        if self._config.gimbal is False or not self._is_stale(self._gimbal_ns, wait_s, now_ns):
            return None
        return Trouble("gimbal", NO_GIMBAL, is_grave=bool(self._config.gimbal))

    def _ground(self, now_ns: int) -> Trouble | None:
        wait_s, asked_ns = self._config.ground_wait_s, self._asked_ns
        if self._is_stale(self._ground_ns, wait_s, now_ns):
            is_asked = asked_ns is not None and not self._is_stale(asked_ns, wait_s, now_ns)
            text = UNANSWERED if is_asked and not self._is_ground_heard else NO_GROUND
            return Trouble("ground", text)
        is_late = self._is_stale(self._start_ns, ASK_WAIT_S, now_ns)
        autopilot = self._presence.autopilots.followed
        is_px4 = autopilot is not None and autopilot.firmware == PX4
        if asked_ns is None and is_late and is_px4:
            return Trouble("ground", NEVER_ASKED, is_grave=False)
        return None

    def news(self, now_ns: int, is_start: bool) -> Sequence[str]:
        """Texts for the operator: each trouble when it begins, and all at the start of a scan."""
        troubles = self.troubles(now_ns)
        before = frozenset() if is_start else self._announced
        self._announced = frozenset(t.what for t in troubles)
        return [t.text for t in troubles if t.what not in before and not t.is_known]


STEP_S = 0.02
BACKLOG = 10_000


@dataclass(frozen=True, slots=True)
class Found:
    """Result of a probe."""

    links: tuple[LinkReport, ...]
    autopilot: tuple[int, int] | None  # system and component
    troubles: tuple[Trouble, ...]


class LinkProbe:
    """A short probe of the links. ValueError for an invalid link or key.

    It sends heartbeats and requests telemetry, as the service does, because a port may carry
    nothing before. It executes no command.
    """

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
            self._presence, history, self._outbox, lambda severity, text: None
        )
        self._watch = LinkWatch(watch, self._presence, now_ns)
        self._decoder = Decoder()
        self._inbox: Inbox[tuple[int, Packet, int]] = Inbox(BACKLOG)
        opened = [Link(parse_link(text)) for text in links]
        self._links = Links(opened, lambda *heard: self._inbox.gather(heard), signing)

    def look(self, seconds: float) -> Found:
        """Listen and request for this long."""
        self._links.start()
        end_ns = time.monotonic_ns() + round(seconds * S)
        while time.monotonic_ns() < end_ns:
            self._step(time.monotonic_ns())
            time.sleep(STEP_S)
        troubles = self._watch.troubles(time.monotonic_ns())
        found = Found(self._links.report(), self._presence.autopilot, troubles)
        self._links.stop()
        return found

    def _step(self, now_ns: int) -> None:
        for index, packet, heard_ns in self._inbox.take(0.0)[0]:
            self._hear(index, packet, heard_ns)
        self._presence.confirm(Health.STANDBY, now_ns)
        self._presence.autopilots.look(now_ns)
        self._autopilot.follow()
        self._autopilot.tick(now_ns)
        messages = (*self._presence.due(now_ns), *self._outbox.take())
        self._links.send(self._presence.system, messages)

    def _hear(self, index: int, packet: Packet, now_ns: int) -> None:
        message = self._decoder.message(packet)
        if message is not None:
            self._presence.autopilots.count(packet.system, packet.component)
            self._autopilot.hear(message, packet, index, now_ns)
            self._watch.hear(packet, message, now_ns)
