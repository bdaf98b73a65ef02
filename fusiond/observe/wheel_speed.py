"""Speed of one wheel. An unsteered wheel measures the forward speed of its contact point; a steered one rolls along its
own track, so it measures the horizontal speed of its contact point and needs no steering angle."""

from __future__ import annotations

import math

import numpy as np

from fusiond.config import Wheel
from fusiond.earth import Array
from fusiond.measurements import WheelSpeed
from fusiond.observe.model import CORRELATION, LEVER_ARM_B, PARAMETERS, Observation, point_velocity_v
from fusiond.state import SCALE, WHEEL_SCALE, FilterState

SPEED, VARIANCE = 0, 1  # m/s, (m/s)^2, values
STEERED, UNSIGNED = 4, 5  # parameters: 1 or 0
LEAST_TRACK_SPEED = 0.5  # m/s: below this the direction of a steered wheel's track is not known, and it is taken as forward


def parameters(wheel: Wheel) -> Array:
    row = np.zeros(PARAMETERS)
    row[LEVER_ARM_B] = wheel.position_m
    row[CORRELATION] = wheel.correlation_s
    row[STEERED], row[UNSIGNED] = float(wheel.steered), float(wheel.unsigned)
    return row


def values(reading: WheelSpeed, wheel: Wheel) -> tuple[float, ...]:
    """Speed [m/s] and its variance: the white noise and that of rounding to a quantum, quantum^2/12."""
    return reading.speed, wheel.sigma_mps**2 + wheel.quantum_mps**2 / 12


def observe(state: FilterState, row: Array, parameter: Array) -> Observation:
    """Innovation (1,) [m/s]: reading less (1 + scale) times the contact point's speed."""
    velocity_v, by_error = point_velocity_v(state, parameter[LEVER_ARM_B])
    forward, sideways = float(velocity_v[0]), float(velocity_v[1])
    along = np.array([1.0, 0.0, 0.0])
    speed = forward
    track = math.sqrt(forward * forward + sideways * sideways)
    if parameter[STEERED] and track > LEAST_TRACK_SPEED:
        speed = math.copysign(track, forward)
        along = np.array([forward / speed, sideways / speed, 0.0])
    scale = 1 + state.nominal[WHEEL_SCALE.start]
    jacobian = scale * (along @ by_error)
    jacobian[SCALE] = speed
    reading = row[SPEED]
    if parameter[UNSIGNED] and reading > 0 and speed < 0:
        reading = -reading
    return Observation(np.array([reading - scale * speed]), jacobian.reshape(1, -1), np.array([row[VARIANCE]]))
