"""The configuration as numbers: what stands in the row of each source."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.filter.observations import GNSS_POSITION, GNSS_VELOCITY, IMU, MODEL, WHEEL_SPEED, wheel_speed
from fusiond.filter.observations.model import CLUTTER, COMPANION, CORRELATION, NOISE_MAX, NOISE_MIN, RESETS, SHARED
from fusiond.filter.parameters import make_parameters
from fusiond.filter.state import (
    CALIBRATIONS,
    ERROR_SIZE,
    FURTHER_SCALES_ERROR,
    HEIGHT_OFFSET_ERROR,
    INERTIAL_DELAYS_ERROR,
    POSITION,
    SCALE,
    SLIP_ERROR,
    STEERING_FACTOR_ERROR,
    STEERING_OFFSET_ERROR,
    UNDERSTEER_ERROR,
    VELOCITY,
    WIDE_SIZE,
    YAW_RATE_OFFSET_ERROR,
)
from tests.helpers.streams import config

PARAMS = make_parameters(
    config(
        ("left", "right"),
        gnss={"position_correlation_s": 2.0, "velocity_correlation_s": 3.0, "outliers": "mixture", "outlier_share": 0.07},
        wheel={"correlation_s": 0.2},
        dual_antenna={"yaw0": {"link": "link", "correlation_s": 4.0}},
        barometer={"baro": {"link": "link", "correlation_s": 5.0}},
        filter={"wheel_scale_by": "wheel"},
    )
)


def column(which: int) -> dict[str, float]:
    """What stands in the rows of all sources but the inertial sensor."""
    rows = zip(PARAMS.sources, PARAMS.model_parameters[:, which].tolist(), strict=True)
    return {source: value for source, value in rows if source != "imu0"}


def test_sources_are_sorted_by_name_with_their_models() -> None:
    assert dict(zip(PARAMS.sources, PARAMS.models, strict=True)) == {
        "baro": MODEL["barometric_height"],
        "gps0.position": GNSS_POSITION,
        "gps0.velocity": GNSS_VELOCITY,
        "imu0": IMU,
        "left": WHEEL_SPEED,
        "right": WHEEL_SPEED,
        "yaw0": MODEL["gnss_yaw"],
    }
    assert list(PARAMS.sources) == sorted(PARAMS.sources)
    assert [PARAMS.sources[i] for i in (PARAMS.imu_source, *PARAMS.wheels, *PARAMS.velocities)] == [
        "imu0",
        "left",
        "right",
        "gps0.velocity",
    ]


def test_each_source_has_its_correlation_time() -> None:
    assert column(CORRELATION) == {
        "baro": 5.0,
        "gps0.position": 0.0,  # its slow error is a state
        "gps0.velocity": 3.0,
        "left": 0.2,
        "right": 0.2,
        "yaw0": 4.0,
    }


def test_what_a_source_resets_and_whom_it_trusts_with() -> None:
    other = dict.fromkeys(("left", "right", "yaw0"), -1.0)
    blocks = {"gps0.position": POSITION.start, "gps0.velocity": VELOCITY.start, "baro": HEIGHT_OFFSET_ERROR.start}
    assert column(RESETS) == other | blocks
    nobody = dict.fromkeys(column(COMPANION), -1.0)
    assert column(COMPANION) == nobody | {"gps0.position": PARAMS.sources.index("gps0.velocity")}
    assert column(CLUTTER) == dict.fromkeys(nobody, 0.0) | {"gps0.position": 0.07, "gps0.velocity": 0.07}
    assert column(SHARED) == dict.fromkeys(nobody, 1.0)  # no groups


def test_bounds_of_learnt_noise_are_of_variances() -> None:
    assert set(column(NOISE_MIN).values()) == {1.0}
    assert set(column(NOISE_MAX).values()) == {9.0}  # three sigmas


def test_a_scale_for_each_wheel_widens_the_state() -> None:
    scales = column(wheel_speed.SCALE_STATE)
    assert (scales["left"], scales["right"]) == (SCALE.start, FURTHER_SCALES_ERROR.start)
    assert (PARAMS.size, make_parameters(config()).size) == (WIDE_SIZE, ERROR_SIZE)
    assert len(PARAMS.calibration_variances) == len(PARAMS.noise.calibrations) == WIDE_SIZE - 15


def test_gates_are_of_chi_square() -> None:
    """Of no axis, one, two, three: the last three from tables, at 0.999."""
    assert PARAMS.gates[0] == math.inf
    np.testing.assert_allclose(PARAMS.gates[1:], [10.828, 13.816, 16.266], atol=1e-3)
    assert make_parameters(config(filter={"gate_probability": 0.95})).gates[3] == pytest.approx(7.815, abs=1e-3)


def test_the_slip_is_learnt_where_the_delay_of_the_inertial_sensor_is() -> None:
    for sigma_ms, holds, learnt in ((0.0, True, 0.0), (50.0, True, math.radians(0.5)), (50.0, False, 0.0)):
        params = make_parameters(config(imu={"delay_sigma_ms": sigma_ms}, motion={"non_holonomic": holds}))
        assert params.size == (WIDE_SIZE if sigma_ms else ERROR_SIZE)
        sigmas = np.zeros(WIDE_SIZE)
        sigmas[CALIBRATIONS : params.size] = np.sqrt(params.calibration_variances)
        assert sigmas[INERTIAL_DELAYS_ERROR] == pytest.approx([sigma_ms * 1e-3] * 2)
        assert sigmas[SLIP_ERROR] == pytest.approx([learnt])


def test_the_offsets_of_the_car_are_states_where_it_tells_of_itself() -> None:
    sensor = {"bus": "bus", "signal": "m.s"}
    steering = {"wheelbase_m": 2.7, "ratio": 16.0, "offset_sigma_deg": 8.0, "factor_sigma": 0.2}
    params = make_parameters(
        config(
            yaw_rate={"esc": {"offset_sigma_deg_s": 2.0} | sensor},
            steering={"wheel": steering | sensor},
        )
    )
    sigmas = np.zeros(WIDE_SIZE)
    sigmas[CALIBRATIONS:] = np.sqrt(params.calibration_variances)
    assert sigmas[YAW_RATE_OFFSET_ERROR] == pytest.approx([math.radians(2.0)])
    assert sigmas[STEERING_OFFSET_ERROR] == pytest.approx([math.radians(0.5)])  # of the road wheels
    assert sigmas[STEERING_FACTOR_ERROR] == pytest.approx([0.2])
    assert sigmas[UNDERSTEER_ERROR] == pytest.approx([math.radians(0.3)])
    without = {"esc": {"offset_sigma_deg_s": 0.0} | sensor}
    assert make_parameters(config(yaw_rate=without)).size == WIDE_SIZE  # the model has a place for it all the same
