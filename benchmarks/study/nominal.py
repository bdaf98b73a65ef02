"""The nominal scenario: a drive that never stands, a configuration whose every number is the truth's."""

from __future__ import annotations

from typing import Any

import msgspec

from fusiond.config.schema import Config
from fusiond.simulation.scenario import Scenario

WHEELS: dict[str, dict[str, Any]] = {
    "front_left": {"position_m": (1.6, -0.75, 0.6), "steered": True},
    "front_right": {"position_m": (1.6, 0.75, 0.6), "steered": True},
    "rear_left": {"position_m": (-1.1, -0.75, 0.6)},
    "rear_right": {"position_m": (-1.1, 0.75, 0.6)},
}
SETTINGS: dict[str, dict[str, Any]] = {
    "filter": {
        "wheel_scale_sigma": 0.01,
        "mount_sigma_deg": 1.0,
        "mount_walk_deg": 0.0,
        "heading_sigma_deg": 2.0,
        "level_sigma_deg": 0.5,
    },
    "motion": {
        "point_m": (-1.1, 0.0, 0.6),
        "lateral_sigma_mps": 0.1,
        "vertical_sigma_mps": 0.1,
        "standstill": False,
    },
    "imu": {
        "accel_noise": 0.01,
        "gyro_noise": 5e-4,
        "accel_bias_sigma": 0.1,
        "gyro_bias_sigma": 0.003,
        "accel_bias_walk": 2e-4,
        "gyro_bias_walk": 1e-5,
    },
    "gnss": {
        "lever_arm_m": (-0.3, 0.2, -1.0),
        "position_sigma_m": 1.0,
        "height_sigma_m": 2.0,
        "velocity_sigma_mps": 0.1,
        "interval_s": 0.2,
        "position_correlation_s": 0.0,
        "velocity_correlation_s": 0.0,
        "stamp_sigma_ms": 0.0,
    },
    "wheel": {"unsigned": False, "sigma_mps": 0.05, "least_mps": 0.0},
}
IMU_HZ = 200.0
TOWN = [  # duration [s], speed at the end [m/s], turn [deg], slope at the end [deg]
    (6, 12, 0, 0), (10, 15, 90, 2), (10, 18, 0, 0), (8, 10, -60, -3), (10, 14, -120, 0), (8, 8, 0, 0), (8, 15, 90, 1),
]  # fmt: skip


def config(wheels: dict[str, dict[str, Any]] | None = None, **changes: dict[str, Any]) -> Config:
    """The nominal configuration with some keys of filter, motion, imu, gnss or wheel (all of them) changed."""
    tables = {name: table | changes.get(name, {}) for name, table in SETTINGS.items()}
    wheel = {"bus": "bus", "message": "m", "signal": "s"} | tables["wheel"]
    raw = {
        "filter": tables["filter"],
        "motion": tables["motion"],
        "mavlink": {"link": {}},
        "can": {"bus": {}},
        "imu": {"imu0": {"link": "link"} | tables["imu"]},
        "gnss": {"gps0": {"link": "link"} | tables["gnss"]},
        "wheel": {name: wheel | own for name, own in (WHEELS if wheels is None else wheels).items()},
    }
    for table in ("yaw_rate", "steering"):  # the car's own sensors are only there where they are asked for
        if table in changes:
            raw[table] = {table: {"bus": "bus", "signal": "m.s"} | changes[table]}
    return msgspec.convert(raw, Config)


def scenario(
    rounds: int = 1, heading_deg: float = 30.0, course: list[tuple[float, float, float, float]] | None = None,
    speed: float = 8.0, imu_hz: float = IMU_HZ, grade_deg: float = 0.0,
) -> Scenario:  # fmt: skip
    """The town course, driven so many times, 60 s each, or another one."""
    segments = [
        {"duration_s": duration, "speed_mps": end, "turn_deg": turn, "grade_deg": grade}
        for duration, end, turn, grade in (TOWN if course is None else course) * rounds
    ]
    start = {"speed_mps": speed, "heading_deg": heading_deg, "grade_deg": grade_deg}
    return msgspec.convert({"segment": segments, "imu": {"rate_hz": imu_hz}, "start": start}, Scenario)
