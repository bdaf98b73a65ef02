"""GNSS velocity: the antenna's velocity over ground, through the lever arm. Groves (2013), equation 14.103."""

from __future__ import annotations

import math

import numpy as np

from fusiond.config.schema import Gnss, calibrated
from fusiond.events import GnssVelocity
from fusiond.filter.observations.model import (
    CALIBRATED,
    CORRELATION,
    LEVER_ARM_B,
    PARAMETERS,
    SPEED_LIMIT,
    Observation,
    mat_eb,
    mean_rate_b,
    rate_b,
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
from fusiond.filter.strapdown import EARTH_RATE_SKEW
from fusiond.maths.portable import square
from fusiond.maths.rotation import skew
from fusiond.maths.wgs84 import Array, gravity_e, mat_ne

VELOCITY_N = slice(0, 3)  # m/s, values
VARIANCE = 3  # (m/s)^2, values
AXES = 4  # values: 3, or 2 where the receiver gives no vertical speed


def parameters(gnss: Gnss) -> Array:
    row = np.zeros(PARAMETERS)
    row[LEVER_ARM_B] = gnss.lever_arm_m
    row[CORRELATION] = gnss.velocity_correlation_s
    row[CALIBRATED] = float(calibrated(gnss))
    return row


def values(velocity: GnssVelocity, gnss: Gnss) -> tuple[float, ...]:
    """Velocity (3,) north-east-down [m/s], variance per axis, number of axes given. Raises Unusable."""
    within((velocity.north, velocity.east, velocity.down or 0.0), SPEED_LIMIT, "impossible speed")
    variance = square(max(velocity.sigma or 0.0, gnss.velocity_sigma_mps))
    if velocity.down is None:
        return velocity.north, velocity.east, 0.0, variance, 2.0
    return velocity.north, velocity.east, velocity.down, variance, 3.0


def least_speed(row: Array) -> float:
    """The least horizontal speed [m/s] that a reading leaves possible: three sigmas below it."""
    return math.sqrt(row[0] * row[0] + row[1] * row[1]) - 3 * math.sqrt(row[VARIANCE])


def observe(state: FilterState, row: Array, parameter: Array) -> Observation:
    """Innovation (2,) or (3,) [m/s], north-east(-down). A delay that is a state takes the velocity back along the
    acceleration; what the lever arm swings is taken as constant over it."""
    axes = int(row[AXES])
    to_n = mat_ne(state.nominal[POSITION_E])[:axes]
    rotation = mat_eb(state)
    lever_b = parameter[LEVER_ARM_B]
    if parameter[CALIBRATED]:
        lever_b = lever_b + state.nominal[ANTENNA_B]
    swing_e = rotation @ np.cross(rate_b(state), lever_b)
    jacobian = np.zeros((axes, state.size))
    jacobian[:, VELOCITY] = to_n
    jacobian[:, GYRO_BIAS] = to_n @ rotation @ skew(lever_b)
    if parameter[CALIBRATED]:
        swing_e = swing_e - _gained(state, to_n, rotation, jacobian)
    jacobian[:, ATTITUDE] -= to_n @ skew(swing_e)
    innovation = row[VELOCITY_N][:axes] - to_n @ (state.nominal[VELOCITY_E] + swing_e)
    return Observation(innovation, jacobian, np.full(axes, row[VARIANCE]))


def _gained(state: FilterState, to_n: Array, rotation: Array, jacobian: Array) -> Array:
    """The velocity (3,) [m/s, e axes] that was gained since the delay began; fills the jacobian's columns of lever arm,
    delays, velocity and accelerometer bias, and what of the attitude's does not turn with the specific force."""
    x = state.nominal
    delay = float(x[DELAYS.start] + x[DELAYS.start + 1])
    force_e = rotation @ (state.auxiliary[SMOOTH_FORCE_B] - x[ACCEL_BIAS_B])
    rest = gravity_e(x[POSITION_E]) - 2 * EARTH_RATE_SKEW @ x[VELOCITY_E]
    jacobian[:, VELOCITY] += to_n @ EARTH_RATE_SKEW * (2 * delay)
    jacobian[:, ACCEL_BIAS] = to_n @ rotation * delay
    jacobian[:, ANTENNA_ERROR] = to_n @ rotation @ skew(mean_rate_b(state))
    jacobian[:, DELAYS_ERROR] = np.outer(-to_n @ (force_e + rest), np.ones(2))
    jacobian[:, ATTITUDE] = -to_n @ skew(rest) * delay
    return (force_e + rest) * delay
