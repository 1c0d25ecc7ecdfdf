"""Scans of a small textured place, with known errors of placing: for the tests of sites."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import scipy.ndimage as ndi

from recon import se3
from recon.camera_model import rays
from recon.similarity import Similarity
from recon.types import F64, Bool, DepthMap, Keyframe, Pose
from service.georeference import LocalFrame, between_frames
from service.stream.codec import encode
from service.stream.records import ScanHeader
from service.stream.store import ScanStore

SIZE = (240, 136)
K = np.array([[180.0, 0.0, 119.5], [0.0, 180.0, 67.5], [0.0, 0.0, 1.0]])
HEIGHT_M, SIGMA_M, METRES = 40.0, 0.04, 0.16
FRAME = LocalFrame(47.39, 8.54, 408.0)
ELSEWHERE = LocalFrame(47.391, 8.541, 420.0)
START_NS = 1_700_000_000_000_000_000
Box = tuple[float, float, float, float, float]
"""West, south, east, north, height above the plain, m."""


DUSK = 0
"""The ground 1 in other light."""


@cache
def texture(seed: int) -> F64:
    """(900, 900) gray values with detail of all sizes."""
    if seed == DUSK:
        x = np.linspace(0.0, 40.0, 900)
        return np.asarray(0.5 * texture(1) + 15.0 * np.sin(x) + 10.0 * np.cos(x)[:, None])
    rng = np.random.default_rng(seed)
    layers = [ndi.gaussian_filter(rng.normal(size=(900, 900)), 1.3 * 2.0**k) for k in range(5)]
    total = np.asarray(sum(2.0**k * layer / layer.std() for k, layer in enumerate(layers)))
    return np.asarray(128 + 45 * (total - total.mean()) / total.std())


def height(x: F64, y: F64, boxes: Sequence[Box] = ()) -> F64:
    """True height, m: gentle country with boxes on it."""
    z = np.asarray(1.2 * np.sin(x / 9.0) * np.cos(y / 11.0))
    for west, south, east, north, tall in boxes:
        z = np.where((x > west) & (x < east) & (y > south) & (y < north), z + tall, z)
    return z


@dataclass(frozen=True, slots=True)
class Errors:
    """How far a scan's placing is off."""

    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    growth: float = 1.0
    bend_m: float = 0.0  # higher at both ends of the leg than in its middle

    def as_similarity(self) -> Similarity:
        """From the truth to where the scan has it, about 40 m below the cameras."""
        return Similarity(self.growth, se3.so3_exp(np.array(self.turn_rad)), np.array(self.shift_m))


def leg(heading_rad: float, count: int = 6, step_m: float = 6.0) -> list[F64]:
    """Poses of cameras that look straight down along a line through the origin."""
    turn = se3.so3_exp(np.array([0.0, 0.0, heading_rad]))
    R = turn @ np.diag([1.0, -1.0, -1.0])
    return [
        se3.compose(
            R, turn @ np.array([0.0, (k - (count - 1) / 2) * step_m, 0.0]) + [0, 0, HEIGHT_M]
        )
        for k in range(count)
    ]


def met(T: F64, ways: F64, above_m: float) -> F64:
    """(N,) distance along the rays to the country raised by so much."""
    z = np.full(len(ways), HEIGHT_M)
    for _ in range(6):
        p = T[:3, 3] + ways * z[:, None]
        z += (p[:, 2] - height(p[:, 0], p[:, 1]) - above_m) / -ways[:, 2]
    return z


def within(T: F64, ways: F64, z: F64, box: Box) -> Bool:
    """(N,) rays that meet a box's outline at distance ``z``; its walls are not seen from above."""
    x, y = (T[:3, 3] + ways * z[:, None])[:, :2].T
    return np.asarray((x > box[0]) & (x < box[2]) & (y > box[1]) & (y < box[3]))


def view(seq: int, T: F64, boxes: Sequence[Box] = (), ground: int = 1) -> Keyframe:
    """The keyframe at a true pose; noise in gray and depth."""
    rng = np.random.default_rng(1000 * (ground or 1) + seq)
    w, h = SIZE
    v, u = np.mgrid[0:h, 0:w].astype(np.float64)
    ways = rays(K, np.column_stack([u.ravel(), v.ravel()])) @ T[:3, :3].T
    z = met(T, ways, 0.0)
    for box in boxes:
        roof = met(T, ways, box[4])
        z = np.where(within(T, ways, roof, box), roof, z)
    p = (T[:3, 3] + ways * z[:, None])[:, :2] / METRES + 450
    gray = ndi.map_coordinates(texture(ground), p.T, order=1, mode="reflect").reshape(h, w)
    gray = np.clip(gray + rng.normal(size=gray.shape) * 2, 0, 255).astype(np.uint8)
    depth = z.reshape(h, w) + ndi.gaussian_filter(rng.normal(size=(h, w)), 1.0) * 3.0 * SIGMA_M
    seen = np.full((h, w), 3, np.uint8)
    spread = np.diag([0.01**2] * 3 + [1.0, 1.0, 1.5**2])
    A = se3.adjoint(se3.compose(np.eye(3), T[:3, 3]))
    return Keyframe(
        seq, START_NS + seq * 10**9,
        DepthMap(depth.astype(np.float32), np.full((h, w), SIGMA_M, np.float32), seen, K, T),
        np.repeat(gray[..., None], 3, axis=2),
        Pose(T, A @ spread @ A.T, ("vision", "gnss")), np.ones((h, w), np.bool_),
    )  # fmt: skip


def header_of(
    name: str, frame: LocalFrame | None = FRAME, day: int = 0, drone: str = "drone"
) -> ScanHeader:
    """The header of a scan of the place."""
    return ScanHeader(
        name, drone, START_NS + day * 86_400 * 10**9,
        origin_lat_deg=frame.lat_deg if frame else None,
        origin_lon_deg=frame.lon_deg if frame else None,
        origin_alt_amsl_m=frame.alt_amsl_m if frame else None,
        epsg=frame.epsg if frame else None, georeference="gnss" if frame else "none",
    )  # fmt: skip


def layers(
    seq: int, T: F64, errors: Errors | None = None, boxes: Sequence[Box] = (), ground: int = 1,
    frame: LocalFrame = FRAME, day: int = 0, lift_m: float = 0.0, truth: LocalFrame = FRAME,
) -> list[bytes]:  # fmt: skip
    """The coded keyframe at a true pose, wrongly placed by ``errors`` and ``lift_m`` up."""

    one = view(seq, T, boxes, ground)
    d, wrong = one.depth, (errors or Errors()).as_similarity()
    grown = np.float32(wrong.scale)
    lift = se3.compose(np.eye(3), np.array([0.0, 0.0, lift_m]))
    placed = between_frames(frame, truth) @ lift @ wrong.pose(T)
    depth = DepthMap(d.depth_m * grown, d.sigma_m * grown, d.views, d.K, placed)
    pose = Pose(placed, one.pose.covariance, one.pose.sources)
    placed_one = Keyframe(seq, one.time_ns, depth, one.bgr, pose, one.fresh)
    return list(encode(placed_one, one.time_ns + day * 86_400 * 10**9))


def write_scan(
    folder: Path, poses: Sequence[F64], errors: Errors | None = None, boxes: Sequence[Box] = (),
    ground: int = 1, frame: LocalFrame | None = FRAME, day: int = 0, finished: bool = True,
    truth: LocalFrame = FRAME,
) -> Path:  # fmt: skip
    """A scan of the place in ``folder``; its world is ``frame``, wrongly placed by ``errors``.

    The truth is in ENU of ``truth``.
    """
    with ScanStore.create(folder / "scan.db", header_of(folder.name, frame, day)) as store:
        for seq, T in enumerate(poses):
            lift = (errors or Errors()).bend_m * (2.0 * seq / max(len(poses) - 1, 1) - 1.0) ** 2
            store.add_keyframe(
                seq, layers(seq, T, errors, boxes, ground, frame or FRAME, day, lift, truth)
            )
        if finished:
            store.finish({"frames": len(poses)})
    return folder
