"""Poses of all frames as they were published, in little memory over a whole scan."""

from __future__ import annotations

import struct
import tempfile
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from recon.tracking.frame import RelativePose
from recon.types import F64
from service.errors import OutsideError


@dataclass(frozen=True, slots=True, eq=False)
class PublishedFrame:
    """A frame's pose as it was written."""

    time_ns: int
    reference: RelativePose | None  # None: by telemetry alone, never corrected
    T_world_camera: F64  # (4, 4)
    sigma_m: float
    agl_m: float | None
    is_view: bool


_ROW = struct.Struct("<qqi?16d16d2d")


class PublishedFrames:
    """Published poses of every frame, in order; on the disk but for the newest.

    The file has no name and is gone with the process.
    """

    def __init__(self, folder: Path) -> None:
        self._fresh: deque[PublishedFrame] = deque()
        self._file = tempfile.TemporaryFile(dir=folder, buffering=1 << 16)  # noqa: SIM115

    def add(self, frame: PublishedFrame, is_settled: Callable[[RelativePose], bool]) -> None:
        """Take the next frame; those whose keyframes no longer change go to the disk.

        Raises OutsideError when the disk takes no more.
        """
        self._fresh.append(frame)
        while self._fresh:
            reference = self._fresh[0].reference
            if reference is not None and not is_settled(reference):
                return
            first = self._fresh.popleft()
            if reference is not None:
                self._write(_packed(first, reference))

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
        yield from (frame for frame in self._fresh if frame.reference is not None)

    def close(self) -> None:
        """Release the file."""
        self._file.close()


def _packed(frame: PublishedFrame, reference: RelativePose) -> bytes:
    agl = np.nan if frame.agl_m is None else frame.agl_m
    return _ROW.pack(
        frame.time_ns, reference.seq, reference.segment, frame.is_view,
        *reference.T_odom_camera.ravel(), *frame.T_world_camera.ravel(), frame.sigma_m, agl,
    )  # fmt: skip


def _unpacked(row: bytes) -> PublishedFrame:
    time_ns, seq, segment, is_view, *rest = _ROW.unpack(row)
    *rest, sigma_m, agl = rest
    numbers = np.array(rest)
    agl_m = None if np.isnan(agl) else agl
    T_odom_camera, T_world_camera = numbers.reshape(2, 4, 4)
    reference = RelativePose(seq, segment, T_odom_camera)
    return PublishedFrame(time_ns, reference, T_world_camera, sigma_m, agl_m, is_view)
