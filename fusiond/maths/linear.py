"""Linear algebra on arrays of the error state's size, in an order of operations that is the same everywhere."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from fusiond.maths.typed import Covariance, ErrorVector, compiled, primitive


@compiled
def dot(a: ErrorVector, b: ErrorVector) -> float:
    """Inner product, summed from the first element on."""
    total = 0.0
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


@primitive
def mirror(p: Covariance) -> None:
    """Make a matrix symmetric: its upper triangle decides."""
    lower = _lower_triangle(len(p))
    p[lower] = p.T[lower]


@cache
def _lower_triangle(n: int) -> tuple[NDArray[np.intp], ...]:
    """Indices of the elements below the diagonal of an n x n matrix."""
    return np.tril_indices(n, -1)
