"""Accepts loops: two must agree, and the drift of vision must explain them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from typing import Protocol

import numpy as np

from recon import se3
from recon.posegraph.records import Loop, Node, loops_agree
from recon.posegraph.thinning import moved_loops
from recon.types import F64

CHI2_LIMIT = 22.5
"""99.9 % of chi-square with six degrees of freedom."""

DRIFT, SLACK_M, MAX_TURN_RAD = 0.05, 2.0, 0.5
"""A loop off by more than this share of the path between its ends and so many metres, or by such a
turn, is impossible: vision drifts by less."""

WINDOW = 15
"""Keyframes within which two loops support each other: between those, vision is trusted."""

MAX_PENDING = 50
"""Loops that wait for one that agrees; older ones are forgotten."""


class Track(Protocol):
    """What loops are held against: the keyframes' poses as the graph has them."""

    def node(self, seq: int) -> Node: ...

    def place(self, seq: int) -> F64: ...

    def scale(self, seq: int) -> float: ...

    def path_m(self, a: int, b: int) -> float: ...


class LoopVerification:
    """Loops that were offered, and which of them the map rests on."""

    def __init__(self, track: Track) -> None:
        self.taken: list[Loop] = []
        self.pending: list[Loop] = []  # none that agrees was found yet
        self.counts: Counter[str] = Counter()
        self._track = track

    def offer(self, loop: Loop) -> list[Loop]:
        """Return the loops accepted from now on; empty while this one waits or is refused."""
        if not self._is_possible(loop):
            self.counts["loop impossible"] += 1
            return []
        support = [other for other in self.pending + self.taken if self._agree(loop, other)]
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

    def into(self, segment: int) -> list[Loop]:
        return [loop for loop in self.taken if self.enters(loop, segment)]

    def enters(self, loop: Loop, segment: int) -> bool:
        """True when the loop leads from an earlier segment into this one."""
        ends = [self._track.node(seq).segment for seq in loop.ends]
        return ends[1] == segment != ends[0]

    def _is_possible(self, loop: Loop) -> bool:
        """False when a loop within a segment is off by more than vision can drift."""
        track = self._track
        if track.node(loop.a).segment != track.node(loop.b).segment:
            return True
        T = se3.inverse(track.place(loop.a)) @ track.place(loop.b)
        apart = se3.log(se3.inverse(loop.scaled(track.scale(loop.a)).T_a_b) @ T)
        allowed_m = SLACK_M + DRIFT * track.path_m(loop.a, loop.b)
        turned, moved = float(np.linalg.norm(apart[:3])), float(np.linalg.norm(apart[3:]))
        return moved < allowed_m and turned < MAX_TURN_RAD

    def _agree(self, one: Loop, other: Loop) -> bool:
        """True when two loops, joined by the track between their ends, close on themselves."""
        track = self._track
        near = all(self._apart(*pair) <= WINDOW for pair in zip(one.ends, other.ends, strict=True))
        if not near or one.ends == other.ends:
            return False
        ends = (one.a, other.a, other.b, one.b)
        a, a_other, b_other, b = (track.place(seq) for seq in ends)
        T_a_a, T_b_b = se3.inverse(a) @ a_other, se3.inverse(b_other) @ b
        T_b_b[:3, 3] *= one.ratio * track.scale(one.a) / track.scale(one.b)
        one, other = one.scaled(track.scale(one.a)), other.scaled(track.scale(other.a))
        return loops_agree(one, other, T_a_a, T_b_b, CHI2_LIMIT)

    def _apart(self, seq: int, other: int) -> int:
        """Keyframes from one to the other; many between segments."""
        one, two = self._track.node(seq), self._track.node(other)
        return abs(one.key - two.key) if one.segment == two.segment else 1_000_000
