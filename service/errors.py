"""The failures that the service reports, each with its exit code (see docs/commands.md)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from service.redaction import without_credentials


class SkyreliefError(Exception):
    """A failure that a person can act on; its text is one line: what, where, what to do. The text
    is published (status, MAVLink, scan.json, logs), so credentials in it are hidden."""

    exit_code = 1

    def __init__(self, text: str = "", report: Mapping[str, Any] | None = None) -> None:
        """``report`` is what was done all the same, for --json."""
        super().__init__(without_credentials(text))
        self.report = dict(report or {})  # failures come from other processes, pickled


class InputError(SkyreliefError):
    """Wrong usage, configuration or input: the caller can fix it."""

    exit_code = 2


class MissingError(InputError):
    """What was asked for is not there."""


@contextmanager
def refusing(what: str) -> Iterator[None]:
    """Make a ValueError of the block, which refuses what was given, an InputError of ``what``."""
    try:
        yield
    except ValueError as error:
        raise InputError(f"{what}: {error}") from error


class OutsideError(SkyreliefError):
    """The environment failed: camera, link, disk, a missing optional package."""

    exit_code = 3


@contextmanager
def outside(what: str, remedy: str = "") -> Iterator[None]:
    """Make an OSError of the block an OutsideError of ``what`` has failed."""
    try:
        yield
    except OSError as error:
        text = f"{what} ({error.strerror or error})"
        raise OutsideError(f"{text}; {remedy}" if remedy else text) from error


class NoSenderError(OutsideError):
    """Nothing has come yet at a camera source that waits to be sent images."""
