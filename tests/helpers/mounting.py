"""A simulated drive with much motion, for the tests of the mounting angles."""

from __future__ import annotations

import atexit
import math
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from fusiond.app.mounting.windows import Gathering, Windows
from fusiond.config import load as config
from fusiond.config.schema import Config
from fusiond.events import Measurement
from fusiond.maths.typed import Array
from fusiond.simulation.scenario import parse
from fusiond.timeline.clock import Clock
from fusiond_adapters.logs.merge import open_logs
from fusiond_adapters.logs.write import write_drive

SCENARIO = """
[imu]
rate_hz = 50.0
accel_bias_sigma = 0.1
gyro_bias_sigma = 5e-3
vibration_hz = [17.0]
vibration_mps2 = 0.3
[gnss]
delay_ms = 100.0
velocity_sigma_mps = 0.1
[wheels]
rate_hz = 20.0
[[segment]]
duration_s = 4
[[segment]]
duration_s = 7
speed_mps = 14.0
grade_deg = 3.0
[[segment]]
duration_s = 8
turn_deg = 100.0
[[segment]]
duration_s = 6
speed_mps = 6.0
grade_deg = -2.0
[[segment]]
duration_s = 7
speed_mps = 15.0
turn_deg = -70.0
[[segment]]
duration_s = 8
speed_mps = 0.0
grade_deg = 0.0
[[segment]]
duration_s = 5
"""
ALL = ("imu0", "gps0", "front", "rear")
WITHIN = math.radians(3.0)


@cache
def folder() -> Path:
    """Where the simulated drive's files are."""
    temporary = TemporaryDirectory(prefix="fusiond-mount-")
    atexit.register(temporary.cleanup)
    write_drive(parse(SCENARIO), temporary.name)
    return Path(temporary.name)


@cache
def settings() -> Config:
    return config.load(folder() / "fusiond.toml")


@cache
def events() -> tuple[Measurement, ...]:
    """The simulated drive, aligned."""
    clock = Clock(settings())
    logs = open_logs([str(folder() / name) for name in ("drive.tlog", "drive.log")], settings())
    return tuple(event for event in map(clock.align, logs) if event is not None)


@cache
def windows(*kinds: str) -> Windows:
    """The drive by the sources whose names begin so."""
    gathering = Gathering(settings())
    for event in events():
        if event.source.startswith(kinds):
            gathering.add(event)
    return gathering.windows()


def angle_of(matrix: Array) -> float:
    """The angle of a rotation [rad]."""
    return math.acos((float(np.trace(matrix)) - 1) / 2)
