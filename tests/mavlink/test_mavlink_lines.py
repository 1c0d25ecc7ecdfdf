"""NMEA and CSV lines give the states that they state; any bytes give whole packets or nothing."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from functools import reduce
from operator import xor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from loopback import free_port, until
from rehearsal import RehearsalControl

from mavlink.component.vehicle import VehicleConfig, VehicleLink
from mavlink.telemetry.decode import decode
from mavlink.telemetry.samples import AccuracySample, PositionSample, Sample
from mavlink.wire.framing import Decoder, Framer
from mavlink.wire.lines import COLUMNS, LineReader

S = 1_000_000_000


def sentence(body: str) -> bytes:
    return f"${body}*{reduce(xor, body.encode()):02X}\r\n".encode()


def samples(data: bytes) -> list[Sample]:
    framer, decoder = Framer(), Decoder()
    found = [decode(decoder.message(packet)) for packet in framer.feed(data)]
    assert framer.skipped_bytes == 0
    return [sample for sample in found if sample is not None]


def test_nmea_gives_position_velocity_and_accuracy() -> None:
    reader = LineReader()
    first = sentence("GPGGA,235959.50,4807.038,S,01131.000,W,1,08,0.9,545.4,M,46.9,M,,")
    reader.packets(first, 5 * S)
    second = sentence("GNGST,000000.50,,,,,0.3,0.4,1.1") + sentence(
        "GNGGA,000000.50,4807.032,S,01131.000,W,4,08,0.9,547.4,M,46.9,M,,"
    )
    accuracy, position = samples(reader.packets(second, 6 * S))
    assert isinstance(position, PositionSample) and isinstance(accuracy, AccuracySample)
    assert position.lat_deg == pytest.approx(-(48 + 7.032 / 60), abs=1e-7)
    assert position.lon_deg == pytest.approx(-(11 + 31.0 / 60), abs=1e-7)
    assert position.alt_amsl_m == 547.4 and position.relative_alt_m is None
    assert position.boot_ms == 86_400_500  # on from the day before
    # A hundredth of a minute of latitude is 18.5 m.
    assert position.v_ned_m_s == pytest.approx((0.6 * 18.553, 0.0, -2.0), abs=0.02)
    assert accuracy.sigma_h_m == pytest.approx(np.sqrt(0.125), abs=1e-3)
    assert accuracy.sigma_v_m == 1.1 and accuracy.is_claimed


@pytest.mark.parametrize(
    "line",
    [
        sentence("GPGGA,120000,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,")[:-4] + b"00\r\n",
        sentence("GPGGA,120000,4807.038,N,01131.000,E,0,08,0.9,545.4,M,46.9,M,,"),  # no fix
        sentence("GPGGA,120000,,N,,E,1,08,0.9,545.4,M,46.9,M,,"),
        sentence("GPGGA,120000,4807.038,N,01131.000,E,1,08,0.9,,M,46.9,M,,"),
        b"lat_deg,lon_deg\n47.1,8.2\n",  # no height
        b"47.1,8.2,400\n",  # no header
        b"lat_deg,lon_deg,alt_amsl_m\n0,0,400\n",
    ],
)
def test_lines_without_a_position_give_none(line: bytes) -> None:
    assert samples(LineReader().packets(line, S)) == []


def test_a_header_with_other_names_is_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    reader = LineReader()
    for _ in range(3):
        assert reader.packets(b"lat,lon,alt\n47.1,8.2,400\n", S) == b""
    (message,) = caplog.messages
    assert "'lat,lon,alt'" in message and "lat_deg, yaw_deg, gimbal_yaw_deg" in message


def test_cells_are_taken_by_name() -> None:
    reader = LineReader()
    reader.packets(b"note,gimbal_yaw_deg,lon_deg,lat_deg,relative_alt_m,gimbal_pitch_deg\n", S)
    row = b"a,0,8.2,47.1,61.5,-85\nb,,8.2,47.1,61.5,\n"
    found = samples(reader.packets(row, 2 * S))
    assert [type(one).__name__ for one in found] == [
        "AccuracySample", "PositionSample", "GimbalSample", "AccuracySample", "PositionSample",
    ]  # fmt: skip
    position = found[1]
    assert isinstance(position, PositionSample)
    assert (position.lat_deg, position.lon_deg) == pytest.approx((47.1, 8.2))
    assert position.alt_amsl_m is None and position.relative_alt_m == 61.5


lines = st.lists(
    st.one_of(
        st.binary(max_size=80),
        st.lists(st.sampled_from([*COLUMNS, "x"]), max_size=9).map(lambda f: ",".join(f).encode()),
        st.lists(st.floats() | st.just(""), max_size=9).map(
            lambda f: ",".join(map(str, f)).encode()
        ),
        st.lists(st.text("0123456789.-NSEWinfa", max_size=12), max_size=16).map(
            lambda fields: sentence("GPGGA," + ",".join(fields))
        ),
        st.lists(st.floats(), min_size=8, max_size=8).map(
            lambda fields: sentence("GPGST," + ",".join(map(str, fields)))
        ),
    ),
    max_size=12,
)


@given(st.lists(lines, max_size=4), st.integers(0, 1 << 62))
def test_any_lines_give_whole_packets(datagrams: list[list[bytes]], now_ns: int) -> None:
    reader = LineReader()
    for datagram in datagrams:
        samples(reader.packets(b"\n".join(datagram), now_ns))


@pytest.fixture
def vehicle() -> Iterator[tuple[VehicleLink, int]]:
    port = free_port()
    link = VehicleLink(VehicleConfig((f"lines:127.0.0.1:{port}",)), RehearsalControl())
    link.start()
    yield link, port
    link.stop()


def test_a_link_of_lines_fills_the_history(vehicle: tuple[VehicleLink, int]) -> None:
    link, port = vehicle
    row = "%.2f,47.1,8.2,460,60,1,2,30,0,-90,30\n"
    head = (
        "time_s,lat_deg,lon_deg,alt_amsl_m,relative_alt_m,roll_deg,pitch_deg,yaw_deg,"
        "gimbal_roll_deg,gimbal_pitch_deg,gimbal_yaw_deg\n"
    )
    sent = 0

    def is_known() -> bool:
        nonlocal sent
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            out.sendto((head + row % (0.1 * sent)).encode(), ("127.0.0.1", port))
        sent += 1
        last_ns = link.history.last_ns
        state = None if last_ns is None else link.history.state_at(last_ns)
        return state is not None and {"gnss", "attitude", "gimbal", "relative"} <= set(
            state.sources
        )

    until(is_known)
    state = link.history.state_at(link.history.last_ns or 0)
    assert state is not None
    assert (state.lat_deg, state.lon_deg) == pytest.approx((47.1, 8.2))
    assert (state.alt_amsl_m, state.alt_agl_m) == pytest.approx((460.0, 60.0))
    assert link.report().autopilot == (1, 1)
