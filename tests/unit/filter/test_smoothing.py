"""The adjoint of the smoother against the dense solution of the same linear problem."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest

from fusiond.filter import gnss_error
from fusiond.filter.inertial_delay import catch_up
from fusiond.filter.observations import GNSS_POSITION
from fusiond.filter.parameters import Parameters, make_parameters
from fusiond.filter.smoothing import Link, against_others, inverse, through_transition, through_update
from fusiond.filter.state import GYRO_BIAS, POSITION_E, RATE_B, T_GNSS_ERROR, FilterState, T
from fusiond.filter.strapdown import coast, end_coasting, propagate
from fusiond.maths.typed import Array
from fusiond.units import SECOND
from tests.helpers.streams import config, running_state

SIZE, STEPS = 5, 12
FROZEN = SIZE - 1  # a state that is known and stays: the covariance is singular


class Toy(NamedTuple):
    """A linear system: x[k] = A[k] x[k-1] + w[k], z[k] = H[k] x[k] + v[k]; x[-1] is N(0, P)."""

    first: Array
    transitions: list[Array]
    noises: list[Array]
    sights: list[Array]
    variances: list[Array]
    readings: list[Array]


def toy(seed: int, weight: float = 1.0) -> Toy:
    """A random system. In every third step nothing is measured."""
    random = np.random.default_rng(seed)

    def spread(scale: float) -> Array:
        root = scale * random.normal(size=(SIZE, SIZE))
        root[FROZEN] = 0.0
        return np.asarray(root @ root.T)

    transitions, noises, sights, variances, readings = [], [], [], [], []
    for k in range(STEPS):
        moved = np.eye(SIZE)
        moved[:3] += 0.3 * random.normal(size=(3, SIZE))
        axes = 0 if k % 3 == 2 else int(random.integers(1, 4))
        transitions.append(moved)
        noises.append(spread(0.1))
        sights.append(random.normal(size=(axes, SIZE)))
        variances.append(random.uniform(0.1, 2.0, axes) * weight)
        readings.append(random.normal(size=axes) * 2.0)
    return Toy(spread(1.0), transitions, noises, sights, variances, readings)


def dense(given: Toy, left_out: int | None = None) -> tuple[Array, Array]:
    """Mean (STEPS, SIZE) and covariance (STEPS, SIZE, STEPS, SIZE) of all states at once, from all readings but one."""
    prior = np.zeros((STEPS * SIZE, STEPS * SIZE))
    own = given.first
    for k in range(STEPS):
        own = given.transitions[k] @ own @ given.transitions[k].T + given.noises[k]
        at = slice(k * SIZE, (k + 1) * SIZE)
        prior[at, at] = own
        across = own
        for later in range(k + 1, STEPS):
            across = given.transitions[later] @ across
            there = slice(later * SIZE, (later + 1) * SIZE)
            prior[there, at], prior[at, there] = across, across.T
    used = [k for k in range(STEPS) if k != left_out and len(given.readings[k])]
    sight = np.zeros((sum(len(given.readings[k]) for k in used), STEPS * SIZE))
    row = 0
    for k in used:
        sight[row : row + len(given.readings[k]), k * SIZE : (k + 1) * SIZE] = given.sights[k]
        row += len(given.readings[k])
    noise = np.diag(np.concatenate([given.variances[k] for k in used]))
    gain = np.linalg.solve(sight @ prior @ sight.T + noise, sight @ prior).T
    mean = gain @ np.concatenate([given.readings[k] for k in used])
    return mean.reshape(STEPS, SIZE), (prior - gain @ sight @ prior).reshape(STEPS, SIZE, STEPS, SIZE)


def forward(given: Toy, left_out: int | None = None) -> list[tuple[Link, Array, Array]]:
    """The links of a Kalman filter, each with the filter's prediction and its covariance."""
    found, x, p = [], np.zeros(SIZE), given.first
    for k in range(STEPS):
        x, p = given.transitions[k] @ x, given.transitions[k] @ p @ given.transitions[k].T + given.noises[k]
        link, h, m = Link(SIZE), given.sights[k], len(given.readings[k])
        link.row, link.m, link.transition[:] = k, m, given.transitions[k]
        found.append((link, x, p))
        if not m:
            continue
        link.sight[:m], link.across[:m], link.spread[:m, :m] = h, h @ p, h @ p @ h.T
        link.variance[:m], link.innovation[:m] = given.variances[k], given.readings[k] - h @ x
        if k == left_out:
            continue
        link.fused = True
        link.gain[:m] = np.linalg.solve(link.spread[:m, :m] + np.diag(given.variances[k]), h @ p)
        x = x + link.gain[:m].T @ link.innovation[:m]
        p = p - link.gain[:m].T @ h @ p
    return found


def close(found: Array, expected: Array) -> None:
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_a_linear_system_is_smoothed_as_by_dense_least_squares(seed: int) -> None:
    given = toy(seed)
    mean, covariance = dense(given)
    vector, matrix = np.zeros(SIZE), np.zeros((SIZE, SIZE))
    for link, x, p in reversed(forward(given)):
        if link.fused:
            through_update(link, vector, matrix)
        close(x + p @ vector, mean[link.row])
        close(p - p @ matrix @ p, covariance[link.row, :, link.row])
        through_transition(link.transition, vector, matrix)


@pytest.mark.parametrize("left_out", [0, 4, 10])
@pytest.mark.parametrize("used", [True, False])
def test_a_reading_is_judged_by_all_others(left_out: int, used: bool) -> None:
    """The same innovation and covariance whether it was used itself or not: that of the dense solution without it."""
    given = toy(7)
    mean, covariance = dense(given, left_out)
    sight, vector, matrix = given.sights[left_out], np.zeros(SIZE), np.zeros((SIZE, SIZE))
    for link, _, _ in reversed(forward(given, None if used else left_out)):
        if link.row == left_out:
            innovation, variance = np.zeros(3), np.zeros((3, 3))
            assert against_others(link, vector, matrix, innovation, variance)
            close(innovation[: link.m], given.readings[left_out] - sight @ mean[left_out])
            expected = sight @ covariance[left_out, :, left_out] @ sight.T + np.diag(given.variances[left_out])
            close(variance[: link.m, : link.m], expected)
            return
        if link.fused:
            through_update(link, vector, matrix)
        through_transition(link.transition, vector, matrix)


def test_a_weighed_reading_is_judged_by_its_own_variance() -> None:
    """Errors that are correlated are weighed by more than the variance, but are no larger."""
    plain, weighed = toy(3), toy(3, weight=4.0)
    mean, covariance = dense(weighed, 4)
    vector, matrix = np.zeros(SIZE), np.zeros((SIZE, SIZE))
    for link, _, _ in reversed(forward(weighed)):
        link.weight, link.variance[:] = 4.0, link.variance / 4.0
        if link.row == 4:
            innovation, variance = np.zeros(3), np.zeros((3, 3))
            assert against_others(link, vector, matrix, innovation, variance)
            close(innovation[: link.m], weighed.readings[4] - weighed.sights[4] @ mean[4])
            expected = weighed.sights[4] @ covariance[4, :, 4] @ weighed.sights[4].T + np.diag(plain.variances[4])
            close(variance[: link.m, : link.m], expected)
            return
        if link.fused:
            through_update(link, vector, matrix)
        through_transition(link.transition, vector, matrix)


def test_what_is_not_positive_definite_has_no_inverse() -> None:
    found = np.zeros((3, 3))
    assert not inverse(np.diag([1.0, -1.0, 0.0]), np.zeros(3), 1.0, 2, found)
    assert inverse(np.array([[2.0, 1.0, 0.0], [1.0, 3.0, 0.0], [0.0, 0.0, 0.0]]), np.ones(3), 1.0, 2, found)
    close(found[:2, :2], np.linalg.inv([[3.0, 1.0], [1.0, 4.0]]))


Work = Callable[[FilterState, Parameters], None]


def _coast(state: FilterState, params: Parameters) -> None:
    coast(state, 0.12, params.noise)


def _return(state: FilterState, params: Parameters) -> None:
    coast(state, 0.12, params.noise)
    end_coasting(state)


def _fix(state: FilterState, params: Parameters) -> None:
    """A second after the last one: the slow error has kept a part of itself."""
    source = params.models.index(GNSS_POSITION)
    state.stamps[T_GNSS_ERROR] = state.stamps[T] - SECOND
    gnss_error.carry(state, source, np.array([*state.nominal[POSITION_E], 1.0, 4.0, 3.0, 0, 0]), params)


WORK: dict[str, Work] = {
    "propagation": lambda state, params: propagate(
        state, 0.13, np.array([0.8, -0.5, -9.6]), np.array([0.1, 0.05, -0.4]), params.noise
    ),
    "coasting": _coast,
    "the end of coasting": _return,
    "a delay that is made up for": lambda state, _: catch_up(state, np.array([1.0, 2.0, 0.5]), np.array([0.1, 0.0, 0.3])),
    "the slow error of fixes": _fix,
}


@pytest.mark.parametrize("name", WORK)
def test_the_transition_is_what_becomes_of_the_covariance(name: str) -> None:
    """P = A P A' + Q: so of two covariances the difference becomes A (P - P') A', whatever is added."""
    gnss = {"position_correlation_s": 5.0, "delay_sigma_ms": 20.0}
    params = make_parameters(config(imu={"delay_sigma_ms": 10.0}, gnss=gnss))
    random, found = np.random.default_rng(5), []
    for scale in (1.0, 0.3):
        state = running_state(np.random.default_rng(2), len(params.sources), size=params.size)
        root = scale * random.normal(size=(params.size, params.size))
        before = root @ root.T
        state.covariance[:] = before
        state.auxiliary[RATE_B] = [0.02, -0.01, 0.3]
        state.track()
        WORK[name](state, params)
        found.append((before, state.covariance.copy(), state.transition.copy()))
    (before, after, transition), (other_before, other_after, other) = found
    np.testing.assert_array_equal(transition, other)
    assert not np.array_equal(transition, np.eye(params.size))
    kept = slice(None) if name != "the end of coasting" else ~np.isin(np.arange(params.size), np.r_[GYRO_BIAS])
    expected = transition @ (before - other_before) @ transition.T
    np.testing.assert_allclose((after - other_after)[kept][:, kept], expected[kept][:, kept], rtol=1e-9, atol=1e-9)


def test_a_state_is_only_tracked_where_it_is_asked_for() -> None:
    params = make_parameters(config())
    state = running_state(np.random.default_rng(2), len(params.sources), size=params.size)
    propagate(state, 0.01, np.array([0.0, 0.0, -9.8]), np.zeros(3), params.noise)
    assert not state.tracked and state.transition.size == 0
    state.track()
    assert not state.hypothesis(0).tracked and not state.copy().tracked
