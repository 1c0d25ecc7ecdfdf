"""A scan of two strips over painted ground whose poses err, with its stills at full size."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from painted_ground import SIZE, K, pose, still

from recon import se3
from recon.camera_model import scaled_K
from recon.types import F64, DepthMap, Keyframe, Pose
from service.georeference import LocalFrame
from service.stream.codec import encode
from service.stream.records import PoseRecord, ScanHeader
from service.stream.store import ScanStore

FRAME = LocalFrame(47.39, 8.54, 408.0)
START_NS = 1_700_000_000_000_000_000
SMALL = (60, 45)
TOO_DEEP = 1.04


def flown() -> F64:
    """Truth: two strips in opposite directions that lean and overlap by half."""
    one = [pose(6.0 * k, 0.0, 40.0 + k % 2, seed=k) for k in range(5)]
    two = [pose(24.0 - 6.0 * k, 180.0, 38.0, seed=9 + k) for k in range(5)]
    return np.array([*one, *two])


def depth_of(T: F64, size: tuple[int, int] = SMALL) -> F64:
    """(h, w) exact depth of the plane z = 0."""
    k = scaled_K(K, size[0] / SIZE[0], size[1] / SIZE[1])
    v, u = np.mgrid[0 : size[1], 0 : size[0]].astype(np.float64)
    ways = np.stack([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], np.ones_like(u)], -1)
    return np.asarray(-T[2, 3] / (ways @ T[:3, :3].T)[..., 2])


def made(
    folder: Path, truth: F64, placed: bool = True, size: tuple[int, int] = SMALL,
    new_px: int | None = None,
) -> Path:  # fmt: skip
    """A scan whose poses err one by one and whose surfaces are 4 % too deep, and its stills.

    Keyframes are of ``size``; ``new_px`` of their columns are new, by default all.
    """
    rng = np.random.default_rng(4)
    camera = {"width": SIZE[0], "height": SIZE[1], "K": K.ravel().tolist(), "distortion": [0.0] * 5}
    header = ScanHeader(
        "test-1", "drone-1", START_NS, camera=camera, origin_lat_deg=FRAME.lat_deg,
        origin_lon_deg=FRAME.lon_deg, origin_alt_amsl_m=FRAME.alt_amsl_m, epsg=FRAME.epsg,
        georeference="gnss",
    )  # fmt: skip
    if not placed:
        header = ScanHeader("test-1", "drone-1", START_NS, camera=camera)
    spread = np.diag([0.02**2] * 3 + [1.0] * 3)
    (folder / "stills").mkdir()
    with ScanStore.create(folder / "scan" / "scan.db", header) as store:
        for k, T in enumerate(truth):
            time_ns = START_NS + k * 10**9
            here = T @ se3.exp(rng.normal(size=6) * ([0.01] * 3 + [0.7] * 3))
            depth = (TOO_DEEP * depth_of(T, size)).astype(np.float32)
            bgr = np.full((*depth.shape, 3), 120, np.uint8)
            fresh = np.ones(depth.shape, np.bool_)
            fresh[:, new_px:] = new_px is None
            K_small = scaled_K(K, size[0] / SIZE[0], size[1] / SIZE[1])
            one = Keyframe(
                k, time_ns,
                DepthMap(depth, np.full_like(depth, 0.05), np.full(depth.shape, 3, np.uint8),
                         K_small, here),
                bgr, Pose(here, spread, ("vision",)), fresh,
            )  # fmt: skip
            store.add_keyframe(k, encode(one, time_ns))
            store.add_pose(PoseRecord(time_ns, here, spread, sources=("vision",), keyframe_seq=k))
            image = cv2.cvtColor(still(T), cv2.COLOR_GRAY2BGR)
            assert cv2.imwrite(str(folder / "stills" / f"{k}.png"), image)
        store.finish({"frames": len(truth)})
    return folder / "scan"
