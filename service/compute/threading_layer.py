"""Whether compiled kernels may run on two threads of ours at once.

Numba shares its loops among cores by TBB, OpenMP or a work queue of its own. The work queue ends
the process when two threads call it at once, and it is what is left on a bare system without
``libgomp.so.1`` (numba's documentation, "The Threading Layers").
"""

from __future__ import annotations

import functools
import logging
import sys
from collections.abc import Callable

from service.packages import loads

log = logging.getLogger(__name__)

LIBRARIES = ("libtbb.so.12", "libgomp.so.1")
REMEDY = "apt install libgomp1"


def share_cores(threads: int) -> Callable[[], None]:
    """Give compiled kernels of this thread half of ``threads`` (0: one per core) from now on.

    Returns what gives the other half to the thread that calls it: two that each want all the
    cores only wait for one another.
    """
    import numba

    available = numba.config.NUMBA_NUM_THREADS
    half = max(1, min(threads or available, available) // 2)
    numba.set_num_threads(half)
    return functools.partial(numba.set_num_threads, half)


@functools.cache
def kernels_may_overlap() -> bool:
    """True when TBB or OpenMP is there; said once in the log when neither is."""
    import numba

    if numba.config.THREADING_LAYER != "workqueue" and (
        not sys.platform.startswith("linux") or any(map(loads, LIBRARIES))
    ):
        return True
    log.warning("no OpenMP on this system: tracking and stereo take turns; %s", REMEDY)
    return False
