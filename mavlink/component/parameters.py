"""What an operator tunes in flight: PARAM_* on the onboard computer, PARAM_EXT_* on the camera.

Both show the same values. All are REAL32: ArduPilot and PX4 encode other types differently.
Ground stations use PARAM_EXT_* for the settings in a camera definition; there the 4 bytes of a
REAL32 travel in a field of 128.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from mavlink.component.control import Answer, Result
from mavlink.telemetry.gimbal import YAW_FRAMES
from mavlink.wire.dialect import dialect
from mavlink.wire.first_beat import CAMERA, ONBOARD
from mavlink.wire.messages import Outbox

REAL32 = 9  # MAV_PARAM_TYPE
YAW_FRAME = "SR_YAW_FRAME"


@dataclass(frozen=True, slots=True)
class Parameter:
    """One tunable value."""

    name: str  # at most 16 characters
    default: float
    low: float
    high: float
    text: str
    options: tuple[str, ...] = ()  # names of the values 0, 1, 2 ...
    unit: str = ""
    step: float = 1.0  # of a ground station's slider

    def __post_init__(self) -> None:
        if not 1 <= len(self.name) <= 16 or not self.name.isascii():
            raise ValueError(f"parameter name {self.name!r} must have 1 to 16 ASCII characters")
        if not self.low <= self.default <= self.high:
            raise ValueError(f"parameter {self.name}: default {self.default} is out of range")

    def accepts(self, value: float) -> bool:
        """True for a value in range; whole numbers only where values have names."""
        if not math.isfinite(value) or not self.low <= value <= self.high:
            return False
        return not self.options or value == round(value)


PARAMETERS: tuple[Parameter, ...] = (
    Parameter("SR_BASELINE_M", 0.0, 0.0, 200.0, "Stereo baseline, 0 automatic", (), "m", 0.5),
    Parameter("SR_RESOLUTION_M", 0.0, 0.0, 5.0, "Map resolution, 0 automatic", (), "m", 0.01),
    Parameter("SR_LINK_KBIT_S", 1000.0, 1.0, 100_000.0, "Datalink budget", (), "kbit/s", 10.0),
    Parameter(YAW_FRAME, 0.0, 0.0, len(YAW_FRAMES) - 1.0, "Gimbal yaw frame", options=YAW_FRAMES),
    Parameter("SR_CAM_LATENCY", 0.0, -500.0, 2000.0, "Camera latency", (), "ms", 5.0),
    Parameter("SR_CAM_LAT_AUTO", 0.0, 0.0, 1.0, "Apply the latency found", ("off", "on")),
)
"""The next parameter is one line here and one in the service's table."""


def with_defaults(values: Mapping[str, float]) -> tuple[Parameter, ...]:
    """The table with other defaults; those out of range are left as they are."""
    return tuple(
        replace(p, default=values[p.name]) if p.accepts(values.get(p.name, math.nan)) else p
        for p in PARAMETERS
    )


class Parameters:
    """Values of parameters, and the protocol to read and set them."""

    def __init__(
        self,
        outbox: Outbox,
        on_change: Callable[[str, float], Answer],
        kept: Mapping[str, float] | None = None,
        table: Sequence[Parameter] = PARAMETERS,
    ) -> None:
        self._outbox = outbox
        self._on_change = on_change
        self.table = tuple(table)
        self._index = {p.name: i for i, p in enumerate(self.table)}
        self._values = [_real32(p.default) for p in self.table]
        self.revision = 0  # grows with every change, so that a keeper knows when to save
        for name, value in (kept or {}).items():
            i = self._index.get(name)
            if i is not None and self.table[i].accepts(value):
                self._values[i] = _real32(value)

    def __getitem__(self, name: str) -> float:
        return self._values[self._index[name]]

    def values(self) -> dict[str, float]:
        """Every value by name."""
        return {p.name: v for p, v in zip(self.table, self._values, strict=True)}

    def kept(self) -> dict[str, float]:
        """The values that differ from their defaults, by name."""
        pairs = zip(self.table, self._values, strict=True)
        return {p.name: v for p, v in pairs if v != _real32(p.default)}

    def forget(self, name: str) -> None:
        """Put a value that the service no longer takes back to its default."""
        i = self._index[name]
        self._values[i] = _real32(self.table[i].default)

    def adopt(self, values: Mapping[str, float]) -> None:
        """Take other defaults, which hold from now on, and show them."""
        table = list(self.table)
        for name, value in values.items():
            i = self._index[name]
            if table[i].accepts(value):
                table[i] = replace(table[i], default=value)
                self._values[i] = _real32(value)
                self.revision += 1
                self._send(i)
        self.table = tuple(table)

    def change(self, name: str, value: float) -> Answer:
        """Set a value, unless it is out of range or the service refuses it."""
        i = self._index.get(name)
        if i is None:
            return Answer(Result.DENIED, f"no parameter {name}")
        parameter = self.table[i]
        if not parameter.accepts(value):
            span = f"{parameter.low:g} to {parameter.high:g}"
            return Answer(Result.DENIED, f"{name} refused: {value:g} is not {span}")
        answer = self._on_change(name, value)
        if answer.result is Result.ACCEPTED and self._values[i] != _real32(value):
            self._values[i] = _real32(value)
            self.revision += 1
            self._send(i)
        return answer

    def reset(self) -> None:
        """Every value back to its default."""
        for parameter in self.table:
            self.change(parameter.name, parameter.default)

    def receive(self, message: Any) -> Answer | None:
        """Serve a PARAM_* message that is meant for the onboard computer.

        The answer of a PARAM_SET, for the operator; None for the rest.
        """
        kind = message.get_type()
        if kind == "PARAM_REQUEST_LIST":
            for i in range(len(self.table)):
                self._send(i)
        elif kind == "PARAM_REQUEST_READ":
            i = int(message.param_index)
            i = self._index.get(text_of(message.param_id), -1) if i < 0 else i
            if 0 <= i < len(self.table):
                self._send(i)
        elif kind == "PARAM_SET":
            name = text_of(message.param_id)
            before = self.revision
            answer = self.change(name, message.param_value)
            if self.revision == before and name in self._index:
                self._send(self._index[name])  # tells the asker what stands
            return answer
        return None

    def _send(self, i: int) -> None:
        name = self.table[i].name.encode()
        count = len(self.table)
        message = dialect.MAVLink_param_value_message(name, self._values[i], REAL32, count, i)
        self._outbox.put(ONBOARD, message)


def _real32(value: float) -> float:
    rounded: float = struct.unpack("<f", struct.pack("<f", value))[0]
    return rounded


def text_of(raw: str | bytes) -> str:
    """A parameter's name as it came, without what follows a zero."""
    text = raw.decode("ascii", "replace") if isinstance(raw, bytes) else raw
    return text.partition("\0")[0]


VALUE = 128
ACK_ACCEPTED, ACK_UNSUPPORTED, ACK_FAILED = 0, 1, 2


class ExtendedParameters:
    """The protocol's answers."""

    def __init__(self, parameters: Parameters, outbox: Outbox) -> None:
        self._parameters = parameters
        self._outbox = outbox

    def receive(self, message: Any) -> Answer | None:
        """Serve a PARAM_EXT_* message; the answer of a SET, for the operator."""
        kind = message.get_type()
        names = [parameter.name for parameter in self._parameters.table]
        if kind == "PARAM_EXT_REQUEST_LIST":
            for i in range(len(names)):
                self._send(i)
        elif kind == "PARAM_EXT_REQUEST_READ":
            i = int(message.param_index)
            if i < 0:
                name = text_of(message.param_id)
                i = names.index(name) if name in names else -1
            if 0 <= i < len(names):
                self._send(i)
        elif kind == "PARAM_EXT_SET":
            return self._set(message, names)
        return None

    def _set(self, message: Any, names: list[str]) -> Answer:
        name = text_of(message.param_id)
        if name not in names or message.param_type != REAL32:
            self._acknowledge(name, 0.0, ACK_UNSUPPORTED)
            return Answer(Result.DENIED, f"no parameter {name}")
        raw = _raw(message)
        answer = self._parameters.change(name, struct.unpack("<f", raw[:4])[0])
        accepted = answer.result is Result.ACCEPTED
        self._acknowledge(name, self._parameters[name], ACK_ACCEPTED if accepted else ACK_FAILED)
        return answer

    def _send(self, i: int) -> None:
        name = self._parameters.table[i].name
        value = _packed(self._parameters[name])
        count = len(self._parameters.table)
        message = dialect.MAVLink_param_ext_value_message(name.encode(), value, REAL32, count, i)
        self._outbox.put(CAMERA, message)

    def _acknowledge(self, name: str, value: float, result: int) -> None:
        raw = name.encode("ascii", "replace")[:16]
        message = dialect.MAVLink_param_ext_ack_message(raw, _packed(value), REAL32, result)
        self._outbox.put(CAMERA, message)


def _packed(value: float) -> bytes:
    return struct.pack("<f", value).ljust(VALUE, b"\0")


def _raw(message: Any) -> bytes:
    """The value's own bytes; pymavlink drops the zeros at their end."""
    value: bytes = message._param_value_raw
    return value.ljust(VALUE, b"\0")
