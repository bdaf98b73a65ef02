"""An autopilot whose low-pass filters delay its inertial samples, as ArduPilot Rover's do: what that costs, and what
learning the delays gives back."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import msgspec
import numpy as np

from benchmarks.study.recorded import LOOK_NS, Recorded, Segment, changed, installed, recorded, scenario
from benchmarks.study.report import Section
from benchmarks.study.runs import spread
from fusiond.config.schema import Config, Filter, Imu, Motion
from fusiond.estimator.fusion import Fusion
from fusiond.filter.calibration import calibrations
from fusiond.maths.typed import Array
from fusiond.simulation.wgs84 import radii
from fusiond.units import SECOND

DRIVE_S, FROM_S = 200.0, 30.0  # of a drive; errors count from the latter on
GYRO_HZ, ACCEL_HZ = 4.0, 10.0  # INS_GYRO_FILTER and INS_ACCEL_FILTER of a stock Rover
SIGMA_MS = 50.0  # first sigma of the delays where they are learnt
SLIP = 0.5  # deg per m/s^2, of a car's tyres
ROVER: dict[str, dict[str, Any]] = {
    "vehicle": {"wheelbase_m": 0.6, "track_m": 0.6, "roll_deg_per_mps2": 0.2},
    "imu": {"rate_hz": 50.0, "position_m": [0.2, 0.0, -0.3]},
    "gnss": {
        "antenna_m": [0.1, 0.0, -0.6], "sigma_m": 0.05, "drift_sigma_m": 0.02,
        "height_sigma_m": 0.1, "height_drift_sigma_m": 0.05,
    },
    "wheels": {"rate_hz": 20.0, "unsigned": False},
}  # fmt: skip


class Case(NamedTuple):
    """The filters' cutoffs [Hz], the tyres' slip [deg per m/s^2], the first sigma of the delays [ms]."""

    gyro_hz: float = GYRO_HZ
    accel_hz: float = ACCEL_HZ
    slip: float = 0.0
    sigma_ms: float = SIGMA_MS


CASES = {
    "no filters, delays not learnt": Case(0.0, 0.0, sigma_ms=0.0),
    "no filters, learnt": Case(0.0, 0.0),
    "a Rover's filters, not learnt": Case(sigma_ms=0.0),
    "a Rover's filters, learnt": Case(),
    "the same, tyres slip, not learnt": Case(slip=SLIP, sigma_ms=0.0),
    "the same, tyres slip, learnt": Case(slip=SLIP),
}


class Found(NamedTuple):
    """Horizontal RMSE [m], yaw RMSE [deg] and the largest yaw error in its own sigmas; share of instants with the yaw inside
    3 sigma; the calibrations at the end, value and sigma; resets."""

    position: float
    yaw: float
    worst_sigmas: float
    inside: float
    learnt: dict[str, tuple[float, float]]
    resets: int


def delay_ms(cutoff_hz: float) -> float:
    """What a Butterworth filter of the second order delays slow motion by."""
    return 1e3 * math.sqrt(2) / (2 * math.pi * cutoff_hz) if cutoff_hz else 0.0


def course(random: np.random.Generator) -> list[Segment]:
    """3 to 6 m/s with a bend every few seconds, from standstill on."""
    segments: list[Segment] = [{"duration_s": 5.0}, {"duration_s": 4.0, "speed_mps": 4.0}]
    while sum(segment["duration_s"] for segment in segments) < DRIVE_S:
        side = float(random.choice((-1.0, 1.0)))
        segments += [
            {"duration_s": float(random.uniform(3, 8)), "speed_mps": float(random.uniform(3, 6))},
            {"duration_s": float(random.uniform(2.5, 5)), "turn_deg": side * float(random.uniform(45, 150))},
        ]
    return segments


def by_default(config: Config) -> Config:
    """The configuration with the defaults for all that is not measured at the vehicle."""
    imus = {name: Imu(link=imu.link) for name, imu in config.imu.items()}
    wheels = {
        name: msgspec.structs.replace(wheel, **{key: defaults[key] for key in ("sigma_mps", "correlation_s")})
        for name, wheel in config.wheel.items()
        for defaults in ({field.name: field.default for field in msgspec.structs.fields(wheel)},)
    }
    motion = Motion(point_m=config.motion.point_m)
    return msgspec.structs.replace(installed(config), imu=imus, wheel=wheels, filter=Filter(), motion=motion)


def one(name: str, seed: int, run: int) -> Found:
    case, random = CASES[name], np.random.default_rng([seed, run, 6])
    tables = ROVER | {
        "vehicle": ROVER["vehicle"] | {"slip_deg_per_mps2": case.slip},
        "imu": ROVER["imu"] | {"gyro_filter_hz": case.gyro_hz, "accel_filter_hz": case.accel_hz},
    }
    made = recorded(scenario(random, DRIVE_S, segments=course(random), **tables), int(random.integers(1 << 31)))
    fusion = Fusion(changed(by_default(made.config), "imu", delay_sigma_ms=case.sigma_ms))
    looks = followed(fusion, made)
    return Found(
        float(np.sqrt(np.mean(looks[:, 0] ** 2))), math.degrees(float(np.sqrt(np.mean(looks[:, 1] ** 2)))),
        float(np.abs(looks[:, 2]).max()), float((np.abs(looks[:, 2]) < 3).mean()),
        calibrations(fusion.params, fusion.history.head), fusion.solution_at(int(made.truth.t_ns[-1])).resets,
    )  # fmt: skip


def followed(fusion: Fusion, drive: Recorded) -> Array:
    """Feed a drive, and look at what would be published, ten times a second: horizontal error [m], yaw error [rad], the same
    in its sigmas (N, 3)."""
    truth = drive.truth
    due = np.arange(drive.start_ns + int(FROM_S * SECOND), int(truth.t_ns[-1]), LOOK_NS)
    latitude, longitude, height = (np.interp(due, truth.t_ns, x) for x in (truth.latitude, truth.longitude, truth.height))
    yaws = np.interp(due, truth.t_ns, np.unwrap(truth.euler[:, 2]))
    meridian, transverse = radii(latitude)
    rows, number = [], 0
    for event in drive.events:
        while number < len(due) and due[number] < event.t_receive_ns:
            state = fusion.solution_at(int(due[number])).state
            assert state is not None
            north = (state.latitude - latitude[number]) * (meridian[number] + height[number])
            east = (state.longitude - longitude[number]) * (transverse[number] + height[number]) * math.cos(state.latitude)
            yaw = math.remainder(state.euler()[2] - float(yaws[number]), 2 * math.pi)
            rows.append((math.hypot(north, east), yaw, yaw / state.sigma_yaw()))
            number += 1
        fusion.feed(event)
    return np.array(rows)


def delay(runs: int, seed: int) -> Section:
    section = Section("Delay of the inertial sensor")
    section.say(
        f"{runs} drives of the simulator, seed {seed}: {DRIVE_S:.0f} s at 3 to 6 m/s with bends of 45 to 150 deg, IMU "
        "50 Hz, GNSS of some 5 cm at 5 Hz, wheels 20 Hz; lever arms as measured, else the default configuration. A Rover's "
        f"filters ({GYRO_HZ:g} Hz gyro, {ACCEL_HZ:g} Hz accelerometer) delay by {delay_ms(GYRO_HZ):.1f} and "
        f"{delay_ms(ACCEL_HZ):.1f} ms. Learnt: `imu.delay_sigma_ms` = {SIGMA_MS:g}. Tyres slip: {SLIP} deg per m/s^2. "
        f"Errors from {FROM_S:.0f} s on; yaw in sigmas: the largest of all runs."
    )
    rows = []
    for name, case in CASES.items():
        found = spread(one, [(name, seed, run) for run in range(runs)])
        cells = []
        for key, true in (
            ("gyro_delay_ms", delay_ms(case.gyro_hz)), ("accel_delay_ms", delay_ms(case.accel_hz)),
            ("slip_deg_per_mps2", case.slip),
        ):  # fmt: skip
            learnt = [f.learnt[key] for f in found if key in f.learnt]
            off = max((abs(value - true) for value, _ in learnt), default=0.0)
            mean, sigma = (float(np.mean([pair[i] for pair in learnt])) if learnt else 0.0 for i in range(2))
            cells.append(f"{mean:.3g} +- {sigma:.2g} ({off:.2g})" if learnt else "-")
        rows.append(
            (name, f"{np.sqrt(np.mean([f.position**2 for f in found])):.2f} m",
             f"{np.sqrt(np.mean([f.yaw**2 for f in found])):.2f} deg", f"{max(f.worst_sigmas for f in found):.1f}",
             f"{np.mean([f.inside for f in found]):.1%}", *cells, sum(f.resets for f in found))
        )  # fmt: skip
    head = ("drive", "position, RMSE", "yaw, RMSE", "yaw in sigmas", "yaw inside 3 sigma", "gyro delay [ms] (worst error)",
            "accelerometer delay [ms]", "slip [deg per m/s^2]", "resets")  # fmt: skip
    section.table(head, rows)
    return section
