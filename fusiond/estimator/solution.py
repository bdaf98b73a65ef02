"""The solution at one instant: state, covariance and mode, as published, logged and shown."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusiond.events import Vector3
from fusiond.maths.portable import asin, atan2

# Blocks of `SolutionState.covariance`
POSITION = slice(0, 3)  # m, north-east-down
VELOCITY = slice(3, 6)  # m/s, north-east-down
ATTITUDE = slice(6, 9)  # rad, small rotation about north, east, down
COVARIANCE_SIZE = 9


class Mode(enum.StrEnum):
    """How far the state can be trusted."""

    ALIGNING = "aligning"  # no state yet
    NOMINAL = "nominal"  # position is being fixed
    DEAD_RECKONING = "dead_reckoning"  # no recent position fix; the covariance grows
    LOST = "lost"  # the state is not worth using


@dataclass(frozen=True, slots=True, eq=False)
class SolutionState:
    """The state in north-east-down and its uncertainty. Position and velocity are those of the IMU.

    The covariance is copied and made read-only. Raises ValueError if its shape is not (9, 9).
    """

    latitude: float  # rad, WGS-84
    longitude: float  # rad
    height: float  # m, on the datum of the position source
    velocity_n: Vector3  # m/s
    quaternion_nb: tuple[float, float, float, float]  # w, x, y, z
    angular_rate_b: Vector3  # rad/s, corrected for bias
    acceleration_b: Vector3  # m/s^2, specific force corrected for bias: (0, 0, -9.8) when level and at rest
    gyro_bias: Vector3  # rad/s
    accel_bias: Vector3  # m/s^2
    wheel_scale: float  # relative error of all wheels: 0.01 if they read 1 % too high
    mount: tuple[float, float]  # rad, pitch and yaw of the IMU against the vehicle
    covariance: NDArray[np.float64]  # (9, 9), blocks POSITION, VELOCITY, ATTITUDE
    sigma_gyro_bias: Vector3  # rad/s
    sigma_accel_bias: Vector3  # m/s^2
    sigma_wheel_scale: float
    sigma_mount: tuple[float, float]  # rad

    def __post_init__(self) -> None:
        covariance = np.array(self.covariance, dtype=np.float64)
        if covariance.shape != (COVARIANCE_SIZE, COVARIANCE_SIZE):
            raise ValueError(f"covariance must be {COVARIANCE_SIZE} x {COVARIANCE_SIZE}, not {covariance.shape}")
        covariance.setflags(write=False)
        object.__setattr__(self, "covariance", covariance)

    def euler(self) -> Vector3:
        """Roll, pitch, yaw [rad] of the body against north-east-down, Z-Y-X convention:
        mat_nb = Rz(yaw) Ry(pitch) Rx(roll). Roll and yaw lie in (-pi, pi], pitch in [-pi/2, pi/2].
        """
        w, x, y, z = self.quaternion_nb
        roll = atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = asin(2 * (w * y - z * x))
        yaw = atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return _half_open(roll), pitch, _half_open(yaw)

    def sigma_position_n(self) -> Vector3:
        """Position sigmas north, east, down [m]."""
        return self._sigma(0), self._sigma(1), self._sigma(2)

    def sigma_velocity(self) -> float:
        """Horizontal velocity sigma per axis [m/s]: the root mean square of north and east."""
        return math.sqrt((float(self.covariance[3, 3]) + float(self.covariance[4, 4])) / 2)

    def sigma_yaw(self) -> float:
        """Sigma of the rotation about down [rad]: that of the yaw angle while the vehicle is nearly level."""
        return self._sigma(8)

    def _sigma(self, index: int) -> float:
        """The root of a variance; NaN where that is negative, as rounding leaves it in a state that has lost all meaning."""
        variance = float(self.covariance[index, index])
        return math.sqrt(variance) if variance >= 0 else math.nan


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The solution at `t_ns`; `state` is None before alignment is complete."""

    t_ns: int  # the instant it is valid for
    mode: Mode
    age_ns: int | None  # t_ns less the stamp of the last IMU sample used; None before the first sample
    resets: int  # number of resets so far; the state may jump at each
    state: SolutionState | None
    heading_confirmed: bool = True  # by the drive or two antennas; until then it is the given or the stored one


def _half_open(angle: float) -> float:
    """An angle in [-pi, pi], moved to (-pi, pi]."""
    return math.pi if angle == -math.pi else angle
