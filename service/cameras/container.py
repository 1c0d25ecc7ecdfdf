"""Opens recordings and streams whose tags may hold any bytes."""

from __future__ import annotations

from typing import Any

LENIENT_SINCE = 19
"""The version of PyAV from which tags that are not UTF-8 are read without being asked for it."""


def open_container(source: Any, **options: Any) -> Any:
    """``av.open`` for reading; tags that are not UTF-8 raise nothing."""
    import av

    if int(av.__version__.partition(".")[0]) < LENIENT_SINCE:
        options["metadata_errors"] = "replace"
    return av.open(source, **options)
