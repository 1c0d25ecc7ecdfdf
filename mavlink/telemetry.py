"""Telemetry messages out of packets that are checked already; the rest is pymavlink's to decode.

Hundreds of them come every second, and most of what a general decoder does with them (the
checksum, the header, the message's own bytes) has been done or is not asked for.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from mavlink.framing import MAGIC_V2, Packet
from mavlink.wire import dialect, numbers_of


class Telemetry:
    """A message with pymavlink's names for its fields."""

    __slots__ = ("__dict__", "_name", "_packet")

    def __init__(self, name: str, packet: Packet, fields: dict[str, Any]) -> None:
        self._name, self._packet = name, packet
        self.__dict__ = fields

    def __getattr__(self, name: str) -> Any:
        """Fields are found before this is asked."""
        raise AttributeError(f"{self._name} has no field {name}")

    def get_type(self) -> str:
        """The message's name."""
        return self._name

    def get_srcSystem(self) -> int:
        """The system that sent it."""
        return self._packet.system

    def get_srcComponent(self) -> int:
        """The component that sent it."""
        return self._packet.component


@dataclass(frozen=True, slots=True)
class _Plan:
    """How a payload is read: numbers in the order of the wire, some of them arrays."""

    name: str
    unpack: Any
    size: int
    fields: tuple[str, ...]
    arrays: tuple[tuple[int, int], ...]  # where in the fields, how long

    def read(self, payload: bytes) -> dict[str, Any]:
        """Fields of a payload; zeros at its end may have been cut, newer fields are left out."""
        if len(payload) != self.size:
            payload = payload[: self.size].ljust(self.size, b"\0")
        values = list(self.unpack(payload))
        for at, length in self.arrays:
            values[at : at + length] = [values[at : at + length]]
        return dict(zip(self.fields, values, strict=True))


class TelemetryDecoder:
    """Reads the messages of some names."""

    def __init__(self, names: Iterable[str]) -> None:
        """The messages must be of numbers alone, without texts."""
        self._plans = {number: _plan(dialect.mavlink_map[number]) for number in numbers_of(names)}

    def message(self, packet: Packet) -> Telemetry | None:
        """The message in a packet with a right checksum; None when it is none of them."""
        plan = self._plans.get(packet.message_id)
        if plan is None:
            return None
        data = packet.data
        start = 10 if data[0] == MAGIC_V2 else 6
        return Telemetry(plan.name, packet, plan.read(data[start : start + data[1]]))


def _plan(kind: Any) -> _Plan:
    arrays = tuple((at, n) for at, n in enumerate(kind.array_lengths) if n)
    fields = tuple(kind.ordered_fieldnames)
    return _Plan(kind.msgname, kind.unpacker.unpack, kind.unpacker.size, fields, arrays)
