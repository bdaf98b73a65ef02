"""What is learnt of the installation: each state finds its truth inside its sigma, and is told by name."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from fusiond.estimator.fusion import Fusion
from fusiond.events import GnssPosition, GnssVelocity, Measurement, WheelSpeed
from fusiond.filter.calibration import calibrations
from fusiond.maths.wgs84 import ecef, geodetic, mat_ne
from tests.conftest import needs_compiled
from tests.helpers.streams import MS, SECOND, T0, config, drive, fuse, measurements

FACING = {"heading_deg": math.degrees(0.7), "heading_sigma_deg": 1.0}
LATE_S = 0.12


def installed(
    wheel_scale: float = 0.0, lever: tuple[float, float, float] = (0.0, 0.0, 0.0), late: bool = False
) -> list[Measurement]:
    """A drive with speed changes and bends; the receiver is elsewhere and late, and one wheel reads too much."""
    truth = drive(60.0, lambda t: 10.0 + 4.0 * np.sin(0.5 * t), lambda t: 0.7 + 0.9 * np.sin(0.25 * t), rate=50.0)
    held, delay = [], round(LATE_S * SECOND) if late else 0
    for event in measurements(truth, seed=4, gnss_hz=5.0):
        payload, k = event.payload, truth.at((event.t_ns - T0) / SECOND)
        if isinstance(payload, WheelSpeed) and event.source == "rear_left":
            payload = WheelSpeed((1 + wheel_scale) * payload.speed)
        if isinstance(payload, GnssPosition):
            place = ecef(payload.latitude, payload.longitude, payload.height) + truth.mat_eb[k] @ np.array(lever)
            latitude, longitude, height = geodetic(place)
            payload = msgspec.structs.replace(payload, latitude=latitude, longitude=longitude, height=height)
        if isinstance(payload, GnssVelocity):
            swing_n = mat_ne(truth.position_e[k]) @ truth.mat_eb[k] @ np.cross(truth.rate_b[k], lever)
            north, east, down = np.array([payload.north, payload.east, payload.down]) + swing_n
            payload = msgspec.structs.replace(payload, north=float(north), east=float(east), down=float(down))
        shift = delay if isinstance(payload, GnssPosition | GnssVelocity) else 0
        t_ns = event.t_ns + shift
        held.append(Measurement(t_ns, event.source, event.sequence, t_ns + 5 * MS, payload))
    return sorted(held, key=lambda event: event.key)


def learnt(fusion: Fusion) -> dict[str, tuple[float, float]]:
    return calibrations(fusion.params, fusion.history.head)


@needs_compiled
def test_the_delay_of_a_receiver() -> None:
    gnss = {"delay_sigma_ms": 100.0, "position_sigma_m": 1.0, "velocity_sigma_mps": 0.1}
    found = learnt(fuse(config(gnss=gnss, filter=FACING), installed(late=True), True))
    value, sigma = found["delay_ms"]
    assert abs(value - 1e3 * LATE_S) < 3 * sigma
    assert sigma < 15.0


@needs_compiled
def test_the_lever_arm_of_an_antenna() -> None:
    truth = (0.8, -0.5, -1.0)
    found = learnt(fuse(config(gnss={"lever_arm_sigma_m": 1.0}, filter=FACING), installed(lever=truth), True))
    for name, there in zip(("lever_arm_forward_m", "lever_arm_right_m"), truth, strict=False):
        value, sigma = found[name]
        assert abs(value - there) < 3 * sigma
        assert sigma < 0.4  # of 1 m
    assert found["lever_arm_down_m"][1] > 0.7  # a level drive tells nothing of it, and it is not claimed


@needs_compiled
def test_the_scale_of_one_wheel() -> None:
    settings = config(filter=FACING | {"wheel_scale_by": "wheel"})
    found = learnt(fuse(settings, installed(wheel_scale=0.015), True))
    for name in ("front_left", "front_right", "rear_left", "rear_right"):
        value, sigma = found[f"wheel_scale_{name}"]
        assert abs(value - (0.015 if name == "rear_left" else 0.0)) < 3 * sigma
        assert sigma < 0.005


def test_what_is_frozen_is_not_told(compiled: bool) -> None:
    fusion = Fusion(config(filter={"mount_sigma_deg": 0.0}), compiled)
    assert list(learnt(fusion)) == ["wheel_scale"]
    wide = Fusion(config(gnss={"delay_sigma_ms": 10.0}), compiled)
    assert list(learnt(wide)) == ["wheel_scale", "mount_pitch_deg", "mount_yaw_deg", "delay_ms"]
