"""The delays of gyro and accelerometer, which are states: an autopilot's low-pass filters make its samples late.

A sample stamped t reads what was a delay d earlier, so what it would read at t itself is, to the first order, the reading
and d times its rate of change. Integrated from one sample to the next that is d times the change between them: the attitude
turns, and the velocity grows, by so much more. So the state is that of its own instant whatever the delays are, every model
sees the truth of its instant, and each sees the delays by what they have done to attitude and velocity.
"""

from __future__ import annotations

from fusiond.filter.state import (
    ATTITUDE,
    ERROR_SIZE,
    INERTIAL_DELAYS,
    INERTIAL_DELAYS_ERROR,
    QUATERNION_EB,
    VELOCITY,
    VELOCITY_E,
    FilterState,
)
from fusiond.maths.rotation import matrix, normalised, quaternion_exp, quaternion_multiply, times
from fusiond.maths.typed import Vector3, compiled


@compiled
def catch_up(state: FilterState, force_change: Vector3, rate_change: Vector3) -> None:
    """Add to attitude and velocity what the delays kept back while the readings changed by `force_change` (3,) [m/s^2] and
    `rate_change` (3,) [rad/s]."""
    x, p = state.nominal, state.covariance
    gyro, accel = INERTIAL_DELAYS_ERROR.start, INERTIAL_DELAYS_ERROR.start + 1
    if state.size == ERROR_SIZE or not p[gyro, gyro] + p[accel, accel] > 0:
        return
    c = matrix(x[QUATERNION_EB])
    turned_e, pushed_e = times(c, rate_change), times(c, force_change)
    turn = quaternion_exp(rate_change * x[INERTIAL_DELAYS.start])
    x[QUATERNION_EB] = normalised(quaternion_multiply(x[QUATERNION_EB], turn))
    x[VELOCITY_E] += pushed_e * x[INERTIAL_DELAYS.start + 1]
    for i in range(3):
        p[VELOCITY.start + i] += pushed_e[i] * p[accel]
        p[ATTITUDE.start + i] += turned_e[i] * p[gyro]
    for i in range(3):
        p[:, VELOCITY.start + i] += pushed_e[i] * p[:, accel]
        p[:, ATTITUDE.start + i] += turned_e[i] * p[:, gyro]
    if state.tracked:
        for i in range(3):
            state.transition[VELOCITY.start + i] += pushed_e[i] * state.transition[accel]
            state.transition[ATTITUDE.start + i] += turned_e[i] * state.transition[gyro]
