"""The long trials: hours of scanning, and a ground station that is gone for minutes."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from trial_rig import BACK_S, WHOLE, Row, Service, free_port, stored, stream_to

pytestmark = [pytest.mark.trial, pytest.mark.timeout(7200 if WHOLE else 280)]

MINUTES = float(os.environ.get("SKYRELIEF_SOAK_MINUTES", "60" if WHOLE else "0.25"))
WARM_SHARE = 0.3
"""Of the soak, before memory is watched: caches and the map fill."""

FLAT_MIB_PER_H = 1.0


def there_and_back(folder: Path) -> tuple[Path, Path]:
    """(video, camera model) of a flight to and fro, which can be shown in a loop.

    SKYRELIEF_SOAK_FLIGHT names a folder that ``skyrelief simulate`` made; else one is made.
    """
    flight = Path(os.environ.get("SKYRELIEF_SOAK_FLIGHT", folder / "flight"))
    if not flight.is_dir():
        simulate = [sys.executable, "-m", "service.cli", "simulate", "--out", str(flight)]
        size = ["--size", "480x270", "--duration-s", "15", "--fps", "10"]
        subprocess.run([*simulate, *size], check=True, capture_output=True, timeout=600)
    loop = folder / "loop.mp4"
    command = f"ffmpeg -v error -y -i {flight}/flight.mp4 -filter_complex"
    chain = "[0]split[a][b];[b]reverse[r];[a][r]concat"
    subprocess.run(
        [*shlex.split(command), chain, "-c:v", "libx264", "-preset", "veryfast", str(loop)],
        check=True,
        timeout=280,
    )
    return loop, flight / "camera.yaml"


def resident_mib(pid: int) -> float:
    """Resident memory of a process."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return float(line.split()[1]) / 1024.0
    raise AssertionError("the process is gone")


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg")
def test_soak(tmp_path: Path, record: Row) -> None:
    video, model = there_and_back(tmp_path)
    port = free_port()
    sender = stream_to(port, "480:270", f"-i {video}")
    samples: list[tuple[float, float, int]] = []
    try:
        camera = f"stream:udp://127.0.0.1:{port}"
        with Service(tmp_path, camera=camera, model=model) as service:
            service.until(lambda: stored(service.scans), "a chunk")
            pid, start = service.process.pid, time.monotonic()
            while (elapsed_s := time.monotonic() - start) < 60.0 * MINUTES:
                files = len(os.listdir(f"/proc/{pid}/fd"))
                samples.append((elapsed_s / 3600.0, resident_mib(pid), files))
                time.sleep(min(2.0, 6.0 * MINUTES))
            status = service.get()
            assert service.process.poll() is None
            assert service.stop() == 0
    finally:
        sender.kill()
        sender.wait()
    hours, memory, files_open = np.array(samples).T
    late = hours >= WARM_SHARE * hours[-1]
    slope = float(np.polyfit(hours[late], memory[late], 1)[0])
    growth = int(files_open[late].max() - files_open[late][0])
    record(
        f"soak of {MINUTES:g} minutes",
        1,
        f"{status['frames']} frames, {status['clouds']} keyframes; memory {memory[-1]:.0f} MiB, "
        f"slope {slope:+.1f} MiB/h; files open {files_open[-1]:.0f}, growth {growth}",
        "nothing",
    )
    assert not status["fault"]
    assert growth <= 2
    if MINUTES >= 60.0:  # over less the slope is noise
        assert slope < FLAT_MIB_PER_H


def test_ground_gone_for_minutes(tmp_path: Path, record: Row) -> None:
    pytest.importorskip("zenoh")
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    store, gone_s = tmp_path / "ground", 180.0 if WHOLE else 5.0
    command = [sys.executable, "-m", "service.cli", "ground", "--store", str(store)]
    command += ["--listen", endpoint]

    def ground() -> subprocess.Popen[bytes]:
        with (tmp_path / "ground.log").open("ab") as log:
            return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)

    link = f'[datalink]\nconnect = ["{endpoint}"]\nbudget_kbit_s = 8000\n'
    receiver = ground()
    try:
        with Service(tmp_path, more=link) as service:
            service.until(lambda: stored(store), "a chunk at the ground")
            receiver.kill()
            receiver.wait()
            time.sleep(gone_s)
            aboard = stored(service.scans)
            receiver = ground()
            back_s = service.until(lambda: aboard <= stored(store), "what was missed")
            scanned_on = bool(stored(service.scans))
            service.stop()
    finally:
        receiver.kill()
        receiver.wait()
    lost = aboard - stored(store)
    record(
        f"ground station gone for {gone_s:g} s",
        1,
        "fetches what it missed",
        f"{len(lost)} of {len(aboard)} chunks",
        back_s,
    )
    assert scanned_on
    assert not lost
    assert back_s < 6.0 * BACK_S
