"""Rotations: quaternions (w, x, y, z), rotation matrices, Euler angles, skew matrices.

Source: Sola, Quaternion kinematics for the error-state Kalman filter (2017).
"""

from __future__ import annotations

import math

import numpy as np

from fusiond.maths.portable import asin, atan2, sin_cos
from fusiond.maths.wgs84 import Array


def product(left: Array, right: Array) -> Array:
    """Matrix product (n, m) of (n, k) and (k, m), or (n,) of (n, k) and (k,), in plain IEEE arithmetic: `@` leaves it to a
    library that is not the same on every processor."""
    terms: Array = left[:, :, None] * right[None] if right.ndim == 2 else left * right
    summed: Array = terms.sum(axis=1)
    return summed


def skew(v: Array) -> Array:
    """The matrix (3, 3) with skew(v) @ u = v x u."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def quaternion_exp(rotation: Array) -> Array:
    """Quaternion (4,) of a rotation vector (3,) [rad]."""
    x, y, z = rotation
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-8:  # the series is exact to 1e-18 there
        scale, w = 0.5 - angle2 / 48, 1 - angle2 / 8 + angle2 * angle2 / 384
    else:
        angle = math.sqrt(angle2)
        sine, w = sin_cos(angle / 2)
        scale = sine / angle
    return np.array([w, scale * x, scale * y, scale * z])


def quaternion_multiply(a: Array, b: Array) -> Array:
    """Hamilton product (4,): the rotation b first, then a."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return np.array(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


def normalised(quaternion: Array) -> Array:
    w, x, y, z = quaternion
    return quaternion / math.sqrt(w * w + x * x + y * y + z * z)


def matrix(quaternion_ab: Array) -> Array:
    """Rotation matrix (3, 3) of a unit quaternion (4,)."""
    w, x, y, z = quaternion_ab
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion(mat_ab: Array) -> Array:
    """Unit quaternion (4,), w >= 0, of a rotation matrix (3, 3) (Shepperd's method)."""
    m = mat_ab
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    pick = int(np.argmax([trace, m[0, 0], m[1, 1], m[2, 2]]))
    if pick == 0:
        q = np.array([1 + trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
    elif pick == 1:
        q = np.array([m[2, 1] - m[1, 2], 1 + 2 * m[0, 0] - trace, m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]])
    elif pick == 2:
        q = np.array([m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], 1 + 2 * m[1, 1] - trace, m[1, 2] + m[2, 1]])
    else:
        q = np.array([m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], 1 + 2 * m[2, 2] - trace])
    return normalised(q if q[0] >= 0 else -q)


def matrix_from_euler(roll: float, pitch: float, yaw: float) -> Array:
    """Rotation (3, 3) Rz(yaw) Ry(pitch) Rx(roll) [rad]: with body axes turned so, from body to navigation."""
    (sr, cr), (sp, cp), (sy, cy) = sin_cos(roll), sin_cos(pitch), sin_cos(yaw)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def euler(mat_nb: Array) -> tuple[float, float, float]:
    """Roll, pitch, yaw [rad] of a rotation (3, 3); yaw in (-pi, pi]."""
    roll = atan2(float(mat_nb[2, 1]), float(mat_nb[2, 2]))
    return roll, asin(-float(mat_nb[2, 0])), atan2(float(mat_nb[1, 0]), float(mat_nb[0, 0]))
