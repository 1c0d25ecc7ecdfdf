"""A short scan of synthetic ground, which fills numba's cache on disk with every kernel.

The installer runs it once per version: the first scan of a flight then loads its kernels instead
of compiling them for minutes on a small board; a scan that stalls for seconds can count as hung.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event

import numpy as np

from service.cameras.source import CameraFrame, CameraSource
from service.config import Config, change
from service.progress import Progress
from service.scans.writing import write_whole
from service.version import software
from service.workers import guarded

SIZE_PX = (320, 240)
FOCAL_PX = 300.0
STEP_PX = 10
FRAMES = 40
MARKER = "warm"
INSTALLED, SERVICE_CACHE = "/opt/skyrelief", "/var/cache/skyrelief"
AS_SERVICE = f"sudo -u skyrelief env NUMBA_CACHE_DIR={SERVICE_CACHE}"


class SyntheticGround(CameraSource):
    """A camera on a straight flight over flat ground with a slab; deterministic."""

    def __init__(self, frames: int = FRAMES) -> None:
        super().__init__("synthetic ground")
        self.size_px, self.fps = SIZE_PX, 10.0
        self._frames = frames

    def __iter__(self) -> Iterator[CameraFrame]:
        import cv2

        W, H = SIZE_PX
        rng = np.random.default_rng(0)
        noise = rng.integers(0, 256, (H, W + STEP_PX * self._frames, 3), np.uint8)
        smooth = np.asarray(cv2.GaussianBlur(noise, (0, 0), 1.5), np.float64)
        ground = np.clip(5.0 * (smooth - 127.5) + 127.5, 0, 255).astype(np.uint8)
        for i in range(self._frames):
            x = STEP_PX * i
            image = ground[:, x : x + W].copy()
            left = W - round(1.1 * x) % (2 * W)  # nearer by a tenth, so it moves faster
            a, b = max(0, left), min(W, left + 80)
            if a < b:
                image[60:140, a:b] = ground[150:230, a - left : b - left]
            yield CameraFrame(image, 100_000_000 * i, i, None, f"frame {i}")


def warm_up(
    config: Config, progress: Progress, export: Callable[[Path], None] = lambda _: None
) -> tuple[float, int]:
    """Scan the synthetic ground with the configured backend, and ``export`` from the scan's folder;
    returns (seconds, keyframes). Writes the marker that :func:`is_warm` checks."""
    from recon.backends.cpu import warm_up as warm_up_backend
    from recon.types import Camera
    from service.compute.backend_choice import open_backend
    from service.flight.scan import Scan, ScanInputs, create_store
    from service.scans.folder import write_deliverables

    start = time.monotonic()
    progress("compiling the kernels of stereo: once, a minute or two")
    warm_up_backend()  # the fallback of a device that fails
    for key in ("scan.assumed_agl_m=60", "scan.keep_debug=false", "scan.baseline=auto"):
        config = change(config, *key.split("="))
    W, H = SIZE_PX
    K = np.array([[FOCAL_PX, 0, W / 2 - 0.5], [0, FOCAL_PX, H / 2 - 0.5], [0, 0, 1.0]])
    with TemporaryDirectory(prefix="skyrelief-warm-") as folder:
        inputs = ScanInputs(
            SyntheticGround(),
            Camera(K, np.zeros(5), SIZE_PX),
            config,
            open_backend(config.compute),
            Path(folder),
            "warm-up",
            time.time_ns(),
        )
        store = create_store(inputs)
        scan = Scan(inputs, store)
        with progress.part("compiling the others by a scan of synthetic ground", of_rest=0.5):
            say = progress.counting(FRAMES)
            scan.run(Event(), lambda _: say(progress.text))
        summary = scan.close()
        write_deliverables(Path(folder), store)
        store.close()
        export(Path(folder))
    marker = _marker(os.environ.get("NUMBA_CACHE_DIR", ""))
    if marker is not None:
        guarded(f"marker {marker}", lambda: write_whole(marker, software()))
    return time.monotonic() - start, int(summary["keyframes"])


@cache
def load_kernels() -> None:
    """Load what a scan runs, which takes a second or more. Done at arming: an idle service does not
    hold it, and the first image does not wait for it."""
    import service.flight.scan  # noqa: F401
    from recon.backends.cpu import warm_up as warm_up_backend

    warm_up_backend()


def has_kernels() -> bool:
    """True when numba's cache holds compiled kernels, so that a start need not wait for them."""
    import recon

    folder = os.environ.get("NUMBA_CACHE_DIR") or Path(recon.__file__).parent
    return any(Path(folder).rglob("*.nbi"))


def warm_up_command(prefix: str = sys.prefix) -> str:
    """The command that compiles the kernels where this installation looks for them."""
    if not _services_cache(prefix):
        return "skyrelief warm-up"
    return f"{AS_SERVICE} {INSTALLED}/current/bin/skyrelief warm-up"


def is_warm(version: str = "") -> bool:
    """True when this version (or ``version``) was warmed up with this cache or the service's."""
    marker = _marker(os.environ.get("NUMBA_CACHE_DIR", "") or _services_cache())
    try:
        return marker is not None and marker.read_text(encoding="utf-8") == (version or software())
    except OSError:
        return False


def _services_cache(prefix: str = sys.prefix) -> str:
    """Kernel cache of an installed service; empty for any other installation."""
    return SERVICE_CACHE if Path(prefix).is_relative_to(INSTALLED) else ""


def _marker(folder: str) -> Path | None:
    """Marker next to the kernels, one per installation: each version has its own kernels. None for
    kernels next to the sources, where versions cannot be distinguished."""
    return Path(folder) / f"{MARKER}-{Path(sys.prefix).name}" if folder else None
