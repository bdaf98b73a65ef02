"""Speed of one wheel. An unsteered wheel measures the forward speed of its contact point; a steered one rolls along its
own track, so it measures the horizontal speed of its contact point and needs no steering angle.

An unsigned reading near standstill is a mixture of two hypotheses, forward and backward; it is collapsed by its moments
(THEORY B6: Gaussian mixture to Gaussian), so that noise does not choose the direction when the vehicle pulls away."""

from __future__ import annotations

import math

import numpy as np

from fusiond.config.schema import Wheel
from fusiond.events import WheelSpeed
from fusiond.filter.observations.model import (
    LEVER_ARM_B,
    SPEED_LIMIT,
    STAMP_ERROR,
    Observation,
    acceleration_e,
    empty_row,
    mat_eb,
    point_velocity_v,
    within,
)
from fusiond.filter.state import SCALE, FilterState
from fusiond.maths.linear import dot
from fusiond.maths.portable import exp, square
from fusiond.maths.typed import Array, Vector, compiled

SPEED, VARIANCE, CORRELATED = 0, 1, 2  # m/s, (m/s)^2, s over which errors stay correlated: values
SIGNED = 3  # 1 where the reading has its direction from elsewhere: values
STEERED, UNSIGNED = 4, 5  # parameters: 1 or 0
SCALE_STATE = 6  # parameters: the error state of its scale; the nominal state is one higher
SLOW_CORRELATION = 1.0  # s: a slow wheel stays slow at least this long
SURE_SPEED = 2.0  # m/s: a speed beyond this leaves no doubt of its direction
SAME_DIRECTION = 100.0  # readings that share their direction, and so are worth no more than one about it
MIN_TRACK_SPEED = 0.5  # m/s: below this the direction of a steered wheel's track is not known, and it is taken as forward


def parameters(wheel: Wheel) -> Array:
    row = empty_row()
    row[LEVER_ARM_B] = wheel.position_m
    row[STEERED] = float(wheel.steered)
    told = wheel.direction_signal is not None and "." not in wheel.direction_signal  # by each of its frames
    always_signed = told and wheel.forward_values is None
    row[UNSIGNED] = float(wheel.unsigned and not always_signed)
    row[SCALE_STATE] = SCALE.start
    return row


def values(reading: WheelSpeed, wheel: Wheel) -> tuple[float, ...]:
    """Speed [m/s], its variance (white noise, rounding to a quantum, quantum^2/12, and the reading's own), and the time over
    which its error stays correlated [s]. A wheel slower than its least speed reads 0: that says only that it is as slow, the
    same from reading to reading. Raises Unusable."""
    speed, sigma, quantum, own = reading.speed, wheel.sigma_mps, wheel.quantum_mps, reading.sigma
    if not -SPEED_LIMIT <= speed <= SPEED_LIMIT:
        within((speed,), SPEED_LIMIT, "impossible speed")
    variance = sigma * sigma + quantum * quantum / 12 + own * own
    if -wheel.least_mps < speed < wheel.least_mps:
        return speed, variance + square(wheel.least_mps) / 3, max(wheel.correlation_s, SLOW_CORRELATION)
    if reading.signed:
        return speed, variance, wheel.correlation_s, 1.0
    return speed, variance, wheel.correlation_s


@compiled
def observe(state: FilterState, row: Vector, parameter: Vector, seen: Observation) -> bool:
    """Innovation (1,) [m/s]: reading less (1 + scale) times the contact point's speed."""
    return _observe(state, row, parameter, seen, False)


@compiled
def observe_certain(state: FilterState, row: Vector, parameter: Vector, seen: Observation) -> bool:
    """The same, but the state is taken at its word: an unsigned wheel turns the way that it says."""
    return _observe(state, row, parameter, seen, True)


@compiled
def _observe(state: FilterState, row: Vector, parameter: Vector, seen: Observation, certain: bool) -> bool:
    steered = parameter[STEERED] != 0.0
    by = np.empty((3, state.size))
    velocity_v = point_velocity_v(state, parameter[LEVER_ARM_B], 2 if steered else 1, by)
    forward, sideways = velocity_v[0], velocity_v[1]
    speed = forward
    which = int(parameter[SCALE_STATE])
    scale = 1 + state.nominal[which + 1]
    jacobian = seen.jacobian[0]
    track = math.sqrt(forward * forward + sideways * sideways)
    if steered and track > MIN_TRACK_SPEED:
        speed = track if forward >= 0 else -track
        along, across = forward / speed, sideways / speed
        jacobian[:] = scale * (along * by[0] + across * by[1])
    else:
        jacobian[:] = scale * by[0]
    jacobian[which] = speed
    reading, variance = row[SPEED], row[VARIANCE]
    if parameter[UNSIGNED] != 0.0 and reading > 0 and row[SIGNED] == 0.0:
        if certain or abs(speed) > SURE_SPEED:
            if speed < 0:
                reading = -reading
        else:
            reach = np.zeros(state.size)  # P H'
            for k in range(state.size):
                if jacobian[k] != 0.0:
                    reach += jacobian[k] * state.covariance[k]
            spread = variance + dot(jacobian, reach)
            sure = direction(reading * scale * speed / spread)
            variance += SAME_DIRECTION * reading * reading * (1 - sure * sure)
            reading *= sure
    seen.m = 1
    seen.common[:] = 0.0
    seen.innovation[0] = reading - scale * speed
    seen.variance[0] = variance
    if row[STAMP_ERROR] > 0:
        rotation, gained_e = mat_eb(state), acceleration_e(state)
        along = rotation[0, 0] * gained_e[0] + rotation[1, 0] * gained_e[1] + rotation[2, 0] * gained_e[2]
        seen.variance[0] += square(along * row[STAMP_ERROR])
    return True


@compiled
def direction(odds: float) -> float:
    """Mean sign of an unsigned reading z, with a speed of mean h and variance S - R behind it: the two signs weighed by
    their likelihoods, tanh(z h / S); `odds` is z h / S."""
    other = exp(-2 * abs(odds))
    sure = (1 - other) / (1 + other)
    return -sure if odds < 0 else sure
