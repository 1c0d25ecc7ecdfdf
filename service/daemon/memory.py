"""Keeps a long-lived process from holding memory that nothing uses.

The C library gives threads pools of their own, and keeps what was freed in them. Pictures are
taken and freed on several threads, so that each pool would grow to the largest need of all; and
what is free at the end of a pool is given back for the first one only.
"""

from __future__ import annotations

import ctypes
import gc
import os

M_ARENA_MAX = -8  # mallopt(3)
SMALL_BYTES, KEPT_EACH = 1024, 7


def one_pool() -> bool:
    """True when the C library keeps to one pool from now on; threads that run have theirs.

    Before NumPy is imported: it would ask for huge pages (2 MiB) wherever a large array lay in
    that pool, for whatever little comes there next.
    """
    os.environ.setdefault("NUMPY_MADVISE_HUGEPAGE", "0")
    libc = _libc("mallopt")
    return libc is not None and libc.mallopt(M_ARENA_MAX, 1) == 1


def fill_small_caches() -> None:
    """Have NumPy take all the small blocks at once that it would take in the course of hours.

    It keeps up to :data:`KEPT_EACH` freed blocks of every size below :data:`SMALL_BYTES`
    (numpy/_core/src/multiarray/alloc.c): 3.5 MiB. Taken one by one they would lie between
    pictures, and each hold a page of memory; taken together they lie together.
    """
    import numpy as np

    held = [np.empty(size, np.uint8) for size in range(1, SMALL_BYTES) for _ in range(KEPT_EACH)]
    held.clear()


def give_back(collect: bool = False) -> bool:
    """True when freed memory went back to the system: a millisecond or two of work.

    With ``collect`` objects that only refer to each other are freed before, as after a scan;
    that takes longer.
    """
    if collect:
        gc.collect()
    libc = _libc("malloc_trim")
    return libc is not None and libc.malloc_trim(0) == 1


def _libc(name: str) -> ctypes.CDLL | None:
    """The C library if it has that function (glibc has)."""
    libc = ctypes.CDLL(None)
    return libc if hasattr(libc, name) else None
