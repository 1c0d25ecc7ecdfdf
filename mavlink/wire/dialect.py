"""The dialect: all messages of ``common`` and ArduPilot's own, from pymavlink.

pymavlink has no type annotations; this module imports it untyped.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega  # type: ignore[import-untyped]
from pymavlink.generator import mavcrc  # type: ignore[import-untyped]

dialect: Any = ardupilotmega
"""Message classes, enums as module constants, ``mavlink_map`` from number to class."""

x25crc: Any = mavcrc.x25crc  # CRC-16/MCRF4XX; compiled when fastcrc is installed

COMMAND_CANCEL = 80

CRC_EXTRA: dict[int, int] = {n: kind.crc_extra for n, kind in dialect.mavlink_map.items()}
"""Message number to the byte that its checksum ends with."""
CRC_EXTRA.setdefault(COMMAND_CANCEL, 14)  # of common.xml; pymavlink's dialect lacks it


def numbers_of(names: Iterable[str]) -> frozenset[int]:
    wanted = set(names)
    return frozenset(n for n, kind in dialect.mavlink_map.items() if kind.msgname in wanted)
