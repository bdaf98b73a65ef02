"""What every observation model shares: its result, the plan of one source, and the kinematics of a point of the vehicle.

A model is a pure function of the filter state, a row of values (the measurement) and a row of parameters (the source's
configuration). It returns an `Observation`, or a reason why there is none.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fusiond.filter.state import (
    ATTITUDE,
    GYRO_BIAS,
    GYRO_BIAS_B,
    MEAN_RATE_B,
    MOUNT,
    MOUNT_ERROR,
    QUATERNION_EB,
    RATE_B,
    RATE_VARIANCE,
    VELOCITY,
    VELOCITY_E,
    FilterState,
)
from fusiond.maths.portable import sin_cos
from fusiond.maths.rotation import matrix, skew
from fusiond.maths.wgs84 import Array

VALUES = 8  # width of a measurement's row
PARAMETERS = 16  # width of a source's row
SPEED_LIMIT = 1000.0  # m/s: a speed beyond is not one
LEVER_ARM_B = slice(0, 3)  # parameters that models share: m, the sensor from the IMU
CORRELATION = 3  # s, over which the sensor's errors stay alike
NOISE_LEAST, NOISE_MOST = 8, 9  # learnt variance over the configured one: its bounds
SHARED = 10  # by what an error shared with others of a group multiplies the variance
COMPANION = 11  # place of the source that must be trusted as well, or -1
CLUTTER = 12  # share of readings that are anywhere; 0: the gate decides
CALIBRATED = 4  # 1 where lever arm and delays of this receiver are states of the filter


class Unusable(Exception):
    """A payload that must not reach the filter; the message is the reason."""


def within(values: tuple[float, ...], limit: float, complaint: str) -> None:
    """Every value finite and at most `limit` in size, or Unusable."""
    for value in values:
        if not -limit <= value <= limit:
            raise Unusable(complaint if math.isfinite(value) else "not finite")


class Observation(NamedTuple):
    """innovation d = z - h(x) : (m,), jacobian = d h / d error : (m, n), variance of z : (m,), independent axes."""

    innovation: Array
    jacobian: Array
    variance: Array


def with_rate_noise(state: FilterState, seen: Observation) -> Observation:
    """The angular rate enters over a lever arm: its white noise does as well, as its bias would."""
    by_rate = seen.jacobian[:, GYRO_BIAS]
    return seen._replace(variance=seen.variance + state.auxiliary[RATE_VARIANCE] * np.einsum("ij,ij->i", by_rate, by_rate))


def mean_rate_b(state: FilterState) -> Array:
    """Mean angular rate (3,) [rad/s] of the last half second, freed of bias: for derivatives. The noise of the rate itself
    is in the innovation too, or looks like motion: their product would be a bias, or knowledge that is none."""
    rate: Array = state.auxiliary[MEAN_RATE_B] - state.nominal[GYRO_BIAS_B]
    return rate


def mat_eb(state: FilterState) -> Array:
    return matrix(state.nominal[QUATERNION_EB])


def rate_b(state: FilterState) -> Array:
    """Angular rate (3,) [rad/s] at the state's instant, freed of bias."""
    rate: Array = state.auxiliary[RATE_B] - state.nominal[GYRO_BIAS_B]
    return rate


def mat_vb(pitch: float, yaw: float) -> tuple[Array, Array, Array]:
    """Rotation (3, 3) from body to vehicle axes, Rz(yaw) Ry(pitch), and its derivatives by pitch and by yaw."""
    (sp, cp), (sy, cy) = sin_cos(pitch), sin_cos(yaw)
    rotation = np.array([[cy * cp, -sy, cy * sp], [sy * cp, cy, sy * sp], [-sp, 0.0, cp]])
    by_pitch = np.array([[-cy * sp, 0.0, cy * cp], [-sy * sp, 0.0, sy * cp], [-cp, 0.0, -sp]])
    by_yaw = np.array([[-sy * cp, -cy, -sy * sp], [cy * cp, -sy, cy * sp], [0.0, 0.0, 0.0]])
    return rotation, by_pitch, by_yaw


def point_velocity_v(state: FilterState, point_b: Array) -> tuple[Array, Array]:
    """Velocity over ground (3,) [m/s] in vehicle axes of a point (3,) [m] fixed to the body, and its derivative (3, n) by
    the error state. The Earth's own rotation over a lever arm (0.07 mm/s at 1 m) is left out."""
    x = state.nominal
    rotation_eb = mat_eb(state)
    velocity_b = rotation_eb.T @ x[VELOCITY_E] + np.cross(rate_b(state), point_b)
    rotation_vb, by_pitch, by_yaw = mat_vb(float(x[MOUNT.start]), float(x[MOUNT.start + 1]))
    jacobian = np.zeros((3, state.size))
    jacobian[:, VELOCITY] = rotation_vb @ rotation_eb.T
    jacobian[:, ATTITUDE] = rotation_vb @ rotation_eb.T @ skew(x[VELOCITY_E])
    jacobian[:, GYRO_BIAS] = rotation_vb @ skew(point_b)
    smooth_b = rotation_eb.T @ x[VELOCITY_E] + np.cross(mean_rate_b(state), point_b)
    jacobian[:, MOUNT_ERROR.start] = by_pitch @ smooth_b
    jacobian[:, MOUNT_ERROR.start + 1] = by_yaw @ smooth_b
    return rotation_vb @ velocity_b, jacobian
