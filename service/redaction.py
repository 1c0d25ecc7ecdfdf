"""Removes secrets from everything that leaves the process: scans, status, logs, reports, errors.

One list of secret configuration keys, and patterns for credentials in addresses and pipelines:
``rtsp://user:secret@host``, ``…?pwd=secret``, ``user-pw=secret``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

HIDDEN = "***"  # replaces a secret

SECRET_KEYS = frozenset({"mavlink.signing_key", "datalink.tls_key"})
"""Configuration keys whose whole value is secret, as ``section.key``."""

_USER = re.compile(
    r"(?<=://)(?:"
    r"[^\s/?#]{0,512}"  # RFC 3986: user information ends at the last @ before the path
    r"|[^\s/@:]{0,256}:(?!\d{1,5}(?:[/?#\s]|$))\S{0,512}"  # a password with a slash in it
    r")@"
)
_NAMED = re.compile(
    r"((?:passw(?:or)?d|passphrase|loginpas|secret|token|api_?key|private_key\w{0,20}"
    r"|(?<![a-z])(?:pass|pwd?|psk|auth))\s{0,3}=\s{0,3})"
    r"(\"[^\"]*\"|'[^']*'|[^\s&;!,\"']+)",
    re.IGNORECASE,
)


def without_credentials(text: str) -> str:
    """``text`` with the credentials of its addresses and pipelines hidden."""
    if "://" in text:
        text = _USER.sub(f"{HIDDEN}@", text)
    return _NAMED.sub(rf"\1{HIDDEN}", text) if "=" in text else text


def redacted(value: Any) -> Any:
    """``value`` with credentials hidden in every text of its dicts, lists and tuples."""
    if isinstance(value, str):
        return without_credentials(value)
    if isinstance(value, Mapping):
        return {name: redacted(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(redacted(item) for item in value)
    return value


def public_configuration(configuration: Mapping[str, Any]) -> dict[str, Any]:
    """Sections of a configuration without secrets."""
    return {
        section: {
            name: HIDDEN if value and f"{section}.{name}" in SECRET_KEYS else redacted(value)
            for name, value in values.items()
        }
        if isinstance(values, Mapping)
        else redacted(values)
        for section, values in configuration.items()
    }
