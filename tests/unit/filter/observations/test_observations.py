"""Every observation model of the table: its Jacobian against finite differences, its innovation against what is known."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import msgspec
import numpy as np
import pytest

from fusiond.config.car import LateralAccelerometer, ParkedSensor, Steering, YawRateSensor
from fusiond.config.schema import Barometer, DualAntenna, Gnss, Motion, Wheel
from fusiond.events import (
    GnssPosition,
    GnssVelocity,
    GnssYaw,
    LateralAcceleration,
    Parked,
    Pressure,
    SteeringAngle,
    WheelSpeed,
    YawRate,
)
from fusiond.filter.measurement_update import inject
from fusiond.filter.observations import (
    CONSTRAINTS,
    MODELS,
    barometric_height,
    gnss_position,
    gnss_velocity,
    gnss_yaw,
    lateral,
    non_holonomic,
    parked,
    steering,
    wheel_speed,
    yaw_rate,
    zero_rotation,
    zero_velocity,
)
from fusiond.filter.observations.model import (
    LEVER_ARM_B,
    PARAMETERS,
    STAMP_ERROR,
    UNWEIGHTED,
    VALUES,
    Observation,
    mat_eb,
    rate_b,
)
from fusiond.filter.observations.wheel_speed import direction
from fusiond.filter.state import (
    GYRO_BIAS_B,
    MEAN_RATE_B,
    MOUNT,
    POSITION_E,
    QUATERNION_EB,
    RATE_B,
    SLIP,
    SLIP_ERROR,
    SMOOTH_FORCE_B,
    STEERING_FACTOR,
    STEERING_OFFSET,
    UNDERSTEER,
    VELOCITY_E,
    WHEEL_SCALE,
    WIDE_SIZE,
    YAW_RATE_OFFSET,
    FilterState,
)
from fusiond.maths.rotation import matrix_from_euler, quaternion
from fusiond.maths.typed import Array
from fusiond.maths.wgs84 import ecef, mat_ne
from tests.helpers.observations import Observed, observed
from tests.helpers.streams import EARTH_RATE_E, MUNICH, running_state

GNSS = Gnss(link="l", lever_arm_m=(-0.4, 0.3, -1.2))
WHITE = msgspec.structs.replace(GNSS, position_correlation_s=0.0)
WHEEL = Wheel(bus="b", message="m", signal="s", position_m=(1.3, -0.8, 0.5))
MOTION = Motion(point_m=(-1.2, 0.1, 0.4), minimum_speed_mps=0.0)
WIDTHS = [3, 3, 3, 3, 3, 3, 3, 3, 3, 2, 1, 2, 1, 4]
STEPS = np.repeat([1.0, 0.1, 1e-4, 1e-3, 0.1, 1e-4, 1.0, 1e-4, 0.1, 0.01, 1.0, 0.01, 0.01, 1e-4], WIDTHS)
YAW_RATE = YawRateSensor(bus="b", signal="m.s")
STEERING = Steering(bus="b", signal="m.s", wheelbase_m=2.7)
ACROSS = LateralAccelerometer(bus="b", signal="m.s")
PARKED = ParkedSensor(bus="b", signal="m.s")
BAROMETER = Barometer(link="l")
ANTENNAS = DualAntenna(link="l", offset_deg=50.0)
LEARNT = msgspec.structs.replace(GNSS, lever_arm_sigma_m=0.3, delay_sigma_ms=100.0, velocity_delay_sigma_ms=50.0)


Observe = Callable[[FilterState, Array, Array, Observation], bool]
OBSERVE: dict[str, Observe] = {model.name: model.observe for model in MODELS} | {
    constraint.__name__.rpartition(".")[2]: constraint.observe for constraint in CONSTRAINTS
}


def on_axle(row: Array) -> Array:
    """Parameters of a model whose point is the middle of the unsteered axle."""
    row[LEVER_ARM_B] = MOTION.point_m
    return row


class Case(NamedTuple):
    model: str
    values: tuple[float, ...]
    parameters: Array
    speed: float  # m/s, of the vehicle, forward


def wheel_case(speed: float, reading: float, **changes: bool) -> Case:
    wheel = msgspec.structs.replace(WHEEL, **changes)
    return Case("wheel_speed", wheel_speed.values(WheelSpeed(reading), wheel), wheel_speed.parameters(wheel), speed)


FIX = GnssPosition(*MUNICH, 1.0, 2.0)
CASES = {
    "position": Case("gnss_position", gnss_position.values(FIX, GNSS), gnss_position.parameters(GNSS), 10.0),
    "position, white": Case("gnss_position", gnss_position.values(FIX, WHITE), gnss_position.parameters(WHITE), 10.0),
    "velocity": Case(
        "gnss_velocity", gnss_velocity.values(GnssVelocity(5.0, 6.0, 1.0), GNSS), gnss_velocity.parameters(GNSS), 10.0
    ),
    "velocity 2-D": Case(
        "gnss_velocity", gnss_velocity.values(GnssVelocity(5.0, 6.0), GNSS), gnss_velocity.parameters(GNSS), 10.0
    ),
    "position, learning": Case("gnss_position", gnss_position.values(FIX, LEARNT), gnss_position.parameters(LEARNT), 10.0),
    "velocity, learning": Case(
        "gnss_velocity", gnss_velocity.values(GnssVelocity(5.0, 6.0, 1.0), LEARNT), gnss_velocity.parameters(LEARNT), 10.0
    ),
    "velocity 2-D, learning": Case(
        "gnss_velocity", gnss_velocity.values(GnssVelocity(5.0, 6.0), LEARNT), gnss_velocity.parameters(LEARNT), 10.0
    ),
    "barometer": Case(
        "barometric_height",
        barometric_height.values(Pressure(95_000.0, 280.0), BAROMETER),
        barometric_height.parameters(BAROMETER),
        10.0,
    ),
    "yaw": Case("gnss_yaw", gnss_yaw.values(GnssYaw(1.0), ANTENNAS), gnss_yaw.parameters(ANTENNAS), 10.0),
    "wheel signed": wheel_case(10.0, 10.0, unsigned=False),
    "wheel signed in reverse": wheel_case(-3.0, -3.1, unsigned=False),
    "wheel signed at rest": wheel_case(0.0, 0.0, unsigned=False),
    "wheel unsigned": wheel_case(10.0, 10.0),
    "wheel unsigned in reverse": wheel_case(-10.0, 10.0),
    "wheel unsigned reading zero": wheel_case(0.5, 0.0),
    "steered": wheel_case(10.0, 10.0, steered=True, unsigned=False),
    "steered in reverse": wheel_case(-10.0, 10.0, steered=True),
    "steered and slow": wheel_case(0.05, 0.0, steered=True),
    "non-holonomic": Case("non_holonomic", (), non_holonomic.parameters(MOTION), 10.0),
    "non-holonomic in reverse": Case("non_holonomic", (), non_holonomic.parameters(MOTION), -4.0),
    "yaw rate": Case("yaw_rate", yaw_rate.values(YawRate(0.2), YAW_RATE), yaw_rate.parameters(YAW_RATE), 10.0),
    "steering": Case(
        "steering", steering.values(SteeringAngle(0.1), STEERING), on_axle(steering.parameters(STEERING)), 10.0
    ),
    "steering in reverse": Case(
        "steering", steering.values(SteeringAngle(0.1), STEERING), on_axle(steering.parameters(STEERING)), -10.0
    ),
    "steering, slow": Case(
        "steering", steering.values(SteeringAngle(0.1), STEERING), on_axle(steering.parameters(STEERING)), 1.0
    ),
    "across": Case(
        "lateral_acceleration", lateral.values(LateralAcceleration(1.0), ACROSS), on_axle(lateral.parameters(ACROSS)), 10.0
    ),
    "across, slow": Case(
        "lateral_acceleration", lateral.values(LateralAcceleration(1.0), ACROSS), on_axle(lateral.parameters(ACROSS)), 1.0
    ),
    "parked": Case("parked", parked.values(Parked(True), PARKED), parked.parameters(PARKED), 0.1),
    "not parked": Case("parked", parked.values(Parked(False), PARKED), parked.parameters(PARKED), 5.0),
    "zero velocity": Case("zero_velocity", (), zero_velocity.parameters(MOTION), 0.2),
    "zero rotation": Case("zero_rotation", (), zero_rotation.parameters(MOTION), 0.0),
}


def moving_state(rng: np.random.Generator, speed: float) -> FilterState:
    """A state that moves forward along its own axis, with a little of everything else."""
    state = running_state(rng, size=WIDE_SIZE)
    slip = 0.1 if abs(speed) > 1 else 0.01
    state.nominal[SLIP] = 0.02
    state.nominal[STEERING_FACTOR], state.nominal[UNDERSTEER] = 0.1, 0.004
    state.nominal[VELOCITY_E] = mat_eb(state) @ rng.normal((speed, 0.0, 0.0), slip)
    state.auxiliary[SMOOTH_FORCE_B] = rng.normal((0.0, 0.0, -9.8), 0.5)
    state.auxiliary[RATE_B] = state.auxiliary[MEAN_RATE_B] = rng.normal(0.0, 0.3 if abs(speed) > 1 else 0.005, 3)
    return state


def found(observe: Observe, state: FilterState, row: Array, parameters: Array) -> Observed:
    """What a model observes where there is something to observe."""
    seen = observed(observe, state, row, parameters)
    assert seen is not None
    return seen


def test_every_model_has_a_case() -> None:
    assert {case.model for case in CASES.values()} == set(OBSERVE)
    assert len(OBSERVE) == len(MODELS) + len(CONSTRAINTS)


def predicted(observe: Observe, state: FilterState, row: Array, parameters: Array) -> Array:
    """h(x): what a reading of zero would miss by."""
    return -found(observe, state, row, parameters).innovation


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_jacobian_against_finite_differences(case: Case, seed: int) -> None:
    """d h / d error = - d innovation / d error, for a direct measurement at a fixed reading."""
    state = moving_state(np.random.default_rng(seed), case.speed)
    observe = OBSERVE[case.model]
    row = np.zeros(VALUES)
    row[: len(case.values)] = case.values
    seen = found(observe, state, row, case.parameters)
    m = len(seen.innovation)
    assert (seen.jacobian.shape, seen.variance.shape) == ((m, state.size), (m,))
    assert (seen.variance > 0).all()
    scale = np.abs(seen.jacobian).max()
    # the position innovation is resolved in axes that turn with the position: along the ground by 1 m in 6,400 km
    atol = 1e-6 * max(scale, np.abs(seen.innovation).max())
    for i, step in enumerate(STEPS):
        ends = []
        for sign in (1, -1):
            moved, error = state.copy(), np.zeros(state.size)
            error[i] = sign * step
            inject(moved, error)
            ends.append(predicted(observe, moved, row, case.parameters))
        slope = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(seen.jacobian[:, i], slope, rtol=2e-5, atol=atol, err_msg=f"error {i}")


def level_state(yaw: float = 0.4) -> FilterState:
    state = FilterState(7)
    state.nominal[POSITION_E] = ecef(*MUNICH)
    state.nominal[QUATERNION_EB] = quaternion(mat_ne(ecef(*MUNICH)).T @ matrix_from_euler(0.0, 0.0, yaw))
    return state


def padded(values: tuple[float, ...]) -> Array:
    return np.array(values + (0.0,) * (VALUES - len(values)))


def test_position_of_the_antenna() -> None:
    state = level_state(math.pi / 2)  # facing east: the antenna is 0.4 m west, 0.3 m south, 1.2 m above
    place = ecef(*MUNICH) + mat_ne(ecef(*MUNICH)).T @ np.array([-0.3, -0.4, -1.2])
    row = np.array([*place, 1.0, 4.0, 0.0, 0.0, 0.0])
    seen = found(gnss_position.observe, state, row, gnss_position.parameters(GNSS))
    np.testing.assert_allclose(seen.innovation, 0.0, atol=3e-9)
    np.testing.assert_allclose(seen.variance, np.array([1.0, 1.0, 4.0]) * GNSS.position_white_share)


def test_velocity_of_the_antenna() -> None:
    state = level_state(0.0)
    state.nominal[GYRO_BIAS_B] = (0.0, 0.0, 0.1)
    state.auxiliary[RATE_B] = (0.0, 0.0, 0.6)  # turns right by 0.5 rad/s
    row = padded(gnss_velocity.values(GnssVelocity(-0.15, -0.2, 0.0), GNSS))
    seen = found(gnss_velocity.observe, state, row, gnss_velocity.parameters(GNSS))
    np.testing.assert_allclose(seen.innovation, 0.0, atol=1e-9)


def test_sigmas_of_the_receiver_count_from_the_configured_on() -> None:
    gnss = Gnss(link="l", position_sigma_m=1.0, height_sigma_m=2.0, velocity_sigma_mps=0.1)
    assert gnss_position.values(GnssPosition(0.1, 0.2, 3.0), gnss)[3:] == (1.0, 4.0, 3.0)
    assert gnss_position.values(GnssPosition(0.1, 0.2, 3.0, 3.0, 5.0), gnss)[3:] == (9.0, 25.0, 3.0)
    assert gnss_position.values(GnssPosition(0.1, 0.2, 3.0, 0.5, 0.0), gnss)[3:] == (1.0, 4.0, 3.0)
    assert gnss_velocity.values(GnssVelocity(1.0, 2.0, 3.0, 0.5), gnss) == (1.0, 2.0, 3.0, 0.25, 3.0)
    assert gnss_velocity.values(GnssVelocity(1.0, 2.0), gnss) == (1.0, 2.0, 0.0, 0.1 * 0.1, 2.0)


@pytest.mark.parametrize(
    ("fix_type", "least"),
    [(2, (1.5, 3.0)), (3, (1.5, 3.0)), (4, (0.8, 1.6)), (5, (0.3, 0.6)), (6, (0.02, 0.03)), (7, (0.02, 0.03))],
)
def test_each_fix_type_has_its_least_sigma(fix_type: int, least: tuple[float, float]) -> None:
    gnss = Gnss(link="l")
    worst = GnssPosition(0.1, 0.2, 3.0, 5.0, 7.0, fix_type)
    best = msgspec.structs.replace(worst, sigma_horizontal=0.001, sigma_vertical=0.001)
    silent = msgspec.structs.replace(worst, sigma_horizontal=None, sigma_vertical=None)
    for fix, sigmas in ((worst, (5.0, 7.0)), (best, least), (silent, least)):
        assert gnss_position.values(fix, gnss)[3:] == pytest.approx((sigmas[0] ** 2, sigmas[1] ** 2, fix_type))
    sharp = msgspec.structs.replace(gnss, position_sigma_m=0.01, height_sigma_m=0.02)
    assert gnss_position.values(best, sharp)[3:5] == pytest.approx((1e-4, 4e-4))  # that of a single fix holds for all


def test_jitter_of_the_stamp_is_an_error_along_the_track() -> None:
    state = level_state()
    velocity_n = np.array([6.0, -8.0, 0.5])
    state.nominal[VELOCITY_E] = mat_ne(ecef(*MUNICH)).T @ velocity_n
    seen = Observation(state.size)
    settings = msgspec.structs.replace(GNSS, stamp_sigma_ms=20.0)
    values = padded(gnss_position.values(FIX, settings))
    assert gnss_position.observe(state, values, gnss_position.parameters(settings), seen)
    np.testing.assert_allclose(seen.common, 0.02 * math.sqrt(GNSS.position_white_share) * velocity_n, rtol=1e-9)


def test_wheel_reads_its_contact_point_with_the_scale() -> None:
    state = level_state(0.0)
    state.nominal[VELOCITY_E] = mat_eb(state) @ [10.0, 0.0, 0.0]
    state.nominal[WHEEL_SCALE] = 0.02
    state.auxiliary[RATE_B] = (0.0, 0.0, 0.5)  # turning right: the left wheel is the outer one
    row = padded((1.02 * (10.0 + 0.5 * 0.8), 0.01))
    seen = found(wheel_speed.observe, state, row, wheel_speed.parameters(WHEEL))
    assert seen.innovation[0] == pytest.approx(0.0, abs=1e-12)
    steered = msgspec.structs.replace(WHEEL, steered=True)
    along = math.hypot(10.4, 0.5 * 1.3)
    seen = found(wheel_speed.observe, state, padded((1.02 * along, 0.01)), wheel_speed.parameters(steered))
    assert seen.innovation[0] == pytest.approx(0.0, abs=1e-12)


def test_wheel_values() -> None:
    wheel = Wheel(bus="b", message="m", signal="s", sigma_mps=0.1, quantum_mps=0.6, least_mps=0.3, correlation_s=0.2)
    speed, variance, alike = wheel_speed.values(WheelSpeed(5.0), wheel)
    assert (speed, variance, alike) == (5.0, pytest.approx(0.01 + 0.03), 0.2)
    speed, variance, alike = wheel_speed.values(WheelSpeed(0.0), wheel)
    assert (speed, variance, alike) == (0.0, pytest.approx(0.04 + 0.03), wheel_speed.SLOW_CORRELATION)


def test_sign_of_an_unsigned_wheel() -> None:
    unsigned = wheel_speed.parameters(WHEEL)
    signed = wheel_speed.parameters(msgspec.structs.replace(WHEEL, unsigned=False))
    row = padded((5.0, 0.01, 0.0))
    for speed, parameters, expected in ((-5.0, unsigned, 0.0), (-5.0, signed, 10.0), (5.0, unsigned, 0.0)):
        state = level_state()
        state.nominal[VELOCITY_E] = mat_eb(state) @ [speed, 0.0, 0.0]
        seen = found(wheel_speed.observe, state, row, parameters)
        assert seen.innovation[0] == pytest.approx(expected, abs=1e-12)
        assert seen.variance[0] == 0.01


def test_slow_unsigned_wheel_is_a_mixture_of_two_directions() -> None:
    """The mean sign is that of two Gaussians of speeds +-z, weighed by what a speed of N(h, S - R) makes of each."""
    z, h, spread = 0.8, 0.3, 0.5
    forward, backward = (math.exp(-((sign * z - h) ** 2) / (2 * spread)) for sign in (1, -1))
    assert direction(z * h / spread) == pytest.approx((forward - backward) / (forward + backward))
    assert (direction(0.0), direction(1e9), direction(-1e9)) == (0.0, 1.0, -1.0)
    state = level_state()
    state.covariance[3:6, 3:6] = np.eye(3)
    still = found(wheel_speed.observe, state, padded((z, 0.01, 0.0)), wheel_speed.parameters(WHEEL))
    assert still.innovation[0] == pytest.approx(0.0, abs=1e-12)  # no direction, so no push either way
    assert still.variance[0] == pytest.approx(0.01 + wheel_speed.SAME_DIRECTION * z * z)


def test_non_holonomic_rests_when_slow() -> None:
    state, parameters = level_state(), non_holonomic.parameters(Motion(minimum_speed_mps=2.0))
    for speed, rests in ((1.99, True), (-1.99, True), (2.01, False), (-2.01, False)):
        state.nominal[VELOCITY_E] = mat_eb(state) @ [speed, 0.0, 0.0]
        assert (observed(non_holonomic.observe, state, parameters, parameters) is None) is rests


def test_non_holonomic_takes_the_mount_out() -> None:
    state, parameters = level_state(), non_holonomic.parameters(Motion())
    pitch, yaw = 0.03, -0.02
    state.nominal[MOUNT] = pitch, yaw
    state.nominal[VELOCITY_E] = mat_eb(state) @ (matrix_from_euler(0.0, pitch, yaw).T @ [12.0, 0.0, 0.0])
    seen = found(non_holonomic.observe, state, parameters, parameters)
    np.testing.assert_allclose(seen.innovation, 0.0, atol=1e-12)


def test_non_holonomic_lets_tyres_slide_out_of_a_bend() -> None:
    """In a bend to the right the axle moves to the left, by the slip times lateral acceleration and speed."""
    state, parameters = FilterState(7, WIDE_SIZE), non_holonomic.parameters(Motion())
    level = level_state()
    state.nominal[QUATERNION_EB], state.nominal[POSITION_E] = level.nominal[QUATERNION_EB], level.nominal[POSITION_E]
    state.nominal[SLIP], state.auxiliary[RATE_B] = 0.01, (0.0, 0.0, 0.2)
    state.nominal[VELOCITY_E] = mat_eb(state) @ (10.0, -0.01 * 0.2 * 10.0**2, 0.0)
    unaware = found(non_holonomic.observe, state, parameters, parameters)
    state.covariance[SLIP_ERROR, SLIP_ERROR] = 1e-4
    seen = found(non_holonomic.observe, state, parameters, parameters)
    assert unaware.innovation == pytest.approx([0.2, 0.0], abs=1e-9)
    assert seen.innovation == pytest.approx([0.0, 0.0], abs=1e-9)


def test_zero_rotation_allows_for_the_earth() -> None:
    state, parameters = level_state(), zero_rotation.parameters(Motion())
    state.nominal[GYRO_BIAS_B] = (0.01, -0.02, 0.03)
    state.auxiliary[RATE_B] = state.nominal[GYRO_BIAS_B] + mat_eb(state).T @ EARTH_RATE_E
    np.testing.assert_allclose(found(zero_rotation.observe, state, parameters, parameters).innovation, 0.0, atol=1e-16)
    np.testing.assert_allclose(rate_b(state), mat_eb(state).T @ EARTH_RATE_E, atol=1e-16)


def test_parameters_fit_their_row() -> None:
    rows = [gnss_position.parameters(GNSS), wheel_speed.parameters(WHEEL), non_holonomic.parameters(MOTION)]
    assert all(row.shape == (PARAMETERS,) for row in rows)
    np.testing.assert_array_equal(rows[0][LEVER_ARM_B], GNSS.lever_arm_m)


# --- The car's own sensors


def bend(speed: float, turn: float, roll: float = 0.0) -> FilterState:
    """A vehicle that faces 0.4 rad east of north, and drives forward in a bend to the right by `turn` [rad/s]."""
    state = FilterState(7, WIDE_SIZE)
    to_n = mat_ne(ecef(*MUNICH))
    state.nominal[POSITION_E] = ecef(*MUNICH)
    state.nominal[QUATERNION_EB] = quaternion(to_n.T @ matrix_from_euler(roll, 0.0, 0.4))
    state.nominal[VELOCITY_E] = mat_eb(state) @ np.array([speed, 0.0, 0.0])
    state.auxiliary[RATE_B] = state.auxiliary[MEAN_RATE_B] = (0.0, 0.0, turn)
    return state


def test_the_yaw_rate_has_an_offset() -> None:
    state = bend(10.0, 0.3)
    state.nominal[GYRO_BIAS_B] = (0.0, 0.0, 0.01)
    state.nominal[YAW_RATE_OFFSET] = 0.02
    seen = found(yaw_rate.observe, state, padded(yaw_rate.values(YawRate(0.31), YAW_RATE)), yaw_rate.parameters(YAW_RATE))
    assert seen.innovation == pytest.approx([0.0], abs=1e-12)
    assert seen.variance == pytest.approx([math.radians(0.3) ** 2])


@pytest.mark.parametrize("speed", [10.0, -5.0])
def test_the_steering_of_a_bend_by_hand(speed: float) -> None:
    """At 10 m/s and 0.2 rad/s the radius is 50 m: 2.7 m / 50 m, and 2 m/s^2 of understeer at 0.003 rad each."""
    state = bend(speed, 0.2)
    state.nominal[STEERING_OFFSET], state.nominal[STEERING_FACTOR], state.nominal[UNDERSTEER] = 0.01, 0.05, 0.003
    angle = 0.01 + 1.05 * (2.7 / (speed / 0.2) + 0.003 * speed * 0.2)
    row = padded(steering.values(SteeringAngle(angle), STEERING))
    seen = found(steering.observe, state, row, steering.parameters(STEERING))
    assert seen.innovation == pytest.approx([0.0], abs=1e-12)
    assert seen.variance == pytest.approx([(math.radians(2.0) / 15.0) ** 2])


def test_steering_and_acceleration_say_nothing_at_walking_pace() -> None:
    state = bend(2.9, 0.2)
    cases = (
        (steering.observe, steering.values(SteeringAngle(1.0), STEERING), steering.parameters(STEERING)),
        (lateral.observe, lateral.values(LateralAcceleration(9.0), ACROSS), lateral.parameters(ACROSS)),
    )
    for observe, values, parameters in cases:
        seen = found(observe, state, padded(values), parameters)
        assert (seen.innovation[0], seen.variance[0], np.abs(seen.jacobian).max()) == (0.0, UNWEIGHTED, 0.0)


def test_the_acceleration_across_in_a_banked_bend() -> None:
    """In a bend to the right, leaning to the right by 0.1 rad: gravity pulls the sensor's mass to the right, too."""
    state = bend(10.0, 0.2, roll=0.1)
    force = 10.0 * 0.2 - 9.8073 * math.sin(0.1)  # gravity at Munich, 500 m
    row = padded(lateral.values(LateralAcceleration(force), ACROSS))
    seen = found(lateral.observe, state, row, lateral.parameters(ACROSS))
    assert seen.innovation == pytest.approx([0.0], abs=2e-3)


def test_only_a_parked_car_stands() -> None:
    state = bend(0.2, 0.0)
    stands = found(parked.observe, state, padded(parked.values(Parked(True), PARKED)), parked.parameters(PARKED))
    assert np.linalg.norm(stands.innovation) == pytest.approx(0.2)
    assert stands.variance == pytest.approx([0.0025] * 3)
    drives = found(parked.observe, state, padded(parked.values(Parked(False), PARKED)), parked.parameters(PARKED))
    assert (np.abs(drives.innovation).max(), np.abs(drives.jacobian).max(), drives.variance.min()) == (0, 0, UNWEIGHTED)


# --- Clocks that may have placed a reading off


def common_of(observe: Observe, state: FilterState, row: Array, parameters: Array) -> Array:
    seen = Observation(state.size)
    assert observe(state, row, parameters, seen)
    return seen.common[: seen.m]


def test_an_uncertain_clock_widens_what_moves() -> None:
    """By 30 ms at 20 m/s: 0.6 m along the way, beside 0.2 m by the receiver's own stamp; at 3 m/s^2: 0.09 m/s."""
    state = bend(20.0, 0.0)
    to_n = mat_ne(ecef(*MUNICH))
    state.auxiliary[SMOOTH_FORCE_B] = mat_eb(state).T @ to_n.T @ np.array([3 * math.cos(0.4), 3 * math.sin(0.4), -9.8073])
    receiver = msgspec.structs.replace(WHITE, stamp_sigma_ms=10.0)
    row = padded(gnss_position.values(FIX, receiver))
    north, east, _ = common_of(gnss_position.observe, state, row, gnss_position.parameters(receiver))
    assert math.hypot(north, east) == pytest.approx(0.2)
    row[STAMP_ERROR] = 0.03
    north, east, _ = common_of(gnss_position.observe, state, row, gnss_position.parameters(receiver))
    assert math.hypot(north, east) == pytest.approx(math.hypot(0.2, 0.6))
    assert math.atan2(east, north) == pytest.approx(0.4)
    row = padded(gnss_velocity.values(GnssVelocity(20.0, 0.0), GNSS))
    row[STAMP_ERROR] = 0.03
    across = common_of(gnss_velocity.observe, state, row, gnss_velocity.parameters(GNSS))
    assert np.hypot(*across) == pytest.approx(0.09, rel=1e-3)
    row = padded(wheel_speed.values(WheelSpeed(20.0), WHEEL))
    plain = found(wheel_speed.observe, state, row, wheel_speed.parameters(WHEEL)).variance[0]
    row[STAMP_ERROR] = 0.03
    wide = found(wheel_speed.observe, state, row, wheel_speed.parameters(WHEEL)).variance[0]
    assert wide - plain == pytest.approx(0.09**2, rel=2e-3)


def test_an_unsigned_wheel_that_is_told_its_direction() -> None:
    state = bend(-1.0, 0.0)
    for reading, innovation in ((WheelSpeed(-1.0, signed=True), 0.0), (WheelSpeed(1.0, signed=True), 2.0)):
        row = padded(wheel_speed.values(reading, WHEEL))
        seen = found(wheel_speed.observe, state, row, wheel_speed.parameters(WHEEL))
        assert seen.innovation == pytest.approx([innovation], abs=1e-9)
        assert seen.variance == pytest.approx([WHEEL.sigma_mps**2])
