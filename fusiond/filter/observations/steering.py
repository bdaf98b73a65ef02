"""The steering: where the road wheels of the steered axle point, for a vehicle that rolls on its unsteered axle.

A vehicle of wheelbase L that turns at w while it drives at v needs an angle L w / v, and in proportion to its lateral
acceleration v w an understeer more (the linear single-track model; Groves (2013), section 6.3). Offset, factor and
understeer are states. So the steering tells the turn rate where the inertial sensor is silent, and holds its bias where it
is not."""

from __future__ import annotations

import math

import numpy as np

from fusiond.config.car import Steering
from fusiond.events import SteeringAngle
from fusiond.filter.observations.model import (
    LEVER_ARM_B,
    UNWEIGHTED,
    Observation,
    begin,
    empty_row,
    mean_rate_b,
    point_velocity_v,
    rate_b,
    turn_by_mount,
    vertical_b,
    with_rate_noise,
    within,
)
from fusiond.filter.state import (
    GYRO_BIAS,
    MOUNT_ERROR,
    STEERING_FACTOR,
    STEERING_FACTOR_ERROR,
    STEERING_OFFSET,
    STEERING_OFFSET_ERROR,
    UNDERSTEER,
    UNDERSTEER_ERROR,
    FilterState,
)
from fusiond.maths.portable import square
from fusiond.maths.rotation import inner
from fusiond.maths.typed import Array, Vector, compiled

ANGLE, VARIANCE = 0, 1  # rad, rad^2: values
WHEELBASE, MIN_SPEED = 4, 5  # m, m/s: parameters
ANGLE_LIMIT = 1.6  # rad: road wheels do not turn further


def parameters(steering: Steering) -> Array:
    row = empty_row()
    row[WHEELBASE], row[MIN_SPEED] = steering.wheelbase_m, steering.minimum_speed_mps
    return row


def values(reading: SteeringAngle, steering: Steering) -> tuple[float, ...]:
    """Angle of the road wheels [rad] and its variance: white noise, and rounding to a quantum. Raises Unusable."""
    within((reading.angle,), ANGLE_LIMIT, "impossible steering angle")
    sigma, quantum = (math.radians(angle) / steering.ratio for angle in (steering.sigma_deg, steering.quantum_deg))
    return reading.angle, square(sigma) + square(quantum) / 12


@compiled
def observe(state: FilterState, row: Vector, parameter: Vector, seen: Observation) -> bool:
    """Innovation (1,) [rad], to the right; below the least speed, where the angle says nothing of the turn rate, of no
    weight."""
    begin(seen, 1)
    by = np.empty((3, state.size))
    velocity_v = point_velocity_v(state, parameter[LEVER_ARM_B], 1, by)
    speed, base, x = velocity_v[0], parameter[WHEELBASE], state.nominal
    if abs(speed) < parameter[MIN_SPEED]:
        seen.innovation[0], seen.variance[0] = 0.0, UNWEIGHTED
        return True
    axis_b = vertical_b(state)
    turn, mean = inner(axis_b, rate_b(state)), inner(axis_b, mean_rate_b(state))
    factor, understeer = 1 + x[STEERING_FACTOR.start], x[UNDERSTEER.start]
    needed = base / speed + understeer * speed
    by_speed = factor * mean * (understeer - base / (speed * speed))
    for k in range(state.size):
        seen.jacobian[0, k] = by_speed * by[0, k]
    for i in range(3):
        seen.jacobian[0, GYRO_BIAS.start + i] -= factor * needed * axis_b[i]
    seen.jacobian[0, MOUNT_ERROR.start] += factor * needed * turn_by_mount(state)
    seen.jacobian[0, STEERING_OFFSET_ERROR.start] = 1.0
    seen.jacobian[0, STEERING_FACTOR_ERROR.start] = needed * mean
    seen.jacobian[0, UNDERSTEER_ERROR.start] = factor * speed * mean
    seen.innovation[0] = row[ANGLE] - x[STEERING_OFFSET.start] - factor * needed * turn
    seen.variance[0] = row[VARIANCE]
    with_rate_noise(state, seen)
    return True
