"""A day's drive at 400 Hz in the compiled kernel: the covariance stays symmetric, positive definite and consistent.

A closed ten-minute course with standstills and GNSS outages is driven repeatedly, each time with new noise. The events are
prepared in arrays for the kernel, so that a day takes minutes.
"""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from fusiond.config.schema import Config
from fusiond.filter.kernel.interpreted import compiled_available, make_kernel
from fusiond.filter.observations import IMU, MODEL
from fusiond.filter.parameters import make_parameters
from fusiond.filter.rows import ROW, Outcome
from fusiond.filter.state import BLOWN, POSITION_E, RESETS, VELOCITY_E, FilterState
from fusiond.filter.step import run_one
from fusiond.maths.wgs84 import ecef, mat_ne
from fusiond.simulation.drive import simulate
from fusiond.simulation.scenario import parse
from fusiond.simulation.truth import Truth
from fusiond.units import SECOND

IMU_HZ, WHEEL_HZ, GNSS_HZ, SEED = 400, 100, 5, 20
ACCEL_NOISE, GYRO_NOISE, WHEEL_SIGMA, POSITION_SIGMA, VELOCITY_SIGMA = 0.02, 5e-4, 0.05, 1.0, 0.1
OUTAGE_S = (200.0, 320.0)  # of each round
CHECK_EVERY = 20_000  # rows between two checks of the covariance
COURSE = """
[start]
latitude_deg = 48.0
longitude_deg = 11.0
[imu]
rate_hz = 400.0
position_m = [0.0, 0.0, 0.0]
[gnss]
rate_hz = 5.0
[wheels]
rate_hz = 10.0
chatter = false
""" + "".join(
    f"[[segment]]\nduration_s = {duration}\nspeed_mps = {speed}\nturn_deg = {turn}\n"
    for duration, speed, turn in [
        (20, 0.0, 0.0),
        (20, 15.0, 0.0),
        (80, 15.0, 0.0),
        (40, 15.0, 180.0),
        (120, 15.0, 0.0),
        (20, 0.0, 0.0),  # half way: opposite of the start
        (20, 0.0, 0.0),
        (20, 15.0, 0.0),
        (80, 15.0, 0.0),
        (40, 15.0, 180.0),
        (120, 15.0, 0.0),
        (20, 0.0, 0.0),
    ]
)
WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
CONFIG = {
    "filter": {"heading_deg": 0.0, "snapshot_interval_s": 3600.0},
    "mavlink": {"link": {}},
    "can": {"bus": {}},
    "imu": {"imu0": {"link": "link", "accel_noise": ACCEL_NOISE, "gyro_noise": GYRO_NOISE}},
    "gnss": {"gps0": {"link": "link", "position_sigma_m": POSITION_SIGMA, "velocity_sigma_mps": VELOCITY_SIGMA}},
    "wheel": {name: {"bus": "bus", "message": "m", "signal": "s", "sigma_mps": WHEEL_SIGMA} for name in WHEELS},
}


class Course:
    """One round of the course as rows of the kernel, without noise; `rows` adds it."""

    def __init__(self) -> None:
        self.truth: Truth = simulate(parse(COURSE), SEED).truth
        self.params = make_parameters(msgspec.convert(CONFIG, Config))
        truth, n = self.truth, len(self.truth.t_ns)
        self.round_ns = n * SECOND // IMU_HZ
        seconds = np.arange(n) / IMU_HZ
        fixes = np.arange(0, n, IMU_HZ // GNSS_HZ)
        fixes = fixes[(seconds[fixes] < OUTAGE_S[0]) | (seconds[fixes] >= OUTAGE_S[1])]
        imu = self._blank(np.arange(n), "imu0")
        imu["values"][:, 0:3], imu["values"][:, 3:6] = truth.specific_force_b, truth.angular_rate_b
        position, velocity = self._blank(fixes, "gps0.position"), self._blank(fixes, "gps0.velocity")
        position["values"][:, 0:3] = [ecef(truth.latitude[i], truth.longitude[i], truth.height[i]) for i in fixes]
        position["values"][:, 3:5] = POSITION_SIGMA**2, (3 * POSITION_SIGMA) ** 2
        velocity["values"][:, 0:3] = truth.velocity_n[fixes]
        velocity["values"][:, 3:5] = VELOCITY_SIGMA**2, 2
        parts = [imu, position, velocity]
        for name in WHEELS:
            wheel = self._blank(np.arange(0, n, IMU_HZ // WHEEL_HZ), name)
            wheel["values"][:, 0] = truth.speed[:: IMU_HZ // WHEEL_HZ]
            wheel["values"][:, 1] = WHEEL_SIGMA**2
            parts.append(wheel)
        table = np.concatenate(parts)
        self.table = table[np.lexsort((table["source"], table["t_ns"]))]
        self.kind = np.array(self.params.models)[self.table["source"]]

    def _blank(self, at: np.ndarray, source: str) -> np.ndarray:
        rows = np.zeros(len(at), dtype=ROW)
        rows["t_ns"] = at * SECOND // IMU_HZ
        rows["source"] = self.params.sources.index(source)
        return rows

    def rows(self, number: int, random: np.random.Generator) -> np.ndarray:
        """Round `number`, with noise of its own."""
        rows, values = self.table.copy(), self.table["values"].copy()
        rows["t_ns"] += number * self.round_ns
        imu, wheel = self.kind == IMU, (self.kind == MODEL["wheel_speed"]) & (values[:, 0] > 0)
        position, velocity = self.kind == MODEL["gnss_position"], self.kind == MODEL["gnss_velocity"]
        values[imu, 0:3] += random.normal(0, ACCEL_NOISE * IMU_HZ**0.5, (imu.sum(), 3))
        values[imu, 3:6] += random.normal(0, GYRO_NOISE * IMU_HZ**0.5, (imu.sum(), 3))
        values[wheel, 0] += random.normal(0, WHEEL_SIGMA, wheel.sum())
        values[position, 0:3] += random.normal(0, POSITION_SIGMA, (position.sum(), 3))
        values[velocity, 0:2] += random.normal(0, VELOCITY_SIGMA, (velocity.sum(), 2))
        rows["values"] = values
        return rows


def drive(rounds: int) -> tuple[FilterState, list[float]]:
    """Drive the course; returns the last state and the NEES of horizontal position and velocity at each look."""
    course, random = Course(), np.random.default_rng(SEED)
    settings = course.params
    kernel, head = make_kernel(settings), FilterState(len(settings.sources))
    counts = np.zeros((len(settings.sources), len(Outcome)), dtype=np.int64)
    memory = np.zeros((4096, len(head.numbers))), np.zeros((4096, len(head.whole)), dtype=np.int64)
    nees = []
    for number in range(rounds):
        rows = course.rows(number, random)
        kernel.attach(head, rows, counts, *memory, np.zeros(4096, dtype=np.int64))
        applied = 0
        for stop in [*range(CHECK_EVERY, len(rows), CHECK_EVERY), len(rows)]:
            limit = int(rows[stop - 1]["t_ns"])
            done = False
            while not done:
                applied, _, done = kernel.run(0, len(rows), applied, limit, 1)
                if not done:
                    applied = run_one(head, rows, applied, counts, settings)
            assert np.array_equal(head.covariance, head.covariance.T)
            np.linalg.cholesky(head.covariance)
            nees.append(_nees(head, course.truth, limit - number * course.round_ns))
    return head, nees


def _nees(head: FilterState, truth: Truth, t_ns: int) -> float:
    i = round(t_ns * IMU_HZ / SECOND)
    place = ecef(truth.latitude[i], truth.longitude[i], truth.height[i])
    to_n = mat_ne(place)
    error = np.concatenate([place - head.nominal[POSITION_E], to_n.T @ truth.velocity_n[i] - head.nominal[VELOCITY_E]])
    turn = np.kron(np.eye(2), to_n)
    error, covariance = turn @ error, turn @ head.covariance[:6, :6] @ turn.T
    level = [0, 1, 3, 4]
    return float(error[level] @ np.linalg.solve(covariance[np.ix_(level, level)], error[level]))


def check(rounds: int) -> None:
    head, nees = drive(rounds)
    assert head.stamps[RESETS] == 0
    assert head.stamps[BLOWN] == 0
    mean = float(np.mean(nees[len(nees) // rounds // 4 :]))
    print(f"{rounds} rounds, seed {SEED}: mean NEES of 4 degrees of freedom {mean:.2f}, largest {max(nees):.1f}")
    assert mean < 12  # within a factor of three in variance: successive checks are not independent


@pytest.mark.skipif(not compiled_available(), reason="the compiled kernel was not built")
def test_two_rounds() -> None:
    check(2)


@pytest.mark.slow
@pytest.mark.skipif(not compiled_available(), reason="the compiled kernel was not built")
def test_a_day() -> None:
    check(24 * 6)
