"""The figures that makers of dead-reckoning receivers give: the 68th percentile of the error after 1000 m without GNSS, in
percent of the distance, and of the errors of heading, pitch, roll and velocity with GNSS, for inertial sensors of three
grades."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from benchmarks.study import nominal
from benchmarks.study.report import Section
from benchmarks.study.runs import begun, drive, error, spread
from benchmarks.study.world import GNSS_NAME, T0, Fault, Sensors
from fusiond.filter.state import ATTITUDE, POSITION, VELOCITY
from fusiond.maths.statistics import chi_square
from fusiond.maths.typed import Array
from fusiond.units import nanoseconds

IMU_HZ, WHEEL_HZ = 100.0, 20.0
OUTAGE_M = 1000.0
SETTLED_S, BEFORE_S = 120.0, 240.0  # errors with GNSS are taken between the two; then GNSS falls silent
LOOK_S = 0.5
SHARE = 0.68
ELLIPSE_95 = chi_square(0.95, 2)
GRADES: dict[str, dict[str, float]] = {  # by data sheets, with the vibration of a car on the noise
    "tactical": {
        "gyro_noise": 3e-5, "accel_noise": 2e-3, "gyro_bias_sigma": 1e-4, "accel_bias_sigma": 0.02,
        "gyro_bias_walk": 2e-7, "accel_bias_walk": 2e-5,
    },
    "automotive": {
        "gyro_noise": 2e-4, "accel_noise": 5e-3, "gyro_bias_sigma": 3e-3, "accel_bias_sigma": 0.1,
        "gyro_bias_walk": 2e-6, "accel_bias_walk": 1e-4,
    },
    "phone": {
        "gyro_noise": 5e-4, "accel_noise": 1e-2, "gyro_bias_sigma": 1e-2, "accel_bias_sigma": 0.3,
        "gyro_bias_walk": 1e-5, "accel_bias_walk": 3e-4,
    },
}  # fmt: skip
REAR = {name: nominal.WHEELS[name] for name in ("rear_left", "rear_right")}
VEHICLES: dict[str, dict[str, dict[str, Any]]] = {"four wheels": nominal.WHEELS, "two wheels": REAR, "no wheels": {}}
RECEIVER = {  # with the errors that last that real receivers have
    "position_sigma_m": 1.5, "height_sigma_m": 3.0, "velocity_sigma_mps": 0.1, "position_correlation_s": 30.0,
    "velocity_correlation_s": 2.0,
}  # fmt: skip


class Found(NamedTuple):
    """Of one drive: error at the end of the outage in percent of the distance, the claimed sigma in percent, whether the end
    is inside its 95 % ellipse; with GNSS the absolute errors (N,) of heading, pitch, roll [deg] and velocity [m/s]."""

    percent: float
    claimed: float
    inside: bool
    with_gnss: dict[str, list[float]]


def one(grade: str, vehicle: str, seed: list[int]) -> Found:
    """Drive once, and lose GNSS for OUTAGE_M."""
    random = np.random.default_rng(seed)
    config = nominal.config(VEHICLES[vehicle], imu=GRADES[grade], gnss=RECEIVER)
    world, fusion = begun(nominal.scenario(7, imu_hz=IMU_HZ), config, random)
    driven = np.cumsum(np.abs(world.speed)) / world.sensor.rate_hz
    since = driven - np.interp(BEFORE_S, world.t, driven)
    end = float(np.floor(np.interp(OUTAGE_M, since, world.t) / LOOK_S) * LOOK_S)
    found = Found(0.0, 0.0, False, {name: [] for name in ("heading", "pitch", "roll", "velocity")})

    def look(t: float, k: int) -> None:
        nonlocal found
        head, to_n = fusion.history.head, world.mat_ne[k]
        off = error(head, world, k)
        if t < BEFORE_S:
            _note(found.with_gnss, world.mat_nb[k].T @ to_n @ off[ATTITUDE], to_n @ off[VELOCITY], to_n @ off[ATTITUDE])
            return
        place = (to_n @ off[POSITION])[:2]
        claimed = (to_n @ head.covariance[POSITION, POSITION] @ to_n.T)[:2, :2]
        distance = float(np.interp(t, world.t, since))
        found = Found(
            100 * float(np.hypot(*place)) / distance,
            100 * float(np.sqrt(np.trace(claimed))) / distance,
            bool(place @ np.linalg.solve(claimed, place) <= ELLIPSE_95),
            found.with_gnss,
        )

    faults = (Fault(GNSS_NAME, "absent", BEFORE_S, 1e6),)
    last_ns = T0 + nanoseconds(end + LOOK_S)
    measurements = [m for m in Sensors(world, WHEEL_HZ, faults=faults).measurements() if m.t_ns <= last_ns]
    drive(fusion, measurements, [*np.arange(SETTLED_S, BEFORE_S, LOOK_S), end], look)
    return found


def _note(found: dict[str, list[float]], turn_b: Array, velocity_n: Array, turn_n: Array) -> None:
    """Add the absolute errors of one instant: of small rotations (3,) [rad] in body and in north-east-down axes."""
    found["heading"].append(abs(float(np.degrees(turn_n[2]))))
    found["pitch"].append(abs(float(np.degrees(turn_b[1]))))
    found["roll"].append(abs(float(np.degrees(turn_b[0]))))
    found["velocity"].append(float(np.hypot(*velocity_n[:2])))


def reckoning(runs: int, seed: int) -> Section:
    section = Section("1000 m without GNSS")
    section.say(
        f"{runs} drives of each kind, seed {seed}: {BEFORE_S:.0f} s with GNSS, whose errors last as those of real receivers "
        f"do, then {OUTAGE_M:.0f} m without, in the nominal course. 68 % below: the 68th percentile, as makers of receivers "
        "give it (u-blox ZED-F9K: 1 % of the distance, heading 0.2, pitch 0.3, roll 0.5 deg, with wheels). "
        f"With GNSS, the errors from {SETTLED_S:.0f} s on; the mount and all biases are learnt."
    )
    rows = []
    for grade in GRADES:
        for vehicle in VEHICLES:
            found = spread(one, [(grade, vehicle, [seed, run]) for run in range(runs)])
            percents = np.array([drive.percent for drive in found])
            errors = {
                name: np.quantile(np.concatenate([drive.with_gnss[name] for drive in found]), SHARE)
                for name in found[0].with_gnss
            }
            rows.append(
                (grade, vehicle, f"{np.quantile(percents, SHARE):.2f} %", f"{percents.max():.2f} %",
                 f"{np.sqrt(np.mean([drive.claimed**2 for drive in found])):.2f} %",
                 f"{100 * np.mean([drive.inside for drive in found]):.0f} %",
                 *(f"{errors[name]:.2f}" for name in ("heading", "pitch", "roll")), f"{errors['velocity']:.3f}")
            )  # fmt: skip
    head = (
        "inertial sensor", "vehicle", "error after 1000 m, 68 % below", "worst", "claimed", "in the 95 % ellipse",
        "heading [deg], 68 % below", "pitch", "roll", "velocity [m/s]",
    )  # fmt: skip
    section.table(head, rows)
    return section
