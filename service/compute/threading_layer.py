"""Whether compiled kernels may run on two threads at once.

Numba distributes its loops over cores by TBB, OpenMP or its own work queue. The work queue aborts
the process when two threads call it at once, and it is the only one on a bare system without
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
    """Limit compiled kernels of this thread to half of ``threads`` (0: one per core).

    Returns a function that gives the other half to its calling thread: two threads that each use
    all cores only wait for each other.
    """
    import numba

    available = numba.config.NUMBA_NUM_THREADS
    half = max(1, min(threads or available, available) // 2)
    numba.set_num_threads(half)
    return functools.partial(numba.set_num_threads, half)


@functools.cache
def kernels_may_overlap() -> bool:
    """True with TBB or OpenMP; logs once when neither is available."""
    import numba

    if numba.config.THREADING_LAYER != "workqueue" and (
        not sys.platform.startswith("linux") or any(map(loads, LIBRARIES))
    ):
        return True
    log.warning("no OpenMP on this system: tracking and stereo take turns; %s", REMEDY)
    return False
