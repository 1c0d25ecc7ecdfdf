"""Poses of all frames as they were published, in little memory over a whole scan."""

from __future__ import annotations

import tempfile
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from recon.tracking.frame import Frame
from service.errors import OutsideError

FRAME = np.dtype(
    [
        ("time_ns", np.int64),  # unix
        ("seq", np.int64),
        ("segment", np.int32),
        ("T_odom_camera", np.float64, (4, 4)),
        ("T_world_camera", np.float64, (4, 4)),  # as written, as all below
        ("sigma_m", np.float64),
        ("agl_m", np.float64),  # NaN: unknown
        ("is_view", np.bool_),
    ]
)
"""A row of the file: one frame."""


class PublishedFrames:
    """Published poses of the frames that refer to a keyframe, in order; on the disk but for the
    newest.

    The file has no name and is gone with the process.
    """

    def __init__(self, folder: Path) -> None:
        self._fresh: deque[tuple[Frame, Any]] = deque()
        self._file = tempfile.TemporaryFile(dir=folder, buffering=1 << 16)  # noqa: SIM115

    def add(self, frame: Frame, row: Any, is_settled: Callable[[Frame], bool]) -> None:
        """Take the next frame's row of :data:`FRAME` but for what the ``frame`` knows; those whose
        keyframes no longer change go to the disk.

        Raises OutsideError when the disk takes no more.
        """
        self._fresh.append((frame, row))
        while self._fresh and is_settled(self._fresh[0][0]):
            try:
                self._file.write(_whole(*self._fresh.popleft()).tobytes())
            except OSError as error:
                why = f"poses cannot be stored for the scan: {error.strerror}"
                raise OutsideError(why) from error

    def rows(self) -> Iterator[Any]:
        """The rows of all frames, in order."""
        self._file.seek(0)
        while row := self._file.read(FRAME.itemsize):
            yield np.frombuffer(row, FRAME)[0]
        yield from (_whole(*one) for one in self._fresh)

    def close(self) -> None:
        """Release the file."""
        self._file.close()


def _whole(frame: Frame, row: Any) -> Any:
    row["seq"], row["segment"], row["T_odom_camera"] = frame.seq, frame.segment, frame.T_odom_camera
    return row
