"""A recorded video: mp4, mov, mkv, MPEG-TS, whatever FFmpeg reads."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from service.cameras import reject_options
from service.cameras.video import VideoSource
from service.errors import InputError


def open_file(rest: str, options: Mapping[str, str]) -> VideoSource:
    """The video at path ``rest``; raises InputError naming what is wrong with it."""
    import av
    import av.error

    reject_options("file", options)
    path = Path(rest)
    if not path.exists():
        raise InputError(f"no such file: {path}")
    if path.is_dir():
        raise InputError(f"{path} is a folder; for a folder of pictures write images:{path}")
    if not path.is_file():
        raise InputError(f"{path} is no regular file; for a named pipe write pipe:{path}")
    if path.stat().st_size == 0:
        raise InputError(f"{path} is empty (0 bytes); copy it from the camera again")
    try:
        container = av.open(str(path), metadata_errors="replace")
    except av.error.InvalidDataError as error:
        raise InputError(_not_video(path)) from error
    except av.error.EOFError as error:
        raise InputError(f"{path} ends before its first picture; it was cut off") from error
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
