"""GNSS position: the antenna's place, through the lever arm from the IMU, and the error that fixes share for a while. Groves
(2013), equation 14.102."""

from __future__ import annotations

import math

import numpy as np

from fusiond.config.schema import Gnss, calibrated
from fusiond.events import GnssPosition
from fusiond.filter.observations.model import (
    CALIBRATED,
    LEVER_ARM_B,
    RESETS,
    STAMP_ERROR,
    Observation,
    Unusable,
    begin,
    empty_row,
    mat_eb,
    mean_rate_b,
    rate_b,
    skew_rows,
    within,
)
from fusiond.filter.state import (
    ANTENNA_B,
    ANTENNA_ERROR,
    ATTITUDE,
    DELAYS,
    DELAYS_ERROR,
    GNSS_ERROR,
    GNSS_ERROR_E,
    GYRO_BIAS,
    POSITION,
    POSITION_E,
    VELOCITY,
    VELOCITY_E,
    FilterState,
)
from fusiond.maths.portable import square
from fusiond.maths.rotation import cross, matrix_product, times
from fusiond.maths.typed import Array, Matrix3, Vector, Vector3, compiled
from fusiond.maths.wgs84 import ecef, mat_ne

PLACE_E = slice(0, 3)  # m, values
VARIANCE_HORIZONTAL, VARIANCE_VERTICAL = 3, 4  # m^2, values
TYPE_OF_FIX = 5  # values: GPS_FIX_TYPE

STAMP_SIGMA = 6  # s, parameters
ERROR_TIME = 5  # s, parameters: over which the slow part of the error stays the same; 0: it is all white
SLOW_SHARE = 7  # parameters: of the variance

HEIGHT_LIMITS = (-1000.0, 100_000.0)  # m: a GNSS height outside is not one


def parameters(gnss: Gnss) -> Array:
    row = empty_row()
    row[LEVER_ARM_B] = gnss.lever_arm_m
    row[CALIBRATED] = float(calibrated(gnss))
    row[RESETS] = POSITION.start
    row[ERROR_TIME] = gnss.position_correlation_s
    row[SLOW_SHARE] = 1 - gnss.position_white_share if gnss.position_correlation_s > 0 else 0.0
    row[STAMP_SIGMA] = gnss.stamp_sigma_ms * 1e-3
    return row


def values(fix: GnssPosition, gnss: Gnss) -> tuple[float, ...]:
    """Place (3,) earth-fixed [m], variances horizontal and vertical [m^2], fix type. The sigma is the receiver's own,
    where it gives one, but never below the configured one of the fix type. Raises Unusable."""
    within((fix.latitude,), math.pi / 2, "impossible position")
    within((fix.longitude,), 2 * math.pi, "impossible position")
    if not HEIGHT_LIMITS[0] <= fix.height <= HEIGHT_LIMITS[1]:
        raise Unusable("impossible position" if math.isfinite(fix.height) else "not finite")
    least_horizontal, least_vertical = gnss.sigmas(fix.fix_type)
    horizontal = max(fix.sigma_horizontal or 0.0, least_horizontal)
    vertical = max(fix.sigma_vertical or 0.0, least_vertical)
    x, y, z = ecef(fix.latitude, fix.longitude, fix.height).tolist()
    return x, y, z, square(horizontal), square(vertical), float(fix.fix_type)


@compiled
def observe(state: FilterState, row: Vector, parameter: Vector, seen: Observation) -> bool:
    """Innovation (3,) [m], north-east-down: the fix less the antenna and the slow error. A delay that is a state takes the
    antenna back along its velocity. Jitter of the stamp is an error along the velocity."""
    x = state.nominal
    to_n = mat_ne(x[POSITION_E])
    begin(seen, 3)
    delay = 0.0
    lever_e = np.empty(3)
    if parameter[CALIBRATED] != 0.0:
        delay = x[DELAYS.start]
        lever_e[:] = _calibrated(state, parameter[LEVER_ARM_B], to_n, seen)
    else:
        lever_e[:] = times(mat_eb(state), parameter[LEVER_ARM_B])
    for i in range(3):
        seen.jacobian[i, POSITION] = to_n[i]
    skew_rows(to_n, lever_e, -1.0, 3, seen.jacobian, ATTITUDE.start)
    off_e = row[PLACE_E] - x[POSITION_E] - lever_e + x[VELOCITY_E] * delay
    slow = parameter[SLOW_SHARE]
    if slow > 0:
        off_e -= x[GNSS_ERROR_E]
        for i in range(3):
            seen.jacobian[i, GNSS_ERROR] = to_n[i]
    seen.innovation[:] = times(to_n, off_e)
    stamp = parameter[STAMP_SIGMA] * math.sqrt(1 - slow)
    if row[STAMP_ERROR] > 0:
        stamp = math.sqrt(stamp * stamp + row[STAMP_ERROR] * row[STAMP_ERROR])
    seen.common[:] = times(to_n, x[VELOCITY_E]) * stamp
    seen.variance[0] = seen.variance[1] = (1 - slow) * row[VARIANCE_HORIZONTAL]
    seen.variance[2] = (1 - slow) * row[VARIANCE_VERTICAL]
    return True


@compiled
def _calibrated(state: FilterState, lever_b: Vector3, to_n: Matrix3, seen: Observation) -> Vector3:
    """The antenna from the IMU (3,) [m, e axes] where lever arm and delay are states, but for the way that the IMU itself
    goes in the delay; fills the jacobian's columns of lever arm, delay, velocity and gyro bias."""
    x = state.nominal
    rotation, delay = mat_eb(state), x[DELAYS.start]
    arm_b = lever_b + x[ANTENNA_B]
    swing_b = cross(rate_b(state), arm_b)
    turned = matrix_product(to_n, rotation)
    skew_rows(turned, arm_b, -delay, 3, seen.jacobian, GYRO_BIAS.start)
    skew_rows(turned, mean_rate_b(state), -delay, 3, seen.jacobian, ANTENNA_ERROR.start)
    for i in range(3):
        along = 0.0
        for j in range(3):
            seen.jacobian[i, VELOCITY.start + j] = to_n[i, j] * -delay
            seen.jacobian[i, ANTENNA_ERROR.start + j] += turned[i, j]
            along += to_n[i, j] * x[VELOCITY_E.start + j] + turned[i, j] * swing_b[j]
        seen.jacobian[i, DELAYS_ERROR.start] = -along
    return times(rotation, arm_b - swing_b * delay)
