"""Accepts loops: two must agree, and the drift of vision must explain them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping

import numpy as np

from recon import se3
from recon.posegraph.records import Loop
from recon.posegraph.thinning import moved_loops
from recon.types import F64

DRIFT, SLACK_M, MAX_TURN_RAD = 0.05, 2.0, 0.5
"""A loop off by more than this share of the path between its ends and so many metres, or by such a
turn, is impossible: vision drifts by less."""

MAX_PENDING = 50
"""Loops that wait for one that agrees; older ones are forgotten."""


def is_explained(loop: Loop, T_a_b: F64, path_m: float) -> bool:
    """False when a loop, in metres, is off by more than vision can drift: ``T_a_b`` (4, 4) is the
    track's motion between its ends, over a path of so many metres."""
    apart = se3.log(se3.inverse(loop.T_a_b) @ T_a_b)
    turned, moved = float(np.linalg.norm(apart[:3])), float(np.linalg.norm(apart[3:]))
    return moved < SLACK_M + DRIFT * path_m and turned < MAX_TURN_RAD


class LoopVerification:
    """Loops that were offered, and which of them the map rests on."""

    def __init__(self) -> None:
        self.taken: list[Loop] = []
        self.pending: list[Loop] = []  # none that agrees was found yet
        self.counts: Counter[str] = Counter()

    def offer(self, loop: Loop, agree: Callable[[Loop, Loop], bool]) -> list[Loop]:
        """Return the loops accepted from now on, by those that ``agree``; empty while this one
        waits."""
        support = [other for other in self.pending + self.taken if agree(loop, other)]
        if not support:
            self.pending = [*self.pending, loop][-MAX_PENDING:]
            self.counts["loop waits"] += 1
            return []
        fresh = [loop, *(other for other in support if other in self.pending)]
        self.pending = [other for other in self.pending if other not in support]
        self.taken += fresh
        return fresh

    def thin(self, marginalised: Mapping[int, Loop], dropped: Collection[int], most: int) -> None:
        """Move ends that were marginalised; drop loops of dropped keyframes; at most ``most``
        stay."""
        self.taken = moved_loops(self.taken, marginalised, dropped, most)
        self.pending = moved_loops(self.pending, marginalised, dropped, most)
