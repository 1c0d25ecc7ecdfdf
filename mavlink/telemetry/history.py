"""The vehicle's recent past: adds samples, returns the state at any time in it."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mavlink.telemetry.gimbal import YAW_FRAMES, steadiest_frame, to_earth
from mavlink.telemetry.quaternion import Quaternion, curve, down_component, hermite, slerp
from mavlink.telemetry.samples import (
    EXTRAPOLATE_NS,
    MAX_GAP_NS,
    RECEIVER_SIGMA_H_M,
    RECEIVER_SIGMA_V_M,
    AccuracySample,
    AttitudeSample,
    Bracket,
    GimbalFrame,
    GimbalSample,
    PositionSample,
    RangeSample,
    ReceiverAltitude,
    Sample,
    TerrainSample,
    TimeSeries,
    VehicleState,
)

M_PER_DEG = 111_319.49  # along a meridian, and along the equator
POSITION_GAP_NS = ACCURACY_GAP_NS = 3_000_000_000  # the way between bends by a metre at most
GIMBAL_DEVICES = (154, 171, 172, 173, 174, 175)
JUDGE_EVERY_NS = 10_000_000_000  # between two checks of a gimbal's reference frame
JUDGE_LAG_NS = 3_000_000_000
JUDGED_SAMPLES = 600
PATIENCE_S = 0.3  # live: a little more than the 3.5 Hz of a slow telemetry radio


@dataclass(frozen=True, slots=True)
class HistoryConfig:
    keep_s: float = math.inf
    yaw_frame: str = "auto"  # auto: as a gimbal's flags declare, unless telemetry refutes them

    def __post_init__(self) -> None:
        if self.yaw_frame not in YAW_FRAMES:
            raise ValueError(
                f"gimbal yaw_frame is {self.yaw_frame!r}; use one of {', '.join(YAW_FRAMES)}"
            )


SIGMA_TILT_RAD, SIGMA_YAW_RAD, SIGMA_GIMBAL_RAD = 0.01, 0.05, 0.01
SIGMA_CAMERA_RAD = 0.03  # of a camera that finds gravity by its own accelerometer
TURN_RAD_S2, ACCELERATION_M_S2 = 1.5, 1.0
"""Accelerations assumed between two samples: of the angles, and of positions with velocity."""

WITH_RATES = 0.5
"""Share of an angle's error that is left where its rates are known: on logs 0.3 to 0.75."""

BETWEEN_NS = 100_000_000  # a rotation that is compared with images is wanted at least so often

MAX_AGL_M = 1e5  # senders fill in any float; the datalink takes no higher pose

UNKNOWN = (math.nan, math.nan, math.nan)


class VehicleHistory:
    """Samples of one vehicle by time; safe for one writer and several readers.

    Live, a frame arrives before the attitude that was sampled after it, and nothing is
    extrapolated by more than 20 ms. So :meth:`state_at` waits up to ``patience_s`` for samples that
    are as near. It does not wait for the one after: of a position at 10 Hz that takes 0.1 s.
    """

    def __init__(
        self,
        config: HistoryConfig | None = None,
        patience_s: float = 0.0,
        wait: Callable[[float], object] | None = None,
    ) -> None:
        """``wait`` is called with the seconds left (default: until a sample comes)."""
        self.config = config or HistoryConfig()
        self.vertical_datum = ""  # of its altitudes; empty: mean sea level
        self.is_pressure_altitude = False  # they are those of air pressure in standard weather
        self._patience_s = patience_s
        self._lock = threading.Lock()
        self._news = threading.Condition()
        self._wait = wait or self._news.wait
        self._waiting = 0  # waiting readers
        self._given_up_ns = 0  # up to here nothing is waited for again
        self._attitude: TimeSeries[AttitudeSample] = TimeSeries()
        self._position: TimeSeries[PositionSample] = TimeSeries()
        self._fixes: TimeSeries[PositionSample] = TimeSeries()  # of the receiver
        self._accuracy: TimeSeries[AccuracySample] = TimeSeries()
        self._range: TimeSeries[RangeSample] = TimeSeries()
        self._terrain: TimeSeries[TerrainSample] = TimeSeries()
        self._gimbals: dict[tuple[int, int], TimeSeries[GimbalSample]] = {}  # by rank and component
        self._tracks: dict[type[Sample], TimeSeries[Any]] = {
            AttitudeSample: self._attitude,
            PositionSample: self._position,
            AccuracySample: self._accuracy,
            RangeSample: self._range,
            TerrainSample: self._terrain,
        }
        self._judged: dict[tuple[int, int], tuple[int, GimbalFrame | None]] = {}  # when
        self._seen: GimbalFrame | None = None  # by the images

    @property
    def _places(self) -> TimeSeries[PositionSample]:
        """The estimator's positions; the receiver's where it has sent none."""
        return self._fixes if self._position.first_ns is None else self._position

    @property
    def first_ns(self) -> int | None:
        times = [t.first_ns for t in (self._attitude, self._places) if t.first_ns is not None]
        return min(times, default=None)

    @property
    def last_ns(self) -> int | None:
        times = [t.last_ns for t in (self._attitude, self._places) if t.last_ns is not None]
        return max(times, default=None)

    def covers(self, time_ns: int, until_ns: float = math.inf) -> bool:
        """True when no active stream can still add data about ``time_ns``.

        A stream whose next sample is due after ``until_ns`` cannot. Of several streams of gimbals
        the first counts, which is the one that is used.
        """
        with self._lock:
            gimbals: list[TimeSeries[Any]] = [self._gimbals[key] for key in self._gimbal_order()]
            heads, bodies = (
                [
                    (t.last_ns, t.due_ns)
                    for t in tracks
                    if t.last_ns is not None and t.last_ns > time_ns - MAX_GAP_NS
                ]
                for tracks in (gimbals, (self._attitude, self._places))
            )
        return all(last >= time_ns or due > until_ns for last, due in (*heads[:1], *bodies))

    def attitudes(self) -> list[tuple[AttitudeSample, int]]:
        """Every attitude with its time in ns, oldest first."""
        with self._lock:
            return [(sample, time_ns) for time_ns, sample in self._attitude.items()]

    def gap_s(self, time_ns: int) -> float:
        """Seconds between the attitudes of the camera's head about a time, or of the body; 0 where
        none are near."""
        with self._lock:
            heads = [self._gimbals[key] for key in self._gimbal_order()]
            tracks: list[TimeSeries[Any]] = [*heads, self._attitude]
            around = [at for track in tracks if (at := track.around(time_ns)) is not None]
        return around[0].gap_s if around else 0.0

    def bodies(self, since_ns: int = 0, until_ns: float = math.inf) -> list[tuple[int, Quaternion]]:
        """The body's attitude at every sample, and between slow samples whose rates are known."""
        out = []
        with self._lock:
            samples = [one for one in self._attitude.items() if since_ns <= one[0] <= until_ns]
        for (t, one), (later, next_one) in zip(samples, samples[1:] + samples[-1:], strict=True):
            gap = Bracket(t, later, one, next_one, t)
            is_curve = later - t <= MAX_GAP_NS and _has_rates(gap)
            steps = max(1, (later - t) // BETWEEN_NS) if is_curve else 1
            times = [t + (later - t) * k // steps for k in range(steps)]
            out += [(at, _body(replace(gap, time_ns=at))) for at in times]
        return out

    def body_at(self, time_ns: int) -> Quaternion | None:
        """``q_ned_body`` at a time, if known."""
        with self._lock:
            at = self._attitude.around(time_ns)
        return None if at is None else _body(at)

    def claimed_at(self, time_ns: int) -> tuple[Quaternion, Quaternion] | None:
        """(the gimbal's quaternion as sent, ``q_ned_body``) at a time, if known."""
        with self._lock:
            body = self._attitude.around(time_ns)
            if body is None:
                return None
            q_body = _body(body)
            for key in self._gimbal_order():
                at = self._gimbals[key].around(time_ns)
                if at is not None:
                    return slerp(at.before.q, at.after.q, at.fraction), q_body
        return None

    def _gimbal_order(self) -> list[tuple[int, int]]:
        """Streams by rank, most informative first; at equal rank the gimbal before its relay."""
        return sorted(self._gimbals, key=lambda k: (k[0], k[1] not in GIMBAL_DEVICES, k[1]))

    def heads(self, since_ns: int = 0, until_ns: float = math.inf) -> list[tuple[int, Quaternion]]:
        """The camera head's attitude at every gimbal sample, or the body's without a gimbal."""
        with self._lock:
            tracks = self._gimbals.values()
            times = {t for track in tracks for t, _ in track.items() if since_ns <= t <= until_ns}
        states = [(t, self._state_at(t)) for t in sorted(times)]
        found = [
            (t, (w, x, y, z))
            for t, s in states
            if s is not None and s.q_ned_gimbal_wxyz is not None
            for w, x, y, z in [s.q_ned_gimbal_wxyz.tolist()]
        ]
        return found or self.bodies(since_ns, until_ns)

    def __len__(self) -> int:
        return len(self._attitude) + len(self._places)

    def add(self, sample: Sample, time_ns: int) -> None:
        """Insert a sample at its time; order does not matter."""
        with self._lock:
            kept: list[tuple[TimeSeries[Any], Sample]] = [(self._track(sample), sample)]
            if isinstance(sample, AccuracySample) and sample.place is not None:
                kept.append((self._fixes, sample.place))
            for track, one in kept:
                track.add(time_ns, one)
                if math.isfinite(self.config.keep_s):
                    track.forget_before(time_ns - int(self.config.keep_s * 1e9))
        if self._waiting:
            with self._news:
                self._news.notify_all()

    def set_yaw_frame(self, frame: str) -> None:
        """Change how gimbal messages are read, including those already stored."""
        with self._lock:
            self.config = replace(self.config, yaw_frame=frame)

    def gimbal_frame(self) -> GimbalFrame | None:
        """The reference frame in use for the gimbal; None without a gimbal."""
        with self._lock:
            for key in self._gimbal_order():
                sample = self._gimbals[key].last
                if sample is not None:
                    return self._frame(key, sample.frame)
        return None

    def trust_images(self, frame: GimbalFrame) -> None:
        """Read the gimbal as the images indicate, unless the configuration sets a frame."""
        with self._lock:
            self._seen = frame

    def clear(self) -> None:
        with self._lock:
            for track in (*self._tracks.values(), self._fixes):
                track.clear()
            self._gimbals.clear()
            self._judged.clear()

    def _track(self, sample: Sample) -> TimeSeries[Any]:
        if isinstance(sample, GimbalSample):
            return self._gimbals.setdefault((sample.rank, sample.component), TimeSeries())
        return self._tracks[type(sample)]

    def at_rate(self, rate: float, zero_ns: int) -> VehicleHistory:
        """A copy by a clock that shows the same at ``zero_ns`` and gains ``rate`` seconds in each
        of this one's."""
        out = VehicleHistory(self.config)
        out.vertical_datum = self.vertical_datum
        out.is_pressure_altitude = self.is_pressure_altitude
        with self._lock:
            tracks = [*self._tracks.values(), *self._gimbals.values()]
            samples = [one for track in tracks for one in track.items()]
        for time_ns, sample in samples:
            out.add(sample, time_ns + round(rate * (time_ns - zero_ns)))
        return out

    def state_at(self, time_ns: int, waits: bool = True) -> VehicleState | None:
        """The state interpolated at ``time_ns``, or None when no part of it is known.

        It waits for samples that are on their way, for as long as the patience given; not so the
        thread that delivers them, where ``waits`` is False.

        Attitude by a cubic through angles and rates at both ends, by slerp where no rates are
        known; position by a cubic through positions and velocities.
        Nothing is extrapolated by more than 20 ms past the last sample. Sigmas grow with the
        square of the distance to the samples on both sides; a part whose samples are more than
        one second apart (positions: three) is left out. The height above ground comes from the
        first available of rangefinder, terrain, height above home.
        """
        if waits and self._patience_s:
            self._await(time_ns)
        return self._state_at(time_ns)

    def _await(self, time_ns: int) -> None:
        """Wait until every active stream can be extrapolated to ``time_ns``, or patience ends."""
        now_s = time.monotonic()
        end_s = now_s + self._patience_s
        if time_ns * 1e-9 >= end_s or time_ns <= self._given_up_ns:
            return  # samples further ahead cannot arrive in time
        with self._news:
            self._waiting += 1  # before checking, so that no new sample is missed
            near_ns = time_ns - EXTRAPOLATE_NS
            while not self.covers(near_ns, end_s * 1e9) and now_s < end_s:
                self._wait(end_s - now_s)
                now_s = time.monotonic()
            self._waiting -= 1
        if now_s >= end_s:  # once for a frame, not for each moment about its exposure
            self._given_up_ns = time_ns + EXTRAPOLATE_NS

    def _state_at(self, time_ns: int) -> VehicleState | None:
        with self._lock:
            state = _Assembly(time_ns)
            attitude = self._attitude.around(time_ns)
            q_body = self._add_attitude(state, attitude)
            self._add_gimbal(state, q_body)
            relative = self._add_position(state)
            self._add_agl(state, q_body, relative)
        return state.finish()

    def _add_attitude(
        self, state: _Assembly, at: Bracket[AttitudeSample] | None
    ) -> Quaternion | None:
        if at is None:
            return None
        q = _body(at)
        bend = TURN_RAD_S2 * at.curvature_s2 * (WITH_RATES if _has_rates(at) else 1.0)
        state.set(
            "attitude",
            at.age_ms,
            q_ned_body_wxyz=np.array(q),
            sigma_attitude_rad=math.hypot(SIGMA_TILT_RAD, bend),
            sigma_yaw_rad=math.hypot(SIGMA_YAW_RAD, bend),
        )
        return q

    def _add_gimbal(self, state: _Assembly, q_body: Quaternion | None) -> None:
        for key in self._gimbal_order():
            at = self._gimbals[key].around(state.time_ns)
            q = None if at is None else self._gimbal_at(key, at, q_body)
            if at is None or q is None:
                continue
            bend = TURN_RAD_S2 * at.curvature_s2
            known = at.before.is_yaw_known
            sigma = math.hypot(SIGMA_GIMBAL_RAD if known else SIGMA_CAMERA_RAD, bend)
            state.set("gimbal", at.age_ms, q_ned_gimbal_wxyz=np.array(q), sigma_gimbal_rad=sigma)
            if not known:
                state.set("gimbal", at.age_ms, sigma_yaw_rad=math.pi)
            return

    def _gimbal_at(
        self, key: tuple[int, int], at: Bracket[GimbalSample], q_body: Quaternion | None
    ) -> Quaternion | None:
        """``q_ned_gimbal`` between two samples, in the frame in which the head rotated less."""
        sent = at.before.q, at.after.q
        frame = self._frame(key, at.before.frame)
        if frame is GimbalFrame.EARTH:
            return slerp(*sent, at.fraction)
        ends = self._attitude.around(at.before_ns), self._attitude.around(at.after_ns)
        if ends[0] is None or ends[1] is None or q_body is None:
            return None
        bodies = [_body(e) for e in ends if e]
        earth = [to_earth(q, frame, body) for q, body in zip(sent, bodies, strict=True)]
        if _apart(*sent) < _apart(*earth):
            return to_earth(slerp(*sent, at.fraction), frame, q_body)
        return slerp(earth[0], earth[1], at.fraction)

    def _frame(self, key: tuple[int, int], claimed: GimbalFrame) -> GimbalFrame:
        """The reference frame of the quaternion. By configuration, else by the images, else as
        declared unless telemetry refutes it."""
        chosen = self.config.yaw_frame
        if chosen != "auto":
            return GimbalFrame(chosen)
        if self._seen is not None:
            return self._seen
        if claimed is not GimbalFrame.VEHICLE:
            return claimed
        track = self._gimbals[key]
        newest = track.last_ns or 0
        looked_ns, better = self._judged.get(key, (0, None))
        if newest - looked_ns > JUDGE_EVERY_NS:
            better = self._steadiest(track) or better
            self._judged[key] = (newest, better)
        return better or claimed

    def _steadiest(self, track: TimeSeries[GimbalSample]) -> GimbalFrame | None:
        """Uses a thinned track, because it runs repeatedly in flight."""
        sent: list[Quaternion] = []
        bodies: list[Quaternion] = []
        samples = track.items()
        samples = samples[:: max(1, len(samples) // JUDGED_SAMPLES)]
        for time_ns, sample in samples:
            at = self._attitude.around(time_ns)
            if at is not None:
                sent.append(sample.q)
                bodies.append(_body(at))
        if len(samples) < 2:
            return None
        spacing_ns = (samples[-1][0] - samples[0][0]) / (len(samples) - 1)
        return steadiest_frame(sent, bodies, max(1, round(JUDGE_LAG_NS / spacing_ns)))

    def _add_position(self, state: _Assembly) -> Bracket[PositionSample] | None:
        at = self._places.around(state.time_ns, POSITION_GAP_NS)
        if at is None:
            return None
        accuracy = self._accuracy.around(state.time_ns, ACCURACY_GAP_NS, ACCURACY_GAP_NS)
        nearest = None if accuracy is None else accuracy.nearer
        is_placed = math.isfinite(at.before.lat_deg + at.after.lat_deg)
        if not is_placed or (nearest is not None and not nearest.has_fix):
            return at  # no fix: the estimated position is too uncertain for a tag
        sigma_h, sigma_v = RECEIVER_SIGMA_H_M, RECEIVER_SIGMA_V_M
        if nearest is not None:
            sigma_h, sigma_v = nearest.sigma_h_m, nearest.sigma_v_m
        bend = ACCELERATION_M_S2 * at.curvature_s2
        lat, lon, alt, velocity = _position_at(at)
        state.set(
            "gnss",
            at.age_ms,
            lat_deg=lat,
            lon_deg=lon,
            v_ned_m_s=velocity,
            sigma_h_m=math.hypot(sigma_h, bend),
            is_claimed=nearest is not None and nearest.is_claimed,
            receiver=_receiver_above(accuracy, self._position),
        )
        if math.isfinite(alt):
            state.fields.update(alt_amsl_m=alt, sigma_v_m=math.hypot(sigma_v, bend))
        return at

    def _add_agl(
        self, state: _Assembly, q_body: Quaternion | None, position: Bracket[PositionSample] | None
    ) -> None:
        at = self._range.around(state.time_ns)
        down = 0.0 if q_body is None else down_component(q_body)
        if at is not None and down > 0.5 and _is_height(agl := at.mixed("distance_m") * down):
            state.set_agl("rangefinder", at.age_ms, agl, 0.1 + 0.02 * agl)
            return
        terrain = self._terrain.around(state.time_ns)
        if terrain is not None and _is_height(agl := terrain.mixed("agl_m")):
            state.set_agl("terrain", terrain.age_ms, agl, terrain.before.sigma_m)
            return
        if position is not None and _is_height(agl := position.mixed("relative_alt_m")):
            state.set_agl("relative", position.age_ms, agl, max(5.0, 0.1 * agl))


def _is_height(agl_m: float) -> bool:
    """True for a height above ground that an aircraft may have; False for NaN."""
    return 0.0 <= agl_m <= MAX_AGL_M


class _Assembly:
    """A VehicleState under construction."""

    def __init__(self, time_ns: int) -> None:
        self.time_ns = time_ns
        self.ages: dict[str, float] = {}
        self.fields: dict[str, Any] = {}

    def set(self, source: str, age_ms: float, **fields: object) -> None:
        self.ages[source] = age_ms
        self.fields.update(fields)

    def set_agl(self, source: str, age_ms: float, agl_m: float, sigma_m: float) -> None:
        # Terrain and climb between samples: a metre per second.
        self.set(source, age_ms, alt_agl_m=agl_m, sigma_agl_m=math.hypot(sigma_m, age_ms * 1e-3))

    def finish(self) -> VehicleState | None:
        if not self.ages:
            return None
        ages = self.ages
        return VehicleState(self.time_ns, age_ms=ages, sources=tuple(ages), **self.fields)


def _body(at: Bracket[AttitudeSample]) -> Quaternion:
    """``q_ned_body`` by its rates at both ends where they are known; by slerp past an end."""
    ends = at.before.q_ned_body, at.after.q_ned_body
    rates = at.before.rates_rad_s, at.after.rates_rad_s
    if rates[0] is None or rates[1] is None or not 0.0 <= at.fraction <= 1.0:
        return slerp(*ends, at.fraction)
    return curve(*ends, rates[0], rates[1], at.gap_s, at.fraction)


def _has_rates(at: Bracket[AttitudeSample]) -> bool:
    return at.before.rates_rad_s is not None and at.after.rates_rad_s is not None


def _apart(a: Quaternion, b: Quaternion) -> float:
    """Grows with the angle between two rotations; 0 when they are equal."""
    return 1.0 - abs(sum(p * q for p, q in zip(a, b, strict=True)))


def _position_at(at: Bracket[PositionSample]) -> tuple[float, float, float, object]:
    """(lat, lon, alt or NaN, v_ned or None) by a cubic Hermite curve when both ends have a
    velocity."""
    a, b = at.before, at.after
    per_lon = M_PER_DEG * max(1e-6, math.cos(math.radians(a.lat_deg)))
    d_lon = (b.lon_deg - a.lon_deg + 180.0) % 360.0 - 180.0
    alts = [math.nan if one.alt_amsl_m is None else one.alt_amsl_m for one in (a, b)]
    step = ((b.lat_deg - a.lat_deg) * M_PER_DEG, d_lon * per_lon, alts[0] - alts[1])
    v0, v1 = a.v_ned_m_s or UNKNOWN, b.v_ned_m_s or UNKNOWN
    u, h = at.fraction, at.gap_s
    ned = [_way(step[k], v0[k] * h, v1[k] * h, u) for k in range(3)]
    lat = a.lat_deg + ned[0] / M_PER_DEG
    lon = (a.lon_deg + ned[1] / per_lon + 180.0) % 360.0 - 180.0
    velocity = np.array(v0) + (np.array(v1) - np.array(v0)) * u
    return lat, lon, alts[0] - ned[2], velocity if np.isfinite(velocity).all() else None


def _way(step: float, m0: float, m1: float, u: float) -> float:
    """Distance covered at fraction u; linear when the velocities contradict the step."""
    straight = u * step
    if not (math.isfinite(m0) and math.isfinite(m1)) or not 0.0 <= u <= 1.0:
        return straight
    if abs(0.5 * (m0 + m1) - step) > 0.5 + 0.2 * abs(step):
        return straight
    return hermite(step, m0, m1, u)


def _receiver_above(
    accuracy: Bracket[AccuracySample] | None, positions: TimeSeries[PositionSample]
) -> ReceiverAltitude | None:
    """The fix nearest in time, compared with the autopilot's altitude then; None without either."""
    at = None if accuracy is None else positions.around(accuracy.nearer_ns)
    if accuracy is None or at is None or accuracy.nearer.alt_amsl_m is None:
        return None
    above = accuracy.nearer.alt_amsl_m - at.mixed("alt_amsl_m")
    return ReceiverAltitude(accuracy.nearer_ns, above) if math.isfinite(above) else None
