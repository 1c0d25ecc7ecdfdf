"""A scan with exact synthetic keyframes, shared by the tests of the deliverables."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from recon import se3
from recon.types import F64, Array, DepthMap, Keyframe, Pose
from service.stream.codec import encode
from service.stream.records import PoseRecord, ScanHeader
from service.stream.store import ScanStore


class HouseFlight:
    """Exact nadir keyframes flown east over flat ground with a 12 m x 8 m house, 6 m high."""

    K = np.array([[140.0, 0.0, 79.5], [0.0, 140.0, 44.5], [0.0, 0.0, 1.0]])
    nadir = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    height_m = 40.0
    start_ns = 1_700_000_000_123_456_789
    origin = (47.39, 8.54, 408.0)

    def roof_m(self, x: Array, y: Array) -> F64:
        """Height of the truth: the house stands about (10, 2)."""
        return np.where((np.abs(x - 10.0) < 6.0) & (np.abs(y - 2.0) < 4.0), 6.0, 0.0)

    def pose(self, east_m: float) -> F64:
        """(4, 4) T_world_camera at (east, 0, 40)."""
        return se3.compose(self.nadir, np.array([east_m, 0.0, self.height_m]))

    def keyframe(self, seq: int, east_m: float, sigma_m: float = 0.05) -> Keyframe:
        """The exact view of the camera."""
        h, w = 90, 160
        u, v = np.meshgrid(np.arange(w), np.arange(h))
        a, b = (u - self.K[0, 2]) / self.K[0, 0], (v - self.K[1, 2]) / self.K[1, 1]
        on_roof = self.height_m - 6.0
        top = self.roof_m(east_m + a * on_roof, -b * on_roof)
        depth = self.height_m - top
        x, y = east_m + a * depth, -b * depth
        bgr = np.full((h, w, 3), (60, 120, 70), np.uint8)
        bgr[top > 0] = (40, 40, 200)
        bgr[((np.floor(x / 4) + np.floor(y / 4)) % 2 == 0) & (top == 0)] = (90, 150, 110)
        depth_map = DepthMap(
            depth.astype(np.float32),
            np.full((h, w), sigma_m, np.float32),
            np.full((h, w), 2, np.uint8),
            self.K,
            self.pose(east_m),
        )
        pose = Pose(depth_map.T_world_camera, np.eye(6) * 1e-4, ("vision",))
        time_ns = self.start_ns + seq * 10**9
        return Keyframe(seq, time_ns, depth_map, bgr, pose, np.ones((h, w), np.bool_))

    def record(self, seq: int, east_m: float) -> PoseRecord:
        """The pose of frame ``seq`` as the drone would write it."""
        return PoseRecord(
            time_unix_ns=self.start_ns + seq * 10**9,
            T_world_camera=self.pose(east_m),
            covariance=np.eye(6) * 1e-4,
            lat_deg=self.origin[0],
            lon_deg=self.origin[1],
            alt_amsl_m=self.origin[2] + self.height_m,
            pitch_rad=-np.pi / 2,
            speed_m_s=5.0,
            distance_m=5.0 * seq,
            sources=("vision", "gnss"),
            sigma_m=0.3,
            keyframe_seq=seq,
        )

    def flown(self, folder: Path, georeferenced: bool = True) -> ScanStore:
        """A store of five keyframes, open for writing."""
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "scan.db").write_bytes(self._recorded(georeferenced))
        return ScanStore.open(folder / "scan.db")

    @cache  # noqa: B019 - a flight lasts as long as the tests
    def _recorded(self, georeferenced: bool) -> bytes:
        """The file of that store."""
        with TemporaryDirectory() as folder:
            self._record(Path(folder), georeferenced).close()
            return (Path(folder) / "scan.db").read_bytes()

    def _record(self, folder: Path, georeferenced: bool) -> ScanStore:
        header = ScanHeader(
            "test-1", "drone-1", self.start_ns, camera={"fx": 140.0}, software="0.0"
        )
        store = ScanStore.create(folder / "scan.db", header)
        if georeferenced:
            lat, lon, alt = self.origin
            store.update_header(
                origin_lat_deg=lat, origin_lon_deg=lon, origin_alt_amsl_m=alt, georeference="gnss"
            )
        for seq in range(5):
            one = self.keyframe(seq, 5.0 * seq)
            store.add_keyframe(seq, encode(one, one.time_ns))
            store.add_pose(self.record(seq, 5.0 * seq))
        return store


class HillsideFlight(HouseFlight):
    """The same flight over ground that rises to the north, without a house."""

    slope = 0.15

    def keyframe(self, seq: int, east_m: float, sigma_m: float = 0.05) -> Keyframe:
        """The exact view of the camera."""
        one = super().keyframe(seq, east_m, sigma_m)
        h, w = one.depth.depth_m.shape
        b = (np.arange(h) - self.K[1, 2]) / self.K[1, 1]
        depth_m = np.repeat(self.height_m / (1.0 - self.slope * b)[:, None], w, axis=1)
        return replace(one, depth=replace(one.depth, depth_m=depth_m.astype(np.float32)))
