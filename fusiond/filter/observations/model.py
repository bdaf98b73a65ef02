"""What every observation model shares: its result, the rows of numbers it works on, the kinematics of a point of the body.

A model is a pure function of the filter state, a row of values (the measurement) and a row of parameters (the source's
configuration). It fills an `Observation`, or returns False where there is nothing to observe. Its `values` and `parameters`
make those rows; they run in the interpreter, once a measurement and once a configuration.
"""

from __future__ import annotations

import math

import numpy as np

from fusiond.filter.state import (
    ACCEL_BIAS_B,
    ATTITUDE,
    GYRO_BIAS,
    GYRO_BIAS_B,
    MEAN_RATE_B,
    MOUNT,
    MOUNT_ERROR,
    POSITION_E,
    QUATERNION_EB,
    RATE_B,
    RATE_VARIANCE,
    SMOOTH_FORCE_B,
    VELOCITY,
    VELOCITY_E,
    FilterState,
)
from fusiond.maths.portable import sin_cos
from fusiond.maths.rotation import cross, matrix, times, transposed_times
from fusiond.maths.typed import Array, ErrorRows3, Matrix3, Vector3, compiled
from fusiond.maths.wgs84 import gravity_e

VALUES = 8  # width of a measurement's row
UNWEIGHTED = 1e12  # variance of a reading that says nothing at present
STAMP_ERROR = VALUES - 1  # s, sigma by which the clocks may have placed a reading off, values of every model
PARAMETERS = 16  # width of a source's row
SPEED_LIMIT = 1000.0  # m/s: a speed beyond is not one
LEVER_ARM_B = slice(0, 3)  # parameters that models share: m, the sensor from the IMU
CORRELATION = 3  # s, over which the sensor's errors stay correlated
CALIBRATED = 4  # 1 where lever arm and delays of this receiver are states of the filter
NOISE_MIN, NOISE_MAX = 8, 9  # learnt variance over the configured one: its bounds
SHARED = 10  # by what an error shared with others of a group multiplies the variance
COMPANION = 11  # index of the source that must be trusted as well, or -1
CLUTTER = 12  # share of readings that are anywhere; 0: the gate decides
RESETS = 13  # first error state of the block that the source resets when it was locked out, or -1


def empty_row() -> Array:
    """A source's row of parameters, before its model fills it."""
    row = np.zeros(PARAMETERS)
    row[COMPANION] = row[RESETS] = -1
    return row


class Unusable(Exception):
    """A payload that must not reach the filter; the message is the reason."""


def within(values: tuple[float, ...], limit: float, complaint: str) -> None:
    """Every value finite and at most `limit` in size, or Unusable."""
    for value in values:
        if not -limit <= value <= limit:
            raise Unusable(complaint if math.isfinite(value) else "not finite")


class Observation:
    """What a model observes, on `m` axes, at most three; the rest of the memory is not used.

    innovation d = z - h(x) : (3,), jacobian = d h / d error : (3, n), variance of z : (3,), independent axes; common : (3,),
    a sigma of all axes at once, along one direction: R = diag(variance) + common common'.
    """

    __slots__ = ("common", "innovation", "jacobian", "m", "variance")

    def __init__(self, size: int) -> None:
        """Room for `size` error states."""
        self.m = 0
        self.innovation: Array = np.zeros(3)
        self.jacobian: Array = np.zeros((3, size))
        self.variance: Array = np.zeros(3)
        self.common: Array = np.zeros(3)

    @classmethod
    def of(cls, innovation: Array, jacobian: Array, variance: Array) -> Observation:
        """One of (m,), (m, n), (m,)."""
        seen = cls(jacobian.shape[1])
        seen.m = len(innovation)
        seen.innovation[: seen.m], seen.jacobian[: seen.m], seen.variance[: seen.m] = innovation, jacobian, variance
        return seen

    def trimmed(self) -> tuple[Array, Array, Array]:
        """Innovation (m,), jacobian (m, n) and variance (m,)."""
        return self.innovation[: self.m], self.jacobian[: self.m], self.variance[: self.m]


@compiled
def begin(seen: Observation, axes: int) -> None:
    """Make room for an observation on so many axes, with a jacobian of zeros and nothing common."""
    seen.m = axes
    seen.common[:] = 0.0
    for a in range(axes):
        seen.jacobian[a] = 0.0


@compiled
def skew_rows(rows: Matrix3, v: Vector3, factor: float, axes: int, jacobian: ErrorRows3, column: int) -> None:
    """jacobian[:axes, column : column + 3] = factor * rows[:axes] @ skew(v)."""
    for i in range(axes):
        jacobian[i, column] = factor * (rows[i, 1] * v[2] - rows[i, 2] * v[1])
        jacobian[i, column + 1] = factor * (rows[i, 2] * v[0] - rows[i, 0] * v[2])
        jacobian[i, column + 2] = factor * (rows[i, 0] * v[1] - rows[i, 1] * v[0])


@compiled
def with_rate_noise(state: FilterState, seen: Observation) -> None:
    """The angular rate enters over a lever arm: add its white noise, which enters as its bias does."""
    for a in range(seen.m):
        by = seen.jacobian[a, GYRO_BIAS]
        seen.variance[a] += state.auxiliary[RATE_VARIANCE] * (by[0] * by[0] + by[1] * by[1] + by[2] * by[2])


@compiled
def acceleration_e(state: FilterState) -> Vector3:
    """Acceleration (3,) [m/s^2] over ground, e axes, without Coriolis' part: a mean over some 0.1 s."""
    x = state.nominal
    return times(mat_eb(state), state.auxiliary[SMOOTH_FORCE_B] - x[ACCEL_BIAS_B]) + gravity_e(x[POSITION_E])


@compiled
def mean_rate_b(state: FilterState) -> Vector3:
    """Mean angular rate (3,) [rad/s] of the last half second, freed of bias: for derivatives. The noise of the rate itself
    is in the innovation too, or looks like motion: their product would be a bias, or knowledge that is none."""
    return state.auxiliary[MEAN_RATE_B] - state.nominal[GYRO_BIAS_B]


@compiled
def vertical_b(state: FilterState) -> Vector3:
    """The vehicle's vertical axis (3,), downwards, in body axes: it is turned by the mount's pitch."""
    sp, cp = sin_cos(state.nominal[MOUNT.start])
    return np.array([-sp, 0.0, cp])


@compiled
def right_b(state: FilterState) -> Vector3:
    """The vehicle's axis (3,) to the right in body axes."""
    sp, cp = sin_cos(state.nominal[MOUNT.start])
    sy, cy = sin_cos(state.nominal[MOUNT.start + 1])
    return np.array([sy * cp, cy, sy * sp])


@compiled
def turn_by_mount(state: FilterState) -> float:
    """By how much the turn rate about that axis grows with the mount's pitch [rad/s per rad]."""
    sp, cp = sin_cos(state.nominal[MOUNT.start])
    mean_b = mean_rate_b(state)
    return -cp * mean_b[0] - sp * mean_b[2]


@compiled
def mat_eb(state: FilterState) -> Matrix3:
    """Rotation (3, 3) from body to earth-fixed axes."""
    return matrix(state.nominal[QUATERNION_EB])


@compiled
def rate_b(state: FilterState) -> Vector3:
    """Angular rate (3,) [rad/s] at the state's instant, freed of bias."""
    return state.auxiliary[RATE_B] - state.nominal[GYRO_BIAS_B]


@compiled
def point_velocity_v(state: FilterState, point_b: Vector3, axes: int, jacobian: ErrorRows3) -> Vector3:
    """Velocity over ground (3,) [m/s] in vehicle axes (those of the body turned by the mount, Rz(yaw) Ry(pitch)) of a point
    (3,) [m] fixed to the body; the first `axes` rows of its derivative by the error state go into `jacobian`. The Earth's
    rotation over a lever arm (0.07 mm/s at 1 m) is left out."""
    x = state.nominal
    c = matrix(x[QUATERNION_EB])
    swing_b = cross(rate_b(state), point_b)
    along_b = transposed_times(c, x[VELOCITY_E])
    velocity_b = along_b + swing_b
    sp, cp = sin_cos(x[MOUNT.start])
    sy, cy = sin_cos(x[MOUNT.start + 1])
    mat_vb = np.array([[cy * cp, -sy, cy * sp], [sy * cp, cy, sy * sp], [-sp, 0.0, cp]])
    turned = np.empty((3, 3))  # mat_vb @ mat_eb.T
    for i in range(axes):
        jacobian[i] = 0.0
        for j in range(3):
            turned[i, j] = mat_vb[i, 0] * c[j, 0] + mat_vb[i, 1] * c[j, 1] + mat_vb[i, 2] * c[j, 2]
        jacobian[i, VELOCITY] = turned[i]
    skew_rows(turned, x[VELOCITY_E], 1.0, axes, jacobian, ATTITUDE.start)
    skew_rows(mat_vb, point_b, 1.0, axes, jacobian, GYRO_BIAS.start)
    mean_b = along_b + cross(mean_rate_b(state), point_b)
    by_mount = np.array(
        [
            [-cy * sp * mean_b[0] + cy * cp * mean_b[2], -sy * cp * mean_b[0] - cy * mean_b[1] - sy * sp * mean_b[2], 0.0],
            [-sy * sp * mean_b[0] + sy * cp * mean_b[2], cy * cp * mean_b[0] - sy * mean_b[1] + cy * sp * mean_b[2], 0.0],
            [-cp * mean_b[0] - sp * mean_b[2], 0.0, 0.0],
        ]
    )
    for i in range(axes):
        jacobian[i, MOUNT_ERROR.start] = by_mount[i, 0]
        jacobian[i, MOUNT_ERROR.start + 1] = by_mount[i, 1]
    return times(mat_vb, velocity_b)
