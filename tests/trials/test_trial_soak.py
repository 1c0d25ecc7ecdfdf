"""The soak: an hour of flights, one after the other, and what the process holds at the end.

The budgets of the map and of the views for loops are set so small that the first flights fill
them. A flight's own record, the pose graph above all, grows with its keyframes and ends with it;
so memory is compared flight by flight, at the same time after each take-off.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import shlex
import shutil
import subprocess
import sys
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from loopback import free_port
from scipy.stats import theilslopes
from trial_autopilot import Autopilot
from trial_rig import WHOLE, Chunk, Row, Service, stored, stream_to

pytestmark = [pytest.mark.trial, pytest.mark.timeout(9000 if WHOLE else 280)]

MINUTES = float(os.environ.get("SKYRELIEF_SOAK_MINUTES", "60" if WHOLE else "0.1"))
FLIGHTS = 12 if MINUTES >= 6 else 2
WARM_SHARE = 0.3
"""Of the flights, before memory is watched: caches, pools and budgets fill."""

FLAT_MIB_PER_H = 1.0
MAP, LOOPS = "map_voxels = 20000\n", "[fusion]\nloop_views = 40\n"
"""Budgets that are full within a minute."""

COUNTS = ("frames", "clouds", "map_voxels", "map_tiles_on_disk", "loop_views")


def there_and_back(folder: Path) -> tuple[Path, Path]:
    """(video, camera model) of a flight to and fro, which can be shown in a loop.

    SKYRELIEF_SOAK_FLIGHT names a folder that ``skyrelief simulate`` made; else one is made.
    """
    flight = Path(os.environ.get("SKYRELIEF_SOAK_FLIGHT", folder / "flight"))
    if not flight.is_dir():
        simulate = [sys.executable, "-m", "service.cli", "simulate", "--out", str(flight)]
        size = ["--size", "480x270", "--duration-s", "24" if WHOLE else "4", "--fps", "10"]
        subprocess.run(
            [*simulate, *size, "--speed-m-s", "8"], check=True, capture_output=True, timeout=900
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
    """What was seen at one moment of one flight."""

    flight: int
    aloft_s: float  # LANDED: at rest after it
    hours: float  # of the soak
    memory_mib: float  # resident, of the service and its own processes
    files: int
    frames: int
    keyframes: int
    budgets: tuple[int, int, int]  # voxels in memory, tiles on disk, views for loops


def held(pid: int) -> tuple[float, int]:
    """(MiB resident, open files) of a process and its children."""
    text = Path(f"/proc/{pid}/status").read_text()
    rows = [line.split() for line in text.splitlines() if line.startswith("VmRSS:")]
    mib, files = float(rows[0][1]) / 1024.0, len(os.listdir(f"/proc/{pid}/fd"))
    for thread in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(OSError, IndexError):  # the thread or the child has ended
            for child in (thread / "children").read_text().split():
                more = held(int(child))
                mib, files = mib + more[0], files + more[1]
    return mib, files


def flown(service: Service, autopilot: Autopilot, begin_s: float, number: int) -> list[Sample]:
    """The samples of one flight, from arming to the closed scan."""
    scans = set(service.scans.glob("*"))
    autopilot.armed.set()
    service.until(lambda: service.get().get("clouds", 0) > 0, "a keyframe")
    start, out = time.monotonic(), []
    long_s = 60.0 * MINUTES / FLIGHTS
    while (aloft_s := time.monotonic() - start) < long_s:
        status = service.get()
        mib, files = held(service.process.pid)
        hours = (time.monotonic() - begin_s) / 3600.0
        counts = [int(status.get(name, 0)) for name in COUNTS]
        budgets = (counts[2], counts[3], counts[4])
        out.append(Sample(number, aloft_s, hours, mib, files, counts[0], counts[1], budgets))
        assert service.process.poll() is None
        time.sleep(min(2.0, 0.1 * long_s))
    assert not status["fault"]
    autopilot.armed.clear()
    service.until(lambda: service.get().get("state") == "idle", "landing")
    time.sleep(2.0)  # until what the scan held is given back
    mib, files = held(service.process.pid)
    hours = (time.monotonic() - begin_s) / 3600.0
    out.append(replace(out[-1], aloft_s=LANDED, hours=hours, memory_mib=mib, files=files))
    (folder,) = set(service.scans.glob("*")) - scans
    assert (folder / "cloud.laz").is_file()
    return out


def slope_mib_per_h(samples: list[Sample]) -> float:
    """Median slope between flights, over all pairs at the same time after take-off (Theil-Sen)."""
    bins: dict[int, list[Sample]] = {}
    for sample in samples:
        bins.setdefault(int(sample.aloft_s // 5.0), []).append(sample)
    slopes = [
        (b.memory_mib - a.memory_mib) / (b.hours - a.hours)
        for same in bins.values()
        for a, b in itertools.combinations(same, 2)
        if a.flight != b.flight
    ]
    return float(np.median(slopes))


def slope_at_rest(samples: list[Sample]) -> tuple[float, float, float]:
    """MiB/h after the landings by Theil and Sen, and the ends of its interval of 90 %."""
    rest = [s for s in samples if s.aloft_s == LANDED]
    x, y = [s.hours for s in rest], [s.memory_mib for s in rest]
    found = theilslopes(y, x, 0.9)
    return float(found[0]), float(found[2]), float(found[3])


def kib_per_keyframe(samples: list[Sample]) -> float:
    """Growth within a flight, in its second half; the median over flights."""
    out = []
    for _, group in itertools.groupby(samples, lambda s: s.flight):
        flight = list(group)
        half = [s for s in flight if s.aloft_s > 0.5 * max(s.aloft_s for s in flight)]
        keyframes = np.array([s.keyframes for s in half], np.float64)
        if np.ptp(keyframes) > 5:
            memory = 1024.0 * np.array([s.memory_mib for s in half])
            out.append(float(np.polyfit(keyframes, memory, 1)[0]))
    return float(np.median(out)) if out else float("nan")


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg")
def test_soak(tmp_path: Path, record: Row) -> None:
    video, model = there_and_back(tmp_path)
    port, link = free_port(), free_port()
    autopilot = Autopilot(link, attitude=False)
    autopilot.start()
    sender = stream_to(port, "480:270", f"-i {video}")
    samples: list[Sample] = []
    acknowledged: set[Chunk] = set()
    more = f'{LOOPS}[mavlink]\nlinks = ["udpin:127.0.0.1:{link}"]\n'
    try:
        camera = f"stream:udp://127.0.0.1:{port}"
        with Service(tmp_path, "on-arm", None, camera, model, more=more, compute=MAP) as service:
            service.until_up()
            begin_s = time.monotonic()
            for number in range(FLIGHTS):
                samples += flown(service, autopilot, begin_s, number)
                acknowledged |= stored(service.scans)
            assert service.stop() == 0
            lost = acknowledged - stored(service.scans)
    finally:
        autopilot.ended.set()
        sender.kill()
        sender.wait()
    (tmp_path / "samples.json").write_text(json.dumps([asdict(s) for s in samples]))
    warm = max(1, round(WARM_SHARE * FLIGHTS)) if FLIGHTS > 2 else 0
    late = [s for s in samples if s.flight >= warm]
    slope, files = slope_mib_per_h([s for s in late if s.aloft_s != LANDED]), late[-1].files
    rest, low, high = slope_at_rest(late)
    ends = [[s for s in samples if s.flight == n][-1] for n in range(FLIGHTS)]
    growth = files - ends[warm].files
    voxels, tiles, views = (max(column) for column in zip(*(e.budgets for e in ends), strict=True))
    aloft = max(s.memory_mib for s in late)
    record(
        f"soak of {MINUTES:g} minutes: flights one after the other",
        FLIGHTS,
        f"{sum(e.frames for e in ends)} frames, {sum(e.keyframes for e in ends)} keyframes; after "
        f"the first {warm} flights: at rest {ends[-1].memory_mib:.0f} MiB, slope {rest:+.1f} "
        f"({low:+.1f} to {high:+.1f}) MiB/h; aloft up to {aloft:.0f} MiB, slope {slope:+.1f} "
        f"MiB/h; within a flight {kib_per_keyframe(late):+.1f} KiB a keyframe, the map at {voxels} "
        f"voxels and {tiles} tiles on disk, {views} views for loops; files open at rest {files}, "
        f"growth {growth:+d}",
        f"{len(lost)} of {len(acknowledged)} chunks",
    )
    assert acknowledged
    assert not lost
    assert growth <= 2
    if MINUTES >= 60.0:  # over less the slope is noise
        assert low < FLAT_MIB_PER_H  # 95 % sure of more: a leak
