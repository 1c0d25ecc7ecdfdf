"""Values that an operator tunes in flight: PARAM_* (onboard computer), PARAM_EXT_* (camera).

Both give the same values. All are REAL32: ArduPilot and PX4 encode other types differently.
Ground stations use PARAM_EXT_* for the settings in a camera definition; it carries the 4 bytes of
a REAL32 in a field of 128.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from mavlink.component.control import Answer, Result
from mavlink.telemetry.gimbal import YAW_FRAMES
from mavlink.wire.dialect import dialect
from mavlink.wire.first_beat import CAMERA, ONBOARD
from mavlink.wire.messages import SendQueue

REAL32 = 9  # MAV_PARAM_TYPE
EXTENDED_VALUE = 128  # bytes
ACK_ACCEPTED, ACK_UNSUPPORTED, ACK_FAILED = 0, 1, 2
YAW_FRAME = "SR_YAW_FRAME"


@dataclass(frozen=True, slots=True)
class Parameter:
    name: str  # at most 16 characters
    default: float
    low: float
    high: float
    text: str
    options: tuple[str, ...] = ()  # names of the values 0, 1, 2 ...
    unit: str = ""
    step: float = 1.0  # step of a ground station's slider

    def __post_init__(self) -> None:
        if not 1 <= len(self.name) <= 16 or not self.name.isascii():
            raise ValueError(f"parameter name {self.name!r} must have 1 to 16 ASCII characters")
        if not self.low <= self.default <= self.high:
            raise ValueError(f"parameter {self.name}: default {self.default} is out of range")

    @property
    def is_constant(self) -> bool:
        """True for a value that only describes us."""
        return self.low == self.high

    def accepts(self, value: float) -> bool:
        """True for a value in range; only whole numbers where values have names."""
        if not math.isfinite(value) or not self.low <= value <= self.high:
            return False
        return not self.options or value == round(value)


PARAMETERS: tuple[Parameter, ...] = (
    Parameter("SR_BASELINE_M", 0.0, 0.0, 200.0, "Stereo baseline, 0 automatic", (), "m", 0.5),
    Parameter("SR_RESOLUTION_M", 0.0, 0.0, 5.0, "Map resolution, 0 automatic", (), "m", 0.01),
    Parameter("SR_LINK_KBIT_S", 1000.0, 1.0, 100_000.0, "Datalink budget", (), "kbit/s", 10.0),
    Parameter(YAW_FRAME, 0.0, 0.0, len(YAW_FRAMES) - 1.0, "Gimbal yaw frame", options=YAW_FRAMES),
    Parameter("SR_CAM_LATENCY", 0.0, -500.0, 2000.0, "Camera latency", (), "ms", 5.0),
    Parameter("SR_CAM_LAT_AUTO", 0.0, 0.0, 1.0, "Apply measured latency", ("off", "on")),
    Parameter("CAM_MODE", 1.0, 1.0, 1.0, "Camera mode", ("photo", "video")),  # clients expect it
)
"""A new parameter is one line here and, unless it is constant, one in the service's table."""


def with_defaults(values: Mapping[str, float]) -> tuple[Parameter, ...]:
    """The table with other defaults; defaults out of range are ignored."""
    return tuple(
        replace(p, default=values[p.name]) if p.accepts(values.get(p.name, math.nan)) else p
        for p in PARAMETERS
    )


class Parameters:
    """Values of parameters, and the protocols to read and set them."""

    def __init__(
        self,
        outbox: SendQueue,
        on_change: Callable[[str, float], Answer],
        kept: Mapping[str, float] | None = None,
        table: Sequence[Parameter] = PARAMETERS,
    ) -> None:
        self._outbox = outbox
        self._on_change = on_change
        self._table = {p.name: p for p in table}
        self._values = {p.name: _real32(p.default) for p in table}
        self.revision = 0  # increases with every change, so that the owner knows when to save
        for name, value in (kept or {}).items():
            if name in self._table and self._table[name].accepts(value):
                self._values[name] = _real32(value)

    @property
    def table(self) -> tuple[Parameter, ...]:
        return tuple(self._table.values())

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def values(self) -> dict[str, float]:
        return dict(self._values)

    def kept(self) -> dict[str, float]:
        """The values that differ from their defaults, by name."""
        defaults = {p.name: _real32(p.default) for p in self.table}
        return {name: v for name, v in self._values.items() if v != defaults[name]}

    def forget(self, name: str) -> None:
        """Reset a value that the service no longer accepts to its default."""
        self._values[name] = _real32(self._table[name].default)

    def adopt(self, values: Mapping[str, float]) -> None:
        """Replace the defaults, and publish the new values."""
        for name, value in values.items():
            if self._table[name].accepts(value):
                self._table[name] = replace(self._table[name], default=value)
                self._take(name, value)

    def change(self, name: str, value: float) -> Answer:
        """Set a value, unless it is out of range or the service refuses it."""
        parameter = self._table.get(name)
        if parameter is None:
            return Answer(Result.DENIED, f"no parameter {name}")
        if not parameter.accepts(value):
            span = f"{parameter.low:g} to {parameter.high:g}"
            return Answer(Result.DENIED, f"{name} refused: {value:g} is not {span}")
        answer = Answer() if parameter.is_constant else self._on_change(name, value)
        if answer.result is Result.ACCEPTED and self._values[name] != _real32(value):
            self._take(name, value)
        return answer

    def _take(self, name: str, value: float) -> None:
        self._values[name] = _real32(value)
        self.revision += 1
        self._send(name)

    def reset(self) -> None:
        for parameter in self.table:
            self.change(parameter.name, parameter.default)

    def receive(self, message: Any) -> Answer | None:
        """Handle a PARAM_* or PARAM_EXT_* message addressed to our component. Returns the
        operator's answer for a message that sets a value, None for the rest."""
        kind, names = message.get_type(), list(self._table)
        send = partial(self._send, is_extended=kind.startswith("PARAM_EXT_"))
        if kind.endswith("_REQUEST_LIST"):
            for name in names:
                send(name)
        elif kind.endswith("_REQUEST_READ"):
            i = int(message.param_index)
            name = _text(message.param_id) if i < 0 else "".join(names[i : i + 1])
            if name in self._table:
                send(name)
        elif kind == "PARAM_SET":
            return self._set(message)
        elif kind == "PARAM_EXT_SET":
            return self._set_extended(message)
        return None

    def _set(self, message: Any) -> Answer:
        name, before = _text(message.param_id), self.revision
        answer = self.change(name, message.param_value)
        if self.revision == before and name in self._table:
            self._send(name)  # reports the value in force
        return answer

    def _set_extended(self, message: Any) -> Answer:
        name = _text(message.param_id)
        if name not in self._table or message.param_type != REAL32:
            self._acknowledge(name, 0.0, ACK_UNSUPPORTED)
            is_known = name in self._table
            text = f"{name} refused: send it as REAL32" if is_known else f"no parameter {name}"
            return Answer(Result.DENIED, text)
        raw: bytes = message._param_value_raw  # pymavlink drops its trailing zeros
        answer = self.change(name, struct.unpack("<f", raw.ljust(4, b"\0")[:4])[0])
        accepted = answer.result is Result.ACCEPTED
        self._acknowledge(name, self[name], ACK_ACCEPTED if accepted else ACK_FAILED)
        return answer

    def _send(self, name: str, is_extended: bool = False) -> None:
        value, place = self[name], (REAL32, len(self._table), list(self._table).index(name))
        if is_extended:
            packed = _packed(value)
            message = dialect.MAVLink_param_ext_value_message(name.encode(), packed, *place)
        else:
            message = dialect.MAVLink_param_value_message(name.encode(), value, *place)
        self._outbox.put(CAMERA if is_extended else ONBOARD, message)

    def _acknowledge(self, name: str, value: float, result: int) -> None:
        raw = name.encode("ascii", "replace")[:16]
        message = dialect.MAVLink_param_ext_ack_message(raw, _packed(value), REAL32, result)
        self._outbox.put(CAMERA, message)


def _real32(value: float) -> float:
    rounded: float = struct.unpack("<f", struct.pack("<f", value))[0]
    return rounded


def _packed(value: float) -> bytes:
    return struct.pack("<f", value).ljust(EXTENDED_VALUE, b"\0")


def _text(raw: str | bytes) -> str:
    """A parameter's name as received, cut at the first zero."""
    text = raw.decode("ascii", "replace") if isinstance(raw, bytes) else raw
    return text.partition("\0")[0]
