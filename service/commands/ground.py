"""``skyrelief ground``: receive the scans of drones into scan folders."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.commands import AsJson, stop_by_signals, with_options
from service.errors import InputError, SkyreliefError
from service.packages import needing

if TYPE_CHECKING:
    from service.ground.portal import Portal
    from service.ground.receiver import Receiver, ReceiverConfig
    from service.init_system import Notifier
    from service.workers import Worker, Workers

DEFAULT_PORT = 7447
RADIO_REFRESH_S = 15.0
NOTIFY_S = 1.0
SHOW_S = 2.0
CLOSING_S = 900.0  # writing deliverables at the end may take so long; then the init system ends it

TokenFile = Annotated[
    Path | None,
    typer.Option(
        "--portal-token-file",
        "--portal-token",
        help="file of the portal's tokens, a line each: TOKEN or NAME TOKEN; "
        "default: one is made and kept in STORE/portal-token",
    ),
]


@dataclass(frozen=True)
class GroundOptions:
    connect: Annotated[
        list[str] | None, typer.Option(help="router to join: tls/HOST:7447; may be repeated")
    ] = None
    listen: Annotated[
        list[str] | None,
        typer.Option(help="where drones connect: tls/0.0.0.0:7447; default: this machine only"),
    ] = None
    store: Annotated[Path, typer.Option(help="folder of received scans")] = Path("ground-scans")
    keys: Annotated[
        Path | None, typer.Option(help="this station's keys, a folder of 'skyrelief keys'")
    ] = None
    plain: Annotated[
        bool, typer.Option("--plain", help="allow endpoints without TLS beyond this machine")
    ] = False
    quota_mb: Annotated[
        float | None, typer.Option(help="size of one scan; beyond it only coarse layers are kept")
    ] = None
    drone_share: Annotated[
        float, typer.Option(help="percent of the disk that the scans of one drone may take")
    ] = 50.0
    reserve_mb: Annotated[
        float | None, typer.Option(help="disk space kept free; default: 5 %, at most 2 GiB")
    ] = None
    mavlink: Annotated[
        list[str] | None,
        typer.Option(help="telemetry radio for the narrow fallback: udpin:0.0.0.0:14551"),
    ] = None
    refresh_s: Annotated[
        float | None, typer.Option(help="interval for writing clouds of growing scans")
    ] = None
    portal: Annotated[
        str | None, typer.Option(help="serve the web portal at HOST:PORT, such as 127.0.0.1:8080")
    ] = None
    portal_token: TokenFile = None
    portal_tls: Annotated[
        tuple[Path, Path] | None, typer.Option(help="the portal's certificate and key")
    ] = None
    basemap: Annotated[
        Path | None, typer.Option(help="MBTiles or PMTiles basemap of the portal's maps")
    ] = None
    vehicle: Annotated[
        str | None,
        typer.Option(help="MAVLink of the vehicle for the portal: udpin://0.0.0.0:14550"),
    ] = None
    take: Annotated[
        list[Path] | None,
        typer.Option(help="scans of an aircraft's storage, imported first; may be repeated"),
    ] = None
    sites: Annotated[
        bool, typer.Option(help="align finished scans that show the same ground, in STORE/site")
    ] = True
    meshes: Annotated[
        bool, typer.Option(help="mesh scans that have ended, to be shown in the portal")
    ] = True
    once: Annotated[bool, typer.Option("--once", help="end when a scan is complete")] = False
    idle_exit_s: Annotated[
        float | None, typer.Option(help="end after so many seconds without new data")
    ] = None
    as_json: AsJson = False

    def receiver(self) -> ReceiverConfig:
        """The receiver's configuration; InputError for impossible options."""
        from service.ground.receiver import ReceiverConfig
        from service.ground.storage import DroneLimits
        from service.stream.keys import member_name, tls_files
        from service.stream.session import SessionConfig

        if not 0.0 < self.drone_share <= 100.0:
            raise InputError("--drone-share is a percentage: more than 0, at most 100")
        sizes_mb = (self.quota_mb, self.reserve_mb)
        if any(size is not None and not size >= 0 for size in sizes_mb):
            raise InputError("--quota-mb and --reserve-mb are 0 or more")
        quota, reserve = (None if size is None else int(size * 1e6) for size in sizes_mb)
        refresh_s = self.refresh_s
        if refresh_s is None:
            refresh_s = RADIO_REFRESH_S if self.mavlink else 0.0
        limits = DroneLimits(quota, self.drone_share / 100.0, reserve, refresh_s=refresh_s)
        connect, listen, has_keys = self.connect or [], self.listen or [], self.keys is not None
        ca, certificate, key = tls_files(self.keys) if self.keys is not None else ("", "", "")
        if has_keys and connect and listen:
            raise InputError(
                "with --keys a station listens or joins another: its key does not let it pass on "
                "what drones send; a drone can name several stations in datalink.connect"
            )
        if not connect and not listen:
            host = "tls/0.0.0.0" if has_keys else "tcp/127.0.0.1"
            listen = [f"{host}:{DEFAULT_PORT}"]
        session = SessionConfig(
            mode="router" if listen or len(connect) > 1 else "client",
            connect=tuple(connect), listen=tuple(listen), plain=self.plain,
            tls_ca=ca, tls_certificate=certificate, tls_key=key,
            fleet_rights=has_keys and bool(listen),
        )  # fmt: skip
        name = member_name(Path(certificate)) if certificate else ""  # on its certificate
        return ReceiverConfig(self.store, session, limits, name)


@with_options(GroundOptions)
def ground(given: GroundOptions) -> None:
    """Receive scans from drones; end with Ctrl-C. Scans: STORE/drones/DRONE/SCAN."""
    from service.scans.retention import Claim

    config, claim = given.receiver(), Claim()
    if not claim.take(config.store):
        raise InputError(f"another station or daemon works in {config.store}; give another --store")
    try:
        _run(given, config)
    finally:
        claim.give_up()


def _run(given: GroundOptions, config: ReceiverConfig) -> None:
    from service.ground import live_site
    from service.ground.due import MESH
    from service.ground.receiver import Receiver
    from service.ground.sites import Sites
    from service.init_system import Notifier
    from service.radio import GROUND, RadioLink
    from service.workers import Workers

    notifier = Notifier()
    taken = _take_in(config.store, given.take or [])
    stop, workers = stop_by_signals(), Workers()
    page: Portal | None = None
    sites, aligning = Sites(config.store, config.limits), []

    def ended(folder: Path) -> None:
        if given.sites:
            sites.put(folder)
        if page is not None:
            page.ended(folder)
        elif given.meshes:
            MESH.mark(folder)  # for the next portal

    receiver = Receiver(config, workers, ended=ended)
    radios = [RadioLink(endpoint, GROUND, receiver.add_radio) for endpoint in given.mavlink or []]
    receiver.start()
    if given.sites:
        align_live = partial(live_site.run, config.store)
        aligning = [workers.start("sites", sites.run), workers.start("live site", align_live)]
    where = ", ".join((*config.session.listen, *config.session.connect))
    print(f"ground station at {where}, scans in {config.store}", file=sys.stderr, flush=True)
    for radio in radios:
        radio.open()
    try:
        if given.portal is not None:
            page = _open_portal(given.portal, given, receiver, workers)
        for folder in taken:
            ended(folder)
        notifier.ready()
        shown: dict[str, str] = {}
        shown_at = beat_at = 0.0
        while not stop.wait(0.2):
            now, entries = time.monotonic(), receiver.progress()
            if now >= beat_at:
                beat_at = now + NOTIFY_S
                feed_watchdog(workers, notifier)
                for radio in radios:
                    radio.beat()
            if given.once and any(entry["complete"] for entry in entries):
                stop.wait(1.5)  # let the report reach the drone
                break
            if given.idle_exit_s is not None and now - receiver.last_news_at > given.idle_exit_s:
                break
            if sys.stderr.isatty() and now - shown_at > SHOW_S:
                shown_at = now
                show_news(entries, shown)
        entries = receiver.progress()
    finally:
        notifier.stopping()
        closing = workers.start("closing", lambda worker: _ask_for_time(notifier, worker))
        if page is not None:
            page.close()
        for radio in radios:
            radio.close()
        receiver.close()
        for worker in aligning:
            worker.join()
        closing.join()
    if given.as_json:
        report = {"scans": entries, "dropped": receiver.dropped, "workers": workers.report()}
        print(json.dumps(report))
        return
    lines = [f"{_line(entry)}; {entry['folder']}" for entry in entries]
    print("\n".join(lines) or "no scan was received")


def _take_in(store: Path, folders: list[Path]) -> list[Path]:
    """Delete unfinished files of a killed process; take in the scans of the folders."""
    from service.ground.storage import clear_leftovers, take_in

    clear_leftovers(store)
    taken = [path for folder in folders for path in take_in(store, folder)]
    for path in taken:
        print(f"taken in: {path}", file=sys.stderr, flush=True)
    return taken


def _open_portal(
    address: str, given: GroundOptions, receiver: Receiver, workers: Workers
) -> Portal:
    """The portal, started; its address is printed."""
    with needing("the portal"):
        from service.ground.portal import Portal, config_of
        from service.ground.vehicle import Vehicle
    endpoint = given.vehicle
    vehicle = None if endpoint is None else Vehicle(endpoint, workers=workers)
    config = config_of(
        address, given.store, given.portal_token, given.portal_tls, basemap=given.basemap,
        limits=receiver.limits, meshes=given.meshes,
    )  # fmt: skip
    page = Portal(config, receiver.progress, vehicle, workers)
    page.start()
    if vehicle is not None:
        vehicle.start()
    print(f"portal: {page.url}", file=sys.stderr, flush=True)
    return page


def _ask_for_time(notifier: Notifier, worker: Worker) -> None:
    """Keep the init system waiting while deliverables are written, for so long and no longer."""
    deadline = time.monotonic() + CLOSING_S
    while time.monotonic() < deadline:
        notifier.closing()
        if worker.stop.wait(NOTIFY_S):
            return


def feed_watchdog(workers: Workers, notifier: Notifier) -> None:
    """Feed the watchdog while every worker makes progress.

    Raises SkyreliefError when one that the station cannot do without has failed for good.
    """
    for worker in workers.failed:
        raise SkyreliefError(f"{worker.name} failed too often ({worker.fault}); see the log")
    stalled = ", ".join(worker.name for worker in workers.stalled)
    if stalled:
        notifier.status(f"no progress: {stalled}")
    else:
        notifier.alive()


def show_news(entries: list[dict[str, Any]], shown: dict[str, str]) -> None:
    """Print the scans whose line is not the one ``shown``, by folder."""
    for entry in entries:
        line = _line(entry)
        if shown.get(entry["folder"]) != line:
            shown[entry["folder"]] = line
            print(line, file=sys.stderr, flush=True)


def _line(entry: dict[str, Any]) -> str:
    held, missing = entry["held"], sum(entry["missing"].values())
    state = "complete" if entry["complete"] else f"{missing} missing" if missing else "up to date"
    return (
        f"{entry['drone']}/{entry['scan']}: {held.get('k0', 0)} keyframes, "
        f"{held.get('pose', 0)} poses, {entry['received_bytes'] / 1e6:.2f} MB, {state}"
    )
