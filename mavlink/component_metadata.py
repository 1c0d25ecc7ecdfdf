"""Names, ranges and units of our parameters for ground stations: COMPONENT_METADATA and its files.

The message gives the address of ``general.json.xz``, which gives that of ``parameters.json.xz``;
both are read over MAVLink FTP. See https://mavlink.io/en/services/component_metadata.html. The
files are made once and do not change while the service runs, as that protocol asks.
"""

from __future__ import annotations

import json
import lzma
import struct
from collections.abc import Sequence
from typing import Any

from mavlink.camera import CameraConfig
from mavlink.ftp import file_crc, file_uri
from mavlink.messages import ONBOARD
from mavlink.parameters import Parameter
from mavlink.wire import dialect

NUMBER, CRC_EXTRA = 397, 182
URI = 100  # bytes
GENERAL, PARAMETERS = "general.json.xz", "parameters.json.xz"
TYPE_PARAMETER = 1  # COMP_METADATA_TYPE
VERSION = 1  # of both formats; ground stations refuse the parameter schema's newer numbers
XZ = [{"id": lzma.FILTER_LZMA2, "preset": 9, "dict_size": 1 << 16}]


class ComponentMetadataMessage(dialect.MAVLink_message):  # type: ignore[misc]
    """COMPONENT_METADATA, which pymavlink's dialects do not have."""

    id, msgname, crc_extra = NUMBER, "COMPONENT_METADATA", CRC_EXTRA
    unpacker = struct.Struct(f"<II{URI}s")

    def __init__(self, time_boot_ms: int, crc: int, uri: str) -> None:
        super().__init__(self.id, self.msgname)
        self._values = (time_boot_ms, crc, uri.encode())

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        """The packet; pymavlink calls this."""
        payload = self.unpacker.pack(*self._values)
        packet: bytes = self._pack(mav, self.crc_extra, payload, force_mavlink1)
        return packet


class ComponentMetadata:
    """The onboard computer's metadata."""

    def __init__(self, camera: CameraConfig, table: Sequence[Parameter]) -> None:
        parameters = _packed(
            {"version": VERSION, "parameters": [_parameter(parameter) for parameter in table]}
        )
        general = _packed(
            {
                "version": VERSION,
                "vendorName": camera.vendor,
                "modelName": camera.model,
                "firmwareVersion": ".".join(map(str, camera.version)),
                "metadataTypes": [
                    {
                        "type": TYPE_PARAMETER,
                        "uri": file_uri(ONBOARD, PARAMETERS),
                        "fileCrc": file_crc(parameters),
                    }
                ],
            }
        )
        self.files = {GENERAL: general, PARAMETERS: parameters}

    def message(self, boot_ms: int) -> ComponentMetadataMessage:
        """Where the general file is, and its checksum."""
        crc = file_crc(self.files[GENERAL])
        return ComponentMetadataMessage(boot_ms, crc, file_uri(ONBOARD, GENERAL))


def _packed(content: object) -> bytes:
    """JSON in XZ with a small dictionary and CRC32, which every embedded reader can unpack."""
    text = json.dumps(content, separators=(",", ":")).encode()
    return lzma.compress(text, check=lzma.CHECK_CRC32, filters=XZ)


def _parameter(p: Parameter) -> dict[str, object]:
    described: dict[str, object] = {
        "name": p.name,
        "type": "Float",
        "shortDesc": p.text,
        "default": p.default,
        "min": p.low,
        "max": p.high,
        "group": "skyrelief",
    }
    if p.unit:
        described["units"] = p.unit
    if p.options:
        named = [{"value": k, "description": name} for k, name in enumerate(p.options)]
        return described | {"decimalPlaces": 0, "increment": 1, "values": named}
    return described | {"decimalPlaces": 2, "increment": p.step}
