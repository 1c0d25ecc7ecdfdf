"""The failures that the service reports, and the exit code of each (README, "Exit codes")."""

from __future__ import annotations


class SkyreliefError(Exception):
    """A failure that a person can act on; its text is one line: what, where, what to do."""

    exit_code = 1


class InputError(SkyreliefError):
    """Wrong usage, configuration or input: the caller can put it right."""

    exit_code = 2


class OutsideError(SkyreliefError):
    """A part of the outside world failed: camera, link, disk, a missing optional package."""

    exit_code = 3
