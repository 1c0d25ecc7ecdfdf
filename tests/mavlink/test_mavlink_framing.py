"""Bytes into packets, packets into messages and samples."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import pytest
from autopilot import attitude, packed
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink.telemetry.decode import READERS, decode
from mavlink.telemetry.samples import PositionSample, RangeSample, TerrainSample
from mavlink.wire.dialect import dialect, x25crc
from mavlink.wire.framing import Decoder, Framer, check_packet, packet_length


def mixture(rng: random.Random, count: int) -> tuple[bytes, int]:
    """Good packets of both versions with noise between them, and how many are good."""
    data, good = bytearray(), 0
    v1 = dialect.MAVLink(None, 9, 9)
    for k in range(count):
        message = attitude(k)
        if rng.random() < 0.3:
            data += bytes(message.pack(v1, force_mavlink1=True))
        else:
            data += packed(message, seq=k % 256)
        good += 1
        if rng.random() < 0.3:  # noise that cannot hide a packet start
            data += bytes(rng.choice(range(0xFD)) for _ in range(rng.randrange(40)))
    return bytes(data), good


@pytest.mark.parametrize("seed", range(5))
def test_packets_are_found_however_the_bytes_come(seed: int) -> None:
    rng = random.Random(seed)
    data, good = mixture(rng, 200)
    whole = Framer()
    assert len(whole.feed(data)) == good
    pieces = Framer()
    found, at = 0, 0
    while at < len(data):
        step = rng.randrange(1, 50)
        found += len(pieces.feed(data[at : at + step]))
        at += step
    assert found == good and pieces.skipped_bytes == whole.skipped_bytes


def test_a_damaged_packet_does_not_take_the_next_one_along() -> None:
    first, second = bytearray(packed(attitude(1))), packed(attitude(2))
    first[1] = 200  # claims to be longer than it is
    framer = Framer()
    found = framer.feed(bytes(first) + second * 30)
    assert len(found) == 30 and framer.skipped_bytes >= 1


def test_an_order_does_not_wait_behind_noise_that_looks_like_a_start() -> None:
    beat = bytes(dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(dialect.MAVLink(None)))
    for noise in (b"\xfd\xff\x00\x00\x01", b"\xfe\xff", beat[:12]):
        framer = Framer()
        assert framer.feed(noise) == []
        assert [p.data for p in framer.feed(beat)] == [beat]
        assert framer.skipped_bytes == len(noise)
        assert [p.data for p in framer.feed(beat[:9]) + framer.feed(beat[9:])] == [beat]


def test_every_single_bit_error_is_noticed() -> None:
    packet = packed(attitude(12345, 0.5))
    for i in range(len(packet)):
        for bit in range(8):
            damaged = bytearray(packet)
            damaged[i] ^= 1 << bit
            for got in Framer().feed(bytes(damaged)):
                assert not got.known, (i, bit)


@settings(max_examples=300)
@given(st.binary(max_size=300), st.integers(0, 300))
def test_length_and_check_take_any_bytes(data: bytes, at: int) -> None:
    length = packet_length(data, at)
    assert length is None or 0 <= length <= 280
    if length and at + length <= len(data):
        check_packet(data[at : at + length])


@pytest.mark.parametrize("version", ["v1", "v2"])
def test_messages_of_numbers_read_as_pymavlink_does(version: str) -> None:
    rng = random.Random(5)
    ours, theirs = Decoder(), dialect.MAVLink(None)
    for number, kind in sorted(dialect.mavlink_map.items()):
        if "char" in kind.fieldtypes or kind.unpacker.size > 255:
            continue
        if version == "v1" and number > 255:
            continue
        for cut in (0, 1, 7):
            payload = bytes(rng.randrange(256) for _ in range(kind.unpacker.size))
            payload = payload[: len(payload) - cut]
            if version == "v1":
                head = bytes((0xFE, len(payload), 3, 1, 154, number))
            else:
                head = bytes((0xFD, len(payload), 0, 0, 3, 1, 154)) + number.to_bytes(3, "little")
            crc = x25crc(head[1:] + payload + bytes((kind.crc_extra,))).crc
            (packet,) = Framer().feed(head + payload + crc.to_bytes(2, "little"))
            mine, other = ours.message(packet), theirs.decode(bytearray(packet.data))
            assert mine is not None and other is not None
            assert mine.get_type() == other.get_type()
            assert mine.get_srcSystem() == 1 and mine.get_srcComponent() == 154
            for field in kind.ordered_fieldnames:
                a, b = np.array(getattr(mine, field)), np.array(getattr(other, field))
                np.testing.assert_array_equal(a, b)
            with pytest.raises(AttributeError, match="not_there"):
                _ = mine.not_there


def test_samples_make_sense_or_there_are_none() -> None:
    def sample(message: Any) -> Any:
        framer, decoder = Framer(), Decoder()
        (packet,) = framer.feed(packed(message))
        return decode(decoder.message(packet))

    d = dialect
    assert sample(attitude(1, float("nan"))) is None
    assert sample(d.MAVLink_attitude_quaternion_message(1, 0, 0, 0, 0, 0, 0, 0)) is None
    for kind, angles in (
        (d.MAVLink_attitude_message, (0.1, 0.2, 0.3)),
        (d.MAVLink_attitude_quaternion_message, (1.0, 0.0, 0.0, 0.0)),
    ):
        turning = sample(kind(1, *angles, 0.25, -0.5, 2.0))
        assert turning.rates_rad_s == (0.25, -0.5, 2.0)
        for rates in ((0.0, 0.0, 0.0), (0.1, float("nan"), 0.0), (0.1, 0.0, -36.0)):
            unknown = sample(kind(1, *angles, *rates))
            assert unknown.rates_rad_s is None and unknown.q_ned_body == turning.q_ned_body
    nowhere = d.MAVLink_global_position_int_message(1, 0, 0, 5, 5, 0, 0, 0, 0)
    assert sample(nowhere) is None
    off = d.MAVLink_global_position_int_message(1, 2**31 - 1, 0, 5, 5, 0, 0, 0, 0)
    assert sample(off) is None
    place = sample(
        d.MAVLink_global_position_int_message(
            9, 473000000, 85000000, 512250, 62250, 100, -200, 50, 0
        )
    )
    assert isinstance(place, PositionSample)
    assert place.alt_amsl_m == pytest.approx(512.25)
    assert place.v_ned_m_s == pytest.approx((1.0, -2.0, 0.5))

    def distance(cm: int, orientation: int = 25, quality: int = 0) -> Any:
        return d.MAVLink_distance_sensor_message(
            1, 20, 4000, cm, 0, 0, orientation, 0, 0, 0, [0, 0, 0, 0], quality
        )

    assert isinstance(sample(distance(1234)), RangeSample)
    assert sample(distance(10)) is None and sample(distance(4000)) is None
    assert sample(distance(1234, orientation=0)) is None
    assert sample(distance(1234, quality=1)) is None
    terrain = d.MAVLink_terrain_report_message(473000000, 85000000, 100, 450.0, 62.0, 0, 50)
    assert isinstance(sample(terrain), TerrainSample)
    unloaded = d.MAVLink_terrain_report_message(473000000, 85000000, 0, 0.0, 0.0, 0, 0)
    assert sample(unloaded) is None
    clear = d.MAVLink_altitude_message(5_000_000, 1, 2, 3, 4, 5, 30.0)
    got = sample(clear)
    assert isinstance(got, TerrainSample) and got.boot_ms == 5000.0
    unknown = d.MAVLink_altitude_message(5_000_000, 1, 2, 3, 4, 5, float("nan"))
    assert sample(unknown) is None
    assert set(READERS) >= {"GIMBAL_DEVICE_ATTITUDE_STATUS", "MOUNT_ORIENTATION", "MOUNT_STATUS"}
