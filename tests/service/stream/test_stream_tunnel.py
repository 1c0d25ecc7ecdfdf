"""The narrow radio: messages decodable alone, pace, and a map in flight at 57,600 baud."""

from __future__ import annotations

import dataclasses
import os
import select
import socket
import time
import tty
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from loopback import until
from rehearsal import RehearsalControl

from mavlink.component.presence import Health
from mavlink.component.vehicle import VehicleConfig, VehicleLink
from mavlink.wire.dialect import dialect
from mavlink.wire.framing import Framer
from recon import se3
from recon.types import DepthMap, Keyframe, Pose
from service.config import Config, DatalinkConfig
from service.daemon.datalink import OWN_LINKS, DaemonLink
from service.ground.receiver import Receiver, ReceiverConfig
from service.radio import DRONE, GROUND, TUNNEL, RadioLink
from service.stream import codec
from service.stream.link import DatalinkSender
from service.stream.radio_messages import (
    MAX_BYTES,
    RadioTile,
    pack_announce,
    pack_pose,
    pack_tile,
    tag_of,
    unpack_announce,
    unpack_pose,
    unpack_tile,
)
from service.stream.radio_tiles import keyframe_of, tiles_of
from service.stream.records import PoseRecord, Repose, ScanHeader
from service.stream.records import unpack_pose as unpack_record
from service.stream.session import SessionConfig
from service.stream.store import ScanStore
from service.stream.tunnel import RadioSender, TunnelIntake, TunnelSender

HEADER = ScanHeader("20260101T120000Z", "drone-a", 1_767_268_800_000_000_000, 47.5, 8.25, 431.5)
RATE_BYTES_S = 0.3 * 5760  # 57,600 baud
F = 260.0
R_DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])


def keyframe(seq: int, x_m: float, fresh_from_px: int = 0) -> Keyframe:
    """A nadir view from 60 m above ``ground_m``."""
    w, h = 320, 180
    T = se3.compose(R_DOWN, np.array([x_m, 20.0, 60.0]))
    K = np.array([[F, 0, 159.5], [0, F, 89.5], [0, 0, 1]])
    v, u = np.mgrid[:h, :w]
    z = np.full((h, w), 60.0)
    for _ in range(12):
        x = x_m + (u - 159.5) / F * z
        y = 20.0 - (v - 89.5) / F * z
        z = 60.0 - ground_m(x, y)
    gray = (128 + 60 * np.sin(x / 3)).astype(np.uint8)
    depth = DepthMap(
        z.astype(np.float32), np.full((h, w), 0.2, np.float32), np.full((h, w), 3, np.uint8), K, T
    )
    fresh = np.broadcast_to(u >= fresh_from_px, (h, w)).copy()
    bgr = np.stack([gray, gray, gray // 2], axis=-1)
    return Keyframe(seq, 5, depth, bgr, Pose(T, np.eye(6) * 1e-4), fresh)


def ground_m(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.asarray(4 * np.sin(x / 15) + 3 * np.cos(y / 12))


def world_points(frame: Keyframe) -> np.ndarray:
    depth = frame.depth
    v, u = np.nonzero(np.isfinite(depth.depth_m))
    z = depth.depth_m[v, u].astype(np.float64)
    K = depth.K
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(len(u))], axis=1)
    return se3.transform(depth.T_world_camera, rays * z[:, None])


def coarse(frame: Keyframe) -> Keyframe:
    decoded = codec.decode(codec.encode(frame, 2_000_000_000)[:1])
    assert decoded is not None
    return decoded


def test_a_tile_fits_and_decodes_alone() -> None:
    tiles = tiles_of(coarse(keyframe(9, 3.0)))
    packed = [pack_tile(77, tile) for tile in tiles]
    assert len(packed) == 15 and max(map(len, packed)) <= MAX_BYTES
    for data, tile in zip(packed, tiles, strict=True):
        back = unpack_tile(data)
        assert back is not None and back[0] == 77
        got = back[1]
        assert (got.seq, got.index, got.grid_px) == (9, tile.index, (40, 23))
        error = got.depth_m - tile.depth_m
        assert float(np.nanmax(np.abs(error))) < 0.15
        np.testing.assert_array_equal(np.isfinite(got.depth_m), np.isfinite(tile.depth_m))
        assert float(np.abs(got.bgr.astype(float) - tile.bgr).mean()) < 12
        np.testing.assert_allclose(got.T_world_camera, tile.T_world_camera, atol=0.01)
        assert 0.8 < got.sigma_m / tile.sigma_m < 1.25


def test_tiles_make_the_surface_again() -> None:
    frame = keyframe(0, 3.0, fresh_from_px=200)
    tiles = [unpack_tile(pack_tile(1, tile)) for tile in tiles_of(coarse(frame))]
    again = keyframe_of([tile[1] for tile in tiles if tile is not None])
    assert again is not None
    points = world_points(again)
    assert points[:, 0].min() > 3.0 + (190 - 160) / F * 70
    error = points[:, 2] - ground_m(points[:, 0], points[:, 1])
    assert float(np.sqrt(np.mean(error**2))) < 0.4


def test_announcement_and_pose_round_trip() -> None:
    back = unpack_announce(pack_announce(HEADER))
    assert back is not None
    assert (back.scan_id, back.drone, back.started_unix_ns) == (
        HEADER.scan_id, HEADER.drone, HEADER.started_unix_ns,
    )  # fmt: skip
    assert (back.origin_lat_deg, back.origin_alt_amsl_m) == (47.5, 431.5)
    T = se3.exp(np.array([0.1, 0.2, -3.0, 4.0, 5.0, -6.0]))
    pose = PoseRecord(17, T, np.eye(6), lat_deg=47.1234567, lon_deg=-8.5, sigma_m=0.31)
    found = unpack_pose(pack_pose(5, 3, pose))
    assert found is not None and found[:2] == (5, 3)
    np.testing.assert_allclose(found[2].T_world_camera, T, atol=0.006)
    assert found[2].lat_deg == pytest.approx(47.1234567, abs=1e-7)
    assert found[2].alt_amsl_m is None
    with pytest.raises(ValueError, match="too long"):
        pack_announce(ScanHeader("s" * 60, "d" * 60, 0))


@pytest.mark.parametrize(("x_m", "is_taken"), [(9.9e5, True), (1.1e6, False), (-2e7, False)])
def test_a_camera_out_of_reach_is_no_message(x_m: float, is_taken: bool) -> None:
    T = se3.compose(R_DOWN, np.array([x_m, 20.0, 60.0]))
    tile = replace(tiles_of(coarse(keyframe(9, 3.0)))[0], T_world_camera=T)
    assert (unpack_tile(pack_tile(77, tile)) is not None) == is_taken
    pose = PoseRecord(17, T, np.eye(6))
    assert (unpack_pose(pack_pose(5, 3, pose)) is not None) == is_taken


def test_tiles_replace_the_first_depth_of_their_keyframe_and_end_earlier_ones(
    tmp_path: Path,
) -> None:
    """The datalink was lost after them; the narrow radio brings keyframes that are done."""

    def first(seq: int) -> None:
        assert store.put_record("first", seq, codec.encode(keyframe(seq, 0.0), 0)[0])

    def tiles(seq: int) -> None:
        for tile in tiles_of(coarse(keyframe(seq, 0.0))):
            store.radio.add("tile", seq, tile.index, pack_tile(77, tile))

    with ScanStore.create(tmp_path / "a.db", HEADER) as store:
        for order in ((first, tiles), (tiles, first)):
            for add in order:
                add(1)
            shown = store.keyframe(1)
            assert shown is not None and shown.depth.depth_m.shape == (23, 40)
        first(2)
        tiles(1)
        assert list(store.states()) == [1, 2]
        tiles(3)  # the view 2 was refused
        assert list(store.states()) == store.seqs() == [1, 3] and store.keyframe(2) is None


@settings(max_examples=300)
@given(st.binary(max_size=128), st.sampled_from([0x11, 0x12, 0x13]))
def test_any_bytes_never_raise(data: bytes, kind: int) -> None:
    for payload in (data, bytes([kind]) + data[1:]):
        TunnelIntake().receive(payload)
        found = unpack_tile(payload)
        if found is not None:
            keyframe_of([found[1]])


def fly(sender: TunnelSender, store: ScanStore, seconds: float) -> list[tuple[float, bytes]]:
    """Messages of the radio while 100 m are flown in that time, a keyframe every 8 m."""
    sent: list[tuple[float, bytes]] = []
    next_frame, seq, now = 0.0, 0, 0.0
    while now < seconds:
        if now >= next_frame:
            frame = keyframe(seq, 8.0 * seq, fresh_from_px=0 if seq == 0 else 290)
            store.add_keyframe(seq, codec.encode(frame, round(now * 1e9)))
            store.add_pose(PoseRecord(round(now * 1e9), frame.pose.T_world_camera, np.eye(6)))
            sender.on_item("k0", seq)
            sender.on_item("pose", seq + 1)
            seq, next_frame = seq + 1, next_frame + seconds / 13
        todo = sender.next(now)
        if isinstance(todo, bytes):
            sent.append((now, todo))
        else:
            now += min(todo, 0.05)
    return sent


@pytest.mark.slow
def test_a_map_of_100_m_arrives_in_flight_within_the_share(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    with (
        ScanStore.create(tmp_path / "a.db", HEADER) as onboard,
        ScanStore.create(tmp_path / "g.db", HEADER) as ground,
    ):
        sender = TunnelSender(onboard, RATE_BYTES_S, 0.0)
        sent = fly(sender, onboard, 20.0)
        size = sum(len(payload) + 17 for _, payload in sent)
        assert size <= RATE_BYTES_S * 20 * 1.05
        intake = TunnelIntake()
        for _, payload in sent:
            if rng.random() < 0.1:
                continue
            for _, kind, number, part, data in intake.receive(payload):
                if kind != "header":
                    ground.radio.add(kind, number, part, data)
        points = np.concatenate([world_points(frame) for frame in ground.keyframes()])
        error = points[:, 2] - ground_m(points[:, 0], points[:, 1])
        assert float(np.sqrt(np.mean(error**2))) < 0.5
        cells = {(int(x // 4), int(y // 4)) for x, y in points[:, :2]}
        whole = [world_points(frame) for frame in onboard.keyframes()]
        seen = {(int(x // 4), int(y // 4)) for part in whole for x, y in part[:, :2]}
        assert len(cells & seen) > 0.85 * len(seen)
        assert len(list(ground.poses())) >= 10
        # What comes later over IP takes the place of what the radio brought.
        for seq in onboard.seqs():
            record = onboard.record("k1", seq)
            assert record is not None and ground.put_record("k1", seq, record)
        for a, b in zip(onboard.keyframes(), ground.keyframes(), strict=True):
            np.testing.assert_array_equal(a.depth.depth_m, b.depth.depth_m)


def drain(sender: TunnelSender, start: float, seconds: float) -> list[bytes]:
    out, now = [], start
    while now < start + seconds:
        todo = sender.next(now)
        if isinstance(todo, bytes):
            out.append(todo)
        else:
            now += min(todo, 0.05)
    return out


def test_a_late_origin_and_corrections_reach_the_ground(tmp_path: Path) -> None:
    bare = ScanHeader(HEADER.scan_id, HEADER.drone, HEADER.started_unix_ns)
    with ScanStore.create(tmp_path / "a.db", bare) as store:
        sender = TunnelSender(store, 15_000.0, 0.0)
        store.listen(sender.on_item)
        store.add_keyframe(0, codec.encode(keyframe(0, 0.0), 0))
        drain(sender, 0.0, 5.0)
        store.update_header(origin_lat_deg=47.5, origin_lon_deg=8.25)
        moved = se3.compose(R_DOWN, np.array([5.0, 20.0, 66.0]))
        store.add_reposes([Repose(0, 1, moved, 1.1, np.eye(6))])
        later = drain(sender, 5.0, 5.0)
        headers = [header for p in later if (header := unpack_announce(p)) is not None]
        tiles = [tile[1] for p in later if (tile := unpack_tile(p)) is not None]
        assert headers[0].origin_lat_deg == 47.5
        again = keyframe_of(tiles)
        assert again is not None
        np.testing.assert_allclose(again.depth.T_world_camera, moved, atol=0.01)
        plain = coarse(keyframe(0, 0.0))
        ratio = np.nanmedian(again.depth.depth_m) / np.nanmedian(plain.depth.depth_m)
        assert ratio == pytest.approx(1.1, abs=0.02)


@pytest.mark.parametrize(
    ("moved_m", "scale", "resent"), [(0.0, 1.05, True), (0.6, 1.0, True), (0.1, 1.001, False)]
)
def test_a_correction_beyond_the_tiles_resolution_resends_them(
    tmp_path: Path, moved_m: float, scale: float, resent: bool
) -> None:
    with ScanStore.create(tmp_path / "a.db", HEADER) as store:
        sender = TunnelSender(store, 15_000.0, 0.0)
        store.listen(sender.on_item)
        frame = keyframe(0, 0.0)
        store.add_keyframe(0, codec.encode(frame, 0))
        drain(sender, 0.0, 5.0)
        T = frame.depth.T_world_camera.copy()
        T[0, 3] += moved_m
        store.add_reposes([Repose(0, 1, T, scale, np.eye(6))])
        assert sender.all_sent is not resent


def test_poses_take_a_message_a_second_and_the_share_counts_what_wraps_it(tmp_path: Path) -> None:
    with ScanStore.create(tmp_path / "a.db", HEADER) as store:
        sender = TunnelSender(store, 500.0, 0.0)
        store.listen(sender.on_item)
        T, sent, poses, now = keyframe(0, 0.0).pose.T_world_camera, 0, 0, 0.0
        for seq in range(4):
            store.add_keyframe(seq, codec.encode(keyframe(seq, 8.0 * seq), 0))
        while now < 10.0:
            store.add_pose(PoseRecord(round(now * 1e9), T, np.eye(6)))
            todo = sender.next(now)
            if isinstance(todo, bytes):
                sent += len(todo) + 17
                poses += unpack_pose(todo) is not None
            else:
                now += min(todo, 0.05)
        assert 0.8 * 500 * 10 < sent < 1.1 * 500 * 10
        assert 5 <= poses <= 11


def test_a_full_radio_buffer_slows_it_down_and_an_empty_one_speeds_it_up(tmp_path: Path) -> None:
    with ScanStore.create(tmp_path / "a.db", HEADER) as store:
        sender = TunnelSender(store, RATE_BYTES_S, 0.0)
        store.add_keyframe(0, codec.encode(keyframe(0, 0.0), 0))

        def bytes_in_ten_seconds(start: float, free_percent: int) -> int:
            sent, now = 0, start
            sender.on_item("k0", 0)
            while now < start + 10:
                todo = sender.next(now)
                if isinstance(todo, float):
                    now += min(todo, 0.05)
                else:
                    sent += len(todo) + 17
                if int(now * 20) % 20 == 0:
                    sender.radio_status(free_percent, now)
            return sent

        full_speed = bytes_in_ten_seconds(0.0, 95)
        slowed = bytes_in_ten_seconds(10.0, 10)
        assert slowed < 0.4 * full_speed


def test_over_a_real_link_into_the_ground_station(tmp_path: Path) -> None:
    pytest.importorskip("zenoh")
    with socket.socket(type=socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        udp = probe.getsockname()[1]
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        tcp = probe.getsockname()[1]
    session = SessionConfig(mode="router", listen=(f"tcp/127.0.0.1:{tcp}",))
    ground = Receiver(ReceiverConfig(tmp_path / "ground", session), deliver=lambda _: None)
    ground.start()
    radio = RadioLink(f"udpin:127.0.0.1:{udp}", GROUND, ground.add_radio)
    radio.open()
    store = ScanStore.create(tmp_path / "a.db", HEADER)
    carrier = RadioLink(f"udpout:127.0.0.1:{udp}", DRONE)
    sender = RadioSender(store, 15_000.0, carrier)
    try:
        store.add_keyframe(0, codec.encode(keyframe(0, 0.0), 0))
        until(lambda: any(e["radio_messages"] >= 15 for e in ground.progress()))
    finally:
        sender.close()
        radio.close()
        ground.close()
        store.close()
    path = tmp_path / "ground" / "drones" / HEADER.drone / HEADER.scan_id / "scan.db"
    with ScanStore.open(path) as kept:
        (frame,) = kept.keyframes()
        assert np.isfinite(frame.depth.depth_m).mean() > 0.95
        assert kept.header.origin_lat_deg == 47.5


def test_through_the_vehicles_own_serial_port_heeding_its_radio(tmp_path: Path) -> None:
    """One serial port: our heartbeats, the tunnel and RADIO_STATUS share the vehicle's link."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    control = RehearsalControl()
    vehicle = VehicleLink(VehicleConfig(links=(f"serial:{os.ttyname(theirs)}:57600",)), control)
    store = ScanStore.create(tmp_path / "a.db", HEADER)
    framer, intake, heartbeats = Framer(), TunnelIntake(), 0
    found: list[tuple[ScanHeader, str, int, int, bytes]] = []
    listener = dialect.MAVLink(None)
    vehicle.start()
    vehicle.set_health(Health.ACTIVE)
    config = DatalinkConfig(radio=OWN_LINKS, radio_share=1.0)
    link = DaemonLink()
    try:
        link.begin_scan(store, Config(datalink=config), vehicle)
        store.add_keyframe(0, codec.encode(keyframe(0, 0.0), 0))
        full = dialect.MAVLink_radio_status_message(200, 200, 3, 50, 50, 0, 0)
        radio = dialect.MAVLink(None, 51, 68)
        os.write(ours, bytes(full.pack(radio)))
        deadline = time.monotonic() + 15
        while len(found) < 16 and time.monotonic() < deadline:
            if not select.select([ours], [], [], 0.2)[0]:
                continue
            for packet in framer.feed(os.read(ours, 4096)):
                heartbeats += packet.message_id == 0
                if packet.message_id == TUNNEL:
                    message = listener.decode(bytearray(packet.data))
                    payload = bytes(message.payload[: message.payload_length])
                    found += [item for item in intake.receive(payload) if item[1] != "pose"]
        sender = link.sender
        assert isinstance(sender, DatalinkSender) and sender._radio is not None
        assert sender._radio._tunnel._factor < 1.0  # the full buffer was heard
    finally:
        link.end_scan(Config(datalink=dataclasses.replace(config, drain_s=0.0)))
        vehicle.stop()
        store.close()
        os.close(ours)
        os.close(theirs)
    assert heartbeats >= 1
    assert {kind for _, kind, *_ in found} == {"header", "tile"}
    tiles = [unpack_tile(item[4]) for item in found if item[1] == "tile"]
    again = keyframe_of([tile[1] for tile in tiles if tile is not None])
    assert again is not None and np.isfinite(again.depth.depth_m).mean() > 0.9


def test_tags_tell_scans_apart() -> None:
    assert tag_of("a", "b") != tag_of("b", "a")
    assert isinstance(tiles_of(coarse(keyframe(0, 0.0)))[0], RadioTile)
    pose = unpack_record(b"")
    assert pose is None
