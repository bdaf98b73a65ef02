"""What the delays of gyro and accelerometer kept back is added to the state, and its covariance follows it."""

from __future__ import annotations

import numpy as np
import pytest

from fusiond.filter.inertial_delay import catch_up
from fusiond.filter.measurement_update import difference, inject
from fusiond.filter.state import (
    ERROR_SIZE,
    INERTIAL_DELAYS,
    INERTIAL_DELAYS_ERROR,
    QUATERNION_EB,
    VELOCITY_E,
    WIDE_SIZE,
)
from fusiond.maths.rotation import matrix, quaternion_exp, quaternion_multiply
from tests.helpers.streams import running_state

FORCE, RATE = np.array([0.8, -1.5, 0.3]), np.array([0.02, -0.05, 0.4])  # changes: m/s^2, rad/s
STEP = np.repeat([1.0, 0.1, 1e-3, 1e-4, 1e-3, 1e-3], [3, 3, 3, 3, 3, WIDE_SIZE - 15])


def test_attitude_and_velocity_catch_up_by_the_delay_times_the_change() -> None:
    state = running_state(np.random.default_rng(1), size=WIDE_SIZE)
    x = state.nominal
    x[INERTIAL_DELAYS] = 0.056, 0.022
    before, attitude = x.copy(), matrix(x[QUATERNION_EB])
    catch_up(state, FORCE, RATE)
    assert x[QUATERNION_EB] == pytest.approx(quaternion_multiply(before[QUATERNION_EB], quaternion_exp(0.056 * RATE)))
    assert x[VELOCITY_E] - before[VELOCITY_E] == pytest.approx(0.022 * attitude @ FORCE)
    unchanged = np.ones(len(x), np.bool_)
    unchanged[QUATERNION_EB] = unchanged[VELOCITY_E] = False
    assert (x[unchanged] == before[unchanged]).all()


def test_the_covariance_is_carried_by_the_transition() -> None:
    """Against finite differences of the step itself, to the first order in the change."""
    state = running_state(np.random.default_rng(2), size=WIDE_SIZE)
    state.nominal[INERTIAL_DELAYS] = 0.0
    ended = state.copy()
    catch_up(ended, FORCE, RATE)
    transition = np.empty((WIDE_SIZE, WIDE_SIZE))
    for i, step in enumerate(STEP):
        ends = []
        for sign in (1, -1):
            moved, error = state.copy(), np.zeros(WIDE_SIZE)
            error[i] = sign * step
            inject(moved, error)
            catch_up(moved, FORCE, RATE)
            ends.append(difference(moved, ended))
        transition[:, i] = (ends[0] - ends[1]) / (2 * step)
    expected = transition @ state.covariance @ transition.T
    assert ended.covariance == pytest.approx(expected, rel=1e-6, abs=1e-9 * np.abs(expected).max())
    assert not np.array_equal(ended.covariance, state.covariance)


@pytest.mark.parametrize("size", [ERROR_SIZE, WIDE_SIZE])
def test_nothing_happens_where_the_delays_are_not_learnt(size: int) -> None:
    state = running_state(np.random.default_rng(3), size=size)
    if size == WIDE_SIZE:
        state.nominal[INERTIAL_DELAYS] = 0.0
        state.covariance[INERTIAL_DELAYS_ERROR] = 0.0
        state.covariance[:, INERTIAL_DELAYS_ERROR] = 0.0
    before = state.copy()
    catch_up(state, FORCE, RATE)
    assert (state.numbers == before.numbers).all()
