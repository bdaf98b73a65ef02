"""MAVLink messages made of a state: covariances, projections, rates."""

from __future__ import annotations

import numpy as np
import pytest

from fusiond.maths.rotation import euler, matrix, matrix_from_euler
from fusiond_adapters.mavlink.outgoing import CONVENTIONS, Origin, RateLimiter, ellipsoid_projection, vision_position
from tests.helpers.mavlink_peers import MS, state_at, state_of


def test_angles_in_the_covariance_are_those_of_roll_pitch_and_yaw() -> None:
    """Against finite differences of the Euler angles."""
    message = state_at(10**18, 4)
    state = state_of(message)
    mat_nb = matrix(np.array(state.quaternion_nb))
    step = 1e-6
    columns = []
    for axis in range(3):
        turn = [step if axis == i else 0.0 for i in range(3)]
        turned = euler(matrix_from_euler(*turn) @ mat_nb)
        columns.append((np.array(turned) - np.array(euler(mat_nb))) / step)
    jacobian = np.column_stack(columns)
    want = jacobian @ np.array(state.covariance_attitude_rad2).reshape(3, 3) @ jacobian.T
    covariance = vision_position(message, state, Origin.of(state), CONVENTIONS["px4"], 0).covariance
    whole = np.zeros((6, 6))
    whole[np.triu_indices(6)] = covariance
    np.testing.assert_allclose(whole[3:, 3:][np.triu_indices(3)], want[np.triu_indices(3)], rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(whole[:3, :3], np.triu(np.array(state.covariance_position_m2).reshape(3, 3)))
    assert not whole[:3, 3:].any()


def test_maps_differ_by_metres_and_cross_the_date_line() -> None:
    origin = Origin(48.0, 179.99, 0.0)
    for project in (CONVENTIONS["ardupilot"].project, CONVENTIONS["px4"].project, ellipsoid_projection):
        north, east = project(origin, 48.05, -179.99)
        assert north == pytest.approx(5560, abs=10) and east == pytest.approx(1490, abs=5)
    apart = CONVENTIONS["ardupilot"].project(origin, 48.05, 179.99)[0] - ellipsoid_projection(origin, 48.05, 179.99)[0]
    assert 4 < apart < 8  # m, in 5.6 km


def test_pace_keeps_its_rate_between_ticks_of_another() -> None:
    limiter = RateLimiter(30.0)
    passed = [limiter.due(tick * 20 * MS) for tick in range(500)]  # 10 s at 50 Hz
    assert sum(passed) == 300
    assert limiter.due(60_000 * MS)
    assert not limiter.due(60_001 * MS)  # a pause is not made up for
    assert not any(RateLimiter(0.0).due(tick) for tick in range(3))
