"""Small linear algebra in plain operations: no library call that waits, any device captures it."""

from __future__ import annotations

import torch
from torch import Tensor

MEDIAN_OF = 4000
"""About so many residuals give the scale of all."""


def solve(A: Tensor, B: Tensor) -> Tensor:
    """X (n, k) with ``A X = B``, A (n, n) symmetric and positive definite; Gauss and Jordan.

    No pivot is looked for, as none is needed for such a matrix; what is not positive definite
    gives numbers without a meaning, never an error.
    """
    n = A.shape[0]
    rows = torch.cat([A, B], 1)
    unit = torch.eye(n, dtype=A.dtype, device=A.device)
    for k in range(n):
        pivot = rows[k] / rows[k, k]
        rows = rows - (rows[:, k, None] - unit[:, k, None]) * pivot
    return rows[:, n:]


def median(values: Tensor, chosen: Tensor) -> Tensor:
    """() mean of the two middle values of those ``chosen`` (N,); the largest float if none is."""
    far = torch.finfo(values.dtype).max
    ordered = torch.where(chosen, values, far).sort().values
    count = chosen.sum()
    middle = torch.stack([(count - 1).clamp(min=0) // 2, count // 2])
    return ordered.gather(0, middle.clamp(max=len(values) - 1)).mean()


def scale_of(residual: Tensor, found: Tensor) -> Tensor:
    """() standard deviation of the residuals (N,) that are ``found``, by their median."""
    every = max(len(residual) // MEDIAN_OF, 1)
    middle = median(residual[::every].abs(), found[::every] > 0)
    return (middle / 0.6745).clamp(min=1e-3)
