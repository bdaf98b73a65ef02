"""The estimate at one instant: Euler angles, and a covariance that nothing can change."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.estimates import quaternion, state


@given(st.floats(-math.pi, math.pi), st.floats(-1.57, 1.57), st.floats(-math.pi, math.pi))
def test_euler_angles_come_back(roll: float, pitch: float, yaw: float) -> None:
    found = state(quaternion_nb=quaternion(roll, pitch, yaw)).euler()
    for angle, expected in zip(found, (roll, pitch, yaw), strict=True):
        assert math.isclose(math.remainder(angle - expected, math.tau), 0, abs_tol=1e-9)
        assert -math.pi < angle <= math.pi


def test_south_is_plus_180_degrees_whichever_way_it_is_reached() -> None:
    for z in (1.0, -1.0):
        for w in (0.0, -0.0):
            assert state(quaternion_nb=(w, 0.0, 0.0, z)).euler()[2] == math.pi


def test_straight_up_is_90_degrees_in_spite_of_rounding() -> None:
    half = math.sqrt(0.5) * (1 + 1e-15)
    assert state(quaternion_nb=(half, 0.0, half, 0.0)).euler()[1] == math.pi / 2


def test_covariance_is_a_copy_that_cannot_be_written() -> None:
    original = np.eye(9)
    kept = state(covariance=original)
    original[0, 0] = 5.0
    assert kept.covariance[0, 0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        kept.covariance[0, 0] = 2.0
    with pytest.raises(ValueError, match="9 x 9"):
        state(covariance=np.eye(3))
