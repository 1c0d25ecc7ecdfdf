"""``make bench ARGS=latency``: from the exposure of an image to the ground and its portal.

The whole system over a simulated flight: ``skyrelief run`` and ``skyrelief ground`` in processes
of their own, the link emulator between them. An image is exposed when the scan dates it, with the
camera's latency as the scan measures it. Poses are looked for every :data:`LOOK_S`; keyframes have
the times at which each end stored them. The camera's shutter is stated: otherwise the views of a
scan's first seconds wait until the images show it.
"""

from __future__ import annotations

import contextlib
import json
import struct
import subprocess
import tempfile
import threading
import time
import urllib.request
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from command_line import command_process

from service.bench import BenchOptions, BenchResult
from service.bench.link_emulator import LinkEmulator, LinkModel
from service.daemon.simulated import SimulatedFlight
from service.errors import OutsideError, SkyreliefError
from service.listener import free_ports
from service.packages import needing
from service.stream.ranges import RangeSet
from service.stream.store import ScanStore

LOOK_S = 0.01
PATIENCE_S = 240.0
"""From the start of both processes to the first keyframe at the ground, kernels compiled."""
LATE_S = 8.0
"""What is exposed in the flight may arrive for so long after it."""


@dataclass(frozen=True, slots=True)
class Trial:
    """A flight of camera.source, as long as it is watched, and the link."""

    source: str = "sim:?duration_s=60"
    watched_s: float = 60.0
    link: LinkModel = field(default_factory=lambda: LinkModel(5000.0, 0.02, 0.01))
    settings: tuple[str, ...] = ()  # of the daemon


@dataclass(slots=True, eq=False)
class Outcome:
    """Seconds from exposure, of each item that is exposed while the flight is watched."""

    delays_s: dict[str, list[float]]  # by place
    missing: int  # keyframes stored on board that did not reach the ground
    camera_ms: float  # latency of the camera, in the times of exposure; NaN: not known


PLACES = (
    "pose stored on board", "pose at the ground", "next keyframe exposed",
    "depth stored on board", "first depth at the ground", "coarse depth at the ground",
    "fine depth at the ground", "first depth at the portal's websocket",
    "depth at the portal's websocket",
)  # fmt: skip
"""In the order of the table. A keyframe waits for the next one, as its stereo partner; the first
depth is by a frame between them, or the keyframe's own where that comes before."""


def run(options: BenchOptions) -> list[BenchResult]:
    """Median and 95th percentile of each delay."""
    outcome = fly(Trial(settings=(f"compute.backend={options.backend}",)))
    rows: list[BenchResult] = []
    for place in PLACES:
        delays = outcome.delays_s[place]
        note = f"{len(delays)} items"
        for percent in (50, 95):
            value = float(np.percentile(delays, percent)) if delays else float("nan")
            rows.append(BenchResult(f"{place}, {percent} %", value, "s", note=note))
    rows.append(BenchResult("keyframes that did not reach the ground", outcome.missing, ""))
    rows.append(BenchResult("latency of the camera, part of all", outcome.camera_ms, "ms"))
    return rows


def fly(trial: Trial) -> Outcome:
    """Watch a flight; OutsideError when a process ends, or no keyframe reaches the portal."""
    with needing("bench latency"):
        import websockets.sync.client  # noqa: F401
        import zenoh  # noqa: F401
    SimulatedFlight(trial.source)  # rendered before anything is timed
    with tempfile.TemporaryDirectory() as folder, ExitStack() as open_now:
        return _fly(trial, Path(folder), open_now)


def _fly(trial: Trial, folder: Path, open_now: ExitStack) -> Outcome:
    at_ground, at_link, at_portal, at_status = free_ports(4)
    onboard, received = folder / "scans", folder / "ground"
    emulator = LinkEmulator(trial.link, at_link, at_ground)
    emulator.start()
    open_now.callback(emulator.close)
    settings = [
        f"camera.source={trial.source}", "camera.latency=auto", "camera.readout_ms=0",
        f"scan.folder={onboard}",
        f"health.http=127.0.0.1:{at_status}", f'datalink.connect=["tcp/127.0.0.1:{at_link}"]',
        f"datalink.budget_kbit_s={trial.link.rate_kbit_s}", "datalink.drain_s=0", *trial.settings,
    ]  # fmt: skip
    ends: list[tuple[subprocess.Popen[bytes], Path]] = []
    for words in (
        ["ground", "--listen", f"tcp/127.0.0.1:{at_ground}", "--store", str(received),
         "--portal", f"127.0.0.1:{at_portal}"],
        ["run", *(word for setting in settings for word in ("--set", setting))],
    ):  # fmt: skip
        log = folder / f"{words[0]}.log"
        ends.append((open_now.enter_context(command_process(log, *words)), log))
    drone = open_now.enter_context(_store(onboard, "*", ends))
    ground = open_now.enter_context(_store(received, "drones/*/*", ends))
    watch = _Watch(drone, ground)
    name = ground.path.parent
    portal = f"ws://127.0.0.1:{at_portal}/api/scans/{name.parent.name}/{name.name}/live"
    threading.Thread(target=watch.listen, args=(portal,), daemon=True).start()
    if not watch.until(lambda: bool(watch.shown), PATIENCE_S, ends):
        raise OutsideError(f"bench latency: no keyframe at the portal within {PATIENCE_S:g} s")
    began_ns = time.time_ns()
    watch.until(lambda: False, trial.watched_s, ends)
    ended_ns = time.time_ns()
    watch.until(lambda: False, LATE_S, ends)
    watch.is_over = True
    with (
        contextlib.suppress(OSError),
        urllib.request.urlopen(f"http://127.0.0.1:{at_status}/status", timeout=5) as answer,
    ):
        watch.camera_ms = json.load(answer).get("camera_latency_ms", watch.camera_ms)
    return watch.outcome(began_ns, ended_ns)


Ends = Sequence[tuple[subprocess.Popen[bytes], Path]]


def _check(ends: Ends) -> None:
    for process, log in ends:
        if process.poll() is not None:
            last = (log.read_text(errors="replace").strip().splitlines() or [""])[-1]
            raise OutsideError(f"skyrelief {log.stem} ended, code {process.returncode}: {last}")


def _store(below: Path, pattern: str, ends: Ends) -> ScanStore:
    """The only scan, once it is there."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        _check(ends)
        for path in below.glob(f"{pattern}/scan.db"):
            with contextlib.suppress(SkyreliefError):  # its header is not written yet
                return ScanStore.peek(path)
        time.sleep(LOOK_S)
    raise OutsideError(f"bench latency: no scan within {PATIENCE_S:g} s")


class _Watch:
    """Notes when poses and keyframes are where; all times in unix ns."""

    def __init__(self, drone: ScanStore, ground: ScanStore) -> None:
        self._stores = {"pose stored on board": drone, "pose at the ground": ground}
        self._known = {place: RangeSet() for place in self._stores}
        self._versions = dict.fromkeys(self._stores, (-1, -1))
        self._seen: dict[str, dict[int, int]] = {place: {} for place in self._stores}
        self.firsts: dict[int, int] = {}  # first depths at the ground
        self.shown: dict[int, int] = {}  # keyframes at the websocket, by a first depth or their own
        self.replaced: dict[int, int] = {}  # by their own
        self.camera_ms = float("nan")
        self.is_over = False

    def until(self, is_there: Callable[[], bool], seconds: float, ends: Ends) -> bool:
        """Watch until something is there, or for so long; whether it is there."""
        deadline = time.monotonic() + seconds
        while not is_there():
            if time.monotonic() > deadline:
                return False
            _check(ends)
            for place in self._stores:
                self._look(place)
            time.sleep(LOOK_S)
        return True

    def _look(self, place: str) -> None:
        store = self._stores[place]
        version = store.database.version()
        if version == self._versions[place]:
            return
        self._versions[place] = version
        new = list(store.poses_beside(self._known[place]))
        now_ns = time.time_ns()
        for (seq,) in store.database.all("SELECT number FROM radio WHERE kind = 'first'"):
            self.firsts.setdefault(seq, now_ns)
        for _, pose in new:
            self._seen[place].setdefault(pose.time_unix_ns, now_ns)

    def listen(self, url: str) -> None:
        """Note the keyframes that the portal shows, until the end."""
        from websockets.exceptions import WebSocketException
        from websockets.sync.client import connect

        while not self.is_over:
            with contextlib.suppress(OSError, WebSocketException), connect(url) as socket:
                for message in socket:
                    if isinstance(message, bytes):
                        (size,) = struct.unpack_from("<I", message)
                        said = json.loads(message[4 : 4 + size])
                        self.shown.setdefault(said["seq"], time.time_ns())
                        if said["layer"] >= 0:
                            self.replaced.setdefault(said["seq"], time.time_ns())
            time.sleep(LOOK_S)

    def outcome(self, began_ns: int, ended_ns: int) -> Outcome:
        """The delays of what was exposed between two times."""
        drone, ground = self._stores.values()
        stored, came = _keyframes(drone), _keyframes(ground)
        times = sorted(one[0] for (_, layer), one in stored.items() if layer == 0)
        following = dict(pairwise(times))
        delays: dict[str, list[float]] = {place: [] for place in PLACES}

        def note(place: str, exposed_ns: int, at_ns: int | None) -> None:
            if at_ns is not None:
                delays[place].append(1e-9 * (at_ns - exposed_ns))

        for place, poses in self._seen.items():
            for exposed_ns, at_ns in poses.items():
                if began_ns <= exposed_ns < ended_ns:
                    note(place, exposed_ns, at_ns)
        missing = 0
        for (seq, layer), (exposed_ns, at_ns) in stored.items():
            if not began_ns <= exposed_ns < ended_ns:
                continue
            _, came_ns = came.get((seq, layer), (0, None))
            if layer == 0:
                note("next keyframe exposed", exposed_ns, following.get(exposed_ns))
                note("depth stored on board", exposed_ns, at_ns)
                note("coarse depth at the ground", exposed_ns, came_ns)
                at_ground = [at for at in (self.firsts.get(seq), came_ns) if at is not None]
                note("first depth at the ground", exposed_ns, min(at_ground, default=None))
                note("first depth at the portal's websocket", exposed_ns, self.shown.get(seq))
                note("depth at the portal's websocket", exposed_ns, self.replaced.get(seq))
                missing += came_ns is None
            elif layer == 1:
                note("fine depth at the ground", exposed_ns, came_ns)
        return Outcome(delays, missing, self.camera_ms)


def _keyframes(store: ScanStore) -> dict[tuple[int, int], tuple[int, int]]:
    """Number and layer to the times of exposure and of storing."""
    rows = store.database.all("SELECT seq, layer, time_unix_ns, stored_unix_ns FROM chunks")
    return {(seq, layer): (exposed_ns, at_ns) for seq, layer, exposed_ns, at_ns in rows}
