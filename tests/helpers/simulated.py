"""Scenarios of the simulator for its tests, and the truth in other coordinates."""

from __future__ import annotations

import numpy as np

from fusiond.maths import wgs84 as earth
from fusiond.maths.rotation import matrix
from fusiond.maths.typed import Array
from fusiond.simulation.drive import Drive
from fusiond.simulation.scenario import Scenario, parse
from fusiond.simulation.truth import Truth

DRIVE = """
[[segment]]
duration_s = 3
[[segment]]
duration_s = 9
speed_mps = 14.0
[[segment]]
duration_s = 10
turn_deg = 100.0
grade_deg = 4.0
[[segment]]
duration_s = 10
turn_deg = -80.0
grade_deg = -3.0
[[segment]]
duration_s = 8
speed_mps = 0.0
grade_deg = 0.0
[[segment]]
duration_s = 4
[[segment]]
duration_s = 8
speed_mps = -3.0
turn_deg = 20.0
[[segment]]
duration_s = 8
speed_mps = 0.0
"""
CRUISE = "[start]\nspeed_mps = 10.0\n[[segment]]\nduration_s = {}\n"
REST = "[[segment]]\nduration_s = {}\n"
CLEAN = {  # no sensor noise at all
    "imu": "accel_noise = 0\ngyro_noise = 0\naccel_bias = [0, 0, 0]\ngyro_bias = [0, 0, 0]\n"
    "accel_bias_walk = 0\ngyro_bias_walk = 0\n",
    "gnss": "sigma_m = 0\nheight_sigma_m = 0\ndrift_sigma_m = 0\nheight_drift_sigma_m = 0\nvelocity_sigma_mps = 0\n",
    "wheels": "sigma_mps = 0\n",
}


def scenario(drive: str = DRIVE, clean: bool = True, **tables: str) -> Scenario:
    """A scenario of a drive and of lines for some tables, without noise unless asked for."""
    text = dict(tables)
    for name, lines in CLEAN.items() if clean else ():
        given = {line.split(" = ")[0] for line in tables.get(name, "").splitlines()}
        unsaid = [line for line in lines.splitlines() if line.split(" = ")[0] not in given]
        text[name] = "\n".join([*unsaid, tables.get(name, "")])
    return parse(drive + "".join(f"[{name}]\n{lines}\n" for name, lines in text.items()))


def ecef(latitude: Array, longitude: Array, height: Array) -> Array:
    return np.array([earth.ecef(*place) for place in zip(latitude, longitude, height, strict=True)])


def mats_nb(truth: Truth) -> Array:
    return np.array([matrix(quaternion) for quaternion in truth.quaternion_nb])


def seconds(drive: Drive, stamps_us: Array) -> Array:
    """Receive stamps as seconds from the start of the drive."""
    return (stamps_us - drive.scenario.start_ns // 1000) / 1e6
