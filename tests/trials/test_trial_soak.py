"""The soaks: flights one after the other, and one scan that does not end; what the processes hold.

The budgets of the map, of the views for loops and of the pose graph are set so small that the
first minutes fill them. The memory of short flights is compared at rest and at the same time
after each take-off. In the long scan the camera holds still for some seconds every minute:
what the pipeline works with comes and goes, and is gone then.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from scipy.stats import theilslopes
from trial_autopilot import Autopilot, aircraft
from trial_rig import PATIENCE_S, WHOLE, Chunk, Row, Service, scan_folders, stored

pytestmark = [pytest.mark.trial, pytest.mark.timeout(9000 if WHOLE else 280)]

MINUTES = float(os.environ.get("SKYRELIEF_SOAK_MINUTES", "60" if WHOLE else "0.1"))
FLIGHTS = 12 if MINUTES >= 6 else 2
LONG_S = 60.0 * MINUTES
SHORT_S = LONG_S / FLIGHTS
"""Of the long scan, and of each of the flights."""

SIZE = "480x270" if WHOLE else "320x180"
"""Of the images."""

WARM_SHARE = 0.3
"""Of the flights, before memory is watched: caches, pools and budgets fill."""

FLAT_MIB_PER_H = 1.0
STILL_EVERY_S, STILL_S = 60.0, 7.0
"""From one stillness of the camera to the next, and how long it lasts: the pipeline comes to rest,
and freed memory is given back every two seconds."""

MAP, LOOPS = "map_voxels = 20000\n", "[fusion]\nloop_views = 40\ngraph_keyframes = 100\n"
"""Budgets that are full within a minute."""

COUNTS = (
    "frames", "clouds", "map_voxels", "map_tiles_on_disk", "loop_views", "graph_keyframes",
)  # fmt: skip


def there_and_back(folder: Path) -> tuple[Path, Path]:
    """(video, camera model) of a flight to and fro, which can be shown in a loop.

    SKYRELIEF_SOAK_FLIGHT names a folder that ``skyrelief simulate`` made; else one is made.
    """
    flight = Path(os.environ.get("SKYRELIEF_SOAK_FLIGHT", folder / "flight"))
    if not flight.is_dir():
        simulate = [sys.executable, "-m", "service.cli", "simulate", "--out", str(flight)]
        plan = ["--size", SIZE, "--duration-s", "24" if WHOLE else "2", "--fps", "10"]
        subprocess.run(
            [*simulate, *plan, "--speed-m-s", "8"], check=True, capture_output=True, timeout=900
        )
    loop = folder / "loop.mp4"
    command = f"ffmpeg -v error -y -i {flight}/flight.mp4 -filter_complex"
    chain = "[0]split[a][b];[b]reverse[r];[a][r]concat"
    subprocess.run(
        [*shlex.split(command), chain, "-c:v", "libx264", "-preset", "veryfast", str(loop)],
        check=True,
        timeout=280,
    )
    return loop, flight / "camera.yaml"


LANDED = -1.0


@dataclass(frozen=True, slots=True)
class Sample:
    """Figures of one moment of one flight."""

    flight: int
    flying_s: float  # LANDED: at rest after it
    hours: float  # of the soak
    memory_mib: float  # resident, of the service and its own processes
    files: int
    frames: int
    keyframes: int  # in flight clouds, of which a keyframe has some
    budgets: tuple[int, ...]  # voxels in memory, tiles on disk, views for loops, nodes
    own_mib: float = 0.0  # of that memory, what is in no file
    still: bool = False  # nothing came from the camera


class Held(NamedTuple):
    """Memory and files of a process and its children.

    ``own_mib`` leaves out pages of files (libraries), which the kernel drops and reads again.
    """

    mib: float
    own_mib: float
    files: int


def held(pid: int) -> Held:
    """Memory and files of the process now."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    kib = {line.split(":")[0]: float(line.split()[1]) for line in lines if line.endswith(" kB")}
    children: list[Held] = []
    for thread in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(OSError, KeyError):  # the thread or the child has ended
            children += [held(int(child)) for child in (thread / "children").read_text().split()]
    return Held(
        kib["VmRSS"] / 1024.0 + sum(child.mib for child in children),
        (kib["RssAnon"] + kib["RssShmem"]) / 1024.0 + sum(child.own_mib for child in children),
        len(os.listdir(f"/proc/{pid}/fd")) + sum(child.files for child in children),
    )


def flown(
    service: Service, autopilot: Autopilot, begin_s: float, number: int, long_s: float,
    camera: subprocess.Popen[bytes] | None = None,
) -> list[Sample]:  # fmt: skip
    """The samples of one flight of ``long_s``, from arming to the closed scan.

    The ``camera`` holds still now and then.
    """
    scans = set(scan_folders(service.scans))
    autopilot.armed.set()
    service.until(lambda: service.get().get("clouds", 0) > 0, "a keyframe")
    start, out = time.monotonic(), []
    still_at_s = STILL_EVERY_S
    while (flying_s := time.monotonic() - start) < long_s:
        is_still = camera is not None and flying_s > still_at_s
        if camera is not None and is_still:
            still_at_s += STILL_EVERY_S
            camera.send_signal(signal.SIGSTOP)
            time.sleep(STILL_S)
        status = service.get()
        now = held(service.process.pid)
        hours = (time.monotonic() - begin_s) / 3600.0
        frames, clouds, *budgets = (int(status.get(name, 0)) for name in COUNTS)
        counts = (now.files, frames, clouds, tuple(budgets))
        out.append(Sample(number, flying_s, hours, now.mib, *counts, now.own_mib, is_still))
        if camera is not None and is_still:
            camera.send_signal(signal.SIGCONT)
        assert service.process.poll() is None
        time.sleep(min(2.0, 0.1 * long_s))
    assert not status["fault"]
    autopilot.armed.clear()
    limit_s = max(PATIENCE_S, long_s)  # closing a long scan takes minutes next to other work
    service.until(lambda: service.get().get("state") == "idle", "landing", limit_s)
    time.sleep(5.0 if WHOLE else 0.0)  # until what the scan held is given back
    now = held(service.process.pid)
    hours = (time.monotonic() - begin_s) / 3600.0
    (folder,) = set(scan_folders(service.scans)) - scans
    assert (folder / "cloud.laz").is_file()
    keyframes = int(json.loads((folder / "scan.json").read_text())["counts"]["keyframes"])
    landed = replace(out[-1], flying_s=LANDED, hours=hours, keyframes=keyframes, files=now.files)
    return [*out, replace(landed, memory_mib=now.mib, own_mib=now.own_mib)]


def slope_mib_per_h(samples: list[Sample]) -> float:
    """Median slope between flights, over all pairs at the same time after take-off (Theil-Sen)."""
    bins: dict[int, list[Sample]] = {}
    for sample in samples:
        bins.setdefault(int(sample.flying_s // 5.0), []).append(sample)
    slopes = [
        (b.memory_mib - a.memory_mib) / (b.hours - a.hours)
        for same in bins.values()
        for a, b in itertools.combinations(same, 2)
        if a.flight != b.flight
    ]
    return float(np.median(slopes))


Slope = tuple[float, float, float]
"""MiB/h and the ends of its interval of 90 %."""


def slope_at_rest(samples: list[Sample], memory: Callable[[Sample], float]) -> Slope:
    """MiB/h of ``memory`` after the landings by Theil and Sen, and the ends of its interval of
    90 %."""
    rest = [s for s in samples if s.flying_s == LANDED]
    found = theilslopes([memory(s) for s in rest], [s.hours for s in rest], 0.9)
    return float(found[0]), float(found[2]), float(found[3])


def slope_within(samples: list[Sample], memory: Callable[[Sample], float]) -> Slope:
    """MiB/h of ``memory`` in one scan, while the camera held still, after its budgets were
    filled; by Theil and Sen, with the ends of its interval of 90 %."""
    late_s = WARM_SHARE * max(s.flying_s for s in samples)
    still = [s for s in samples if s.still and s.flying_s > late_s]
    found = theilslopes([memory(s) for s in still], [s.hours for s in still], 0.9)
    return float(found[0]), float(found[2]), float(found[3])


def in_words(slope: Slope) -> str:
    """The slope with its interval."""
    return f"{slope[0]:+.1f} ({slope[1]:+.1f} to {slope[2]:+.1f}) MiB/h"


def kib_per_keyframe(samples: list[Sample]) -> float:
    """Growth within a flight, in its second half; the median over flights."""
    out = []
    for _, group in itertools.groupby(samples, lambda s: s.flight):
        flight = list(group)
        half = [s for s in flight if s.flying_s > 0.5 * max(s.flying_s for s in flight)]
        keyframes = np.array([s.keyframes for s in half], np.float64)
        if np.ptp(keyframes) > 5:
            memory = 1024.0 * np.array([s.memory_mib for s in half])
            out.append(float(np.polyfit(keyframes, memory, 1)[0]))
    return float(np.median(out)) if out else float("nan")


needs_ffmpeg = pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg")


@dataclass(frozen=True, slots=True)
class Bench:
    """A service on a bench: a camera that never ends, an autopilot to arm."""

    service: Service
    autopilot: Autopilot
    camera: subprocess.Popen[bytes]
    folder: Path

    def fly(self, flights: int, long_s: float, still: bool = False) -> tuple[list[Sample], str]:
        """Every sample of so many flights of ``long_s``, and how many chunks were lost.

        ``still``: the camera holds still now and then.
        """
        samples: list[Sample] = []
        acknowledged: set[Chunk] = set()
        self.service.until_up()
        begin_s = time.monotonic()
        for number in range(flights):
            camera = self.camera if still else None
            samples += flown(self.service, self.autopilot, begin_s, number, long_s, camera)
            acknowledged |= stored(self.service.scans)
        assert self.service.stop() == 0
        lost = acknowledged - stored(self.service.scans)
        (self.folder / "samples.json").write_text(json.dumps([asdict(s) for s in samples]))
        assert acknowledged
        assert not lost
        return samples, f"{len(lost)} of {len(acknowledged)} chunks"


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    video, model = there_and_back(tmp_path)
    if WHOLE:  # as the installer does: who compiles keeps the compiler's memory
        warm_up = [sys.executable, "-m", "service.cli", "warm-up"]
        subprocess.run(warm_up, check=True, capture_output=True, timeout=900)
    streamed = SIZE.replace("x", ":"), f"-i {video}"
    with aircraft(tmp_path, streamed, model, "on-arm", MAP, LOOPS) as (service, autopilot, sender):
        yield Bench(service, autopilot, sender, tmp_path)


@needs_ffmpeg
def test_flights_one_after_the_other(bench: Bench, record: Row) -> None:
    samples, lost = bench.fly(FLIGHTS, SHORT_S)
    is_leaking = tell_flights(samples, record, lost)
    assert not (is_leaking and MINUTES >= 60.0)  # over less the slope is noise


@needs_ffmpeg
@pytest.mark.skipif(MINUTES < 6.0, reason="only in the whole form of the trials")
def test_one_long_scan(bench: Bench, record: Row) -> None:
    samples, lost = bench.fly(1, LONG_S, still=True)
    is_leaking = tell_scan(samples, record, lost)
    assert not (is_leaking and MINUTES >= 60.0)


def tell_flights(samples: list[Sample], record: Row, lost: str) -> bool:
    """Write the row of the short flights; True when memory at rest grows beyond doubt."""
    warm = max(1, round(WARM_SHARE * FLIGHTS)) if FLIGHTS > 2 else 0
    late = [s for s in samples if s.flight >= warm]
    slope, files = slope_mib_per_h([s for s in late if s.flying_s != LANDED]), late[-1].files
    rest = slope_at_rest(late, lambda s: s.memory_mib)
    own = slope_at_rest(late, lambda s: s.own_mib)
    ends = [[s for s in samples if s.flight == n][-1] for n in range(FLIGHTS)]
    growth = files - ends[warm].files
    voxels, tiles, views, nodes = (
        max(column) for column in zip(*(e.budgets for e in ends), strict=True)
    )
    flying = max(s.memory_mib for s in late)
    record(
        f"soak of {MINUTES:g} minutes: flights one after the other",
        FLIGHTS,
        f"of {SHORT_S:.0f} s each, {sum(e.frames for e in ends)} frames, "
        f"{sum(e.keyframes for e in ends)} keyframes; after "
        f"the first {warm} flights: at rest {ends[-1].memory_mib:.0f} MiB, slope {in_words(rest)}, "
        f"without pages of files {ends[-1].own_mib:.0f} MiB, slope {in_words(own)}; "
        f"in flight up to {flying:.0f} MiB, slope {slope:+.1f} "
        f"MiB/h; within a flight {kib_per_keyframe(late):+.1f} KiB a keyframe, the map at {voxels} "
        f"voxels and {tiles} tiles on disk, {views} views for loops, {nodes} keyframes in the pose "
        f"graph; files open at rest {files}, growth {growth:+d}",
        lost,
    )
    assert growth <= 2
    return rest[1] >= FLAT_MIB_PER_H  # 95 % sure of more: a leak


def tell_scan(samples: list[Sample], record: Row, lost: str) -> bool:
    """Write the row of the long scan; True when memory grows within it beyond doubt."""
    flying = [s for s in samples if s.flying_s != LANDED]
    end = [s for s in flying if s.still][-1]
    slope = slope_within(flying, lambda s: s.memory_mib)
    record(
        f"soak of {MINUTES:g} minutes: one scan",
        1,
        f"of {LONG_S / 60.0:.0f} minutes, {end.frames} frames, {samples[-1].keyframes} keyframes, "
        f"{end.budgets[3]} of them in the pose graph; after the first {100 * WARM_SHARE:.0f} %, "
        f"whenever the camera held still: the service at {end.memory_mib:.0f} MiB, "
        f"slope {in_words(slope)}",
        lost,
    )
    return slope[1] >= FLAT_MIB_PER_H
