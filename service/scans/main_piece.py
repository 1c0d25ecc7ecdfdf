"""The part of a scan that its deliverables show, without stretches that are not tied to it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from recon.types import Keyframe
from service.stream.records import PoseRecord
from service.stream.store import ScanStore

Stretch = tuple[int, int]  # first and last keyframe
MIN_PIECE = 3  # keyframes from which on an unconnected stretch has a cloud of its own


@dataclass(frozen=True)
class Piece:
    """Some keyframes of a store, such as a stretch that is not tied to the rest, as a store."""

    whole: ScanStore
    own: list[int]
    summary: dict[str, Any] | None = None
    refinement: dict[str, Any] | None = None

    def seqs(self) -> list[int]:
        return self.own

    def keyframe(self, seq: int) -> Keyframe | None:
        return self.whole.keyframe(seq)


Keyframes = ScanStore | Piece


def stretches_apart(store: Keyframes) -> list[Stretch]:
    """The stretches that are left out: the unconnected ones, and those of false depth."""
    return _unconnected(store) + _false(store)


def _unconnected(store: Keyframes) -> list[Stretch]:
    """By the refinement in force, else by the scan's summary."""
    return _stretches((store.refinement or {}).get("apart", (store.summary or {}).get("apart")))


def _false(store: Keyframes) -> list[Stretch]:
    """Those whose depth no better pose makes true."""
    return _stretches((store.summary or {}).get("false"))


def _stretches(rows: object) -> list[Stretch]:
    if not isinstance(rows, list):
        return []
    pairs = [row for row in rows if isinstance(row, list) and len(row) == 2]
    return [(a, b) for a, b in pairs if isinstance(a, int) and isinstance(b, int)]


def is_apart(seq: int, apart: Iterable[Stretch]) -> bool:
    return any(first <= seq <= last for first, last in apart)


def pieces_apart(store: ScanStore) -> list[Piece]:
    """The unconnected stretches with MIN_PIECE sound keyframes or more; none counts twice."""
    apart, false, own = _unconnected(store), _false(store), dict[int, list[int]]()
    for seq in store.seqs():
        k = next((k for k, (first, last) in enumerate(apart) if first <= seq <= last), None)
        if k is not None and not is_apart(seq, false):
            own.setdefault(k, []).append(seq)
    return [Piece(store, seqs) for seqs in own.values() if len(seqs) >= MIN_PIECE]


def main_seqs(store: Keyframes) -> list[int]:
    apart = stretches_apart(store)
    return [seq for seq in store.seqs() if not is_apart(seq, apart)]


def main_keyframes(store: Keyframes) -> Iterator[Keyframe]:
    for seq in main_seqs(store):
        found = store.keyframe(seq)
        if found is not None:
            yield found


def main_poses(poses: Iterable[PoseRecord], apart: Iterable[Stretch]) -> list[PoseRecord]:
    """The poses, in order of time, whose newest view is not within a stretch."""
    out, left_out = [], False
    for pose in poses:
        if pose.keyframe_seq is not None:
            left_out = is_apart(pose.keyframe_seq, apart)
        if not left_out:
            out.append(pose)
    return out


def main_track(store: ScanStore) -> list[PoseRecord]:
    """The main piece's trajectory in order of time, each pose as last corrected."""
    return main_poses(store.poses(), stretches_apart(store))


def in_words(store: Keyframes) -> str:
    """A note on the pieces that are left out, for the operator; empty where none is."""
    apart = stretches_apart(store)
    if not apart:
        return ""
    count = sum(is_apart(seq, apart) for seq in store.seqs())
    return (
        f"left out: {count} of {len(store.seqs())} keyframes, "
        "which fixes of known height and scale, loops or sound tracking do not tie to the rest"
    )
