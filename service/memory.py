"""Keeps unused memory from staying with the process.

The C library gives each thread its own memory pool and keeps freed memory in it. Images are
allocated and freed on several threads, so that each pool would grow to the maximum need of all; and
only the first pool returns free memory at its end. Arrays larger than a colour image stay out of
the pool, where they would leave holes; the library itself would take in arrays of up to 32 MiB.
"""

from __future__ import annotations

import ctypes
import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager

M_ARENA_MAX, M_MMAP_THRESHOLD, M_TRIM_THRESHOLD = -8, -3, -1  # mallopt(3)

POOLED_BYTES, SPARE_BYTES = 8 << 20, 32 << 20
"""The largest allocation in the pool, and what it keeps at its end."""


def one_pool() -> bool:
    """Restrict the C library to one pool; True when it does. Running threads keep theirs.

    Call it before NumPy is imported, which requests huge pages (2 MiB) for large arrays: any small
    allocation that later uses such a place in the pool would occupy a whole one.
    """
    os.environ.setdefault("NUMPY_MADVISE_HUGEPAGE", "0")
    libc = _libc("mallopt")
    if libc is None:
        return False
    libc.mallopt(M_MMAP_THRESHOLD, POOLED_BYTES)
    libc.mallopt(M_TRIM_THRESHOLD, SPARE_BYTES)
    return bool(libc.mallopt(M_ARENA_MAX, 1) == 1)


@contextmanager
def loading() -> Iterator[None]:
    """Import modules inside: what they hold is never garbage, and the collector of garbage would
    look at all of it again and again."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def release_memory(collect: bool = False) -> bool:
    """Return freed memory to the system; True when it did. Takes a millisecond or two. With
    ``collect`` reference cycles are freed first, as after a scan; that takes longer."""
    if collect:
        gc.collect()
    libc = _libc("malloc_trim")
    return libc is not None and libc.malloc_trim(0) == 1


def _libc(name: str) -> ctypes.CDLL | None:
    """The C library if it has that function (as glibc does)."""
    libc = ctypes.CDLL(None)
    return libc if hasattr(libc, name) else None
