"""Telemetry samples, one per message, and the vehicle state that they give at one time."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Generic, TypeVar

import numpy as np
import numpy.typing as npt

from mavlink.telemetry.quaternion import Quaternion, Vector

YEAR_2000_UNIX_S = 946_684_800
"""Start of 2000: a recorder without a clock counts from 1904 or 1970, and GPS9 its days from it."""

RECEIVER_SIGMA_H_M, RECEIVER_SIGMA_V_M = 2.1, 3.5
"""1 sigma per axis of a receiver that reports no accuracy: a circular error of 2.5 m, from the data
sheets of u-blox M8 receivers, is 2.1 m per axis; heights are about 1.7 times worse."""


class GimbalFrame(Enum):
    EARTH = "earth"  # NED
    VEHICLE = "vehicle"  # horizon in roll and pitch, the vehicle's heading in yaw
    BODY = "body"  # the vehicle's own axes
    SERVO = "servo"  # pan, roll and tilt of servos on the body, sent as yaw, roll and pitch


@dataclass(frozen=True, slots=True)
class Sample:
    """Base of all samples. ``boot_ms`` is the sender's boot clock, None when it sends none."""

    boot_ms: float | None


@dataclass(frozen=True, slots=True)
class AttitudeSample(Sample):
    q_ned_body: Quaternion
    rates_rad_s: Vector | None = None  # of the body, about its own axes


@dataclass(frozen=True, slots=True)
class PositionSample(Sample):
    """The estimator's position, or a receiver's without one."""

    lat_deg: float  # NaN, like the longitude: only the height above home is known
    lon_deg: float
    alt_amsl_m: float | None
    relative_alt_m: float | None  # above home
    v_ned_m_s: tuple[float, float, float] | None


@dataclass(frozen=True, slots=True)
class AccuracySample(Sample):
    """The GNSS receiver's own estimate of its accuracy, 1 sigma, its own altitude and position."""

    has_fix: bool
    sigma_h_m: float
    sigma_v_m: float
    alt_amsl_m: float | None = None
    is_claimed: bool = True  # False: typical of receivers, as this one states none
    place: PositionSample | None = None  # for want of an estimator's


@dataclass(frozen=True, slots=True)
class RangeSample(Sample):
    """Distance of a rangefinder that looks along the body's z axis."""

    distance_m: float


@dataclass(frozen=True, slots=True)
class TerrainSample(Sample):
    """Height above the ground from a terrain model or an altimeter fused by the autopilot."""

    agl_m: float
    sigma_m: float


@dataclass(frozen=True, slots=True)
class GimbalSample(Sample):
    """Attitude of a gimbal's head as declared by its sender."""

    q: Quaternion
    frame: GimbalFrame
    component: int
    rank: int  # 0 GIMBAL_DEVICE_ATTITUDE_STATUS, 1 MOUNT_ORIENTATION, 2 MOUNT_STATUS
    is_yaw_known: bool = True  # False: by a camera's own sensors, from an unknown direction


OF_AUTOPILOT = (AttitudeSample, PositionSample, AccuracySample)
"""Accepted from the autopilot only: a gimbal or camera that sends it describes itself."""


F64 = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ReceiverAltitude:
    """One fix of the GNSS receiver and the autopilot's altitude at the same time."""

    time_ns: int
    gnss_minus_baro_m: float  # the receiver's altitude minus the autopilot's


@dataclass(frozen=True, slots=True, eq=False)
class VehicleState:
    """Attitude, gimbal attitude, position and height at ``time_ns``; a missing part is None. Sigmas
    are 1 sigma and cover the time between samples; they are None with their part."""

    time_ns: int  # the history's clock: companion monotonic live, unix in a replay
    q_ned_body_wxyz: F64 | None = None  # (4,) FRD body to NED
    q_ned_gimbal_wxyz: F64 | None = None  # (4,) FRD gimbal head to NED
    lat_deg: float | None = None
    lon_deg: float | None = None
    alt_amsl_m: float | None = None
    alt_agl_m: float | None = None  # above the ground below; ``sources`` names its origin
    v_ned_m_s: F64 | None = None  # (3,)
    sigma_h_m: float | None = None  # of the horizontal position, per axis
    sigma_v_m: float | None = None  # of alt_amsl_m
    sigma_agl_m: float | None = None
    sigma_attitude_rad: float | None = None  # roll and pitch of the body
    sigma_yaw_rad: float | None = None
    sigma_gimbal_rad: float | None = None  # roll and pitch of the gimbal head
    is_claimed: bool = True  # False: sigma_h_m and sigma_v_m are typical ones
    receiver: ReceiverAltitude | None = None  # of the fix nearest in time
    age_ms: Mapping[str, float] = field(default_factory=dict)  # source to ms from its next sample
    sources: tuple[str, ...] = ()  # of attitude, gimbal, gnss, rangefinder, terrain, relative


S = TypeVar("S")

EXTRAPOLATE_NS = 20_000_000
MAX_GAP_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Bracket(Generic[S]):
    """The samples before and after a time; the same one twice at the end of a track."""

    before_ns: int
    after_ns: int
    before: S
    after: S
    time_ns: int

    @property
    def fraction(self) -> float:
        """Position of the time from before (0) to after (1); slightly outside past an end."""
        span = self.after_ns - self.before_ns
        return (self.time_ns - self.before_ns) / span if span else 0.0

    @property
    def nearer(self) -> S:
        return self.before if self.fraction < 0.5 else self.after

    @property
    def nearer_ns(self) -> int:
        return self.before_ns if self.fraction < 0.5 else self.after_ns

    @property
    def gap_s(self) -> float:
        return (self.after_ns - self.before_ns) * 1e-9

    def mixed(self, name: str) -> float:
        """An attribute interpolated linearly; NaN where a sample does not have it."""
        before, after = getattr(self.before, name), getattr(self.after, name)
        if before is None or after is None:
            return math.nan
        return float(before + (after - before) * self.fraction)

    @property
    def age_ms(self) -> float:
        near = min(abs(self.time_ns - self.before_ns), abs(self.after_ns - self.time_ns))
        return near * 1e-6

    @property
    def curvature_s2(self) -> float:
        """``dt_before * dt_after / 2``: times an acceleration, the linear interpolation error."""
        before = (self.time_ns - self.before_ns) * 1e-9
        after = (self.after_ns - self.time_ns) * 1e-9
        return 0.5 * abs(before * after)


class TimeSeries(Generic[S]):
    """Samples sorted by time. Not thread-safe by itself."""

    def __init__(self) -> None:
        self._times: list[int] = []
        self._samples: list[S] = []

    def __len__(self) -> int:
        return len(self._times)

    @property
    def first_ns(self) -> int | None:
        return self._times[0] if self._times else None

    @property
    def last_ns(self) -> int | None:
        return self._times[-1] if self._times else None

    @property
    def due_ns(self) -> int:
        """Time of the next sample, as far from the newest as the one before; 0 without samples."""
        if len(self._times) < 2:
            return self.last_ns or 0
        return 2 * self._times[-1] - self._times[-2]

    @property
    def last(self) -> S | None:
        return self._samples[-1] if self._samples else None

    def items(self) -> list[tuple[int, S]]:
        return list(zip(self._times, self._samples, strict=True))

    def add(self, time_ns: int, sample: S) -> None:
        """Insert in order of time; replaces a sample of the same time."""
        if not self._times or time_ns > self._times[-1]:
            self._times.append(time_ns)
            self._samples.append(sample)
            return
        i = bisect_left(self._times, time_ns)
        if self._times[i] == time_ns:
            self._samples[i] = sample
        else:
            self._times.insert(i, time_ns)
            self._samples.insert(i, sample)

    def clear(self) -> None:
        self._times.clear()
        self._samples.clear()

    def forget_before(self, time_ns: int) -> None:
        """Drop older samples, in batches so that the cost per sample stays constant."""
        i = bisect_left(self._times, time_ns)
        if i > 64 and 2 * i > len(self._times):
            del self._times[:i]
            del self._samples[:i]

    def around(
        self, time_ns: int, max_gap_ns: int = MAX_GAP_NS, extrapolate_ns: int = EXTRAPOLATE_NS
    ) -> Bracket[S] | None:
        """The samples around a time, or None without samples near enough.

        Inside the track the two neighbours must be at most ``max_gap_ns`` apart, unless one of
        them is within ``extrapolate_ns``. Past an end the last two samples are extrapolated by at
        most ``extrapolate_ns``.
        """
        times = self._times
        if not times:
            return None
        i = bisect_right(times, time_ns)
        if 0 < i < len(times):
            return self._inside(i, time_ns, max_gap_ns, extrapolate_ns)
        return self._past_end(bool(i), time_ns, max_gap_ns, extrapolate_ns)

    def _past_end(self, late: bool, time_ns: int, max_gap: int, near: int) -> Bracket[S] | None:
        times = self._times
        k = len(times) - 1 if late else 0
        beyond = abs(time_ns - times[k])
        if beyond > near:
            return None
        step = -1 if late else 1
        j = k + step
        # Samples closer together than the extrapolated step would amplify their noise.
        while 0 <= j < len(times) and abs(times[j] - times[k]) < beyond:
            j += step
        if beyond == 0 or not 0 <= j < len(times) or abs(times[j] - times[k]) > max_gap:
            j = k
        return self._between(min(j, k), max(j, k), time_ns)

    def _inside(self, i: int, time_ns: int, max_gap: int, near: int) -> Bracket[S] | None:
        before, after = self._times[i - 1], self._times[i]
        if after - before <= max_gap:
            return self._between(i - 1, i, time_ns)
        k = i - 1 if time_ns - before <= after - time_ns else i
        return None if abs(time_ns - self._times[k]) > near else self._between(k, k, time_ns)

    def _between(self, i: int, j: int, time_ns: int) -> Bracket[S]:
        times, samples = self._times, self._samples
        return Bracket(times[i], times[j], samples[i], samples[j], time_ns)
