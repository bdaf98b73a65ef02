"""The types of functions that run compiled as well as interpreted, and their mark.

A function marked `@compiled` is plain Python on NumPy arrays. `tools/translate_kernel` makes the compiled kernel's source
of it, by the types of its parameters; what may stand in it is said there.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Vector = Array  # (k,), of whatever length
Vector3 = Array  # (3,)
Quaternion = Array  # (4,), w, x, y, z
Matrix3 = Array  # (3, 3)
StateN = Array  # (91,), see fusiond.filter.north_east_down
ErrorVector = Array  # (n,), n error states
ErrorRows3 = Array  # (3, n): room for the rows of up to three axes
ErrorRows6 = Array  # (6, n)
ErrorRows9 = Array  # (9, n)
Covariance = Array  # (n, n), symmetric
Transition = Array  # (n, n), what an error becomes
Stamps = NDArray[np.int64]  # (k,), ns or counts

Any_ = TypeVar("Any_", bound=Callable[..., object])


def compiled(function: Any_) -> Any_:
    """Marks a function that is translated into the compiled kernel."""
    return function


def primitive(function: Any_) -> Any_:
    """Marks one that the compiled kernel calls, but that is written there by hand, in kernel/primitives.pxi."""
    return function
