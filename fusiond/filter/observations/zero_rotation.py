"""Zero rotation: the vehicle stands, so the gyro reads its bias and the Earth's rotation alone."""

from __future__ import annotations

import math

import numpy as np

from fusiond.config.schema import Motion
from fusiond.filter.observations.model import PARAMETERS, Observation, mat_eb
from fusiond.filter.state import ATTITUDE, GYRO_BIAS, GYRO_BIAS_B, RATE_B, FilterState
from fusiond.filter.strapdown import EARTH_RATE_E
from fusiond.maths.portable import square
from fusiond.maths.rotation import skew
from fusiond.maths.wgs84 import Array

VARIANCE = 0  # (rad/s)^2, parameters


def parameters(motion: Motion) -> Array:
    row = np.zeros(PARAMETERS)
    row[VARIANCE] = square(math.radians(motion.zero_rotation_sigma_deg_s))
    return row


def observe(state: FilterState, row: Array, parameter: Array) -> Observation:
    """Innovation (3,) [rad/s], body axes. There are no values."""
    rotation = mat_eb(state)
    jacobian = np.zeros((3, state.size))
    jacobian[:, GYRO_BIAS] = np.eye(3)
    jacobian[:, ATTITUDE] = rotation.T @ skew(EARTH_RATE_E)
    innovation = state.auxiliary[RATE_B] - state.nominal[GYRO_BIAS_B] - rotation.T @ EARTH_RATE_E
    return Observation(innovation, jacobian, np.full(3, parameter[VARIANCE]))
