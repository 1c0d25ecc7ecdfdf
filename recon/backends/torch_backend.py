"""The heavy operations in torch, on CUDA where there is a device, else on the processor."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from recon.backends.torch_dense import DenseStereo, JointBilateral
from recon.belief_propagation import BeliefPropagationConfig, believe
from recon.matching_cost import check_pair
from recon.types import F64, U8, Array, DepthMap, DisparityMap, Registration
from recon.upsampling import UpsamplingConfig, check_guide, guide_at_taps, upsample

if TYPE_CHECKING:
    from recon.registration import IcpConfig

log = logging.getLogger(__name__)

KEPT_PLANS = 8
"""Shapes whose buffers (and CUDA graph) are kept."""


@dataclass(slots=True, eq=False)
class _Plan:
    """One operation at fixed shapes: static inputs on the device, and how to run it."""

    inputs: tuple[torch.Tensor, ...]
    outputs: tuple[torch.Tensor, ...]
    replay: Callable[[], object] | None  # None: call ``module`` anew
    module: Any


class TorchBackend:
    """``device`` is "cuda" when torch has one, else "cpu"; RuntimeError when it cannot compute.

    On CUDA an operation is captured once per shape as a graph; a call then uploads, replays
    and waits once, for its result. One backend serves one thread at a time.
    """

    name = "torch"

    def __init__(self, device: str | None = None) -> None:
        self.device = device or ("cuda" if torch.cuda.is_available() else "cpu")
        self._plans: dict[Any, _Plan] = {}
        torch.zeros(8, device=self.device).add_(1).cpu()  # fails here rather than in flight

    def belief_propagation(
        self, left: U8, right: U8, labels: int, config: BeliefPropagationConfig
    ) -> DisparityMap:
        """Labels of the left view, (h, w); Eq. 1."""
        check_pair(left, right, labels)
        px, confidence = self._run(
            ("stereo", left.shape, labels, config),
            lambda: DenseStereo(labels, config),
            (left, right),
        )
        return believe(left, px, confidence, config)

    def upsample(self, coarse: DisparityMap, guide: U8, config: UpsamplingConfig) -> DisparityMap:
        """``coarse`` (h, w) at the size of ``guide`` (H, W, 3), values unscaled; Eq. 2."""
        check_guide(coarse, guide)
        if config.method != "bilateral":
            return upsample(coarse, guide, config)
        shape = (coarse.px.shape[0], coarse.px.shape[1])
        size = (guide.shape[0], guide.shape[1])
        px, confidence = self._run(
            ("upsample", shape, size, config),
            lambda: JointBilateral(shape, size, config),
            (coarse.px, coarse.confidence, guide_at_taps(guide, shape), guide),
        )
        return DisparityMap(px, confidence)

    def register(
        self, source: DepthMap, target: DepthMap, T_target_source: F64, config: IcpConfig
    ) -> Registration:
        """Projective point-to-plane ICP from the given start."""
        from recon.backends.torch_icp import register_projective

        return register_projective(source, target, T_target_source, config, self.device)

    def _run(
        self, key: Any, build: Callable[[], torch.nn.Module], arrays: tuple[Array, ...]
    ) -> tuple[Array, Array]:
        """Two float32 results of the operation called ``key`` on ``arrays``."""
        with torch.inference_mode():
            if key not in self._plans:
                while len(self._plans) >= KEPT_PLANS:
                    self._plans.pop(next(iter(self._plans)))
                self._plans[key] = self._plan(build().to(self.device), arrays)
            plan = self._plans[key]
            for tensor, array in zip(plan.inputs, arrays, strict=True):
                tensor.copy_(torch.from_numpy(np.ascontiguousarray(array)), non_blocking=True)
            if plan.replay is not None:
                plan.replay()
                outputs = plan.outputs
            else:
                outputs = plan.module(*plan.inputs)
            first, second = (tensor.cpu().numpy() for tensor in outputs)
            return first.copy(), second.copy()

    def _plan(self, module: torch.nn.Module, arrays: tuple[Array, ...]) -> _Plan:
        inputs = tuple(torch.zeros(a.shape, device=self.device) for a in arrays)
        if self.device != "cuda":
            return _Plan(inputs, (), None, module)
        stream: Any = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):  # capture needs kernels that are loaded already
            for _ in range(2):
                module(*inputs)
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            outputs = module(*inputs)
        log.debug("captured a CUDA graph for shapes %s", [a.shape for a in arrays])
        return _Plan(inputs, tuple(outputs), graph.replay, module)
