"""The car's own accelerometer across it: the centripetal acceleration of the middle of its unsteered axle, which is its
speed times its turn rate, and the part of gravity that a banked road leaves.

It says little beside an inertial sensor, but holds the turn rate while that is silent."""

from __future__ import annotations

import numpy as np

from fusiond.config.car import LateralAccelerometer
from fusiond.events import LateralAcceleration
from fusiond.filter.observations.model import (
    LEVER_ARM_B,
    UNWEIGHTED,
    Observation,
    begin,
    empty_row,
    mat_eb,
    mean_rate_b,
    point_velocity_v,
    rate_b,
    right_b,
    skew_rows,
    turn_by_mount,
    vertical_b,
    with_rate_noise,
    within,
)
from fusiond.filter.state import ATTITUDE, GYRO_BIAS, MOUNT, MOUNT_ERROR, POSITION_E, FilterState
from fusiond.maths.portable import sin_cos, square
from fusiond.maths.rotation import inner, times, transposed_times
from fusiond.maths.typed import Array, Vector, compiled
from fusiond.maths.wgs84 import gravity_e

FORCE, VARIANCE = 0, 1  # m/s^2, (m/s^2)^2: values
MIN_SPEED = 5  # m/s, parameters
FORCE_LIMIT = 160.0  # m/s^2


def parameters(sensor: LateralAccelerometer) -> Array:
    row = empty_row()
    row[MIN_SPEED] = sensor.minimum_speed_mps
    return row


def values(reading: LateralAcceleration, sensor: LateralAccelerometer) -> tuple[float, ...]:
    """Specific force to the right [m/s^2] and its variance: road, body roll, offset and rounding. Raises Unusable."""
    within((reading.specific_force,), FORCE_LIMIT, "impossible acceleration")
    return reading.specific_force, square(sensor.sigma_mps2) + square(sensor.quantum_mps2) / 12


@compiled
def observe(state: FilterState, row: Vector, parameter: Vector, seen: Observation) -> bool:
    """Innovation (1,) [m/s^2], to the right; below the least speed of no weight."""
    begin(seen, 1)
    by = np.empty((3, state.size))
    velocity_v = point_velocity_v(state, parameter[LEVER_ARM_B], 1, by)
    speed = velocity_v[0]
    if abs(speed) < parameter[MIN_SPEED]:
        seen.innovation[0], seen.variance[0] = 0.0, UNWEIGHTED
        return True
    axis_b, across_b = vertical_b(state), right_b(state)
    turn, mean = inner(axis_b, rate_b(state)), inner(axis_b, mean_rate_b(state))
    down_e = gravity_e(state.nominal[POSITION_E])
    down_b = transposed_times(mat_eb(state), down_e)
    across_e = times(mat_eb(state), across_b)
    for k in range(state.size):
        seen.jacobian[0, k] = mean * by[0, k]
    leaning = np.zeros((3, 3))
    leaning[0] = across_e
    tilted = np.zeros((3, state.size))
    skew_rows(leaning, down_e, -1.0, 1, tilted, ATTITUDE.start)
    for i in range(3):
        seen.jacobian[0, ATTITUDE.start + i] += tilted[0, ATTITUDE.start + i]
        seen.jacobian[0, GYRO_BIAS.start + i] -= speed * axis_b[i]
    seen.jacobian[0, MOUNT_ERROR.start] += speed * turn_by_mount(state)
    sp, cp = sin_cos(state.nominal[MOUNT.start])
    sy, cy = sin_cos(state.nominal[MOUNT.start + 1])
    seen.jacobian[0, MOUNT_ERROR.start] -= sy * (cp * down_b[2] - sp * down_b[0])
    seen.jacobian[0, MOUNT_ERROR.start + 1] -= cy * (cp * down_b[0] + sp * down_b[2]) - sy * down_b[1]
    seen.innovation[0] = row[FORCE] - speed * turn + inner(across_b, down_b)
    seen.variance[0] = row[VARIANCE]
    with_rate_noise(state, seen)
    return True
