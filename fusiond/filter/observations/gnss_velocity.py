"""GNSS velocity: the antenna's velocity over ground, through the lever arm. Groves (2013), equation 14.103."""

from __future__ import annotations

import math

from fusiond.config.schema import Gnss, calibrated
from fusiond.events import GnssVelocity
from fusiond.filter.observations.model import (
    CALIBRATED,
    LEVER_ARM_B,
    RESETS,
    SPEED_LIMIT,
    STAMP_ERROR,
    Observation,
    acceleration_e,
    begin,
    empty_row,
    mat_eb,
    mean_rate_b,
    rate_b,
    skew_rows,
    within,
)
from fusiond.filter.state import (
    ACCEL_BIAS,
    ACCEL_BIAS_B,
    ANTENNA_B,
    ANTENNA_ERROR,
    ATTITUDE,
    DELAYS,
    DELAYS_ERROR,
    GYRO_BIAS,
    POSITION_E,
    SMOOTH_FORCE_B,
    VELOCITY,
    VELOCITY_E,
    FilterState,
)
from fusiond.maths.portable import square
from fusiond.maths.rotation import cross, matrix_product, times
from fusiond.maths.typed import Array, Matrix3, Vector, Vector3, compiled
from fusiond.maths.wgs84 import EARTH_RATE, gravity_e, mat_ne

VELOCITY_N = slice(0, 3)  # m/s, values
VARIANCE = 3  # (m/s)^2, values
AXES = 4  # values: 3, or 2 where the receiver gives no vertical speed


def parameters(gnss: Gnss) -> Array:
    row = empty_row()
    row[LEVER_ARM_B] = gnss.lever_arm_m
    row[CALIBRATED] = float(calibrated(gnss))
    row[RESETS] = VELOCITY.start
    return row


def values(velocity: GnssVelocity, gnss: Gnss) -> tuple[float, ...]:
    """Velocity (3,) north-east-down [m/s], variance per axis, number of axes given. Raises Unusable."""
    within((velocity.north, velocity.east, velocity.down or 0.0), SPEED_LIMIT, "impossible speed")
    variance = square(max(velocity.sigma or 0.0, gnss.velocity_sigma_mps))
    if velocity.down is None:
        return velocity.north, velocity.east, 0.0, variance, 2.0
    return velocity.north, velocity.east, velocity.down, variance, 3.0


@compiled
def lowest_speed(row: Vector) -> float:
    """The lowest horizontal speed [m/s] that a reading leaves possible: three sigmas below it."""
    return math.sqrt(row[0] * row[0] + row[1] * row[1]) - 3 * math.sqrt(row[VARIANCE])


@compiled
def observe(state: FilterState, row: Vector, parameter: Vector, seen: Observation) -> bool:
    """Innovation (2,) or (3,) [m/s], north-east(-down). A delay that is a state takes the velocity back along the
    acceleration; what the lever arm swings is taken as constant over it."""
    x = state.nominal
    axes = int(row[AXES])
    to_n = mat_ne(x[POSITION_E])
    rotation = mat_eb(state)
    arm_b = parameter[LEVER_ARM_B].copy()
    if parameter[CALIBRATED] != 0.0:
        arm_b += x[ANTENNA_B]
    swing_e = times(rotation, cross(rate_b(state), arm_b))
    turned = matrix_product(to_n, rotation)
    begin(seen, axes)
    for i in range(axes):
        seen.jacobian[i, VELOCITY] = to_n[i]
    if parameter[CALIBRATED] != 0.0:
        swing_e -= _gained(state, to_n, turned, seen)
    for i in range(axes):
        seen.jacobian[i, ATTITUDE.start] += -1.0 * (to_n[i, 1] * swing_e[2] - to_n[i, 2] * swing_e[1])
        seen.jacobian[i, ATTITUDE.start + 1] += -1.0 * (to_n[i, 2] * swing_e[0] - to_n[i, 0] * swing_e[2])
        seen.jacobian[i, ATTITUDE.start + 2] += -1.0 * (to_n[i, 0] * swing_e[1] - to_n[i, 1] * swing_e[0])
    skew_rows(turned, arm_b, 1.0, axes, seen.jacobian, GYRO_BIAS.start)
    predicted_n = times(to_n, x[VELOCITY_E] + swing_e)
    for i in range(axes):
        seen.innovation[i] = row[i] - predicted_n[i]
        seen.variance[i] = row[VARIANCE]
    if row[STAMP_ERROR] > 0:
        seen.common[:] = times(to_n, acceleration_e(state)) * row[STAMP_ERROR]
    return True


@compiled
def _gained(state: FilterState, to_n: Matrix3, turned: Matrix3, seen: Observation) -> Vector3:
    """The velocity (3,) [m/s, e axes] that was gained since the delay began; fills the jacobian's columns of lever arm,
    delays, velocity and accelerometer bias, and what of the attitude's does not turn with the specific force."""
    x = state.nominal
    delay = x[DELAYS.start] + x[DELAYS.start + 1]
    force_e = times(mat_eb(state), state.auxiliary[SMOOTH_FORCE_B] - x[ACCEL_BIAS_B])
    rest_e = gravity_e(x[POSITION_E])  # less 2 omega_ie x v, with omega_ie along z
    rest_e[0] += 2 * EARTH_RATE * x[VELOCITY_E.start + 1]
    rest_e[1] -= 2 * EARTH_RATE * x[VELOCITY_E.start]
    skew_rows(turned, mean_rate_b(state), 1.0, seen.m, seen.jacobian, ANTENNA_ERROR.start)
    skew_rows(to_n, rest_e, -delay, seen.m, seen.jacobian, ATTITUDE.start)
    for i in range(seen.m):
        along = 0.0
        for j in range(3):
            along += to_n[i, j] * (force_e[j] + rest_e[j])
            seen.jacobian[i, ACCEL_BIAS.start + j] = turned[i, j] * delay
        seen.jacobian[i, DELAYS_ERROR.start] = -along
        seen.jacobian[i, DELAYS_ERROR.start + 1] = -along
        seen.jacobian[i, VELOCITY.start] += to_n[i, 1] * (2 * EARTH_RATE * delay)
        seen.jacobian[i, VELOCITY.start + 1] -= to_n[i, 0] * (2 * EARTH_RATE * delay)
    return (force_e + rest_e) * delay
