"""Poses of frames relative to the odometry's keyframes, in little memory over a whole scan.

A keyframe of the odometry is refined while it is in the window that is adjusted together, and holds
images and corners meanwhile. Afterwards only its pose is needed.
"""

from __future__ import annotations

import struct
import tempfile
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from recon.tracking.keyframe_window import OdometryKeyframe
from recon.types import F64
from service.errors import OutsideError


@dataclass(frozen=True, slots=True, eq=False)
class SettledKey:
    """The pose of a keyframe that no longer changes."""

    seq: int
    segment: int
    T_odom_camera: F64  # (4, 4)


Key = OdometryKeyframe | SettledKey
"""A keyframe of the odometry, as far as frames refer to it; the first is still refined."""


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


class Carriers:
    """Views on the chain of keyframes, in order; frames of their segment are carried by them."""

    def __init__(self) -> None:
        self._views: list[Anchorage] = []
        self._settled = 0  # the first so many no longer change

    def add(self, view: Anchorage) -> None:
        """Take the next view."""
        self._views.append(view)

    def settle(self, is_settled: Callable[[Key], bool]) -> None:
        """Release the keyframes that no longer change."""
        for i in range(self._settled, len(self._views)):
            if not is_settled(self._views[i].key):
                return
            self._views[i] = self._views[i].settled()
            self._settled += 1

    def of(self, frame: Anchorage) -> Anchorage | None:
        """The view at or before a frame, or its segment's first; None without any."""
        after = bisect_right(self._views, frame.seq, key=lambda view: view.seq)
        for view in self._views[max(after - 1, 0) : after + 1]:
            if view.key.segment == frame.key.segment:
                return view
        return None


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
