"""Rotations: quaternions (w, x, y, z), rotation matrices, Euler angles, skew matrices.

Source: Sola, Quaternion kinematics for the error-state Kalman filter (2017).
"""

from __future__ import annotations

import math

import numpy as np

from fusiond.maths.portable import asin, atan2, sin_cos
from fusiond.maths.typed import Array, Matrix3, Quaternion, Vector3, compiled


def product(left: Array, right: Array) -> Array:
    """Matrix product (n, m) of (n, k) and (k, m), or (n,) of (n, k) and (k,), in plain IEEE arithmetic: `@` leaves it to a
    library that is not the same on every processor."""
    terms: Array = left[:, :, None] * right[None] if right.ndim == 2 else left * right
    summed: Array = terms.sum(axis=1)
    return summed


@compiled
def times(mat: Matrix3, v: Vector3) -> Vector3:
    """mat @ v (3,)."""
    return np.array(
        [
            mat[0, 0] * v[0] + mat[0, 1] * v[1] + mat[0, 2] * v[2],
            mat[1, 0] * v[0] + mat[1, 1] * v[1] + mat[1, 2] * v[2],
            mat[2, 0] * v[0] + mat[2, 1] * v[1] + mat[2, 2] * v[2],
        ]
    )


@compiled
def inner(a: Vector3, b: Vector3) -> float:
    """Inner product of two vectors (3,)."""
    total = 0.0
    for i in range(3):
        total += a[i] * b[i]
    return total


@compiled
def transposed_times(mat: Matrix3, v: Vector3) -> Vector3:
    """mat.T @ v (3,)."""
    return np.array(
        [
            mat[0, 0] * v[0] + mat[1, 0] * v[1] + mat[2, 0] * v[2],
            mat[0, 1] * v[0] + mat[1, 1] * v[1] + mat[2, 1] * v[2],
            mat[0, 2] * v[0] + mat[1, 2] * v[1] + mat[2, 2] * v[2],
        ]
    )


@compiled
def matrix_product(a: Matrix3, b: Matrix3) -> Matrix3:
    """a @ b (3, 3)."""
    found = np.empty((3, 3))
    for i in range(3):
        found[i] = a[i, 0] * b[0] + a[i, 1] * b[1] + a[i, 2] * b[2]
    return found


@compiled
def cross(a: Vector3, b: Vector3) -> Vector3:
    """a x b (3,)."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def skew(v: Array) -> Array:
    """The matrix (3, 3) with skew(v) @ u = v x u."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


@compiled
def quaternion_exp(rotation: Vector3) -> Quaternion:
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


@compiled
def quaternion_multiply(a: Quaternion, b: Quaternion) -> Quaternion:
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


@compiled
def normalised(quaternion: Quaternion) -> Quaternion:
    """The quaternion (4,) of length 1 in the same direction."""
    w, x, y, z = quaternion
    return quaternion / math.sqrt(w * w + x * x + y * y + z * z)


@compiled
def matrix(quaternion_ab: Quaternion) -> Matrix3:
    """Rotation matrix (3, 3) of a unit quaternion (4,)."""
    w, x, y, z = quaternion_ab
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@compiled
def quaternion(mat_ab: Matrix3) -> Quaternion:
    """Unit quaternion (4,), w >= 0, of a rotation matrix (3, 3) (Shepperd's method)."""
    m = mat_ab
    q = np.empty(4)
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    largest, pick = trace, 0
    for i in range(3):
        if m[i, i] > largest:
            largest, pick = m[i, i], i + 1
    if pick == 0:
        q[0], q[1], q[2], q[3] = 1 + trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    elif pick == 1:
        q[0], q[1], q[2], q[3] = m[2, 1] - m[1, 2], 1 + 2 * m[0, 0] - trace, m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]
    elif pick == 2:
        q[0], q[1], q[2], q[3] = m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], 1 + 2 * m[1, 1] - trace, m[1, 2] + m[2, 1]
    else:
        q[0], q[1], q[2], q[3] = m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], 1 + 2 * m[2, 2] - trace
    if not q[0] >= 0:
        for i in range(4):
            q[i] = -q[i]
    return normalised(q)


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
