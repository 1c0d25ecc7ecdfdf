"""The heavy operations on a CUDA device: Triton kernels, captured by torch as graphs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from recon.backends.padding import kept, padded, pyramid_levels
from recon.backends.torch_depth import DensePath, upsampled
from recon.backends.torch_plan import Plan, compiling, part, read
from recon.backends.triton_dense import contrast, stereo
from recon.stereo.belief_propagation import BeliefPropagationConfig, drop_unreliable
from recon.stereo.brightness_transfer import match_brightness
from recon.stereo.matching_cost import check_pair
from recon.stereo.upsampling import check_guide
from recon.types import F64, U8, Array, DepthMap, DisparityMap, Registration, StereoPair

if TYPE_CHECKING:
    from recon.backends.torch_icp import DeviceIcp
    from recon.mapping.registration import IcpConfig

KEPT_PLANS = 8  # shapes whose buffers (and CUDA graph) are kept


class TorchBackend:
    """An operation is captured once per shape as a graph; a call then uploads, replays and waits
    once, for its result. One backend serves one thread at a time.

    Raises RuntimeError where there is no CUDA device, or where a kernel cannot be compiled. With
    ``device`` "cpu" the kernels run in Triton's interpreter, as the tests do.
    """

    name = "torch"
    keeps_pairs = True

    def __init__(self, device: str = "cuda") -> None:
        if device == "cuda" and not torch.cuda.is_available():
            raise RuntimeError("torch finds no CUDA device; the processor's backend is cpu")
        self.device = device
        self._icp: DeviceIcp | None = None
        self._plans: dict[Any, Plan] = {}
        self._path: DensePath | None = None
        with compiling():  # fails here rather than in flight
            contrast(torch.zeros((8, 8), dtype=torch.uint8, device=device), 1).cpu()

    def belief_propagation(
        self, left: U8, right: U8, labels: int, config: BeliefPropagationConfig
    ) -> DisparityMap:
        check_pair(left, right, labels)
        right = match_brightness(left, right, labels, config.min_disparity)
        h, w = left.shape
        *space, label_count = padded(h, w, labels)
        levels = pyramid_levels(h, w, config)
        px, confidence = self._run(
            ("stereo", *space, label_count, levels, config),
            lambda a, b, true: stereo(a, b, label_count, levels, true, config),
            (space, space, (3,)),
            (left, right, np.array([h, w, labels])),
        )
        px, confidence = px[:h, :w].copy(), confidence[:h, :w].copy()
        return drop_unreliable(left, px, confidence, config)

    def upsample(self, coarse: DisparityMap, guide: U8) -> DisparityMap:
        check_guide(coarse, guide)
        (h, w), (H, W) = coarse.px.shape, guide.shape[:2]
        small, large = padded(h, w, 1)[:2], padded(H, W, 1)[:2]
        px, confidence = self._run(
            ("upsample", *small, *large),
            upsampled,
            (small, small, (*large, 3), (4,)),
            (coarse.px, coarse.confidence, guide, np.array([h, w, H, W])),
        )
        return DisparityMap(px[:H, :W].copy(), confidence[:H, :W].copy())

    def register(
        self, source: DepthMap, target: DepthMap, T_target_source: F64, config: IcpConfig
    ) -> Registration:
        from recon.backends.torch_icp import DeviceIcp

        if self._icp is None:
            self._icp = DeviceIcp(self.device)
        return self._icp.register(source, target, T_target_source, config)

    def fused_depth(
        self,
        pairs: Sequence[StereoPair],
        K: F64,
        size_px: tuple[int, int],
        T_world_camera: F64,
        config: BeliefPropagationConfig,
    ) -> DepthMap:
        if self._path is None or self._path.matching != config:
            self._path = DensePath(self.device, config)
        return self._path.depth(pairs, K, size_px, T_world_camera)

    def _run(
        self,
        key: Any,
        operation: Callable[..., tuple[Tensor, ...]],
        shapes: Sequence[Sequence[int]],
        arrays: Sequence[Array],
    ) -> list[Array]:
        """The float32 results of the ``operation`` called ``key`` on ``arrays`` padded to these
        ``shapes``."""
        parts = [part(a, tuple(shape)) for a, shape in zip(arrays, shapes, strict=True)]
        with torch.inference_mode():
            plan = kept(self._plans, key, KEPT_PLANS, lambda: Plan(self.device, operation, parts))
            plan.upload(arrays)
            return read(plan.run())
