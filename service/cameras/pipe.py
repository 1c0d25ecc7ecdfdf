"""Video piped on standard input or through a named pipe, encoded or raw.

``ffmpeg -i flight.mp4 -c copy -f mpegts - | skyrelief replay -``. Matroska, MPEG-TS,
fragmented mp4 and y4m describe themselves; raw frames need their shape in the options:
``pipe:-?format=rawvideo&video_size=1280x720&pixel_format=bgr24&framerate=30`` (FFmpeg's names).
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

from service.cameras import reject_options
from service.cameras.video import VideoSource
from service.errors import InputError

OPTIONS = ("format", "video_size", "pixel_format", "framerate")
HEAD_BYTES = 4096


class PipeReader:
    """A read-only byte stream whose first bytes can be looked at before they are consumed."""

    def __init__(self, stream: BinaryIO) -> None:
        """Wrap ``stream``; nothing is read yet."""
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
    """The video that comes out of ``-`` (standard input) or the named pipe at ``rest``."""
    import av
    import av.error

    reject_options("pipe", options, OPTIONS)
    name = "standard input" if rest in ("-", "") else rest
    reader = PipeReader(_stream(rest))
    head = reader.peek(HEAD_BYTES)
    if not head:
        raise InputError(f"{name}: nothing came; pipe a video into it")
    if index_at_end(head):
        raise InputError(
            f"{name}: an mp4 with its index at the end cannot be piped; give the file itself, or "
            "'ffmpeg -i FILE -c copy -f mpegts - | …'"
        )
    demuxer = {key: value for key, value in options.items() if key != "format"}
    try:
        container = av.open(
            reader,
            mode="r",
            format=options.get("format"),
            options=demuxer,
            metadata_errors="replace",
        )
    except (av.error.FFmpegError, ValueError, OSError) as error:
        raise InputError(
            f"{name}: not a video stream that can be read ({error}); Matroska, MPEG-TS, "
            "fragmented mp4 and y4m describe themselves, raw frames need "
            "pipe:-?format=rawvideo&video_size=WxH&pixel_format=bgr24&framerate=F"
        ) from error
    return VideoSource(container, name)


def index_at_end(head: bytes) -> bool:
    """True when ``head`` starts an mp4 whose pictures come before their index."""
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
