"""Telemetry in lines of text, NMEA 0183 or CSV, as MAVLink packets of one vehicle.

For aircraft without MAVLink: whatever has their telemetry, as an app on the controller, sends lines
by UDP. As packets they are recorded, replayed and used like those of an autopilot.

NMEA: ``GGA`` (position) and ``GST`` (its accuracy). CSV: a header with names of :data:`COLUMNS` in
any order, then rows; others are ignored. A row gives a position (``lat_deg``, ``lon_deg`` and a
height), the attitude of the body (``roll_deg``, ``pitch_deg``, ``yaw_deg``) or of the camera
(``gimbal_pitch_deg``, ``gimbal_yaw_deg``); empty fields are unknown. Times are those of the lines:
UTC of the day, ``time_s`` on any clock; without one, those of arrival.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Mapping, Sequence
from functools import reduce
from operator import xor
from typing import Any

from mavlink.wire.dialect import dialect

log = logging.getLogger(__name__)

MAX_LINES, LONGEST_LINE = 64, 512  # of a datagram; the rest is dropped

COLUMNS = (
    "time_s", "lat_deg", "lon_deg", "alt_amsl_m", "relative_alt_m", "sigma_h_m", "sigma_v_m",
    "hdop", "roll_deg", "pitch_deg", "yaw_deg", "gimbal_roll_deg", "gimbal_pitch_deg",
    "gimbal_yaw_deg",
)  # fmt: skip
HEADERS = ("lat_deg", "yaw_deg", "gimbal_yaw_deg")  # a header has one of them
MAX_COLUMNS = 64

SYSTEM, AUTOPILOT, GIMBAL = 1, 1, 154
BEAT_NS = 1_000_000_000
DAY_S = 86_400.0
M_PER_DEG = 111_319.49
LONGEST_STEP_S = 3.0  # between two positions that give a velocity
UNKNOWN_I32, UNKNOWN_U16 = -(1 << 31), 65535
NAN = math.nan

Values = dict[str, float]


class LineReader:
    """Lines to packets; holds the header, the last position and the sequence numbers."""

    def __init__(self) -> None:
        self._columns: Sequence[str] = ()
        self._has_complained = False
        self._encoders = {n: dialect.MAVLink(None, SYSTEM, n) for n in (AUTOPILOT, GIMBAL)}
        self._beat_ns: int | None = None
        self._sigma: Values = {}  # of the last GST
        self._day_s = self._of_day_s = 0.0
        self._last: tuple[float, float, float, float] | None = None  # s, lat, lon, height
        self._velocity = (0.0, 0.0, 0.0)

    def packets(self, data: bytes, now_ns: int) -> bytes:
        """The packets of a datagram that arrives at ``now_ns``; empty without a valid line."""
        lines = data[: MAX_LINES * LONGEST_LINE].decode("ascii", "replace").splitlines()
        read = [self._values(line[:LONGEST_LINE].strip()) for line in lines[:MAX_LINES]]
        packets = b"".join(self._packed(values, 1e-9 * now_ns) for values in read if values)
        if packets and (self._beat_ns is None or now_ns - self._beat_ns >= BEAT_NS):
            self._beat_ns = now_ns
            beat = dialect.MAVLink_heartbeat_message(2, 0, 0, 0, 4, 3)  # a multicopter, disarmed
            packets = self._pack(AUTOPILOT, beat) + packets
        return packets

    def _values(self, line: str) -> Values:
        """What a line states, by name of a column; empty for one that states nothing."""
        if line.startswith("$"):
            return self._sentence(line)
        fields = [field.strip() for field in line.split(",", MAX_COLUMNS)[:MAX_COLUMNS]]
        if any(name in fields for name in HEADERS):
            self._columns = fields
            return {}
        if len(fields) != len(self._columns):
            if line and not self._has_complained:
                self._has_complained = True
                log.warning(
                    "no telemetry in %.80r: neither NMEA nor CSV below a header with one of %s",
                    line, ", ".join(HEADERS),
                )  # fmt: skip
            return {}
        named = zip(self._columns, map(_number, fields), strict=True)
        return {name: value for name, value in named if name in COLUMNS and value == value}

    def _sentence(self, line: str) -> Values:
        """What an NMEA sentence with a correct checksum states."""
        whole = re.fullmatch(r"\$(..(...),([^*]*))\*([0-9A-Fa-f]{2})", line)
        if whole is None or reduce(xor, map(ord, whole[1])) != int(whole[4], 16):
            return {}
        fields = whole[3].split(",")
        if whole[2] == "GST" and len(fields) >= 8:
            north, east, up = map(_number, fields[5:8])
            self._sigma = {"sigma_h_m": math.sqrt((north**2 + east**2) / 2), "sigma_v_m": up}
        if whole[2] != "GGA" or len(fields) < 9 or fields[5] in ("", "0", "6"):  # 6: dead reckoning
            return {}
        values = {
            "time_s": self._time_s(fields[0]),
            "lat_deg": _degrees(fields[1], fields[2] == "S"),
            "lon_deg": _degrees(fields[3], fields[4] == "W"),
            "hdop": _number(fields[7]),
            "alt_amsl_m": _number(fields[8]),
        }
        found = values | self._sigma
        self._sigma = {}
        return {name: value for name, value in found.items() if math.isfinite(value)}

    def _time_s(self, text: str) -> float:
        """Seconds of ``hhmmss.ss``, past midnight too; NaN where it is none."""
        hours, rest = divmod(_number(text), 10_000.0)
        minutes, seconds = divmod(rest, 100.0)
        of_day_s = 3600.0 * hours + 60.0 * minutes + seconds
        if not 0.0 <= of_day_s < DAY_S:
            return NAN
        self._day_s += DAY_S if of_day_s < self._of_day_s - 0.5 * DAY_S else 0.0
        self._of_day_s = of_day_s
        return self._day_s + of_day_s

    def _packed(self, values: Mapping[str, float], now_s: float) -> bytes:
        time_s = values.get("time_s", now_s) % (1 << 22)  # in ms it fits its field
        time_ms = round(1e3 * time_s)
        found = [(AUTOPILOT, m) for m in self._position(values, time_s, time_ms)]
        body = [values.get(f"{axis}_deg", NAN) for axis in ("roll", "pitch", "yaw")]
        if all(map(math.isfinite, body)):
            angles = map(math.radians, body)
            found.append((AUTOPILOT, dialect.MAVLink_attitude_message(time_ms, *angles, 0, 0, 0)))
        pitch, yaw = (values.get(f"gimbal_{axis}_deg", NAN) for axis in ("pitch", "yaw"))
        if math.isfinite(pitch) and math.isfinite(yaw):
            roll, yaw = values.get("gimbal_roll_deg", 0.0), yaw % 360.0 or 360.0  # 0: not given
            message = dialect.MAVLink_mount_orientation_message(time_ms, roll, pitch, yaw, yaw)
            found.append((GIMBAL, message))
        return b"".join(self._pack(component, message) for component, message in found)

    def _position(self, values: Mapping[str, float], time_s: float, time_ms: int) -> list[Any]:
        """The messages of a position; none without one."""
        lat, lon = values.get("lat_deg", NAN), values.get("lon_deg", NAN)
        heights = [values.get(name, NAN) for name in ("alt_amsl_m", "relative_alt_m")]
        known = [h for h in heights if abs(h) < 1e5]
        if not (abs(lat) <= 90.0 and abs(lon) <= 180.0 and known) or (lat == 0.0 == lon):
            return []
        self._follow((time_s, lat, lon, known[0]))
        alt, above = (round(1e3 * h) if abs(h) < 1e5 else UNKNOWN_I32 for h in heights)
        degrees = round(1e7 * lat), round(1e7 * lon)
        sigmas = [values.get(name, 0.0) for name in ("sigma_h_m", "sigma_v_m")]
        h_mm, v_mm = (round(1e3 * s) if 0.0 < s < 1e5 else 0 for s in sigmas)
        cm_s = [round(1e2 * v) for v in self._velocity]
        hdop = values.get("hdop", 0.0)
        eph = round(1e2 * hdop) if 0.0 < hdop < 100.0 else UNKNOWN_U16
        unknown = (UNKNOWN_U16,) * 3
        return [
            dialect.MAVLink_gps_raw_int_message(
                time_ms * 1000, 3, *degrees, alt if alt != UNKNOWN_I32 else 0, eph, *unknown, 255,
                h_acc=h_mm, v_acc=v_mm,
            ),
            dialect.MAVLink_global_position_int_message(
                time_ms, *degrees, alt, above, *cm_s, UNKNOWN_U16
            ),
        ]  # fmt: skip

    def _follow(self, now: tuple[float, float, float, float]) -> None:
        """The velocity, NED, from the last position to this one; kept over a repetition."""
        last, self._last = self._last, now
        step_s = 0.0 if last is None else now[0] - last[0]
        if last is None or not 0.0 < step_s < LONGEST_STEP_S:
            self._velocity = self._velocity if step_s == 0.0 else (0.0, 0.0, 0.0)
            return
        per_lon = M_PER_DEG * math.cos(math.radians(now[1]))
        d_lon = (now[2] - last[2] + 180.0) % 360.0 - 180.0
        way = (now[1] - last[1]) * M_PER_DEG, d_lon * per_lon, last[3] - now[3]
        velocity = [m / step_s for m in way]
        self._velocity = (
            (velocity[0], velocity[1], velocity[2])
            if max(map(abs, velocity)) < 300.0
            else (0.0, 0.0, 0.0)
        )

    def _pack(self, component: int, message: Any) -> bytes:
        encoder = self._encoders[component]
        data = bytes(message.pack(encoder))
        encoder.seq = (encoder.seq + 1) % 256
        return data


def _number(text: str) -> float:
    """The finite number in a field, else NaN."""
    try:
        value = float(text)
    except ValueError:
        return NAN
    return value if abs(value) < 1e12 else NAN


def _degrees(text: str, is_negative: bool) -> float:
    """Degrees of NMEA's ``dddmm.mmmm``; NaN where it is none."""
    whole, minutes = divmod(_number(text), 100.0)
    return (-1.0 if is_negative else 1.0) * (whole + minutes / 60.0)
