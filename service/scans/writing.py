"""Files that appear whole or not at all."""

from __future__ import annotations

import glob
import os
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from service.errors import OutsideError


@contextmanager
def writing(path: Path) -> Iterator[Path]:
    """A temporary path of the calling thread for ``path``; renamed onto it on success, otherwise
    removed.

    A disk failure becomes an OutsideError.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_abandoned(path)
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


def _remove_abandoned(path: Path) -> None:
    """Remove the temporary files for ``path`` of processes that ended by a kill or a power cut."""
    for part in path.parent.glob(f".{glob.escape(path.name)}.*-*.part"):
        writer = re.fullmatch(r"([0-9]{1,9})-[0-9]+\.part", part.name[len(path.name) + 2 :])
        if writer is None:
            continue  # a name that is not ours
        try:
            os.kill(int(writer[1]), 0)
        except ProcessLookupError:
            part.unlink(missing_ok=True)
        except PermissionError:
            pass  # another user's, alive
