"""Yaw of a dual-antenna receiver: its Jacobian against finite differences, its innovation in attitudes that are known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.config.schema import DualAntenna
from fusiond.events import GnssYaw
from fusiond.filter.measurement_update import inject
from fusiond.filter.observations import gnss_yaw
from fusiond.filter.observations.model import PARAMETERS, VALUES, Unusable
from fusiond.filter.state import ATTITUDE, POSITION_E, QUATERNION_EB, WIDE_SIZE, FilterState
from fusiond.maths.rotation import matrix_from_euler, quaternion
from fusiond.maths.wgs84 import ecef, mat_ne
from tests.helpers.observations import Observed, observed
from tests.helpers.streams import MUNICH, running_state

STEP = 1e-5  # rad


def antennas(**keys: float) -> DualAntenna:
    return DualAntenna(link="l", **keys)  # type: ignore[arg-type]


def turned(roll: float, pitch: float, yaw: float) -> FilterState:
    """A state with an attitude given in degrees."""
    state = FilterState(1)
    state.nominal[POSITION_E] = ecef(*MUNICH)
    mat_nb = matrix_from_euler(math.radians(roll), math.radians(pitch), math.radians(yaw))
    state.nominal[QUATERNION_EB] = quaternion(mat_ne(ecef(*MUNICH)).T @ mat_nb)
    return state


def seen(state: FilterState, yaw_deg: float, section: DualAntenna) -> Observed | None:
    row = np.zeros(VALUES)
    row[:3] = gnss_yaw.values(GnssYaw(math.radians(yaw_deg)), section)
    return observed(gnss_yaw.observe, state, row, gnss_yaw.parameters(section))


def innovation_deg(state: FilterState, yaw_deg: float, section: DualAntenna) -> float:
    observation = seen(state, yaw_deg, section)
    assert observation is not None
    return math.degrees(float(observation.innovation[0]))


@pytest.mark.parametrize("offset_deg", [0.0, 90.0, -135.0])
@pytest.mark.parametrize("seed", [0, 2, 3, 4, 5])  # of attitudes in which no baseline is nearly vertical
def test_jacobian_against_finite_differences(seed: int, offset_deg: float) -> None:
    section = antennas(offset_deg=offset_deg)
    state = running_state(np.random.default_rng(seed), size=WIDE_SIZE)
    observation = seen(state, 70.0, section)
    assert observation is not None
    assert (observation.jacobian.shape, observation.variance.shape) == ((1, WIDE_SIZE), (1,))
    for i in range(WIDE_SIZE):
        ends = []
        for sign in (1, -1):
            moved, error = state.copy(), np.zeros(WIDE_SIZE)
            error[i] = sign * STEP
            inject(moved, error)
            ends.append(math.radians(innovation_deg(moved, 70.0, section)))
        slope = -math.remainder(ends[0] - ends[1], 2 * math.pi) / (2 * STEP)
        # along the ground the north direction turns by 1 m in 6,400 km, which is left out
        assert observation.jacobian[0, i] == pytest.approx(slope, rel=1e-5, abs=1e-6), f"error {i}"
    assert np.abs(observation.jacobian[0, ATTITUDE]).max() > 0.1


@pytest.mark.parametrize(
    ("yaw", "reading", "difference"),
    [(30.0, 33.0, 3.0), (30.0, 27.0, -3.0), (-1.0, 2.0, 3.0), (179.0, 182.0, 3.0), (-179.0, 179.0, -2.0), (0.0, 360.0, 0.0)],
)
def test_innovation_is_the_shorter_way_round(yaw: float, reading: float, difference: float) -> None:
    assert innovation_deg(turned(0.0, 0.0, yaw), reading, antennas()) == pytest.approx(difference, abs=1e-9)


def test_offset_is_that_of_the_baseline_clockwise_from_forward() -> None:
    across = antennas(offset_deg=90.0)  # from the left antenna to the right one
    assert innovation_deg(turned(0.0, 0.0, 40.0), 130.0, across) == pytest.approx(0.0, abs=1e-9)
    assert innovation_deg(turned(0.0, 25.0, 40.0), 130.0, across) == pytest.approx(0.0, abs=1e-9)


def test_a_baseline_across_a_vehicle_that_leans() -> None:
    """With roll and pitch the yaw of a baseline to the right is not the vehicle's and 90 degrees."""
    roll, pitch = 20.0, 15.0
    right_n = matrix_from_euler(math.radians(roll), math.radians(pitch), 0.0)[:, 1]
    reading = math.degrees(math.atan2(right_n[1], right_n[0]))
    assert abs(reading - 90.0) > 5.0
    assert innovation_deg(turned(roll, pitch, 0.0), reading, antennas(offset_deg=90.0)) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("pitch", "used"), [(78.0, True), (79.0, False), (-90.0, False), (90.0, False)])
def test_a_baseline_that_is_nearly_vertical_has_no_yaw(pitch: float, used: bool) -> None:
    assert (seen(turned(0.0, pitch, 10.0), 10.0, antennas()) is not None) is used


def test_values_and_parameters() -> None:
    section = antennas(sigma_deg=0.5)
    assert gnss_yaw.parameters(section).shape == (PARAMETERS,)
    half = math.radians(0.5)
    for sigma, used in ((None, half), (0.0, half), (half / 2, half), (3 * half, 3 * half)):
        sine, cosine, variance = gnss_yaw.values(GnssYaw(2.0, sigma), section)
        assert (sine, cosine) == (pytest.approx(math.sin(2.0)), pytest.approx(math.cos(2.0)))
        assert variance == pytest.approx(used * used)


@pytest.mark.parametrize(("yaw", "reason"), [(math.nan, "not finite"), (math.inf, "not finite"), (7.0, "impossible yaw")])
def test_a_yaw_that_is_none(yaw: float, reason: str) -> None:
    with pytest.raises(Unusable, match=reason):
        gnss_yaw.values(GnssYaw(yaw), antennas())
