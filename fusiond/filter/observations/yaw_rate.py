"""The car's own yaw rate: that of the inertial sensor about the vehicle's vertical axis, and an offset, which is a state.

Where the inertial sensor is silent it is the only gyro: the angular rate itself is estimated then."""

from __future__ import annotations

import math

from fusiond.config.car import YawRateSensor
from fusiond.events import YawRate
from fusiond.filter.observations.model import (
    Observation,
    begin,
    empty_row,
    rate_b,
    turn_by_mount,
    vertical_b,
    with_rate_noise,
    within,
)
from fusiond.filter.state import GYRO_BIAS, MOUNT_ERROR, YAW_RATE_OFFSET, YAW_RATE_OFFSET_ERROR, FilterState
from fusiond.maths.portable import square
from fusiond.maths.rotation import inner
from fusiond.maths.typed import Array, Vector, compiled

RATE, VARIANCE = 0, 1  # rad/s, (rad/s)^2: values
RATE_LIMIT = 35.0  # rad/s: a car does not turn faster


def parameters(_sensor: YawRateSensor) -> Array:
    return empty_row()


def values(reading: YawRate, sensor: YawRateSensor) -> tuple[float, ...]:
    """Yaw rate [rad/s] and its variance: white noise, and rounding to a quantum. Raises Unusable."""
    within((reading.rate,), RATE_LIMIT, "impossible yaw rate")
    sigma, quantum = math.radians(sensor.sigma_deg_s), math.radians(sensor.quantum_deg_s)
    return reading.rate, square(sigma) + square(quantum) / 12


@compiled
def observe(state: FilterState, row: Vector, parameter: Vector, seen: Observation) -> bool:
    """Innovation (1,) [rad/s], clockwise: the reading less the turn rate and the offset."""
    begin(seen, 1)
    axis_b = vertical_b(state)
    for i in range(3):
        seen.jacobian[0, GYRO_BIAS.start + i] = -axis_b[i]
    seen.jacobian[0, MOUNT_ERROR.start] = turn_by_mount(state)
    seen.jacobian[0, YAW_RATE_OFFSET_ERROR.start] = 1.0
    seen.innovation[0] = row[RATE] - inner(axis_b, rate_b(state)) - state.nominal[YAW_RATE_OFFSET.start]
    seen.variance[0] = row[VARIANCE]
    with_rate_noise(state, seen)
    return True
