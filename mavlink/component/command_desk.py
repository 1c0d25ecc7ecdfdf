"""The command protocol: each call is checked, executed once and acknowledged.

Rules of the MAVLink command service: immediate acknowledgement, IN_PROGRESS while work runs and a
final result after it, TEMPORARILY_REJECTED for the same command while it runs, UNSUPPORTED for
unknown commands. Clients do not number their retransmissions reliably, so a repetition is
recognised by its content: within a time window the last executed command is acknowledged again,
not executed again. A refused one has changed nothing and may succeed now, so it is remembered only
for the moment in which it arrives on several links. A stop is executed every time, also while the
same command runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from mavlink.component.control import Answer, Handled, Result, Work
from mavlink.component.status import INFO, WARNING
from mavlink.wire.dialect import dialect
from mavlink.wire.messages import Address, SendQueue

INT_UNSET = 0x7FFFFFFF
PROGRESS_EVERY_NS = 500_000_000
WORK_LIMIT_NS = 180_000_000_000
S = 1_000_000_000
MOMENT_NS = 300_000_000
REFUSED = frozenset({Result.TEMPORARILY_REJECTED, Result.DENIED, Result.UNSUPPORTED})
BUSY = Answer(Result.TEMPORARILY_REJECTED, "busy")


@dataclass(frozen=True, slots=True)
class Call:
    """A received command; unset parameters are NaN."""

    number: int
    params: tuple[float, float, float, float, float, float, float]
    source: Address
    target: Address
    link: int

    def param(self, k: int, default: float) -> float:
        """Parameter k (1 to 7), or the default when it is not set."""
        value = self.params[k - 1]
        return value if math.isfinite(value) else default

    @property
    def is_broadcast(self) -> bool:
        """True when the sender named no component."""
        return self.target.component == 0


@dataclass(frozen=True, slots=True)
class Command:
    components: frozenset[int]  # our components that accept it
    window_s: float  # within it a repetition is a retransmission; 0 for queries
    handle: Callable[[Call, Any], Handled | None]  # None: not for this component


def decode_call(message: Any, link: int) -> Call | None:
    """The call in a COMMAND_LONG or COMMAND_INT; None for any other message."""
    kind = message.get_type()
    if kind == "COMMAND_LONG":
        last = (message.param5, message.param6, message.param7)
    elif kind == "COMMAND_INT":
        x, y = (math.nan if v == INT_UNSET else float(v) for v in (message.x, message.y))
        last = (x, y, message.z)
    else:
        return None
    first = (message.param1, message.param2, message.param3, message.param4)
    return Call(
        message.command,
        (*first, *last),
        Address(message.get_srcSystem(), message.get_srcComponent()),
        Address(message.target_system, message.target_component),
        link,
    )


def _key(call: Call) -> tuple[object, ...]:
    """Equal for a call and its repetition; NaN is replaced because it never equals itself."""
    return (call.source, call.number, *map(str, call.params))


@dataclass(slots=True)
class _Running:
    component: int
    call: Call
    window_ns: int
    work: Work
    until_ns: int
    next_report_ns: int


@dataclass(frozen=True, slots=True)
class _Done:
    key: tuple[object, ...]
    answer: Answer
    until_ns: int


class CommandDesk:
    """Receives calls for our components and answers them through an outbox."""

    def __init__(
        self,
        commands: Mapping[int, Command],
        outbox: SendQueue,
        host: Any,
        say: Callable[[int, str], None],
        is_stop: Callable[[Call], bool],
    ) -> None:
        """``say`` gets the severity and text of answers."""
        self._commands, self._is_stop = commands, is_stop
        self._outbox = outbox
        self._host = host
        self._say = say
        self._running: dict[tuple[object, ...], _Running] = {}  # each stop gets its own result
        self._last: _Done | None = None  # shared: both components act on one scan

    def receive(self, call: Call, components: tuple[int, ...], now_ns: int) -> None:
        """Execute a call for one of our components (the caller has checked that)."""
        command = self._commands.get(call.number)
        if call.is_broadcast:
            mine = [c for c in components if command is not None and c in command.components]
            if not mine:
                return  # not for us; refusals from both components would mislead the sender
            component = mine[0]
        else:
            component = call.target.component
        if command is None or component not in command.components:
            self._answer(component, call, Answer(Result.UNSUPPORTED))
            return
        self._carry_out(component, command, call, now_ns)

    def _carry_out(self, component: int, command: Command, call: Call, now_ns: int) -> None:
        key = (component, *_key(call))
        is_stop = self._is_stop(call)
        running = [(one.component, one.call.number) for one in self._running.values()]
        if not is_stop and (component, call.number) in running:
            self._answer_while(component, call, key)
            return
        last = self._last
        if last is not None and not is_stop and last.key == key and now_ns < last.until_ns:
            self._answer(component, call, Answer(last.answer.result))
            return
        handled = command.handle(call, self._host)
        if key in self._running and isinstance(handled, Work):
            self._answer_while(component, call, key)
        elif handled is None:
            if not call.is_broadcast:
                self._answer(component, call, Answer(Result.DENIED))
        elif isinstance(handled, Work):
            window_ns = int(command.window_s * S)
            limit_ns, report_ns = now_ns + WORK_LIMIT_NS, now_ns + PROGRESS_EVERY_NS
            self._last = None
            self._running[key] = _Running(component, call, window_ns, handled, limit_ns, report_ns)
            if handled.answer is None and not handled.is_brief:
                self._progress(component, call, handled)
            self.tick(now_ns)
        else:
            self._answer(component, call, handled)
            self._remember(key, handled, now_ns, int(command.window_s * S))

    def _answer_while(self, component: int, call: Call, key: tuple[object, ...]) -> None:
        """Acknowledge while this command runs; only one final result can be reported."""
        if key in self._running:
            self._progress(component, call, self._running[key].work)
        else:
            self._answer(component, call, BUSY)

    def _remember(
        self, key: tuple[object, ...], answer: Answer, now_ns: int, window_ns: int
    ) -> None:
        """Remember an executed command; queries are not remembered, so that they hide none."""
        if answer.result in REFUSED:
            window_ns = min(window_ns, MOMENT_NS)
        if window_ns:
            self._last = _Done(key, answer, now_ns + window_ns)

    def cancel(self, number: int, now_ns: int) -> None:
        for running in self._running.values():
            if running.call.number == number:
                running.work.cancel()
        self.tick(now_ns)

    def tick(self, now_ns: int) -> None:
        """Report progress and final results of running work."""
        for key, running in list(self._running.items()):
            component, answer = running.component, running.work.answer
            if isinstance(answer, Work):
                running.work, answer = answer, None
            if answer is None and now_ns >= running.until_ns:
                running.work.cancel()
                answer = Answer(Result.FAILED, "timed out")
            if answer is not None:
                del self._running[key]
                if running.work.cancelled and answer.result is Result.ACCEPTED:
                    answer = Answer(Result.CANCELLED)
                self._answer(component, running.call, answer)
                self._remember(key, answer, now_ns, running.window_ns)
            elif now_ns >= running.next_report_ns:
                running.next_report_ns = now_ns + PROGRESS_EVERY_NS
                self._progress(component, running.call, running.work)

    def _progress(self, component: int, call: Call, work: Work) -> None:
        percent = min(99, int(100 * work.fraction))
        self._ack(component, call, Result.IN_PROGRESS, percent)

    def _answer(self, component: int, call: Call, answer: Answer) -> None:
        self._ack(component, call, answer.result, 255)
        if answer.text:
            self._say(INFO if answer.result is Result.ACCEPTED else WARNING, answer.text)

    def _ack(self, component: int, call: Call, result: Result, progress: int) -> None:
        message = dialect.MAVLink_command_ack_message(
            call.number, int(result), progress, 0, call.source.system, call.source.component
        )
        self._outbox.put(component, message, call.link)
