"""The life of scans as a state machine: events go in, effects come out.

No clock, file or thread. Commands, arming and the configuration decide whether a scan is wanted;
attempts at it follow. So a stop ends every retry, and a pause or a fault cancels no wanted scan.
:class:`service.daemon.scanning.Scanning` performs the effects.
"""

from __future__ import annotations

from enum import Enum

from mavlink.component.control import Phase

FIRST_RETRY_S, LAST_RETRY_S = 1.0, 8.0  # waits between attempts at a scan


class State(Enum):
    IDLE = "idle", Phase.IDLE
    WAITING = "waiting", Phase.WAITING  # for the next attempt at the wanted scan
    WAITING_PAUSED = "waiting paused", Phase.WAITING
    SCANNING = "scanning", Phase.SCANNING
    PAUSED = "paused", Phase.PAUSED  # takes no frames
    CLOSING = "closing", Phase.FINALISING  # writes the files of the scan
    REOPENING = "reopening", Phase.WAITING  # closes a scan; another follows
    REOPENING_PAUSED = "reopening paused", Phase.WAITING
    ENDING = "ending", Phase.FINALISING  # the service closes its last scan
    ENDED = "ended", Phase.IDLE

    def __init__(self, text: str, phase: Phase) -> None:
        self.text, self.phase = text, phase  # and as the operator sees it

    @property
    def has_run(self) -> bool:
        """An attempt at a scan runs, or is being closed."""
        return Event.DONE in TRANSITIONS[self]

    @property
    def is_closing(self) -> bool:
        return self.has_run and Event.COMPLETED not in TRANSITIONS[self]

    @property
    def is_wanted(self) -> bool:
        """From start to stop, pauses and retries included."""
        return Event.STOP in TRANSITIONS[self]

    @property
    def is_paused(self) -> bool:
        return Event.RESUME in TRANSITIONS[self]


class Event(Enum):
    START = "start"  # a scan is wanted now; ends a pause
    STOP = "stop"
    PAUSE = "pause"
    RESUME = "resume"
    TICK = "due"  # time passes; counts once the next attempt is due
    GROWN = "grown"  # the attempt has stored data
    COMPLETED = "completed"  # the recording has ended by itself
    INTERRUPTED = "interrupted"  # a fault, or images of another shape; the scan is being closed
    DONE = "done"  # the attempt has ended
    FAILED = "failed"  # the attempt has ended by a fault
    END = "end"  # the service ends


class Effect(Enum):
    """What the owner of the machine does, in this order."""

    HOLD = "take no frames"
    RELEASE = "take frames"
    MARK = "note on disk that a crash must not end the scan"
    UNMARK = "remove the note"
    CLOSE = "stop the attempt"
    OPEN = "start an attempt"
    OFFER = "send earlier scans"


def _row(text: str) -> dict[Event, State]:
    states = {state.text: state for state in State}
    pairs = (pair.split(" > ") for pair in text.split(", ") if pair)
    return {Event(event): states[after] for event, after in pairs}


TRANSITIONS: dict[State, dict[Event, State]] = {
    State.IDLE: _row("start > waiting, end > ended"),
    State.WAITING: _row("due > scanning, stop > idle, pause > waiting paused, end > ended"),
    State.WAITING_PAUSED: _row(
        "due > paused, start > waiting, stop > idle, resume > waiting, end > ended"
    ),
    State.SCANNING: _row(
        "stop > closing, pause > paused, completed > closing, interrupted > reopening, "
        "done > idle, failed > waiting, end > ending"
    ),
    State.PAUSED: _row(
        "start > scanning, stop > closing, resume > scanning, completed > closing, "
        "interrupted > reopening paused, done > idle, failed > waiting paused, end > ending"
    ),
    State.CLOSING: _row("start > reopening, done > idle, failed > idle, end > ending"),
    State.REOPENING: _row(
        "stop > closing, pause > reopening paused, done > waiting, failed > waiting, end > ending"
    ),
    State.REOPENING_PAUSED: _row(
        "start > reopening, stop > closing, resume > reopening, done > waiting paused, "
        "failed > waiting paused, end > ending"
    ),
    State.ENDING: _row("done > ended, failed > ended"),
    State.ENDED: _row(""),
}
"""The next state; an event that is not listed changes nothing."""


class ScanLife:
    """The state, and when to try again. Its owner guards it against other threads."""

    def __init__(self, first_s: float = FIRST_RETRY_S, last_s: float = LAST_RETRY_S) -> None:
        """The wait between two attempts grows from ``first_s`` to ``last_s``."""
        self.state = State.IDLE
        self.failures = 0  # since the scan was requested
        self.due_s = 0.0  # the next attempt
        self._first_s, self._last_s, self._retry_s = first_s, last_s, first_s

    def handle(self, event: Event, now_s: float) -> tuple[Effect, ...]:
        """Take an event at ``now_s`` of a monotonic clock; what is to be done about it."""
        if event is Event.TICK and now_s < self.due_s:
            return ()
        before = self.state
        self.state = after = TRANSITIONS[before].get(event, before)
        if event is Event.START:
            self.due_s, self.failures, self._retry_s = now_s, 0, self._first_s
        elif event is Event.GROWN:
            self._retry_s = self._first_s
        elif event is Event.FAILED and after.is_wanted:
            self.failures += 1
            self.due_s = now_s + self._retry_s
            self._retry_s = min(2.0 * self._retry_s, self._last_s)
        is_dropped = before.is_wanted and not after.is_wanted
        has_opened = after.has_run and not before.has_run
        found = {
            Effect.HOLD: after.is_paused and not before.is_paused,
            Effect.RELEASE: before.is_paused and not after.is_paused,
            Effect.MARK: after.is_wanted and not before.is_wanted,
            Effect.UNMARK: event in (Event.STOP, Event.END) or is_dropped,
            Effect.CLOSE: event in (Event.STOP, Event.END) and before.has_run,
            Effect.OPEN: has_opened,
            Effect.OFFER: after is State.IDLE is not before,
        }
        return tuple(effect for effect, is_due in found.items() if is_due)
