"""The measurement update against closed forms: products of Gaussians, the Riccati equation, gates, and bad numbers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.events import GnssVelocity, Measurement
from fusiond.filter.measurement_update import (
    _solve,
    cholesky,
    correlation_factor,
    difference,
    inject,
    project,
    turn_along,
    update,
    whiten,
)
from fusiond.filter.observations.model import Observation
from fusiond.filter.parameters import make_parameters
from fusiond.filter.state import (
    ATTITUDE,
    ERROR_SIZE,
    NEVER,
    POSITION,
    POSITION_E,
    QUATERNION_EB,
    SCALE,
    VELOCITY,
    VELOCITY_E,
    WHEEL_SCALE,
    WIDE_SIZE,
    FilterState,
)
from fusiond.filter.strapdown import coast
from fusiond.maths.rotation import matrix, quaternion_exp, skew
from fusiond.maths.statistics import chi_square
from fusiond.maths.typed import Array
from fusiond.maths.wgs84 import mat_ne
from tests.helpers.streams import T0, apply, config, running_state, triple

ALWAYS = math.inf  # a gate that lets everything pass
PLACE = SCALE.start


def scalar(value: float, variance: float, state: FilterState) -> Observation:
    """A direct measurement of the wheel scale, which stands for a scalar of its own."""
    jacobian = np.zeros((1, state.size))
    jacobian[0, PLACE] = 1.0
    return Observation.of(value - state.nominal[WHEEL_SCALE], jacobian, np.array([variance]))


def scalar_state(mean: float, variance: float) -> FilterState:
    state = FilterState(1)
    state.covariance[:] = np.eye(state.size)
    state.nominal[WHEEL_SCALE], state.covariance[PLACE, PLACE] = mean, variance
    return state


def test_twenty_equal_measurements() -> None:
    """A1: each adds as much as the first; the variance is sigma^2 / 20."""
    values = np.random.default_rng(1).normal(3.0, 0.5, 20)
    state = scalar_state(values[0], 0.25)
    for value in values[1:]:
        assert update(state, scalar(value, 0.25, state), ALWAYS) == (0.0, True)
    assert state.covariance[PLACE, PLACE] == pytest.approx(0.25 / 20, rel=1e-14)
    assert state.nominal[WHEEL_SCALE][0] == pytest.approx(values.mean(), rel=1e-14)


def test_product_of_two_scalar_gaussians() -> None:
    """A2: (0, 1) with (1, 4) gives (0.2, 0.8)."""
    state = scalar_state(0.0, 1.0)
    update(state, scalar(1.0, 4.0, state), ALWAYS)
    assert state.nominal[WHEEL_SCALE][0] == pytest.approx(0.2, rel=1e-15)
    assert state.covariance[PLACE, PLACE] == pytest.approx(0.8, rel=1e-15)


def place_seen(state: FilterState, value: Array, variance: Array) -> Observation:
    jacobian = np.zeros((3, state.size))
    jacobian[:, POSITION] = np.eye(3)
    return Observation.of(value - state.nominal[POSITION_E], jacobian, variance)


def test_product_of_two_vector_gaussians() -> None:
    """A3: C = Cz (Cx + Cz)^-1 Cx, and a smaller volume than either's."""
    rng = np.random.default_rng(2)
    state = running_state(rng)
    state.covariance[ATTITUDE], state.covariance[:, ATTITUDE] = 0.0, 0.0  # an attitude error would turn the correction
    cx, x = state.covariance[POSITION, POSITION].copy(), state.nominal[POSITION_E].copy()
    variance, z = np.array([0.3, 1.0, 2.0]), state.nominal[POSITION_E] + rng.normal(size=3)
    cz = np.diag(variance)
    update(state, place_seen(state, z, variance), ALWAYS)
    c = state.covariance[POSITION, POSITION]
    np.testing.assert_allclose(c, cz @ np.linalg.inv(cx + cz) @ cx, rtol=1e-12)
    np.testing.assert_allclose(c, np.linalg.inv(np.linalg.inv(cx) + np.linalg.inv(cz)), rtol=1e-9)
    weighed = cx @ np.linalg.inv(cx + cz) @ (z - x)
    np.testing.assert_allclose(state.nominal[POSITION_E] - x, weighed, rtol=1e-8)
    assert np.linalg.det(c) < min(np.linalg.det(cx), np.linalg.det(cz))


def test_order_of_independent_sensors_does_not_matter() -> None:
    """A4."""
    ends = []
    for order in ((1.0, 2.0, 4.0), (4.0, 1.0, 2.0)):
        state = scalar_state(0.0, 3.0)
        for value in order:
            update(state, scalar(value, value, state), ALWAYS)
        ends.append((state.nominal[WHEEL_SCALE][0], state.covariance[PLACE, PLACE]))
    assert ends[0] == pytest.approx(ends[1], rel=1e-14)


def test_riccati_steady_state() -> None:
    """B1: a random walk of q a step, seen with r, settles at p = (q + sqrt(q^2 + 4 q r)) / 2 before each measurement."""
    layout = make_parameters(config(filter={"wheel_scale_walk": 0.1}))
    r, q, state = 0.5, 0.01, scalar_state(0.0, 10.0)
    state.nominal[:3] = 6.4e6, 0.0, 0.0
    for _ in range(200):
        update(state, scalar(0.0, r, state), ALWAYS)
        coast(state, 1.0, layout.noise)
    expected = (q + math.sqrt(q * q + 4 * q * r)) / 2
    assert state.covariance[PLACE, PLACE] == pytest.approx(expected, rel=1e-12)


def ill_conditioned(rng: np.random.Generator) -> Array:
    """A covariance of condition 1e12 with eigenvectors in all directions."""
    turn, _ = np.linalg.qr(rng.normal(size=(ERROR_SIZE, ERROR_SIZE)))
    covariance: Array = turn @ np.diag(np.logspace(6, -6, ERROR_SIZE)) @ turn.T
    covariance[ATTITUDE] *= 1e-3  # of angles that there are
    covariance[:, ATTITUDE] *= 1e-3
    return (covariance + covariance.T) / 2


@pytest.mark.parametrize("seed", range(4))
def test_joseph_form_keeps_an_ill_conditioned_covariance_positive(compiled: bool, seed: int) -> None:
    """A velocity of 1 um/s on a kilometre a second of doubt: the short form P - K H P leaves noise above its variance, of
    either sign; the filter's form leaves that, and a covariance that is positive to rounding."""
    state = running_state(np.random.default_rng(seed))
    p = ill_conditioned(np.random.default_rng(seed))
    state.covariance[:] = p
    sigma, h = 1e-6, np.eye(ERROR_SIZE)[VELOCITY]
    short = p - p @ h.T @ np.linalg.inv(h @ p @ h.T + sigma**2 * np.eye(3)) @ h @ p
    assert np.abs(short[VELOCITY, VELOCITY] - sigma**2 * np.eye(3)).max() > sigma**2
    settings = config(gnss={"velocity_sigma_mps": sigma})
    for k in range(1, 11):
        along_n = triple(mat_ne(state.nominal[POSITION_E]) @ state.nominal[VELOCITY_E])
        heard = Measurement(T0, "gps0.velocity", k, T0, GnssVelocity(*along_n))
        state.source_stamps[:] = NEVER  # so that a reading at the same instant is no duplicate
        state.copy_from(apply(settings, state, [heard], compiled).history.head)
        np.testing.assert_array_equal(state.covariance, state.covariance.T)
        seen = np.linalg.eigvalsh(state.covariance[VELOCITY, VELOCITY])
        np.testing.assert_allclose(seen, sigma**2 / k, rtol=0.05)
        assert np.linalg.eigvalsh(state.covariance).min() > -np.finfo(float).eps * 1e6


def test_gate_is_closed_above_one_and_open_up_to_it() -> None:
    gate = chi_square(0.999, 1)
    edge = math.sqrt(gate * (1.0 + 4.0))
    for factor, passes in ((1 - 1e-12, True), (1 + 1e-12, False), (-1 + 1e-12, True), (-1 - 1e-12, False)):
        state = scalar_state(0.0, 1.0)
        before = state.numbers.copy()
        ratio, fused = update(state, scalar(edge * factor, 4.0, state), gate)
        assert fused is passes
        assert ratio == pytest.approx(1.0, rel=1e-11)
        assert passes or (state.numbers == before).all()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("where", ["innovation", "jacobian", "variance"])
def test_numbers_that_are_not_finite_leave_the_state_untouched(where: str, bad: float) -> None:
    state = running_state(np.random.default_rng(3))
    seen = place_seen(state, state.nominal[POSITION_E] + 0.1, np.ones(3))
    getattr(seen, where)[..., 1] = bad
    before = state.numbers.copy()
    with np.errstate(invalid="ignore"):
        ratio, fused = update(state, seen, ALWAYS if where != "innovation" else 1.0)
    assert (ratio, fused) == (math.inf, False)
    np.testing.assert_array_equal(state.numbers, before)


@pytest.mark.parametrize("variance", [-1e-9, -1.0, -1e9])
def test_negative_variance_leaves_the_state_untouched(variance: float) -> None:
    state = running_state(np.random.default_rng(3))
    before = state.numbers.copy()
    seen = place_seen(state, state.nominal[POSITION_E] + 0.1, np.array([1.0, variance, 1.0]))
    assert update(state, seen, ALWAYS) == (math.inf, False)
    np.testing.assert_array_equal(state.numbers, before)


def test_a_miss_leaves_the_prediction() -> None:
    """D2: an infinite variance tells nothing, and changes not a bit."""
    state = scalar_state(1.0, 2.0)
    before = state.numbers.copy()
    update(state, scalar(5.0, math.inf, state), ALWAYS)
    update(state, scalar(1.0, 1.0, state), 10.0, factor=math.inf)
    np.testing.assert_array_equal(state.numbers, before)


def test_judged_by_its_own_variance_weighed_by_more() -> None:
    state, other = scalar_state(0.0, 1.0), scalar_state(0.0, 1.0)
    ratio, fused = update(state, scalar(1.0, 1.0, state), 1.0, factor=3.0)
    update(other, scalar(1.0, 3.0, other), ALWAYS)
    assert (ratio, fused) == (pytest.approx(0.5), True)
    np.testing.assert_allclose(state.numbers, other.numbers, rtol=1e-15)


def test_correlation_factor() -> None:
    assert correlation_factor(0.1, 0.0) == 1.0
    assert correlation_factor(math.inf, 2.0) == 1.0
    assert correlation_factor(100.0, 1.0) == pytest.approx(1.0, abs=1e-40)
    assert correlation_factor(0.01, 1.0) == pytest.approx(2 / 0.01, rel=1e-4)  # dense samples: two of a second's worth
    assert correlation_factor(1.0, 1.0) == pytest.approx(1 / math.tanh(0.5))
    assert correlation_factor(0.0, 1.0) == correlation_factor(1e-6, 1.0) == pytest.approx(2e6, rel=1e-6)
    assert correlation_factor(0.0, 1e12) == math.inf


def test_cholesky_and_solve() -> None:
    rng = np.random.default_rng(4)
    root = rng.normal(size=(3, 3))
    spread, right = root @ root.T + np.eye(3), rng.normal(size=(3, 5))
    variance, lower, gain = np.array([0.5, 0.0, 2.0]), np.zeros((3, 3)), np.empty((3, 5))
    for factor in (1.0, 7.0):
        matrix = spread + factor * np.diag(variance)
        assert cholesky(spread, variance, factor, 3, lower)
        np.testing.assert_allclose(lower @ lower.T, matrix, atol=1e-12)
        assert not np.triu(lower, 1).any()
        gain[:] = right
        _solve(lower, 3, gain)
        np.testing.assert_allclose(matrix @ gain, right, atol=1e-12)
    for bad in (-np.eye(2), np.array([[1.0, 2.0], [2.0, 1.0]]), np.diag([1.0, math.nan]), np.diag([math.inf, 1.0])):
        assert not cholesky(bad, np.zeros(2), 1.0, 2, lower)
    for wrong in (-1e-300, math.nan, math.inf):
        assert not cholesky(np.eye(2), np.array([1.0, wrong]), 1.0, 2, lower)


@pytest.mark.parametrize("m", [1, 2, 3])
def test_projection_and_whitening_against_matrices(m: int) -> None:
    """H P, H P H', and L^-1 d of H P H' + R = L L'."""
    rng = np.random.default_rng(5)
    state = running_state(rng)
    jacobian, innovation, variance = rng.normal(size=(m, state.size)), rng.normal(size=m), rng.uniform(0.1, 2.0, m)
    jacobian[:, rng.permutation(state.size)[:6]] = 0.0  # most models see a part of the state
    across, spread, whitened = np.empty((3, state.size)), np.empty((3, 3)), np.empty(3)
    project(state, Observation.of(innovation, jacobian, variance), across, spread)
    np.testing.assert_allclose(across[:m], jacobian @ state.covariance, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(spread[:m, :m], jacobian @ state.covariance @ jacobian.T, rtol=1e-12)
    assert whiten(spread, innovation, variance, m, whitened)
    lower = np.linalg.cholesky(jacobian @ state.covariance @ jacobian.T + np.diag(variance))
    np.testing.assert_allclose(whitened[:m], np.linalg.solve(lower, innovation), rtol=1e-11)


def test_a_correction_turns_along_with_the_attitude() -> None:
    """P = M P M', with -[correction]x where M's rows of position and velocity meet its columns of attitude."""
    rng = np.random.default_rng(6)
    state, error = running_state(rng), rng.normal(size=ERROR_SIZE)
    turn = np.eye(ERROR_SIZE)
    for block in (POSITION, VELOCITY):
        turn[block, ATTITUDE] = -skew(error[block])
    expected = turn @ state.covariance @ turn.T
    turn_along(state.covariance, error)
    np.testing.assert_allclose(state.covariance, expected, rtol=1e-12, atol=1e-15)
    np.testing.assert_array_equal(state.covariance, state.covariance.T)


@pytest.mark.parametrize("size", [ERROR_SIZE, WIDE_SIZE])
def test_injection_adds_every_block_to_its_own(size: int) -> None:
    state = running_state(np.random.default_rng(7), size=size)
    before, error = state.copy(), np.random.default_rng(8).normal(0.0, 1e-2, size)
    inject(state, error)
    change = state.nominal - before.nominal
    np.testing.assert_allclose(change[POSITION_E], error[POSITION], atol=2e-9)  # of 6,400 km
    np.testing.assert_allclose(change[VELOCITY_E], error[VELOCITY], rtol=1e-9)
    np.testing.assert_allclose(change[QUATERNION_EB.stop : size + 1], error[ATTITUDE.stop :], rtol=1e-9)
    turn = matrix(state.nominal[QUATERNION_EB]) @ matrix(before.nominal[QUATERNION_EB]).T
    np.testing.assert_allclose(turn, matrix(quaternion_exp(error[ATTITUDE])), atol=1e-14)
    np.testing.assert_array_equal(state.covariance, before.covariance)


@pytest.mark.parametrize("size", [ERROR_SIZE, WIDE_SIZE])
def test_difference_is_what_inject_adds(size: int) -> None:
    rng = np.random.default_rng(1)
    state = running_state(rng, size=size)
    moved, error = state.copy(), rng.normal(0.0, 1e-3, state.size)
    inject(moved, error)
    np.testing.assert_allclose(difference(moved, state), error, atol=1e-8)
    assert abs(difference(moved, state)[ATTITUDE]).max() > 0
    moved.nominal[QUATERNION_EB] *= -1  # the same attitude
    np.testing.assert_allclose(difference(moved, state), error, atol=1e-8)


@pytest.mark.parametrize("variance", [1e-4, 0.0])
def test_with_the_scale_given_the_gain_is_that_of_a_filter_that_knows_it(variance: float) -> None:
    """The scale stays as it is, to the bit; the nominal state goes where a filter without that state would take it, and the
    covariance is that plus what the scale's error does to it."""
    random = np.random.default_rng(5)
    state, known = FilterState(1), FilterState(1)
    n, s = state.size, SCALE.start
    half = random.normal(size=(n, n)) * 0.1
    known.covariance[:] = half @ half.T
    known.covariance[s], known.covariance[:, s] = 0.0, 0.0
    owed = random.normal(size=n) * (variance > 0)  # what the other states owe to the scale's error
    owed[s] = 1.0
    state.covariance[:] = known.covariance + variance * np.outer(owed, owed)
    jacobian = np.zeros((1, n))
    jacobian[0, [3, 4, s]] = 1.0, 0.3, 20.0
    seen = Observation.of(np.array([0.4]), jacobian, np.array([0.01]))
    before = state.covariance[s, s]
    gain = known.covariance @ jacobian[0] / (jacobian[0] @ known.covariance @ jacobian[0] + 0.01)
    update(state, seen, ALWAYS, given=True)
    update(known, seen, ALWAYS)
    assert state.nominal[WHEEL_SCALE] == 0.0
    assert state.covariance[s, s] == pytest.approx(before, rel=1e-12)
    np.testing.assert_allclose(state.nominal, known.nominal, atol=1e-12)
    left = owed - gain * (jacobian[0] @ owed)
    without_turn = state.covariance[9:15, 9:15]  # `turn_along` changes position and velocity
    expected = known.covariance + variance * np.outer(left, left)
    np.testing.assert_allclose(without_turn, expected[9:15, 9:15], atol=1e-12)
