"""The interface of all cameras: images with a time and their tags; how a stream becomes images, and
readers that fetch them on a separate thread."""

from __future__ import annotations

import logging
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass
from threading import Event, Lock
from typing import TYPE_CHECKING, Any

import numpy as np

from recon.types import U8
from service.background import Channel
from service.workers import PROCESS, Worker

if TYPE_CHECKING:
    import av
    import av.container

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class GeoTag:
    """Place and attitude of an image, as written by the camera (EXIF, XMP)."""

    lat_deg: float | None  # None like lon_deg: the camera had no fix
    lon_deg: float | None
    alt_amsl_m: float | None = None  # as written; consumer cameras drift by tens of metres
    sigma_h_m: float = 5.0  # 1 sigma, horizontal; the default for tags without accuracy
    sigma_v_m: float | None = None  # of the altitude; None: not stated
    is_sigma_h_stated: bool = False
    datum: str = ""  # of the altitude where it is stated, as for service.georeference.vertical_code
    is_pressure_altitude: bool = False  # it is that of air pressure in standard weather
    ypr_deg: tuple[float, float, float] | None = None
    """Yaw from true north, pitch, roll of the gimbal head (FRD in NED); pitch -90 looks down."""
    is_yaw_known: bool = True  # False: the aircraft's own headings contradict it
    relative_alt_m: float | None = None  # above the take-off point


@dataclass(frozen=True, slots=True)
class Decoded:
    """An image as the decoder gave it, in BGR once that is asked for."""

    frame: av.VideoFrame
    turned_deg: int  # clockwise

    @property
    def shape(self) -> tuple[int, int, int]:
        """(H, W, 3) as turned."""
        stored = int(self.frame.width), int(self.frame.height)
        W, H = stored[::-1] if self.turned_deg % 180 else stored
        return H, W, 3

    def __call__(self) -> U8:
        """(H, W, 3) BGR."""
        return np.ascontiguousarray(np.rot90(frame_bgr(self.frame), -(self.turned_deg // 90)))


def frame_bgr(frame: av.VideoFrame) -> U8:
    """(H, W, 3) BGR of a decoded image."""
    from av.video.reformatter import VideoReformatter

    # Without a number of threads each image would start as many as there are cores.
    frame = VideoReformatter().reformat(frame, format="bgr24", threads=1)
    return np.ascontiguousarray(frame.to_ndarray(), dtype=np.uint8)


MAX_PIXELS = 1 << 27
"""Maximum pixels of an image; the decoder refuses larger ones before allocating memory."""

MAX_ONE_CORE_PX = 1920 * 1088
"""Pixels of the largest images that one core surely decodes as fast as cameras send them."""


def video_stream(
    container: av.container.InputContainer, is_live: bool = False
) -> av.VideoStream | None:
    """The first video stream, ready to decode; None without a decodable one.

    An ``is_live`` one of up to :data:`MAX_ONE_CORE_PX` is decoded image by image: threads that
    decode one image each hold back as many images as there are cores.
    """
    stream = container.streams.video[0] if container.streams.video else None
    if stream is None or stream.codec_context is None:
        return None
    stream.codec_context.options = {"max_pixels": str(MAX_PIXELS)}
    px = stream.codec_context.width * stream.codec_context.height
    stream.thread_type = "SLICE" if is_live and px <= MAX_ONE_CORE_PX else "AUTO"
    return stream


def decoded_frames(
    packets: Iterator[av.Packet[Any]],
    stream: av.VideoStream,
    broke_off: Callable[[str], None],
    damaged: Callable[[Exception], None],
    is_needed: Callable[[av.Packet[Any]], bool] = lambda packet: True,
) -> Iterator[av.VideoFrame]:
    """Every complete image of ``packets`` of ``stream``: a damaged one affects no other.

    ``broke_off`` is called when they end with an error, ``damaged`` for each image
    that does not decode or that the decoder concealed. Packets that are not ``is_needed`` are
    passed over.
    """
    import av.error

    while True:
        try:
            packet = next(packets, None)
        except IndexError:  # PyAV's, at the end of a recording in which a stream began late
            packet = None
        except (av.error.FFmpegError, OSError) as error:
            broke_off(f"it is cut off: {error}")
            packet = None
        if packet is not None and not is_needed(packet):
            continue
        try:
            frames = stream.codec_context.decode(None) if packet is None else packet.decode()
        except av.error.EOFError:
            frames = []  # the decoder was emptied before
        except av.error.FFmpegError as error:
            damaged(error)
            frames = []
        for frame in frames:
            if frame.is_corrupt:
                damaged(ValueError("concealed by the decoder"))
            else:
                yield frame
        if packet is None:
            return


@dataclass(frozen=True, slots=True, eq=False)
class CameraFrame:
    pixels: U8 | Decoded  # (H, W, 3) BGR; of a video only some are converted
    time_ns: int  # presentation time, ns since the start of the stream
    seq: int  # 0, 1, 2 … of the delivered images
    geotag: GeoTag | None
    name: str  # file name of a still, else "frame <seq>"

    @property
    def image(self) -> U8:
        """(H, W, 3) BGR."""
        return self.pixels if isinstance(self.pixels, np.ndarray) else self.pixels()

    @property
    def size_px(self) -> tuple[int, int]:
        """(W, H)."""
        return self.pixels.shape[1], self.pixels.shape[0]


class CameraSource(ABC):
    """An open camera: iterate once for its images, in order of time, then close it."""

    size_px: tuple[int, int]  # (W, H)
    epoch_unix_ns: int | None = None  # UTC of time_ns = 0, if known
    start_monotonic_ns: int | None = None  # this machine's monotonic clock at time_ns = 0, if live
    fps: float | None = None  # mean images per second, if known
    is_live = False  # images that are not fetched in time are lost
    turned_deg = 0  # clockwise, from the images as they are stored
    is_reshaped = False  # it follows a source whose images had another shape

    def __init__(self, description: str) -> None:
        self.description = description  # for a log line and scan.json
        self.warnings: list[str] = []  # one line each; grows while images are fetched

    @abstractmethod
    def __iter__(self) -> Iterator[CameraFrame]:
        """Yield the images, oldest first; ends with the recording."""

    @property
    def images(self) -> int:
        """Their number by a recording's index; 0 where it has none."""
        return 0

    @property
    def dropped(self) -> int:
        """Images that were not fetched in time."""
        return 0

    def following(self) -> CameraSource | None:
        """The camera's further images where a change of their shape has ended this source, else
        None; what this source holds open is then the other's."""
        return None

    def close(self) -> None:  # noqa: B027, most recordings hold nothing open
        """Release the file or device; safe to call twice."""

    def _warn(self, text: str) -> None:
        """Warn once, however often the images are read."""
        if text not in self.warnings:
            self.warnings.append(text)
            log.warning("%s: %s", self.description, text)


class Relayed(CameraSource):
    """A source whose images are passed on as those of a live camera."""

    is_live = True

    def __init__(self, source: CameraSource) -> None:
        super().__init__(source.description)
        self._source = source
        self.size_px, self.fps, self.turned_deg = source.size_px, source.fps, source.turned_deg
        self.epoch_unix_ns = source.epoch_unix_ns
        self.start_monotonic_ns = source.start_monotonic_ns
        self.warnings = source.warnings

    @property
    def dropped(self) -> int:
        return self._source.dropped

    def close(self) -> None:
        self._source.close()


def ahead(source: CameraSource, kept: int = 4) -> Generator[CameraFrame, None, None]:
    """Every image of ``source`` in order, with at most ``kept`` of them decoded in advance.

    Raises what the source raises. A reader whose images are no longer fetched ends soon;
    close the iterator before the source.
    """
    queue: Channel[CameraFrame] = Channel(kept, drops=False)
    reader = _read("decoder", queue, source)
    try:
        yield from queue
    finally:
        queue.close()
        reader.join()


def _read(
    row: str,
    queue: Channel[CameraFrame],
    frames: Iterable[CameraFrame],
    at_end: Callable[[], None] = lambda: None,
) -> Worker:
    """Fill ``queue`` with ``frames`` on a separate thread."""

    def read(_: Worker) -> None:
        try:
            queue.fill(frames)
        finally:
            at_end()

    return PROCESS.start(row, read, queue.__len__, lambda: queue.lag_s)


CLOSE_S = 5.0  # for a recording's reader to end


class QueuedSource(Relayed):
    """A source whose newest images wait in a queue of ``kept``, filled on a separate thread; older
    ones are dropped, as by GStreamer's ``queue leaky=downstream``, and :attr:`dropped` counts them.

    A live source is read as fast as it gives images. Those of a recording come at their
    presentation time, as a camera's do.
    """

    def __init__(self, source: CameraSource, kept: int = 2) -> None:
        super().__init__(source)
        self._queue: Channel[CameraFrame] = Channel(kept, drops=True)
        self._closed = Event()
        self._starting = Lock()
        self._reader: Worker | None = None
        self._is_passed_on = False
        self.is_reshaped = source.is_reshaped

    @property
    def dropped(self) -> int:
        return self._queue.dropped

    def __iter__(self) -> Iterator[CameraFrame]:
        due = self._due()

        def end() -> None:
            due.close()
            if not self._source.is_live:
                self._source.close()

        with self._starting:  # close() finds the reader, or the reader finds it closed
            self._reader = _read("camera", self._queue, due, end)
        yield from self._queue
        if self.dropped:
            self.warnings.append(f"{self.dropped} frames arrived faster than they could be used")

    def following(self) -> CameraSource | None:
        if self._reader is None or not self._source.is_live:
            return None
        self._reader.join()  # it ends with its queue
        source = self._source.following()
        self._is_passed_on = source is not None
        return source and QueuedSource(source)

    def close(self) -> None:
        """End the iteration at once, from any thread, and close the source.

        A recording is closed by the thread that reads it, which is waited for unless its input
        hangs: a decoder must not be closed under it.
        """
        self._closed.set()
        self._queue.close()
        with self._starting:
            reader = self._reader
        if self._is_passed_on:
            return
        if self._source.is_live or reader is None:
            self._source.close()
        else:
            reader.join(CLOSE_S)

    def _due(self) -> Generator[CameraFrame, None, None]:
        start = time.monotonic_ns()
        for frame in self._source:
            early_s = 1e-9 * (frame.time_ns - (time.monotonic_ns() - start))
            if self._closed.wait(0.0 if self._source.is_live else max(0.0, early_s)):
                return
            yield frame
