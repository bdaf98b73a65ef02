"""The slow error of GNSS positions: carried as the Gauss-Markov process that it is; shared by what a fix has placed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from fusiond.events import GnssPosition
from fusiond.filter import gnss_error
from fusiond.filter.observations import gnss_position
from fusiond.filter.observations.gnss_position import WHITE_SHARE
from fusiond.filter.observations.model import VALUES, Observation
from fusiond.filter.parameters import Parameters, make_parameters
from fusiond.filter.state import (
    GNSS_ERROR,
    GNSS_ERROR_E,
    NEVER,
    NOISE_EXCESS,
    POSITION,
    POSITION_E,
    T_GNSS_ERROR,
    VELOCITY,
    FilterState,
    T,
)
from fusiond.maths.typed import Array
from fusiond.maths.wgs84 import mat_ne
from fusiond.units import SECOND
from tests.helpers.streams import MUNICH, T0, config, drive, fuse, measurements, running_state, town

TAU = 20.0  # s
SLOW = 1 - WHITE_SHARE
GNSS: dict[str, Any] = {"position_correlation_s": TAU, "position_sigma_m": 2.0, "height_sigma_m": 3.0}
PARAMS = make_parameters(config(gnss=GNSS))
SOURCE = PARAMS.sources.index("gps0.position")
STATIONARY_N = np.diag([SLOW * 4.0, SLOW * 4.0, SLOW * 9.0])


def row(params: Parameters = PARAMS) -> Array:
    found = np.zeros(VALUES)
    (gnss,) = config(gnss=GNSS).gnss.values()
    values = gnss_position.values(GnssPosition(*MUNICH), gnss)
    found[: len(values)] = values
    return found


def later(state: FilterState, seconds: float) -> FilterState:
    """A copy, whose error is carried on so far."""
    state = state.copy()
    state.stamps[T] += round(seconds * SECOND)
    gnss_error.carry(state, SOURCE, row(), PARAMS)
    gnss_error.note(state, SOURCE, PARAMS)
    return state


def begun(seed: int = 1) -> FilterState:
    state = running_state(np.random.default_rng(seed))
    state.stamps[T_GNSS_ERROR] = state.stamps[T]
    return state


def of_the_ground(state: FilterState) -> Array:
    """The covariance of the error, north-east-down."""
    to_n = mat_ne(state.nominal[POSITION_E])
    return to_n @ state.covariance[GNSS_ERROR, GNSS_ERROR] @ to_n.T


def test_it_decays_and_grows_as_a_gauss_markov_process() -> None:
    before = begun()
    after, kept = later(before, 7.0), math.exp(-7.0 / TAU)
    np.testing.assert_allclose(after.nominal[GNSS_ERROR_E], kept * before.nominal[GNSS_ERROR_E], rtol=1e-12)
    expected = kept**2 * of_the_ground(before) + (1 - kept**2) * STATIONARY_N
    np.testing.assert_allclose(of_the_ground(after), expected, rtol=1e-9, atol=1e-12)
    others = [i for i in range(before.size) if not GNSS_ERROR.start <= i < GNSS_ERROR.stop]
    cross = kept * before.covariance[others, GNSS_ERROR]
    np.testing.assert_allclose(after.covariance[others, GNSS_ERROR], cross, rtol=1e-12)
    np.testing.assert_array_equal(after.covariance[np.ix_(others, others)], before.covariance[np.ix_(others, others)])
    np.testing.assert_array_equal(after.covariance, after.covariance.T)


def test_many_steps_are_one() -> None:
    """A fix that is missed, or one more, changes nothing of what the error is afterwards."""
    once = later(begun(), 12.0)
    often = begun()
    for _ in range(60):
        often = later(often, 0.2)
    np.testing.assert_allclose(often.nominal, once.nominal, rtol=1e-12)
    np.testing.assert_allclose(often.covariance, once.covariance, rtol=1e-9, atol=1e-12)


def test_after_a_long_silence_it_is_drawn_anew() -> None:
    after, never = later(begun(), 100 * TAU), begun()
    never.stamps[T_GNSS_ERROR] = NEVER
    for state in (after, later(never, 1.0)):
        np.testing.assert_allclose(of_the_ground(state), STATIONARY_N, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(state.nominal[GNSS_ERROR_E], 0.0, atol=1e-12)


def test_it_grows_with_the_noise_that_was_learnt() -> None:
    state = begun()
    state.memory[SOURCE, NOISE_EXCESS] = 3.2  # of which 0.2 is chance
    np.testing.assert_allclose(of_the_ground(later(state, 100 * TAU)), 4 * STATIONARY_N, rtol=1e-9, atol=1e-12)


def test_without_a_correlation_time_there_is_none() -> None:
    fusion = fuse(config(), measurements(town(20.0)))
    head = fusion.history.head
    assert head.stamps[T_GNSS_ERROR] != NEVER  # the start has placed it
    np.testing.assert_array_equal(head.nominal[GNSS_ERROR_E], 0.0)
    np.testing.assert_array_equal(head.covariance[GNSS_ERROR], 0.0)


def placed(params: Parameters = PARAMS, offset_n: tuple[float, float, float] = (3.0, -4.0, 5.0)) -> FilterState:
    """A state put where a fix says that is so far off."""
    state, seen = begun(), Observation(begun().size)
    seen.m = 3
    seen.innovation[:] = offset_n
    seen.variance[:] = (WHITE_SHARE * 4.0, WHITE_SHARE * 4.0, WHITE_SHARE * 9.0)
    gnss_error.place(state, SOURCE, row(), seen, params)
    return state


def test_a_position_that_a_fix_gives_is_off_by_what_the_fix_is() -> None:
    before, after = begun(), placed()
    to_n = mat_ne(before.nominal[POSITION_E])
    np.testing.assert_array_equal(after.nominal[GNSS_ERROR_E], 0.0)
    moved = after.nominal[POSITION_E] - before.nominal[POSITION_E] - before.nominal[GNSS_ERROR_E]
    np.testing.assert_allclose(to_n @ moved, (3.0, -4.0, 5.0), atol=1e-8)
    p = after.covariance
    np.testing.assert_allclose(to_n @ p[POSITION, POSITION] @ to_n.T, np.diag([4.0, 4.0, 9.0]), rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(p[POSITION, GNSS_ERROR], -p[GNSS_ERROR, GNSS_ERROR])
    both = p[POSITION, POSITION] + p[POSITION, GNSS_ERROR] + p[GNSS_ERROR, POSITION] + p[GNSS_ERROR, GNSS_ERROR]
    np.testing.assert_allclose(to_n @ both @ to_n.T, WHITE_SHARE * np.diag([4.0, 4.0, 9.0]), rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(p[POSITION, VELOCITY], 0.0)
    np.testing.assert_array_equal(p, p.T)


def test_the_first_position_is_off_by_what_the_first_fix_is(compiled: bool) -> None:
    """At the start as after a reset; fixes that are alike then teach nothing."""
    stands = drive(20.0, lambda t: 0.0 * t, lambda t: 0.3 + 0.0 * t)
    settings = config(gnss=GNSS | {"position_correlation_s": 1e6}, filter={"heading_deg": 17.0})
    fusion = fuse(settings, measurements(stands, seed=None), compiled)
    head = fusion.history.head
    to_n = mat_ne(head.nominal[POSITION_E])
    spread = to_n @ head.covariance[POSITION, POSITION] @ to_n.T
    least = np.diag(STATIONARY_N)
    assert (np.diag(spread) >= least).all()
    assert (np.diag(spread) <= 1.05 * least).all()
    error = to_n @ head.covariance[GNSS_ERROR, POSITION] @ to_n.T
    np.testing.assert_allclose(np.diag(error), -least, rtol=0.01)


@pytest.mark.parametrize("tau", [5.0, 40.0])
def test_a_mean_of_fixes_is_worth_what_it_is(tau: float) -> None:
    """At rest, the variance of the best mean of fixes over a span T with errors correlated over tau: 2 tau / (2 tau + T) of
    the slow variance, for a position that does not move (Grenander and Szego; white noise adds a little)."""
    stands = drive(60.0, lambda t: 0.0 * t, lambda t: 0.3 + 0.0 * t)
    settings = config(gnss=GNSS | {"position_correlation_s": tau}, filter={"heading_deg": 17.0})
    head = fuse(settings, measurements(stands, seed=None)).history.head
    to_n = mat_ne(head.nominal[POSITION_E])
    north = float(to_n[0] @ head.covariance[POSITION, POSITION] @ to_n[0])
    span = (int(head.stamps[T]) - T0) / SECOND - 1.0
    assert north == pytest.approx(SLOW * 4.0 * 2 * tau / (2 * tau + span), rel=0.1)
