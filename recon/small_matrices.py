"""Small symmetric systems inside compiled kernels.

NumPy's own ``solve``, ``inv`` and ``@`` in a kernel call LAPACK and BLAS, and make the compiler
build their error messages as well: seconds at the first start, for matrices of a few rows.

A kernel without a ``fastmath`` of its own takes that of the kernel that is the first to call it,
and then misses NaN: these have one.
"""

from __future__ import annotations

from typing import Any

from numba import njit


@njit(cache=True, nogil=True, fastmath=False)
def solve_symmetric(A: Any, b: Any) -> bool:
    """Solve A x = b in place; True where A is positive definite.

    ``A`` (n, n) is read in its lower half, which its factors L D L^T replace; ``b`` (n, m) becomes
    x. Golub and Van Loan, Matrix Computations, section 4.1.
    """
    n = A.shape[0]
    for j in range(n):
        for k in range(j):
            A[j, j] -= A[j, k] * A[j, k] * A[k, k]
        if not A[j, j] > 0.0:
            return False
        for i in range(j + 1, n):
            s = A[i, j]
            for k in range(j):
                s -= A[i, k] * A[j, k] * A[k, k]
            A[i, j] = s / A[j, j]
    for c in range(b.shape[1]):
        for i in range(n):
            for k in range(i):
                b[i, c] -= A[i, k] * b[k, c]
        for i in range(n):
            b[i, c] /= A[i, i]
        for i in range(n - 1, -1, -1):
            for k in range(i + 1, n):
                b[i, c] -= A[k, i] * b[k, c]
    return True


@njit(cache=True, nogil=True, fastmath=False)
def invert_3x3(A: Any, out: Any) -> None:
    """Fill ``out`` with the inverse of the symmetric ``A`` (3, 3), by its cofactors."""
    a, b, c = A[0, 0], A[0, 1], A[0, 2]
    d, e, f = A[1, 1], A[1, 2], A[2, 2]
    out[0, 0], out[0, 1], out[0, 2] = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * out[0, 0] + b * out[0, 1] + c * out[0, 2]
    out[1, 1], out[1, 2], out[2, 2] = a * f - c * c, b * c - a * e, a * d - b * b
    for i in range(3):
        for j in range(i, 3):
            out[i, j] /= det
            out[j, i] = out[i, j]
