"""Zero velocity: the vehicle stands, so its velocity over ground is nothing in every axis; but for creeping, which wheels
below `still_wheel_mps` do not tell."""

from __future__ import annotations

import numpy as np

from fusiond.config.schema import Motion
from fusiond.filter.observations.model import PARAMETERS, Observation
from fusiond.filter.state import VELOCITY, VELOCITY_E, FilterState
from fusiond.maths.portable import square
from fusiond.maths.wgs84 import Array

VARIANCE = 0  # (m/s)^2, parameters


def parameters(motion: Motion) -> Array:
    row = np.zeros(PARAMETERS)
    row[VARIANCE] = square(motion.zero_velocity_sigma_mps) + square(motion.still_wheel_mps) / 3
    return row


def observe(state: FilterState, row: Array, parameter: Array) -> Observation:
    """Innovation (3,) [m/s], earth-fixed axes. There are no values."""
    jacobian = np.zeros((3, state.size))
    jacobian[:, VELOCITY] = np.eye(3)
    return Observation(-state.nominal[VELOCITY_E], jacobian, np.full(3, parameter[VARIANCE]))
