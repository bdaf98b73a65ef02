"""How far the body may have drifted in the odometry frame: the covariance of its pose there.

The odometry frame is exact where it began. From then on the errors of the published velocity and of the gyro bias
accumulate. Eight errors are carried along: position [m] and heading [rad] in the odometry frame; three errors of the
velocity in the body and that of the gyro bias, in sigmas. The published sigmas turn these into m/s and rad/s.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusiond.maths.rotation import matrix
from fusiond.messages.local_frame import LocalState, Placed
from fusiond.messages.types import Triple
from fusiond.units import SECOND

VELOCITY_ERROR_S = 10.0  # correlation time of the velocity's errors; that of the gyro bias has no end
TURN_NOISE = 5e-4  # rad/sqrt(s): of the angular rate, sampled as often as states are published
POSITION, HEADING, VELOCITY, GYRO_BIAS = slice(0, 3), 3, slice(4, 7), 7
SIZE = 8

Matrix = NDArray[np.float64]


class Drift:
    """Follows the body in the odometry frame."""

    def __init__(self) -> None:
        self._covariance = np.diag([0.0] * 4 + [1.0] * 4)  # (8, 8)
        self._last_ns: int | None = None

    def follow(self, t_ns: int, state: LocalState, body: Placed, sigma_gyro_bias: Triple) -> None:
        """Add the errors since the last state. `body` is the body in the odometry frame; the sigmas are in its axes."""
        last, self._last_ns = self._last_ns, t_ns
        if last is None:
            return
        dt = (t_ns - last) / SECOND
        mat_ob = matrix(np.array(body.quaternion))
        velocity_o = mat_ob @ state.velocity_b
        kept = math.exp(-dt / VELOCITY_ERROR_S)
        step = np.eye(SIZE)
        step[POSITION, VELOCITY] = mat_ob * (_velocity_sigmas(state) * dt)
        step[0, HEADING], step[1, HEADING] = -velocity_o[1] * dt, velocity_o[0] * dt
        step[HEADING, GYRO_BIAS] = float(np.linalg.norm(mat_ob[2] * sigma_gyro_bias)) * dt
        step[VELOCITY, VELOCITY] *= kept
        self._covariance = step @ self._covariance @ step.T
        self._covariance[VELOCITY, VELOCITY] += np.eye(3) * (1 - kept * kept)
        self._covariance[HEADING, HEADING] += TURN_NOISE**2 * dt

    def lose_sight(self, t_ns: int, furthest_m: float) -> None:
        """Until `t_ns` nothing was known of the motion: the body may have gone this far, and have any heading."""
        self._last_ns = t_ns
        self._covariance[POSITION, POSITION] += np.eye(3) * furthest_m**2
        self._covariance[HEADING, HEADING] += math.pi**2 / 3  # of an angle that may have any value

    def covariance(self, state: LocalState, body: Placed) -> tuple[float, ...]:
        """The covariance (6, 6) of the pose, row by row: position, then small rotations, in the axes of the odometry frame.
        Roll and pitch are the filter's own, which do not drift."""
        mat_ol = matrix(np.array(body.quaternion)) @ matrix(np.array(state.quaternion_lb)).T
        found = np.zeros((6, 6))
        tilt = mat_ol @ np.reshape(state.covariance_attitude_l, (3, 3)) @ mat_ol.T
        found[3:5, 3:5] = tilt[:2, :2]
        errors = [0, 1, 2, 5]
        found[np.ix_(errors, errors)] = self._covariance[:4, :4]
        return tuple(((found + found.T) / 2).ravel().tolist())


def _velocity_sigmas(state: LocalState) -> Matrix:
    """Of the velocity in the body's axes (3,).

    The published velocity is over ground, so an error of the attitude is one of the velocity across: as if the two were
    independent, which is too much in a long dead reckoning rather than too little.
    """
    variance = np.array(state.covariance_velocity_b)[[0, 4, 8]]
    speed = float(np.linalg.norm(state.velocity_b))
    across = np.array([0.0, speed, speed])
    tilt, heading = max(state.covariance_attitude_l[0], state.covariance_attitude_l[4]), state.covariance_attitude_l[8]
    sigmas: Matrix = np.sqrt(variance + across**2 * [0.0, heading, tilt])
    return sigmas

