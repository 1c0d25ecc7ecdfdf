"""Messages about ourselves: status texts, computer load, speed and distance, odometry."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mavlink.component.control import ScanStatus
from mavlink.telemetry.quaternion import Quaternion
from mavlink.wire.dialect import dialect
from mavlink.wire.first_beat import ONBOARD
from mavlink.wire.messages import SendQueue

S = 1_000_000_000
TEXT = 50  # bytes in one STATUSTEXT
LONGEST = 200
AGAIN_NS = 30 * S  # a repeated text is suppressed within this time
MAX_WAITING = 20  # news, and answers
MAX_SAID = 100  # texts that are remembered; answers use at most half of it
SPACING_NS = S
BURST = 3  # texts that may be sent at once after a pause

EMERGENCY, ALERT, CRITICAL, ERROR, WARNING, NOTICE, INFO, DEBUG = range(8)


class StatusTexts:
    """Texts to the operator: at most one a second, repetitions suppressed. News come before
    answers, of which anybody may cause any number."""

    def __init__(self, outbox: SendQueue) -> None:
        self._outbox = outbox
        self._news: deque[tuple[int, str]] = deque(maxlen=MAX_WAITING)
        self._answers: deque[tuple[int, str]] = deque(maxlen=MAX_WAITING)
        self._said: dict[str, int] = {}
        self._credit_ns = BURST * SPACING_NS
        self._last_ns: int | None = None
        self._next_id = 1

    def say(self, severity: int, text: str, now_ns: int, is_answer: bool = False) -> None:
        """Queue a text. It is dropped when it was sent within 30 s, unless it answers a command."""
        self._said = {t: at for t, at in self._said.items() if now_ns - at < AGAIN_NS}
        waiting = self._answers if is_answer else self._news
        if not text or (severity, text) in waiting:
            return
        if not is_answer and (text in self._said or len(self._said) >= MAX_SAID):
            return
        if len(self._said) < MAX_SAID // (2 if is_answer else 1):
            self._said[text] = now_ns
        waiting.append((severity, text))
        self.tick(now_ns)

    def tick(self, now_ns: int) -> None:
        passed = 0 if self._last_ns is None else max(0, now_ns - self._last_ns)
        self._last_ns = now_ns
        self._credit_ns = min(BURST * SPACING_NS, self._credit_ns + passed)
        while (waiting := self._news or self._answers) and self._credit_ns >= SPACING_NS:
            self._credit_ns -= SPACING_NS
            self._send(*waiting.popleft())

    def _send(self, severity: int, text: str) -> None:
        raw = text.encode("ascii", "replace")[:LONGEST]
        chunks = [raw[i : i + TEXT] for i in range(0, len(raw), TEXT)]
        number = self._next_id if len(chunks) > 1 else 0
        if number:
            self._next_id = self._next_id % 65535 + 1
        for k, chunk in enumerate(chunks):
            message = dialect.MAVLink_statustext_message(severity, chunk, number, k)
            self._outbox.put(ONBOARD, message)
        if number and len(raw) % TEXT == 0:  # a text must end with a zero byte
            last = dialect.MAVLink_statustext_message(severity, b"", number, len(chunks))
            self._outbox.put(ONBOARD, last)


@dataclass(frozen=True, slots=True)
class ComputerLoad:
    """The companion's load as measured by the service; None where unknown."""

    cpu_percent: tuple[float, ...] = ()  # per core, the first eight are sent
    temperature_c: float | None = None
    ram_used_mib: float | None = None
    ram_total_mib: float | None = None
    storage_used_mib: float | None = None
    storage_total_mib: float | None = None
    throttled: bool = False
    disk_full: bool = False


def computer_status(load: ComputerLoad, unix_us: int, uptime_ms: int) -> Any:
    u8, u32 = 255, 0xFFFFFFFF

    def known(value: float | None, low: int = 0, high: int = u32, unknown: int = u32) -> int:
        return unknown if value is None else max(low, min(high, round(value)))

    cores = [known(c, 0, 100) for c in load.cpu_percent[:8]]
    mean = round(sum(cores) / len(cores)) if cores else u8
    temperature = known(load.temperature_c, -127, 126, 127)
    flags = (4 if load.throttled else 0) | (8 if load.disk_full else 0)
    return dialect.MAVLink_onboard_computer_status_message(
        unix_us,
        uptime_ms & u32,
        0,
        cores + [u8] * (8 - len(cores)),
        [mean] + [u8] * 9,
        [u8] * 4,
        [u8] * 10,
        temperature,
        [127] * 8,
        [32767] * 4,
        known(load.ram_used_mib),
        known(load.ram_total_mib),
        [u32] * 4,
        [known(load.storage_used_mib), u32, u32, u32],
        [known(load.storage_total_mib), u32, u32, u32],
        [u32] * 6,
        *([u32] * 6,) * 4,
        flags,
    )


def motion_values(status: ScanStatus, boot_ms: int) -> list[Any]:
    """NAMED_VALUE_FLOAT by vision: speed (m/s), distance (m), turn rate (rad/s), latency (ms)."""
    named = (
        (b"SR_SPEED", status.speed_m_s),
        (b"SR_DIST", status.distance_m),
        (b"SR_TURN", status.turn_rate_rad_s),
        (b"SR_CAM_LAT", status.camera_latency_ms),
        (b"SR_LAT_SIG", status.camera_latency_sigma_ms),
    )
    return [
        dialect.MAVLink_named_value_float_message(boot_ms, name, value)
        for name, value in named
        if math.isfinite(value)
    ]


LOCAL_FRD = 20  # MAV_FRAME_LOCAL_FRD: an arbitrary origin; ArduPilot and PX4 both accept it
BODY_FRD = 12  # MAV_FRAME_BODY_FRD
VISION = 2  # MAV_ESTIMATOR_TYPE_VISION
CELLS = 21  # upper triangle of 6 x 6


@dataclass(frozen=True, slots=True)
class BodyOdometry:
    """Pose and velocity of the body; unknown parts of the covariances are NaN."""

    position_ned_m: tuple[float, float, float]
    q_ned_body: Quaternion
    velocity_frd_m_s: tuple[float, float, float]
    pose_covariance: Sequence[Sequence[float]]  # (6, 6) x y z roll pitch yaw
    reset_counter: int  # increases when the estimate jumps, as after a loop closure
    quality_percent: int  # 0 to 100; 0 is unusable


def odometry_message(odometry: BodyOdometry, boot_time_us: int) -> Any:
    """The ODOMETRY at a time of the autopilot's boot clock."""
    rows = odometry.pose_covariance
    upper = [float(rows[i][j]) for i in range(6) for j in range(i, 6)]
    nan = math.nan
    return dialect.MAVLink_odometry_message(
        max(0, boot_time_us), LOCAL_FRD, BODY_FRD, *odometry.position_ned_m,
        list(odometry.q_ned_body), *odometry.velocity_frd_m_s, nan, nan, nan, upper, [nan] * CELLS,
        odometry.reset_counter & 0xFF, VISION, max(-1, min(100, odometry.quality_percent)),
    )  # fmt: skip
