"""Poses of frames relative to the odometry's keyframes, in little memory over a whole scan.

A keyframe of the odometry is refined while it is in the window that is adjusted together, and holds
images and corners meanwhile. Afterwards only its pose is needed.
"""

from __future__ import annotations

import struct
import tempfile
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from recon.posegraph.ledger import Ledger, MemoryLedger
from recon.types import F64
from service.errors import OutsideError


class Key(Protocol):
    """A keyframe of the odometry, as far as frames refer to it."""

    @property
    def seq(self) -> int:
        """Number of its frame."""
        ...

    @property
    def segment(self) -> int:
        """Number of the segment."""
        ...

    @property
    def T_odom_camera(self) -> F64:
        """(4, 4) as refined by now."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class SettledKey:
    """The pose of a keyframe that no longer changes."""

    seq: int
    segment: int
    T_odom_camera: F64  # (4, 4)


@dataclass(frozen=True, slots=True, eq=False)
class Anchorage:
    """A frame's pose relative to an odometry keyframe, whose own pose gets better."""

    seq: int
    key: Key
    T_key_camera: F64  # (4, 4)

    @property
    def T_odom_camera(self) -> F64:
        """(4, 4) as known by now."""
        return np.asarray(self.key.T_odom_camera @ self.T_key_camera)

    def settled(self) -> Anchorage:
        """The same with only the keyframe's current pose, moved to the frame."""
        key = SettledKey(self.key.seq, self.key.segment, self.T_odom_camera)
        return Anchorage(self.seq, key, UNMOVED)


UNMOVED = np.eye(4)


VIEW = np.dtype([("seq", np.int64), ("segment", np.int64), ("odom", np.float64, (4, 4))])
"""A row of the ledger of views that no longer change."""


class Carriers:
    """Views on the chain of keyframes, in order; frames of their segment are carried by them."""

    def __init__(self, ledger: Ledger | None = None) -> None:
        """``ledger`` takes rows of :data:`VIEW`, those that no longer change; memory when left
        out."""
        self._settled: Ledger = MemoryLedger(VIEW) if ledger is None else ledger
        self._newest: Anchorage | None = None  # of those settled
        self._fresh: deque[Anchorage] = deque()  # may still be refined

    def add(self, view: Anchorage) -> None:
        """Take the next view."""
        self._fresh.append(view)

    def settle(self, is_settled: Callable[[Key], bool]) -> None:
        """Release the keyframes that no longer change."""
        while self._fresh and is_settled(self._fresh[0].key):
            self._newest = view = self._fresh.popleft().settled()
            row = np.zeros(1, VIEW)
            row["seq"], row["segment"] = view.seq, view.key.segment
            row["odom"] = view.T_odom_camera
            self._settled.append(row)

    def of(self, frame: Anchorage) -> Anchorage | None:
        """The view at or before a frame, or its segment's first; None without any."""
        segment = frame.key.segment
        at = self._before(frame.seq)
        for i in (at, at + 1):
            view = self._view(i)
            if view is not None and view.key.segment == segment:
                return view
        return None

    def _before(self, seq: int) -> int:
        """Place of the last view whose number is ``seq`` or smaller; -1 without any."""
        held = len(self._settled)
        if self._newest is not None and seq < self._newest.seq:
            return bisect_right(_Seqs(self._settled), seq) - 1
        return held - 1 + bisect_right(self._fresh, seq, key=lambda view: view.seq)

    def _view(self, i: int) -> Anchorage | None:
        """The view at a place; None where there is none."""
        held = len(self._settled)
        if i == held - 1:
            return self._newest
        if not 0 <= i < held:
            return self._fresh[i - held] if 0 <= i - held < len(self._fresh) else None
        row = self._settled.read(i, i + 1)[0]
        seq = int(row["seq"])
        key = SettledKey(seq, int(row["segment"]), row["odom"])
        return Anchorage(seq, key, UNMOVED)

    def close(self) -> None:
        """Release the ledger."""
        self._settled.close()


class _Seqs(Sequence[int]):
    """The numbers of a ledger's rows, for a search."""

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger

    def __len__(self) -> int:
        return len(self._ledger)

    def __getitem__(self, i: Any) -> Any:
        return int(self._ledger.read(i, i + 1)["seq"][0])


@dataclass(frozen=True, slots=True, eq=False)
class PublishedFrame:
    """A frame's pose as it was written."""

    time_ns: int
    anchor: Anchorage | None  # None: by telemetry alone, never corrected
    position_m: F64  # (3,)
    sigma_m: float
    agl_m: float | None
    is_view: bool


_ROW = struct.Struct("<qqqi?16d3d2d")


class PublishedFrames:
    """Published poses of every frame, in order; on the disk but for the newest.

    The file has no name and is gone with the process.
    """

    def __init__(self, folder: Path) -> None:
        self._fresh: deque[PublishedFrame] = deque()
        self._file = tempfile.TemporaryFile(dir=folder, buffering=1 << 16)  # noqa: SIM115

    def add(self, frame: PublishedFrame, is_settled: Callable[[Key], bool]) -> None:
        """Take the next frame; those whose keyframes no longer change go to the disk.

        Raises OutsideError when the disk takes no more.
        """
        self._fresh.append(frame)
        while self._fresh:
            anchor = self._fresh[0].anchor
            if anchor is not None and not is_settled(anchor.key):
                return
            first = self._fresh.popleft()
            if anchor is not None:
                self._write(_packed(first, anchor))

    def _write(self, row: bytes) -> None:
        try:
            self._file.write(row)
        except OSError as error:
            raise OutsideError(f"poses cannot be stored for the scan: {error.strerror}") from error

    def corrigible(self) -> Iterator[PublishedFrame]:
        """The frames that refer to a keyframe, in order."""
        self._file.seek(0)
        while row := self._file.read(_ROW.size):
            yield _unpacked(row)
        yield from (frame for frame in self._fresh if frame.anchor is not None)

    def close(self) -> None:
        """Release the file."""
        self._file.close()


def _packed(frame: PublishedFrame, anchor: Anchorage) -> bytes:
    agl = np.nan if frame.agl_m is None else frame.agl_m
    return _ROW.pack(
        frame.time_ns, anchor.seq, anchor.key.seq, anchor.key.segment, frame.is_view,
        *anchor.T_odom_camera.ravel(), *frame.position_m, frame.sigma_m, agl,
    )  # fmt: skip


def _unpacked(row: bytes) -> PublishedFrame:
    time_ns, seq, key_seq, segment, is_view, *rest = _ROW.unpack(row)
    *rest, sigma_m, agl = rest
    numbers = np.array(rest)
    key = SettledKey(key_seq, segment, numbers[:16].reshape(4, 4))
    agl_m, anchor = None if np.isnan(agl) else agl, Anchorage(seq, key, UNMOVED)
    return PublishedFrame(time_ns, anchor, numbers[16:19], sigma_m, agl_m, is_view)
