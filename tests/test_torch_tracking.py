"""The odometry with its corners and tracks in torch, against the compiled one, on ``--device``.

Tolerances: every frame has the same state; poses agree to 2 cm and 1 mrad at 60 m, a tenth of
the odometry's own sigma.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import cv2
import numpy as np
import pytest

from recon import se3
from recon.tracking.localisation import OdometryConfig
from recon.tracking.matching import Matcher, MatchingConfig
from recon.tracking.odometry import Odometry, Tracked
from recon.types import F64, U8, Camera, PosePrior
from service.compute.backend_choice import FallbackBackend
from service.config import Config
from service.flight.stages import build_stages

torch = pytest.importorskip("torch")

K = np.array([[330.0, 0, 199.5], [0, 330.0, 149.5], [0, 0, 1]])
CAMERA = Camera(K, np.zeros(5), (400, 300))
DOWN = np.diag([1.0, -1, -1])
M_PER_PX = 0.15
FRAMES = 10
SETTINGS = OdometryConfig(matching=MatchingConfig(grid=18))


@pytest.fixture
def device(request: pytest.FixtureRequest) -> str:
    """Where the torch code runs."""
    return str(request.config.getoption("--device"))


@pytest.fixture(scope="module")
def flight() -> list[tuple[U8, PosePrior]]:
    """Pictures of a flat ground, flown over at 60 m, with telemetry."""
    rng = np.random.default_rng(0)
    ground = np.zeros((1200, 1200), np.float32)
    for size in (20, 75, 300, 1200):
        layer = rng.normal(0, 1, (size, size)).astype(np.float32)
        ground += cv2.resize(layer, (1200, 1200), interpolation=cv2.INTER_CUBIC)
    ground = np.clip(ground / ground.std() * 45 + 128, 0, 255).astype(np.uint8)
    plane = np.array([[M_PER_PX, 0, -90.0], [0, M_PER_PX, -90.0], [0, 0, 1]])
    out = []
    for i in range(FRAMES):
        R = se3.so3_exp(np.r_[rng.normal(0, 0.02, 2), 0.3]) @ DOWN
        t = np.array([2.7 * i - 15.0, 0.6 * i - 5, 60.0])
        H = K @ R.T @ (np.c_[np.eye(3)[:, :2], -t] @ plane)
        picture = cv2.warpPerspective(ground, H, CAMERA.size_px, flags=cv2.INTER_AREA)
        prior = PosePrior(R, 0.01, 0.03, t + rng.normal(0, 0.3, 3), np.full(3, 0.5), 60.0, 2.0)
        out.append((np.asarray(picture, np.uint8), prior))
    return out


def flown(flight: list[tuple[U8, PosePrior]], matcher: Matcher | None) -> list[Tracked]:
    """What the odometry says of each frame, at 5 Hz."""
    odometry = Odometry(CAMERA, SETTINGS, matcher)
    return [
        odometry.track(picture, i, i * 200_000_000, prior)
        for i, (picture, prior) in enumerate(flight)
    ]


def alike(got: list[Tracked], want: list[Tracked]) -> None:
    """The same states and, to the tolerance, the same poses."""
    assert [g.state for g in got] == [w.state for w in want]
    assert Counter(w.state for w in want)["keyframe"] >= 3
    for g, w in zip(got, want, strict=True):
        if g.T_odom_camera is None or w.T_odom_camera is None:
            assert g.T_odom_camera is None and w.T_odom_camera is None
            continue
        assert np.linalg.norm(g.T_odom_camera[:3, 3] - w.T_odom_camera[:3, 3]) < 0.02
        turn: F64 = g.T_odom_camera[:3, :3].T @ w.T_odom_camera[:3, :3]
        assert np.linalg.norm(se3.so3_log(turn)) < 1e-3


def test_the_odometry_follows_the_same_track(
    device: str, flight: list[tuple[U8, PosePrior]]
) -> None:
    """First views, keyframes and frames between them."""
    from recon.backends.torch_backend import TorchBackend

    want = flown(flight, None)
    alike(flown(flight, TorchBackend(device).matcher()), want)


def test_a_device_lost_while_tracking_changes_nothing(
    device: str, flight: list[tuple[U8, PosePrior]]
) -> None:
    """The processor goes on with the pictures that the device held; the reason is kept."""
    from recon.backends.torch_backend import TorchBackend

    backend = FallbackBackend(TorchBackend(device))
    matcher: Any = backend.matcher()
    own, asked = matcher._own.match, []

    def lost(*given: Any) -> Any:
        asked.append(1)
        if len(asked) > 6:
            raise RuntimeError("CUDA error: device lost")
        return own(*given)

    matcher._own.match = lost
    alike(flown(flight, matcher), flown(flight, None))
    assert len(asked) == 7
    assert backend.failure == "CUDA error: device lost"
    assert backend.name == "cpu"
    assert backend.device_matcher() is None


def test_the_pipeline_tracks_on_its_backend(device: str) -> None:
    """Torch brings a matcher of its own; the compiled backend leaves it to the processor."""
    from recon.backends import load_backend
    from recon.backends.torch_backend import TorchBackend
    from recon.backends.torch_tracking import TorchMatcher
    from recon.tracking.matching import HostMatcher

    own = build_stages(
        CAMERA, Config(), FallbackBackend(TorchBackend(device))
    ).track.odometry._matcher
    assert isinstance(getattr(own, "_own", None), TorchMatcher)
    assert isinstance(
        build_stages(CAMERA, Config(), load_backend("cpu")).track.odometry._matcher, HostMatcher
    )
