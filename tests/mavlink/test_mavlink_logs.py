"""Telemetry logs of every kind, whole and damaged; truth from the logs' own making."""

from __future__ import annotations

import math
import random
import re
import struct
import tempfile
import threading
import time
import tracemalloc
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from paths import DATA, SHARED
from scipy.spatial.transform import Rotation

from mavlink.telemetry import quaternion
from mavlink.telemetry.decode import READERS
from mavlink.telemetry.history import HistoryConfig, VehicleHistory
from mavlink.telemetry.logs import TelemetryLog, load_telemetry
from mavlink.telemetry.samples import F64
from mavlink.wire.dialect import dialect

TURN = DATA / "mavlink" / "arducopter_turn.tlog"
US = 1_000_000
T0_US = 1_700_000_000 * US


def shared(name: str) -> Path:
    path = SHARED / name
    if not path.is_file():
        pytest.skip(f"{name} is not here")
    return path


def angle(a: F64 | quaternion.Quaternion, b: F64 | quaternion.Quaternion) -> float:
    ra, rb = (Rotation.from_quat([q[1], q[2], q[3], q[0]]) for q in (a, b))
    return float((ra.inv() * rb).magnitude())


class TlogWriter:
    """Writes packets of any sender with pymavlink's own encoder."""

    def __init__(self) -> None:
        self.data = bytearray()
        self._encoders: dict[tuple[int, int], Any] = {}

    def add(self, usec: int, message: Any, system: int = 1, component: int = 1) -> None:
        key = (system, component)
        encoder = self._encoders.setdefault(key, dialect.MAVLink(None, *key))
        packet = bytes(message.pack(encoder))
        encoder.seq = (encoder.seq + 1) % 256
        self.data += usec.to_bytes(8, "big") + packet

    def save(self, path: Path) -> Path:
        path.write_bytes(self.data)
        return path


def heartbeat() -> Any:
    return dialect.MAVLink_heartbeat_message(2, 3, 128, 0, 4, 3)


def attitude(boot_ms: int, yaw: float) -> Any:
    return dialect.MAVLink_attitude_message(boot_ms & 0xFFFFFFFF, 0.05, -0.1, yaw, 0, 0, 0)


def fly(
    writer: TlogWriter,
    seconds: float,
    stamp_us: Callable[[float], int],
    boot_ms: Callable[[float], float],
    system: int = 1,
) -> None:
    """20 Hz of attitude whose yaw is 0.3 rad/s, with a heartbeat every second."""
    for k in range(round(seconds * 20)):
        t = k / 20
        if k % 20 == 0:
            writer.add(stamp_us(t), heartbeat(), system)
        writer.add(stamp_us(t), attitude(round(boot_ms(t)), 0.3 * t), system)


def yaw_at(history: VehicleHistory, usec: int) -> float | None:
    state = history.state_at(usec * 1000)
    if state is None or state.q_ned_body_wxyz is None:
        return None
    w, x, y, z = state.q_ned_body_wxyz
    return quaternion.to_rpy((float(w), float(x), float(y), float(z)))[2]


# tlog: clocks


def test_jitter_of_arrival_does_not_reach_the_samples(tmp_path: Path) -> None:
    rng = random.Random(1)
    writer = TlogWriter()
    # Arrival is 3 ms late at best and 150 ms at worst; the clock drifts by 60 ppm.
    fly(
        writer,
        120,
        lambda t: T0_US + round((t + 0.003 + rng.expovariate(1 / 0.03)) * US),
        lambda t: 5000 + t * 1000 * (1 + 60e-6),
    )
    log = load_telemetry(writer.save(tmp_path / "a.tlog"))
    errors = []
    for t in np.linspace(1.0, 119.0, 300):
        yaw = yaw_at(log.history, T0_US + round(float(t) * US))
        assert yaw is not None
        errors.append((yaw - 0.3 * float(t) + math.pi) % (2 * math.pi) - math.pi)
    lateness_ms = -np.array(errors) / 0.3 * 1000
    assert np.abs(lateness_ms - 3.0).max() < 3.0
    assert log.clock == "unix" and log.warnings == ()


def test_a_faster_simulation_is_read_by_its_own_clock(tmp_path: Path) -> None:
    writer = TlogWriter()
    fly(writer, 100, lambda t: T0_US + round(t / 5 * US), lambda t: 60_000 + t * 1000)
    log = load_telemetry(writer.save(tmp_path / "a.tlog"))
    assert (log.last_ns - log.first_ns) * 1e-9 == pytest.approx(99.95)
    assert yaw_at(log.history, T0_US + 10 * US) == pytest.approx(3.0, abs=1e-3)
    assert any("clock" in warning for warning in log.warnings)


def test_the_boot_counter_may_wrap_in_flight(tmp_path: Path) -> None:
    writer = TlogWriter()
    fly(writer, 20, lambda t: T0_US + round(t * US), lambda t: 2**32 - 10_000 + t * 1000)
    log = load_telemetry(writer.save(tmp_path / "a.tlog"))
    assert log.warnings == ()
    for t in (5.0, 9.99, 10.01, 15.0):
        yaw = yaw_at(log.history, T0_US + round(t * US))
        assert yaw is not None
        assert math.remainder(yaw - 0.3 * t, 2 * math.pi) == pytest.approx(0.0, abs=1e-3)


def test_a_reboot_starts_a_session_of_its_own(tmp_path: Path) -> None:
    writer = TlogWriter()
    fly(writer, 20, lambda t: T0_US + round(t * US), lambda t: 300_000 + t * 1000)
    fly(writer, 20, lambda t: T0_US + round((t + 40) * US), lambda t: 2_000 + t * 1000)
    log = load_telemetry(writer.save(tmp_path / "a.tlog"))
    assert any("rebooted" in warning for warning in log.warnings)
    assert yaw_at(log.history, T0_US + 5 * US) == pytest.approx(1.5, abs=1e-3)
    assert yaw_at(log.history, T0_US + 45 * US) == pytest.approx(1.5, abs=1e-3)
    assert yaw_at(log.history, T0_US + 30 * US) is None


def test_a_clock_that_is_set_in_mid_log_is_followed(tmp_path: Path) -> None:
    writer = TlogWriter()
    step = 400 * 86_400 * US  # the computer learnt the date
    fly(
        writer,
        60,
        lambda t: T0_US + round(t * US) + (step if t >= 30 else 0),
        lambda t: 5_000 + t * 1000,
    )
    log = load_telemetry(writer.save(tmp_path / "a.tlog"))
    assert yaw_at(log.history, T0_US + 10 * US) == pytest.approx(3.0, abs=0.01)
    late = yaw_at(log.history, T0_US + step + 50 * US)
    assert late is not None and math.remainder(late - 15.0, 2 * math.pi) == pytest.approx(
        0.0, abs=0.01
    )


def test_the_vehicle_with_an_attitude_is_taken_not_the_ground_station(tmp_path: Path) -> None:
    writer = TlogWriter()
    fly(writer, 10, lambda t: T0_US + round(t * US), lambda t: 9_000 + t * 1000, system=7)
    for k in range(10):
        station = dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
        writer.add(T0_US + k * US, station, 255, 190)
    log = load_telemetry(writer.save(tmp_path / "a.tlog"))
    assert log.warnings == () and yaw_at(log.history, T0_US + 5 * US) is not None
    fly(writer, 3, lambda t: T0_US + round(t * US), lambda t: 1_000 + t * 1000, system=8)
    log = load_telemetry(writer.save(tmp_path / "b.tlog"))
    assert any("several vehicles" in w and "7" in w for w in log.warnings)


def test_the_attitude_of_a_gimbal_is_not_the_vehicles_in_a_log(tmp_path: Path) -> None:
    writer = TlogWriter()
    fly(writer, 10, lambda t: T0_US + round(t * US), lambda t: 9_000 + t * 1000)
    gimbal = dialect.MAVLink_heartbeat_message(26, 8, 0, 0, 4, 3)
    for k in range(100):
        writer.add(T0_US + k * US // 10, gimbal, 1, 154)
        writer.add(T0_US + k * US // 10, attitude(500 + 100 * k, -2.0), 1, 154)
    for k in range(100):  # and it restarts
        writer.add(T0_US + 10 * US + k * US // 10, attitude(500 + 100 * k, -2.0), 1, 154)
    log = load_telemetry(writer.save(tmp_path / "a.tlog"))
    assert len(log.history) == 200 and log.warnings == ()


# tlog: damage


def test_damage_is_skipped_and_counted(tmp_path: Path) -> None:
    raw = bytearray(TURN.read_bytes())
    rng = random.Random(2)
    for _ in range(60):
        at = rng.randrange(len(raw))
        raw[at : at + rng.randrange(30)] = rng.randbytes(rng.randrange(50))
    path = tmp_path / "damaged.tlog"
    path.write_bytes(raw)
    log, whole = load_telemetry(path), load_telemetry(TURN)
    assert 0 < log.counts["skipped_bytes"] < 20_000
    assert log.counts["packets"] > 0.95 * whole.counts["packets"]
    assert any("damaged bytes" in warning for warning in log.warnings)
    worst = 0.0
    for t in np.linspace(whole.first_ns + 10**9, whole.last_ns - 10**9, 200).astype(int):
        a, b = log.history.state_at(int(t)), whole.history.state_at(int(t))
        assert b is not None and b.q_ned_body_wxyz is not None
        if a is not None and a.q_ned_body_wxyz is not None:
            worst = max(worst, angle(a.q_ned_body_wxyz, b.q_ned_body_wxyz))
    assert worst < 0.05


def test_a_damaged_first_stamp_does_not_cost_the_log(tmp_path: Path) -> None:
    raw = bytearray(TURN.read_bytes())
    raw[:8] = (T0_US + 40 * 365 * 86_400 * US).to_bytes(8, "big")
    path = tmp_path / "first.tlog"
    path.write_bytes(raw)
    log, whole = load_telemetry(path), load_telemetry(TURN)
    assert log.counts["packets"] == whole.counts["packets"] - 1
    assert abs(log.first_ns - whole.first_ns) < 10**9


@pytest.mark.parametrize("cut", [1, 7, 8, 9, 15, 40])
def test_a_torn_end_is_no_failure(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "torn.tlog"
    path.write_bytes(TURN.read_bytes()[:-cut])
    assert load_telemetry(path).counts["packets"] >= 3300


@pytest.mark.parametrize("name", ["x.tlog", "x.BIN", "x.ulg", "x.SRT", "x.csv"])
@pytest.mark.parametrize("content", ["empty", "random", "zeros", "text"])
def test_what_is_no_log_is_refused_in_one_line(tmp_path: Path, name: str, content: str) -> None:
    path = tmp_path / name
    made = {
        "empty": b"",
        "random": random.Random(4).randbytes(50_000),
        "zeros": bytes(50_000),
        "text": b"no telemetry here\n" * 1000,
    }
    path.write_bytes(made[content])
    with pytest.raises(ValueError) as caught:
        load_telemetry(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


@pytest.mark.parametrize("header", [b"\xa3\x95", b"ULog\x01\x12\x35"], ids=["dataflash", "ulog"])
def test_garbage_behind_a_right_header_is_refused(tmp_path: Path, header: bytes) -> None:
    if header.startswith(b"ULog"):
        pytest.importorskip("pyulog")
    path = tmp_path / ("x.bin" if header[0] == 0xA3 else "x.ulg")
    for seed in range(5):
        path.write_bytes(header + random.Random(seed).randbytes(5_000))
        with pytest.raises(ValueError) as caught:
            load_telemetry(path)
        assert "\n" not in str(caught.value)


def test_no_file_and_an_unknown_kind_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no such"):
        load_telemetry(tmp_path / "none.tlog")
    (tmp_path / "x.txt").write_bytes(b"x")
    with pytest.raises(ValueError, match=r"\.tlog, \.bin, \.ulg, \.srt, \.csv"):
        load_telemetry(tmp_path / "x.txt")


# A real ArduCopter's log


def left_out_errors(log: TelemetryLog, keep_every: int) -> tuple[F64, F64]:
    """Errors and sigmas of attitudes left out of a thinned copy of a log's history."""
    thin = VehicleHistory()
    samples = log.history.attitudes()
    for sample, time_ns in samples[::keep_every]:
        thin.add(replace(sample, rates_rad_s=None), time_ns)
    errors, sigmas = [], []
    for sample, time_ns in samples:
        state = thin.state_at(time_ns)
        if state is not None and state.q_ned_body_wxyz is not None and state.sigma_attitude_rad:
            errors.append(angle(state.q_ned_body_wxyz, sample.q_ned_body))
            sigmas.append(state.sigma_attitude_rad)
    return np.array(errors), np.array(sigmas)


def check_interpolation(log: TelemetryLog) -> None:
    errors, sigmas = left_out_errors(log, 2)
    assert np.percentile(errors, 99) < math.radians(0.6)
    thin_errors, thin_sigmas = left_out_errors(log, 7)  # about the 3.5 Hz of a slow radio
    assert (thin_errors < 2.0 * thin_sigmas).mean() > 0.99
    assert thin_sigmas.max() > 1.5 * sigmas.max()


def test_attitude_left_out_of_a_real_log_is_interpolated_within_its_sigma() -> None:
    check_interpolation(load_telemetry(TURN))


@pytest.mark.slow
def test_the_whole_survey_is_read_quickly_and_agrees_with_itself() -> None:
    log = load_telemetry(shared("ardupilot_survey/survey_companion.tlog"))
    assert log.warnings == () and log.counts["ATTITUDE"] == 5954
    assert (log.last_ns - log.first_ns) * 1e-9 == pytest.approx(297.7, abs=0.2)
    check_interpolation(log)
    other = load_telemetry(shared("ardupilot_survey/survey_gcs.tlog"))
    for t in np.linspace(log.first_ns + 60e9, log.last_ns - 60e9, 50).astype(int):
        a, b = log.history.state_at(int(t)), other.history.state_at(int(t))
        assert a is not None and b is not None
        assert a.q_ned_body_wxyz is not None and b.q_ned_body_wxyz is not None
        assert angle(a.q_ned_body_wxyz, b.q_ned_body_wxyz) < math.radians(0.5)
        assert a.alt_agl_m is not None and b.alt_agl_m is not None
        assert a.alt_agl_m == pytest.approx(b.alt_agl_m, abs=0.3)


def nadir_angle_deg(q: F64) -> float:
    r = Rotation.from_quat([q[1], q[2], q[3], q[0]])
    return float(np.degrees(np.arccos(np.clip(r.as_matrix()[2, 0], -1, 1))))


def test_the_servo_mount_of_a_real_log_looks_straight_down() -> None:
    log = load_telemetry(TURN)
    off = []
    for t in np.linspace(log.first_ns + 1e9, log.last_ns - 1e9, 300).astype(int):
        state = log.history.state_at(int(t))
        assert state is not None and state.q_ned_gimbal_wxyz is not None
        off.append(nadir_angle_deg(state.q_ned_gimbal_wxyz))
    assert np.median(off) < 0.1
    assert np.percentile(off, 90) < 5.0  # in the turns the servo runs into its stop


def test_a_gimbal_device_that_keeps_the_horizon_is_accepted() -> None:
    log = load_telemetry(shared("ardupilot_survey/gimbal_device_companion.tlog"))
    state = log.history.state_at(log.first_ns + 50 * 10**9)
    assert state is not None and state.q_ned_gimbal_wxyz is not None
    assert nadir_angle_deg(state.q_ned_gimbal_wxyz) < 0.1
    assert any("clock" in warning for warning in log.warnings)


def test_the_slow_cmac_log_tags_with_terrain_height() -> None:
    log = load_telemetry(shared("cuav_cmac_20180805/flight.tlog"))
    start = 1_533_430_844_800_000_000  # the first frame, 01:00:44.80 UTC
    seen = 0
    for k in range(18):
        state = log.history.state_at(start + k * 820_000_000)
        if state is None or state.q_ned_body_wxyz is None or state.lat_deg is None:
            continue
        seen += 1
        assert state.alt_agl_m is not None and 60.0 < state.alt_agl_m < 100.0
        assert "terrain" in state.sources
        assert state.sigma_h_m is not None and 0.2 < state.sigma_h_m < 1.0
    assert seen >= 16


# DJI subtitles


SRT = {
    "phantom": (
        "1\n00:00:00,000 --> 00:00:01,000\nF/5.6, SS 400, GPS (-58.85, -34.23, 15), HOME (-58.8,"
        " -34.2, -57.98m), D 698.70m, H 85.80m, F.PRY (2.7°, -7.0°, 110.1°), G.PRY (-24.4°, 0.0°,"
        " 110.4°)\n\n"
    ),
    "phantom with a base station": (
        "1\n00:00:00,000 --> 00:00:01,000\nF/6.3, SS 60, ISO 100, EV 0, RTK (-58.85, -34.23, 28),"
        " HOME (-58.8, -34.2, 103.55m), D 75.36m, H 85.80m, G.PRY (-40.0°, 0.0°, 28.2°)\n\n"
    ),
    "mavic": (
        '1\n00:00:00,000 --> 00:00:00,033\n<font size="36">SrtCnt : 1, DiffTime : 33ms\n'
        "2022-05-01 15:01:58,531,716\n[iso : 100] [latitude: -34.23] [longitude: -58.85]"
        " [rel_alt: 85.800 abs_alt: 210.500] [gb_yaw: 110.4 gb_pitch: -24.4 gb_roll: 0.0] </font>"
        "\n\n"
    ),
    "matrice": (
        "1\n00:00:00,000 --> 00:00:01,000\n2022.06.21 16:06:17\n"
        "GPS(-34.2300,-58.8500,0.0M) BAROMETER:85.8M\n\n"
    ),
    "mavic of 2017": (
        "1\n00:00:00,000 --> 00:00:01,000\nHOME(-58.85,-34.23) 2017.8.5 14:11:51\n"
        "GPS(-58.8500,-34.2300,16) Hb:85.8 Hs:1.9\nISO:100 TV:60 EV: 0 IR:F2.8\n\n"
    ),
    "autel": (
        "1\n00:00:00,000 --> 00:00:01,000\nHOME(W: 58.800000, S: 34.200000) 2022-05-01 15:01:58\n"
        "GPS(W: 58.850000, S: 34.230000, 085.80m)\nISO:100 SHUTTER:30 EV:0.0 F-NUM:2.8\n"
        "F.PRY (2.7°, -7.0°, 110.1°), G.PRY (-24.4°, 0.0°, 110.4°)\n\n"
    ),
}


def with_commas(text: str) -> str:
    """The same numbers with decimal commas."""
    return re.sub(r": (-?\d+)\.(\d)", r": \1,\2", text)


@pytest.mark.parametrize("layout", list(SRT))
@pytest.mark.parametrize(
    "stored",
    [
        str.encode,
        lambda text: text.encode("cp1252"),
        lambda text: b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode(),
        lambda text: with_commas(text).encode(),
    ],
    ids=["utf-8", "cp1252", "windows", "commas"],
)
def test_subtitles_of_several_drones(
    tmp_path: Path, layout: str, stored: Callable[[str], bytes]
) -> None:
    path = tmp_path / "flight.SRT"
    path.write_bytes(stored(SRT[layout]))
    log = load_telemetry(path)
    assert log.clock == "video" and log.first_ns == 0
    state = log.history.state_at(0)
    assert state is not None
    assert state.lat_deg == pytest.approx(-34.23) and state.lon_deg == pytest.approx(-58.85)
    assert state.alt_agl_m == (None if layout == "autel" else pytest.approx(85.8))
    assert state.alt_amsl_m == (pytest.approx(210.5) if layout == "mavic" else None)
    if layout in ("phantom", "mavic", "autel"):
        assert state.q_ned_gimbal_wxyz is not None
        q = quaternion.from_rpy(0.0, math.radians(-24.4), math.radians(110.4))
        assert angle(state.q_ned_gimbal_wxyz, q) < 1e-6
    if layout in ("phantom", "autel"):
        assert state.q_ned_body_wxyz is not None
        q = quaternion.from_rpy(*map(math.radians, (-7.0, 2.7, 110.1)))
        assert angle(state.q_ned_body_wxyz, q) < 1e-6


# Flight records of AirData


AIRDATA = (
    "time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff({u}),"
    "height_above_ground_at_drone_location({u}),altitude_above_seaLevel({u}),speed(mph),"
    " compass_heading(degrees), pitch(degrees), roll(degrees),isVideo,gimbal_heading(degrees),"
    "gimbal_pitch(degrees),gimbal_roll(degrees),flycState,message"
)


def airdata(
    path: Path, unit: str = "feet", off_deg: float = -27.0, lines: Iterable[str] = (),
    dated: bool = True,
) -> TelemetryLog:  # fmt: skip
    """A record of 20 s, in which the vehicle turns at 12 degrees a second and its gimbal 3 degrees
    behind, but for ``off_deg``."""
    rows = [AIRDATA.format(u=unit), *lines]
    up = 1 / 0.3048 if unit == "feet" else 1.0
    for k in range(200):
        yaw, head = 1.2 * k % 360.0, (1.2 * k - 3.0 + off_deg) % 360.0
        date = f"2023-12-22 19:56:{32 + (k + 3) // 10:02d}"
        rows.append(
            f"{100 * k},{date if dated else ''},38.72{k:03d},-121.17,{50.0 * up},Available with"
            f" any subscription,{150.0 * up},0,{yaw:.1f}, 2.7, -0.1,1,{head:.1f}"
            f',-40.0,0,P-GPS,"Home Point updated, Data Recorder {k}"'
        )
    path.write_text("\n".join(rows) + "\n", encoding="utf-8-sig")
    return load_telemetry(path)


@pytest.mark.parametrize("unit", ["feet", "meters"])
def test_a_flight_record_of_airdata_is_read_in_its_own_units(tmp_path: Path, unit: str) -> None:
    log = airdata(tmp_path / "flight.csv", unit)
    assert (log.clock, log.may_lag) == ("unix", True)
    assert log.counts["positions"] == log.counts["rows"] == 200
    begin_ns = 1_703_274_992 * 10**9 + 300_000_000  # 2023-12-22 19:56:32.3 UTC
    assert log.first_ns == begin_ns
    state = log.history.state_at(begin_ns + 10 * 10**9)
    assert state is not None and state.lat_deg == pytest.approx(38.721)
    assert state.alt_agl_m == pytest.approx(50.0) and state.alt_amsl_m == pytest.approx(150.0)
    assert state.q_ned_body_wxyz is not None and state.q_ned_gimbal_wxyz is not None
    body = quaternion.from_degrees(-0.1, 2.7, 120.0)
    assert body is not None and angle(state.q_ned_body_wxyz, body) < 1e-6
    # What the gimbal lags by on the mean goes with what its heading is off by.
    head = quaternion.from_degrees(0.0, -40.0, 120.0)
    assert head is not None and angle(state.q_ned_gimbal_wxyz, head) < 1e-3
    assert log.warnings == ("the gimbal's headings are -30 degrees off the nose: corrected",)


def test_a_column_without_a_name_moves_none_of_the_others(tmp_path: Path) -> None:
    path = tmp_path / "flight.csv"
    airdata(path)
    first, *rows = path.read_text(encoding="utf-8-sig").splitlines()
    path.write_text("\n".join(["," + first, *("7.5," + row for row in rows)]))
    log = load_telemetry(path)
    assert log.counts["positions"] == 200
    state = log.history.state_at(log.first_ns)
    assert state is not None and state.lat_deg == pytest.approx(38.72)


def test_a_height_of_an_unknown_unit_is_none(tmp_path: Path) -> None:
    log = airdata(tmp_path / "flight.csv", "furlongs")
    state = log.history.state_at(log.first_ns)
    assert state is not None and state.alt_agl_m is None and state.alt_amsl_m is None


def test_a_record_without_dates_counts_from_its_start(tmp_path: Path) -> None:
    log = airdata(tmp_path / "flight.csv", dated=False)
    assert (log.clock, log.first_ns, log.last_ns) == ("boot", 0, 19_900_000_000)


def test_a_gimbal_that_turns_by_itself_keeps_its_heading(tmp_path: Path) -> None:
    path = tmp_path / "flight.csv"
    airdata(path)
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    turning = [line.split(",") for line in lines[1:]]
    for k, texts in enumerate(turning):
        texts[12] = f"{1.8 * k % 360:.1f}"
    path.write_text("\n".join([lines[0], *map(",".join, turning)]))
    log = load_telemetry(path)
    state = log.history.state_at(log.first_ns + 10 * 10**9)
    head = quaternion.from_degrees(0.0, -40.0, 180.0)
    assert state is not None and state.q_ned_gimbal_wxyz is not None and head is not None
    assert angle(state.q_ned_gimbal_wxyz, head) < 1e-6 and log.warnings == ()


def test_lines_that_are_no_rows_of_a_record_are_left_out(tmp_path: Path) -> None:
    bad = ['nan,"a lost quote', "1e99,,1,1", "x" * 40_000, "-5,2023-99-99 99:99:99", "\0", "100"]
    log = airdata(tmp_path / "flight.csv", lines=bad)
    assert log.counts["positions"] == 200 and log.counts["unreadable"] == 7
    assert log.warnings[0] == "7 lines are no rows of the record"


def cue(number: int, text: str) -> str:
    start, end = (
        f"00:00:{ms // 1000:02d},{ms % 1000:03d}" for ms in (number * 40, number * 40 + 40)
    )
    return f"{number + 1}\n{start} --> {end}\n{text}\n\n"


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-be"])
def test_subtitles_that_another_tool_stored_again_are_read(tmp_path: Path, encoding: str) -> None:
    text = "[latitude: 47.1] [longitude: 8.5] [rel_alt: 50.0 abs_alt: 500.0]"
    path = tmp_path / "flight.srt"
    mark = "\ufeff" if encoding == "utf-16-be" else ""
    lines = "".join(cue(k, text) for k in range(3)).replace("\n", "\r\n")
    path.write_bytes((mark + lines).encode(encoding))
    assert load_telemetry(path).counts["positions"] == 3


def test_subtitles_of_a_drone_without_a_position_give_its_height(tmp_path: Path) -> None:
    lost = "[latitude: 0.000000] [longitude: 0.000000] [rel_alt: 30.000 abs_alt: 269.1]"
    found = "[latitude: 45.0] [longitude: 13.0] [rel_alt: 30.000 abs_alt: 269.1]"
    path = tmp_path / "flight.SRT"
    path.write_text("".join(cue(n, found if n > 2 else lost) for n in range(5)))
    log = load_telemetry(path)
    assert log.warnings == ("3 cues without a position",) and log.history.is_pressure_altitude
    for time_ns in (0, 40_000_000, 100_000_000):  # the last between a cue without and one with
        state = log.history.state_at(time_ns)
        assert state is not None and state.lat_deg is None and state.alt_amsl_m is None
        assert state.alt_agl_m == pytest.approx(30.0)
    state = log.history.state_at(150_000_000)
    assert state is not None and state.lat_deg == pytest.approx(45.0)


def test_subtitles_of_joined_recordings_follow_on(tmp_path: Path) -> None:
    places = [f"[latitude: 45.0] [longitude: 13.0] [rel_alt: {n + 1}.0]" for n in range(60)]
    files = ["".join(cue(n, text) for n, text in enumerate(part)) for part in (places, places[30:])]
    path = tmp_path / "flight.SRT"
    path.write_text("".join(files))
    log = load_telemetry(path)
    assert log.warnings == ("times begin again 1 time(s): joined, the rest follows on",)
    assert log.last_ns == 89 * 40_000_000
    for time_ns, height_m in ((0, 1.0), (59 * 40_000_000, 60.0), (60 * 40_000_000, 31.0)):
        state = log.history.state_at(time_ns)
        assert state is not None and state.alt_agl_m == pytest.approx(height_m)


@pytest.mark.parametrize(
    ("focals", "median_mm", "zooms"),
    [
        (("240", "240", "240"), 24.0, False),
        (("24.00", "24.00", "24.00"), 24.0, False),
        (("24,00", "24,00", "24,00"), 24.0, False),
        (("162.00",) * 3, 162.0, False),
        (("240", "240", "480"), 24.0, True),
        (("0", "0", "0"), None, False),
        (("240] [dzoom_ratio: 10000, delta:0",) * 3, 24.0, False),
        (("240] [dzoom_ratio: 20000, delta:0",) * 3, 48.0, False),
        (("24.00] [dzoom_ratio: 1.00", "24.00] [dzoom_ratio: 2.00") * 2, 36.0, True),
        (("24.00] [dzoom_ratio: 999999999",) * 3, 24.0, False),
    ],
)
def test_subtitles_give_the_focal_length(
    tmp_path: Path, focals: tuple[str, ...], median_mm: float | None, zooms: bool
) -> None:
    place = "[latitude: 45.0] [longitude: 13.0] [rel_alt: 30.0]"
    path = tmp_path / "flight.SRT"
    path.write_text("".join(cue(n, f"[focal_len : {f}] {place}") for n, f in enumerate(focals)))
    log = load_telemetry(path)
    assert log.focal_35mm == median_mm
    assert any("zooms between 24 and 48 mm" in warning for warning in log.warnings) == zooms


@pytest.mark.parametrize("place", ["gb_yaw", "gb_pitch", "rel_alt", "abs_alt", "focal_len"])
def test_subtitles_lose_no_more_than_a_number_that_is_none(tmp_path: Path, place: str) -> None:
    good = (
        "[latitude: 45.0] [longitude: 13.0] [rel_alt: 30.0 abs_alt: 269.1] "
        "[gb_yaw: 1.0 gb_pitch: -90.0 gb_roll: 0.0] [focal_len: 24.0]"
    )
    texts = [good, re.sub(rf"{place}: \S+?(?=[ \]])", f"{place}: {'9' * 400}", good), good]
    path = tmp_path / "flight.SRT"
    path.write_text("".join(cue(n, text) for n, text in enumerate(texts)))
    log = load_telemetry(path)
    assert log.counts["positions"] == 3 and log.warnings == () and log.focal_35mm == 24.0
    gimbals = len(log.history.heads())
    assert gimbals == 2 if place.startswith("gb_") else gimbals == 3


@pytest.mark.slow
def test_subtitles_of_a_cue_without_end_take_no_memory(tmp_path: Path) -> None:
    path = tmp_path / "flight.SRT"
    found = "[latitude: 45.0] [longitude: 13.0] [rel_alt: 30.0]"
    path.write_text(cue(0, found) + "a\n" * 1_000_000 + cue(1, found))
    tracemalloc.start()
    try:
        assert load_telemetry(path).counts["positions"] == 2
        assert tracemalloc.get_traced_memory()[1] < 10_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("name", ["p4_rtk.SRT", "mavic_air2.srt", "matrice_300.srt"])
def test_real_subtitles_are_read_whole(name: str) -> None:
    log = load_telemetry(shared(f"flight_logs/dji_srt/{name}"))
    assert log.counts["positions"] == log.counts["cues"] > 20
    assert log.warnings == ()


# PX4 and ArduPilot onboard logs


def test_a_real_px4_log_gives_its_attitude() -> None:
    pytest.importorskip("pyulog")
    log = load_telemetry(shared("flight_logs/px4_auav_x21_68s.ulg"))
    assert log.clock == "boot" and any("no GPS time" in w for w in log.warnings)
    assert log.counts["vehicle_attitude"] == 6461
    errors, _ = left_out_errors(log, 2)
    assert np.percentile(errors, 99) < math.radians(0.1)


DATAFLASH = {
    "ATT": ("QhhHH", "TimeUS,Roll,Pitch,Yaw,AEKF", "Qcccc"),
    "POS": ("QiifffB", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt,X", "QLLfffB"),
    "XKF1": ("QBfff", "TimeUS,C,VN,VE,VD", "QBfff"),
    "GPS": ("QBBIHBfiB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,U", "QBBIHBfLB"),
    "GPA": ("QBff", "TimeUS,I,HAcc,VAcc", "QBff"),
    "RFND": ("QBfBB", "TimeUS,Instance,Dist,Stat,Orient", "QBfBB"),
    "TERR": ("QBf", "TimeUS,Status,CHeight", "QBf"),
    "MNT": ("QBffff", "TimeUS,I,Roll,Pitch,YawB,YawE", "QBffff"),
    "RATE": ("Qffffff", "TimeUS,RDes,R,PDes,P,YDes,Y", "Qffffff"),
    "IMU": ("QBfff", "TimeUS,I,GyrX,GyrY,GyrZ", "QBfff"),
    "UNIT": ("QB64s", "TimeUS,Id,Label", "QBZ"),
    "MULT": ("QBd", "TimeUS,Id,Mult", "Qbd"),
    "FMTU": ("QB16s16s", "TimeUS,FmtType,UnitIds,MultIds", "QBNN"),
}


class DataflashWriter:
    """Writes an ArduPilot .BIN log by its documented layout."""

    def __init__(self, formats: Mapping[str, tuple[str, str, str]] = DATAFLASH) -> None:
        self.data, self._formats = bytearray(), formats
        self._numbers = {name: 129 + k for k, name in enumerate(formats)}
        self._format(128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
        for name, (packed, columns, kinds) in formats.items():
            size = 3 + struct.calcsize("<" + packed)
            number = self._numbers[name]
            self._format(number, size, name.encode(), kinds.encode(), columns.encode())

    def _format(self, number: int, size: int, name: bytes, kinds: bytes, columns: bytes) -> None:
        self.data += b"\xa3\x95\x80" + struct.pack(
            "<BB4s16s64s", number, size, name, kinds, columns
        )

    def add(self, name: str, *values: float | bytes) -> None:
        self.data += bytes((0xA3, 0x95, self._numbers[name]))
        self.data += struct.pack("<" + self._formats[name][0], *values)

    def state_units_of_rate(self) -> None:
        """As Copter does since 3.6."""
        self.add("UNIT", 0, ord("s"), b"s")
        self.add("UNIT", 0, ord("k"), b"deg/s")
        self.add("MULT", 0, ord("F"), 1e-6)
        self.add("MULT", 0, ord("?"), 1.0)
        self.add("FMTU", 0, self._numbers["RATE"], b"skkkkkk", b"F??????")


def dataflash_flight(dated: bool) -> DataflashWriter:
    writer = DataflashWriter()
    for k in range(200):
        us = 30_000_000 + k * 50_000
        if k % 4 == 0:
            gms = 100_000_000 + k * 50 if dated else 0
            writer.add("GPS", us, 0, 3, gms, 2200 if dated else 0, 12, 0.8, 473000000, 1)
            writer.add("GPA", us, 0, 0.7, 1.1)
        writer.add("XKF1", us, 0, 3.0, 1.0, -0.5)
        writer.add("ATT", us, 500, -1000, 9000, 3)
        writer.add("POS", us, 473000000, 85000000, 512.5, 62.5, 60.0, 0)
        writer.add("MNT", us, 0, 0.0, -60.0, 10.0, 100.0)
        if k >= 100:
            writer.add("RFND", us, 0, 50.0, 4, 25)
        writer.add("TERR", us, 2, 58.0)
    return writer


def test_damage_of_an_onboard_log_is_counted_in_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "log.BIN"
    data = dataflash_flight(True).data
    path.write_bytes(data)
    sound = load_telemetry(path)
    assert sound.counts["skipped_bytes"] == 0 and sound.warnings == ()
    path.write_bytes(data + bytes(5000) + data[-3000:])
    damaged = load_telemetry(path)
    assert 5000 <= damaged.counts["skipped_bytes"] <= 5100  # and what was torn
    assert damaged.warnings == (f"{damaged.counts['skipped_bytes']} damaged bytes were skipped",)
    assert capfd.readouterr() == ("", "")


def test_what_others_print_while_a_log_is_read_is_shown(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Only the readers of logs are silenced, not the process."""
    path = tmp_path / "log.BIN"
    path.write_bytes(dataflash_flight(True).data)
    for log in (path, shared("flight_logs/px4_auav_x21_68s.ulg")):
        said, is_reading = [0], [True]

        def speak(said: list[int] = said, is_reading: list[bool] = is_reading) -> None:
            while is_reading[0]:
                print("another thread")
                said[0] += 1
                time.sleep(0.001)

        speaking = threading.Thread(target=speak)
        speaking.start()
        before = said[0]
        load_telemetry(log)
        during = said[0] - before
        is_reading[0] = False
        speaking.join()
        assert during > 0 and capfd.readouterr().out.count("another thread") == said[0]


def test_a_damaged_time_of_an_onboard_log_costs_its_message_only(tmp_path: Path) -> None:
    path = tmp_path / "log.BIN"
    path.write_bytes(dataflash_flight(True).data)
    sound = load_telemetry(path)
    writer = dataflash_flight(True)
    writer.add("ATT", 1 << 63, 500, -1000, 9000, 3)
    writer.add("POS", 1 << 60, 473000000, 85000000, 512.5, 62.5, 60.0, 0)
    writer.add("ATT", 1 << 25, 500, -1000, 9000, 3)  # 33 s: within any day
    path.write_bytes(writer.data)
    damaged = load_telemetry(path)
    assert (damaged.first_ns, damaged.last_ns) == (sound.first_ns, sound.last_ns)


@pytest.mark.parametrize("dated", [True, False])
def test_an_ardupilot_onboard_log(tmp_path: Path, dated: bool) -> None:
    path = tmp_path / "log.BIN"
    path.write_bytes(dataflash_flight(dated).data)
    log = load_telemetry(path)
    assert log.clock == ("unix" if dated else "boot")
    # GPS week 2200, 100000 s into it, leap seconds off: 2022-03-07 03:46:40 UTC less 18 s.
    if dated:
        assert log.first_ns * 1e-9 == pytest.approx(315964800 + 2200 * 604800 + 100_000 - 18, abs=1)
    early, late = (
        log.history.state_at(log.first_ns + 10**9),
        log.history.state_at(log.last_ns - 10**9),
    )
    for state in (early, late):
        assert state is not None and state.q_ned_body_wxyz is not None
        q = quaternion.from_rpy(*map(math.radians, (5.0, -10.0, 90.0)))
        assert angle(state.q_ned_body_wxyz, q) < 1e-4
        assert state.lat_deg == pytest.approx(47.3) and state.lon_deg == pytest.approx(8.5)
        assert state.alt_amsl_m == pytest.approx(512.5)
        assert state.v_ned_m_s is not None and list(state.v_ned_m_s) == pytest.approx([3, 1, -0.5])
        assert state.sigma_h_m == pytest.approx(0.7, rel=0.01)
        assert state.q_ned_gimbal_wxyz is not None
        head = quaternion.from_rpy(0.0, math.radians(-60.0), math.radians(100.0))
        assert angle(state.q_ned_gimbal_wxyz, head) < 1e-4
    assert early is not None and early.sources[-1] == "terrain"
    assert late is not None and late.sources[-1] == "rangefinder"
    path.write_bytes(dataflash_flight(dated).data[:-700])
    assert load_telemetry(path).counts["ATT"] > 190


def test_a_second_receiver_without_a_fix_takes_no_position(tmp_path: Path) -> None:
    writer = dataflash_flight(True)
    for k in range(100):
        us = 30_000_000 + k * 100_000
        writer.add("GPS", us, 1, 1, 0, 0, 0, 99.9, 0, 0)
        writer.add("GPA", us, 1, 500.0, 500.0)
    path = tmp_path / "log.BIN"
    path.write_bytes(writer.data)
    log = load_telemetry(path)
    for k in range(1, 10):
        state = log.history.state_at(log.first_ns + k * 970_000_000)
        assert state is not None and state.lat_deg == pytest.approx(47.3)
        assert state.sigma_h_m == pytest.approx(0.7, rel=0.01)


@pytest.mark.parametrize("has_rate", [True, False], ids=["RATE", "IMU"])
def test_rates_of_an_onboard_log_turn_the_body_between_its_attitudes(
    tmp_path: Path, has_rate: bool
) -> None:
    """Of a roll at 1 Hz, with an attitude ten times a second; RATE without a unit is not read."""
    writer, swing = DataflashWriter(), 2.0 * math.pi
    if has_rate:
        writer.state_units_of_rate()
    for k in range(400):
        us, t = 30_000_000 + k * 10_000, 0.01 * k
        if k % 4 == 1:
            off = 100.0 if has_rate else 0.0  # read only where RATE is not
            writer.add("IMU", us, 0, 0.35 * swing * math.cos(swing * t) + off, 0.0, 0.0)
            writer.add("IMU", us, 1, 1.0, 2.0, 3.0)
        if k % 10 == 0:
            writer.add("ATT", us, round(math.degrees(35.0 * math.sin(swing * t))), 0, 0, 3)
            deg_s = math.degrees(0.35 * swing * math.cos(swing * t))
            writer.add("RATE", us, 0.0, deg_s if has_rate else 100.0 * deg_s, 0.0, 0.0, 0.0, 0.0)
    path = tmp_path / "log.BIN"
    path.write_bytes(writer.data)
    history = load_telemetry(path).history
    errors = []
    for k in range(100, 300):
        state = history.state_at(30_000_000_000 + k * 10_000_000)
        assert state is not None and state.q_ned_body_wxyz is not None
        true = quaternion.from_rpy(0.35 * math.sin(swing * 0.01 * k), 0.0, 0.0)
        errors.append(angle(state.q_ned_body_wxyz, true))
    assert max(errors) < math.radians(0.1)  # without rates 1.0


class UlogWriter:
    """Writes a PX4 .ulg log by its documented layout."""

    def __init__(self, topics: dict[str, str]) -> None:
        self.data = bytearray(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 10_000_000))
        self._codes: dict[str, tuple[int, str]] = {}
        self._put(b"B", bytes(40))
        for name, declared in topics.items():
            self._put(b"F", f"{name}:{declared}".encode())
        for number, (name, declared) in enumerate(topics.items()):
            self._put(b"A", struct.pack("<BH", 0, number) + name.encode())
            self._codes[name] = (
                number,
                "<" + "".join(map(self.code, re.findall(r"(\S+) \w+;", declared))),
            )

    @staticmethod
    def code(kind: str) -> str:
        """Of the struct module."""
        codes = {"uint64_t": "Q", "float": "f", "double": "d", "bool": "?", "uint8_t": "B"}
        codes |= {"uint16_t": "H", "float[4]": "4f", "int32_t": "i"}
        return codes[kind]

    def _put(self, kind: bytes, content: bytes) -> None:
        self.data += struct.pack("<H", len(content)) + kind + content

    def add(self, name: str, *values: float) -> None:
        number, code = self._codes[name]
        self._put(b"D", struct.pack("<H", number) + struct.pack(code, *values))


STAMP = "uint64_t timestamp;"
GLOBAL = "double lat;double lon;float alt;float vel_n;float vel_e;float vel_d;float eph;float epv;"
LOCAL = (
    "double ref_lat;double ref_lon;float ref_alt;float x;float y;float z;float vx;float vy;"
    "float vz;float eph;float epv;float dist_bottom;bool dist_bottom_valid;bool xy_global;"
    "bool z_global;"
)
ULOG = {
    "vehicle_attitude": STAMP + "float[4] q;",
    "vehicle_global_position": STAMP + GLOBAL,
    "vehicle_local_position": STAMP + LOCAL,
    "distance_sensor": STAMP
    + "float min_distance;float max_distance;float current_distance;uint8_t orientation;",
    "gimbal_device_attitude_status": STAMP + "float[4] q;uint16_t device_flags;",
    "sensor_gps": STAMP + "uint64_t time_utc_usec;",
}


@pytest.mark.parametrize("place", ["vehicle_global_position", "vehicle_local_position"])
def test_a_px4_onboard_log(tmp_path: Path, place: str) -> None:
    pytest.importorskip("pyulog")
    writer = UlogWriter(ULOG)
    body, head = quaternion.from_rpy(0.1, -0.1, 0.5), quaternion.from_rpy(0.0, -1.2, 0.0)
    for k in range(100):
        us = 10_000_000 + k * 50_000
        writer.add("vehicle_attitude", us, *body)
        writer.add("gimbal_device_attitude_status", us, *head, 64)
        if place == "vehicle_global_position":
            writer.add(place, us, 47.3, 8.5, 512.5, 3.0, 1.0, -0.5, 0.6, 0.9)
        else:
            # 111.31949 m north of the reference is a thousandth of a degree.
            writer.add(
                place, us, 47.299, 8.5, 450.0, 111.31949, 0.0, -62.5,
                3.0, 1.0, -0.5, 0.6, 0.9, 55.0, True, True, True,
            )  # fmt: skip
        writer.add("sensor_gps", us, T0_US + k * 50_000)
        if k >= 50:
            writer.add("distance_sensor", us, 0.2, 100.0, 50.0, 25)
        writer.add("distance_sensor", us + 1, 0.2, 100.0, 9.0, 0)  # looks ahead
    path = tmp_path / "log.ulg"
    path.write_bytes(writer.data)
    log = load_telemetry(path)
    assert log.clock == "unix" and log.first_ns == T0_US * 1000 and log.warnings == ()
    early = log.history.state_at(log.first_ns + 10**9)
    late = log.history.state_at(log.last_ns - 10**9)
    for state in (early, late):
        assert state is not None
        assert state.lat_deg == pytest.approx(47.3, abs=1e-7)
        assert state.lon_deg == pytest.approx(8.5)
        assert state.alt_amsl_m == pytest.approx(512.5)
        assert state.v_ned_m_s is not None and list(state.v_ned_m_s) == pytest.approx([3, 1, -0.5])
        assert state.sigma_h_m == pytest.approx(0.6, rel=0.01)
        assert state.q_ned_body_wxyz is not None and state.q_ned_gimbal_wxyz is not None
        assert angle(state.q_ned_body_wxyz, body) < 1e-5
        assert angle(state.q_ned_gimbal_wxyz, head) < 1e-5
    assert late is not None and late.sources[-1] == "rangefinder"
    assert early is not None and ("terrain" in early.sources) == (
        place != "vehicle_global_position"
    )


MODERN = {
    "vehicle_attitude": STAMP + "float[4] q;",
    "vehicle_global_position": STAMP + "double lat;double lon;float alt;float eph;float epv;",
    "vehicle_local_position": STAMP + "float vx;float vy;float vz;bool v_xy_valid;bool v_z_valid;",
    "vehicle_gps_position": STAMP + "int32_t lat;int32_t lon;int32_t alt;uint8_t fix_type;",
    "sensor_gps": STAMP + "uint64_t time_utc_usec;double latitude_deg;double longitude_deg;"
    "double altitude_msl_m;float eph;float epv;float vel_n_m_s;float vel_e_m_s;float vel_d_m_s;"
    "uint8_t fix_type;bool vel_ned_valid;",
    "home_position": STAMP + "float alt;bool valid_alt;",
}
"""As PX4 writes them since 1.11, and vehicle_gps_position as it did before 1.14."""


@pytest.mark.parametrize(
    ("place", "alt_m", "sigma_m", "speed_m_s"),
    [
        ("vehicle_global_position", 538.0, 0.12, 5.0),
        ("vehicle_gps_position", 537.0, 2.1, None),
        ("sensor_gps", 536.0, 0.5, 4.0),
    ],
)
def test_a_px4_log_since_1_11(
    tmp_path: Path, place: str, alt_m: float, sigma_m: float, speed_m_s: float | None
) -> None:
    """Without velocities in the global position; the best place that is there is read."""
    pytest.importorskip("pyulog")
    better = ("vehicle_global_position", "vehicle_gps_position", "sensor_gps")
    left_out = better[: better.index(place)]
    writer = UlogWriter({name: one for name, one in MODERN.items() if name not in left_out})
    for k in range(200):
        us, lat = 10_000_000 + k * 50_000, 47.3977 + 5.0 * k * 0.05 / 111_319.49
        writer.add("vehicle_attitude", us, 1.0, 0.0, 0.0, 0.0)
        writer.add("vehicle_local_position", us + 9000, 5.0, 0.0, -0.5, True, True)
        writer.add("sensor_gps", us, T0_US + us, lat, 8.5456, 536, 0.5, 0.9, 4, 0, 0, 3, True)
        if place == "vehicle_gps_position":
            writer.add(place, us, round(lat * 1e7), 85_456_000, 537_000, 3)
        if place == "vehicle_global_position":
            writer.add(place, us, lat, 8.5456, 538.0, 0.12, 0.2)
    writer.add("home_position", 10_000_000, 488.0, True)
    path = tmp_path / "log.ulg"
    path.write_bytes(writer.data)
    log = load_telemetry(path)
    assert log.clock == "unix" and log.first_ns == (T0_US + 10_000_000) * 1000
    state = log.history.state_at(log.first_ns + 8 * 10**9)
    assert state is not None and state.alt_amsl_m == pytest.approx(alt_m)
    assert state.lat_deg == pytest.approx(47.3977 + 40.0 / 111_319.49, abs=1e-7)
    assert state.lon_deg == pytest.approx(8.5456)
    assert state.sigma_h_m == pytest.approx(sigma_m, rel=0.01)
    assert state.alt_agl_m == (50.0 if place == "vehicle_global_position" else None)
    assert (state.v_ned_m_s is None) == (speed_m_s is None)
    assert state.v_ned_m_s is None or state.v_ned_m_s[0] == pytest.approx(speed_m_s)


def test_an_ardupilot_log_without_an_estimate_is_placed_by_its_receiver(tmp_path: Path) -> None:
    """As Copter 3.2's, which has no POS, NKF1 and GPA."""
    kept = {name: DATAFLASH[name] for name in ("ATT", "TERR")}
    columns = "TimeUS,Status,GMS,GWk,HDop,Lat,Lng,Alt,Spd,GCrs,VZ"
    writer = DataflashWriter(kept | {"GPS": ("QBIHfiiffff", columns, "QBIHfLLffff")})
    for k in range(100):
        us = 30_000_000 + k * 100_000
        place = (473_000_000 + 100 * k, 85_000_000, 512.5, 11.132, 0.0, -0.5)
        writer.add("GPS", us, 3, 100_000_000 + 100 * k, 2200, 0.8, *place)
        writer.add("ATT", us, 500, -1000, 9000, 3)
    path = tmp_path / "log.BIN"
    path.write_bytes(writer.data)
    log = load_telemetry(path)
    state = log.history.state_at(log.first_ns + 5 * 10**9)
    assert log.clock == "unix" and state is not None and not state.is_claimed
    assert state.lat_deg == pytest.approx(47.3005, abs=2e-6)
    assert state.alt_amsl_m == pytest.approx(512.5)
    assert state.sigma_h_m == pytest.approx(1.2, rel=0.01)
    assert state.v_ned_m_s is not None and state.v_ned_m_s[0] == pytest.approx(11.132)


# Any subset of what is declared


def check_log(path: Path) -> None:
    """The log is read into finite values, or refused in one line."""
    try:
        log = load_telemetry(path)
    except ValueError as refused:
        assert "\n" not in str(refused)
        return
    for time_ns in np.linspace(log.first_ns, log.last_ns, 5).astype(int):
        state = log.history.state_at(int(time_ns))
        log.history.heads()
        for field in fields(state) if state is not None else ():
            value = getattr(state, field.name)
            if isinstance(value, float | np.ndarray):
                assert np.isfinite(value).all(), (field.name, value)
        if state is not None and state.lat_deg is not None:
            assert state.sigma_h_m is not None and state.sigma_h_m > 0.0


ODD = (math.nan, math.inf, -math.inf, 0.0, -1.0, 1e30, 200.0)
"""Values of fields that were never set."""


class Draw(random.Random):
    """Chooses what a log declares, and the values of its fields."""

    def some(self, of: Collection[Any]) -> list[Any]:
        """Most of them, in their order."""
        return [one for one in of if self.random() < 0.85]

    def value(self, code: str, sound: float = 3.0) -> Any:
        """One that a field of the struct module's ``code`` can hold."""
        value = self.choice(ODD) if self.random() < 0.2 else sound
        if code[-1] in "fd":
            return value
        least, most = (-(2**7), 2**7 - 1) if code[-1].islower() else (0, 2**8 - 1)
        return round(sound if not least <= value <= most else value)


EACH_TIME = settings(max_examples=50)(given(st.integers(0, 2**32).map(Draw)))

ULOG_MORE = {
    "vehicle_global_position": GLOBAL + "bool lat_lon_valid;bool alt_valid;",
    "vehicle_local_position": LOCAL + "bool v_xy_valid;bool v_z_valid;",
    "sensor_gps": MODERN["sensor_gps"].removeprefix(STAMP) + "int32_t lat;int32_t lon;int32_t alt;",
}
SOUND = {"lat": 47.0, "lon": 8.0, "ref_lat": 47.0, "latitude_deg": 47.0, "longitude_deg": 8.0}


@EACH_TIME
def test_px4_logs_of_any_fields_are_read_or_refused(draw: Draw) -> None:
    pytest.importorskip("pyulog")
    every = MODERN | ULOG | {name: STAMP + more for name, more in ULOG_MORE.items()}
    every["vehicle_gps_position"] = every["sensor_gps"]
    topics = {
        name: "".join(f"{field};" for field in draw.some(every[name].split(";")[:-1]))
        for name in draw.some(every)
    }
    writer = UlogWriter(topics)
    for k in range(8):
        known = SOUND | {"timestamp": 10_000_000 + 50_000 * k, "time_utc_usec": T0_US + 50_000 * k}
        for name, declared in topics.items():
            values: list[Any] = []
            for field in declared.split(";")[:-1]:
                kind, called = field.split()
                code = UlogWriter.code(kind)
                sound = known.get(called, 1.0)
                values.append(sound if code == "Q" else draw.value(code, sound))
                values += [0.0] * 3 if code == "4f" else []
            writer.add(name, *values)
    check_log(_written(writer.data, "log.ulg"))


@EACH_TIME
def test_ardupilot_logs_of_any_fields_are_read_or_refused(draw: Draw) -> None:
    formats, codes = {}, {}
    for name in draw.some(DATAFLASH):
        packed, columns, kinds = DATAFLASH[name]
        declared = zip(re.findall(r"\d*[a-zA-Z]", packed), columns.split(","), kinds, strict=True)
        kept = draw.some(list(declared))
        codes[name] = [code for code, _, _ in kept]
        formats[name] = (
            "".join(codes[name]),
            ",".join(c for _, c, _ in kept),
            "".join(k for _, _, k in kept),
        )
    writer = DataflashWriter(formats)
    for k in range(8):
        us = 30_000_000 + 50_000 * k
        for name, wanted in codes.items():
            values = [us if c == "Q" else b"k" if c[-1] == "s" else draw.value(c) for c in wanted]
            writer.add(name, *values)
    check_log(_written(writer.data, "log.BIN"))


@EACH_TIME
def test_telemetry_logs_of_any_messages_are_read_or_refused(draw: Draw) -> None:
    writer = TlogWriter()
    for k in range(8):
        for name in draw.some(READERS):
            kind = getattr(dialect, f"MAVLink_{name.lower()}_message")
            codes = {"float": "f", "double": "d", "int8_t": "b", "int16_t": "b", "int32_t": "b"}
            sizes = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
            values: list[Any] = []
            for field, sort in zip(kind.fieldnames, kind.fieldtypes, strict=True):
                value = draw.value(codes.get(sort, "B"))
                values.append([value] * sizes[field] if sizes[field] else value)
            writer.add(T0_US + 100_000 * k, kind(*values))
    check_log(_written(writer.data, "log.tlog"))


@EACH_TIME
def test_subtitles_of_any_fields_are_read_or_refused(draw: Draw) -> None:
    words = [word for text in SRT.values() for word in re.findall(r"[^\s,\[\]]+", text)]
    words += ["rel_alt:", "latitude: 999", "longitude: 1e400", "focal_len: 0.0", "GPS (", "-->"]
    cues = [cue(n, " ".join(draw.some(draw.choices(words, k=30)))) for n in range(6)]
    check_log(_written("".join(draw.some(cues)).encode() or b"\n", "log.SRT"))


@EACH_TIME
def test_flight_records_of_any_fields_are_read_or_refused(draw: Draw) -> None:
    words = [*AIRDATA.format(u="feet").split(","), "1e400", "-", "2023-12-22 19:56:32", '"', "12.5"]
    lines = [",".join(draw.some(draw.choices(words, k=20))) for _ in range(6)]
    lines.insert(0, ",".join(draw.some(AIRDATA.format(u="feet").split(","))))
    check_log(_written("\n".join(lines).encode() or b"\n", "log.csv"))


def _written(content: bytes | bytearray, name: str) -> Path:
    path = Path(tempfile.mkdtemp(dir=SCRATCH.name)) / name
    path.write_bytes(content)
    return path


SCRATCH = tempfile.TemporaryDirectory()
"""Removed at the end; hypothesis and pytest's tmp_path do not go together."""


def test_settings_of_the_history_reach_it() -> None:
    config = HistoryConfig(keep_s=1.0)
    log = load_telemetry(TURN, config)
    assert log.history.config is config


def test_receivers_fixes_fill_what_an_estimate_leaves(tmp_path: Path) -> None:
    """The estimate began late, and the whole log before it had no position; one sample of a wrong
    time makes no log of an hour."""
    pytest.importorskip("pyulog")
    gps = STAMP + "double latitude_deg;double longitude_deg;double altitude_msl_m;float eph;"
    writer = UlogWriter(ULOG | {"vehicle_gps_position": gps + "float epv;uint8_t fix_type;"})
    for k in range(100):
        us = 10_000_000 + k * 100_000
        writer.add("vehicle_attitude", us, 1.0, 0.0, 0.0, 0.0)
        writer.add("vehicle_gps_position", us, 47.4, 8.5, 500.0, 1.5, 2.0, 3)
        if 60 <= k < 80:
            writer.add("vehicle_global_position", us, 47.3, 8.5, 512.5, 0.0, 0.0, 0.0, 0.6, 0.9)
    writer.add("vehicle_attitude", 3_600_000_000, 1.0, 0.0, 0.0, 0.0)
    path = tmp_path / "log.ulg"
    path.write_bytes(writer.data)
    log = load_telemetry(path)
    assert (log.last_ns - log.first_ns) * 1e-9 == pytest.approx(9.9)
    for time_s, lat, sigma_m in ((2.0, 47.4, 1.5), (7.0, 47.3, 0.6), (9.5, 47.4, 1.5)):
        state = log.history.state_at(log.first_ns + round(time_s * 1e9))
        assert state is not None and state.lat_deg == pytest.approx(lat)
        assert state.sigma_h_m == pytest.approx(sigma_m, abs=0.01)


def test_a_damaged_ulg_is_said_in_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """pyulog prints a line for each damaged message, where --json has its object."""
    data = bytearray(shared("flight_logs/px4_auav_x21_68s.ulg").read_bytes()[:400_000])
    rng = random.Random(1)
    for _ in range(200):
        data[rng.randrange(100_000, len(data))] ^= 1 << rng.randrange(8)
    path = tmp_path / "damaged.ulg"
    path.write_bytes(data)
    log = load_telemetry(path)
    assert "the log is damaged: parts of it were skipped" in log.warnings
    assert capfd.readouterr() == ("", "")


def test_a_ulg_that_breaks_off_within_a_damaged_message_ends(tmp_path: Path) -> None:
    """pyulog would step back and read these three bytes for ever."""
    path = tmp_path / "flight.ulg"
    path.write_bytes(b"ULog\x01\x12\x35\x01" + bytes(8) + b"\x01\x00\x00")
    with pytest.raises(ValueError, match="is truncated within a damaged message"):
        load_telemetry(path)
