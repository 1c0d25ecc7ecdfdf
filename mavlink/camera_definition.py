"""The camera definition: what makes a ground station show our parameters as camera settings."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from xml.sax.saxutils import escape, quoteattr

from mavlink.ftp import file_uri
from mavlink.messages import CAMERA
from mavlink.parameters import Parameter

FILE = "camera.xml"
URI = file_uri(CAMERA, FILE)


def camera_definition(vendor: str, model: str, table: Sequence[Parameter]) -> bytes:
    """The XML of a camera with these parameters; its version is :func:`definition_version`."""
    body = "".join(_parameter(parameter) for parameter in table)
    version = definition_version(table)
    return (
        '<?xml version="1.0" encoding="UTF-8" ?>\n<mavlinkcamera>\n'
        f'  <definition version="{version}">\n'
        f"    <model>{escape(model)}</model>\n    <vendor>{escape(vendor)}</vendor>\n"
        "  </definition>\n  <parameters>\n"
        f"{body}  </parameters>\n</mavlinkcamera>\n"
    ).encode()


def definition_version(table: Sequence[Parameter]) -> int:
    """1 to 65535, another one whenever the parameters change: ground stations keep the file."""
    body = "".join(_parameter(parameter) for parameter in table)
    return zlib.crc32(body.encode()) & 0xFFFF or 1


def _parameter(p: Parameter) -> str:
    attributes = f'name={quoteattr(p.name)} type="float" default="{p.default:g}"'
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
