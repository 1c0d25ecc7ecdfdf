"""Folders that tests read: the repository, the tests' data, real data beside the checkout."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT / "tests" / "data"
DEMO = ROOT / "demo" / "caliterra"
SHARED = ROOT.parent / "shared" / "data"  # optional: tests that need it skip by name
FULL_DISK = Path("/sys/kernel")
"""A folder of a file system without any room."""


def demo_stretch(laps: int = 0) -> Path:
    """A folder with 16 of the demo's stills in a row, IMG_9364 to IMG_9379; or with so many laps of
    them, there and back, by number."""
    return Path(_stretch(laps).name)


@cache
def _stretch(laps: int) -> tempfile.TemporaryDirectory[str]:
    folder = tempfile.TemporaryDirectory()
    stills = sorted((DEMO / "frames").glob("IMG_93[67]?.jpg"))
    lap = [*stills, *stills[-2:0:-1]]
    for k, still in enumerate(lap * laps or stills):
        (Path(folder.name) / (f"{k:04d}.jpg" if laps else still.name)).symlink_to(still)
    return folder
