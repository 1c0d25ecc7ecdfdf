"""Nothing waits for the device in the work of a frame but the one read of each result.

On the processor every operation is watched for those that read a value on the host (and that
CUDA would wait for); on ``--device cuda`` torch itself raises where it would wait.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import cv2
import numpy as np
import pytest

from recon.mapping.registration import IcpConfig
from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.types import U8, DepthMap, StereoPair

torch = pytest.importorskip("torch")

from torch.utils._python_dispatch import TorchDispatchMode  # noqa: E402

WAITS = (
    "_local_scalar_dense", "item", "nonzero", "masked_select", "unique", "nanmedian", "median",
    "equal", "bincount", "histc", "_linalg_eigh", "_linalg_svd", "_linalg_check_errors",
)  # fmt: skip
"""Operations whose result or shape the host must know before it can go on."""


class Watch(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Notes the operations that would wait on a GPU."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.waits: list[str] = []
        self.launches = 0

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        name = func.overloadpacket.__name__
        if any(name == w or name.startswith(w + "_") for w in WAITS):
            self.waits.append(name)
        chosen = args[1] if name in ("index", "index_put", "index_put_") else ()
        if any(t is not None and t.dtype == torch.bool for t in chosen):
            self.waits.append(f"{name} by a mask")
        self.launches += 1
        return func(*args, **(kwargs or {}))


@pytest.fixture
def reads(device: str, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Grows by one with each read of a tensor on the host."""
    from recon.backends import torch_plan

    made: list[int] = []
    own = torch_plan.to_host

    def counted(tensor: Any) -> Any:
        made.append(tensor.numel())
        with waiting_allowed(device, True):
            return own(tensor)

    monkeypatch.setattr(torch_plan, "to_host", counted)
    return made


@contextmanager
def waiting_allowed(device: str, allowed: bool) -> Iterator[None]:
    """On CUDA: torch raises at a hidden wait, or not."""
    if device == "cpu":
        yield
        return
    before = torch.cuda.get_sync_debug_mode()
    torch.cuda.set_sync_debug_mode("default" if allowed else "error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode(before)


def watched(device: str, work: Callable[[], object]) -> list[str]:
    """The hidden waits of the second of two calls; the first builds and captures."""
    work()
    with waiting_allowed(device, False), Watch() as watch:
        work()
    assert device != "cpu" or watch.launches > 20
    found: list[str] = watch.waits
    return found


def texture(height: int, width: int) -> U8:
    """Noise of two scales."""
    rng = np.random.default_rng(0)
    image = sum(
        cv2.GaussianBlur(rng.normal(128, 40 * s, (height, width)), (0, 0), s) for s in (1, 3)
    )
    return np.asarray(np.clip(np.asarray(image) / 2, 0, 255), np.uint8)


K = np.array([[100.0, 0, 47.5], [0, 100.0, 26.5], [0, 0, 1]])


def test_a_keyframe_from_images_to_fused_depth(device: str, reads: list[int]) -> None:
    """Two pairs, one read of depth, sigma and views."""
    from recon.backends.torch_backend import TorchBackend

    left = texture(54, 96) if device == "cuda" else texture(12, 20)
    seen = np.ones(left.shape, np.bool_)
    pair = StereoPair(
        left=left, right=np.roll(left, -5, 1), baseline_m=4.0, K=K, labels=8,
        plane=np.array([0.0, 0.0, 8.0]), slope=1.0,
        R_left_keyframe=np.eye(3), guide=np.repeat(left[:, :, None], 3, 2), left_seen=seen,
        right_seen=seen,
    )  # fmt: skip
    config = BeliefPropagationConfig(iterations=1, levels=1, speckle_px=4)
    backend = TorchBackend(device)
    reads.clear()
    path = lambda: backend.fused_depth([pair] * 2, K, (96, 54), np.eye(4), config)  # noqa: E731
    assert watched(device, path) == []
    assert reads == [(4 + 4 + 1) * 96 * 54] * 2  # bytes


def test_a_registration(device: str, reads: list[int]) -> None:
    """All iterations of both levels, one read of a few numbers."""
    from recon.backends.torch_backend import TorchBackend

    v, u = np.mgrid[0:60, 0:90]
    z = (40 + np.sin(u / 9) * np.cos(v / 8)).astype(np.float32)
    depth = DepthMap(z, np.full(z.shape, 0.05, np.float32), np.ones(z.shape, np.uint8), K,
                     np.eye(4))  # fmt: skip
    backend = TorchBackend(device)
    reads.clear()
    config = IcpConfig() if device == "cuda" else IcpConfig(strides=(6, 3), iterations=(1, 1))
    assert watched(device, lambda: backend.register(depth, depth, np.eye(4), config)) == []
    assert len(reads) == 2 and max(reads) < 1600


def test_a_wait_would_be_seen(device: str) -> None:
    """A value read, a mask counted, an eigenvalue."""
    values = torch.arange(12.0, device=device).view(3, 4)
    for work in (
        lambda: float(values[0, 0]), lambda: values[values > 3],
        lambda: torch.nonzero(values), lambda: torch.linalg.eigh(values @ values.T),
    ):  # fmt: skip
        if device == "cpu":
            with Watch() as watch:
                work()
            assert watch.waits
        else:
            work()
            with pytest.raises(RuntimeError), waiting_allowed(device, False):
                work()
