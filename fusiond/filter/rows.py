"""Events as rows of one table: what the filter works on, and the outcome of each."""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusiond.filter.observations.model import VALUES


class Outcome(IntEnum):
    """The outcome of an event. FUSED: taken into the state. REJECTED: stopped by the innovation gate. TOO_OLD: stamped
    before the horizon. DUPLICATE: a second event of a source at one instant. INVALID: declared unusable by its protocol,
    not finite, or out of bounds. WAITING: stamped after the newest IMU sample. GATHERED: taken to align, or into
    hypotheses of the heading, when there was no state yet."""

    FUSED = 0
    REJECTED = 1
    TOO_OLD = 2
    DUPLICATE = 3
    INVALID = 4
    WAITING = 5
    GATHERED = 6


ROW = np.dtype(
    [
        ("t_ns", "i8"),
        ("sequence", "i8"),
        ("t_receive_ns", "i8"),
        ("source", "i4"),
        ("outcome", "i4"),
        ("ratio", "f8"),  # test ratio, 1 at the gate; 0 before it was judged
        ("values", "f8", (VALUES,)),
        ("innovation", "f8", (3,)),
        ("variance", "f8", (3,)),  # of the innovation, diagonal
    ]
)
Row = Any  # one row of a structured array
Rows = NDArray[Any]  # structured, of dtype ROW
