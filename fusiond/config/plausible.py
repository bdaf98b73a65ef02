"""What values of a configuration are plausible: a value beyond is allowed, and probably a mistake of unit or sign."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

from fusiond.config.schema import Config
from fusiond.config.sensor import point_in_words, vector_in_words
from fusiond.config.toml import Section

RADIANS = math.pi / 2  # mounts are mostly multiples of it
CLOSE = 0.005  # rad: how near to a multiple a number in radians is written
OFF_M = 0.5  # how far the wheels that are not steered may be from the point that does not slip sideways
ABOVE_M = 0.3  # how far an antenna may be below the IMU, or a wheel's contact point above it


class Range(NamedTuple):
    """The least and the largest plausible value, and what may be wrong beyond."""

    least: float
    most: float
    ask: str


SIGMA = "the filter believes what it is told"
RANGES = {  # by table and key; of vectors, of their size
    "filter.v_max_mps": Range(0.2, 150.0, "is it in m/s?"),
    "filter.course_speed_mps": Range(0.2, 60.0, "is it in m/s?"),
    "filter.horizon_s": Range(0.05, 60.0, "is it in s?"),
    "filter.wheel_scale_sigma": Range(0.0, 0.2, "1 is 100 %"),
    "filter.mount_sigma_deg": Range(0.0, 15.0, "larger angles belong into rotation_deg; see `fusiond mount`"),
    "imu.accel_noise": Range(1e-5, 5.0, "is it in m/s^2/sqrt(Hz)?"),
    "imu.gyro_noise": Range(1e-7, 0.2, "is it in rad/s/sqrt(Hz)?"),
    "imu.accel_bias_sigma": Range(0.0, 3.0, "is it in m/s^2?"),
    "imu.gyro_bias_sigma": Range(0.0, 0.2, "is it in rad/s?"),
    "imu.delay_ms": Range(-1.0, 1000.0, "is it in ms?"),
    "gnss.position_sigma_m": Range(1e-3, 100.0, SIGMA),
    "gnss.height_sigma_m": Range(1e-3, 200.0, SIGMA),
    "gnss.velocity_sigma_mps": Range(1e-3, 10.0, SIGMA),
    "gnss.interval_s": Range(0.01, 10.0, "is it in s?"),
    "dual_antenna.sigma_deg": Range(0.01, 30.0, SIGMA),
    "barometer.sigma_m": Range(0.01, 50.0, SIGMA),
    "wheel.sigma_mps": Range(1e-3, 5.0, SIGMA),
    "wheel.radius_m": Range(0.02, 2.0, "is it in metres?"),
    "wheel.scale": Range(0.1, 10.0, "units are converted by `unit`"),
}


def implausible(config: Config) -> Iterator[tuple[str, str]]:
    """The dotted key of each implausible value, and why it is."""
    yield from _beyond(config)
    for name, imu in config.imu.items():
        if any(imu.rotation_deg) and all(_is_in_radians(angle) for angle in imu.rotation_deg):
            yield f"imu.{name}.rotation_deg", f"{vector_in_words(imu.rotation_deg)} looks like radians; it is in degrees"
    for name, gnss in config.gnss.items():
        if gnss.lever_arm_m[2] > ABOVE_M:
            yield (
                f"gnss.{name}.lever_arm_m",
                f"puts the antenna {gnss.lever_arm_m[2]:g} m below the IMU; the third number is down",
            )
    for name, wheel in config.wheel.items():
        if wheel.position_m[2] < -ABOVE_M:
            yield (
                f"wheel.{name}.position_m",
                f"puts its contact point {-wheel.position_m[2]:g} m above the IMU; the third number is down",
            )
    axles = [wheel.position_m[0] for wheel in config.wheel.values() if not wheel.steered and any(wheel.position_m)]
    if config.motion.non_holonomic and axles:
        mean, point = sum(axles) / len(axles), config.motion.point_m
        if not min(axles) - OFF_M <= point[0] <= max(axles) + OFF_M:
            words = f"{point_in_words(point)} is not between the wheels that are not steered, {mean:g} m forward of the IMU"
            yield "motion.point_m", f"{words}; is its sign right?"


def _beyond(config: Config) -> Iterator[tuple[str, str]]:
    sections: list[tuple[str, str, Section]] = [("filter", "filter", config.filter)]
    sections += [(table, f"{table}.{name}", section) for table, name, section in config.sensors()]
    for table, where, section in sections:
        for key, (least, most, ask) in RANGES.items():
            kind, _, field = key.partition(".")
            value = getattr(section, field) if kind == table else None
            if value is not None and not least <= abs(value) <= most:
                yield f"{where}.{field}", f"{value:g} is not between {least:g} and {most:g}, as is usual: {ask}"


def _is_in_radians(angle: float) -> bool:
    return abs(angle) < 2 * math.pi + CLOSE and abs(angle - RADIANS * round(angle / RADIANS)) < CLOSE
