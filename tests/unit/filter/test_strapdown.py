"""Propagation of the nominal state and of its covariance, of both kernels, against motions whose truth is known."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from fusiond.events import GnssPosition, GnssVelocity, ImuSample, Measurement
from fusiond.filter.kernel.interpreted import AnyKernel, make_kernel
from fusiond.filter.measurement_update import inject
from fusiond.filter.parameters import make_parameters
from fusiond.filter.state import (
    ACCEL_BIAS,
    ATTITUDE,
    ERROR_SIZE,
    GNSS_ERROR,
    GYRO_BIAS,
    GYRO_BIAS_B,
    MOUNT_ERROR,
    PHASE,
    POSITION,
    POSITION_E,
    QUATERNION_EB,
    RATE_B,
    RUNNING,
    SCALE,
    T_IMU,
    VELOCITY,
    VELOCITY_E,
    FilterState,
    T,
)
from fusiond.filter.strapdown import (
    COAST_ACCEL,
    COAST_TILT,
    TURN_RATE,
    TURN_TIME,
    begin_coasting,
    coast,
    end_coasting,
)
from fusiond.maths.rotation import matrix, matrix_from_euler, quaternion, quaternion_exp, quaternion_multiply
from fusiond.maths.typed import Array
from fusiond.maths.wgs84 import SEMI_MINOR, ecef, geodetic, gravity_e, mat_ne
from tests.helpers.streams import EARTH_RATE_E, MS, MUNICH, SECOND, T0, config, fuse, running_state, triple

TENTH_MM = 1e-4  # m
QUIET = {
    "accel_noise": 1e-30,
    "gyro_noise": 1e-30,
    "accel_bias_walk": 0.0,
    "gyro_bias_walk": 0.0,
}
ANYWHERE = {
    "equator": (0.0, 0.3, 0.0),
    "munich": MUNICH,
    "antimeridian": (math.radians(-17.0), math.pi, 100.0),
    "north pole": (math.pi / 2, 0.0, 10.0),
    "near the south pole": (math.radians(-89.9991), 1.0, 2800.0),
}


class Path:
    """A motion with closed form in earth-fixed axes: a straight line or a circle in the plane that is level at `place`."""

    def __init__(self, place: tuple[float, float, float], speed: float, turn: float = 0.0, begin: float = 0.0) -> None:
        self.origin, self.speed, self.turn, self.begin = ecef(*place), speed, turn, begin
        self.level = mat_ne(self.origin).T  # from axes level at the origin

    def at(self, second: float) -> tuple[Array, Array, Array, Array]:
        """Position [m], velocity [m/s], acceleration [m/s^2] and mat_eb at an instant [s]."""
        v, w, t = self.speed, self.turn, second + self.begin
        forward = np.array([math.cos(w * t), math.sin(w * t), 0.0])
        sideways = np.array([-math.sin(w * t), math.cos(w * t), 0.0])
        along = forward * v * t if w == 0 else (np.array([0.0, 1.0, 0.0]) - sideways) * v / w
        place = self.origin + self.level @ along
        return (
            place,
            self.level @ forward * v,
            self.level @ sideways * v * w,
            self.level @ matrix_from_euler(0.0, 0.0, w * t),
        )

    def felt(self, second: float) -> tuple[Array, Array]:
        """What an ideal IMU measures: specific force [m/s^2] and angular rate [rad/s]."""
        place, velocity, acceleration, mat_eb = self.at(second)
        force_e = acceleration + 2 * np.cross(EARTH_RATE_E, velocity) - gravity_e(place)
        return mat_eb.T @ force_e, np.array([0.0, 0.0, self.turn]) + mat_eb.T @ EARTH_RATE_E

    def state(self, second: float = 0.0) -> FilterState:
        state = FilterState(7)
        place, velocity, _, mat_eb = self.at(second)
        state.nominal[POSITION_E], state.nominal[VELOCITY_E] = place, velocity
        state.nominal[QUATERNION_EB] = quaternion(mat_eb)
        return state

    def drive(self, kernel: AnyKernel, seconds: float, dt: float) -> FilterState:
        state, felt = self.state(), self.felt(dt / 2)
        for k in range(round(seconds / dt)):
            if self.speed:
                felt = self.felt((k + 0.5) * dt)
            kernel.propagate(state, dt, *felt)
        return state

    def miss(self, state: FilterState, second: float) -> tuple[float, float, float]:
        """Errors of position [m], velocity [m/s] and attitude [rad]."""
        place, velocity, _, mat_eb = self.at(second)
        return (
            float(np.linalg.norm(state.nominal[POSITION_E] - place)),
            float(np.linalg.norm(state.nominal[VELOCITY_E] - velocity)),
            float(np.linalg.norm(matrix(state.nominal[QUATERNION_EB]) - mat_eb)),
        )


@pytest.fixture
def kernel(compiled: bool) -> AnyKernel:
    return make_kernel(make_parameters(config(imu=QUIET)), compiled)


@pytest.mark.parametrize("place", ANYWHERE.values(), ids=ANYWHERE)
def test_rest_stays_rest(kernel: AnyKernel, compiled: bool, place: tuple[float, float, float]) -> None:
    seconds = 600.0 if compiled else 60.0
    path = Path(place, 0.0)
    position, velocity, attitude = path.miss(path.drive(kernel, seconds, 0.05), seconds)
    assert position < TENTH_MM
    assert velocity < 1e-6
    assert attitude < 1e-9


@pytest.mark.parametrize("place", ANYWHERE.values(), ids=ANYWHERE)
def test_straight_line(kernel: AnyKernel, place: tuple[float, float, float]) -> None:
    path = Path(place, 25.0, begin=-10.0)  # 250 m to the place, across it, and 250 m on
    position, velocity, attitude = path.miss(path.drive(kernel, 20.0, 0.02), 20.0)
    assert position < TENTH_MM
    assert velocity < 1e-5
    assert attitude < 1e-9


def test_line_past_the_pole_at_100_m(kernel: AnyKernel) -> None:
    path = Path((math.pi / 2 - 100 / 6.4e6, 2.0, 0.0), 25.0, begin=-10.0)
    path.level = path.level @ matrix_from_euler(0.0, 0.0, 1.57)
    assert path.miss(path.drive(kernel, 20.0, 0.02), 20.0)[0] < TENTH_MM


def test_circle_converges_with_the_square_of_the_interval(kernel: AnyKernel) -> None:
    path = Path(MUNICH, 15.0, turn=0.3)
    coarse, fine = (path.miss(path.drive(kernel, 24.0, dt), 24.0) for dt in (0.04, 0.02))
    assert fine[0] < 1e-3
    assert coarse[0] / fine[0] == pytest.approx(4.0, rel=0.2)
    assert coarse[1] / fine[1] == pytest.approx(4.0, rel=0.2)
    assert fine[2] < 1e-8


def test_a_long_interval_goes_in_parts(kernel: AnyKernel) -> None:
    """Intervals at the very edge of a part are divided alike by both kernels, whichever way the quotient is rounded."""
    for dt in (0.05, 0.15, 0.3, 150_000_000 * 1e-9, 300_000_000 * 1e-9, 600_000_000 * 1e-9, 0.45):
        whole, parts = Path(MUNICH, 15.0, turn=0.3).state(), Path(MUNICH, 15.0, turn=0.3).state()
        count = math.ceil(dt / 0.05)
        felt = Path(MUNICH, 15.0, turn=0.3).felt(dt / 2)
        kernel.propagate(whole, dt, *felt)
        for _ in range(count):
            kernel.propagate(parts, dt / count, *felt)
        np.testing.assert_array_equal(whole.numbers, parts.numbers)


@pytest.mark.parametrize("place", [ANYWHERE["north pole"], ANYWHERE["antimeridian"]], ids=["pole", "antimeridian"])
def test_the_whole_filter_drives_across(compiled: bool, place: tuple[float, float, float]) -> None:
    """Align in motion by the course, and drive across the pole or the antimeridian: nothing is rejected or jumps."""
    path, events = Path(place, 20.0, begin=-5.0), []
    for k in range(501):
        t_ns, second = T0 + k * 20 * MS, k * 0.02
        events.append(Measurement(t_ns, "imu0", k, t_ns, ImuSample(*map(triple, path.felt(second)))))
        if k % 10 == 5:
            where, velocity, _, _ = path.at(second)
            fix, (north, east, down) = geodetic(where), triple(mat_ne(where) @ velocity)
            events.append(Measurement(t_ns, "gps0.position", k, t_ns, GnssPosition(*fix, 0.5, 0.5)))
            events.append(Measurement(t_ns, "gps0.velocity", k, t_ns, GnssVelocity(north, east, down, 0.1)))
    fusion = fuse(config(()), sorted(events, key=lambda event: event.key), compiled)
    position, velocity, attitude = path.miss(fusion.history.head, 10.0)
    totals = fusion.totals()
    assert totals["REJECTED"] == 0 and totals["FUSED"] + totals["GATHERED"] == len(events)
    assert totals["GATHERED"] < len(events) / 5  # most of the way it runs
    assert position < 0.05
    assert velocity < 0.01
    assert attitude < math.radians(0.3)
    estimate = fusion.solution_at(T0 + 10 * SECOND).state
    assert estimate is not None
    np.testing.assert_allclose(ecef(estimate.latitude, estimate.longitude, estimate.height), path.at(10.0)[0], atol=0.05)


def difference(a: FilterState, b: FilterState) -> Array:
    """The error that carries b into a."""
    error = np.zeros(a.size)
    x, y = a.nominal, b.nominal
    error[:6] = x[:6] - y[:6]
    error[9:] = x[10 : a.size + 1] - y[10 : a.size + 1]
    conjugate = y[QUATERNION_EB] * [1, -1, -1, -1]
    cosine, *axis = quaternion_multiply(x[QUATERNION_EB], conjugate).tolist()
    sine = math.hypot(*axis)
    error[ATTITUDE] = np.array(axis) * (2 * math.atan2(sine, cosine) / sine if sine else 2.0)
    return error


def derivative(of: Callable[[FilterState], object], state: FilterState, steps: Array) -> Array:
    """Central differences of the error after `of` by the error before it."""
    columns = []
    for i, step in enumerate(steps):
        ends = []
        for sign in (1, -1):
            end = state.copy()
            error = np.zeros(state.size)
            error[i] = sign * step
            inject(end, error)
            of(end)
            ends.append(end)
        columns.append(difference(*ends) / (2 * step))
    return np.array(columns).T


def transition(of: Callable[[FilterState], object], state: FilterState) -> Array:
    """The transition matrix that the covariance is carried by: column i out of a covariance of one alone in place i."""
    columns = []
    for i in range(state.size):
        end = state.copy()
        end.covariance[:] = 0.0
        end.covariance[i, i] = 1.0
        of(end)
        columns.append(end.covariance[:, i] / math.sqrt(end.covariance[i, i]))
    return np.array(columns).T


BLOCKS = {
    "position": POSITION,
    "velocity": VELOCITY,
    "attitude": ATTITUDE,
    "gyro bias": GYRO_BIAS,
    "accel bias": ACCEL_BIAS,
    "scale": SCALE,
    "mount": MOUNT_ERROR,
    "gnss error": GNSS_ERROR,
}
STEPS = np.repeat([100.0, 1.0, 1e-3, 1e-2, 0.1, 1e-3, 1.0], 3)
DT = 0.01  # s
TIGHT = {  # what the model keeps of a block to a better precision than dt^3, as a share of the block's own size
    ("velocity", "position"): 0.02,  # spherical Earth
    ("velocity", "velocity"): 1e-3,
    ("attitude", "attitude"): 1e-3,
    ("position", "velocity"): 1e-5,
}


@pytest.mark.parametrize("seed", range(3))
def test_transition_against_finite_differences(kernel: AnyKernel, seed: int) -> None:
    rng = np.random.default_rng(seed)
    state = running_state(rng)
    force, rate = rng.normal(0.0, 5.0, 3) - [0, 0, 9.8], rng.normal(0.0, 0.5, 3)

    def carry(moved: FilterState) -> None:
        kernel.propagate(moved, DT, force, rate)

    modelled, true = transition(carry, state), derivative(carry, state, STEPS)
    for to_name, to in BLOCKS.items():
        for by_name, by in BLOCKS.items():
            found, expected = modelled[to, by], true[to, by]
            share = TIGHT.get((to_name, by_name))
            change = expected - np.eye(ERROR_SIZE)[to, by]
            tolerance = 6 * DT**3 if share is None else share * np.abs(change).max()
            np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance, err_msg=f"{to_name} by {by_name}")


def test_coasting_against_finite_differences(compiled: bool) -> None:
    state = running_state(np.random.default_rng(4))
    state.stamps[T_IMU] = T0 - 10 * SECOND  # the IMU is long silent
    state.nominal[3:6] *= 0.1  # so that turns, by which a velocity turns along, are little noise
    state.auxiliary[RATE_B] = state.nominal[GYRO_BIAS_B]  # it does not turn
    kernel = make_kernel(make_parameters(config(imu=QUIET)), compiled)

    def carry(moved: FilterState) -> None:
        kernel.predict(moved, T0 + 100 * MS)

    modelled, true = transition(carry, state), derivative(carry, state, STEPS)
    np.testing.assert_allclose(modelled[:3], true[:3], atol=2e-3)  # the coasting noise shows in the diagonal
    moved = state.copy()
    carry(moved)
    np.testing.assert_allclose(moved.nominal[:3], state.nominal[:3] + 0.1 * state.nominal[3:6], atol=1e-8)
    np.testing.assert_allclose(moved.nominal[3:], state.nominal[3:], rtol=1e-14)


def test_process_noise(compiled: bool) -> None:
    """From nothing, the covariance grows as its densities say: by their own integrals."""
    imu = {"accel_noise": 0.1, "gyro_noise": 2e-3, "accel_bias_walk": 1e-3, "gyro_bias_walk": 1e-5}
    layout = make_parameters(config(imu=imu, filter={"wheel_scale_walk": 1e-4, "mount_walk_deg": 0.1}))
    state, path = Path(MUNICH, 0.0).state(), Path(MUNICH, 0.0)
    make_kernel(layout, compiled).propagate(state, DT, *path.felt(0.0))
    p = state.covariance
    expected = np.zeros((ERROR_SIZE, ERROR_SIZE))
    for block, density in (
        (POSITION, 0.01 * DT**2 / 3),
        (VELOCITY, 0.01),
        (ATTITUDE, 4e-6),
        (GYRO_BIAS, 1e-10),
        (ACCEL_BIAS, 1e-6),
        (SCALE, 1e-8),
        (MOUNT_ERROR, math.radians(0.1) ** 2),
    ):
        expected[block, block] = np.eye(block.stop - block.start) * density * DT
    expected[POSITION, VELOCITY] = expected[VELOCITY, POSITION] = np.eye(3) * 0.01 * DT**2 / 2
    np.testing.assert_allclose(p, expected, rtol=1e-12, atol=0)


def test_coasting_noise(compiled: bool) -> None:
    """From nothing, over a second: white acceleration, white tilt, and a turn about the vertical at a rate that is a
    first-order Gauss-Markov process, by which the velocity turns along. All by their integrals, but for steps of 50 ms."""
    state = Path(MUNICH, 10.0).state()
    state.stamps[[T, T_IMU, PHASE]] = T0, T0 - 10 * SECOND, RUNNING
    make_kernel(make_parameters(config()), compiled).predict(state, T0 + SECOND)
    up = state.nominal[:3] / np.linalg.norm(state.nominal[:3])
    sideways = np.cross(up, state.nominal[3:6])
    assert np.linalg.norm(sideways) > 5.0
    kept = math.exp(-1 / TURN_TIME)
    turned = TURN_RATE**2 * (2 * TURN_TIME - TURN_TIME**2 * (3 - 4 * kept + kept**2))  # variance of the rate's integral
    p, accel = state.covariance, COAST_ACCEL**2 * np.eye(3)
    tilt = COAST_TILT**2 * np.eye(3)
    near = {"rtol": 0.08, "atol": 0.08 * turned}
    np.testing.assert_allclose(p[ATTITUDE, ATTITUDE], tilt + turned * np.outer(up, up), **near)
    near["atol"] *= 100
    np.testing.assert_allclose(p[VELOCITY, VELOCITY], accel + turned * np.outer(sideways, sideways), **near)
    np.testing.assert_allclose(p[VELOCITY, ATTITUDE], turned * np.outer(sideways, up), **near)
    np.testing.assert_allclose(up @ p[POSITION, VELOCITY] @ up, COAST_ACCEL**2 / 2, rtol=1e-3)
    np.testing.assert_allclose(up @ p[POSITION, POSITION] @ up, COAST_ACCEL**2 / 3, rtol=1e-3)
    rate = p[GYRO_BIAS, GYRO_BIAS]  # of the rate, while the state coasts
    np.testing.assert_allclose(np.trace(rate), TURN_RATE**2 * (1 - kept**2), rtol=1e-6)
    np.testing.assert_array_equal(p, p.T)


def test_coasting_turns_at_the_rate_that_fades() -> None:
    """Attitude and velocity turn along, and the gyro bias comes back as it was."""
    state = Path(MUNICH, 10.0).state()
    state.stamps[[T, PHASE]] = T0, RUNNING
    state.covariance[GYRO_BIAS, GYRO_BIAS] = np.diag([1e-6, 2e-6, 3e-6])
    state.nominal[GYRO_BIAS_B] = [0.01, -0.02, 0.03]
    before, bias = state.copy(), state.nominal[GYRO_BIAS_B].copy()
    state.auxiliary[RATE_B] = bias + np.array([0.0, 0.0, 0.3])
    coast(state, 2.0, make_parameters(config()).noise)
    angle = 0.3 * TURN_TIME * (1 - math.exp(-2 / TURN_TIME))
    down = mat_ne(before.nominal[:3])[2]
    turned = matrix(quaternion_exp(down * angle))
    np.testing.assert_allclose(state.nominal[3:6], turned @ before.nominal[3:6], rtol=0.02, atol=0.02)
    level = matrix(before.nominal[QUATERNION_EB])
    np.testing.assert_allclose(matrix(state.nominal[QUATERNION_EB]), turned @ level, atol=0.01)
    inject(state, np.concatenate([np.zeros(GYRO_BIAS.start), [0.0, 0.0, -0.1], np.zeros(state.size - GYRO_BIAS.stop)]))
    begin_coasting(state)  # a wheel said that it turns faster
    np.testing.assert_allclose(state.nominal[GYRO_BIAS_B], bias)
    rate = state.auxiliary[RATE_B] - bias
    assert rate[2] == pytest.approx(0.3 * math.exp(-2 / TURN_TIME) + 0.1, rel=1e-3)
    end_coasting(state)
    np.testing.assert_array_equal(state.nominal[GYRO_BIAS_B], bias)
    expected = np.diag([1e-6, 2e-6, 3e-6])
    np.testing.assert_allclose(state.covariance[GYRO_BIAS, GYRO_BIAS], expected, rtol=1e-3)
    assert not state.covariance[GYRO_BIAS, ATTITUDE].any()


def test_the_covariance_turns_as_the_state_does() -> None:
    """Two states that differ a little, in velocity, attitude or rate, differ after coasting as the covariance says."""
    noise = make_parameters(config()).noise
    for place in range(VELOCITY.start, GYRO_BIAS.stop):
        start = Path(MUNICH, 10.0).state()
        start.stamps[[T, PHASE]] = T0, RUNNING
        start.auxiliary[RATE_B] = [0.0, 0.0, 0.3]
        begin_coasting(start)
        error = np.zeros(start.size)
        error[place] = 1e-5
        known, unsure, other = start.copy(), start.copy(), start.copy()
        unsure.covariance[:] = np.outer(error, error)
        inject(other, error)
        for state in (known, unsure, other):
            coast(state, 0.05, noise)
        moved = difference(other, known)
        found = (unsure.covariance - known.covariance)[VELOCITY.start : ATTITUDE.stop, VELOCITY.start : ATTITUDE.stop]
        expected = moved[VELOCITY.start : ATTITUDE.stop]
        np.testing.assert_allclose(found, np.outer(expected, expected), atol=2e-13)


def test_covariance_stays_symmetric_and_positive_definite(compiled: bool) -> None:
    kernel = make_kernel(make_parameters(config()), compiled)
    rng = np.random.default_rng(6)
    state = running_state(rng)
    for _ in range(500):
        kernel.propagate(state, float(rng.uniform(1e-4, 0.05)), rng.normal(0, 5, 3), rng.normal(0, 0.5, 3))
        np.testing.assert_array_equal(state.covariance, state.covariance.T)
    sigma = np.sqrt(np.diag(state.covariance))
    assert np.linalg.eigvalsh(state.covariance / np.outer(sigma, sigma)).min() > 1e-9
    assert np.linalg.norm(state.nominal[QUATERNION_EB]) == pytest.approx(1.0, abs=1e-15)


def test_pole_is_where_the_ellipsoid_says() -> None:
    np.testing.assert_allclose(Path(ANYWHERE["north pole"], 0.0).origin, [0.0, 0.0, SEMI_MINOR + 10.0], atol=1e-8)


def test_attitude_errors_are_small_turns_in_earth_axes() -> None:
    state = running_state(np.random.default_rng(7))
    moved, turn = state.copy(), np.array([1e-3, -2e-3, 3e-3])
    error = np.zeros(ERROR_SIZE)
    error[ATTITUDE] = turn
    inject(moved, error)
    expected = matrix(quaternion_exp(turn)) @ matrix(state.nominal[QUATERNION_EB])
    np.testing.assert_allclose(matrix(moved.nominal[QUATERNION_EB]), expected, atol=1e-15)
    np.testing.assert_allclose(difference(moved, state)[ATTITUDE], turn, atol=1e-8)
