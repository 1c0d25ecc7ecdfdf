"""``skyrelief run``: the daemon."""

from __future__ import annotations

import logging
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from service.runtime import Daemon

log = logging.getLogger(__name__)


def run(
    config: Annotated[Path | None, typer.Option(help="configuration file (TOML)")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="section.key=value, may be repeated")
    ] = None,
) -> None:
    """Wait for the operator's commands and scan; ends on Ctrl-C or a TERM signal.

    A HUP signal reads the configuration again; a broken one changes nothing.
    """
    from service.config import load_config
    from service.runtime import Daemon

    daemon = Daemon(load_config(config, set_ or []))
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: daemon.quit())
    signal.signal(signal.SIGHUP, lambda *_: _reload(daemon, config, set_ or []))
    daemon.run()


def _reload(daemon: Daemon, path: Path | None, overrides: list[str]) -> None:
    from service.config import load_config
    from service.errors import InputError

    try:
        daemon.reload(load_config(path, overrides))
    except InputError as error:
        log.error("the configuration stays as it was: %s", error)
