"""ArduPilot's onboard log (.BIN), read by pymavlink's DFReader."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mavlink.telemetry.decode import (
    DOWNWARD,
    HDOP_TO_M,
    MAX_RATE_RAD_S,
    TERRAIN_MODEL_SIGMA_M,
    plausible_place,
    receiver_accuracy,
)
from mavlink.telemetry.history import HistoryConfig, VehicleHistory
from mavlink.telemetry.logs import NEIGHBOUR_S, TelemetryLog, finish, values_near
from mavlink.telemetry.quaternion import Vector, from_degrees
from mavlink.telemetry.samples import (
    AccuracySample,
    AttitudeSample,
    GimbalFrame,
    GimbalSample,
    PositionSample,
    RangeSample,
    Sample,
    TerrainSample,
)
from mavlink.wire.tlog import LATEST_USEC

HEADER = b"\xa3\x95"
UNIX_FROM_S = 1e9
FRESH_S = 0.25
NEAR_S = 0.05  # rates of the body are known so long before and after a sample of theirs

GOOD = 4  # RangeFinder status


def load(path: Path, config: HistoryConfig) -> TelemetryLog:
    """The history in a .BIN log, on GPS time when the log has it, otherwise since boot."""
    with path.open("rb") as file:
        if file.read(2) != HEADER:
            raise ValueError(f"{path}: not an ArduPilot .BIN log")
    history = VehicleHistory(config)
    counts: Counter[str] = Counter()
    reader = _Reader()
    is_placed = False
    attitudes: list[tuple[AttitudeSample, float]] = []
    for message in _in_time(_messages(path, counts)):
        name = message.get_type()
        counts[name] += 1
        sample = reader.sample(name, message)
        if sample is not None:
            is_placed |= isinstance(sample, PositionSample)
            if isinstance(sample, AttitudeSample):
                attitudes.append((sample, message._timestamp))
            else:
                history.add(sample, round(message._timestamp * 1e9))
    for fix, time_s in reader.fixes:
        is_missing = not (counts["GPA"] if isinstance(fix, AccuracySample) else is_placed)
        if is_missing:
            history.add(fix, round(time_s * 1e9))
    for attitude, time_s in _turning(attitudes, reader.rates["RATE"] or reader.rates["IMU"]):
        history.add(attitude, round(time_s * 1e9))
    dated = (history.first_ns or 0) > UNIX_FROM_S * 1e9
    warnings = [] if dated else ["no GPS time in this log: its clock starts at boot"]
    if counts["skipped_bytes"]:
        warnings.append(f"{counts['skipped_bytes']} damaged bytes were skipped")
    return finish(path, history, counts, warnings, "unix" if dated else "boot")


def _in_time(messages: Iterable[Any]) -> Iterator[Any]:
    """The messages that are close in time to the one before or after them."""
    before_s = -math.inf
    alone = None  # far from the one before
    for message in messages:
        time_s = message._timestamp
        if not 0.0 <= time_s < 1e-6 * LATEST_USEC:
            continue
        if abs(time_s - before_s) <= NEIGHBOUR_S:
            alone = None
        elif alone is None or abs(time_s - alone._timestamp) > NEIGHBOUR_S:
            alone = message
            continue
        else:
            yield alone
            alone = None
        before_s = time_s
        yield message


TAIL_BYTES = 528  # what an autopilot may leave unwritten at the end of a log, by pymavlink


@contextmanager
def _unheard() -> Iterator[None]:
    """Drop what the process writes to stderr: compiled code of pymavlink's indexer writes a line
    for each damaged byte, and nothing else stops it."""
    stderr = os.dup(2)
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)


def _messages(path: Path, counts: Counter[str]) -> Iterator[Any]:
    """The messages that are read; ``counts`` gets the bytes that belong to none."""
    from pymavlink import DFReader  # type: ignore[import-untyped]

    DFReader.print = lambda *_, **__: None  # it, too, prints a line for each damaged byte
    try:
        with _unheard():
            log = DFReader.DFReader_binary(str(path))
        whole = sum(log.counts[kind] * form.len for kind, form in log.formats.items())
        skipped = log.data_len - whole
        counts["skipped_bytes"] = skipped if skipped >= TAIL_BYTES else 0
    except Exception as error:  # DFReader raises this class itself
        raise ValueError(f"{path}: the .BIN log cannot be read ({error})") from error
    # Where the log is cut off, what was read before counts.
    with closing(log), suppress(Exception):
        while True:
            message = log.recv_match(type=list(_Reader.TABLE))
            if message is None:
                return
            yield message


def _turning(
    attitudes: list[tuple[AttitudeSample, float]], rates: list[tuple[float, ...]]
) -> Iterator[tuple[AttitudeSample, float]]:
    """Attitudes and their times in s, with the body's rates where they are known. ``rates`` are
    rows of time in s and rad/s about three axes."""
    table = np.array(rates).reshape(-1, 4)
    table = table[(np.abs(table[:, 1:]) <= MAX_RATE_RAD_S).all(axis=1)]
    times = np.array([time_s for _, time_s in attitudes])
    near = [values_near(table[:, 0], column, times, NEAR_S) for column in table.T[1:]]
    for (attitude, time_s), x, y, z in zip(attitudes, *(n.tolist() for n in near), strict=True):
        is_known = math.isfinite(x)
        yield (replace(attitude, rates_rad_s=(x, y, z)) if is_known else attitude), time_s


def _over_ground(m: Any) -> Vector | None:
    """Velocity in NED m/s of a message GPS."""
    speed, course, down = (getattr(m, name, math.nan) for name in ("Spd", "GCrs", "VZ"))
    if not math.isfinite(speed + course + down):
        return None
    course = math.radians(course)
    return speed * math.cos(course), speed * math.sin(course), down


class _Reader:
    """Messages into samples; remembers velocities and rates, which have their own messages."""

    def __init__(self) -> None:
        self.rates: dict[str, list[tuple[float, ...]]] = {"RATE": [], "IMU": []}
        """Time in s and rates of the body: those of the attitude's filter, and those of its IMU."""
        self._velocity: tuple[float, tuple[float, float, float]] | None = None
        self._receiver = 0  # the one in use
        self._fix = True
        self._fix_alt_m: float | None = None
        self.fixes: list[tuple[Sample, float]] = []
        """Place and accuracy of the receiver's fixes, with their times in s."""

    def sample(self, name: str, m: Any) -> Sample | None:
        try:
            return self.TABLE[name](self, m)
        except (AttributeError, TypeError, ValueError):
            return None  # a field is missing in this firmware version

    def _attitude(self, m: Any) -> Sample | None:
        q = from_degrees(m.Roll, m.Pitch, m.Yaw)
        return None if q is None else AttitudeSample(None, q)

    def _filter_rate(self, m: Any) -> Sample | None:
        # Copter before 3.6 states no unit, and it was another one before 3.4.
        if m.fmt.get_unit("R") == "deg/s":
            self.rates["RATE"].append((m._timestamp, *map(math.radians, (m.R, m.P, m.Y))))
        return None

    def _imu(self, m: Any) -> Sample | None:
        if getattr(m, "I", 0) == 0:
            self.rates["IMU"].append((m._timestamp, m.GyrX, m.GyrY, m.GyrZ))
        return None

    def _ekf_velocity(self, m: Any) -> Sample | None:
        if getattr(m, "C", 0) == 0 and math.isfinite(m.VN + m.VE + m.VD):
            self._velocity = (m._timestamp, (m.VN, m.VE, m.VD))
        return None

    def _position(self, m: Any) -> Sample | None:
        if not plausible_place(m.Lat, m.Lng):
            return None
        velocity = None
        if self._velocity is not None and abs(m._timestamp - self._velocity[0]) < FRESH_S:
            velocity = self._velocity[1]
        relative = getattr(m, "RelHomeAlt", None)
        return PositionSample(None, m.Lat, m.Lng, m.Alt, relative, velocity)

    def _gps(self, m: Any) -> Sample | None:
        if not getattr(m, "U", True):
            return None
        self._receiver = getattr(m, "I", 0)
        self._fix = m.Status >= 3
        self._fix_alt_m = getattr(m, "Alt", None) if self._fix else None
        if not self._fix:
            return receiver_accuracy(False, 1e3, 1e3)
        rough = receiver_accuracy(True, getattr(m, "HDop", math.nan) * HDOP_TO_M, math.nan)
        self.fixes.append(
            (replace(rough, alt_amsl_m=self._fix_alt_m, is_claimed=False), m._timestamp)
        )
        if plausible_place(m.Lat, m.Lng):
            place = PositionSample(None, m.Lat, m.Lng, self._fix_alt_m, None, _over_ground(m))
            self.fixes.append((place, m._timestamp))
        return None

    def _gps_accuracy(self, m: Any) -> Sample | None:
        if getattr(m, "I", 0) != self._receiver:
            return None
        return receiver_accuracy(self._fix, m.HAcc, m.VAcc, self._fix_alt_m)

    def _range(self, m: Any) -> Sample | None:
        if getattr(m, "Orient", DOWNWARD) != DOWNWARD or getattr(m, "Stat", GOOD) != GOOD:
            return None
        distance = getattr(m, "Dist", None)
        distance = m.Dist1 if distance is None else distance
        return RangeSample(None, distance) if distance > 0.0 else None

    def _terrain(self, m: Any) -> Sample | None:
        if m.Status != 2:
            return None
        return TerrainSample(None, m.CHeight, TERRAIN_MODEL_SIGMA_M)

    def _mount(self, m: Any) -> Sample | None:
        earth = math.isfinite(m.YawE)
        q = from_degrees(m.Roll, m.Pitch, m.YawE if earth else m.YawB)
        frame = GimbalFrame.EARTH if earth else GimbalFrame.VEHICLE
        return None if q is None else GimbalSample(None, q, frame, 1, 0)

    TABLE: dict[str, Callable[[_Reader, Any], Sample | None]] = {  # noqa: RUF012
        "ATT": _attitude,
        "RATE": _filter_rate,
        "IMU": _imu,
        "XKF1": _ekf_velocity,
        "NKF1": _ekf_velocity,
        "POS": _position,
        "GPS": _gps,
        "GPA": _gps_accuracy,
        "RFND": _range,
        "TERR": _terrain,
        "MNT": _mount,
    }
