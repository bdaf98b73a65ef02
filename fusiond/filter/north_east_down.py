"""The state in north-east-down: the numbers that are published, worked out from the earth-fixed ones of the filter.

Rotation matrix to quaternion: Shepperd (1978), in fusiond.maths.rotation.
"""

from __future__ import annotations

import numpy as np

from fusiond.filter.state import ATTITUDE, POSITION, POSITION_E, QUATERNION_EB, VELOCITY, VELOCITY_E
from fusiond.maths.rotation import matrix, matrix_product, quaternion, times
from fusiond.maths.typed import Covariance, StateN, Vector, compiled
from fusiond.maths.wgs84 import geodetic, mat_ne

# Slices of what `to_north_east_down` returns
GEODETIC = slice(0, 3)  # latitude, longitude [rad], height [m]
VELOCITY_N = slice(3, 6)  # m/s
QUATERNION_NB = slice(6, 10)  # w >= 0
COVARIANCE_N = slice(10, 91)  # (9, 9): position, velocity, attitude, each north, east, down
STATE_N_SIZE = 91
BLOCKS = (POSITION, VELOCITY, ATTITUDE)  # of the error state, in this order from its begin


@compiled
def to_north_east_down(nominal: Vector, covariance: Covariance) -> StateN:
    """The state (91,) in north-east-down, of a nominal state and its covariance (n, n); slices as above."""
    found = np.empty(STATE_N_SIZE)
    to_n = mat_ne(nominal[POSITION_E])
    found[0], found[1], found[2] = geodetic(nominal[POSITION_E])
    found[VELOCITY_N] = times(to_n, nominal[VELOCITY_E])
    found[QUATERNION_NB] = quaternion(matrix_product(to_n, matrix(nominal[QUATERNION_EB])))
    turned = np.empty((3, 3))
    for a in range(0, 9, 3):
        for b in range(0, 9, 3):  # one block of the covariance, turned from both sides
            for i in range(3):
                for j in range(3):
                    turned[i, j] = (
                        to_n[i, 0] * covariance[a, b + j]
                        + to_n[i, 1] * covariance[a + 1, b + j]
                        + to_n[i, 2] * covariance[a + 2, b + j]
                    )
            for i in range(3):
                for j in range(3):
                    found[COVARIANCE_N.start + 9 * (a + i) + b + j] = (
                        turned[i, 0] * to_n[j, 0] + turned[i, 1] * to_n[j, 1] + turned[i, 2] * to_n[j, 2]
                    )
    return found
