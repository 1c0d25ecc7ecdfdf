"""Files that describe our parameters to ground stations, read over MAVLink FTP.

COMPONENT_METADATA gives the address of ``general.json.xz``, which gives that of
``parameters.json.xz`` (https://mavlink.io/en/services/component_metadata.html). The protocol
requires that they stay constant while the service runs. The camera definition shows the same
parameters as camera settings.
"""

from __future__ import annotations

import json
import lzma
import struct
import zlib
from collections.abc import Sequence
from typing import Any
from xml.sax.saxutils import escape, quoteattr

from mavlink.component.ftp import file_crc, file_uri
from mavlink.component.parameters import Parameter
from mavlink.wire.dialect import dialect
from mavlink.wire.first_beat import CAMERA, ONBOARD

VENDOR, MODEL, VERSION = "skyrelief", "3D scan", (0, 1, 0)
DEFINITION = "camera.xml"
DEFINITION_URI = file_uri(CAMERA, DEFINITION)
NUMBER, CRC_EXTRA = 397, 182
URI = 100  # bytes
GENERAL, PARAMETERS = "general.json.xz", "parameters.json.xz"
TYPE_PARAMETER = 1  # COMP_METADATA_TYPE
FORMAT = 1  # version of both formats; ground stations refuse newer versions of the parameter schema
XZ = [{"id": lzma.FILTER_LZMA2, "preset": 9, "dict_size": 1 << 16}]


class ComponentMetadataMessage(dialect.MAVLink_message):  # type: ignore[misc]
    """COMPONENT_METADATA, which pymavlink's dialects do not have."""

    id, msgname, crc_extra = NUMBER, "COMPONENT_METADATA", CRC_EXTRA
    unpacker = struct.Struct(f"<II{URI}s")

    def __init__(self, time_boot_ms: int, general: bytes) -> None:
        """``general`` is the content of the file ``GENERAL``."""
        super().__init__(self.id, self.msgname)
        self._values = (time_boot_ms, file_crc(general), file_uri(ONBOARD, GENERAL).encode())

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        """The packet; pymavlink calls this."""
        payload = self.unpacker.pack(*self._values)
        packet: bytes = self._pack(mav, self.crc_extra, payload, force_mavlink1)
        return packet


def metadata_files(table: Sequence[Parameter]) -> dict[str, bytes]:
    """By name; :class:`ComponentMetadataMessage` gives the address of ``GENERAL``."""
    parameters = _packed({"version": FORMAT, "parameters": [_parameter(p) for p in table]})
    described = {
        "type": TYPE_PARAMETER,
        "uri": file_uri(ONBOARD, PARAMETERS),
        "fileCrc": file_crc(parameters),
    }
    general = {
        "version": FORMAT,
        "vendorName": VENDOR,
        "modelName": MODEL,
        "firmwareVersion": ".".join(map(str, VERSION)),
        "metadataTypes": [described],
    }
    return {GENERAL: _packed(general), PARAMETERS: parameters}


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


def camera_definition(vendor: str, model: str, table: Sequence[Parameter]) -> tuple[int, bytes]:
    """Version and XML of a camera with these parameters. The version, 1 to 65535, changes with the
    parameters, because ground stations cache the file."""
    body = "".join(map(_described, table))
    version = zlib.crc32(body.encode()) & 0xFFFF or 1
    return version, (
        '<?xml version="1.0" encoding="UTF-8" ?>\n<mavlinkcamera>\n'
        f'  <definition version="{version}">\n'
        f"    <model>{escape(model)}</model>\n    <vendor>{escape(vendor)}</vendor>\n"
        "  </definition>\n  <parameters>\n"
        f"{body}  </parameters>\n</mavlinkcamera>\n"
    ).encode()


def _described(p: Parameter) -> str:
    attributes = f'name={quoteattr(p.name)} type="float" default="{p.default:g}"'
    if p.is_constant:
        attributes += ' readonly="1" control="0"'
    if not p.options:
        attributes += f' min="{p.low:g}" max="{p.high:g}" step="{p.step:g}"'
        if p.unit:
            attributes += f" unit={quoteattr(p.unit)}"
    lines = [f"    <parameter {attributes}>", f"      <description>{escape(p.text)}</description>"]
    if p.options:
        lines.append("      <options>")
        lines += [
            f'        <option name={quoteattr(name)} value="{k}" />'
            for k, name in enumerate(p.options)
        ]
        lines.append("      </options>")
    return "\n".join([*lines, "    </parameter>\n"])
