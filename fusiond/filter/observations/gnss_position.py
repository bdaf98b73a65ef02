"""GNSS position: the antenna's place, through the lever arm from the IMU. Groves (2013), equation 14.102."""

from __future__ import annotations

import math

import numpy as np

from fusiond.config.schema import Gnss, calibrated
from fusiond.events import GnssPosition
from fusiond.filter.observations.model import (
    CALIBRATED,
    CORRELATION,
    LEVER_ARM_B,
    PARAMETERS,
    Observation,
    Unusable,
    mat_eb,
    mean_rate_b,
    rate_b,
    within,
)
from fusiond.filter.state import (
    ANTENNA_B,
    ANTENNA_ERROR,
    ATTITUDE,
    DELAYS,
    DELAYS_ERROR,
    GYRO_BIAS,
    POSITION,
    POSITION_E,
    VELOCITY,
    VELOCITY_E,
    FilterState,
)
from fusiond.maths.portable import square
from fusiond.maths.rotation import skew
from fusiond.maths.wgs84 import Array, ecef, mat_ne

PLACE_E = slice(0, 3)  # m, values
VARIANCE_HORIZONTAL, VARIANCE_VERTICAL = 3, 4  # m^2, values

HEIGHT_LIMITS = (-1000.0, 100_000.0)  # m: a GNSS height outside is not one


def parameters(gnss: Gnss) -> Array:
    row = np.zeros(PARAMETERS)
    row[LEVER_ARM_B] = gnss.lever_arm_m
    row[CORRELATION] = gnss.position_correlation_s
    row[CALIBRATED] = float(calibrated(gnss))
    return row


def values(fix: GnssPosition, gnss: Gnss) -> tuple[float, ...]:
    """Place (3,) earth-fixed [m], variances horizontal and vertical [m^2]: the receiver's own sigma, where it gives one,
    but never below the configured one. Raises Unusable."""
    within((fix.latitude,), math.pi / 2, "impossible position")
    within((fix.longitude,), 2 * math.pi, "impossible position")
    if not HEIGHT_LIMITS[0] <= fix.height <= HEIGHT_LIMITS[1]:
        raise Unusable("impossible position" if math.isfinite(fix.height) else "not finite")
    horizontal = max(fix.sigma_horizontal or 0.0, gnss.position_sigma_m)
    vertical = max(fix.sigma_vertical or 0.0, gnss.height_sigma_m)
    x, y, z = ecef(fix.latitude, fix.longitude, fix.height).tolist()
    return x, y, z, square(horizontal), square(vertical)


def observe(state: FilterState, row: Array, parameter: Array) -> Observation:
    """Innovation (3,) [m], north-east-down. A delay that is a state takes the antenna back along its velocity."""
    to_n = mat_ne(state.nominal[POSITION_E])
    lever_e = mat_eb(state) @ parameter[LEVER_ARM_B]
    jacobian = np.zeros((3, state.size))
    jacobian[:, POSITION] = to_n
    if parameter[CALIBRATED]:
        lever_e = _calibrated(state, parameter[LEVER_ARM_B], to_n, jacobian)
    jacobian[:, ATTITUDE] = -to_n @ skew(lever_e)
    horizontal, vertical = row[VARIANCE_HORIZONTAL], row[VARIANCE_VERTICAL]
    innovation = to_n @ (row[PLACE_E] - state.nominal[POSITION_E] - lever_e)
    if parameter[CALIBRATED]:
        innovation += to_n @ state.nominal[VELOCITY_E] * state.nominal[DELAYS.start]
    return Observation(innovation, jacobian, np.array([horizontal, horizontal, vertical]))


def _calibrated(state: FilterState, lever_b: Array, to_n: Array, jacobian: Array) -> Array:
    """The antenna from the IMU (3,) [m, e axes] where lever arm and delay are states, but for the way that the IMU itself
    goes in the delay; fills the jacobian's columns of lever arm, delay, velocity and gyro bias."""
    x = state.nominal
    rotation, rate, delay = mat_eb(state), rate_b(state), float(x[DELAYS.start])
    lever_b = lever_b + x[ANTENNA_B]
    swing_b = np.cross(rate, lever_b)
    turned = to_n @ rotation
    jacobian[:, VELOCITY] = to_n * -delay
    jacobian[:, GYRO_BIAS] = turned @ skew(lever_b) * -delay
    jacobian[:, ANTENNA_ERROR] = turned - turned @ skew(mean_rate_b(state)) * delay
    jacobian[:, DELAYS_ERROR.start] = -(to_n @ x[VELOCITY_E] + turned @ swing_b)
    return rotation @ (lever_b - swing_b * delay)
