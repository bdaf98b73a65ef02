"""An autopilot that filters its gyro at 4 Hz and its accelerometer at 10 Hz, as a stock ArduPilot Rover does, at the default
configuration: the delays are learnt, and the state is right."""

from __future__ import annotations

import pytest

from benchmarks.study.delay import ACCEL_HZ, GYRO_HZ, SLIP, delay_ms, one
from tests.conftest import needs_compiled

pytestmark = needs_compiled


@pytest.mark.parametrize(("case", "slip"), [("a Rover's filters, learnt", 0.0), ("the same, tyres slip, learnt", SLIP)])
def test_the_delays_are_learnt(case: str, slip: float) -> None:
    found = one(case, 1, 1)
    assert found.learnt["gyro_delay_ms"][0] == pytest.approx(delay_ms(GYRO_HZ), abs=10)
    assert found.learnt["accel_delay_ms"][0] == pytest.approx(delay_ms(ACCEL_HZ), abs=10)
    assert found.learnt["slip_deg_per_mps2"][0] == pytest.approx(slip, abs=0.1)
    assert found.position < 0.25
    assert found.yaw < 0.5
    assert found.inside == 1
    assert found.resets == 0


def test_the_delays_harm_where_they_are_not_learnt() -> None:
    """So the simulated filters are what they should be."""
    found = one("a Rover's filters, not learnt", 1, 0)
    assert found.yaw > 1.0
    assert found.worst_sigmas > 3
