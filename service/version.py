"""Name and version of this software."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def software() -> str:
    try:
        return f"skyrelief {version('skyrelief')}"
    except PackageNotFoundError:
        return "skyrelief (not installed)"
