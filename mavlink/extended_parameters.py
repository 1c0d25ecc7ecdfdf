"""PARAM_EXT_* on the camera: the same values as PARAM_* on the onboard computer.

Ground stations use this protocol for the settings in a camera definition. Values travel as
the 4 bytes of a REAL32 in a field of 128.
"""

from __future__ import annotations

import struct
from typing import Any

from mavlink.control import Answer, Result
from mavlink.messages import CAMERA, Outbox
from mavlink.parameters import REAL32, Parameters, text_of
from mavlink.wire import dialect

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
