"""Figures of a drive: noise densities, and the lag between two speeds."""

from __future__ import annotations

import numpy as np
import pytest

from fusiond.app.inspection.drive import imu_noise, lag


def test_noise_densities_of_a_sensor_that_also_moves() -> None:
    random = np.random.default_rng(1)
    t = np.arange(0, 60, 0.01)
    white = random.normal(0, [0.5] * 3 + [0.02] * 3, (len(t), 6))
    rows = np.column_stack([t, white + 3 * np.sin(t)[:, None]])
    accel, gyro = imu_noise(rows)
    assert accel == pytest.approx(0.5 * 0.1, rel=0.05)  # sigma times the root of the interval
    assert gyro == pytest.approx(0.02 * 0.1, rel=0.35)  # the motion is not negligible here


@pytest.mark.parametrize("delay_s", [-0.1, 0.0, 0.25, 0.6])
def test_the_lag_of_one_speed_behind_another(delay_s: float) -> None:
    t = np.arange(0, 100, 0.1)
    speed = 10 + 5 * np.sin(t / 3)
    gnss = np.stack([t + delay_s, speed], 1)
    found = lag(gnss, np.stack([t, 0.97 * speed], 1))  # the wheels' scale is not known
    assert found is not None
    assert found[0] == pytest.approx(delay_s, abs=0.011)
    assert found[1] < 0.02


def test_a_speed_that_never_changes_tells_no_lag() -> None:
    t = np.arange(0, 100, 0.1)
    steady = np.stack([t, np.full(len(t), 10.0)], 1)
    assert lag(steady, steady) is None
    assert lag(steady[:5], steady) is None
