"""Speed of one wheel. An unsteered wheel measures the forward speed of its contact point; a steered one rolls along its
own track, so it measures the horizontal speed of its contact point and needs no steering angle.

An unsigned reading near standstill is a mixture of two hypotheses, forward and backward; it is collapsed by its moments
(THEORY B6: Gaussian mixture to Gaussian), so that noise does not choose the direction when the vehicle pulls away."""

from __future__ import annotations

import math

import numpy as np

from fusiond.config.schema import Wheel
from fusiond.events import WheelSpeed
from fusiond.filter.observations.model import LEVER_ARM_B, PARAMETERS, SPEED_LIMIT, Observation, point_velocity_v, within
from fusiond.filter.state import SCALE, FilterState
from fusiond.maths.portable import exp, square
from fusiond.maths.wgs84 import Array

SPEED, VARIANCE, ALIKE = 0, 1, 2  # m/s, (m/s)^2, s over which errors stay alike: values
STEERED, UNSIGNED = 4, 5  # parameters: 1 or 0
SCALE_STATE = 6  # parameters: the error state of its scale; the nominal state is one higher
SLOW_ALIKE = 1.0  # s: for so long at least a slow wheel is slow alike
SURE_SPEED = 2.0  # m/s: a speed beyond this leaves no doubt of its direction
DIRECTION_ALIKE = 100.0  # readings: so many share their direction, so they tell no more of it than one
LEAST_TRACK_SPEED = 0.5  # m/s: below this the direction of a steered wheel's track is not known, and it is taken as forward


def parameters(wheel: Wheel) -> Array:
    row = np.zeros(PARAMETERS)
    row[LEVER_ARM_B] = wheel.position_m
    row[STEERED] = float(wheel.steered)
    row[UNSIGNED] = float(wheel.unsigned and wheel.direction_signal is None)
    row[SCALE_STATE] = SCALE.start
    return row


def values(reading: WheelSpeed, wheel: Wheel) -> tuple[float, ...]:
    """Speed [m/s], its variance (white noise, rounding to a quantum, quantum^2/12, and the reading's own), and the time over
    which its error stays alike [s]. A wheel slower than its least speed reads 0: that tells only that it is as slow, the
    same from reading to reading. Raises Unusable."""
    speed, sigma, quantum, own = reading.speed, wheel.sigma_mps, wheel.quantum_mps, reading.sigma
    if not -SPEED_LIMIT <= speed <= SPEED_LIMIT:
        within((speed,), SPEED_LIMIT, "impossible speed")
    variance = sigma * sigma + quantum * quantum / 12 + own * own
    if -wheel.least_mps < speed < wheel.least_mps:
        return speed, variance + square(wheel.least_mps) / 3, max(wheel.correlation_s, SLOW_ALIKE)
    return speed, variance, wheel.correlation_s


def observe(state: FilterState, row: Array, parameter: Array, certain: bool = False) -> Observation:
    """Innovation (1,) [m/s]: reading less (1 + scale) times the contact point's speed. With `certain` the state is taken at
    its word: an unsigned wheel turns the way that it says."""
    velocity_v, by_error = point_velocity_v(state, parameter[LEVER_ARM_B])
    forward, sideways = float(velocity_v[0]), float(velocity_v[1])
    along = np.array([1.0, 0.0, 0.0])
    speed = forward
    track = math.sqrt(forward * forward + sideways * sideways)
    if parameter[STEERED] and track > LEAST_TRACK_SPEED:
        speed = math.copysign(track, forward)
        along = np.array([forward / speed, sideways / speed, 0.0])
    which = int(parameter[SCALE_STATE])
    scale = 1 + state.nominal[which + 1]
    jacobian = scale * (along @ by_error)
    jacobian[which] = speed
    reading, variance = row[SPEED], row[VARIANCE]
    if parameter[UNSIGNED] and reading > 0:
        if certain or abs(speed) > SURE_SPEED:
            reading = math.copysign(reading, speed)
        else:
            spread = float(jacobian @ state.covariance @ jacobian) + variance
            sure = direction(reading * scale * speed / spread)
            variance += DIRECTION_ALIKE * reading * reading * (1 - sure * sure)
            reading *= sure
    return Observation(np.array([reading - scale * speed]), jacobian.reshape(1, -1), np.array([variance]))


def direction(odds: float) -> float:
    """Mean sign of an unsigned reading z, with a speed of mean h and variance S - R behind it: the two signs weighed by
    their likelihoods, tanh(z h / S); `odds` is z h / S."""
    alike = exp(-2 * abs(odds))
    return math.copysign((1 - alike) / (1 + alike), odds)
