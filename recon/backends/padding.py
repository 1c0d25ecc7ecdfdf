"""Sizes of arrays that hold the pairs of a flight, so that few shapes occur.

Rectified pairs differ by a few pixels and labels from each other. A backend that builds
something for each shape (a CUDA graph, an ONNX session, a TensorRT engine) would build it again for
almost every pair; here sizes are rounded up, and the true ones go along as numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from recon.stereo.belief_propagation import BeliefPropagationConfig
from recon.types import Array

PAD_PX, PAD_LABELS = 32, 8

Key = TypeVar("Key")
Built = TypeVar("Built")


def kept(cache: dict[Key, Built], key: Key, limit: int, build: Callable[[], Built]) -> Built:
    """The entry of ``cache`` for ``key``, built when new; beyond ``limit`` the oldest go."""
    if key not in cache:
        while len(cache) >= limit:
            cache.pop(next(iter(cache)))
        cache[key] = build()
    return cache[key]


def padded(height: int, width: int, labels: int) -> tuple[int, int, int]:
    """Height, width and labels of arrays that hold such a pair."""
    h, w = (-(-n // PAD_PX) * PAD_PX for n in (height, width))
    return h, w, -(-labels // PAD_LABELS) * PAD_LABELS


def pyramid_levels(height: int, width: int, config: BeliefPropagationConfig) -> int:
    """How many levels belief propagation takes on a pair of this size."""
    levels, least = 1, min(height, width)
    while levels < config.levels and least >= 8:
        levels, least = levels + 1, (least + 1) // 2
    return levels


def place(view: Array, array: Array) -> None:
    """Fill ``view`` with ``array``, continued by its last row and column."""
    if view.shape == array.shape:
        view[...] = array
        return
    h, w = array.shape[:2]
    view[:h, :w] = array
    view[:h, w:] = view[:h, w - 1 : w]
    view[h:] = view[h - 1 : h]
