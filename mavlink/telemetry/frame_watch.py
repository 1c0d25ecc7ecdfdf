"""A gimbal quaternion's reference frame, from the rotation in its camera's images."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from mavlink.telemetry.gimbal import to_earth
from mavlink.telemetry.history import VehicleHistory
from mavlink.telemetry.quaternion import Quaternion, angle_between, conjugate, multiply, normalised
from mavlink.telemetry.samples import GimbalFrame

SAME_RAD = math.radians(0.3)
CLEAR_RAD = math.radians(0.05)
MIN_TURNS = 20
STEP_NS = 1_000_000_000  # rotations over shorter times are mostly noise
KEPT = 120


@dataclass(frozen=True, slots=True)
class FrameVerdict:
    """The frame that agrees with the images."""

    frame: GimbalFrame
    decided: bool  # the rotations distinguish the frames
    refuted: tuple[GimbalFrame, ...] = ()  # frames that disagree clearly more


Ends = tuple[Quaternion, Quaternion]
"""A rotation at the first and at the second of two images."""


def judge_frame(
    q_sent: Sequence[Ends], q_ned_body: Sequence[Ends], q_seen_steps: Sequence[Quaternion]
) -> FrameVerdict | None:
    """The frame of a gimbal's quaternions that agrees with the rotation seen by the camera.

    For N pairs of images: the quaternions sent by the gimbal and the body's attitude at both, and
    the rotation ``q_head(first)_head(second)`` measured between them, in the head's axes. None
    without pairs. ``decided`` requires the best frame to disagree less than half as much as
    every other frame with a different meaning.
    """
    if not len(q_sent) == len(q_ned_body) == len(q_seen_steps):
        raise ValueError(
            f"judge_frame needs as many of each, got "
            f"{len(q_sent)}, {len(q_ned_body)} and {len(q_seen_steps)}"
        )
    if not q_sent:
        return None
    heads: dict[GimbalFrame, list[Ends]] = {
        frame: [
            (to_earth(a, frame, body_a), to_earth(b, frame, body_b))
            for (a, b), (body_a, body_b) in zip(q_sent, q_ned_body, strict=True)
        ]
        for frame in GimbalFrame
    }
    rms = {frame: _disagreement(heads[frame], q_seen_steps) for frame in GimbalFrame}
    best = min(rms, key=lambda frame: rms[frame])
    # A frame that always gives the same attitudes is no rival.
    rivals = [f for f in GimbalFrame if _largest_angle(heads[f], heads[best]) > SAME_RAD]
    refuted = tuple(
        f for f in rivals if rms[f] > 2.0 * rms[best] and rms[f] - rms[best] > CLEAR_RAD
    )
    return FrameVerdict(best, bool(rivals) and refuted == tuple(rivals), refuted)


def _disagreement(heads: Sequence[Ends], steps: Sequence[Quaternion]) -> float:
    """Root mean square angle in rad between the steps of the heads and those seen."""
    squares = [
        angle_between(multiply(conjugate(a), b), seen) ** 2
        for (a, b), seen in zip(heads, steps, strict=True)
    ]
    return math.sqrt(sum(squares) / len(squares))


def _largest_angle(a: Sequence[Ends], b: Sequence[Ends]) -> float:
    return max(
        angle_between(p, q) for pair in zip(a, b, strict=True) for p, q in zip(*pair, strict=True)
    )


class FrameWatch:
    """Collects rotations between frames and finds the reference frame of the gimbal."""

    def __init__(self, history: VehicleHistory) -> None:
        self._history = history
        self._turns: deque[tuple[int, int, Quaternion]] = deque(maxlen=KEPT)
        self._open: tuple[int, int, Quaternion] | None = None  # a rotation still growing

    def add(self, first_ns: int, second_ns: int, q_step: Quaternion) -> None:
        """Take in ``q_head(first)_head(second)``, seen between two frames, in the head's axes.

        Consecutive steps are joined to rotations over a second.
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
        """The frame that agrees with the images; None with fewer than twenty rotations."""
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
        return judge_frame(sent, bodies, turns) if len(turns) >= MIN_TURNS else None
