"""Zero velocity: the vehicle stands, so its velocity over ground is nothing in every axis; but for creeping, which wheels
below `still_wheel_mps` do not tell."""

from __future__ import annotations

from fusiond.config.schema import Motion
from fusiond.filter.observations.model import Observation, begin, empty_row
from fusiond.filter.state import VELOCITY, VELOCITY_E, FilterState
from fusiond.maths.portable import square
from fusiond.maths.typed import Array, Vector, compiled

VARIANCE = 0  # (m/s)^2, parameters


def parameters(motion: Motion) -> Array:
    row = empty_row()
    row[VARIANCE] = square(motion.zero_velocity_sigma_mps) + square(motion.still_wheel_mps) / 3
    return row


@compiled
def observe(state: FilterState, row: Vector, parameter: Vector, seen: Observation) -> bool:
    """Innovation (3,) [m/s], earth-fixed axes. There are no values."""
    begin(seen, 3)
    for i in range(3):
        seen.jacobian[i, VELOCITY.start + i] = 1.0
        seen.innovation[i] = -state.nominal[VELOCITY_E.start + i]
        seen.variance[i] = parameter[VARIANCE]
    return True
