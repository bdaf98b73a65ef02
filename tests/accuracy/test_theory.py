"""Consistency by Monte Carlo: the errors of many runs against the covariance that the filter claims."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.estimator.fusion import Fusion
from fusiond.filter.state import (
    ACCEL_BIAS_B,
    ATTITUDE,
    GYRO_BIAS_B,
    POSITION,
    POSITION_E,
    QUATERNION_EB,
    VELOCITY,
    VELOCITY_E,
)
from fusiond.maths.rotation import matrix
from tests.conftest import needs_compiled
from tests.helpers.streams import SECOND, T0, Drive, config, measurements, town

RUNS, SECONDS = 10, 60.0
BLOCKS = {"position": POSITION, "velocity": VELOCITY, "attitude": ATTITUDE}
SETTINGS = config(
    filter={"heading_deg": math.degrees(0.7)},
    imu={"accel_bias_sigma": 0.05, "gyro_bias_sigma": 0.005},
    gnss={"position_sigma_m": 1.0, "height_sigma_m": 1.0, "velocity_sigma_mps": 0.1},
    wheel={"sigma_mps": 0.05, "least_mps": 0.1},
)


def errors(fusion: Fusion, truth: Drive, k: int) -> np.ndarray:
    """Position [m], velocity [m/s], attitude [rad], as true = estimate (+) error."""
    x = fusion.history.head.nominal
    turn = truth.mat_eb[k] @ matrix(x[QUATERNION_EB]).T
    small = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    return np.concatenate([truth.position_e[k] - x[POSITION_E], truth.velocity_e[k] - x[VELOCITY_E], small])


@pytest.fixture(scope="module")
def study() -> dict[str, np.ndarray]:
    """Normalised squared errors (runs, instants) of each block, every second from the tenth on, and of all measurements."""
    truth, rng = town(SECONDS), np.random.default_rng(11)
    found: dict[str, list[list[float]]] = {name: [] for name in (*BLOCKS, "gnss")}
    for run in range(RUNS):
        gyro, accel = rng.normal(0.0, 0.005, 3), rng.normal(0.0, 0.05, 3)
        events = measurements(truth, seed=100 + run, gyro_bias=tuple(gyro), accel_bias=tuple(accel))
        fusion, row, tested = Fusion(SETTINGS, True), {name: [] for name in BLOCKS}, []
        for event in events:
            fusion.fuse(event)
            if event.source == "imu0" and event.sequence % 100 == 0 and event.sequence >= 1000:
                error, covariance = errors(fusion, truth, event.sequence), fusion.history.head.covariance
                for name, block in BLOCKS.items():
                    part = error[block]
                    row[name].append(float(part @ np.linalg.solve(covariance[block, block], part)))
                rows = fusion.history.rows
                fixes = rows[(rows["source"] == 2) & (rows["t_ns"] > T0 + (event.sequence - 100) * SECOND // 100)]
                tested += (fixes["ratio"] * fusion.params.gates[2]).tolist()
        assert fusion.totals()["REJECTED"] < 0.01 * len(events)
        assert np.abs(fusion.history.head.nominal[GYRO_BIAS_B] - gyro).max() < 2e-3
        assert np.abs(fusion.history.head.nominal[ACCEL_BIAS_B] - accel).max() < 0.15
        for name, values in row.items():
            found[name].append(values)
        found["gnss"].append(tested)
    return {name: np.array(values) for name, values in found.items()}


@needs_compiled
@pytest.mark.parametrize("block", BLOCKS)
def test_errors_are_as_large_as_claimed(study: dict[str, np.ndarray], block: str) -> None:
    """B2: the mean of the normalised squared error is 3 for an honest filter. Errors are correlated over seconds, so the
    band is that of a few independent samples a run: over-confidence beyond a third, or timidity beyond a half, fails."""
    nees = study[block]
    assert 1.5 < nees.mean() < 4.0
    assert (nees < 7.815).mean() > 0.9  # 95 % of a chi-square variable of 3 degrees


@needs_compiled
def test_innovations_are_as_large_as_claimed(study: dict[str, np.ndarray]) -> None:
    """NIS of the positions, horizontal: their noise is white, so its mean over all runs lies close to 2."""
    nis = study["gnss"]
    assert nis.mean() == pytest.approx(2.0, abs=0.2)
