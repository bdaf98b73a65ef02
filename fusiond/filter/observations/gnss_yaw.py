"""Yaw of the baseline between two GNSS antennas, which is a direction fixed to the body."""

from __future__ import annotations

import math

import numpy as np

from fusiond.config.schema import DualAntenna
from fusiond.events import GnssYaw
from fusiond.filter.observations.model import CORRELATION, PARAMETERS, Observation, mat_eb, within
from fusiond.filter.state import ATTITUDE, POSITION_E, FilterState
from fusiond.maths.portable import atan2, sin_cos, square
from fusiond.maths.rotation import skew
from fusiond.maths.wgs84 import Array, mat_ne

SINE, COSINE, VARIANCE = 0, 1, 2  # of the yaw, rad^2: values
BASELINE_B = slice(4, 7)  # unit vector, parameters

MIN_LEVEL = 0.2  # horizontal part of the baseline's unit vector: nearer to the vertical its yaw says nothing


def parameters(antennas: DualAntenna) -> Array:
    row = np.zeros(PARAMETERS)
    row[CORRELATION] = antennas.correlation_s
    sine, cosine = sin_cos(math.radians(antennas.offset_deg))
    row[BASELINE_B] = cosine, sine, 0.0
    return row


def values(reading: GnssYaw, antennas: DualAntenna) -> tuple[float, ...]:
    """Sine and cosine of the yaw, and its variance [rad^2]: of the receiver's own sigma, where it gives one, but never below
    the configured one. Raises Unusable."""
    within((reading.yaw,), 2 * math.pi, "impossible yaw")
    sine, cosine = sin_cos(reading.yaw)
    return sine, cosine, square(max(reading.sigma or 0.0, math.radians(antennas.sigma_deg)))


def observe(state: FilterState, row: Array, parameter: Array) -> Observation | None:
    """Innovation (1,) [rad], clockwise, in (-pi, pi]; None where the baseline is nearly vertical."""
    to_n = mat_ne(state.nominal[POSITION_E])
    baseline_e = mat_eb(state) @ parameter[BASELINE_B]
    north, east, _ = to_n @ baseline_e
    level = north * north + east * east
    if level < square(MIN_LEVEL):
        return None
    by_attitude = -to_n @ skew(baseline_e)
    jacobian = np.zeros((1, state.size))
    jacobian[0, ATTITUDE] = (north * by_attitude[1] - east * by_attitude[0]) / level
    sine, cosine = row[SINE], row[COSINE]
    innovation = atan2(float(north * sine - east * cosine), float(north * cosine + east * sine))
    return Observation(np.array([innovation]), jacobian, np.array([row[VARIANCE]]))
