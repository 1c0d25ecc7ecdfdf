"""A drone's share of the disk and the reserve of all, to the byte."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from service.errors import OutsideError
from service.ground.storage import DiskShare, DroneLimits, folder_bytes


def test_share_and_reserve_hold_to_the_byte(tmp_path: Path) -> None:
    def share_of(name: str, share: float, reserve_bytes: int | None) -> DiskShare:
        limits = DroneLimits(
            drone_share=share, reserve_bytes=reserve_bytes, usage=lambda _: (10_000, 7_000, 3_000)
        )
        return DiskShare(tmp_path / name, limits)

    (tmp_path / "red" / "scan").mkdir(parents=True)
    (tmp_path / "red" / "scan" / "scan.db").write_bytes(bytes(4_000))
    (tmp_path / "red" / "link").symlink_to("/etc/passwd")
    link_bytes = len(os.readlink(tmp_path / "red" / "link"))
    assert folder_bytes(tmp_path / "red") == 4_000 + link_bytes
    share = share_of("red", 0.5, 500)
    share.check(900 - link_bytes, now=0.0)
    share.check(100, now=0.0)  # 5000 of 5000
    with pytest.raises(OutsideError, match="share"):
        share.check(1, now=0.0)
    other = share_of("blue", 1.0, 500)
    other.check(2_500, now=0.0)  # 500 of 500 stay free
    with pytest.raises(OutsideError, match="reserve"):
        other.check(1, now=0.5)
    other.check(1, now=1.5)  # the disk was measured again: somebody else freed some
    by_default = share_of("green", 1.0, None)
    by_default.check(2_500, now=0.0)  # 5 % of the disk
    with pytest.raises(OutsideError):
        by_default.check(1, now=0.0)
