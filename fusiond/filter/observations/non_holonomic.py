"""The non-holonomic constraint: wheels let the vehicle move neither sideways nor up and down at the unsteered axle.
Dissanayake et al. (2001), here with the mount misalignment of the IMU."""

from __future__ import annotations

import math

import numpy as np

from fusiond.config.schema import Motion
from fusiond.filter.observations.model import LEVER_ARM_B, Observation, empty_row, point_velocity_v, rate_b
from fusiond.filter.state import ERROR_SIZE, GYRO_BIAS, SLIP, SLIP_ERROR, FilterState
from fusiond.maths.portable import square
from fusiond.maths.typed import Array, ErrorRows3, Vector, Vector3, compiled

LATERAL_VARIANCE, VERTICAL_VARIANCE = 3, 4  # (m/s)^2, parameters
MIN_SPEED = 5  # m/s, parameters


def parameters(motion: Motion) -> Array:
    row = empty_row()
    row[LEVER_ARM_B] = motion.point_m
    row[LATERAL_VARIANCE] = square(motion.lateral_sigma_mps)
    row[VERTICAL_VARIANCE] = square(motion.vertical_sigma_mps)
    row[MIN_SPEED] = motion.minimum_speed_mps
    return row


@compiled
def observe(state: FilterState, row: Vector, parameter: Vector, seen: Observation) -> bool:
    """Innovation (2,) [m/s], vehicle axes right and down; nothing below the least speed, in whatever direction: a state that
    slides sideways must not escape. There are no values."""
    return observe_at_any_speed(state, parameter, seen) >= parameter[MIN_SPEED]


@compiled
def observe_at_any_speed(state: FilterState, parameter: Vector, seen: Observation) -> float:
    """The same at whatever speed; returns the speed over ground [m/s], in whatever direction."""
    velocity_v = _observe(state, parameter, seen)
    return math.sqrt(velocity_v[0] * velocity_v[0] + velocity_v[1] * velocity_v[1])


@compiled
def _observe(state: FilterState, parameter: Vector, seen: Observation) -> Vector3:
    by = np.empty((3, state.size))
    velocity_v = point_velocity_v(state, parameter[LEVER_ARM_B], 3, by)
    seen.m = 2
    seen.common[:] = 0.0
    for i in range(2):
        seen.jacobian[i] = by[1 + i]
        seen.innovation[i] = -velocity_v[1 + i]
    seen.variance[0], seen.variance[1] = parameter[LATERAL_VARIANCE], parameter[VERTICAL_VARIANCE]
    if state.size > ERROR_SIZE and state.covariance[SLIP_ERROR.start, SLIP_ERROR.start] > 0:
        _slide(state, velocity_v[0], by, seen)
    return velocity_v


@compiled
def _slide(state: FilterState, speed: float, by: ErrorRows3, seen: Observation) -> None:
    """Let tyres slide out of the bend: by an angle in proportion to the lateral acceleration, which is the speed [m/s] times
    the turn rate. To the filter a gyro that is late looks alike, but for how it depends on the speed."""
    turn, slip = rate_b(state)[2], state.nominal[SLIP.start]
    along = abs(speed) * speed
    seen.innovation[0] -= slip * along * turn
    seen.jacobian[0] += (2 * slip * abs(speed) * turn) * by[0]
    seen.jacobian[0, GYRO_BIAS.start + 2] -= slip * along
    seen.jacobian[0, SLIP_ERROR.start] = along * turn
