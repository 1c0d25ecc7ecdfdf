"""What drones, scans and stations may be called, and the keys that are made of it."""

from __future__ import annotations

import re

from service.errors import InputError

ROOT = "skyrelief"
"""All keys are ``skyrelief/<drone>/<scan>/<topic>``."""

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
"""What a drone, scan or station may be called."""


def check_name(name: str, what: str) -> str:
    """``name`` if it may be part of a key; raises InputError when not."""
    if not NAME.fullmatch(name):
        raise InputError(
            f"{what} {name!r} cannot travel on the datalink; "
            "use at most 64 letters, digits, dots, dashes and underscores"
        )
    return name
