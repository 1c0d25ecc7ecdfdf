"""The MAVLink links as the doctor reports them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.config import Config
from service.daemon.findings import BAD, GOOD, NOTE, Finding
from service.daemon.vehicle_config import watch_config

if TYPE_CHECKING:
    from mavlink.link_probe import LinkFound

WORST = {"ground": NOTE}  # it may just be off


def examine_links(
    config: Config, listen_s: float, running: dict[str, Any] | None
) -> Iterator[Finding]:
    """What is heard on each link, and what is missing; a running service says it itself."""
    if not config.mavlink.links:
        yield Finding("mavlink", NOTE, "mavlink.links is empty: no telemetry, no commands")
    elif running is not None:
        yield from _of_service(running.get("mavlink", {}))
    else:
        yield from _by_listening(config, listen_s)


def _of_service(heard: dict[str, Any]) -> Iterator[Finding]:
    up, packets = heard.get("links_up", 0), heard.get("packets", 0)
    text = f"held by the running service: {up} open, {packets} messages heard"
    yield Finding("mavlink", GOOD if packets else NOTE, text)
    for trouble in heard.get("troubles", ()):
        yield _trouble(trouble["what"], trouble["text"], trouble["is_grave"])


def _by_listening(config: Config, listen_s: float) -> Iterator[Finding]:
    from mavlink.link_probe import LinkProbe

    mavlink = config.mavlink
    watch = watch_config(config, wait_s=listen_s / 2, ground_wait_s=listen_s / 2)
    key = Path(mavlink.signing_key) if mavlink.signing_key else None
    try:
        probe = LinkProbe(mavlink.links, mavlink.system_id or None, watch, key)
    except ValueError as error:
        yield Finding("mavlink", BAD, str(error))
        return
    found = probe.look(listen_s)
    for link in found.links:
        if link.packets:
            heard = (f"system {s}: {n / listen_s:.0f}/s" for s, n in sorted(link.packets.items()))
            yield Finding("mavlink", GOOD, f"{link.name}: {', '.join(heard)}")
        else:
            yield Finding("mavlink", BAD, f"{link.name}: {_why_silent(link)}")
    if found.autopilot is not None:
        system, component = found.autopilot
        yield Finding("autopilot", GOOD, f"system {system}, component {component}")
    if any(link.packets for link in found.links):
        for trouble in found.troubles:
            yield _trouble(trouble.what, trouble.text, trouble.is_grave)


def _why_silent(link: LinkFound) -> str:
    if not link.is_up:
        return f"does not open: {link.last_error}" if link.last_error else "does not open"
    if link.skipped_bytes:
        return "only noise: is SERIALn_BAUD (PX4: SER_TELn_BAUD) the baud rate of mavlink.links?"
    return "silent: is the autopilot on, its port set to MAVLink 2?"


def _trouble(what: str, text: str, is_grave: bool) -> Finding:
    return Finding(what, WORST.get(what, BAD) if is_grave else NOTE, text)
