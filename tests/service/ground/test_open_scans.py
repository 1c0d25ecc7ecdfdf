"""Stores that stay open for the views asked for last."""

from __future__ import annotations

from pathlib import Path

import pytest

from service.errors import InputError
from service.ground.state import OpenScans
from service.stream.records import ScanHeader
from service.stream.store import ScanStore


class Count:
    """Counts its refreshes; the second fails."""

    def __init__(self, store: ScanStore) -> None:
        self.store, self.refreshed = store, 0

    def refresh(self) -> None:
        self.refreshed += 1
        if self.refreshed == 2:
            raise OSError("the card is away")


def folders(tmp_path: Path, count: int) -> list[Path]:
    out = [tmp_path / str(k) for k in range(count)]
    for folder in out:
        ScanStore.create(folder / "scan.db", ScanHeader("s", "d", 1)).close()
    return out


def is_closed(store: ScanStore) -> bool:
    try:
        store.seqs()
    except Exception:
        return True
    return False


def test_the_scan_asked_for_longest_ago_is_closed(tmp_path: Path) -> None:
    a, b, c = folders(tmp_path, 3)
    held = OpenScans(Count, min_age_s=1e9, max_scans=2)
    first, second = held.view(a), held.view(b)
    assert held.view(a) is first  # and now b is the older
    held.view(c)
    assert is_closed(second.store) and not is_closed(first.store)
    assert held.view(a) is first and first.refreshed == 1
    held.close()
    assert is_closed(first.store)


def test_a_refresh_that_fails_is_tried_again(tmp_path: Path) -> None:
    (folder,) = folders(tmp_path, 1)
    held = OpenScans(Count, min_age_s=0.0, max_scans=2)
    view = held.view(folder)
    with pytest.raises(OSError, match="away"):
        held.view(folder)
    assert held.view(folder) is view and view.refreshed == 3
    held.close()


@pytest.mark.parametrize("fault", [InputError("no place"), ValueError("damaged")])
def test_a_store_whose_view_cannot_be_made_is_closed(tmp_path: Path, fault: Exception) -> None:
    (folder,) = folders(tmp_path, 1)
    seen: list[ScanStore] = []

    def refused(store: ScanStore) -> Count:
        seen.append(store)
        raise fault

    held = OpenScans(refused, min_age_s=0.0, max_scans=2)
    with pytest.raises(type(fault)):
        held.view(folder)
    assert is_closed(seen[0])
