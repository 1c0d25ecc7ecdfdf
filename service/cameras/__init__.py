"""Cameras in one table: each line is a word before the colon and the function that opens the rest.

A source is written ``word:rest``, as in ``file:flight.mp4``, ``images:DIR`` or ``pipe:-``. A
bare path is a file or a folder of images, a bare ``-`` is standard input. Options follow a
question mark: ``pipe:-?format=rawvideo&video_size=1280x720``.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

from service.cameras.source import CameraFrame, CameraSource, GeoTag
from service.errors import InputError

__all__ = ["CAMERAS", "CameraFrame", "CameraSource", "GeoTag", "open_camera"]

CAMERAS: dict[str, str] = {
    "file": "service.cameras.video:open_file",
    "images": "service.cameras.images:open_images",
    "pipe": "service.cameras.video:open_pipe",
    "rtsp": "service.cameras.live:open_rtsp",
    "rtmp-listen": "service.cameras.live:open_rtmp_listen",
    "srt": "service.cameras.live:open_srt",
    "v4l2": "service.cameras.live:open_v4l2",
    "gst": "service.cameras.live:open_gst",
    "stream": "service.cameras.live:open_stream",
    "sim": "service.cameras:open_sim",
}
"""Word to ``module:function(rest, options) -> CameraSource``; imported on first use."""


UNREAD = frozenset(
    (
        *(".heic", ".heif", ".avif", ".jxl"),
        *(".dng", ".gpr", ".arw", ".cr2", ".cr3", ".nef", ".orf", ".raf", ".rw2"),
    )
)
"""Stills as phones and cameras store them that no library here decodes."""


def how_to_convert(path: Path) -> str:
    """What to do with stills like ``path``, whose suffix is one of UNREAD, in words."""
    return (
        f"{path.suffix.lower()} images are not read: convert them to JPEG with their EXIF "
        f"('magick mogrify -format jpg *{path.suffix}') and give the folder"
    )


def open_camera(source: str) -> CameraSource:
    """The camera that ``source`` names, open and with its first image decoded.

    Raises InputError when there is no such source or it contains no images, OutsideError when
    a device or a link does not answer.
    """
    word, rest, options = parse_source(source)
    module, _, function = CAMERAS[word].partition(":")
    opener: Callable[[str, Mapping[str, str]], CameraSource]
    opener = getattr(import_module(module), function)
    return opener(rest, options)


def parse_source(source: str) -> tuple[str, str, dict[str, str]]:
    """(word of the table, the rest, options) of a source as written by the user."""
    if not source:
        raise InputError("no camera source given; name a video, a folder of images or '-'")
    if source == "-":
        return "pipe", "-", {}
    if source.startswith("/dev/video"):
        source = f"v4l2:{source}"
    path = Path(source)
    if path.exists():
        return ("images" if path.is_dir() else "file"), source, {}
    word, colon, rest = source.partition(":")
    if colon and word in CAMERAS:
        if "://" in source or word == "gst" or Path(rest).exists():
            return word, rest, {}  # a URL's own query, or a name with a question mark
        rest, _, query = rest.partition("?")
        return word, rest, dict(parse_qsl(query, keep_blank_values=True))
    if colon and "/" not in word and "." not in word and len(word) > 1:
        near = difflib.get_close_matches(word, CAMERAS, n=1)
        hint = f"did you mean '{near[0]}:'?" if near else f"available: {', '.join(CAMERAS)}"
        raise InputError(f"no camera source '{word}:'; {hint}")
    raise InputError(f"no such file or folder: {source}")


def open_sim(rest: str, options: Mapping[str, str]) -> CameraSource:
    """Refuse: a simulated flight is more than a camera, and only the service plays it."""
    raise InputError("sim: is a whole flight; use 'skyrelief run', or 'simulate' for a video")


def reject_options(source: str, options: Mapping[str, str], known: tuple[str, ...] = ()) -> None:
    """Raise InputError when ``options`` holds a key that ``source`` does not know."""
    for key in options:
        if key not in known:
            listing = ", ".join(known) if known else "none"
            raise InputError(f"{source}: no option '{key}'; available: {listing}")


LENIENT_SINCE = 19
"""The version of PyAV from which tags that are not UTF-8 are read without being asked for it."""


def lenient(pyav: str) -> dict[str, str]:
    """What this version of PyAV is asked for, so that tags that are not UTF-8 raise nothing."""
    return {"metadata_errors": "replace"} if int(pyav.partition(".")[0]) < LENIENT_SINCE else {}


def open_container(source: Any, **options: Any) -> Any:
    """A recording or stream by ``av.open``; tags that are not UTF-8 raise nothing."""
    import av

    options |= lenient(av.__version__)
    return av.open(source, **options)
