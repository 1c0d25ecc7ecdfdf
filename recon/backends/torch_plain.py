"""Belief propagation in plain torch operations, where torch has no CUDA device.

The twin of the compiled and of the Triton kernels: the same integers, on any machine, many times
slower. Upsampling, depth and ICP are the compiled ones.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from recon.backends import Backend
from recon.backends.cpu import CpuBackend
from recon.backends.exported_stereo import FAR, edge_weights, matching_cost, propagate, select
from recon.backends.padding import pyramid_levels
from recon.stereo.belief_propagation import (
    NOISE,
    RADIUS,
    SURE_EVIDENCE,
    BeliefPropagationConfig,
    drop_unreliable,
)
from recon.stereo.brightness_transfer import match_brightness
from recon.stereo.matching_cost import check_pair
from recon.types import F32, U8, DisparityMap


def open_torch() -> Backend:
    """The Triton kernels where there is a CUDA device, else the plain operations."""
    if not torch.cuda.is_available():
        return PlainTorchBackend()
    from recon.backends.torch_backend import TorchBackend

    return TorchBackend()


class PlainTorchBackend(CpuBackend):
    """Stereo by torch on the processor, the rest by the compiled kernels."""

    name = "torch"

    def belief_propagation(
        self, left: U8, right: U8, labels: int, config: BeliefPropagationConfig
    ) -> DisparityMap:
        check_pair(left, right, labels)
        right = match_brightness(left, right, labels, config.min_disparity)
        with torch.inference_mode():
            a, b = (torch.from_numpy(np.ascontiguousarray(i)).float() for i in (left, right))
            cost = matching_cost(a, b, labels, config)
            levels = pyramid_levels(left.shape[0], left.shape[1], config)
            belief = propagate(cost, edge_weights(a, config), levels, config)
            px, sure = select(belief, cost, config), confidence(belief, cost, config)
        return drop_unreliable(left, _array(px), _array(sure), config)


def _array(image: Tensor) -> F32:
    return np.asarray(image.numpy(), np.float32)


def confidence(belief: Tensor, cost: Tensor, config: BeliefPropagationConfig) -> Tensor:
    """(h, w) how sure each winner is, 0 to 1, as :func:`recon.stereo.belief_propagation.select`."""
    labels, _, width = cost.shape
    window = 2 * RADIUS + 1
    box = torch.round(
        torch.nn.functional.avg_pool2d(cost[None], window, 1, RADIUS)[0] * window * window
    )
    partner = torch.arange(width)[None] - torch.arange(labels)[:, None] - config.min_disparity
    seen = ((partner >= 0) & (partner < width)).float()[:, None]
    mean = (box * seen).sum(0) / seen.sum(0).clamp(min=1)
    best = belief.argmin(0)
    is_adjacent = (torch.arange(labels)[:, None, None] - best).abs() <= 1
    others = torch.where(is_adjacent, belief + FAR, belief)
    lead = others.amin(0) - belief.amin(0)
    here = box.gather(0, best[None])[0]
    evidence = (mean - here) / (mean + window * window * NOISE)
    enough = (lead > 0) & ((evidence >= config.min_evidence) | (config.min_evidence <= 0))
    visible = seen[:, 0].gather(0, best) > 0
    margin = (lead / (2 * config.truncation)).clamp(max=1)
    sure = margin * (evidence.clamp(min=0.01) / SURE_EVIDENCE).clamp(max=1)
    return torch.where(visible & enough, sure, torch.zeros_like(sure))
