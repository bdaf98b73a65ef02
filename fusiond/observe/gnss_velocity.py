"""GNSS velocity: the antenna's velocity over ground, through the lever arm. Groves (2013), equation 14.103."""

from __future__ import annotations

import numpy as np

from fusiond.config import Gnss
from fusiond.earth import Array, mat_ne
from fusiond.elementary import square
from fusiond.measurements import GnssVelocity
from fusiond.observe.model import CORRELATION, LEVER_ARM_B, PARAMETERS, SPEED_LIMIT, Observation, mat_eb, rate_b, within
from fusiond.rotation import skew
from fusiond.state import ATTITUDE, GYRO_BIAS, POSITION_E, VELOCITY, VELOCITY_E, FilterState

VELOCITY_N = slice(0, 3)  # m/s, values
VARIANCE = 3  # (m/s)^2, values
AXES = 4  # values: 3, or 2 where the receiver gives no vertical speed


def parameters(gnss: Gnss) -> Array:
    row = np.zeros(PARAMETERS)
    row[LEVER_ARM_B] = gnss.lever_arm_m
    row[CORRELATION] = gnss.velocity_correlation_s
    return row


def values(velocity: GnssVelocity, gnss: Gnss) -> tuple[float, ...]:
    """Velocity (3,) north-east-down [m/s], variance per axis, number of axes given. Raises Unusable."""
    within((velocity.north, velocity.east, velocity.down or 0.0), SPEED_LIMIT, "impossible speed")
    variance = square(max(velocity.sigma or 0.0, gnss.velocity_sigma_mps))
    if velocity.down is None:
        return velocity.north, velocity.east, 0.0, variance, 2.0
    return velocity.north, velocity.east, velocity.down, variance, 3.0


def observe(state: FilterState, row: Array, parameter: Array) -> Observation:
    """Innovation (2,) or (3,) [m/s], north-east(-down)."""
    axes = int(row[AXES])
    to_n = mat_ne(state.nominal[POSITION_E])[:axes]
    rotation = mat_eb(state)
    swing_e = rotation @ np.cross(rate_b(state), parameter[LEVER_ARM_B])
    jacobian = np.zeros((axes, state.size))
    jacobian[:, VELOCITY] = to_n
    jacobian[:, ATTITUDE] = -to_n @ skew(swing_e)
    jacobian[:, GYRO_BIAS] = to_n @ rotation @ skew(parameter[LEVER_ARM_B])
    innovation = row[VELOCITY_N][:axes] - to_n @ (state.nominal[VELOCITY_E] + swing_e)
    return Observation(innovation, jacobian, np.full(axes, row[VARIANCE]))
