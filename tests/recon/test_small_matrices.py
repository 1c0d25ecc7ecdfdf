"""Small symmetric systems against LAPACK."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from recon.small_matrices import invert_3x3, solve_symmetric
from recon.types import F64


def positive(rng: np.random.Generator, n: int) -> F64:
    """A positive definite matrix whose condition number is about a thousand."""
    turn = np.linalg.qr(rng.normal(size=(n, n)))[0]
    return np.asarray(turn @ np.diag(np.geomspace(1.0, 1e3, n)) @ turn.T)


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.integers(1, 24), st.integers(1, 3))
def test_solutions_are_those_of_lapack(seed: int, n: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    A, b = positive(rng, n), rng.normal(size=(n, m))
    x = b.copy()
    assert solve_symmetric(np.tril(A), x)
    assert np.allclose(x, np.linalg.solve(A, b), rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("A", [np.diag([1.0, -1.0]), np.zeros((2, 2)), np.full((2, 2), np.nan)])
def test_what_is_not_positive_definite_is_refused(A: F64) -> None:
    assert not solve_symmetric(A.copy(), np.ones((2, 1)))


@njit(fastmath=True)
def _relaxed(A: F64, b: F64) -> bool:
    return bool(solve_symmetric(A, b))


@pytest.mark.parametrize("solve", [_relaxed, solve_symmetric])
def test_nan_is_refused_also_below_a_kernel_that_ignores_it(
    solve: Callable[[F64, F64], bool],
) -> None:
    assert not solve(np.full((2, 2), np.nan), np.ones((2, 1)))


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_inverses_of_three_by_three(seed: int) -> None:
    A = positive(np.random.default_rng(seed), 3)
    out = np.zeros((3, 3))
    invert_3x3(A, out)
    assert np.allclose(out @ A, np.eye(3), atol=1e-9)
