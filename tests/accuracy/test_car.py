"""The car's own sensors on simulated drives whose noise is as configured: calibrations learnt, errors as large as claimed, a
silent inertial sensor replaced, and faults that do no harm."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest

from benchmarks.study import nominal
from benchmarks.study.runs import begun, drive, error
from benchmarks.study.world import GNSS_NAME, IMU_NAME, Fault, Sensors
from fusiond.filter.state import (
    ATTITUDE,
    CALIBRATIONS,
    POSITION,
    STEERING_FACTOR_ERROR,
    STEERING_OFFSET_ERROR,
    UNDERSTEER_ERROR,
    VELOCITY,
    YAW_RATE_OFFSET_ERROR,
)
from fusiond.maths.typed import Array

CAR: dict[str, dict[str, Any]] = {"yaw_rate": {"sigma_deg_s": 0.3}, "steering": {"wheelbase_m": 2.7}}
LEARNT = (YAW_RATE_OFFSET_ERROR, STEERING_OFFSET_ERROR, STEERING_FACTOR_ERROR, UNDERSTEER_ERROR)
END_S = 58.0
WHEELS = tuple(nominal.WHEELS)


class Run:
    """Of one drive: errors (n,) at its end, their covariance, the horizontal error, and the course of the yaw error."""

    def __init__(
        self, seed: int, car: dict[str, dict[str, Any]], faults: tuple[Fault, ...], end_s: float, wheels: tuple[str, ...]
    ) -> None:
        random = np.random.default_rng(seed)
        rolling = {name: nominal.WHEELS[name] for name in wheels}
        world, fusion = begun(nominal.scenario(1, imu_hz=100.0), nominal.config(rolling, **car), random)

        def look(t: float, k: int) -> None:
            head = fusion.history.head
            self.error, self.covariance = error(head, world, k), head.covariance.copy()
            to_n = world.mat_ne[k]
            self.off_m = float(np.hypot(*(to_n @ self.error[POSITION])[:2]))
            self.sigma_m = float(np.sqrt(np.trace((to_n @ self.covariance[POSITION, POSITION] @ to_n.T)[:2, :2])))
            self.yaw_deg = float(np.degrees((to_n @ self.error[ATTITUDE])[2]))
            self.first = fusion.params.calibration_variances

        measurements = Sensors(world, 20.0, faults=faults).measurements()
        drive(fusion, measurements, [end_s], look)

    def nees(self, block: slice) -> float:
        off: Array = self.error[block]
        return float(off @ np.linalg.solve(self.covariance[block, block], off))


@functools.cache
def run(
    seed: int, with_car: bool, faults: tuple[Fault, ...] = (), end_s: float = END_S, wheels: tuple[str, ...] = WHEELS
) -> Run:
    return Run(seed, CAR if with_car else {}, faults, end_s, wheels)


def test_what_the_car_reads_is_learnt_and_errors_are_as_large_as_claimed() -> None:
    runs = [run(seed, True) for seed in range(8)]
    for block in LEARNT:
        first = runs[0].first[block.start - CALIBRATIONS]
        learnt = np.mean([one.covariance[block, block][0, 0] for one in runs])
        assert learnt < 0.5 * first
        assert np.mean([one.nees(block) for one in runs]) < 2.8  # 99.8 % of the mean of 8 chi-square variables of 1 degree
    for block in (POSITION, VELOCITY, ATTITUDE):
        assert 1.1 < np.mean([one.nees(block) for one in runs]) < 5.6  # 3 degrees, 0.1 % to 99.9 %


@pytest.mark.parametrize(("wheels", "share"), [(("rear_left",), 0.05), (WHEELS, 0.8)])
def test_the_car_replaces_a_silent_inertial_sensor(wheels: tuple[str, ...], share: float) -> None:
    """GNSS falls silent at 35 s, and the inertial sensor at 40 s, for ten seconds, in bends. With one wheel nothing else
    tells the turn: 50 m off, with the car's own sensors 0.8 m. The difference of four wheels does: 2.1 m, and 1.4 m."""
    faults = (Fault(GNSS_NAME, "absent", 35.0, 1e6), Fault(IMU_NAME, "absent", 40.0, 50.0))
    alone, helped = ([run(seed, with_car, faults, 50.5, wheels) for seed in range(8)] for with_car in (False, True))
    worse, better = (np.sqrt(np.mean([one.off_m**2 for one in runs])) for runs in (alone, helped))
    assert better < share * worse
    assert all(one.off_m < 3 * one.sigma_m for one in helped)
    assert np.mean([one.sigma_m for one in helped]) < np.mean([one.sigma_m for one in alone])


@pytest.mark.parametrize("source", ["yaw_rate", "steering"])
@pytest.mark.parametrize(("kind", "size"), [("stuck", 0.0), ("noisy", 8.0), ("scale", 0.0), ("absent", 0.0)])
def test_a_sensor_of_the_car_that_fails_does_no_harm(source: str, kind: str, size: float) -> None:
    faults = (Fault(source, kind, 25.0, 1e6, size), Fault(GNSS_NAME, "absent", 40.0, 1e6))
    for seed in range(2):
        failed, without = run(seed, True, faults), run(seed, False, (Fault(GNSS_NAME, "absent", 40.0, 1e6),))
        assert failed.off_m < max(3 * failed.sigma_m, without.off_m + 1.0)
        assert abs(failed.yaw_deg) < abs(without.yaw_deg) + 1.0
