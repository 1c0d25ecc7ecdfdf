"""Scans in flight, aligned with each other and with finished scans of the same ground.

Each keyframe that arrives is compared once with those of the other scans that may show the same
ground, the newest first. After new loops all scans get one similarity each, as in an alignment of
finished scans. Stores are only read: the result is for what is shown.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from recon import se3
from recon.posegraph.records import Loop
from recon.similarity import Similarity
from recon.survey.ground_control import supported
from recon.survey.site_alignment import align, alike
from recon.types import F64, Keyframe
from service.errors import InputError, SkyreliefError
from service.georeference import LocalFrame, between_frames
from service.offline.refine.stored_loops import (
    BREAK_S,
    LOOPS_PER_KEYFRAME,
    LoopEnds,
    likely,
    reach_m,
    verified,
    weighted,
)
from service.offline.site.alignment import MIN_TIES, corners, placing, tie
from service.offline.site.gather import MAX_DISTANCE_M
from service.scans.track import local_frame
from service.stream import codec
from service.stream.store import ScanStore

UNMOVED = Similarity(1.0, np.eye(3), np.zeros(3))
STRIDE = 20_000
"""Between the first keyframes' numbers of two scans; a scan takes part with so many at most."""

MAX_LOOPS = 40
"""The newest between two scans: they show best where receivers have wandered to."""

HELD = 24
"""Decoded keyframes and filled views of a scan in memory."""


@dataclass(frozen=True, slots=True, eq=False)
class PlacedScan:
    """Where a scan is shown."""

    folder: Path
    started_unix_s: float
    T_site_scan: F64  # (4, 4) by the two origins alone
    move: Similarity  # in the site
    sigma_m: F64  # (3,) east, north, up, of its middle
    ties: int
    group: int  # scans that ties join have one number


class FollowedScan:
    """One scan, as far as its store has grown."""

    def __init__(self, folder: Path, number: int, origin: LocalFrame | None, compare: bool) -> None:
        """``number`` is no other scan's; without ``origin`` it is the scan's own.

        Without ``compare`` its keyframes are only what others are compared with. Raises
        InputError for a scan without georeference or too far away.
        """
        self.folder, self.number = folder, number
        self.store = ScanStore.open(folder / "scan.db", read_only=True)
        try:
            self.is_finished = self.store.finished
            self.started_unix_s = self.store.header.started_unix_ns / 1e9
            frame = local_frame(self.store.header)
            if frame is None:
                raise InputError(f"{self.store.path} has no georeference")
            self.origin = origin or frame
            self.T_site_scan = between_frames(self.origin, frame)
            if np.linalg.norm(self.T_site_scan[:3, 3]) > MAX_DISTANCE_M:
                raise InputError(f"{self.store.path} lies too far from the other scans")
        except SkyreliefError:
            self.store.close()
            raise
        self.due: list[int] = []  # places of keyframes yet to be compared, the newest last
        self.move = UNMOVED
        self.poses = np.zeros((0, 4, 4))  # in the site, before alignment
        self._covariances = np.zeros((0, 6, 6))
        self._compare = compare
        self._seqs: list[int] = []
        self._places: dict[int, int] = {}  # of the numbers in the store
        self._stretches: list[int] = []
        self._fine: set[int] = set()  # numbers
        self._last_ns = 0
        self._corrections: tuple[int | None, ...] = ()
        self._keyframe = lru_cache(maxsize=HELD)(lambda seq, _: self.store.keyframe(seq))
        self.ends = LoopEnds(self._at, self._stretches, HELD)

    def key(self, k: int) -> int:
        """The number, among all scans, of its keyframe at place ``k``."""
        return STRIDE * self.number + k

    def refresh(self) -> bool:
        """Take in keyframes and corrections; True when poses were corrected."""
        self.store.follow()
        self.is_finished = self.store.finished
        for seq in self.store.numbers_of("k0"):
            if seq not in self._places and len(self._seqs) < STRIDE:
                self._append(seq)
        for seq in self.store.numbers_of("k1"):
            if seq in self._places and seq not in self._fine:
                self._fine.add(seq)
                self._put_due(self._places[seq])
        numbers = self.store.numbers_of("repose")
        state = len(numbers), next(numbers.newest_first(), None), len(self._seqs)
        if state == self._corrections:
            return False
        self._corrections = state
        return self._correct()

    def _append(self, seq: int) -> None:
        head = codec.peek(self.store.chunk(seq, 0) or b"")
        if head is None:
            return
        is_pause = abs(head.time_unix_ns - self._last_ns) > BREAK_S * 1e9
        self._last_ns = head.time_unix_ns
        self._stretches.append(self._stretches[-1] + is_pause if self._stretches else 0)
        self._places[seq] = len(self._seqs)
        self._seqs.append(seq)
        self._put_due(self._places[seq])
        self.poses = np.concatenate([self.poses, (self.T_site_scan @ head.T_world_camera)[None]])
        self._covariances = np.concatenate([self._covariances, head.covariance[None]])

    def _put_due(self, k: int) -> None:
        if self._compare:
            self.due = [*(j for j in self.due if j != k), k]

    def _correct(self) -> bool:
        changed = False
        for k, seq in enumerate(self._seqs):
            repose = self.store.repose(seq)
            if repose is not None:
                T = self.T_site_scan @ repose.T_world_camera
                changed |= not np.array_equal(T, self.poses[k])
                self.poses[k], self._covariances[k] = T, repose.covariance
        return bool(changed)

    def moved(self) -> F64:
        """(N, 4, 4) poses after the alignment."""
        return self.move.pose(self.poses)

    def covariances(self) -> F64:
        """(N, 6, 6) of its poses, left perturbations in the site."""
        A = se3.adjoint(self.T_site_scan)
        return np.asarray(A @ self._covariances @ A.T)

    def _at(self, k: int) -> Keyframe | None:
        seq = self._seqs[k]
        return self._keyframe(seq, seq in self._fine)  # read again once it is finer


class LiveSite:
    """The scans that are followed. Use it from one thread."""

    def __init__(self) -> None:
        self.scans: dict[Path, FollowedScan] = {}
        self._loops: dict[tuple[int, int], tuple[Loop, F64]] = {}  # with places of b's ground
        self._count = 0
        self._changed = False

    def add(self, folder: Path, compare: bool = True) -> None:
        """Follow the scan in ``folder``; errors and arguments as of :class:`FollowedScan`."""
        origin = next((one.origin for one in self.scans.values()), None)
        self.scans[folder] = FollowedScan(folder, self._count, origin, compare)
        self._count += 1
        self._changed = True

    def remove(self, folder: Path) -> None:
        one = self.scans.pop(folder)
        one.store.close()
        self._loops = {
            ends: loop
            for ends, loop in self._loops.items()
            if all(key // STRIDE != one.number for key in ends)
        }
        self._changed = True

    def refresh(self, folder: Path) -> None:
        self._changed |= self.scans[folder].refresh()

    def compare(self, folder: Path) -> None:
        """Compare the newest keyframe of a scan that is due with those of the other scans."""
        one = self.scans[folder]
        if not one.due:
            return
        k = one.due.pop()
        own = one.ends.at(k)
        if own is None:
            return
        here, near_m = one.moved()[k], reach_m(own)
        for other in self.scans.values():
            poses = other.moved()
            away = np.linalg.norm(poses[:, :2, 3] - here[:2, 3], axis=1)
            near = {int(a): poses[a] for a in np.flatnonzero(away < near_m)}
            if other is not one and near:
                self._compare(one, k, other, near | {STRIDE: here})

    def _compare(
        self, one: FollowedScan, k: int, other: FollowedScan, poses: dict[int, F64]
    ) -> None:
        """Keep the loops of a keyframe, at ``poses[STRIDE]``, with another scan's."""
        end, found = one.ends.end(k), 0
        if end is None:
            return
        for a in likely(end, poses):
            first, second = sorted(((other, a), (one, k)), key=lambda end: end[0].number)
            ends = first[0].key(first[1]), second[0].key(second[1])
            if ends in self._loops or found == LOOPS_PER_KEYFRAME:
                continue
            pair = first[0].ends.end(first[1]), second[0].ends.end(second[1])
            T_a_b = se3.inverse(poses[a]) @ poses[STRIDE]
            guess = T_a_b if second[0] is one else se3.inverse(T_a_b)
            loop, there = verified(*ends, pair, guess), second[0].ends.at(second[1])
            if loop is not None and there is not None:
                self._keep(replace(loop, ratio=1.0), corners(there))
                found += 1

    def _keep(self, loop: Loop, here: F64) -> None:
        """Keep a loop; of one pair of scans only the newest."""
        if not (np.isfinite(loop.covariance).all() and np.isfinite(here).all()):
            return
        between = loop.a // STRIDE, loop.b // STRIDE
        alike = [e for e in self._loops if (e[0] // STRIDE, e[1] // STRIDE) == between]
        for ends in alike[: max(len(alike) - MAX_LOOPS + 1, 0)]:
            del self._loops[ends]
        self._loops[loop.a, loop.b] = loop, here
        self._changed = True

    def place(self) -> list[PlacedScan] | None:
        """Where the scans that have keyframes are shown; None while nothing has changed."""
        if not self._changed:
            return None
        self._changed = False
        scans = [one for one in self.scans.values() if len(one.poses)]
        if not scans:
            return []
        at = {one.number: i for i, one in enumerate(scans)}
        poses = {
            key: scans[at[key // STRIDE]].poses[key % STRIDE]
            for ends in self._loops
            for key in ends
        }
        loops = supported([loop for loop, _ in self._loops.values()], poses)
        pairs = Counter((one.a // STRIDE, one.b // STRIDE) for one in loops)
        loops = [one for one in loops if pairs[one.a // STRIDE, one.b // STRIDE] >= MIN_TIES]
        ties = [
            tie(one, (at[one.a // STRIDE], at[one.b // STRIDE]), poses[one.a], poses[one.b],
                self._loops[one.a, one.b][1])
            for one in weighted(loops)
        ]  # fmt: skip
        centres_m, sigma = placing([(one.poses, one.covariances()) for one in scans])
        found = align(ties, centres_m, alike(sigma))
        sigma = np.sqrt(np.diag(found.covariance)).reshape(-1, 7)[:, 3:6]
        ends = Counter(
            s for t, used in zip(ties, found.used, strict=True) if used for s in (t.a, t.b)
        )
        for one, move in zip(scans, found.moves, strict=True):
            one.move = move
        return [
            PlacedScan(
                one.folder, one.started_unix_s, one.T_site_scan, one.move, sigma[i], ends[i],
                found.groups[i],
            )
            for i, one in enumerate(scans)
        ]  # fmt: skip
