"""Files that appear whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from service.errors import OutsideError


@contextmanager
def writing(path: Path) -> Iterator[Path]:
    """A temporary path for ``path``; renamed onto it on success, otherwise removed.

    A disk failure becomes an OutsideError.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield part
        with open(part, "rb+") as written:
            os.fsync(written.fileno())
        os.replace(part, path)
    except OSError as error:
        raise OutsideError(
            f"cannot write {path} ({error.strerror or error}); check the disk and its rights"
        ) from error
    finally:
        with suppress(OSError):  # a disk that cannot be written cannot be cleaned either
            part.unlink(missing_ok=True)
