"""Live video out of a GStreamer pipeline: CSI cameras and hardware decoders of a Jetson.

``gst:nvarguscamerasrc ! video/x-raw(memory:NVMM),width=1280 ! nvvidconv``. The pipeline is run by
the system's own ``gst-launch-1.0``, because OpenCV and PyAV from PyPI come without GStreamer.
"""

from __future__ import annotations

import logging
import shlex
import shutil
import subprocess
from collections.abc import Mapping
from contextlib import ExitStack
from typing import IO, Any

from service.cameras import reject_options
from service.cameras.live import OPEN_S, LiveSource
from service.cameras.source import CameraSource, Paced
from service.errors import InputError, OutsideError
from service.redaction import without_credentials
from service.workers import PROCESS, Worker, end_process, open_process

log = logging.getLogger(__name__)

TAIL = (
    "videoconvert ! video/x-raw,format=NV12 ! videoconvert ! video/x-raw,format=I420 "
    "! y4menc ! fdsink fd=1"
)
"""By way of NV12, so that the last step always copies: y4menc writes the padding of a decoder's
buffers into the stream (GStreamer 1.22), which then cannot be read."""


def open_gst(rest: str, options: Mapping[str, str]) -> CameraSource:
    """Output of the GStreamer pipeline ``rest``.

    The pipeline ends in raw video in system memory. Time stamps are those of arrival.
    """
    reject_options("gst", options)
    launcher = shutil.which("gst-launch-1.0")
    if launcher is None:
        raise OutsideError("gst: gst-launch-1.0 is not installed (apt install gstreamer1.0-tools)")
    try:
        command = [launcher, "-q", *shlex.split(rest), "!", *shlex.split(TAIL)]
    except ValueError as error:
        raise InputError(f"gst: the pipeline cannot be read: {error}") from error
    description = without_credentials(f"gst:{rest}")
    return Paced(LiveSource(lambda stall_s: _open_command(command, stall_s), description))


class _Complaints:
    """Standard error of a command: logged, the first complaint kept."""

    def __init__(self, pipe: IO[bytes]) -> None:
        self.first = ""
        self._pipe = pipe
        self._worker = PROCESS.start("gst complaints", self._read)

    def _read(self, _: Worker) -> None:
        with self._pipe:
            while line := self._pipe.readline(1000):
                text = line.decode(errors="replace").strip()
                is_complaint = text.startswith(("ERROR", "WARNING"))
                self.first = self.first or (text if is_complaint else "")
                log.log(logging.WARNING if is_complaint else logging.DEBUG, "gst: %s", text)

    def wait(self) -> str:
        """The first complaint of a command that has ended; empty when it had none."""
        self._worker.join(1.0)
        return self.first


def _open_command(command: list[str], stall_s: float) -> Any:
    """A container with the output of ``command``; closing it ends the command.

    Raises OSError with the command's own complaint when it writes no video.
    """
    import av

    pipe = subprocess.PIPE
    process = open_process("gst", command, stdin=subprocess.DEVNULL, stdout=pipe, stderr=pipe)
    assert process.stdout is not None
    assert process.stderr is not None
    complaints = _Complaints(process.stderr)
    with ExitStack() as on_fault:
        on_fault.callback(_end, process)
        try:
            container = av.open(f"pipe:{process.stdout.fileno()}", timeout=(OPEN_S, stall_s))
        except (av.error.FFmpegError, OSError) as error:
            on_fault.close()
            if complaint := complaints.wait():
                raise OSError(complaint) from error
            raise
        on_fault.pop_all()
    return _CommandContainer(container, process)


class _CommandContainer:
    """An open container together with the process that feeds it."""

    def __init__(self, container: Any, process: subprocess.Popen[bytes]) -> None:
        self._container = container
        self._process = process
        self.streams = container.streams

    def demux(self, stream: Any) -> Any:
        """The packets of ``stream``."""
        return self._container.demux(stream)

    def close(self) -> None:
        """End the process, then the container."""
        _end(self._process)
        self._container.close()


def _end(process: subprocess.Popen[bytes]) -> None:
    end_process(process)
    if process.stdout is not None:
        process.stdout.close()
