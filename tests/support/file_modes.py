"""File modes that bind the superuser too, as tests often run as root."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")

CAPABILITY_VERSION_3 = 0x20080522
DAC_OVERRIDE, DAC_READ_SEARCH = 1, 2


def bound_by_modes(run: Callable[[], T]) -> T:
    """What ``run`` returns on a thread of its own, without the right to pass over files' modes."""
    with ThreadPoolExecutor(1, initializer=_give_up_override) as pool:
        return pool.submit(run).result()


def _give_up_override() -> None:
    """Take this thread's capabilities over modes away, for ever."""
    libc = ctypes.CDLL(None, use_errno=True)
    header = (ctypes.c_uint32 * 2)(CAPABILITY_VERSION_3, 0)
    sets = (ctypes.c_uint32 * 6)()  # effective, permitted, inheritable; twice
    if libc.capget(header, sets) == 0:
        for n in range(3):
            sets[n] &= ~(1 << DAC_OVERRIDE | 1 << DAC_READ_SEARCH)
        if libc.capset(header, sets) == 0:
            return
    raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
