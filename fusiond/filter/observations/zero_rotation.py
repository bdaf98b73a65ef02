"""Zero rotation: the vehicle stands, so the gyro reads its bias and the Earth's rotation alone."""

from __future__ import annotations

import math

from fusiond.config.schema import Motion
from fusiond.filter.observations.model import Observation, begin, empty_row, mat_eb
from fusiond.filter.state import ATTITUDE, GYRO_BIAS, GYRO_BIAS_B, RATE_B, FilterState
from fusiond.maths.portable import square
from fusiond.maths.typed import Array, Vector, compiled
from fusiond.maths.wgs84 import EARTH_RATE

VARIANCE = 0  # (rad/s)^2, parameters


def parameters(motion: Motion) -> Array:
    row = empty_row()
    row[VARIANCE] = square(math.radians(motion.zero_rotation_sigma_deg_s))
    return row


@compiled
def observe(state: FilterState, row: Vector, parameter: Vector, seen: Observation) -> bool:
    """Innovation (3,) [rad/s], body axes. There are no values."""
    c = mat_eb(state)
    begin(seen, 3)
    for i in range(3):
        seen.jacobian[i, GYRO_BIAS.start + i] = 1.0
        seen.jacobian[i, ATTITUDE.start] = c[1, i] * EARTH_RATE  # mat_eb' skew(omega_ie), with omega_ie along z
        seen.jacobian[i, ATTITUDE.start + 1] = -(c[0, i] * EARTH_RATE)
        turned = state.auxiliary[RATE_B.start + i] - state.nominal[GYRO_BIAS_B.start + i]
        seen.innovation[i] = turned - c[2, i] * EARTH_RATE
        seen.variance[i] = parameter[VARIANCE]
    return True
