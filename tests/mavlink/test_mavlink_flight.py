"""A flight with the whole daemon: orders, telemetry and odometry over one MAVLink link."""

from __future__ import annotations

import contextlib
import csv
import json
import math
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from loopback import until
from scipy.spatial.transform import Rotation

from mavlink.telemetry.history import PATIENCE_S
from mavlink.wire.dialect import dialect
from mavlink.wire.framing import Framer
from mavlink.wire.tlog import packets
from recon.types import Camera
from service.cameras.camera_file import save_camera
from service.cameras.exif import read_tags
from service.config import load_config
from service.daemon.runtime import Daemon
from service.scans.writing import SUMMARY

AGL_M, FOCAL_PX, SIZE = 50.0, 300.0, (320, 240)
SPEED_M_S, INTERVAL_S = 5.0, 0.1
IMAGES = 300  # more than are needed: a busy machine drops frames
LAT, LON = 47.3, 8.5


def draw_flight(folder: Path) -> None:
    """Nadir images of flat ground, flown east with the image's top to the north."""
    rng = np.random.default_rng(3)
    ground = np.zeros((SIZE[1] + 8, SIZE[0] + 3 * IMAGES, 3), np.float32)
    for size in (3, 9, 31):
        noise = rng.normal(size=ground.shape).astype(np.float32)
        ground += cv2.GaussianBlur(noise, (size, size), 0) * size
    ground = 128 + 50 * ground / ground.std()
    folder.mkdir()
    for k in range(IMAGES):
        shift = SPEED_M_S * INTERVAL_S * k * FOCAL_PX / AGL_M
        move = np.array([[1.0, 0.0, -shift], [0.0, 1.0, 0.0]])
        image = cv2.warpAffine(ground, move, SIZE, flags=cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / f"{k:03}.png"), np.clip(image, 0, 255).astype(np.uint8))
    K = np.array([[FOCAL_PX, 0.0, 159.5], [0.0, FOCAL_PX, 119.5], [0.0, 0.0, 1.0]])
    save_camera(folder / "camera.yaml", Camera(K, np.zeros(5), SIZE))


class Autopilot:
    """An autopilot that flies, and forwards a ground station's orders."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.01)
        self.port = self._socket.getsockname()[1]
        self.heard: list[Any] = []
        self._peer: Any = None
        self._mouths = {c: dialect.MAVLink(None, *c) for c in ((1, 1), (255, 190))}
        self._stop = threading.Event()
        self._boot_ns = time.monotonic_ns() - 100 * 10**9
        self._thread = threading.Thread(target=self._fly, daemon=True)

    def __enter__(self) -> Autopilot:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._socket.close()

    def say(self, message: Any, source: tuple[int, int] = (1, 1)) -> None:
        if self._peer is not None:
            self._socket.sendto(bytes(message.pack(self._mouths[source])), self._peer)

    def order(self, number: int, component: int, *params: float) -> None:
        values = [*params, *[0.0] * (7 - len(params))]
        order = dialect.MAVLink_command_long_message(1, component, number, 0, *values)
        self.say(order, (255, 190))

    def of(self, name: str) -> list[Any]:
        return [m for m in list(self.heard) if m.get_type() == name]

    def _fly(self) -> None:
        framer, ear, tick = Framer(), dialect.MAVLink(None), 0
        while not self._stop.is_set():
            with contextlib.suppress(TimeoutError):
                data, self._peer = self._socket.recvfrom(65536)
                for packet in framer.feed(data):
                    self.heard.append(ear.decode(bytearray(packet.data)))
            boot_ms = (time.monotonic_ns() - self._boot_ns) // 10**6
            if boot_ms // 20 != tick:
                tick = boot_ms // 20
                self._tell(boot_ms)

    def _tell(self, boot_ms: int) -> None:
        east_m = SPEED_M_S * (boot_ms - 100_000) * 1e-3
        lon = round((LON + east_m / (111_319.49 * math.cos(math.radians(LAT)))) * 1e7)
        self.say(dialect.MAVLink_heartbeat_message(2, 3, 128, 0, 4, 3))
        self.say(dialect.MAVLink_attitude_message(boot_ms, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
        alt, rel, v = 450_000, round(AGL_M * 1e3), round(SPEED_M_S * 100)
        place = (round(LAT * 1e7), lon, alt, rel, 0, v, 0, 0)
        self.say(dialect.MAVLink_global_position_int_message(boot_ms, *place))


@pytest.fixture
def autopilot() -> Iterator[Autopilot]:
    with Autopilot() as one:
        yield one


@pytest.mark.slow
def test_a_flight_by_mavlink(tmp_path: Path, autopilot: Autopilot) -> None:
    draw_flight(tmp_path / "images")
    settings = {
        "scan.folder": tmp_path / "scans",
        "camera.source": f"images:{tmp_path / 'images'}?interval_s={INTERVAL_S}",
        "camera.model": tmp_path / "images" / "camera.yaml",
        "mavlink.links": f"udpout:127.0.0.1:{autopilot.port}",
        "mavlink.odometry": "true",
        "health.http": "",
        "compute.backend": "cpu",
    }
    daemon = Daemon(load_config(None, [f"{key}={value}" for key, value in settings.items()]))
    service = threading.Thread(target=daemon.run, daemon=True)
    service.start()

    def progress() -> tuple[object, ...]:
        run = daemon.scanning.run
        heard = (len(autopilot.of(kind)) for kind in ("COMMAND_ACK", "ODOMETRY", "STATUSTEXT"))
        return (*heard, daemon.scanning.phase, run and run.progress_s)

    def come(done: Callable[[], Any]) -> None:
        until(done, 120.0, progress)  # without a sign of life: kernels may have to be compiled

    try:
        come(lambda: daemon.actions.is_ready and daemon.vehicle.history.last_ns)
        autopilot.order(2500, 100)
        come(lambda: any(a.command == 2500 for a in autopilot.of("COMMAND_ACK")))
        come(lambda: len(autopilot.of("ODOMETRY")) >= 20)
        autopilot.order(2000, 100, 0, 0, 1, 7)
        come(lambda: any(a.command == 2000 for a in autopilot.of("COMMAND_ACK")))
        come(lambda: len(autopilot.of("CAMERA_IMAGE_CAPTURED")) >= 4)
        come(lambda: any(m.file_url for m in autopilot.of("CAMERA_IMAGE_CAPTURED")))
        autopilot.order(2501, 100)
        come(lambda: daemon.scanning.run is None)
    finally:
        daemon.quit()
        service.join(timeout=240)
    acks = {(a.command, a.result) for a in autopilot.of("COMMAND_ACK")}
    acks.discard((2501, 5))  # in progress, until the disk has it
    assert acks == {(2500, 0), (2000, 0), (2501, 0)}
    (folder,) = (path.parent for path in (tmp_path / "scans").glob("*/" + SUMMARY))
    _check_odometry(autopilot.of("ODOMETRY"))
    _check_images(autopilot.of("CAMERA_IMAGE_CAPTURED"), folder)
    assert {v.name for v in autopilot.of("NAMED_VALUE_FLOAT")} >= {"SR_SPEED", "SR_DIST", "SR_TURN"}
    counts: Counter[str] = Counter()
    with (folder / "link.tlog").open("rb") as file:
        heard = [(at, (p.system, p.component, p.message_id)) for at, p in packets(file, counts)]
    kinds = Counter(kind for _, kind in heard)
    assert counts["skipped_bytes"] == 0
    attitudes = [at_ns * 1e-9 for at_ns, kind in heard if kind == (1, 1, 30)]
    _check_tags((folder / "telemetry.csv").read_text().splitlines(), attitudes)
    assert kinds[(1, 1, 30)] > 50 and kinds[(1, 1, 33)] > 50  # what came
    assert kinds[(1, 191, 0)] and kinds[(1, 191, 331)] >= 20 and kinds[(255, 190, 76)] >= 1


def _check_images(images: list[Any], folder: Path) -> None:
    """The photo, and every keyframe once, at its own place."""
    assert [m.image_index for m in images] == list(range(len(images)))
    assert all(m.capture_result == 1 for m in images)
    (photo,) = (m for m in images if m.file_url)
    stored = read_tags(folder.parent / photo.file_url)
    assert stored.geotag is not None and stored.geotag.lon_deg is not None
    assert stored.geotag.lon_deg == pytest.approx(photo.lon * 1e-7, abs=1e-6)
    reported = [m for m in images if not m.file_url]
    keyframes = json.loads((folder / SUMMARY).read_text())["counts"]["keyframes"]
    assert len(reported) in (keyframes - 1, keyframes)  # the photo may be one of them
    lons = [m.lon for m in reported]
    assert lons == sorted(lons) and abs(reported[0].lat * 1e-7 - LAT) < 5e-5
    assert reported[0].relative_alt == pytest.approx(AGL_M * 1e3, rel=0.05)
    down = Rotation.from_quat([*reported[0].q[1:], reported[0].q[0]]).apply([1.0, 0.0, 0.0])
    assert down == pytest.approx([0.0, 0.0, 1.0], abs=0.05)  # the optical axis in NED


def _check_tags(lines: list[str], heard_s: list[float]) -> None:
    """Every frame has the attitude that was heard about its time, with its age and sigma."""
    rows = list(csv.DictReader(lines))
    assert len(rows) >= 20
    tagged = [row for row in rows if "attitude" in row["sources"].split()]
    ends_s = np.array([-math.inf, *sorted(heard_s), math.inf])
    times_s = np.array([float(row["time_unix_s"]) for row in rows])
    after = np.searchsorted(ends_s, times_s)
    in_time = np.maximum(times_s - ends_s[after - 1], ends_s[after] - times_s) < PATIENCE_S / 2
    assert len(tagged) > 0.9 * in_time.sum() > 0  # a busy machine keeps the autopilot waiting
    for row in tagged:
        assert 0.0 <= float(row["age_attitude_ms"]) <= 500.0
        assert float(row["sigma_attitude_deg"]) > 0.0 and float(row["sigma_yaw_deg"]) > 0.0
    times = [float(row["time_unix_s"]) for row in rows]
    assert times == sorted(times) and abs(times[0] - time.time()) < 300.0


def _check_odometry(reported: list[Any]) -> None:
    """It flies east, level, at the pace of the images; after a long step no velocity is known."""
    moving = reported[10:20]
    assert [m.q[0] for m in moving] == pytest.approx([1.0] * 10, abs=0.01)
    east = [m.y for m in moving]
    speed = (east[-1] - east[0]) / (moving[-1].time_usec - moving[0].time_usec) * 1e6
    assert speed == pytest.approx(SPEED_M_S, rel=0.15)
    assert np.nanmedian([m.vx for m in moving]) == pytest.approx(0.0, abs=1.0)
    assert np.nanmedian([m.vy for m in moving]) == pytest.approx(SPEED_M_S, rel=0.25)
    assert all(m.pose_covariance[0] > 0.0 and m.quality > 0 for m in moving)
    assert (moving[0].frame_id, moving[0].child_frame_id) == (20, 12)
