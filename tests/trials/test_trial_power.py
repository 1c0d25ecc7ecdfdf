"""The power is cut while the aircraft scans: what had not reached the disk is gone.

The service keeps its data on a file system of its own, which the kernel shuts down without writing
anything more (``EXT4_IOC_SHUTDOWN``); the memory of all its processes is gone with it.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import random
import shutil
import signal
import struct
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import psutil  # type: ignore[import-untyped]
import pytest
from loopback import free_port, until
from pymavlink.dialects.v20 import ardupilotmega as dialect  # type: ignore[import-untyped]
from trial_autopilot import Autopilot
from trial_ground import Ground
from trial_rig import WHOLE, Chunk, Row, Service, back_limit_s, scan_folders, stored

from mavlink.component.camera import KeyframeReport
from service.daemon.resumption import MARK
from service.daemon.stored_image import store_image
from service.scans.writing import write_whole

pytestmark = [pytest.mark.trial, pytest.mark.timeout(7200 if WHOLE else 280)]

START, STOP = 2500, 2501
CUTS = 5 if WHOLE else 1
SHUTDOWN, WITHOUT_THE_LOG = 0x8004587D, struct.pack("I", 2)
"""Of Linux' ext4: ``_IOR('X', 125, __u32)`` and ``EXT4_GOING_FLAGS_NOLOGFLUSH``."""


class Disk:
    """An ext4 file system in a file, whose power can be cut."""

    def __init__(self, folder: Path) -> None:
        """OSError where it cannot be made."""
        self.place, self._image = folder / "disk", folder / "disk.img"
        self.place.mkdir()
        with self._image.open("wb") as file:
            file.truncate(1 << 33)  # more than scans must leave free
        try:
            _done(["mkfs.ext4", "-q", "-F", str(self._image)])
            self.mount()
        except subprocess.CalledProcessError as error:
            raise OSError(error.stderr.decode().strip()) from error

    def mount(self) -> None:
        """Attach it; after a cut its journal is replayed, as at a boot."""
        _done(["mount", "-o", "loop", str(self._image), str(self.place)])

    def unmount(self) -> None:
        """Detach it, once no process uses it any more."""
        command = ["umount", str(self.place)]
        until(lambda: subprocess.run(command, capture_output=True, check=False).returncode == 0)

    def cut(self) -> None:
        """From now on nothing reaches the disk."""
        held = os.open(self.place, os.O_RDONLY)
        try:
            fcntl.ioctl(held, SHUTDOWN, WITHOUT_THE_LOG)
        finally:
            os.close(held)


def _done(command: list[str]) -> None:
    subprocess.run(command, check=True, capture_output=True, timeout=60)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Disk]:
    """Skips where the machine does not permit one."""
    if shutil.which("mkfs.ext4") is None:
        pytest.skip("needs mkfs.ext4")
    try:
        disk = Disk(tmp_path)
    except OSError as error:
        pytest.skip(f"mounting a file as a disk needs root: {error}")
    try:
        yield disk
    finally:
        subprocess.run(["umount", "-l", str(disk.place)], check=False, capture_output=True)


def cut(service: Service, disk: Disk) -> set[Chunk]:
    """The power of the aircraft fails; the chunks that its store had acknowledged until then."""
    main = psutil.Process(service.process.pid)
    processes = set[psutil.Process]()
    while fresh := {main, *main.children(recursive=True)} - processes:
        for process in fresh:  # which starts no other one from now on
            with contextlib.suppress(psutil.NoSuchProcess):
                process.suspend()
        processes |= fresh
    acknowledged = stored(service.scans)
    disk.cut()
    for process in processes:
        with contextlib.suppress(psutil.NoSuchProcess):
            process.send_signal(signal.SIGKILL)
    service.process.wait()
    disk.unmount()
    disk.mount()
    mark = service.scans / MARK
    if mark.exists():
        mark.write_text("the boot before")  # the machine of this trial runs on
    return acknowledged


def write_photo(path: Path) -> None:
    store_image(path, np.zeros((48, 64, 3), np.uint8), KeyframeReport())


@pytest.mark.parametrize("write", [write_photo, lambda path: write_whole(path, "kept")])
def test_a_file_that_was_reported_survives_a_power_cut(
    write: Callable[[Path], None], disk: Disk
) -> None:
    path = disk.place / "folder" / "1.jpg"
    write(path)
    disk.cut()
    disk.unmount()
    disk.mount()
    assert path.stat().st_size > 0


def command(number: int) -> object:
    """A command to the camera."""
    return dialect.MAVLink_command_long_message(1, 100, number, 0, 0, 0, 0, 0, 0, 0, 0)


def test_a_power_cut_loses_nothing(disk: Disk, tmp_path: Path, record: Row) -> None:
    """At any moment: of the start, the scan, the recovery of the scans before, after a stop."""
    for needed in ("zenoh", "starlette", "uvicorn"):
        pytest.importorskip(needed)
    rng, scans, calm = random.Random(51), disk.place / "scans", "relief = false\n"
    link = free_port()
    autopilot = Autopilot(link)
    autopilot.armed.set()
    autopilot.start()
    aboard, back_s = set[Chunk](), list[float]()
    with Ground(tmp_path) as ground:
        more = f'[mavlink]\nlinks = ["udpin:127.0.0.1:{link}"]\n'
        more += f'[datalink]\nconnect = ["{ground.endpoint}"]\nbudget_kbit_s = 8000\n'

        def power_on() -> Service:
            return Service(tmp_path, "on-command", scans=scans, more=more, compute=calm)

        for k in range(CUTS):
            with power_on() as service:
                if k == 0:
                    service.until_up()
                    autopilot.asked.append(command(START))
                service.until(lambda s=service: s.frames > 0, "frames")  # type: ignore[misc]
                back_s.append(time.monotonic() - service.began_s)
                if k % 2 == 0:
                    before = stored(ground.store)
                    service.until(lambda b=before: stored(ground.store) - b, "chunks")  # type: ignore[misc]
                time.sleep(rng.uniform(0.0, 5.0))
                aboard |= cut(service, disk)
        with power_on() as service:
            service.until(lambda: service.frames > 0, "frames")
            back_s.append(time.monotonic() - service.began_s)
            autopilot.asked.append(command(STOP))
            service.until(lambda: STOP in autopilot.accepted, "stop")
            aboard |= cut(service, disk)
        with power_on() as service:
            service.until_up()
            for folder in scan_folders(scans):
                service.until((folder / "scan.json").is_file, f"files of {folder.name}")
            service.until(lambda: aboard <= stored(ground.store), "the rest at the ground")
            assert service.get()["state"] == "idle"  # it was stopped
            assert service.stop() == 0
        kept, sent = stored(scans), stored(ground.store)
        assert ground.stop() == 0, ground.said[-3000:]
    autopilot.ended.set()
    record(
        "power cut of a disk",
        CUTS + 1,
        "a new scan each time; none after a stop; all scans closed, kept, at the ground",
        f"{len((aboard | sent) - kept)} of {len(aboard | sent)} chunks",
        max(back_s),
    )
    assert len(aboard) > CUTS
    assert aboard | sent <= kept
    assert max(back_s) < back_limit_s()
    for folder in scan_folders(scans):
        assert json.loads((folder / "scan.json").read_text())["finished"] is True
        if folder.name in {name for name, *_ in aboard}:
            assert (folder / "cloud.laz").is_file()
            assert (folder / "link.tlog").stat().st_size > 0
    assert "is not used" not in service.log.read_text()  # of parameters
    assert any("Scan resumed after a restart" in text for text in autopilot.texts)
