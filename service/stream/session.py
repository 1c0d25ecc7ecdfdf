"""Zenoh sessions for the datalink: no shared memory, small buffers, TLS, access rights."""

from __future__ import annotations

import json
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.errors import InputError, OutsideError
from service.stream.keys import FLEET, access_control, load_fleet

if TYPE_CHECKING:
    import zenoh

ENDPOINT = re.compile(r"(tcp|udp|tls|quic|ws)/(\[[0-9A-Fa-f:.%]+\]|[^/:#?\s]+):(\d{1,5})([#?].*)?")
_ENCRYPTED = ("tls", "quic")
_LOOPBACK = ("localhost", "[::1]")

SEND_BUFFER_BYTES, SEND_BUFFER_S = 16_384, 0.2
"""Minimum send buffer, and the time in which the budget empties a larger one: the kernel's buffer
must cover a round trip, but urgent messages must not queue behind more."""
BATCH_BYTES = 8_192
LEASE_MS = 8_000
MAX_MESSAGE_BYTES = 1 << 19  # Zenoh drops larger received messages; heads have at most half of it


@dataclass(frozen=True, slots=True)
class SessionConfig:
    """Connection of one end; the TLS files are PEM."""

    mode: str = "client"  # "client" or "router"
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    plain: bool = False  # allow remote endpoints without TLS
    tls_ca: str = ""
    tls_certificate: str = ""
    tls_key: str = ""
    fleet_rights: bool = False  # as a router, enforce the fleet.json next to tls_key
    open_timeout_s: float = 10.0  # of one attempt to reach the other end
    rate_bytes_s: float = 0.0  # our send rate; determines the send buffer


def is_encrypted(endpoint: str) -> bool:
    return endpoint.partition("/")[0] in _ENCRYPTED


def check_endpoints(config: SessionConfig) -> None:
    """Raise InputError for endpoints that are malformed, unencrypted to another machine, or lack
    certificates."""
    for endpoint in (*config.connect, *config.listen):
        match = ENDPOINT.fullmatch(endpoint)
        if match is None:
            raise InputError(f"endpoint {endpoint!r} is not like tls/HOST:7447 or tcp/HOST:7447")
        protocol, host = match[1], match[2]
        local = host in _LOOPBACK or host.startswith("127.")
        if protocol not in _ENCRYPTED and not local and not config.plain:
            raise InputError(
                f"endpoint {endpoint} is not encrypted; make keys with 'skyrelief keys' and use "
                "tls/…, or allow it with datalink.plain=true (ground: --plain)"
            )
        if protocol in _ENCRYPTED:
            _check_files(endpoint, config)


def _check_files(endpoint: str, config: SessionConfig) -> None:
    for what, path in (
        ("certificate authority", config.tls_ca),
        ("certificate", config.tls_certificate),
        ("private key", config.tls_key),
    ):
        if not path:
            raise InputError(f"endpoint {endpoint} needs a {what}; make one with 'skyrelief keys'")
        if not os.path.isfile(path):
            raise InputError(f"{what} {path} does not exist; make one with 'skyrelief keys'")
        if not os.access(path, os.R_OK):
            raise InputError(f"{what} {path} is not this user's to read; chown it to the service's")


def open_session(config: SessionConfig) -> zenoh.Session:
    """A new session; raises InputError for its settings, OutsideError when it cannot open."""
    import zenoh

    check_endpoints(config)
    settings = zenoh_config(config)
    try:
        return zenoh.open(settings)
    except zenoh.ZError as error:
        reason = str(error).split(" at ", 1)[0][:200]
        where = ", ".join((*config.listen, *config.connect))
        if "Address already in use" in str(error) or "os error 98" in str(error):
            reason = "another program has this port, such as a second ground station"
        raise OutsideError(f"datalink does not open at {where}: {reason}") from error


def zenoh_config(config: SessionConfig) -> zenoh.Config:
    import zenoh

    settings: dict[str, Any] = {
        "mode": config.mode,
        "connect/endpoints": [_small_buffer(e, config.rate_bytes_s) for e in config.connect],
        "connect/timeout_ms": 0,
        "transport/unicast/open_timeout": round(1000 * config.open_timeout_s),
        "connect/exit_on_failure": config.mode == "client",
        "connect/retry": {
            "period_init_ms": 500,
            "period_max_ms": 2000,
            "period_increase_factor": 1.5,
        },
        "listen/endpoints": list(config.listen),
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # Shared memory would bypass the link, its rate limit and its access rules.
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": LEASE_MS,
        "transport/link/tx/batch_size": BATCH_BYTES,
        "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
        "adminspace/enabled": False,
        # Zenoh answers a query with the query's own quality of service. A query must neither make
        # the drone or the router wait (BLOCK) nor overtake live data.
        "qos/network": [
            {
                "id": "answers-yield",
                "messages": ["query"],
                "flows": ["ingress"],
                "overwrite": {"congestion_control": "drop", "priority": "background"},
            }
        ],
    }
    if config.tls_ca:
        settings |= {
            "transport/link/tls/root_ca_certificate": config.tls_ca,
            "transport/link/tls/listen_certificate": config.tls_certificate,
            "transport/link/tls/listen_private_key": config.tls_key,
            "transport/link/tls/connect_certificate": config.tls_certificate,
            "transport/link/tls/connect_private_key": config.tls_key,
            "transport/link/tls/enable_mtls": True,
            "transport/link/tls/close_link_on_expiration": True,
            # Ground stations change addresses; their certificates identify them.
            "transport/link/tls/verify_name_on_connect": False,
        }
    if config.fleet_rights:
        settings["access_control"] = access_control(load_fleet(Path(config.tls_key).parent / FLEET))
    out: zenoh.Config = zenoh.Config()
    for key, value in settings.items():
        out.insert_json5(key, json.dumps(value))
    return out


def _small_buffer(endpoint: str, rate_bytes_s: float) -> str:
    """The endpoint with a small send buffer, so that control does not queue behind bulk data."""
    if "#" in endpoint or not endpoint.startswith(("tcp/", "tls/")):
        return endpoint
    return f"{endpoint}#so_sndbuf={max(SEND_BUFFER_BYTES, round(rate_bytes_s * SEND_BUFFER_S))}"
