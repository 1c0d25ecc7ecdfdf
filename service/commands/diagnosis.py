"""Checks everything that a flight needs, and names the remedy for each fault."""

from __future__ import annotations

import json
import os
import platform
import re
import shutil
import socket
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import Enum
from http.client import HTTPException
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.request import urlopen

from mavlink.telemetry.clock import EARLIEST_UNIX_S
from service.config import Config, keys, load_config
from service.daemon.machine import read_machine
from service.daemon.simulated import is_simulated
from service.daemon.vehicle_config import vehicle_config, watch_config
from service.daemon.warm_up import is_warm, warm_up_command
from service.errors import InputError, NoSenderError, SkyreliefError
from service.packages import installs, unusable_packages
from service.scans.writing import existing

if TYPE_CHECKING:
    from mavlink.wire.messages import LinkReport
    from service.compute.backend_choice import Choice

CORE = ("numpy", "scipy", "numba", "opencv-python-headless", "av", "pymavlink", "eclipse-zenoh")
DESK = {
    "maps": ("rasterio",),
    "clouds": ("copclib", "py3dtiles"),
    "meshes": ("trimesh", "open3d"),
    "recordings": ("foxglove", "rosbags", "mcap"),
    "flight logs": ("pyulog",),
    "portal": ("starlette", "uvicorn", "websockets"),
}
"""What a desk makes, and the optional packages for it."""
NEEDED_MIB = {"disk": 1000.0, "memory": 700.0}
HOT_C = 85.0
SOON_DAYS = 30  # a certificate that expires sooner gives a note


class Grade(str, Enum):
    GOOD = "good"
    NOTE = "note"  # can fly
    BAD = "bad"


GOOD, NOTE, BAD = Grade

WAIT_S = 1.0
CONFIRM_S = 0.1

LARGEST_BYTES = 1 << 20

BOARDS: dict[str, str] = {
    "orin-nano": r"Orin.*Nano",
    "orin-nx": r"Orin.*NX",
    "orin-agx": r"AGX.*Orin",
    "raspberry-pi-5": r"Raspberry Pi 5|Compute Module 5",
}
"""Profile name to the board's name in the device tree; as in deploy/install.sh."""

PLACES = (
    Path(__file__).resolve().parents[2] / "deploy" / "profiles",
    Path(sys.prefix) / "share" / "skyrelief" / "deploy" / "profiles",
)


@dataclass(frozen=True, slots=True)
class Finding:
    what: str
    verdict: Grade
    text: str


def examine(config: Config, listen_s: float | None) -> Iterator[Finding]:
    """Every finding, as soon as it is available.

    Without seconds to listen on the links only what a desk needs: no camera, no vehicle, no
    datalink, but the packages of the products.
    """
    yield from examine_software()
    if listen_s is None:
        yield from chain(_products(), _clock(), examine_compute(config))
        return
    running = running_service(config.health.http) if config.health.http else None
    yield from chain(
        _machine(config),
        _clock(),
        _folder(Path(config.scan.folder)),
        examine_compute(config),
        _camera(config, running),
        examine_links(config, listen_s, running),
        _datalink(config),
        check_certificate(config),
        _settings(config),
        _service(running),
    )


def parent_of(package: str) -> str:
    spec = find_spec(package)
    origin = spec.origin if spec is not None else None
    return str(Path(origin).resolve().parents[1]) if origin else f"{package} is missing"


def examine_software(parent: Callable[[str], str] = parent_of) -> Iterator[Finding]:
    """Packages: those that are missing, and a stranger's in place of one of ours."""
    found, missing = [], []
    for name in CORE:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            missing.append(name)
    yield Finding("python", GOOD, f"{platform.python_version()} in {sys.prefix}")
    if missing:
        yield Finding("packages", BAD, f"not installed: {', '.join(missing)}; install again")
    else:
        yield Finding("packages", GOOD, ", ".join(found))
    for name, debian in unusable_packages().items():
        text = f"{name} cannot be loaded; apt install {' '.join(debian)}"
        yield Finding("libraries", NOTE, text)
    parents = {parent(name) for name in ("service", "recon", "mavlink")}
    if len(parents) > 1:
        where = ", ".join(sorted(parents))
        yield Finding(
            "packages", BAD, f"another package shadows one of ours ({where}); use a fresh venv"
        )


def _products() -> Iterator[Finding]:
    """Which products the optional packages allow."""
    for what, packages in DESK.items():
        missing = [name for name in packages if find_spec(name) is None]
        if missing:
            remedy = f"pip install {' '.join(dict.fromkeys(map(installs, missing)))}"
            yield Finding(what, NOTE, f"needs {', '.join(missing)}; {remedy}")
        else:
            yield Finding(what, GOOD, ", ".join(packages))


def _machine(config: Config) -> Iterator[Finding]:
    m = read_machine(Path(config.scan.folder))
    yield Finding("machine", GOOD, f"{m.model}, {os.cpu_count()} cores")
    yield from _board(config, m.model)
    if m.memory_free_mib is not None:
        short = m.memory_free_mib < NEEDED_MIB["memory"]
        text = f"{m.memory_free_mib:.0f} MiB free"
        yield Finding("memory", BAD if short else GOOD, text + ("; end other services" * short))
    if m.temperature_c is not None:
        hot = m.temperature_c > HOT_C
        text = f"{m.temperature_c:.0f} degrees" + ("; the CPU will throttle: improve cooling" * hot)
        yield Finding("heat", NOTE if hot else GOOD, text)
    if m.throttled:
        yield Finding("heat", NOTE, "throttled now, by heat or a weak power supply")


def _board(config: Config, model: str) -> Iterator[Finding]:
    name = board_of(model)
    path = profile_path(name)
    if path is None:
        yield Finding("board", NOTE, f"no profile for {model}: the defaults are in force")
        return
    others = other_than_profile(config, path)
    if others:
        yield Finding("board", NOTE, f"differs from {path}: {'; '.join(others)}")
    else:
        yield Finding("board", GOOD, f"the settings of {name} are in force")


def _settings(config: Config) -> Iterator[Finding]:
    """Settings that the service requires, or without which a flight is poor."""
    needed = [n for n in ("source", "model") if not getattr(config.camera, n)]
    if is_simulated(config):
        yield Finding("settings", GOOD, "nothing required: camera and autopilot are simulated")
    elif needed:
        names = " and ".join(f"camera.{n}" for n in needed)
        yield Finding("settings", BAD, f"set {names}; the service does not start without them")
    elif not config.mavlink.links:
        yield Finding(
            "settings", NOTE, "set mavlink.links: without it no commands, scale or georeference"
        )
    else:
        yield Finding("settings", GOOD, "all required settings are present")


def _clock() -> Iterator[Finding]:
    text = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime())
    if time.time() >= EARLIEST_UNIX_S:
        yield Finding("clock", GOOD, text)
        return
    hint = "was never set; names and times of scans are wrong until the autopilot sends the time"
    yield Finding("clock", NOTE, f"{text} {hint}")


def _folder(folder: Path) -> Iterator[Finding]:
    nearest = existing(folder)
    if not os.access(nearest, os.W_OK):
        yield Finding("scans", BAD, f"{folder} cannot be written; set scan.folder or its owner")
        return
    free = shutil.disk_usage(nearest).free / 2**20
    verdict = GOOD if free > NEEDED_MIB["disk"] else BAD
    yield Finding("scans", verdict, f"{folder}: {free / 1024:.1f} GiB free")


def examine_compute(config: Config, by: Choice | None = None) -> Iterator[Finding]:
    """Whether the configured backend runs; ``by`` finds it (default: as a scan does)."""
    from service.compute.backend_choice import Choice, open_backend

    start = time.monotonic()
    try:
        backend = open_backend(config.compute, by=by or Choice())
        import_module("recon.stereo.belief_propagation")  # a scan's kernels; opening loads none
    except (SkyreliefError, ImportError, RuntimeError) as error:  # numba's, without a cache
        yield Finding("compute", BAD, str(error))
        return
    seconds = time.monotonic() - start
    yield Finding("compute", GOOD, f"{backend.name} on {backend.device}, up in {seconds:.1f} s")
    if is_warm():
        yield Finding("kernels", GOOD, "compiled for this version")
    else:
        yield Finding("kernels", NOTE, f"the first scan may compile kernels; {warm_up_command()}")


def _camera(config: Config, running: dict[str, Any] | None) -> Iterator[Finding]:
    from service.cameras import open_camera
    from service.cameras.camera_file import load_camera

    if is_simulated(config):
        yield Finding("camera", GOOD, "sim: a simulated flight; 'skyrelief run' plays it")
        return
    model, path = None, config.camera.model
    if not path:
        yield Finding("camera model", NOTE, "none; 'skyrelief calibrate' makes one")
    else:
        try:
            model = load_camera(path)
        except InputError as error:
            yield Finding("camera model", BAD, str(error))
        else:
            size = f"{model.size_px[0]}x{model.size_px[1]}"
            yield Finding("camera model", GOOD, f"{path}: {size}, fx {model.K[0, 0]:.0f}")
    if not config.camera.source:
        yield Finding("camera", NOTE, "camera.source is not set")
        return
    if running is not None and "frames" in running:
        yield Finding("camera", GOOD, f"in the running scan: {running['frames']} images so far")
        return
    try:
        source = open_camera(config.camera.source)
    except NoSenderError as error:
        yield Finding("camera", NOTE, str(error))
        return
    except SkyreliefError as error:
        yield Finding("camera", BAD, str(error))
        return
    with_rate = f" at {source.fps:.1f} a second" if source.fps else ""
    W, H = source.size_px
    source.close()
    yield Finding("camera", GOOD, f"{source.description}: {W}x{H}{with_rate}")
    if model is not None and model.size_px != source.size_px:
        size = f"{model.size_px[0]}x{model.size_px[1]}"
        yield Finding("camera", BAD, f"the camera model is for {size}; calibrate at {W}x{H}")


def _service(running: dict[str, Any] | None) -> Iterator[Finding]:
    if running is None:
        return
    fault = str(running.get("fault", ""))
    text = f"{running['software']} runs here: {fault or running.get('state', 'unknown')}"
    yield Finding("service", GOOD if running.get("ok") else BAD, text)
    for worker in running.get("workers", ()):
        yield _worker(worker)


def _worker(worker: dict[str, Any]) -> Finding:
    """A worker of the running service: state, depth and lag."""
    text = f"{worker['name']}: {worker['state']}"
    if worker["bound"] is not None:
        text += f", {worker['waiting']} of {worker['bound']} waiting ({worker['when_full']})"
    if worker["lag_s"] > 0:
        text += f", {worker['lag_s']:.1f} s behind"
    if worker["restarts"] or worker["fault"]:
        text += f", {worker['restarts']} restarts, last fault: {worker['fault']}"
    is_well = worker["state"] == "running"
    return Finding("worker", (NOTE if worker["fault"] else GOOD) if is_well else BAD, text)


def check_certificate(config: Config) -> Iterator[Finding]:
    from service.stream.keys import expiry_unix_s, member_name

    path, drone = config.datalink.tls_certificate, config.scan.drone_name
    if not path:
        return
    try:
        left_days = (expiry_unix_s(Path(path)) - time.time()) / 86_400
        name = member_name(Path(path))
    except SkyreliefError as error:
        yield Finding("certificate", BAD if isinstance(error, InputError) else NOTE, str(error))
        return
    if name != drone:
        text = f"{path} is of {name!r}, scan.drone is {drone!r}: the ground would refuse its data"
        yield Finding("certificate", BAD, text)
    if left_days < 0:
        text = f"{path} expired {-left_days:.0f} days ago; make new keys with 'skyrelief keys'"
        yield Finding("certificate", BAD, text)
    elif name == drone:
        verdict = GOOD if left_days > SOON_DAYS else NOTE
        yield Finding("certificate", verdict, f"{path} is valid for {left_days:.0f} more days")


def _datalink(config: Config) -> Iterator[Finding]:
    from service.stream.link import sessions
    from service.stream.naming import check_name

    try:
        if sessions(config.datalink):
            check_name(config.scan.drone_name, "drone")
        else:
            yield Finding("datalink", NOTE, "no endpoints: scans stay onboard")
    except InputError as error:
        yield Finding("datalink", BAD, str(error))
        return
    for endpoint in config.datalink.connect:
        host, _, port = endpoint.partition("/")[2].partition("?")[0].rpartition(":")
        try:
            socket.create_connection((host.strip("[]"), int(port)), timeout=3.0).close()
        except (OSError, ValueError) as error:
            yield Finding("datalink", NOTE, f"{endpoint} does not answer ({error})")
        else:
            yield Finding("datalink", GOOD, f"{endpoint} answers")


def running_service(address: str) -> dict[str, Any] | None:
    """The ``/status`` at ``address`` (HOST:PORT); None when no skyrelief answers there."""
    try:
        with urlopen(f"http://{address}/status", timeout=WAIT_S) as page:
            status = json.loads(page.read(LARGEST_BYTES))
    except (OSError, ValueError, HTTPException):
        return None
    is_ours = isinstance(status, dict) and str(status.get("software", "")).startswith("skyrelief")
    return status if is_ours else None


def board_of(model: str) -> str:
    """The profile's name for a board called ``model``; empty when there is none."""
    for name, pattern in BOARDS.items():
        if re.search(pattern, model):
            return name
    return "x86-bench" if platform.machine() == "x86_64" else ""


def profile_path(name: str) -> Path | None:
    """The profile's file; None when it is not installed."""
    found = (place / f"{name}.toml" for place in PLACES)
    return next((path for path in found if path.is_file()), None)


def other_than_profile(config: Config, path: Path) -> list[str]:
    """Differences of ``config`` from the profile: ``compute.threads = 0, not 4``."""
    profile, default = load_config(path), Config()
    out = []
    for section, field in keys():
        wanted = getattr(getattr(profile, section), field.name)
        if wanted == getattr(getattr(default, section), field.name):
            continue
        value = getattr(getattr(config, section), field.name)
        if value != wanted:
            out.append(f"{section}.{field.name} = {value}, not {wanted}")
    return out


def examine_links(
    config: Config, listen_s: float, running: dict[str, Any] | None
) -> Iterator[Finding]:
    """Messages that each link receives and lacks, by listening or from the running service."""
    if not config.mavlink.links:
        yield Finding("mavlink", NOTE, "mavlink.links is empty: no telemetry, no commands")
    elif running is None:
        yield from _by_listening(config, listen_s)
    else:
        heard = running.get("mavlink", {})
        up, packets = heard.get("links_up", 0), heard.get("packets", 0)
        text = f"held by the running service: {up} open, {packets} messages heard"
        yield Finding("mavlink", GOOD if packets else NOTE, text)
        for trouble in heard.get("troubles", ()):
            yield _trouble(trouble["what"], trouble["text"], trouble["is_grave"])


def _by_listening(config: Config, listen_s: float) -> Iterator[Finding]:
    """Open the links as the service does; every command is refused meanwhile."""
    from mavlink.component.companion import CompanionConfig
    from mavlink.component.control import NoScans
    from mavlink.component.presence import Health
    from mavlink.component.vehicle import VehicleLink

    watch = watch_config(config, wait_s=listen_s / 2, ground_wait_s=listen_s / 2)
    companion = CompanionConfig(watch=watch)
    try:
        settings = replace(vehicle_config(config), companion=companion, state_dir=None)
        vehicle = VehicleLink(settings, NoScans())
    except InputError as error:
        yield Finding("mavlink", BAD, str(error))
        return
    try:
        vehicle.start()
        end_s = time.monotonic() + listen_s
        while time.monotonic() < end_s:
            vehicle.set_health(Health.STANDBY)
            time.sleep(CONFIRM_S)
        found = vehicle.report()
    finally:
        vehicle.stop()
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


def _why_silent(link: LinkReport) -> str:
    if not link.is_up:
        return f"does not open: {link.last_error}" if link.last_error else "does not open"
    if link.skipped_bytes:
        return "only noise: is SERIALn_BAUD (PX4: SER_TELn_BAUD) the baud rate of mavlink.links?"
    if link.name.startswith("lines:"):
        return "silent: does the sender have this address, and its lines a known header?"
    return "silent: is the autopilot on and its port set to MAVLink 2?"


def _trouble(what: str, text: str, is_grave: bool) -> Finding:
    may_be_off = what == "ground"
    return Finding(what, BAD if is_grave and not may_be_off else NOTE, text)
