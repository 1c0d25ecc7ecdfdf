"""A live camera: smooths arrival times, detects stalls and frozen images.

The stream is reopened, with growing pauses, when it ends, fails, stalls or repeats one image.
Images keep one time axis throughout: ns since the source was opened, on the machine's monotonic
clock.

``rtsp://…``; ``stream:URL`` for anything else that FFmpeg opens (udp, tcp, http);
``rtmp-listen:1935/live`` waits for a controller or OBS to send RTMP, ``srt://:9000`` for SRT;
``v4l2:/dev/video0?video_size=1280x720&framerate=30&input_format=mjpeg``;
``gst:nvarguscamerasrc ! video/x-raw(memory:NVMM),width=1280 ! nvvidconv`` for CSI cameras and
hardware decoders of a Jetson. The system's own ``gst-launch-1.0`` runs that pipeline, because
OpenCV and PyAV from PyPI come without GStreamer.
"""

from __future__ import annotations

import itertools
import logging
import os
import re
import select
import shlex
import shutil
import signal
import subprocess
import time
import zlib
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

import numpy as np

from recon.types import U8
from service.cameras import open_container, reject_options
from service.cameras.access_units import LARGEST_BYTES, access_units
from service.cameras.lens import same_shape
from service.cameras.source import (
    CameraFrame,
    CameraSource,
    QueuedSource,
    decoded_frames,
    frame_bgr,
    video_stream,
)
from service.errors import InputError, NoSenderError, OutsideError
from service.redaction import without_credentials
from service.workers import PROCESS, Worker, end_process, open_process

if TYPE_CHECKING:
    import av
    import av.container

log = logging.getLogger(__name__)

V4L2_OPTIONS = ("video_size", "framerate", "input_format")

LIVE_OPTIONS = {"fflags": "nobuffer", "flags": "low_delay", "fpsprobesize": "0"}
"""The last one: open the stream at once, without waiting some twenty images for its rate."""

UNPARSED = {"fflags": "noparse", "max_packet_size": str(LARGEST_BYTES)}
"""Images are not held back until the next one begins: :mod:`service.cameras.access_units`."""

TS_OPTIONS = LIVE_OPTIONS | UNPARSED | {"fflags": "nobuffer+noparse"}

NO_PARSE = 32  # of a container's flags

LISTEN_OPTIONS = {
    "listen": "1",
    "flags": "low_delay",
    "fpsprobesize": "0",
    "analyzeduration": "300000",
}
"""FLV may announce a sound track that never comes: it is waited for this many us, not for 5 s.
The images of that time are kept: the next one to start from is seconds away."""


@dataclass(frozen=True, slots=True)
class LiveConfig:
    open_s: float = 10.0  # no stream for this long: it cannot be opened
    stall_s: float = 3.0  # no image for this long: reopen
    frozen_s: float = 8.0  # the same image for this long: reopen
    changed_s: float = 1.0  # images of another shape for this long: no fault of the stream
    steady_s: float = 60.0  # a shape that stays for less makes the next change take twice as long,
    longest_changed_s: float = 16.0  # or at most so long: a stream that flips is not many scans
    first_retry_s: float = 0.25
    longest_retry_s: float = 5.0


DEFAULT = LiveConfig()


class StampFilter:
    """Arrival times without jitter: presentation time plus the recent minimum of the delay.

    Queues and decoders only delay images, so the lower envelope of arrival minus presentation
    time is the best estimate of the clocks' offset. It may rise by 200 ppm, more than two
    crystals drift apart. A new connection first delivers its backlog, faster than it was
    recorded: those images are older than their arrival suggests.
    """

    RISE = 200e-6
    BACKLOG = 0.25  # share of the step in presentation time: catching up if the offset falls faster

    def __init__(self) -> None:
        self._offset_ns: float | None = None
        self._last_pts_ns = 0

    @property
    def is_set(self) -> bool:
        """True once an image had a presentation time."""
        return self._offset_ns is not None

    def time_ns(self, pts_ns: int, arrival_ns: int) -> int | None:
        """The image's time, on the clock of its arrival; None while catching up."""
        step_ns = pts_ns - self._last_pts_ns
        self._last_pts_ns = pts_ns
        delay_ns = float(arrival_ns - pts_ns)
        if self._offset_ns is None or not 0 <= step_ns < 10_000_000_000:
            self._offset_ns = delay_ns  # first image, or a new time axis
            return None
        fall_ns = self._offset_ns - delay_ns
        self._offset_ns = min(self._offset_ns + self.RISE * step_ns, delay_ns)
        return None if fall_ns > self.BACKLOG * step_ns else pts_ns + round(self._offset_ns)


class LiveSource(CameraSource):
    """Images of a stream that is reopened whenever it is lost; ends where their shape changes."""

    is_live = True

    def __init__(
        self,
        open_container: Callable[[float], av.container.InputContainer],
        description: str,
        config: LiveConfig = DEFAULT,
        listens: bool = False,
    ) -> None:
        """Open the stream by ``open_container(stall_s)`` and decode its first image.

        Raises OutsideError when the camera gives none now, NoSenderError when nothing has come
        where it ``listens``; the constructor does not retry.
        """
        super().__init__(description)
        self.config = config
        self.losses = 0
        self.misfits = 0  # images of another aspect ratio, dropped
        self.epoch_unix_ns = time.time_ns()
        self.start_monotonic_ns = self._start_ns = time.monotonic_ns()
        self._open_container = open_container
        self._closed = Event()
        self._iterated = False
        self._next: tuple[U8, int] | None = None  # the first one that is of another shape to stay
        self._changed_s = self.config.changed_s  # before the next one ends it
        self._is_silent = False  # at the last attempt
        self._images = self._connect()
        first = next(self._images, None)
        if first is None and listens and self._is_silent:
            raise NoSenderError(
                f"{description}: waits for a sender; none came in {self.config.open_s:g} s"
            )
        if first is None:
            why = f" ({self.warnings[-1]})" if self.warnings else ""
            raise OutsideError(
                f"{description}: gives no image; is the camera on and streaming?{why}"
            )
        self.size_px = self._given_px = (first[0].shape[1], first[0].shape[0])
        self._first = first

    def __iter__(self) -> Iterator[CameraFrame]:
        """Yield images until :meth:`close` or another shape; then, or when dropped, release the
        stream, unless another source follows."""
        self._iterated = True
        try:
            yield from self._frames()
        finally:
            if self._next is None:
                self._images.close()
            else:
                self._iterated = False

    def following(self) -> CameraSource | None:
        if self._next is None or self._closed.is_set():
            return None
        image, time_ns = self._next
        self._first, self._next = (image, 0), None
        is_steady = time_ns >= 1e9 * self.config.steady_s
        longer_s = min(2.0 * self._changed_s, self.config.longest_changed_s)
        self._changed_s = self.config.changed_s if is_steady else longer_s
        self._start_ns += time_ns
        self.start_monotonic_ns, self.epoch_unix_ns = self._start_ns, time.time_ns()
        self.size_px = self._given_px
        self.warnings, self.is_reshaped = [], True
        return self

    def close(self) -> None:
        """End the iteration at the next image; a wait for a lost camera ends at once."""
        self._closed.set()
        if not self._iterated:
            self._images.close()

    def _frames(self) -> Iterator[CameraFrame]:
        seq = 0
        last_ns = -1
        odd_ns, odd_px = 0, self.size_px  # since when the images are of another shape
        for image, time_ns in itertools.chain((self._first,), self._endless()):
            fitting = self._fitted(image)
            if fitting is None:
                if odd_px != self._given_px:
                    odd_ns, odd_px = time_ns, self._given_px
                if time_ns - odd_ns >= 1e9 * self._changed_s:
                    self._next = image, time_ns
                    return
                continue
            odd_px = self.size_px
            if time_ns > last_ns:
                yield CameraFrame(fitting, time_ns, seq, None, f"frame {seq}")
                seq += 1
                last_ns = time_ns

    def _endless(self) -> Iterator[tuple[U8, int]]:
        """Every (image, time) of every connection; the time between two attempts grows while they
        fail. One that has waited for a sender for longer is followed by the next at once."""
        retry_s = self.config.first_retry_s
        began_s = time.monotonic()
        while not self._closed.is_set():
            for found in self._images:
                retry_s = self.config.first_retry_s
                yield found
                if self._closed.is_set():
                    return
            if self._closed.is_set():
                return
            self.losses += 1
            self._closed.wait(max(0.0, began_s + retry_s - time.monotonic()))
            retry_s = min(2.0 * retry_s, self.config.longest_retry_s)
            began_s = time.monotonic()
            self._images = self._connect()

    def _connect(self) -> Generator[tuple[U8, int], None, None]:
        """The (image, time) of one connection; ends, with a log message, when it is lost."""
        import av.error

        try:
            container = self._open_container(self.config.stall_s)
        except (av.error.FFmpegError, OSError, ValueError) as error:
            self._is_silent = isinstance(error, (av.error.ExitError, TimeoutError))
            silent = f"no stream for {self.config.open_s:g} s"
            self._warn(silent if self._is_silent else f"cannot be opened: {error}")
            return
        try:
            stream = video_stream(container, is_live=True)
            if stream is None:
                self._warn("contains no video stream that can be decoded")
                return
            rate = stream.average_rate  # nominal, not measured
            self.fps = float(rate) if rate else None
            log.info("%s: connected", self.description)
            packets = container.demux(stream)
            if container.flags & NO_PARSE:
                packets = access_units(packets, stream)
            yield from self.stamped(decoded_frames(packets, stream, self._warn, self._damage))
        finally:
            container.close()

    def stamped(self, frames: Iterator[av.VideoFrame]) -> Iterator[tuple[U8, int]]:
        """The (image, time) of decoded frames; ends when one image is repeated for too long."""
        stamps = StampFilter()
        print_of_last, changed_ns = 0, time.monotonic_ns()
        for frame in frames:
            if self._closed.is_set():
                return
            arrival_ns = time.monotonic_ns()
            image = frame_bgr(frame)
            fingerprint = zlib.crc32(image[::16, ::16].tobytes())
            if fingerprint != print_of_last:
                print_of_last, changed_ns = fingerprint, arrival_ns
            elif arrival_ns - changed_ns > self.config.frozen_s * 1e9:
                self._warn(f"the image is frozen for {self.config.frozen_s:g} s")
                return
            time_ns: int | None = arrival_ns
            if frame.pts is not None and frame.time_base is not None:
                pts_ns = round(frame.pts * frame.time_base * 1_000_000_000)
                time_ns = stamps.time_ns(pts_ns, arrival_ns)
            elif stamps.is_set:  # left in the decoder from before the interruption
                time_ns = None
            if time_ns is not None:
                yield image, time_ns - self._start_ns

    def _damage(self, error: Exception) -> None:
        log.debug("%s: packet dropped: %s", self.description, error)

    def _fitted(self, image: U8) -> U8 | None:
        """The image at the first one's size; None for one of another aspect ratio."""
        import cv2

        size_px = image.shape[1], image.shape[0]
        was_px, self._given_px = self._given_px, size_px
        if size_px == self.size_px:
            return image
        is_alike = same_shape(size_px, self.size_px)
        if size_px != was_px:
            self._warn(
                f"now gives {size_px[0]}x{size_px[1]} images instead of "
                f"{self.size_px[0]}x{self.size_px[1]}; they are "
                + ("scaled" if is_alike else "dropped, and end this scan if they stay")
            )
        if not is_alike:
            self.misfits += 1
            return None
        return np.asarray(cv2.resize(image, self.size_px, interpolation=cv2.INTER_AREA), np.uint8)

    def _warn(self, text: str) -> None:
        text = without_credentials(text)  # FFmpeg's errors contain the address
        if not self._closed.is_set():
            if text not in self.warnings:
                self.warnings.append(text)
            log.warning("%s: %s", self.description, text)


def open_rtsp(rest: str, options: Mapping[str, str]) -> CameraSource:
    """The RTSP camera at ``rtsp:`` + ``rest``; over TCP if it supports that, otherwise UDP."""
    reject_options("rtsp", options)
    return _live(f"rtsp:{rest}", LIVE_OPTIONS | {"rtsp_flags": "prefer_tcp"})


def open_stream(rest: str, options: Mapping[str, str]) -> CameraSource:
    """The stream at the URL ``rest``, of any protocol that FFmpeg supports."""
    reject_options("stream", options)
    if "://" not in rest:
        raise InputError(f"stream:{rest} is not like stream:udp://0.0.0.0:5600")
    return _live(rest, TS_OPTIONS if rest.startswith("udp:") else LIVE_OPTIONS)


def open_rtmp_listen(
    rest: str, options: Mapping[str, str], config: LiveConfig = DEFAULT
) -> CameraSource:
    """What is sent to this machine by RTMP, to ``rest``: ``[HOST:]PORT[/NAME]``."""
    reject_options("rtmp-listen", options)
    place = re.fullmatch(r"(?:([^/\s:]+):)?(\d{1,5})(?:/(\S*))?", rest)
    if place is None or not 0 < int(place[2]) < 65536:
        raise InputError(f"rtmp-listen:{rest} is not like rtmp-listen:1935/live")
    # The wait for a sender has a limit of its own: a sender that comes late in it is heard out.
    waits = LISTEN_OPTIONS | {"timeout": f"{config.open_s:.0f}"}
    url = f"rtmp://{place[1] or '0.0.0.0'}:{place[2]}/{place[3] or ''}"
    return _live(url, waits, listens=True, config=config)


def open_srt(rest: str, options: Mapping[str, str], config: LiveConfig = DEFAULT) -> CameraSource:
    """MPEG-TS by SRT: without a host it is waited for, ``srt://:9000``, else fetched. GStreamer
    receives it: PyAV from PyPI comes without SRT."""
    reject_options("srt", options)
    place = re.fullmatch(r"//([^/\s:?@]*|\[[0-9a-fA-F:]+\]):(\d{1,5})(\?\S*)?", rest)
    if place is None or not 0 < int(place[2]) < 65536:
        raise InputError(f"srt:{rest} is not like srt://:9000")
    # Without a limit of its wait for data, in ms, the element does not end when it is asked to, and
    # a sender learns only by its own timeout of 5 s that its peer is gone.
    limit = "poll-timeout=100"
    source = ["srtsrc", f"uri=srt:{rest}", limit, *([] if place[1] else ["mode=listener"])]
    description = without_credentials(f"srt:{rest}")
    pipeline = [*source, "!", "fdsink", "fd=1"]
    demuxer, listens = LISTEN_OPTIONS | UNPARSED, not place[1]
    return _launched(pipeline, description, demuxer, listens, config)


def open_v4l2(rest: str, options: Mapping[str, str]) -> CameraSource:
    """The V4L2 device ``rest``; uses the kernel's time stamps."""
    reject_options("v4l2", options, V4L2_OPTIONS)
    device = Path(rest)
    if not device.exists():
        raise OutsideError(f"no such camera device: {device}; is it plugged in? (ls /dev/video*)")
    return _live(str(device), dict(options), "v4l2")


def _live(
    url: str,
    demuxer: dict[str, str],
    format_: str | None = None,
    listens: bool = False,
    config: LiveConfig = DEFAULT,
) -> CameraSource:
    def opened(stall_s: float) -> av.container.InputContainer:
        timeout = (2.0 * config.open_s if listens else config.open_s, stall_s)
        made: av.container.InputContainer = open_container(
            url, format=format_, options=demuxer, timeout=timeout
        )
        return made

    return QueuedSource(LiveSource(opened, without_credentials(url), config, listens))


TAIL = (
    "videoconvert ! video/x-raw,format=NV12 ! videoconvert ! video/x-raw,format=I420 "
    "! y4menc ! fdsink fd=1"
)
"""By way of NV12, so that the last step always copies: y4menc writes the padding of a decoder's
buffers into the stream (GStreamer 1.22), which then cannot be read."""


def open_gst(rest: str, options: Mapping[str, str]) -> CameraSource:
    """Output of the GStreamer pipeline ``rest``. The pipeline ends in raw video in system memory.
    Time stamps are those of arrival."""
    reject_options("gst", options)
    try:
        elements = [*shlex.split(rest), "!", *shlex.split(TAIL)]
    except ValueError as error:
        raise InputError(f"gst: the pipeline cannot be read: {error}") from error
    return _launched(elements, without_credentials(f"gst:{rest}"), {})


def _launched(
    elements: list[str],
    description: str,
    demuxer: dict[str, str],
    listens: bool = False,
    config: LiveConfig = DEFAULT,
) -> CameraSource:
    """Output of a GStreamer pipeline that writes a container to its standard output."""
    launcher = shutil.which("gst-launch-1.0")
    if launcher is None:
        raise OutsideError(
            f"{description}: gst-launch-1.0 is not installed (apt install gstreamer1.0-tools "
            "gstreamer1.0-plugins-bad)"
        )
    command = [launcher, "-q", *elements]

    def opened(stall_s: float) -> Any:
        return open_command(command, stall_s, demuxer, config.open_s)

    return QueuedSource(LiveSource(opened, description, config, listens))


OUTPUT_BYTES = 1 << 18  # read at once from a command: raw video is 40 MB/s


class _Command:
    """A command: its output as a file, its standard error in the log. FFmpeg's own pipe waits for a
    silent command for ever."""

    def __init__(self, command: list[str], wait_s: float) -> None:
        pipe = subprocess.PIPE
        process = open_process("gst", command, stdin=subprocess.DEVNULL, stdout=pipe, stderr=pipe)
        assert process.stdout is not None
        assert process.stderr is not None
        self.wait_s = wait_s
        self.complaint = ""  # the first one
        self._process, self._output, self._errors = process, process.stdout, process.stderr
        self._poll = select.poll()
        self._poll.register(self._output, select.POLLIN)
        self._reader = PROCESS.start("gst complaints", self._read_errors)

    def read(self, size: int) -> bytes:
        """The next bytes, empty at the end; TimeoutError after ``wait_s`` without any."""
        if not self._poll.poll(1e3 * self.wait_s):
            raise TimeoutError(f"no data for {self.wait_s:g} s")
        return os.read(self._output.fileno(), size)

    def _read_errors(self, _: Worker) -> None:
        with self._errors:
            while line := self._errors.readline(1000):
                text = line.decode(errors="replace").strip()
                is_complaint = text.startswith(("ERROR", "WARNING"))
                self.complaint = self.complaint or (text if is_complaint else "")
                log.log(logging.WARNING if is_complaint else logging.DEBUG, "gst: %s", text)

    def end(self) -> None:
        """End the command, and read what it still says."""
        end_process(self._process, asks=signal.SIGINT)  # at which a pipeline closes its sockets
        self._output.close()
        self._reader.join(1.0)


def open_command(
    command: list[str], stall_s: float, demuxer: dict[str, str], open_s: float = DEFAULT.open_s
) -> Any:
    """A container with the output of ``command``; closing it ends the command. Raises OSError with
    the command's own complaint when it writes no video."""
    import av

    running = _Command(command, open_s)
    try:
        container = av.open(running, options=demuxer, buffer_size=OUTPUT_BYTES)
    except BaseException as error:
        running.end()
        if isinstance(error, (av.error.FFmpegError, OSError)) and running.complaint:
            raise OSError(running.complaint) from error
        raise
    running.wait_s = stall_s
    return _CommandContainer(container, running)


class _CommandContainer:
    """An open container together with the command that feeds it."""

    def __init__(self, container: Any, command: _Command) -> None:
        self._container, self._command = container, command
        self.streams, self.flags, self.demux = container.streams, container.flags, container.demux

    def close(self) -> None:
        self._command.end()
        self._container.close()
