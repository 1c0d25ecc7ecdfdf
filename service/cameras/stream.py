"""Live video of the network, or of a V4L2 device.

``rtsp://…``; ``stream:URL`` for whatever else FFmpeg opens (udp, tcp, srt, http);
``v4l2:/dev/video0?video_size=1280x720&framerate=30&input_format=mjpeg``. GStreamer's pipelines
are in :mod:`service.cameras.gstreamer`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from service.cameras import reject_options
from service.cameras.live import LiveSource
from service.cameras.pace import paced
from service.cameras.source import CameraSource
from service.errors import InputError, OutsideError
from service.redaction import without_credentials

if TYPE_CHECKING:
    import av.container

V4L2_OPTIONS = ("video_size", "framerate", "input_format")
OPEN_S = 10.0
LIVE_OPTIONS = {"fflags": "nobuffer", "flags": "low_delay", "fpsprobesize": "0"}
"""The last: the stream is opened at once, not when its rate is known some twenty pictures later."""


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


def _live(url: str, demuxer: dict[str, str], format_: str | None = None) -> CameraSource:
    def open_container(stall_s: float) -> av.container.InputContainer:
        import av

        timeout = (OPEN_S, stall_s)
        return av.open(
            url, format=format_, options=demuxer, timeout=timeout, metadata_errors="replace"
        )

    return paced(LiveSource(open_container, without_credentials(url)))
