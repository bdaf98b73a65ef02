"""Yaw of the baseline between two GNSS antennas, which is a direction fixed to the body."""

from __future__ import annotations

import math

import numpy as np

from fusiond.config.schema import DualAntenna
from fusiond.events import GnssYaw
from fusiond.filter.observations.model import Observation, begin, empty_row, mat_eb, skew_rows, within
from fusiond.filter.state import ATTITUDE, POSITION_E, FilterState
from fusiond.maths.portable import atan2, sin_cos, square
from fusiond.maths.rotation import times
from fusiond.maths.typed import Array, Vector, compiled
from fusiond.maths.wgs84 import mat_ne

SINE, COSINE, VARIANCE = 0, 1, 2  # of the yaw, rad^2: values
BASELINE_B = slice(4, 7)  # unit vector, parameters

MIN_LEVEL = 0.2  # horizontal part of the baseline's unit vector: nearer to the vertical its yaw says nothing


def parameters(antennas: DualAntenna) -> Array:
    row = empty_row()
    sine, cosine = sin_cos(math.radians(antennas.offset_deg))
    row[BASELINE_B] = cosine, sine, 0.0
    return row


def values(reading: GnssYaw, antennas: DualAntenna) -> tuple[float, ...]:
    """Sine and cosine of the yaw, and its variance [rad^2]: of the receiver's own sigma, where it gives one, but never below
    the configured one. Raises Unusable."""
    within((reading.yaw,), 2 * math.pi, "impossible yaw")
    sine, cosine = sin_cos(reading.yaw)
    return sine, cosine, square(max(reading.sigma or 0.0, math.radians(antennas.sigma_deg)))


@compiled
def observe(state: FilterState, row: Vector, parameter: Vector, seen: Observation) -> bool:
    """Innovation (1,) [rad], clockwise, in (-pi, pi]; nothing where the baseline is nearly vertical."""
    to_n = mat_ne(state.nominal[POSITION_E])
    baseline_e = times(mat_eb(state), parameter[BASELINE_B])
    baseline_n = times(to_n, baseline_e)
    north, east = baseline_n[0], baseline_n[1]
    level = north * north + east * east
    if level < square(MIN_LEVEL):
        return False
    by_attitude = np.zeros((3, state.size))
    skew_rows(to_n, baseline_e, -1.0, 2, by_attitude, ATTITUDE.start)
    begin(seen, 1)
    for i in range(ATTITUDE.start, ATTITUDE.stop):
        seen.jacobian[0, i] = (north * by_attitude[1, i] - east * by_attitude[0, i]) / level
    sine, cosine = row[SINE], row[COSINE]
    seen.innovation[0] = atan2(north * sine - east * cosine, north * cosine + east * sine)
    seen.variance[0] = row[VARIANCE]
    return True
