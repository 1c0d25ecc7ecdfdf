"""Detects what is missing on open links, and names the setting to change.

ArduPilot does not forward a ground station's heartbeats to a port with private traffic, so a
ground station that is never heard does not hear us either. PX4 forwards each direction
independently; there the symptom is that no ground station ever queries our camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mavlink.component.presence import Presence
from mavlink.wire.dialect import numbers_of
from mavlink.wire.first_beat import TYPES
from mavlink.wire.framing import MAGIC_V1, Packet

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
"""Messages to us that name their target component."""
ASK_WAIT_S = 60.0
BREAK_NS = 5 * S  # of the autopilot: afterwards its messages are waited for again
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
    gimbal: bool | None = None  # True: its angles are required; None: optional
    wait_s: float = 10.0
    ground_wait_s: float = 60.0  # ground stations join later and leave radio range


class LinkWatch:
    """Gets every received packet; ``presence`` identifies our vehicle."""

    def __init__(self, config: WatchConfig, presence: Presence, now_ns: int) -> None:
        self._config, self._presence = config, presence
        self._autopilot_ns: int | None = None  # its last message
        self._since_ns = now_ns  # it is heard without a break
        self._modern_ns = self._old_ns = self._gimbal_ns = -(1 << 62)  # never
        self._start_ns = self._ground_ns = now_ns
        self._asked_ns: int | None = None  # when a ground station addressed one of our components
        self._is_ground_heard = False
        self._announced: frozenset[str] = frozenset()

    def hear(self, packet: Packet, message: Any, now_ns: int) -> None:
        system = self._presence.system
        if (packet.system, packet.component) == self._presence.autopilot:
            if self._autopilot_ns is None or now_ns - self._autopilot_ns > BREAK_NS:
                self.restart(now_ns)
            self._autopilot_ns = now_ns
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

    def restart(self, now_ns: int) -> None:
        self._since_ns = now_ns

    def troubles(self, now_ns: int) -> tuple[Trouble, ...]:
        """Whatever is missing now, the most severe first."""
        found = (self._autopilot(now_ns) or self._telemetry(), self._ground(now_ns))
        return tuple(trouble for trouble in found if trouble is not None)

    def _is_stale(self, since_ns: int, wait_s: float, now_ns: int) -> bool:
        return now_ns - max(since_ns, self._start_ns) >= wait_s * S

    def _autopilot(self, now_ns: int) -> Trouble | None:
        seen_ns = self._presence.autopilot_seen_ns
        since_ns = self._start_ns if seen_ns is None else seen_ns
        if not self._is_stale(since_ns, self._config.wait_s, now_ns):
            return None
        others = self._presence.others(now_ns)
        if not others:
            return Trouble("autopilot", SILENT)
        names = ", ".join(map(str, others))
        given = self._presence.config.system
        if given is None:
            text = f"Several autopilots ({names}): set mavlink.system_id"
            return Trouble("autopilot", text, is_known=True)
        text = f"No autopilot of system {given}, but of {names}: correct mavlink.system_id"
        return Trouble("autopilot", text)

    def _telemetry(self) -> Trouble | None:
        """Messages that the autopilot does not send while it sends others."""
        heard_ns, wait_s = self._autopilot_ns, self._config.wait_s
        if heard_ns is None or not self._is_stale(self._since_ns, wait_s, heard_ns):
            return None
        if self._old_ns > self._modern_ns and self._is_stale(self._modern_ns, wait_s, heard_ns):
            return Trouble("mavlink 1", MAVLINK_1)
        if self._config.gimbal is False or not self._is_stale(self._gimbal_ns, wait_s, heard_ns):
            return None
        return Trouble("gimbal", NO_GIMBAL, is_grave=bool(self._config.gimbal))

    def _ground(self, now_ns: int) -> Trouble | None:
        wait_s, asked_ns = self._config.ground_wait_s, self._asked_ns
        if self._is_stale(self._ground_ns, wait_s, now_ns):
            is_asked = asked_ns is not None and not self._is_stale(asked_ns, wait_s, now_ns)
            text = UNANSWERED if is_asked and not self._is_ground_heard else NO_GROUND
            return Trouble("ground", text)
        is_late = self._is_stale(self._start_ns, ASK_WAIT_S, now_ns)
        autopilot = self._presence.followed
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
