"""Folders that tests read: the repository, the tests' data, real data beside the checkout."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT / "tests" / "data"
DEMO = ROOT / "demo" / "caliterra"
SHARED = ROOT.parent / "shared" / "data"  # optional: tests that need it skip by name
FULL_DISK = Path("/sys/kernel")
"""A folder of a file system without any room."""
