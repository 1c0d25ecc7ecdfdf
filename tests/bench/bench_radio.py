"""The coarse map over a telemetry radio.

A flight of 100 m in 20 s. The drone's MAVLink link and the ground station's are two
pseudo-terminals; between them a radio of 57,600 baud that loses packets and reports the state of
its buffer in RADIO_STATUS. There is no IP link.
"""

from __future__ import annotations

import os
import random
import select
import tempfile
import threading
import time
import tty
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mavlink.component.control import NoScans
from mavlink.component.presence import Health
from mavlink.component.vehicle import VehicleConfig, VehicleLink
from mavlink.wire.dialect import dialect
from mavlink.wire.framing import Framer
from recon import se3
from recon.survey.submap_loops import points_of
from recon.types import F64, DepthMap, Keyframe, Pose
from service.bench import BenchOptions, BenchResult
from service.config import DatalinkConfig
from service.ground.receiver import Receiver, ReceiverConfig
from service.listener import free_ports
from service.radio import GROUND, TUNNEL, RadioLink, VehicleRadio
from service.stream import codec
from service.stream.link import DatalinkSender
from service.stream.radio_messages import unpack_tile
from service.stream.records import PoseRecord, ScanHeader
from service.stream.session import SessionConfig
from service.stream.store import ScanStore

BAUD = 57_600
BYTES_S = BAUD / 10
SHARE = 0.3
LOSS = 0.05
BUFFER_BYTES = 4096
FLIGHT_S, FLIGHT_M, KEYFRAMES = 20.0, 100.0, 13
HEIGHT_M = 60.0
FOCAL_PX, SIZE_PX = 260.0, (320, 180)
CELL_M = 4.0


class _Radio:
    """Two serial lines and the air between them; ``sent`` counts bytes by message number."""

    def __init__(self) -> None:
        self._lines = [os.openpty() for _ in range(2)]
        for _, slave in self._lines:
            tty.setraw(slave)
        self.names = [f"serial:{os.ttyname(slave)}:{BAUD}" for _, slave in self._lines]
        self.sent: dict[int, int] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="radio emulator", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Switch it off."""
        self._stop.set()
        self._thread.join(5.0)
        for line in self._lines:
            for end in line:
                os.close(end)

    def _run(self) -> None:
        """Carry packets up from line 0 to line 1 at the radio's rate, and the status back."""
        drone, ground = (master for master, _ in self._lines)
        framer, encoder, rng = Framer(), dialect.MAVLink(None, 51, 68), random.Random(1)
        waiting: deque[bytes] = deque()
        free_at = status_at = time.monotonic()
        while not self._stop.is_set():
            for end in select.select([drone, ground], [], [], 0.005)[0]:
                data = os.read(end, 4096)
                if end == ground:
                    continue
                for packet in framer.feed(data):
                    size = len(packet.data)
                    self.sent[packet.message_id] = self.sent.get(packet.message_id, 0) + size
                    if sum(map(len, waiting)) + size <= BUFFER_BYTES:
                        waiting.append(bytes(packet.data))
            now = time.monotonic()
            while waiting and free_at <= now:
                data = waiting.popleft()
                free_at = max(free_at, now - 0.02) + len(data) / BYTES_S
                if rng.random() >= LOSS:
                    os.write(ground, data)
            if now >= status_at:
                status_at = now + 1.0
                free = round(100 * (1 - sum(map(len, waiting)) / BUFFER_BYTES))
                status = dialect.MAVLink_radio_status_message(180, 180, free, 40, 40, 0, 0)
                os.write(drone, bytes(status.pack(encoder)))


@dataclass(slots=True, eq=False)
class _TileTimes:
    """When keyframes were made, and when the first and the last of their tiles arrived."""

    made: dict[int, float] = field(default_factory=dict)
    first: dict[int, float] = field(default_factory=dict)
    last: dict[int, float] = field(default_factory=dict)
    tiles: set[tuple[int, int]] = field(default_factory=set)

    def heard(self, payload: bytes) -> None:
        """Take note of a payload at the ground."""
        tile = unpack_tile(payload)
        if tile is not None and (tile[1].seq, tile[1].index) not in self.tiles:
            self.tiles.add((tile[1].seq, tile[1].index))
            self.first.setdefault(tile[1].seq, time.monotonic())
            self.last[tile[1].seq] = time.monotonic()


def run(options: BenchOptions) -> list[BenchResult]:
    """Fly over the radio alone; the state of the ground at the end."""
    del options  # one flight is one round
    with tempfile.TemporaryDirectory() as folder:
        return _fly(Path(folder))


def _fly(folder: Path) -> list[BenchResult]:
    radio, flight = _Radio(), _TileTimes()
    vehicle = VehicleLink(VehicleConfig(links=(radio.names[0],)), NoScans())
    vehicle.start()
    session = SessionConfig(mode="router", listen=(f"tcp/127.0.0.1:{free_ports(1)[0]}",))
    receiver = Receiver(ReceiverConfig(folder / "ground", session), deliver=lambda _: None)
    receiver.start()

    def heard(payload: bytes) -> None:
        flight.heard(payload)
        receiver.add_radio(payload)

    ear = RadioLink(radio.names[1], GROUND, heard)
    ear.open()
    onboard = ScanStore.create(folder / "scan.db", ScanHeader("scan", "drone", 1))
    config = DatalinkConfig(radio_baud=BAUD, radio_share=SHARE)
    sender = DatalinkSender(onboard, config, radio=VehicleRadio(vehicle))
    try:
        began = time.monotonic()
        while time.monotonic() - began < FLIGHT_S:
            vehicle.set_health(Health.ACTIVE)
            _produce(onboard, flight, time.monotonic() - began)
            time.sleep(0.1)
        sent = dict(radio.sent)
    finally:
        sender.close()
        ear.close()
        receiver.close()
        vehicle.stop()
        radio.close()
    with (
        onboard,
        ScanStore.open(folder / "ground" / "drones" / "drone" / "scan" / "scan.db") as ground,
    ):
        return _outcome(onboard, ground, flight, sent)


def _produce(store: ScanStore, flight: _TileTimes, at_s: float) -> None:
    """The keyframes that are due, of the surface that each adds."""
    while len(flight.made) < min(KEYFRAMES, 1 + int(at_s / FLIGHT_S * KEYFRAMES)):
        seq = len(flight.made)
        frame = _keyframe(seq)
        flight.made[seq] = time.monotonic()
        store.add_keyframe(seq, codec.encode(frame, time.time_ns()))
        store.add_pose(PoseRecord(time.time_ns(), frame.pose.T_world_camera, np.eye(6)))


def _ground_m(x: F64, y: F64) -> F64:
    """The true surface: hills of 7 m."""
    return np.asarray(4 * np.sin(x / 15) + 3 * np.cos(y / 12))


def _keyframe(seq: int) -> Keyframe:
    """Depth images of a camera looking down; all but the first show a strip of new surface."""
    w, h = SIZE_PX
    x0, step_m = seq * FLIGHT_M / (KEYFRAMES - 1), FLIGHT_M / (KEYFRAMES - 1)
    T = se3.compose(np.diag([1.0, -1.0, -1.0]), np.array([x0, 0.0, HEIGHT_M]))
    K = np.array([[FOCAL_PX, 0, (w - 1) / 2], [0, FOCAL_PX, (h - 1) / 2], [0, 0, 1]])
    v, u = np.mgrid[:h, :w].astype(np.float64)
    rays_x, rays_y = (u - K[0, 2]) / FOCAL_PX, (v - K[1, 2]) / FOCAL_PX
    z = np.full((h, w), HEIGHT_M)
    for _ in range(12):  # to where each ray meets the surface
        z = HEIGHT_M - _ground_m(x0 + rays_x * z, -rays_y * z)
    gray = np.clip(128 + 60 * np.sin((x0 + rays_x * z) / 3), 0, 255).astype(np.uint8)
    depth = DepthMap(
        z.astype(np.float32), np.full((h, w), 0.2, np.float32), np.full((h, w), 3, np.uint8), K, T
    )
    fresh = u >= (0 if seq == 0 else w - 1.2 * step_m * FOCAL_PX / HEIGHT_M)
    bgr = np.stack([gray, gray, gray // 2], axis=-1)
    return Keyframe(seq, 0, depth, bgr, Pose(T, np.eye(6) * 1e-4), fresh)


def _cells(frames: list[F64]) -> set[tuple[int, int]]:
    return {(int(x // CELL_M), int(y // CELL_M)) for points in frames for x, y in points[:, :2]}


def _outcome(
    onboard: ScanStore, ground: ScanStore, flight: _TileTimes, sent: dict[int, int]
) -> list[BenchResult]:
    there, here = (
        [points_of(k.depth, k.depth.T_world_camera)[0] for k in store.keyframes()]
        for store in (ground, onboard)
    )
    seen = _cells(here)
    points = np.concatenate(there)
    error = points[:, 2] - _ground_m(points[:, 0], points[:, 1])
    whole = BYTES_S * FLIGHT_S
    ours, covered = sum(sent.values()), len(_cells(there) & seen) / len(seen)
    first_s = min(flight.first.values()) - flight.made[0]
    last_s = [at - flight.made[seq] for seq, at in flight.last.items()]
    return [
        BenchResult(what, float(value), unit, name="link 57600 baud")
        for what, value, unit in (
            ("of the radio, by the coarse map", 100 * sent.get(TUNNEL, 0) / whole, "%"),
            ("of the radio, with our heartbeats and answers", 100 * ours / whole, "%"),
            ("of the surface seen in 100 m that is at the ground", 100 * covered, "%"),
            ("height of those points against the truth", np.sqrt(np.mean(error**2)), "m rms"),
            ("first tile after the first keyframe", first_s, "s"),
            ("last tile of a keyframe after it was made, median", np.median(last_s), "s"),
        )
    ]
