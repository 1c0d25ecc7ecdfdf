"""Recorded video through PyAV, with the container's own presentation times.

``file:flight.mp4``: mp4, mov, mkv, MPEG-TS, or any other format of FFmpeg. ``pipe:-`` or a named
pipe: ``ffmpeg -i flight.mp4 -c copy -f mpegts - | skyrelief replay -``. Matroska, MPEG-TS,
fragmented mp4 and y4m describe themselves; raw frames need options:
"""

from __future__ import annotations

import itertools
import logging
import re
import sys
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import datetime, timezone
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from mavlink.telemetry.samples import YEAR_2000_UNIX_S
from service.cameras import UNREAD, how_to_convert, open_container, reject_options
from service.cameras.source import CameraFrame, CameraSource, Decoded, decoded_frames, video_stream
from service.errors import InputError

if TYPE_CHECKING:
    import av
    import av.container

log = logging.getLogger(__name__)

OPTIONS = ("format", "video_size", "pixel_format", "framerate")

PANORAMAS = frozenset((".360", ".insv"))  # recordings of GoPro and Insta360 that show all around

RESTART_NS = 1_000_000_000
"""A time that goes back to this long after the start, at most, begins again: joined recordings."""

LONGEST_NS = 366 * 86_400 * 1_000_000_000  # no recording is longer: a time beyond is damage
UNEQUAL = 0.01  # share by which width and height of a pixel may differ

HEAD_BYTES = 4096
NS_PER_S = 1_000_000_000


class VideoSource(CameraSource):
    """The images of one open PyAV container; its first image is decoded on construction."""

    def __init__(
        self, container: av.container.InputContainer, description: str, follows_turn: bool = False
    ) -> None:
        """Take over ``container``; raises InputError when it has no image. ``follows_turn`` rotates
        the images as the container requests."""
        super().__init__(description)
        self._container = container
        self._damaged = 0
        self._unordered = 0
        self._earlier_ns = 0  # time before the clock last began again
        self._wanted_ns: list[int] | None = None  # all
        self._within_ns = self._late_ns = 0
        self._end_ns = LONGEST_NS
        self.passed = 0  # coded images that are not shown
        if not container.streams.video:
            self.close()
            raise InputError(f"{description}: contains no video stream; give a video of the flight")
        stream = video_stream(container)
        if stream is None:
            self.close()
            raise InputError(f"{description}: its video has a format that cannot be decoded")
        self._stream = stream
        self._images = stream.frames  # a closed container has freed its stream
        self._decoded = decoded_frames(
            container.demux(stream), self._stream, self._warn, self._damage, self._is_needed
        )
        self._first = next(self._decoded, None)
        if self._first is None:
            self.close()
            raise InputError(f"{description}: no image could be decoded; is it cut off or empty?")
        stored = int(self._first.width), int(self._first.height)
        self._stored_px = stored
        if follows_turn:  # counterclockwise in PyAV
            self.turned_deg = round(-getattr(self._first, "rotation", 0) / 90) * 90 % 360
        self.size_px = stored[::-1] if self.turned_deg % 180 else stored
        self._start_s = _start_s(self._stream, self._first)
        self.epoch_unix_ns = creation_unix_ns(container, self._stream)
        rate = self._stream.average_rate or self._stream.guessed_rate
        self.fps = float(rate) if rate else None
        wide = self._stream.sample_aspect_ratio
        if wide and abs(wide - 1) > UNEQUAL:
            self._warn(
                f"a pixel is {float(wide):.2f} times as wide as high, a lens that is not calibrated"
                " counts as if they were square; ffmpeg -vf scale=iw*sar:ih,setsar=1 makes them so"
            )
        if self._first.interlaced_frame:
            self._warn("its images are interlaced, their edges are torn; ffmpeg -vf bwdif fixes it")

    def __iter__(self) -> Iterator[CameraFrame]:
        """Yield the images whose time increases; warns at the end about skipped ones."""
        first, self._first = self._first, None
        if first is None:
            return
        last_ns = -1
        seq = 0
        decoded = 0
        for frame in itertools.chain((first,), self._decoded):
            decoded += 1
            time_ns = self._time_ns(frame, last_ns)
            if not last_ns < time_ns < LONGEST_NS:
                self._unordered += 1
                continue
            if time_ns > self._end_ns:
                break
            size_px = (int(frame.width), int(frame.height))
            if size_px != self._stored_px:
                self._warn(
                    f"image size changed from {_by(self._stored_px)} to {_by(size_px)} at "
                    f"{time_ns / 1e9:.2f} s; the rest is skipped"
                )
                break
            if self._is_wanted(time_ns, time_ns):
                pixels = Decoded(frame, self.turned_deg)
                yield CameraFrame(pixels, time_ns, seq, None, f"frame {seq}")
            last_ns = time_ns
            seq += 1
        else:
            self._warn_losses(decoded + self.passed)
        self.close()

    @property
    def images(self) -> int:
        return self._images

    def only_near(self, times_ns: Iterable[int], within_ns: int) -> None:
        """Yield no other images than those near ``times_ns``, at least one, and end with the last.

        Others are not converted. In a file with an index (mp4) they are not decoded either, unless
        one that is wanted follows before the next keyframe.
        """
        self._wanted_ns, self._within_ns = sorted(times_ns), within_ns
        self._end_ns = self._wanted_ns[-1] + within_ns

    def _is_wanted(self, first_ns: int, last_ns: int) -> bool:
        """Whether one of the times wanted lies between two times, or near them."""
        if self._wanted_ns is None:
            return True
        at = bisect_left(self._wanted_ns, first_ns - self._within_ns)
        return at < len(self._wanted_ns) and self._wanted_ns[at] <= last_ns + self._within_ns

    def _is_needed(self, packet: av.Packet[Any]) -> bool:
        """Whether an image that is wanted may depend on ``packet``."""
        if packet.is_discard:  # before the start that an edit list sets
            self.passed += 1
            return True
        entries = getattr(self._stream, "index_entries", None)
        if self._wanted_ns is None or packet.dts is None or packet.time_base is None:
            return True
        if not entries or len(entries) != self.images:
            return True
        if packet.is_keyframe and packet.pts is not None:
            self._late_ns = self._ns(packet.pts - packet.dts, packet.time_base)
        start_ns = round(self._start_s * NS_PER_S)
        first_ns = self._ns(packet.dts, packet.time_base) - start_ns
        following = entries.search_timestamp(packet.dts + 1, backward=False)
        last_ns = 1 << 62
        if following >= 0:
            dts = entries[following].timestamp
            last_ns = self._ns(dts, packet.time_base) - start_ns + self._late_ns
        is_needed = self._is_wanted(first_ns, last_ns)
        self.passed += not is_needed
        return is_needed

    @staticmethod
    def _ns(ticks: int, time_base: Fraction) -> int:
        return round(ticks * time_base * NS_PER_S)

    def close(self) -> None:
        self._container.close()

    def _damage(self, error: Exception) -> None:
        self._damaged += 1
        log.debug("%s: image dropped: %s", self.description, error)

    def _time_ns(self, frame: av.VideoFrame, last_ns: int) -> int:
        """Presentation time; an image without one follows the last one at the mean interval."""
        if frame.pts is None or frame.time_base is None:
            return self._following(last_ns)
        # Whole ticks first: floats of seconds lose nanoseconds after minutes.
        clock_ns = round((frame.pts * frame.time_base - self._start_s) * NS_PER_S)
        if clock_ns <= RESTART_NS < last_ns - self._earlier_ns - clock_ns:
            self._warn(
                f"times begin again at {last_ns / 1e9:.2f} s, as in joined recordings: "
                "the rest follows on at once"
            )
            self._earlier_ns = self._following(last_ns) - clock_ns
        return self._earlier_ns + clock_ns

    def _following(self, last_ns: int) -> int:
        """Time of the image after the one at ``last_ns``, at the mean interval."""
        step = 1e9 / self.fps if self.fps else 1e9 / 30.0
        return last_ns + int(step) if last_ns >= 0 else 0

    def _warn_losses(self, decoded: int) -> None:
        if self._damaged:
            self._warn(f"{self._damaged} damaged images were skipped")
        if self._unordered:
            self._warn(
                f"{self._unordered} images whose time does not follow the one before were skipped"
            )
        if self.images > decoded:
            self._warn(
                f"{decoded} of the {self.images} images in the index could be "
                "decoded; the recording is cut off or damaged"
            )


LONGEST_CUE = 8192  # bytes of a cue that are read; drones write a few hundred


LARGEST_METADATA = 1 << 20
"""Bytes of a packet of metadata that are read; cameras write some kilobytes."""


def subtitles(path: Path) -> Iterator[tuple[int, str]]:
    """(ns since the video's start, text) of the cues in a video's own subtitles, if it has any."""
    for time_ns, _, packet in _packets(path, "subtitle"):
        codec = packet.stream.codec_context.name
        head = 2 if codec == "mov_text" else 0  # the number of bytes
        text = bytes(packet)[head:LONGEST_CUE].decode("utf-8", "replace")
        if text:
            yield time_ns, text


def metadata(path: Path, is_wanted: Callable[[bytes], bool]) -> Iterator[tuple[int, int, bytes]]:
    """(ns since the video's start, duration in ns, bytes) of the packets of a video's metadata, of
    the first stream with a packet that ``is_wanted``, from that packet on."""
    used: int | None = None
    for time_ns, duration_ns, packet in _packets(path, "data"):
        data = bytes(memoryview(packet)[:LARGEST_METADATA])
        if used is None and is_wanted(data):
            used = packet.stream.index
        if packet.stream.index == used:
            yield time_ns, duration_ns, data


def _packets(path: Path, kind: str) -> Iterator[tuple[int, int, Any]]:
    """(ns since the video's start, duration in ns, packet) of streams of a kind; of subtitles the
    first stream.

    A packet without a time, as MPEG-TS has them, is of the image before it in the file.
    """
    import av.error

    try:
        with open_container(str(path)) as container:
            streams = [s for s in container.streams if s.type == kind]
            streams = streams[:1] if kind == "subtitle" else streams
            if not streams or not container.streams.video:
                return
            video = container.streams.video[0]
            start_s = (video.start_time or 0) * (video.time_base or Fraction(0))
            wanted = [*streams, video] if container.format.name == "mpegts" else streams
            for other in container.streams:
                if other not in wanted and hasattr(other, "discard"):  # since PyAV 18
                    other.discard = type(other.discard).all  # most of the file is not read
            before_s = Fraction(0)
            for packet in container.demux(wanted):
                base = packet.time_base or Fraction(0)
                time_s = before_s if packet.pts is None else packet.pts * base - start_s
                if packet.stream in streams:
                    if packet.size:
                        duration_ns = round((packet.duration or 0) * base * NS_PER_S)
                        yield round(time_s * NS_PER_S), duration_ns, packet
                else:
                    before_s = max(before_s, time_s)  # images are stored out of order
    except IndexError:  # as of decoded_frames
        pass
    except (av.error.FFmpegError, OSError, ValueError) as error:
        log.debug("%s: its %s ends: %s", path, kind, error)


def creation_unix_ns(container: Any, stream: Any) -> int | None:
    """UTC of the start from the container's (else the stream's) creation time; None without."""
    for metadata in (container.metadata, stream.metadata):
        for key in ("creation_time", "com.apple.quicktime.creationdate", "CREATION_TIME"):
            unix_ns = parse_time_unix_ns(metadata.get(key, ""))
            if unix_ns is not None:
                return unix_ns
    return None


def parse_time_unix_ns(text: str) -> int | None:
    """Unix ns of an ISO 8601 time, UTC when it has no zone; None when invalid."""
    text = re.sub(r"([+-]\d\d)(\d\d)$", r"\1:\2", text.strip().replace("Z", "+00:00"))
    try:  # Python 3.10 reads no zone without a colon, as QuickTime's
        moment = datetime.fromisoformat(text)
    except ValueError:
        return None
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=timezone.utc)
    unix_us = round(moment.timestamp() * 1e6)
    return unix_us * 1000 if unix_us >= YEAR_2000_UNIX_S * 1_000_000 else None


def _start_s(stream: av.VideoStream, first: av.VideoFrame) -> Fraction:
    """Presentation time of the stream's start as an exact fraction of seconds. The first decodable
    image may be later than the start (a stream joined midway)."""
    if stream.start_time is not None and stream.time_base is not None:
        start = stream.start_time * stream.time_base
        if first.pts is None or first.time_base is None or start <= first.pts * first.time_base:
            return start
    if first.pts is not None and first.time_base is not None:
        return first.pts * first.time_base
    return Fraction(0)


def _by(size_px: tuple[int, int]) -> str:
    return f"{size_px[0]}x{size_px[1]}"


def open_file(rest: str, options: Mapping[str, str]) -> VideoSource:
    """The video at path ``rest``; raises InputError that names the fault."""
    import av
    import av.error

    reject_options("file", options)
    path = Path(rest)
    if not path.exists():
        raise InputError(f"no such file: {path}")
    if path.is_dir():
        raise InputError(f"{path} is a folder; for a folder of images write images:{path}")
    if not path.is_file():
        raise InputError(f"{path} is not a regular file; for a named pipe write pipe:{path}")
    if path.stat().st_size == 0:
        raise InputError(f"{path} is empty (0 bytes); copy it from the camera again")
    if path.suffix.lower() in PANORAMAS:
        raise InputError(
            f"{path} shows all around, which fits no camera model; "
            "export a flat video of one direction with the maker's program"
        )
    if path.suffix.lower() in UNREAD:
        raise InputError(f"{path}: {how_to_convert(path)}")
    try:
        container = open_container(str(path))
    except av.error.InvalidDataError as error:
        raise InputError(_not_video(path)) from error
    except av.error.EOFError as error:
        raise InputError(f"{path} ends before its first image; it is cut off") from error
    except (av.error.FFmpegError, OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise InputError(f"{path} cannot be read: {why}") from error
    return VideoSource(container, str(path), follows_turn=True)


def _not_video(path: Path) -> str:
    with path.open("rb") as stream:
        head = stream.read(12)
    if head[4:8] == b"ftyp":
        return (
            f"{path} has no index: the recording was cut off before the camera closed it; "
            "repair it with the camera or a recovery tool, or record mkv"
        )
    return f"{path} is not a video that can be read (mp4, mkv, MPEG-TS)"


class PipeReader:
    """A read-only byte stream whose first bytes can be peeked."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._head = b""

    def peek(self, n: int) -> bytes:
        """Up to ``n`` first bytes, fewer only when the stream ends before."""
        while len(self._head) < n:
            more = self._stream.read(n - len(self._head))
            if not more:
                break
            self._head += more
        return self._head[:n]

    def read(self, n: int = -1) -> bytes:
        """The next bytes, at most ``n``; empty at the end."""
        if self._head:
            size = len(self._head) if n < 0 else n
            out, self._head = self._head[:size], self._head[size:]
            return out
        return self._stream.read(n)


def open_pipe(rest: str, options: Mapping[str, str]) -> VideoSource:
    """The video from ``-`` (standard input) or the named pipe at ``rest``."""
    import av
    import av.error

    reject_options("pipe", options, OPTIONS)
    name = "standard input" if rest in ("-", "") else rest
    reader = PipeReader(_stream(rest))
    head = reader.peek(HEAD_BYTES)
    if not head:
        raise InputError(f"{name}: received nothing; pipe a video into it")
    if index_at_end(head):
        raise InputError(
            f"{name}: an mp4 with its index at the end cannot be piped; give the file itself, or "
            "'ffmpeg -i FILE -c copy -f mpegts - | …'"
        )
    demuxer = {key: value for key, value in options.items() if key != "format"}
    try:
        container = open_container(reader, mode="r", format=options.get("format"), options=demuxer)
    except (av.error.FFmpegError, ValueError, OSError) as error:
        raise InputError(
            f"{name}: not a video stream that can be read ({error}); Matroska, MPEG-TS, "
            "fragmented mp4 and y4m describe themselves, raw frames need "
            "pipe:-?format=rawvideo&video_size=WxH&pixel_format=bgr24&framerate=F"
        ) from error
    return VideoSource(container, name)


def index_at_end(head: bytes) -> bool:
    """True when ``head`` starts an mp4 whose images come before their index."""
    if head[4:8] != b"ftyp":
        return False
    at = 0
    while at + 8 <= len(head):
        size = int.from_bytes(head[at : at + 4], "big")
        kind = head[at + 4 : at + 8]
        if kind == b"mdat":
            return True
        if kind in (b"moov", b"moof") or size < 8:
            return False
        at += size
    return False


def _stream(rest: str) -> BinaryIO:
    if rest in ("-", ""):
        if sys.stdin is None or sys.stdin.isatty():
            raise InputError("standard input is a terminal; pipe a video into it")
        return sys.stdin.buffer
    path = Path(rest)
    if not path.exists():
        raise InputError(f"no such named pipe: {path}; make it with 'mkfifo {path}'")
    try:
        return path.open("rb")
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error
