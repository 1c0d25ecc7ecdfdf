"""Joint bilateral upsampling (Eq. 2) as one Triton kernel: every tap, all sums in registers.

Floor of a guide of H x W px: 3 bytes read and 8 written a pixel, 11 H W bytes (45 MB at
2704x1520); 20 operations, one of them a power of two, for each of the D x D taps of a pixel
(D = 10: 8.2 G operations). The coarse layers, 20 bytes a tap, and the two tables stay in the
caches. Plain torch writes some 50 floats a tap and pixel instead.
"""

# mypy: allow-untyped-defs, allow-incomplete-defs
# Triton reads annotations of a kernel as values of its own, so its arguments have none.
from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from recon.backends.torch_upsampling import tap_layers, window
from recon.stereo.upsampling import RANGE_FLOOR, UpsamplingConfig

ROWS, COLUMNS = 4, 64
"""Fine pixels of one program."""

LOG2_E = 1 / math.log(2)


def bilateral(
    px: Tensor, confidence: Tensor, taps: Tensor, guide: Tensor, true: Tensor,
    config: UpsamplingConfig,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """As :meth:`recon.backends.torch_upsampling.JointBilateral.forward`."""
    h, w = px.shape
    height, width, _ = guide.shape
    scale = math.sqrt(0.5 * LOG2_E) / config.range_sigma
    layers = tap_layers(px, confidence, taps)[:5].contiguous()
    layers[:3] *= scale
    rows, log_y = window(h, height, true[0], true[2], config)
    columns, log_x = window(w, width, true[1], true[3], config)
    out, sure = torch.empty((2, height, width), device=px.device)
    grid = (triton.cdiv(height, ROWS), triton.cdiv(width, COLUMNS))
    _bilateral[grid](
        layers, guide.contiguous(), rows.int(), log_y * LOG2_E, columns.int(), log_x * LOG2_E,
        out, sure, height, width, w, h * w, scale, RANGE_FLOOR, config.min_support,
        config.diameter_px, ROWS, COLUMNS,
    )  # fmt: skip
    return out, sure


@triton.jit(do_not_specialize=["height", "width", "pitch", "plane"])
def _bilateral(
    layers, guide, rows, log_y, columns, log_x, out, sure,
    height, width, pitch, plane, scale, floor, support,
    diameter: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """A tile of fine pixels; ``layers`` are three colours, trust, trust times label."""
    v = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    u = tl.program_id(1) * COLUMNS + tl.arange(0, COLUMNS)
    tall, wide = v < height, u < width
    here = tall[:, None] & wide[None, :]
    at = v[:, None] * width + u[None, :]
    b = tl.load(guide + 3 * at, mask=here, other=0).to(tl.float32) * scale
    g = tl.load(guide + 3 * at + 1, mask=here, other=0).to(tl.float32) * scale
    r = tl.load(guide + 3 * at + 2, mask=here, other=0).to(tl.float32) * scale
    everything = tl.full((ROWS, COLUMNS), 0.0, tl.float32)
    known, trusted, value = everything, everything, everything
    for j in range(diameter):
        row = tl.load(rows + j * height + v, mask=tall, other=0) * pitch
        near_y = tl.load(log_y + j * height + v, mask=tall, other=0.0)
        for i in range(diameter):
            column = tl.load(columns + i * width + u, mask=wide, other=0)
            near_x = tl.load(log_x + i * width + u, mask=wide, other=0.0)
            tap = layers + row[:, None] + column[None, :]
            db = b - tl.load(tap)
            dg = g - tl.load(tap + plane)
            dr = r - tl.load(tap + 2 * plane)
            trust = tl.load(tap + 3 * plane)
            tonal = tl.maximum(-(db * db + dg * dg + dr * dr), floor)
            weight = tl.exp2(tonal + near_y[:, None] + near_x[None, :])
            everything += weight
            known += tl.where(trust > 0, weight, 0.0)
            trusted += weight * trust
            value += weight * tl.load(tap + 4 * plane)
    good = known > support * everything
    label = tl.where(good, value / tl.where(good, trusted, 1.0), float("nan"))
    tl.store(out + at, label, mask=here)
    tl.store(sure + at, tl.where(good, trusted / everything, 0.0), mask=here)
