"""Reads small files that a user names, up to a maximum size."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import TypeVar

import msgspec

from service.errors import InputError

T = TypeVar("T")


def read_small(path: Path, max_bytes: int, what: str) -> bytes:
    """The bytes of the regular file at ``path``; errors call it a ``what``.

    Raises InputError, in one line, for a missing file, a folder, a device or pipe, and a file
    larger than ``max_bytes``.
    """
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # never blocks on a pipe
        with open(handle, "rb") as file:
            if not stat.S_ISREG(os.fstat(handle).st_mode):
                raise InputError(f"{path} is not a regular file; give the {what} itself")
            data = file.read(max_bytes + 1)
    except FileNotFoundError:
        raise InputError(f"{path} cannot be read: no such file; give the {what}") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path} cannot be read: {reason}") from error
    if len(data) > max_bytes:
        raise InputError(f"{path} is larger than {max_bytes} bytes; is it a {what}?")
    return data


def read_json(path: Path, kind: type[T], max_bytes: int, what: str) -> T:
    """The ``kind`` that the regular file at ``path`` holds as JSON. Raises InputError as
    :func:`read_small`, and for any other content."""
    data = read_small(path, max_bytes, what)
    try:
        return msgspec.json.decode(data, type=kind)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path.name} cannot be read as {what}: {error}"[:300]) from error
