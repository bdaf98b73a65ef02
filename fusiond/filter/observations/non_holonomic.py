"""The non-holonomic constraint: wheels let the vehicle move neither sideways nor up and down at the unsteered axle.
Dissanayake et al. (2001), here with the mount misalignment of the IMU."""

from __future__ import annotations

import numpy as np

from fusiond.config.schema import Motion
from fusiond.filter.observations.model import LEVER_ARM_B, PARAMETERS, Observation, point_velocity_v
from fusiond.filter.state import FilterState
from fusiond.maths.portable import square
from fusiond.maths.wgs84 import Array

LATERAL_VARIANCE, VERTICAL_VARIANCE = 3, 4  # (m/s)^2, parameters
LEAST_SPEED = 5  # m/s, parameters


def parameters(motion: Motion) -> Array:
    row = np.zeros(PARAMETERS)
    row[LEVER_ARM_B] = motion.point_m
    row[LATERAL_VARIANCE] = square(motion.lateral_sigma_mps)
    row[VERTICAL_VARIANCE] = square(motion.vertical_sigma_mps)
    row[LEAST_SPEED] = motion.minimum_speed_mps
    return row


def observe(state: FilterState, row: Array, parameter: Array) -> Observation | None:
    """Innovation (2,) [m/s], vehicle axes right and down; None below the least speed. There are no values."""
    velocity_v, by_error = point_velocity_v(state, parameter[LEVER_ARM_B])
    if abs(velocity_v[0]) < parameter[LEAST_SPEED]:
        return None
    variance = np.array([parameter[LATERAL_VARIANCE], parameter[VERTICAL_VARIANCE]])
    return Observation(-velocity_v[1:], by_error[1:], variance)
