"""Stores of the scans viewed last, kept open with what is derived from them."""

from __future__ import annotations

import math
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Generic, Protocol, TypeVar

from service.stream.store import ScanStore


class StoreView(Protocol):
    """Something derived from an open store."""

    def refresh(self) -> object:
        """Follow the store."""
        ...


V = TypeVar("V", bound=StoreView)


class OpenScans(Generic[V]):
    """Views of the ``max_scans`` scans asked for last; each is refreshed once it is older than
    ``min_age_s``. Thread-safe."""

    def __init__(self, view: Callable[[ScanStore], V], min_age_s: float, max_scans: int) -> None:
        self._view, self._min_age_s, self._max_scans = view, min_age_s, max_scans
        self.lock = threading.RLock()  # also of the views
        self._kept: OrderedDict[Path, tuple[V, ScanStore, float]] = OrderedDict()

    def view(self, folder: Path) -> V:
        """The view of the scan in ``folder``. Hold :attr:`lock` while it is used.

        Raises InputError when the folder contains no scan, and what the view raises.
        """
        with self.lock:
            if folder not in self._kept:
                self._kept[folder] = self._opened(folder)
            found, store, then = self._kept[folder]
            if time.monotonic() - then >= self._min_age_s:
                store.follow()
                found.refresh()
                then = time.monotonic()
            self._kept[folder] = (found, store, then)
            self._kept.move_to_end(folder)
            while len(self._kept) > self._max_scans:
                self._kept.popitem(last=False)[1][1].close()
            return found

    def _opened(self, folder: Path) -> tuple[V, ScanStore, float]:
        store = ScanStore.open(folder / "scan.db")
        try:
            return self._view(store), store, -math.inf
        except Exception:
            store.close()
            raise

    def forget(self, folder: Path) -> None:
        """Close the store of a folder, for example before it is deleted."""
        with self.lock:
            held = self._kept.pop(folder, None)
            if held is not None:
                held[1].close()

    def close(self) -> None:
        """Close all stores."""
        for folder in list(self._kept):
            self.forget(folder)
