"""The truth at the IMU's instants: the navigation state, and the readings of a perfect inertial sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusiond.maths.typed import Array
from fusiond.simulation import wgs84
from fusiond.simulation.trajectory import BLOCK, Kinematics, Trajectory, turned

Stamps = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Truth:
    """N instants, of the IMU. The position, velocity and attitude are those of the IMU's axes."""

    t_ns: Stamps  # (N,) on the time line of the receiving host
    latitude: Array  # (N,) rad
    longitude: Array  # (N,) rad, in [-pi, pi)
    height: Array  # (N,) m above the ellipsoid
    velocity_n: Array  # (N, 3) m/s
    quaternion_nb: Array  # (N, 4)
    euler: Array  # (N, 3) rad: roll, pitch, yaw
    angular_rate_b: Array  # (N, 3) rad/s, against inertial space, free of errors
    specific_force_b: Array  # (N, 3) m/s^2, free of errors
    gyro_bias_b: Array  # (N, 3) rad/s
    accel_bias_b: Array  # (N, 3) m/s^2
    speed: Array  # (N,) m/s, of the rear axle along the vehicle's forward axis
    wheel_scale: tuple[float, float, float, float]  # relative error of each wheel: 0.01 if it reads 1 % too high


@dataclass(frozen=True, slots=True)
class Motion:
    """The part of the truth that depends on the trajectory alone; fields as in `Truth`."""

    position: tuple[Array, Array, Array]
    velocity_n: Array
    euler: Array
    angular_rate_b: Array
    specific_force_b: Array
    speed: Array


def motion(trajectory: Trajectory) -> Motion:
    """The motion on the trajectory's grid, by the navigation equations in north-east-down axes (Groves 2013, 5.4)."""
    position = trajectory.position(trajectory.t)
    parts: list[tuple[Array, ...]] = []
    for k in range(0, len(trajectory.t), BLOCK):
        block = slice(k, k + BLOCK)
        kinematics = trajectory.kinematics(trajectory.t[block])
        rate_b, force_b = inertial(kinematics, position[0][block], position[2][block])
        parts.append((kinematics.velocity_n, euler_angles(kinematics.mat_nb), rate_b, force_b, kinematics.speed))
    velocity_n, euler, rate_b, force_b, speed = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Motion(position, velocity_n, euler, rate_b, force_b, speed)


def inertial(kinematics: Kinematics, latitude: Array, height: Array) -> tuple[Array, Array]:
    """Angular rate (N, 3) [rad/s] and specific force (N, 3) [m/s^2] in b."""
    velocity_n = kinematics.velocity_n
    earth_n = wgs84.earth_rate_n(latitude)
    transport_n = wgs84.transport_rate_n(latitude, height, velocity_n)
    force_n = kinematics.acceleration_n + np.cross(2 * earth_n + transport_n, velocity_n)
    force_n[:, 2] -= wgs84.gravity(latitude, height)
    mat_bn = kinematics.mat_nb.transpose(0, 2, 1)
    return kinematics.rate_nb_b + turned(mat_bn, earth_n + transport_n), turned(mat_bn, force_n)


def euler_angles(mat_nb: Array) -> Array:
    """Roll, pitch, yaw (N, 3) [rad] of rotations (N, 3, 3)."""
    roll = np.arctan2(mat_nb[:, 2, 1], mat_nb[:, 2, 2])
    pitch = np.arcsin(np.clip(-mat_nb[:, 2, 0], -1, 1))
    return np.stack([roll, pitch, np.arctan2(mat_nb[:, 1, 0], mat_nb[:, 0, 0])], -1)


def quaternions(euler: Array) -> Array:
    """Unit quaternions (N, 4), w >= 0, of roll, pitch, yaw (N, 3) [rad]."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(euler / 2).T, np.sin(euler / 2).T
    found = np.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        -1,
    )
    return np.where(found[:, :1] < 0, -found, found)
