"""Messages of an autopilot, packed by pymavlink."""

from __future__ import annotations

from typing import Any

from mavlink.wire.dialect import dialect

AUTOPILOT = (1, 1)


def packed(message: Any, source: tuple[int, int] = AUTOPILOT, seq: int = 0) -> bytes:
    """A MAVLink 2 packet of ``message``, as pymavlink writes it."""
    mouth = dialect.MAVLink(None, *source)
    mouth.seq = seq
    return bytes(message.pack(mouth))


def beat(system: int = 1, token: int = 0, autopilot: int = 3, armed: bool = False) -> Any:
    """A heartbeat of a quadrotor; ``token`` is its custom mode."""
    return dialect.MAVLink_heartbeat_message(2, autopilot, 128 if armed else 0, token, 4, 3)


def attitude(boot_ms: int, roll: float = 0.0) -> Any:
    """ATTITUDE with a roll in radians, at rest."""
    return dialect.MAVLink_attitude_message(boot_ms, roll, 0.0, 0.0, 0, 0, 0)
