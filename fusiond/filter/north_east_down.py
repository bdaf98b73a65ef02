"""The state in north-east-down: the numbers that are published, worked out from the earth-fixed ones of the filter.

Part of the NumPy twin of the compiled kernel (fusiond.filter.step), which does the same a hundred times faster: it is done
for every publication. Rotation matrix to quaternion: Shepperd (1978), in fusiond.maths.rotation.
"""

from __future__ import annotations

import numpy as np

from fusiond.filter.state import ATTITUDE, POSITION, POSITION_E, QUATERNION_EB, VELOCITY, VELOCITY_E
from fusiond.maths.rotation import matrix, product, quaternion
from fusiond.maths.wgs84 import Array, geodetic, mat_ne

# Slices of what `answer` returns
GEODETIC = slice(0, 3)  # latitude, longitude [rad], height [m]
VELOCITY_N = slice(3, 6)  # m/s
QUATERNION_NB = slice(6, 10)  # w >= 0
COVARIANCE_N = slice(10, 91)  # (9, 9): position, velocity, attitude, each north, east, down
ANSWER_SIZE = 91
BLOCKS = (POSITION, VELOCITY, ATTITUDE)


def answer(nominal: Array, covariance: Array) -> Array:
    """The state (91,) in north-east-down, of a nominal state and its covariance (n, n); slices as above."""
    to_n = mat_ne(nominal[POSITION_E])
    found = np.empty(ANSWER_SIZE)
    found[GEODETIC] = geodetic(nominal[POSITION_E])
    found[VELOCITY_N] = product(to_n, nominal[VELOCITY_E])
    found[QUATERNION_NB] = quaternion(product(to_n, matrix(nominal[QUATERNION_EB])))
    turned = found[COVARIANCE_N].reshape(9, 9)
    for rows in BLOCKS:
        for columns in BLOCKS:
            turned[rows, columns] = product(product(to_n, covariance[rows, columns]), to_n.T)
    return found
