"""Telemetry in videos: GoPro's GPMF and MISB's KLV, of real cameras, written here, and damaged."""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator, Sequence
from datetime import datetime, timedelta, timezone
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from paths import DATA, SHARED
from pyproj import Geod
from scipy.spatial.transform import Rotation

from mavlink.telemetry.history import HistoryConfig
from mavlink.telemetry.logs import TelemetryLog, gpmf, klv
from mavlink.telemetry.samples import VehicleState
from service.cameras import open_camera, video
from service.commands.missing_metadata import telemetry_inside

SECOND_NS = 1_000_000_000
REAL = DATA / "video_metadata"
HERE = Path("flight.mp4")


def at(log: TelemetryLog, time_s: float) -> VehicleState:
    state = log.history.state_at(round(time_s * 1e9))
    assert state is not None
    return state


def item(key: bytes, kind: str, size: int, content: bytes) -> bytes:
    """One item of GPMF; of structures of ``size`` bytes."""
    head = key + (b"\0" if kind == "nest" else kind.encode()) + bytes([size])
    count = len(content) // size
    return head + struct.pack(">H", count) + content + bytes(-len(content) % 4)


def nest(key: bytes, *inside: bytes) -> bytes:
    return item(key, "nest", 1, b"".join(inside))


def gopro(stream: bytes) -> bytes:
    return nest(b"DEVC", item(b"DVID", "L", 4, bytes(4)), nest(b"STRM", stream))


def gps5(lat: float, fix: int, dop: float) -> bytes:
    """A second of a HERO5: 18 positions, a thousandth of a degree apart in all."""
    scale = (10**7, 10**7, 1000, 1000, 100)
    rows = [(lat + 1e-3 * k / 18, 8.5, 412.5, 5.0, 5.0) for k in range(18)]
    whole = [round(v * s) for row in rows for v, s in zip(row, scale, strict=True)]
    return gopro(
        item(b"GPSF", "L", 4, struct.pack(">L", fix))
        + item(b"GPSP", "S", 2, struct.pack(">H", round(100 * dop)))
        + item(b"SCAL", "l", 4, struct.pack(">5l", *scale))
        + item(b"GPS5", "l", 20, struct.pack(f">{len(whole)}l", *whole))
    )


def gps9(lat: float, fix: int, dop: float) -> bytes:
    """A tenth of a second of a HERO11."""
    scale = (10**7, 10**7, 1000, 1000, 100, 1, 1000, 100, 1)
    row = struct.pack(
        ">7lHH", round(lat * 1e7), 85_000_000, 412_500, 5000, 500, 9000, 1, round(100 * dop), fix
    )
    return gopro(
        item(b"TYPE", "c", 1, b"lllllllSS")
        + item(b"SCAL", "l", 4, struct.pack(">9l", *scale))
        + item(b"GPS9", "?", 32, row)
    )


def test_positions_of_a_gopro_spread_over_the_second_of_their_packet() -> None:
    torn = b"GPS"  # what remains of an item is left out
    packets = [(k * SECOND_NS, SECOND_NS, gps5(47.0 + 1e-3 * k, 3, 2.0) + torn) for k in range(3)]
    log = gpmf.of_packets(HERE, packets, HistoryConfig())
    assert log.clock == "video" and log.counts["GPS5"] == 54
    for time_s in (0.0, 0.25, 1.5, 2.9):
        state = at(log, time_s)
        assert state.lat_deg == pytest.approx(47.0 + 1e-3 * time_s, abs=2e-7)
        assert state.lon_deg == pytest.approx(8.5) and state.alt_amsl_m == pytest.approx(412.5)
        assert state.sigma_h_m == pytest.approx(3.0, rel=0.02) and not state.is_claimed


def test_newer_gopros_state_fix_and_accuracy_with_each_position() -> None:
    packets = [(k * SECOND_NS // 10, SECOND_NS // 10, gps9(47.0, 3, 1.0)) for k in range(20)]
    packets += [((20 + k) * SECOND_NS // 10, 0, gps9(47.0, 0, 99.99)) for k in range(50)]
    log = gpmf.of_packets(HERE, packets, HistoryConfig())
    assert at(log, 1.0).lat_deg == pytest.approx(47.0)
    assert at(log, 1.0).sigma_h_m == pytest.approx(1.5, rel=0.01)
    with_none = [gps5(47.0, 0, 99.99)] * 3
    with pytest.raises(ValueError, match="no position"):
        gpmf.of_packets(
            HERE, [(k * SECOND_NS, SECOND_NS, p) for k, p in enumerate(with_none)], HistoryConfig()
        )


def test_a_gopro_without_gpsu_is_dated_by_its_positions() -> None:
    """As a HERO13 writes them (juanmcasillas/gopro2gpx): days from 2000 and seconds in GPS9."""
    packets = [(SECOND_NS, SECOND_NS, gps9(47.0, 3, 1.0)), (0, SECOND_NS, gps9(0.0, 0, 99.99))]
    began = gpmf.of_packets(HERE, packets, HistoryConfig()).start_unix_ns
    assert began is not None
    stated = datetime(2000, 1, 1, tzinfo=timezone.utc) + timedelta(days=9000, seconds=0.001 - 1.0)
    assert began / 1e9 == pytest.approx(stated.timestamp(), abs=1e-6)


def msl(packet: bytes) -> bytes:
    """A packet of :func:`gps5` or :func:`gps9` that says above what its altitudes are."""
    at = packet.index(b"STRM")
    return gopro(item(b"GPSA", "F", 4, b"MSLV") + packet[at + 8 :])


@pytest.mark.parametrize("packet", [gps5(47.0, 3, 1.4), gps9(47.0, 3, 1.4)])
def test_altitudes_of_a_gopro_are_above_the_ellipsoid_unless_it_says_sea_level(
    packet: bytes,
) -> None:
    for data, datum in ((packet, "ellipsoid"), (msl(packet), "")):
        log = gpmf.of_packets(HERE, [(0, SECOND_NS, data)], HistoryConfig())
        assert log.history.vertical_datum == datum


def test_real_gopros_name_their_datum() -> None:
    """A MAX at the beach of Carlsbad is 23 m under the sea, and above the ellipsoid 12 m."""
    datums = {}
    for name in ("max_0", "hero11_0", "karma_0"):
        data = (REAL / f"{name}.gpmf").read_bytes()
        log = gpmf.of_packets(HERE, [(0, SECOND_NS, data)], HistoryConfig())
        datums[name] = log.history.vertical_datum
    assert datums == {"max_0": "ellipsoid", "hero11_0": "", "karma_0": ""}


def test_a_real_karma_gives_its_autopilots_position() -> None:
    packets = [
        (k * 1001 * 10**6, 1001 * 10**6, (REAL / f"karma_{k}.gpmf").read_bytes()) for k in (0, 1)
    ]
    log = gpmf.of_packets(HERE, packets, HistoryConfig())
    assert log.counts["GLPI"] == 8
    state = at(log, 1.0)
    assert state.lat_deg == pytest.approx(33.12538, abs=2e-5)
    assert state.lon_deg == pytest.approx(-117.33108, abs=2e-5)
    assert state.alt_amsl_m == pytest.approx(15.6, abs=0.2)
    assert state.sigma_h_m == pytest.approx(0.25, abs=0.02) and state.v_ned_m_s is not None


def test_a_real_hero11_states_time_fix_and_accuracy_with_each_position() -> None:
    packets = [
        (k * 1001 * 10**6, 1001 * 10**6, (REAL / f"hero11_{k}.gpmf").read_bytes()) for k in (0, 1)
    ]
    log = gpmf.of_packets(HERE, packets, HistoryConfig())
    assert log.counts["GPS9"] == 21 and log.counts["CORI"] == 52
    assert log.last_ns - log.first_ns == pytest.approx(2.0e9, abs=2e6)  # by their own clock
    state = at(log, 1.0)
    assert (state.lat_deg, state.lon_deg) == pytest.approx((42.42615, -8.64998), abs=2e-5)
    assert state.alt_amsl_m == pytest.approx(34.1, abs=0.3)
    assert state.sigma_h_m is not None and 2.0 < state.sigma_h_m < 4.5
    assert log.start_unix_ns is not None
    began = datetime.fromtimestamp(log.start_unix_ns / 1e9, timezone.utc)
    assert abs(began - datetime(2022, 9, 20, 13, 29, 38, tzinfo=timezone.utc)).total_seconds() < 2


def test_positions_that_state_their_own_time_lie_at_it() -> None:
    """The packet of the second one comes late."""
    packets = []
    for k, second in enumerate((0.0, 1.3, 2.0)):
        row = struct.pack(">8f", 10.0 + k, 47.0 + 0.1 * k, 8.5, 400.0, 10.0, 0.0, 0.0, 0.0)
        stream = item(b"TYPE", "c", 1, b"ffffffff") + item(b"SCAL", "l", 4, struct.pack(">l", 1))
        packets.append((round(second * SECOND_NS), 0, gopro(stream + item(b"GLPI", "?", 32, row))))
    log = gpmf.of_packets(HERE, packets, HistoryConfig())
    assert at(log, 1.0).lat_deg == pytest.approx(47.1, abs=1e-4)


def turned(image_to_start: Rotation, stabilised: Rotation, down: np.ndarray) -> bytes:
    """A packet of one frame: the camera's turn since the start, the image's in it, gravity."""
    camera = (image_to_start * stabilised).inv()

    def stream(key: bytes, values: np.ndarray) -> bytes:
        numbers = np.rint(values * 32767).astype(int)
        content = struct.pack(f">{len(numbers)}h", *numbers)
        inside = item(b"SCAL", "s", 2, struct.pack(">h", 32767))
        return nest(b"STRM", inside + item(key, "s", len(content), content))

    cori = stream(b"CORI", camera.as_quat(scalar_first=True))
    iori = stream(b"IORI", stabilised.as_quat(scalar_first=True))
    return nest(b"DEVC", cori, iori, stream(b"GRAV", camera.apply(down)))


@pytest.mark.parametrize("start_deg", [0.0, -90.0], ids=["ahead", "down"])
def test_the_images_attitude_is_that_of_camera_and_stabilisation(start_deg: float) -> None:
    """Down is known, also where the recording starts looking down; the heading up to a constant."""
    rng = np.random.default_rng(3)
    axes = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # of the camera to ahead, right, down
    first = Rotation.from_euler("ZYX", [40.0, start_deg, 3.0], degrees=True)
    truth, packets = [], []
    for k in range(20):
        head = Rotation.from_euler("ZYX", [40.0 + 2 * k, -30.0, rng.normal(0, 4)], degrees=True)
        truth.append(head)
        relative = Rotation.from_matrix(axes.T @ (first.inv() * head).as_matrix() @ axes)
        down = axes.T @ first.inv().apply([0.0, 0.0, 1.0])
        stabilised = Rotation.from_rotvec(rng.normal(0, 0.05, 3))
        data = turned(relative, stabilised, down)
        packets.append((k * SECOND_NS // 10, SECOND_NS // 10, data + gps5(47.0, 3, 1.0)))
    log = gpmf.of_packets(HERE, packets, HistoryConfig())
    found = []
    for k in range(20):
        state = at(log, k / 10)
        assert state.q_ned_gimbal_wxyz is not None and state.sigma_yaw_rad == math.pi
        found.append(Rotation.from_quat(state.q_ned_gimbal_wxyz, scalar_first=True))
    down_in_head = [r.inv().apply([0.0, 0.0, 1.0]) for r in truth]
    np.testing.assert_allclose(
        [r.inv().apply([0.0, 0.0, 1.0]) for r in found], down_in_head, atol=1e-3
    )
    headings = [(t * f.inv()).as_euler("ZYX") for t, f in zip(truth, found, strict=True)]
    assert np.ptp(np.unwrap([h[0] for h in headings])) < 2e-3


def test_a_real_stabilised_image_is_level_where_its_camera_rolls() -> None:
    """The camera of a GoPro MAX; in the first image the horizon lies 66 px of 480 above the middle
    at a focal length of about 450 px: it looks down by 8 degrees."""
    data = (REAL / "max_0.gpmf").read_bytes()
    log = gpmf.of_packets(HERE, [(0, 1_001_000_000, data)], HistoryConfig())
    assert log.counts["CORI"] == log.counts["GRAV"] == 30
    for time_s in (0.0, 0.5, 0.9):
        q = at(log, time_s).q_ned_gimbal_wxyz
        assert q is not None
        _, pitch, roll = Rotation.from_quat(q, scalar_first=True).as_euler("ZYX", degrees=True)
        assert abs(pitch + 8.0) < 1.5 and abs(roll) < 1.0


def test_videos_give_the_telemetry_that_they_hold() -> None:
    """The whole clips, where they are here: GPMF within 0.1 s of the fixes read by others."""
    karma = SHARED / "gopro_karma_clip" / "karma.mp4"
    aphill = SHARED / "aphill_orbit_fmv" / "aphill_klv_10s.ts"
    if not (karma.is_file() and aphill.is_file()):
        pytest.skip("needs ../shared/data")
    log, where = telemetry_inside(karma, HistoryConfig()) or (None, "")
    assert log is not None and "GPMF" in where
    fixes = np.loadtxt(karma.with_name("gps.csv"), delimiter=",", skiprows=1, usecols=(1, 2, 3, 4))
    off_m = []
    for time_s, lat, lon, alt in fixes[10:40]:
        state = at(log, 0.2 + time_s)
        assert state.lat_deg is not None and state.lon_deg is not None and state.alt_amsl_m
        off_m.append(
            (
                111_320 * (state.lat_deg - lat),
                93_200 * (state.lon_deg - lon),
                state.alt_amsl_m - alt,
            )
        )
    assert np.abs(np.median(off_m, axis=0)).max() < 1.0
    log, where = telemetry_inside(aphill, HistoryConfig()) or (None, "")
    assert log is not None and "KLV" in where and log.counts["PositionSample"] == 300


# MISB


def looks_at(state: VehicleState) -> np.ndarray:
    """North, east, down of the optical axis."""
    assert state.q_ned_gimbal_wxyz is not None
    w, x, y, z = state.q_ned_gimbal_wxyz
    axis: np.ndarray = Rotation.from_quat([x, y, z, w]).as_matrix()[:, 0]
    return axis


def test_a_real_universal_set_looks_at_its_frame_centre() -> None:
    data = (REAL / "aphill.klv").read_bytes()
    log = klv.of_packets(HERE, [(0, 0, data)], HistoryConfig())
    state = at(log, 0.0)
    assert (state.lat_deg, state.lon_deg) == pytest.approx((38.15993, -77.356214))
    assert state.alt_amsl_m == pytest.approx(1984.6) and state.alt_agl_m == pytest.approx(
        1984.6, abs=1
    )
    north, east = 111_320 * (38.18508914 - 38.15993), 87_500 * (-77.3581198 + 77.356214)
    there = np.array([north, east, 1984.6])
    assert log.hfov_deg == pytest.approx(0.8)
    assert math.degrees(math.acos(looks_at(state) @ there / np.linalg.norm(there))) < 2.0


def cheyenne() -> list[bytes]:
    """Sets of a real turret, two seconds apart."""
    data = (REAL / "cheyenne.klv").read_bytes()
    return [klv.LOCAL_SET + part for part in data.split(klv.LOCAL_SET)[1:]]


HEAD = 18  # bytes of its key and length


def items(content: bytes) -> Iterator[tuple[int, bytes]]:
    while content:
        end = 2 + content[1]
        yield content[0], content[2:end]
        content = content[end:]


def test_a_real_local_set_looks_at_its_frame_centre() -> None:
    log = klv.of_packets(
        HERE, [(2 * k * SECOND_NS, 0, data) for k, data in enumerate(cheyenne())], HistoryConfig()
    )
    assert log.start_unix_ns is not None
    for data in cheyenne():
        at_ = dict(items(data[HEAD:]))
        lat, lon = (
            span * int.from_bytes(at_[tag], "big", signed=True) / (2**31 - 1)
            for tag, span in ((23, 90.0), (24, 180.0))
        )
        ground_m = 19_900 * int.from_bytes(at_[25], "big") / 65_535 - 900
        stamp_ns = 1000 * int.from_bytes(at_[2], "big")
        state = at(log, 1e-9 * (stamp_ns - log.start_unix_ns))
        assert state.lat_deg is not None and state.lon_deg is not None and state.alt_amsl_m
        east = Geod(ellps="WGS84").inv(state.lon_deg, state.lat_deg, lon, lat)
        north, across = (east[2] * f(math.radians(east[0])) for f in (math.cos, math.sin))
        there = np.array([north, across, state.alt_amsl_m - ground_m])
        assert math.degrees(math.acos(looks_at(state) @ there / np.linalg.norm(there))) < 1.0


def test_sets_that_arrive_late_lie_at_their_own_times_and_date_the_video() -> None:
    late_ns = [0, 300, 0, 200, 0]
    packets = [
        (2 * k * SECOND_NS + late * 10**6, 0, data)
        for k, (data, late) in enumerate(zip(cheyenne(), late_ns, strict=True))
    ]
    stamps_ns = [1000 * int.from_bytes(data[HEAD + 2 : HEAD + 10], "big") for data in cheyenne()]
    log = klv.of_packets(HERE, packets, HistoryConfig())
    assert log.start_unix_ns is not None
    assert log.start_unix_ns == pytest.approx(1_348_087_244_105_300_000, abs=0.3e9)
    found = [log.first_ns + stamp - stamps_ns[0] for stamp in stamps_ns]
    assert log.last_ns == found[-1] == stamps_ns[-1] - log.start_unix_ns


@pytest.mark.parametrize("spoilt", ["own time", "packet's time"])
def test_one_damaged_time_costs_its_set_alone(spoilt: str) -> None:
    """Not the date of the video, and the own times of all others."""
    packets, first = [], cheyenne()[0]
    began_us = int.from_bytes(first[HEAD + 2 : HEAD + 10], "big")
    for k in range(40):
        is_bad = k == 20
        own_us = began_us + 1_000_000 * k + (1 << 52) * (is_bad and spoilt == "own time")
        data = first[: HEAD + 2] + own_us.to_bytes(8, "big") + first[HEAD + 10 : -2]
        summed = sum(data[0::2]) * 256 + sum(data[1::2])
        data += (summed & 0xFFFF).to_bytes(2, "big")
        late_ns = 900 * SECOND_NS * (is_bad and spoilt == "packet's time")
        packets.append((k * SECOND_NS + late_ns, 0, data))
    log = klv.of_packets(HERE, packets, HistoryConfig())
    assert log.start_unix_ns == pytest.approx(1000 * began_us, abs=1000)
    assert (log.first_ns, log.last_ns) == (0, 39 * SECOND_NS)


def stream(path: Path, sets: Sequence[bytes], before: bytes = b"") -> None:
    """MPEG-TS of ten black images and a set after each second one; the sets' packets have no time,
    as in a private stream (MISB ST 1402, asynchronous). Of ``before`` is a stream of its own."""
    with av.open(str(path), "w", format="mpegts") as out:
        video = out.add_stream("mpeg2video", rate=5, options={"bf": "0"})
        video.width, video.height, video.pix_fmt = 64, 48, "yuv420p"
        streams = [out.add_data_stream("klv") for _ in range(2 if before else 1)]
        for k in range(10):
            image = av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8), format="bgr24")
            out.mux(video.encode(image))
            for metadata in streams if k % 2 else ():
                packet = av.Packet(sets[k // 2] if metadata is streams[-1] else before)
                packet.stream, packet.time_base = metadata, Fraction(1, 90_000)
                packet.pts = packet.dts = 18_000 * k
                out.mux(packet)
        out.mux(video.encode(None))
    data = bytearray(path.read_bytes())
    for found in re.finditer(rb"\x00\x00\x01[\xbd\xfc]", bytes(data)):  # of a packet's head
        flags = found.start() + 7
        data[flags] &= 0x3F  # neither PTS nor DTS
        data[flags + 2 : flags + 2 + data[flags + 1]] = b"\xff" * data[flags + 1]
    path.write_bytes(data)


def test_metadata_without_times_is_of_the_images_before_it(tmp_path: Path) -> None:
    path = tmp_path / "async.ts"
    stream(path, cheyenne())
    with av.open(str(path)) as container:
        sets = [packet.pts for packet in container.demux(data=0) if packet.size]
    assert sets == [None] * 5  # the file is what the test is about
    log, where = telemetry_inside(path, HistoryConfig()) or (None, "")
    assert log is not None and "KLV" in where and log.counts["PositionSample"] == 5
    assert -SECOND_NS < log.first_ns < SECOND_NS
    state = at(log, 1e-9 * log.first_ns)
    assert (state.lat_deg, state.lon_deg) == pytest.approx((41.1438, -104.8056), abs=1e-4)


STAMP_ALONE = klv.LOCAL_SET + bytes([10, 2, 8]) + (1_348_087_244_000_000).to_bytes(8, "big")
TARGETS = bytes.fromhex("060e2b34020b01010e010301030600000000"[:32]) + b"\x02\x04\x00"


@pytest.mark.parametrize("before", [STAMP_ALONE, TARGETS])
def test_the_stream_with_a_place_is_read_of_several(tmp_path: Path, before: bytes) -> None:
    path = tmp_path / "several.ts"
    stream(path, cheyenne(), before)
    log, _ = telemetry_inside(path, HistoryConfig()) or (None, "")
    assert log is not None and log.counts["PositionSample"] == 5


def test_a_video_of_stamps_alone_is_refused_in_words(tmp_path: Path) -> None:
    path = tmp_path / "stamps.ts"
    stream(path, [STAMP_ALONE] * 5)
    with pytest.raises(ValueError, match="no attitude and no position"):
        telemetry_inside(path, HistoryConfig())


def test_a_stream_that_begins_late_ends_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where MPEG-TS grows a stream, PyAV may fail at the end of the file, after its packets."""
    path = tmp_path / "late.ts"
    stream(path, cheyenne())

    class Late:
        def __init__(self, opened: Any) -> None:
            self.opened = opened

        def __getattr__(self, name: str) -> Any:
            return getattr(self.opened, name)

        def __enter__(self) -> Late:
            return self

        def __exit__(self, *_: object) -> None:
            self.opened.close()

        def demux(self, streams: Any) -> Iterator[Any]:
            yield from (packet for packet in self.opened.demux(streams) if packet.size)
            raise IndexError("list index out of range")

    monkeypatch.setattr(video, "open_container", lambda *args, **more: Late(av.open(*args)))
    log, _ = telemetry_inside(path, HistoryConfig()) or (None, "")
    assert log is not None and log.counts["PositionSample"] == 5
    source = open_camera(str(path))
    assert sum(1 for _ in source) == 10 and source.warnings == []


@pytest.mark.parametrize("before", [bytes([0, 7, 0x8F, 0x01, 0x21]), STAMP_ALONE, TARGETS])
def test_a_set_is_read_behind_a_header_or_another_set(before: bytes) -> None:
    assert klv.fields_of(before + cheyenne()[0]) == klv.fields_of(cheyenne()[0])
    assert klv.fields_of(before) == {}


def local_set(values: dict[int, tuple[int, bool, float]]) -> bytes:
    """ST 0601 of tag to (bits, signed, share of the range)."""
    body = b""
    for tag, (bits, signed, share) in values.items():
        most = 2 ** (bits - 1) - 1 if signed else 2**bits - 1
        body += bytes([tag, bits // 8]) + round(share * most).to_bytes(
            bits // 8, "big", signed=signed
        )
    return klv.LOCAL_SET + bytes([0x82]) + struct.pack(">H", len(body)) + body


LEVEL = {
    13: (32, True, 47.3 / 90), 14: (32, True, -8.5 / 180), 15: (16, False, (512.5 + 900) / 19_900),
    5: (16, False, 90 / 360), 6: (16, True, 0.0), 7: (16, True, 0.0), 21: (32, False, 2000 / 5e6),
    18: (32, False, 90 / 360), 19: (32, True, -30 / 180), 20: (32, False, 0.0),
}  # fmt: skip


def test_a_local_set_gives_place_and_direction() -> None:
    """Heading east, the sensor to the right and 30 degrees down: it looks south."""
    log = klv.of_packets(HERE, [(0, 0, local_set(LEVEL))], HistoryConfig())
    state = at(log, 0.0)
    assert (state.lat_deg, state.lon_deg) == pytest.approx((47.3, -8.5), abs=1e-7)
    assert state.alt_amsl_m == pytest.approx(512.5, abs=0.2)
    assert state.alt_agl_m == pytest.approx(1000.0, abs=1.0)
    np.testing.assert_allclose(looks_at(state), [-math.cos(math.radians(30)), 0.0, 0.5], atol=1e-3)


def test_an_altitude_above_the_ellipsoid_counts_where_no_other_is_there() -> None:
    above = {tag: value for tag, value in LEVEL.items() if tag != 15}
    for values, alt_m, datum in (
        (above | {75: (16, False, (560.0 + 900) / 19_900)}, 560.0, "ellipsoid"),
        (LEVEL | {75: (16, False, (560.0 + 900) / 19_900)}, 512.5, ""),
    ):
        log = klv.of_packets(HERE, [(0, 0, local_set(values))], HistoryConfig())
        assert log.history.vertical_datum == datum
        assert at(log, 0.0).alt_amsl_m == pytest.approx(alt_m, abs=0.2)


def test_a_recordings_altitudes_are_above_one_datum() -> None:
    """Three of four sets state both heights or that above the ellipsoid, 47.5 m more."""
    hae, amsl = {75: (16, False, (560.0 + 900) / 19_900)}, {15: LEVEL[15]}
    place = {tag: value for tag, value in LEVEL.items() if tag != 15}
    sets = [place | hae, place | amsl, place | hae | amsl, place | hae]
    packets = [(n * 10**8, 0, local_set(values)) for n, values in enumerate(sets)]
    log = klv.of_packets(HERE, packets, HistoryConfig())
    assert log.history.vertical_datum == "ellipsoid"
    altitudes = [at(log, 0.1 * n).alt_amsl_m for n in range(4)]
    assert altitudes == pytest.approx([560.0] * 4, abs=0.2)
    assert "1 positions are above another datum than the others': not used" in log.warnings


def test_a_set_with_another_checksum_is_not_read() -> None:
    data = bytearray(local_set(LEVEL)) + b"\x01\x02\0\0"
    data[17:19] = struct.pack(">H", len(data) - 19)
    total = sum(byte << 8 * ((k + 1) % 2) for k, byte in enumerate(data[:-2]))
    data[-2:] = struct.pack(">H", total & 0xFFFF)
    assert klv.fields_of(bytes(data))["lat"] == pytest.approx(47.3)
    data[40] ^= 1
    assert klv.fields_of(bytes(data)) == {}


def test_a_value_that_says_unknown_is_left_out() -> None:
    data = local_set(LEVEL).replace(local_set({13: LEVEL[13]})[19:], b"\x0d\x04\x80\0\0\0")
    found = klv.fields_of(data)
    assert "lat" not in found and found["lon"] == pytest.approx(-8.5)


KARMA, MAX, HERO11, APHILL = (
    (REAL / name).read_bytes()
    for name in ("karma_0.gpmf", "max_0.gpmf", "hero11_0.gpmf", "aphill.klv")
)


@pytest.mark.parametrize("key", sorted(gpmf.COLUMNS))
def test_an_item_that_declares_too_few_columns_is_not_read(key: bytes) -> None:
    short = item(b"TYPE", "c", 1, b"l") + item(key, "?", 4, struct.pack(">l", 1))
    packets = [(k * SECOND_NS, SECOND_NS, gopro(short) + gps5(47.0, 3, 1.4)) for k in range(2)]
    log = gpmf.of_packets(HERE, packets, HistoryConfig())
    assert log.counts["GPS5"] == 36 and at(log, 0.5).lat_deg == pytest.approx(47.0005)


@settings(max_examples=150)
@given(
    st.binary(max_size=300),
    st.integers(0, 8000),
    st.sampled_from([KARMA, MAX, HERO11, APHILL, cheyenne()[0], local_set(LEVEL), gps9(1, 3, 1)]),
)
@example(b"DEVC\0\xff\xff\xff" * 30, 0, b"")
@example(klv.LOCAL_SET + b"\xff" * 200, 0, b"")
def test_any_bytes_are_read_or_refused(bytes_: bytes, place: int, whole: bytes) -> None:
    """Alone, and in the place of some of a real packet."""
    for data in (bytes_, whole[:place] + bytes_ + whole[place + len(bytes_) :], whole[:place]):
        for reader in (gpmf, klv):
            try:
                log = reader.of_packets(HERE, [(0, SECOND_NS, data)] * 2, HistoryConfig())
            except ValueError as refused:
                assert "\n" not in str(refused)
                continue
            state = log.history.state_at(log.first_ns)
            assert state is None or state.sigma_h_m is None or 0.0 < state.sigma_h_m < 1e6
