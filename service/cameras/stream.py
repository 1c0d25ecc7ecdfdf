"""Live video of the network, of a V4L2 device, or out of a GStreamer pipeline.

``rtsp://…``; ``stream:URL`` for whatever else FFmpeg opens (udp, tcp, srt, http);
``v4l2:/dev/video0?video_size=1280x720&framerate=30&input_format=mjpeg``;
``gst:nvarguscamerasrc ! video/x-raw(memory:NVMM),width=1280 ! nvvidconv``.
"""

from __future__ import annotations

import shlex
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.cameras import reject_options
from service.cameras.live import LiveSource
from service.cameras.pace import paced
from service.cameras.source import CameraSource
from service.errors import InputError, OutsideError

if TYPE_CHECKING:
    import av.container

V4L2_OPTIONS = ("video_size", "framerate", "input_format")
OPEN_S = 10.0
LIVE_OPTIONS = {"fflags": "nobuffer", "flags": "low_delay", "fpsprobesize": "0"}
"""The last: the stream is opened at once, not when its rate is known some twenty pictures later."""

GST_TAIL = "videoconvert ! video/x-raw,format=I420 ! y4menc ! fdsink fd=1"


def open_rtsp(rest: str, options: Mapping[str, str]) -> CameraSource:
    """The RTSP camera at ``rtsp:`` + ``rest``; over TCP where it serves that, else UDP."""
    reject_options("rtsp", options)
    return _live(f"rtsp:{rest}", LIVE_OPTIONS | {"rtsp_flags": "prefer_tcp"})


def open_stream(rest: str, options: Mapping[str, str]) -> CameraSource:
    """The stream at the URL ``rest``, of any protocol that FFmpeg speaks."""
    reject_options("stream", options)
    if "://" not in rest:
        raise InputError(f"stream:{rest} is not like stream:udp://0.0.0.0:5600")
    return _live(rest, LIVE_OPTIONS)


def open_v4l2(rest: str, options: Mapping[str, str]) -> CameraSource:
    """The V4L2 device ``rest``; the kernel's own time stamps are kept."""
    reject_options("v4l2", options, V4L2_OPTIONS)
    device = Path(rest)
    if not device.exists():
        raise OutsideError(f"no such camera device: {device}; is it plugged in? (ls /dev/video*)")
    return _live(str(device), dict(options), "v4l2")


def open_gst(rest: str, options: Mapping[str, str]) -> CameraSource:
    """What the GStreamer pipeline ``rest`` puts out, by the system's ``gst-launch-1.0``.

    The pipeline ends in raw video in system memory; hardware decoders and Argus cameras of a
    Jetson come in this way. Time stamps are those of arrival.
    """
    reject_options("gst", options)
    launcher = shutil.which("gst-launch-1.0")
    if launcher is None:
        raise OutsideError("gst: gst-launch-1.0 is not installed (apt install gstreamer1.0-tools)")
    try:
        command = [launcher, "-q", *shlex.split(rest), "!", *shlex.split(GST_TAIL)]
    except ValueError as error:
        raise InputError(f"gst: the pipeline cannot be read: {error}") from error
    return paced(LiveSource(lambda stall_s: _open_command(command, stall_s), f"gst:{rest}"))


def _live(url: str, demuxer: dict[str, str], format_: str | None = None) -> CameraSource:
    def open_container(stall_s: float) -> av.container.InputContainer:
        import av

        return av.open(url, format=format_, options=demuxer, timeout=(OPEN_S, stall_s))

    return paced(LiveSource(open_container, _without_password(url)))


def _open_command(command: list[str], stall_s: float) -> Any:
    """A container of what ``command`` writes; closing it ends the command."""
    import av

    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE)
    assert process.stdout is not None
    try:
        container = av.open(f"pipe:{process.stdout.fileno()}", timeout=(OPEN_S, stall_s))
    except Exception:
        _end(process)
        raise
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
    process.terminate()
    try:
        process.wait(timeout=2.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    if process.stdout is not None:
        process.stdout.close()


def _without_password(url: str) -> str:
    """``url`` as it may stand in a log."""
    scheme, separator, rest = url.partition("://")
    host, at, _ = rest.partition("@")
    return f"{scheme}://…@{rest[len(host) + 1 :]}" if separator and at else url
