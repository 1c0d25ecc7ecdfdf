"""Encoded video through PyAV, with the container's own presentation times.

Shared by the sources whose pictures come out of a container or a stream: a file, a pipe.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Iterator
from datetime import datetime, timezone
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np

from recon.types import U8
from service.cameras.source import CameraFrame
from service.errors import InputError

if TYPE_CHECKING:
    import av
    import av.container

log = logging.getLogger(__name__)

MAX_PIXELS = 1 << 27
"""Of a picture; the decoder refuses larger ones before it makes room for them."""

EARLIEST_UNIX_S = 946_684_800  # 2000-01-01: cameras without a clock write 1904 or 1970


class VideoSource:
    """The pictures of one open PyAV container; its first picture is decoded on construction."""

    def __init__(
        self,
        container: av.container.InputContainer,
        description: str,
        follows_turn: bool = False,
    ) -> None:
        """Take over ``container``; raises InputError when it shows no image.

        ``follows_turn`` turns the images as the container asks players to.
        """
        self.description = description
        self.turned_deg = 0
        self.is_live = False
        self.start_monotonic_ns: int | None = None
        self.warnings: list[str] = []
        self._container = container
        self._damaged = 0
        self._unordered = 0
        self._open = True
        if not container.streams.video:
            self.close()
            raise InputError(f"{description}: holds no video stream; give a video of the flight")
        stream = video_stream(container)
        if stream is None:
            self.close()
            raise InputError(f"{description}: its video has a format that cannot be decoded")
        self._stream = stream
        self._expected = self._stream.frames
        self._decoded = decoded_pictures(container, self._stream, self._warn, self._damage)
        self._first = next(self._decoded, None)
        if self._first is None:
            self.close()
            raise InputError(f"{description}: no picture could be decoded; is it cut off or empty?")
        stored = int(self._first.width), int(self._first.height)
        self._stored_px = stored
        if follows_turn:  # counterclockwise there
            self.turned_deg = round(-getattr(self._first, "rotation", 0) / 90) * 90 % 360
        self.size_px = stored[::-1] if self.turned_deg % 180 else stored
        self._start_s = _start_s(self._stream, self._first)
        self.epoch_unix_ns = creation_unix_ns(container, self._stream)
        rate = self._stream.average_rate or self._stream.guessed_rate
        self.fps = float(rate) if rate else None

    def __iter__(self) -> Iterator[CameraFrame]:
        """Yield the pictures whose time goes forward; says at the end what was left out."""
        first, self._first = self._first, None
        if first is None:
            return
        last_ns = -1
        seq = 0
        decoded = 0
        for picture in itertools.chain((first,), self._decoded):
            decoded += 1
            time_ns = self._time_ns(picture, last_ns)
            if time_ns <= last_ns:
                self._unordered += 1
                continue
            size_px = (int(picture.width), int(picture.height))
            if size_px != self._stored_px:
                self._warn(
                    f"picture size changed from {_by(self._stored_px)} to {_by(size_px)} at "
                    f"{time_ns / 1e9:.2f} s; what follows is left out"
                )
                break
            image = np.rot90(picture_bgr(picture), -(self.turned_deg // 90))
            yield CameraFrame(np.ascontiguousarray(image), time_ns, seq, None, f"frame {seq}")
            last_ns = time_ns
            seq += 1
        else:
            self._tell_losses(decoded)
        self.close()

    def close(self) -> None:
        """Close the container."""
        if self._open:
            self._open = False
            self._container.close()

    def _damage(self, error: Exception) -> None:
        self._damaged += 1
        log.debug("%s: picture dropped: %s", self.description, error)

    def _time_ns(self, picture: av.VideoFrame, last_ns: int) -> int:
        """Presentation time; a picture without one follows the last by the mean interval."""
        if picture.pts is None or picture.time_base is None:
            step = 1e9 / self.fps if self.fps else 1e9 / 30.0
            return last_ns + int(step) if last_ns >= 0 else 0
        # Whole ticks first: floats of seconds lose nanoseconds after minutes.
        return round((picture.pts * picture.time_base - self._start_s) * 1_000_000_000)

    def _tell_losses(self, decoded: int) -> None:
        if self._damaged:
            self._warn(f"{self._damaged} damaged pictures were left out")
        if self._unordered:
            self._warn(f"{self._unordered} pictures whose time does not go forward were left out")
        if self._expected > decoded:
            self._warn(
                f"{decoded} of the {self._expected} pictures that the index names could be "
                "decoded; the recording is cut off or damaged"
            )

    def _warn(self, text: str) -> None:
        self.warnings.append(text)
        log.warning("%s: %s", self.description, text)


def video_stream(container: av.container.InputContainer) -> av.VideoStream | None:
    """The first video stream, ready to decode; None when there is none that can be decoded."""
    stream = container.streams.video[0] if container.streams.video else None
    if stream is None or stream.codec_context is None:
        return None
    stream.codec_context.options = {"max_pixels": str(MAX_PIXELS)}
    stream.thread_type = "AUTO"
    return stream


def decoded_pictures(
    container: av.container.InputContainer,
    stream: av.VideoStream,
    broke_off: Callable[[str], None],
    damaged: Callable[[Exception], None],
) -> Iterator[av.VideoFrame]:
    """Every whole picture of ``stream``, packet by packet: a damaged one costs itself only.

    ``broke_off`` is told when the container ends with an error, ``damaged`` of each picture
    that does not decode or that the decoder pieced together from others.
    """
    import av.error

    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets, None)
        except (av.error.FFmpegError, OSError) as error:
            broke_off(f"the recording breaks off: {error}")
            packet = None
        try:
            pictures = stream.codec_context.decode(None) if packet is None else packet.decode()
        except av.error.EOFError:
            pictures = []  # the decoder was emptied before
        except av.error.FFmpegError as error:
            damaged(error)
            pictures = []
        for picture in pictures:
            if picture.is_corrupt:
                damaged(ValueError("concealed by the decoder"))
            else:
                yield picture
        if packet is None:
            return


def creation_unix_ns(container: Any, stream: Any) -> int | None:
    """UTC of the start from the container's (else the stream's) creation time; None without."""
    for metadata in (container.metadata, stream.metadata):
        for key in ("creation_time", "com.apple.quicktime.creationdate", "CREATION_TIME"):
            unix_ns = parse_time_unix_ns(metadata.get(key, ""))
            if unix_ns is not None:
                return unix_ns
    return None


def parse_time_unix_ns(text: str) -> int | None:
    """Unix ns of an ISO 8601 time, UTC when it names no zone; None when unusable."""
    try:
        moment = datetime.fromisoformat(text.strip().replace("Z", "+00:00"))
    except ValueError:
        return None
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=timezone.utc)
    since = moment - datetime(1970, 1, 1, tzinfo=timezone.utc)
    unix_us = (since.days * 86_400 + since.seconds) * 1_000_000 + since.microseconds
    return unix_us * 1000 if unix_us >= EARLIEST_UNIX_S * 1_000_000 else None


def _start_s(stream: av.VideoStream, first: av.VideoFrame) -> Fraction:
    """Presentation time of the stream's start as an exact fraction of seconds.

    The first picture that decodes may come later than the start (a stream joined midway).
    """
    if stream.start_time is not None and stream.time_base is not None:
        start = stream.start_time * stream.time_base
        if first.pts is None or first.time_base is None or start <= first.pts * first.time_base:
            return start
    if first.pts is not None and first.time_base is not None:
        return first.pts * first.time_base
    return Fraction(0)


def picture_bgr(picture: av.VideoFrame) -> U8:
    """(H, W, 3) BGR of a decoded picture."""
    return np.ascontiguousarray(picture.to_ndarray(format="bgr24"), dtype=np.uint8)


def _by(size_px: tuple[int, int]) -> str:
    return f"{size_px[0]}x{size_px[1]}"
