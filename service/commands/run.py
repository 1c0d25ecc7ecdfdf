"""``skyrelief run``: the daemon."""

from __future__ import annotations

import logging
import signal
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING

from service.commands import ConfigFile, Overrides, check_names, on_signals
from service.errors import InputError

if TYPE_CHECKING:
    from mavlink.wire.first_beat import FirstBeats
    from service.config import Config
    from service.daemon.runtime import Daemon
    from service.daemon.simulated import SimulatedFlight

log = logging.getLogger(__name__)

_reloads = Lock()


def run(config: ConfigFile = None, set_: Overrides = None) -> None:
    """Scan on the operator's commands; end with Ctrl-C or SIGTERM.

    SIGHUP reloads the configuration; an invalid one changes nothing.
    """
    from service.memory import one_pool

    one_pool()  # before there are threads
    chosen, fault = _configuration(config, set_ or [])
    flight = None
    if chosen.camera.source.startswith("sim:"):
        from service.daemon.simulated import SimulatedFlight

        flight = SimulatedFlight(chosen.camera.source)
        chosen = flight.configured(chosen)
        flight.start()
    first = _first_beats(chosen)
    from service.daemon.runtime import Daemon

    daemon = Daemon(chosen, first, fault)
    on_signals(daemon.quit, signal.SIGINT, signal.SIGTERM)
    on_signals(lambda: reread(daemon, flight, config, set_ or []), signal.SIGHUP)
    daemon.run()


def _configuration(path: Path | None, overrides: list[str]) -> tuple[Config, InputError | None]:
    """The configuration, and why it cannot be used: then at most its links are valid. Raises that
    fault where no init system would restart the service: a person reads it in a terminal.
    """
    from service.config import Config, load_config

    try:
        return load_config(path, overrides), None
    except InputError as error:
        from service.init_system import Notifier

        if not Notifier().is_heard:
            raise
        fault = error
    try:
        return load_config(path, overrides, only="mavlink"), fault
    except InputError:
        return Config(), fault


def _first_beats(config: Config) -> FirstBeats | None:
    """Heartbeats before everything else; None where they must be signed, or there is no link."""
    import random

    from mavlink.component.memory import Memory
    from mavlink.wire.first_beat import FirstBeats

    mavlink = config.mavlink
    if mavlink.signing_key or not mavlink.links:
        return None
    try:
        token = random.getrandbits(32) or 1
        folder = Path(mavlink.memory or config.scan.folder)
        system = mavlink.system_id or Memory(folder).system or 1
        first = FirstBeats(mavlink.links, system, token)
    except ValueError:
        return None  # said by the check of the whole configuration
    first.start()
    return first


def reread(
    daemon: Daemon, flight: SimulatedFlight | None, path: Path | None, overrides: list[str]
) -> None:
    """Read the configuration again, each signal after the one before: the newest file counts."""
    from service.config import load_config

    with _reloads:
        try:
            wanted = load_config(path, overrides)
            check_names(wanted, path)
            daemon.reload(wanted if flight is None else flight.configured(wanted))
        except InputError as error:
            log.error("the configuration is unchanged: %s", error)
