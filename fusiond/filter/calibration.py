"""What the filter has learnt of the installation, by names for people."""

from __future__ import annotations

import math
from collections.abc import Iterator

from fusiond.filter.parameters import Parameters
from fusiond.filter.state import (
    ANTENNA_ERROR,
    CALIBRATIONS,
    DELAYS_ERROR,
    FURTHER_SCALES_ERROR,
    HEIGHT_OFFSET_ERROR,
    INERTIAL_DELAYS_ERROR,
    MOUNT_ERROR,
    SCALE,
    SLIP_ERROR,
    STEERING_FACTOR_ERROR,
    STEERING_OFFSET_ERROR,
    UNDERSTEER_ERROR,
    YAW_RATE_OFFSET_ERROR,
    FilterState,
)

DEGREE = math.degrees(1.0)
MS_PER_S = 1000.0


def calibrations(params: Parameters, state: FilterState) -> dict[str, tuple[float, float]]:
    """Value and sigma of every calibration that is learnt, by a name that ends in its unit; a scale has none. Each is what
    it is more than configured."""
    found = {}
    for place, name, unit in _names(params):
        if place < state.size and params.calibration_variances[place - CALIBRATIONS] > 0:
            variance = max(0.0, float(state.covariance[place, place]))
            found[name] = float(state.nominal[place + 1]) * unit, math.sqrt(variance) * unit
    return found


def first_sigmas(params: Parameters) -> dict[str, float]:
    """The initial sigma of every calibration that is learnt, by the same names."""
    variances = params.calibration_variances
    return {
        name: math.sqrt(float(variances[place - CALIBRATIONS])) * unit
        for place, name, unit in _names(params)
        if place < params.size and variances[place - CALIBRATIONS] > 0
    }


def _names(params: Parameters) -> Iterator[tuple[int, str, float]]:
    """Error state, name and factor to the unit in it."""
    for group, name in enumerate(params.scales):
        yield SCALE.start if group == 0 else FURTHER_SCALES_ERROR.start + group - 1, name, 1.0
    yield MOUNT_ERROR.start, "mount_pitch_deg", DEGREE
    yield MOUNT_ERROR.start + 1, "mount_yaw_deg", DEGREE
    for axis, name in enumerate(("forward", "right", "down")):
        yield ANTENNA_ERROR.start + axis, f"lever_arm_{name}_m", 1.0
    yield DELAYS_ERROR.start, "delay_ms", MS_PER_S
    yield DELAYS_ERROR.start + 1, "velocity_delay_ms", MS_PER_S
    yield HEIGHT_OFFSET_ERROR.start, "height_offset_m", 1.0
    yield INERTIAL_DELAYS_ERROR.start, "gyro_delay_ms", MS_PER_S
    yield INERTIAL_DELAYS_ERROR.start + 1, "accel_delay_ms", MS_PER_S
    yield SLIP_ERROR.start, "slip_deg_per_mps2", DEGREE
    yield YAW_RATE_OFFSET_ERROR.start, "yaw_rate_offset_deg_s", DEGREE
    yield STEERING_OFFSET_ERROR.start, "steering_offset_deg", DEGREE
    yield STEERING_FACTOR_ERROR.start, "steering_factor", 1.0
    yield UNDERSTEER_ERROR.start, "understeer_deg_per_mps2", DEGREE
