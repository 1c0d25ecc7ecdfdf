"""What a gimbal's quaternion refers to, by what its camera's pictures say of the rotation."""

from __future__ import annotations

from collections import deque

from mavlink.gimbal import Ends, FrameVerdict, judge_frame
from mavlink.history import VehicleHistory
from mavlink.quaternion import Quaternion, multiply, normalised

LEAST_TURNS = 20
STEP_NS = 1_000_000_000  # turns are compared over so long: over less they are mostly noise
KEPT = 120


class FrameWatch:
    """Collects turns between frames and says what the gimbal's quaternion refers to."""

    def __init__(self, history: VehicleHistory) -> None:
        self._history = history
        self._turns: deque[tuple[int, int, Quaternion]] = deque(maxlen=KEPT)
        self._open: tuple[int, int, Quaternion] | None = None  # a turn that is not whole yet

    def add(self, first_ns: int, second_ns: int, q_step: Quaternion) -> None:
        """Take in ``q_head(first)_head(second)``, seen between two frames, in the head's axes.

        Steps that follow on each other are joined to turns of a second.
        """
        step = normalised(q_step)
        if second_ns <= first_ns or step is None:
            return
        if self._open is not None and self._open[1] == first_ns:
            start_ns, _, turned = self._open
            step = normalised(multiply(turned, step)) or step
            first_ns = start_ns
        self._open = (first_ns, second_ns, step)
        if second_ns - first_ns >= STEP_NS:
            self._turns.append(self._open)
            self._open = None

    def verdict(self, latency_ms: float = 0.0) -> FrameVerdict | None:
        """The frame that agrees with the pictures; None with less than twenty turns to go by."""
        shift = round(latency_ms * 1e6)
        sent: list[Ends] = []
        bodies: list[Ends] = []
        turns: list[Quaternion] = []
        for first_ns, second_ns, turn in self._turns:
            first = self._history.claimed_at(first_ns - shift)
            second = self._history.claimed_at(second_ns - shift)
            if first is not None and second is not None:
                sent.append((first[0], second[0]))
                bodies.append((first[1], second[1]))
                turns.append(turn)
        return judge_frame(sent, bodies, turns) if len(turns) >= LEAST_TURNS else None
