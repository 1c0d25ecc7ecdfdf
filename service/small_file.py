"""Reads small files that a user names, up to a maximum size."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from service.errors import InputError


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
