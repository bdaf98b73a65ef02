"""Runs of the filter over a world: started from the truth and a known covariance, or left to start by itself."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from benchmarks.study.world import T0, World
from fusiond.config.schema import Config
from fusiond.estimator.fusion import Fusion
from fusiond.events import Measurement
from fusiond.filter.measurement import HORIZONTAL
from fusiond.filter.motion_constraints import watch
from fusiond.filter.observations import GNSS_POSITION
from fusiond.filter.parameters import Parameters
from fusiond.filter.rows import Outcome, Rows
from fusiond.filter.state import (
    ACCEL_BIAS,
    ACCEL_BIAS_B,
    ATTITUDE,
    CALIBRATIONS,
    FORCE_B,
    GYRO_BIAS,
    GYRO_BIAS_B,
    HELD_FORCE_B,
    HELD_RATE_B,
    MEAN_RATE_B,
    MOUNT_ERROR,
    PHASE,
    POSITION,
    POSITION_E,
    QUATERNION_EB,
    RATE_B,
    RUNNING,
    SCALE,
    T_CONSTRAINT,
    T_FIRST_VELOCITY,
    T_IMU,
    T_POSITION,
    T_START,
    VELOCITY,
    VELOCITY_E,
    FilterState,
    T,
)
from fusiond.maths.rotation import matrix, quaternion, quaternion_exp, quaternion_multiply
from fusiond.maths.typed import Array
from fusiond.simulation.scenario import Scenario
from fusiond.units import SECOND, nanoseconds

BLOCKS = {
    "position": POSITION,
    "velocity": VELOCITY,
    "attitude": ATTITUDE,
    "gyro bias": GYRO_BIAS,
    "accel bias": ACCEL_BIAS,
    "wheel scale": SCALE,
    "mount": MOUNT_ERROR,
}
COLLECT_EVERY = 20  # inertial samples
Result = TypeVar("Result")
MAX_LATE_NS = SECOND // 2  # no event of these drives is later than this
START_POSITION, START_VELOCITY = 2.0, 0.3  # m, m/s: sigmas per axis of a start from the truth


def spread(work: Callable[..., Result], jobs: Sequence[tuple[Any, ...]]) -> list[Result]:
    """work(*job) for each of the jobs, in their order, on all processors; work, jobs and results must be picklable."""
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(work, *zip(*jobs, strict=True)))


def start_covariance(world: World, params: Parameters) -> Array:
    """The covariance (n, n) of a start from the truth."""
    unit = params.imu
    level, heading = np.radians([params.filter.level_sigma_deg, params.filter.heading_sigma_deg])
    sigmas = np.zeros(params.size)
    for block, sigma in (
        (POSITION, START_POSITION),
        (VELOCITY, START_VELOCITY),
        (GYRO_BIAS, unit.gyro_bias_sigma),
        (ACCEL_BIAS, unit.accel_bias_sigma),
    ):
        sigmas[block] = sigma
    sigmas[CALIBRATIONS:] = np.sqrt(params.calibration_variances)
    covariance = np.diag(sigmas**2)
    to_n = world.mat_ne[0]
    covariance[ATTITUDE, ATTITUDE] = to_n.T @ np.diag([level**2, level**2, heading**2]) @ to_n
    return covariance


def true_state(world: World, k: int, params: Parameters) -> FilterState:
    """A filter state that holds the truth at the IMU's k-th instant."""
    state = FilterState(len(params.sources), params.size)
    x = state.nominal
    x[POSITION_E], x[VELOCITY_E] = world.position_e[k], world.velocity_e[k]
    x[QUATERNION_EB] = quaternion(world.mat_eb[k])
    x[GYRO_BIAS_B], x[ACCEL_BIAS_B] = world.gyro_bias[k], world.accel_bias[k]
    x[CALIBRATIONS + 1 : params.size + 1] = world.calibrations[k, : params.size - CALIBRATIONS]
    state.auxiliary[RATE_B] = state.auxiliary[MEAN_RATE_B] = world.rate_b[k] + world.gyro_bias[k]
    state.auxiliary[FORCE_B] = world.force_b[k] + world.accel_bias[k]
    return state


def begun(scenario: Scenario, config: Config, random: np.random.Generator) -> tuple[World, Fusion]:
    """A world, and the compiled filter that runs in it from its first instant on."""
    world, fusion = World(scenario, config, random), Fusion(config, compiled=True)
    started(fusion, world, random)
    return world, fusion


def started(fusion: Fusion, world: World, random: np.random.Generator) -> None:
    """Make the filter run from the first instant on: off the truth by one draw of `start_covariance`. Calibrations were
    drawn with the world, so their estimates start at nothing."""
    state = true_state(world, 0, fusion.params)
    covariance = start_covariance(world, fusion.params)
    off = np.linalg.cholesky(covariance + 1e-30 * np.eye(len(covariance))) @ random.standard_normal(len(covariance))
    x = state.nominal
    x[POSITION_E] -= off[POSITION]
    x[VELOCITY_E] -= off[VELOCITY]
    x[QUATERNION_EB] = quaternion_multiply(quaternion_exp(-off[ATTITUDE]), x[QUATERNION_EB])
    x[GYRO_BIAS_B] = x[ACCEL_BIAS_B] = 0.0  # drawn with the world too
    x[CALIBRATIONS + 1 :] = 0.0
    state.covariance[:] = covariance
    state.auxiliary[HELD_FORCE_B] = state.auxiliary[FORCE_B] = world.accel[0]
    state.auxiliary[HELD_RATE_B] = state.auxiliary[RATE_B] = world.gyro[0]
    state.stamps[[T, T_IMU, T_CONSTRAINT, T_POSITION, T_START, T_FIRST_VELOCITY]] = T0
    watch(state, world.accel[0], world.gyro[0], 1 / world.sensor.rate_hz, fusion.params)
    state.stamps[PHASE] = RUNNING
    history = fusion.history
    history.head.copy_from(state)
    history._snapshots.numbers[0], history._snapshots.whole[0] = state.numbers, state.whole


def error(state: FilterState, world: World, k: int) -> Array:
    """Error (n,) of a state at the IMU's k-th instant: true = estimate (+) error."""
    x, found = state.nominal, np.zeros(state.size)
    found[POSITION], found[VELOCITY] = world.position_e[k] - x[POSITION_E], world.velocity_e[k] - x[VELOCITY_E]
    turn = world.mat_eb[k] @ matrix(x[QUATERNION_EB]).T
    axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    sine, cosine = float(np.linalg.norm(axis)), (float(np.trace(turn)) - 1) / 2
    found[ATTITUDE] = axis * (np.arctan2(sine, cosine) / sine if sine > 1e-12 else 1.0)
    found[GYRO_BIAS], found[ACCEL_BIAS] = world.gyro_bias[k] - x[GYRO_BIAS_B], world.accel_bias[k] - x[ACCEL_BIAS_B]
    found[CALIBRATIONS:] = world.calibrations[k, : state.size - CALIBRATIONS] - x[CALIBRATIONS + 1 : state.size + 1]
    return found


def drive(
    fusion: Fusion,
    measurements: Iterable[Measurement],
    looks: Iterable[float],
    look: Callable[[float, int], None],
    ledger: Ledger | None = None,
) -> None:
    """Feed everything, and keep the ledger; at each of the times `looks` [s] from the start call look(t, k) as soon as the
    IMU's k-th sample, stamped at that time, was fused."""
    pending = iter(looks)
    t = next(pending, None)
    due = T0 + nanoseconds(t) if t is not None else -1
    imu = next(iter(fusion.config.imu))
    for measurement in measurements:
        fusion.fuse(measurement)
        if ledger is not None and measurement.source == imu and measurement.sequence % COLLECT_EVERY == 0:
            ledger.collect()
        if t is not None and measurement.source == imu and measurement.t_ns >= due:
            look(t, measurement.sequence)
            t = next(pending, None)
            due = T0 + nanoseconds(t) if t is not None else -1
    if ledger is not None:
        ledger.collect(last=True)


class Ledger:
    """The final outcome of every event of one run; `drive` keeps it."""

    def __init__(self, fusion: Fusion) -> None:
        self.fusion, self._edge = fusion, 0
        self._parts: list[Rows] = []

    def collect(self, last: bool = False) -> None:
        """Take the rows that no late event can change any more; all rows at the `last` call."""
        history = self.fusion.history
        edge = history.applied_ns - (0 if last else MAX_LATE_NS)
        self._parts.append(history.rows[(history.rows["t_ns"] > self._edge) & (history.rows["t_ns"] <= edge)].copy())
        self._edge = edge

    def of(self, source: str) -> Rows:
        """The events of one source, in their order."""
        rows: Rows = np.concatenate(self._parts)
        return np.asarray(rows[rows["source"] == self.fusion.history.index[source]])

    def normalised(self, source: str) -> tuple[Array, Array, int]:
        """Times [s], normalised innovations squared, degrees of freedom, of what was judged."""
        rows = self.of(source)
        rows = rows[rows["ratio"] > 0]
        freedom = int(np.count_nonzero(rows["variance"][0] > 0)) if len(rows) else 1
        if self.fusion.params.models[self.fusion.history.index[source]] == GNSS_POSITION:
            freedom = HORIZONTAL  # its height is judged apart
        return seconds(rows), rows["ratio"] * self.fusion.params.gates[freedom], freedom

    def rejected(self, source: str) -> tuple[Array, NDArray[np.bool_]]:
        """Times [s] and whether each event was rejected."""
        rows = self.of(source)
        return seconds(rows), rows["outcome"] == Outcome.REJECTED


def seconds(rows: Rows) -> Array:
    return np.asarray((rows["t_ns"] - T0) * 1e-9)
