"""Large arrays that the next call of the same thread uses again.

A fresh array of tens of megabytes is mapped page by page when it is first written, which takes
longer than a sweep of belief propagation.
"""

from __future__ import annotations

import threading

import numpy as np
import numpy.typing as npt

I16 = npt.NDArray[np.int16]


class Workspace(threading.local):
    """One set of int16 arrays per thread, by name; each keeps the shape it was last taken in."""

    def __init__(self) -> None:
        self._kept: dict[str, I16] = {}

    def take(self, name: str, shape: tuple[int, ...]) -> I16:
        """The array of that name: zeros when its shape is new, else as the last user left it."""
        array = self._kept.get(name)
        if array is None or array.shape != shape:
            array = np.zeros(shape, np.int16)
            self._kept[name] = array
        return array
