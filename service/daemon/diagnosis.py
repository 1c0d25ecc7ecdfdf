"""One look at everything that a flight needs: what works, what does not, what to do about it."""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavlink.wall_time import EARLIEST_UNIX_S
from service.compute.threading_layer import REMEDY, kernels_may_overlap
from service.config import Config
from service.daemon.findings import BAD, GOOD, NOTE, Finding
from service.daemon.link_diagnosis import examine_links
from service.daemon.running import running_service
from service.daemon.warm_up import is_warm
from service.errors import InputError, SkyreliefError
from service.packages import unusable_packages

if TYPE_CHECKING:
    from recon.types import Camera

CORE = ("numpy", "scipy", "numba", "opencv-python-headless", "av", "pymavlink", "eclipse-zenoh")
NEEDED_MIB = {"disk": 1000.0, "memory": 700.0}
HOT_C = 85.0
WARM_UP = (
    "sudo -u skyrelief env NUMBA_CACHE_DIR=/var/cache/skyrelief "
    "/opt/skyrelief/current/bin/skyrelief warm-up"
)

SOON_DAYS = 30  # a certificate that ends before needs thinking of


def examine(config: Config, listen_s: float) -> Iterator[Finding]:
    """Every finding, as soon as it is there."""
    running = running_service(config.health.http) if config.health.http else None
    checks: tuple[Callable[[], Iterator[Finding]], ...] = (
        _software,
        lambda: _machine(config),
        _clock,
        lambda: _folder(Path(config.scan.folder)),
        lambda: _compute(config),
        lambda: _camera(config, running),
        lambda: examine_links(config, listen_s, running),
        lambda: _datalink(config),
        lambda: _certificate(config),
        lambda: _to_fly(config),
        lambda: _service(running),
    )
    for check in checks:
        yield from check()


def _software() -> Iterator[Finding]:
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
        text = f"{name} cannot be loaded, what uses it is missing; apt install {' '.join(debian)}"
        yield Finding("libraries", NOTE, text)
    parents = {_parent(name) for name in ("service", "recon", "mavlink")}
    if len(parents) > 1:
        where = ", ".join(sorted(parents))
        yield Finding(
            "packages", BAD, f"a foreign package hides one of ours ({where}); use a fresh venv"
        )


def _parent(name: str) -> str:
    spec = find_spec(name)
    origin = spec.origin if spec is not None else None
    return str(Path(origin).resolve().parents[1]) if origin else f"{name} is missing"


def _machine(config: Config) -> Iterator[Finding]:
    from service.daemon.machine import read_machine

    m = read_machine(Path(config.scan.folder))
    yield Finding("machine", GOOD, f"{m.model}, {os.cpu_count()} cores")
    yield from _board(config, m.model)
    if m.memory_free_mib is not None:
        short = m.memory_free_mib < NEEDED_MIB["memory"]
        text = f"{m.memory_free_mib:.0f} MiB free"
        yield Finding("memory", BAD if short else GOOD, text + ("; end other services" * short))
    if m.temperature_c is not None:
        hot = m.temperature_c > HOT_C
        text = f"{m.temperature_c:.0f} degrees" + ("; it will slow down: give it air" * hot)
        yield Finding("heat", NOTE if hot else GOOD, text)
    if m.throttled:
        yield Finding("heat", NOTE, "throttled right now, by heat or a weak supply")


def _board(config: Config, model: str) -> Iterator[Finding]:
    from service.daemon.boards import board_of, other_than_profile, profile_path

    name = board_of(model)
    path = profile_path(name)
    if path is None:
        yield Finding("board", NOTE, f"no settings are delivered for {model}: the defaults hold")
        return
    others = other_than_profile(config, path)
    if others:
        yield Finding("board", NOTE, f"other than {path}: {'; '.join(others)}")
    else:
        yield Finding("board", GOOD, f"the settings of {name} are in force")


def _to_fly(config: Config) -> Iterator[Finding]:
    """What the service does not start without, or a flight is poor without."""
    needed = [n for n in ("source", "model") if not getattr(config.camera, n)]
    if needed:
        names = " and ".join(f"camera.{n}" for n in needed)
        yield Finding("to fly", BAD, f"set {names}; the service does not start without")
    elif not config.mavlink.links:
        yield Finding("to fly", NOTE, "set mavlink.links: without it no commands, scale or place")
    else:
        yield Finding("to fly", GOOD, "all that is needed is set")


def _clock() -> Iterator[Finding]:
    text = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime())
    if time.time() < EARLIEST_UNIX_S:
        hint = "was never set; scans get wrong names and times until the autopilot tells the time"
        yield Finding("clock", NOTE, f"{text} {hint}")
    else:
        yield Finding("clock", GOOD, text)


def _folder(folder: Path) -> Iterator[Finding]:
    import shutil

    nearest = folder
    while not nearest.exists() and nearest != nearest.parent:
        nearest = nearest.parent
    if not os.access(nearest, os.W_OK):
        yield Finding("scans", BAD, f"{folder} cannot be written; set scan.folder or its owner")
        return
    free = shutil.disk_usage(nearest).free / 2**20
    verdict = GOOD if free > NEEDED_MIB["disk"] else BAD
    yield Finding("scans", verdict, f"{folder}: {free / 1024:.1f} GiB free")


def _compute(config: Config) -> Iterator[Finding]:
    from service.compute.opening import open_backend

    start = time.monotonic()
    try:
        backend = open_backend(config.compute)
    except SkyreliefError as error:
        yield Finding("compute", BAD, str(error))
        return
    seconds = time.monotonic() - start
    yield Finding("compute", GOOD, f"{backend.name} on {backend.device}, up in {seconds:.1f} s")
    if kernels_may_overlap():
        yield Finding("threads", GOOD, "OpenMP or TBB: tracking and stereo run side by side")
    else:
        yield Finding("threads", BAD, f"no OpenMP: half as fast, one core idle; {REMEDY}")
    if is_warm():
        yield Finding("kernels", GOOD, "compiled for this version")
    else:
        yield Finding("kernels", NOTE, f"the first scan may have to compile; {WARM_UP}")


def _camera(config: Config, running: dict[str, Any] | None) -> Iterator[Finding]:
    from service.cameras import open_camera

    model = None
    if config.camera.model:
        model, finding = _model(config)
        yield finding
    else:
        yield Finding("camera model", NOTE, "none; 'skyrelief calibrate' makes one")
    if not config.camera.source:
        yield Finding("camera", NOTE, "camera.source is not set")
        return
    if running is not None and "frames" in running:
        yield Finding("camera", GOOD, f"in the running scan: {running['frames']} pictures so far")
        return
    try:
        source = open_camera(config.camera.source)
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


def _model(config: Config) -> tuple[Camera | None, Finding]:
    from service.cameras.camera_file import load_camera

    try:
        model = load_camera(config.camera.model)
    except InputError as error:
        return None, Finding("camera model", BAD, str(error))
    text = f"{config.camera.model}: {model.size_px[0]}x{model.size_px[1]}, fx {model.K[0, 0]:.0f}"
    return model, Finding("camera model", GOOD, text)


def _service(running: dict[str, Any] | None) -> Iterator[Finding]:
    if running is None:
        return
    fault = str(running.get("fault", ""))
    text = f"{running['software']} runs here: {fault or running.get('state', 'unknown')}"
    yield Finding("service", GOOD if running.get("ok") else BAD, text)


def _certificate(config: Config) -> Iterator[Finding]:
    from service.stream.keys import expiry_unix_s

    path = config.datalink.tls_certificate
    if not path:
        return
    try:
        left_days = (expiry_unix_s(Path(path)) - time.time()) / 86_400
    except SkyreliefError as error:
        yield Finding("certificate", BAD if isinstance(error, InputError) else NOTE, str(error))
        return
    if left_days < 0:
        text = f"{path} expired {-left_days:.0f} days ago; make new keys with 'skyrelief keys'"
        yield Finding("certificate", BAD, text)
    else:
        verdict = GOOD if left_days > SOON_DAYS else NOTE
        yield Finding("certificate", verdict, f"{path} holds for {left_days:.0f} days more")


def _datalink(config: Config) -> Iterator[Finding]:
    import socket

    if not (config.datalink.connect or config.datalink.listen):
        yield Finding("datalink", NOTE, "no endpoints: scans stay on board")
    for endpoint in config.datalink.connect:
        host, _, port = endpoint.partition("/")[2].partition("?")[0].rpartition(":")
        try:
            socket.create_connection((host.strip("[]"), int(port)), timeout=3.0).close()
        except (OSError, ValueError) as error:
            yield Finding("datalink", NOTE, f"{endpoint} does not answer now ({error})")
        else:
            yield Finding("datalink", GOOD, f"{endpoint} answers")
