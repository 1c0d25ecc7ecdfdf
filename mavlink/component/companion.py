"""The companion computer on the vehicle's network: packets in, messages out.

No sockets and no clocks: ``receive(link, packet, now_ns)``, ``tick(now_ns)`` and ``take()``.
:mod:`mavlink.component.vehicle` connects it to real links.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from mavlink.component import status as texts
from mavlink.component.autopilot_link import AutopilotLink
from mavlink.component.camera import CAPTURE_STATUS, CameraComponent
from mavlink.component.command_desk import CommandDesk, decode_call
from mavlink.component.commands import COMMANDS, is_stop
from mavlink.component.control import Answer, Handled, Result, ScanControl, Work
from mavlink.component.ftp import FileServer
from mavlink.component.link_watch import TO_ONE, LinkWatch, WatchConfig
from mavlink.component.metadata import (
    DEFINITION,
    GENERAL,
    MODEL,
    VENDOR,
    ComponentMetadataMessage,
    camera_definition,
    metadata_files,
)
from mavlink.component.metadata import NUMBER as METADATA
from mavlink.component.parameters import YAW_FRAME, Parameters, with_defaults
from mavlink.component.presence import RECENT_NS, Presence
from mavlink.component.status import ComputerLoad, StatusTexts, computer_status, motion_values
from mavlink.telemetry.decode import READERS
from mavlink.telemetry.gimbal import YAW_FRAMES
from mavlink.telemetry.history import VehicleHistory
from mavlink.wire.dialect import COMMAND_CANCEL, dialect, numbers_of
from mavlink.wire.first_beat import CAMERA, ONBOARD
from mavlink.wire.framing import Decoder, Packet
from mavlink.wire.messages import Address, OutgoingMessage, SendQueue, Stream

S = 1_000_000_000
MS = 1_000_000
COMPONENTS = (ONBOARD, CAMERA)
LOAD_STATUS, MOTION = 390, 251
LOAD_EVERY_US = 2_000_000
HEARD = numbers_of((*READERS, "HEARTBEAT", "SYSTEM_TIME", "TIMESYNC")) | TO_ONE | {COMMAND_CANCEL}
"""Numbers of the messages that :meth:`Companion.receive` handles."""


TICK_S, IDLE_TICK_S = 0.01, 0.04
FAST_US = 400_000  # streams with a shorter interval, down to 20 ms, need the short pause


@dataclass(frozen=True, slots=True)
class CompanionConfig:
    parameters: Mapping[str, float] = field(default_factory=dict)  # this aircraft's defaults
    watch: WatchConfig = field(default_factory=WatchConfig)
    motion_every_s: float = 1.0


@dataclass(frozen=True, slots=True)
class _Waiting:
    """An action that waits for the report that the vehicle is disarmed."""

    what: str
    act: Callable[[], Handled]
    work: Work
    since_ns: int


class Companion:
    """The protocol of our two components, apart from their heartbeats."""

    def __init__(
        self,
        config: CompanionConfig,
        control: ScanControl,
        presence: Presence,
        history: VehicleHistory,
        now_ns: int,
        kept_parameters: Mapping[str, float] | None = None,
        unix_us: Callable[[], int] = lambda: 0,
    ) -> None:
        self.config = config
        self.control = control
        self.presence = presence
        self.history = history
        self.load: ComputerLoad | None = None  # not measured yet
        self._unix_us = unix_us
        self._listeners: dict[str, list[Callable[[Any], None]]] = {}
        self._start_ns = self._now_ns = now_ns
        self._outbox = SendQueue()
        self._decoder = Decoder()
        self.watch = LinkWatch(config.watch, presence, now_ns)
        self.autopilot = AutopilotLink(
            presence, history, self._outbox, self.say, lambda: self.watch.restart(self._now_ns)
        )
        self.texts = StatusTexts(self._outbox)
        self.parameters = Parameters(
            self._outbox, self._parameter_changed, kept_parameters, with_defaults(config.parameters)
        )
        table = self.parameters.table
        version, definition = camera_definition(VENDOR, MODEL, table)
        metadata = metadata_files(table)
        self._general = metadata[GENERAL]
        self._files = FileServer({DEFINITION: definition, **metadata})
        self.camera = CameraComponent(
            version,
            control,
            self._outbox,
            self._boot_ms,
            lambda: self._now_ns,
            self._answer,
        )
        self.desk = CommandDesk(COMMANDS, self._outbox, self, self._answer, is_stop)
        self.streams = {
            (component, number): Stream(us, partial(self.send_requested, component, number))
            for component, number, us in (
                (ONBOARD, LOAD_STATUS, LOAD_EVERY_US),
                *((CAMERA, number, -1) for number in self.camera.STREAMED),
            )
        }
        every_us = round(config.motion_every_s * 1e6)
        self.streams[ONBOARD, MOTION] = Stream(every_us, self._send_motion)
        self._waiting: list[_Waiting] = []
        self._is_recording, self._watch_ns = False, now_ns

    # Input.

    def receive(self, link: int, packet: Packet, now_ns: int) -> None:
        """Process one packet that arrived on a link at ``now_ns`` (monotonic)."""
        self._now_ns = max(self._now_ns, now_ns)
        self.presence.count(packet.system, packet.component)
        if packet.message_id == COMMAND_CANCEL:
            self._cancel(packet, now_ns)
            return
        message = self._decoder.message(packet)
        if message is None:
            return
        name = message.get_type()
        for listener in self._listeners.get(name, ()):
            listener(message)
        self.autopilot.hear(message, packet, link, now_ns)
        if name.startswith("COMMAND_"):
            call = decode_call(message, link)
            if call is not None and self._is_for_us(call.target):
                self.desk.receive(call, COMPONENTS, now_ns)
        elif name.startswith("PARAM_"):
            self._hear_parameter(message, name)
        elif name == "FILE_TRANSFER_PROTOCOL" and message.target_component:
            target = Address(message.target_system, message.target_component)
            if self._is_for_us(target):
                self._files.serve(message, link, self._outbox)
        self.watch.hear(packet, message, now_ns)  # after the sender of a heartbeat is known

    def when_disarmed(self, what: str, act: Callable[[], Handled]) -> Handled:
        """Act once the autopilot reports from now on that it is disarmed; what it reported before
        may have changed since. Refused while it is armed or silent."""
        if self.presence.is_armed:
            return Answer(Result.TEMPORARILY_REJECTED, f"{what} refused while armed")
        waiting = _Waiting(what, act, Work(), self._now_ns)
        self._waiting.append(waiting)
        return waiting.work

    def _look_at_arming(self) -> None:
        """Act, refuse or wait on, by the autopilot's last report."""
        waiting, self._waiting = self._waiting, []
        for w in waiting:
            if w.work.cancelled:
                w.work.finish()
            elif self.presence.is_disarmed(w.since_ns):
                w.work.finish(w.act())
            elif self.presence.is_armed or self._now_ns - w.since_ns > RECENT_NS:
                why = " while armed" if self.presence.is_armed else ": armed state unknown"
                w.work.finish(Answer(Result.TEMPORARILY_REJECTED, f"{w.what} refused{why}"))
            else:
                self._waiting.append(w)

    def _is_for_us(self, target: Address) -> bool:
        ours = target.system in (0, self.presence.system)
        return ours and (target.component == 0 or target.component in COMPONENTS)

    def _cancel(self, packet: Packet, now_ns: int) -> None:
        # uint16 command, uint8 target system, uint8 target component; trailing zeros are cut.
        payload = packet.data[10 : 10 + packet.data[1]] if packet.data[0] == 0xFD else b""
        payload = payload.ljust(4, b"\0")
        number = payload[0] | payload[1] << 8
        if self._is_for_us(Address(payload[2], payload[3])):
            self.desk.cancel(number, now_ns)

    def _hear_parameter(self, message: Any, name: str) -> None:
        if getattr(message, "target_system", None) not in (0, self.presence.system):
            return
        extended = name.startswith("PARAM_EXT_")
        if message.target_component not in (0, CAMERA if extended else ONBOARD):
            return
        answer = self.parameters.receive(message)
        if answer is not None and answer.text:
            self._answer(texts.WARNING, answer.text)

    def _parameter_changed(self, name: str, value: float) -> Answer:
        answer = self.control.parameter_changed(name, value)
        if name == YAW_FRAME and answer.result is Result.ACCEPTED:
            self.history.set_yaw_frame(YAW_FRAMES[round(value)])
        return answer

    def announce_kept(self) -> None:
        """Pass the parameters kept from an earlier run to the service."""
        for name, value in self.parameters.kept().items():
            answer = self._parameter_changed(name, value)
            if answer.result is not Result.ACCEPTED:
                self.parameters.forget(name)

    # Output.

    def take(self) -> list[OutgoingMessage]:
        return self._outbox.take()

    def tick(self, now_ns: int) -> None:
        self._now_ns = max(self._now_ns, now_ns)
        self.presence.look(now_ns)
        self.autopilot.follow()
        for text in self.presence.take_news():
            self.say(texts.WARNING, text)
        self.camera.tick(now_ns)
        self._look_at_arming()
        self.desk.tick(now_ns)
        for stream in self.streams.values():
            stream.tick(now_ns)
        self.texts.tick(now_ns)
        self.autopilot.tick(now_ns)
        self._watch_links(now_ns)

    @property
    def pause_s(self) -> float:
        """Until the next :meth:`tick`, at most; idle, a longer pause spares the processor."""
        fast = any(0 < stream.interval_us < FAST_US for stream in self.streams.values())
        return TICK_S if fast or self._is_recording else IDLE_TICK_S

    def _watch_links(self, now_ns: int) -> None:
        if now_ns < self._watch_ns:
            return
        self._watch_ns = now_ns + S
        was_recording, self._is_recording = self._is_recording, self.control.status().is_recording
        for text in self.watch.news(now_ns, self._is_recording and not was_recording):
            self.say(texts.WARNING, text)
        self.presence.is_ready = not any(t.is_grave for t in self.watch.troubles(now_ns))

    def say(self, severity: int, text: str, is_answer: bool = False) -> None:
        """Send a text to the operator; one that answers a command is never held back."""
        self.texts.say(severity, text, self._now_ns, is_answer)

    def _answer(self, severity: int, text: str) -> None:
        self.say(severity, text, is_answer=True)

    def send(self, message: Any) -> None:
        """Send a message of the onboard computer to everyone."""
        self._outbox.put(ONBOARD, message)

    def listen(self, name: str, listener: Callable[[Any], None]) -> None:
        """Call ``listener`` with every message of a name, from any sender."""
        self._listeners.setdefault(name, []).append(listener)

    def send_requested(
        self, component: int, number: int, index: int = 0, link: int | None = None
    ) -> bool:
        """Send a message, to everyone without a ``link``; False when the component has none."""
        if component == CAMERA:
            message = self.camera.message(number, index)
        elif number == METADATA:
            message = ComponentMetadataMessage(self._boot_ms(), self._general)
        elif number == LOAD_STATUS and self.load is not None:
            message = computer_status(self.load, self._unix_us(), self._boot_ms())
        else:
            message = None
        if message is None:
            return False
        is_for_all = number == CAPTURE_STATUS  # every ground station's buttons depend on it
        self._outbox.put(component, message, None if is_for_all else link)
        return True

    def send_interval(self, component: int, number: int, link: int) -> None:
        interval_us = self.streams[component, number].interval_us
        message = dialect.MAVLink_message_interval_message(number, interval_us)
        self._outbox.put(component, message, link)

    def _send_motion(self) -> None:
        for message in motion_values(self.control.status(), self._boot_ms()):
            self.send(message)

    def _boot_ms(self) -> int:
        return ((self._now_ns - self._start_ns) // MS) & 0xFFFFFFFF
