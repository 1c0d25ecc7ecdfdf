"""Readings of the machine: heat, throttling, power, memory, disk, as far as available.

psutil reads what every machine has; heat, power and limits differ from board to board and come from
the kernel's files, which tests have below another ``root`` than ``/``.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import psutil  # type: ignore[import-untyped]

from mavlink.component.status import ComputerLoad
from service.scans.writing import existing

THROTTLED_NOW = 0b1111  # Raspberry Pi: under-voltage, frequency capped, throttled, soft limit


@dataclass(frozen=True, slots=True)
class Machine:
    """Readings at one time; None where not available."""

    model: str
    temperature_c: float | None = None  # the hottest sensor
    throttled: bool | None = None  # now, by heat or low supply voltage
    power_w: float | None = None  # total
    memory_free_mib: float | None = None  # available without swapping
    memory_total_mib: float | None = None
    memory_limit_free_mib: float | None = None  # below the service's own limit
    resident_mib: float | None = None  # of this process
    load: float | None = None  # runnable threads per core, 1 minute
    disk_free_mib: float | None = None
    disk_total_mib: float | None = None

    @property
    def memory_left_mib(self) -> float | None:
        """Memory available to this process: of the machine, or below its own limit."""
        known = [m for m in (self.memory_free_mib, self.memory_limit_free_mib) if m is not None]
        return min(known, default=None)

    def to_dict(self) -> dict[str, Any]:
        return {key: value for key, value in asdict(self).items() if value is not None}


def computer_load(machine: Machine, cores: Sequence[float], keep_free_mib: float) -> ComputerLoad:
    """The readings, and the load of each ``cores`` in per cent, in the form sent over MAVLink."""

    def used(free: float | None, total: float | None) -> float | None:
        return None if free is None or total is None else total - free

    free = machine.disk_free_mib
    return ComputerLoad(
        cpu_percent=tuple(cores),
        temperature_c=machine.temperature_c,
        ram_used_mib=used(machine.memory_free_mib, machine.memory_total_mib),
        ram_total_mib=machine.memory_total_mib,
        storage_used_mib=used(free, machine.disk_total_mib),
        storage_total_mib=machine.disk_total_mib,
        throttled=bool(machine.throttled),
        disk_full=free is not None and free < max(100.0, 0.5 * keep_free_mib),
    )


def read_machine(disk: Path, root: Path = Path("/")) -> Machine:
    """The readings now; ``disk`` is any path on the disk of the scans."""
    disk_free_mib, disk_total_mib = _disk_mib(disk)
    memory = psutil.virtual_memory()
    return Machine(
        model=_text(root / "proc/device-tree/model") or os.uname().machine,
        temperature_c=_hottest(root),
        throttled=_throttled(root),
        power_w=_power_w(root),
        memory_free_mib=memory.available / 2**20,
        memory_total_mib=memory.total / 2**20,
        memory_limit_free_mib=_limit_free_mib(root),
        resident_mib=psutil.Process().memory_info().rss / 2**20,
        load=os.getloadavg()[0] / (os.cpu_count() or 1),
        disk_free_mib=disk_free_mib,
        disk_total_mib=disk_total_mib,
    )


def _limit_free_mib(root: Path) -> float | None:
    """Memory below the tightest limit of our control groups (v2); None without a limit."""
    line = _text(root / "proc/self/cgroup")
    if not line.startswith("0::/"):
        return None
    group = Path(line.removeprefix("0::/"))
    rooms = []
    for part in (group, *group.parents):
        folder = root / "sys/fs/cgroup" / part
        limit, used = _number(folder / "memory.max"), _number(folder / "memory.current")
        if limit is not None and used is not None:
            cache = 0.0
            for entry in _text(folder / "memory.stat").splitlines():
                if entry.startswith("inactive_file "):
                    cache = float(entry.split()[1])
            rooms.append((limit - used + cache) / 2**20)
    return min(rooms, default=None)


def _hottest(root: Path) -> float | None:
    zones = (root / "sys/class/thermal").glob("thermal_zone*/temp")
    found = [t / 1000.0 for zone in zones if (t := _number(zone)) is not None]
    return max((t for t in found if -40.0 < t < 150.0), default=None)


def _throttled(root: Path) -> bool | None:
    """Throttling state of a Raspberry Pi's firmware, or an active cooling device of a Jetson."""
    word = _text(root / "sys/devices/platform/soc/soc:firmware/get_throttled")
    if word:
        return bool(int(word, 16) & THROTTLED_NOW)
    active = []
    for device in (root / "sys/class/thermal").glob("cooling_device*"):
        kind, state = _text(device / "type"), _number(device / "cur_state")
        if state is not None and "fan" not in kind.lower():
            active.append(state > 0)
    return any(active) if active else None


def _power_w(root: Path) -> float | None:
    """Power of the input rail: an INA3221 of a Jetson gives volts and amperes per channel."""
    for label in (root / "sys/class/hwmon").glob("hwmon*/in[123]_label"):
        sensor, channel = label.parent, label.name[2]
        if "ina" in _text(sensor / "name") and "VDD_IN" in _text(label):
            volts = _number(sensor / f"in{channel}_input")
            amperes = _number(sensor / f"curr{channel}_input")
            if volts is not None and amperes is not None:
                return volts * amperes / 1e6
    return None


def _disk_mib(disk: Path) -> tuple[float | None, float | None]:
    """(free, total) of the disk that holds ``disk`` or the nearest folder above it."""
    try:
        usage = shutil.disk_usage(existing(disk))
    except OSError:
        return None, None
    return usage.free / 2**20, usage.total / 2**20


def _number(path: Path) -> float | None:
    text = _text(path)
    try:
        return float(text) if text else None
    except ValueError:
        return None


def _text(path: Path) -> str:
    """Contents without trailing zeros and blanks; empty when it cannot be read."""
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip("\0\n ")
    except OSError:
        return ""
