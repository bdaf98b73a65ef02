"""A published state of a vehicle that drives north, for the tests of comparison and summary."""

from __future__ import annotations

import math

import numpy as np

from fusiond.estimator.solution import Mode, Solution, SolutionState
from fusiond.messages.from_solution import state_message
from fusiond.messages.types import OutcomeCounts, StateMessage
from fusiond.units import SECOND


def message(
    second: float = 0.0, mode: Mode = Mode.NOMINAL, speed: float = 0.0, sigma: tuple[float, float, float] = (3.0, 4.0, 5.0)
) -> StateMessage:
    """A state at 48 N 11 E that moves north, with uncorrelated position errors."""
    state = SolutionState(
        latitude=math.radians(48.0),
        longitude=math.radians(11.0),
        height=500.0,
        velocity_n=(speed, 0.0, 0.0),
        quaternion_nb=(1.0, 0.0, 0.0, 0.0),
        angular_rate_b=(0.0, 0.0, 0.0),
        acceleration_b=(0.0, 0.0, -9.8),
        gyro_bias=(0.0, 0.0, 0.0),
        accel_bias=(0.0, 0.0, 0.0),
        wheel_scale=0.0,
        mount=(0.0, 0.0),
        covariance=np.diag(np.square([*sigma, 0.1, 0.1, 0.1, 0.01, 0.01, 0.01])),
        sigma_gyro_bias=(0.0, 0.0, 0.0),
        sigma_accel_bias=(0.0, 0.0, 0.0),
        sigma_wheel_scale=0.0,
        sigma_mount=(0.0, 0.0),
    )
    return state_message(Solution(round(second * SECOND), mode, 0, 0, state), "car", OutcomeCounts())
