"""The slow error of GNSS positions: carried as the Gauss-Markov process that it is; shared by what a fix has placed."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import pytest

from fusiond.estimator.fusion import Fusion
from fusiond.events import GnssPosition, Measurement
from fusiond.filter import gnss_error
from fusiond.filter.measurement_update import difference
from fusiond.filter.observations import gnss_position
from fusiond.filter.observations.model import VALUES, Observation
from fusiond.filter.parameters import Parameters, make_parameters
from fusiond.filter.rows import Outcome
from fusiond.filter.state import (
    CALIBRATIONS,
    GNSS_ERROR,
    GNSS_ERROR_E,
    NEVER,
    NOISE_EXCESS,
    POSITION,
    POSITION_E,
    T_GNSS_ERROR,
    VELOCITY,
    VELOCITY_E,
    FilterState,
    T,
)
from fusiond.filter.stored_state import stored_state
from fusiond.maths.typed import Array
from fusiond.maths.wgs84 import geodetic, mat_ne
from fusiond.units import SECOND
from tests.helpers.streams import MUNICH, T0, apply, config, drive, fuse, measurements, running_state, town

TAU, WHITE_SHARE = 20.0, 0.2  # s; the default
SLOW = 1 - WHITE_SHARE
GNSS: dict[str, Any] = {"position_correlation_s": TAU, "position_sigma_m": 2.0, "height_sigma_m": 3.0, "stamp_sigma_ms": 0.0}
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
    gnss_error.note(state, SOURCE, row(), PARAMS)
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


def test_it_is_not_stored() -> None:
    kept = stored_state(begun(), config(gnss=GNSS))
    sky = slice(GNSS_ERROR.start - CALIBRATIONS, GNSS_ERROR.stop - CALIBRATIONS)
    assert kept.calibrations[sky] == kept.calibration_variances[sky] == [0.0, 0.0, 0.0]
    assert all(kept.calibration_variances[: sky.start])


def placed(axes: int) -> FilterState:
    """A state put where a fix says that is far off, along the first axes of north, east, down."""
    state, seen = begun(), Observation(begun().size)
    seen.m = axes
    seen.innovation[:] = (3.0, -4.0, 5.0)
    seen.variance[:] = (WHITE_SHARE * 4.0, WHITE_SHARE * 4.0, WHITE_SHARE * 9.0)
    gnss_error.place(state, SOURCE, row(), seen, PARAMS)
    return state


def test_a_position_that_a_fix_gives_is_off_by_what_the_fix_is() -> None:
    before, after = begun(), placed(3)
    to_n = mat_ne(before.nominal[POSITION_E])
    np.testing.assert_array_equal(after.nominal[GNSS_ERROR_E], 0.0)
    moved = after.nominal[POSITION_E] - before.nominal[POSITION_E] - before.nominal[GNSS_ERROR_E]
    np.testing.assert_allclose(to_n @ moved, (3.0, -4.0, 5.0), atol=1e-8)
    p = after.covariance
    np.testing.assert_allclose(to_n @ p[POSITION, POSITION] @ to_n.T, np.diag([4.0, 4.0, 9.0]), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(p[POSITION, GNSS_ERROR], -p[GNSS_ERROR, GNSS_ERROR], rtol=1e-12, atol=1e-12)
    both = p[POSITION, POSITION] + p[POSITION, GNSS_ERROR] + p[GNSS_ERROR, POSITION] + p[GNSS_ERROR, GNSS_ERROR]
    np.testing.assert_allclose(to_n @ both @ to_n.T, WHITE_SHARE * np.diag([4.0, 4.0, 9.0]), rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(p[POSITION, VELOCITY], 0.0)
    np.testing.assert_array_equal(p, p.T)


def test_a_place_leaves_the_height_as_it_is() -> None:
    before, after = begun(), placed(2)
    to_n = mat_ne(before.nominal[POSITION_E])
    moved = to_n @ (after.nominal[POSITION_E] - before.nominal[POSITION_E])
    old = to_n @ before.nominal[GNSS_ERROR_E]
    np.testing.assert_allclose(moved, (3.0 + old[0], -4.0 + old[1], 0.0), atol=1e-8)
    p = after.covariance
    spread = to_n @ p[POSITION, POSITION] @ to_n.T
    height = to_n[2] @ before.covariance[POSITION, POSITION] @ to_n[2]
    np.testing.assert_allclose(spread, np.diag([4.0, 4.0, height]), rtol=1e-9, atol=1e-9)
    tied = to_n @ p[POSITION, GNSS_ERROR] @ to_n.T
    np.testing.assert_allclose(tied, np.diag([-SLOW * 4.0, -SLOW * 4.0, 0.0]), rtol=1e-9, atol=1e-9)
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
    the slow variance, for a position that does not move (Grenander and Szego; white noise adds a little, and
    what a standstill leaves of the velocity)."""
    stands = drive(60.0, lambda t: 0.0 * t, lambda t: 0.3 + 0.0 * t)
    settings = config(gnss=GNSS | {"position_correlation_s": tau}, filter={"heading_deg": 17.0})
    head = fuse(settings, measurements(stands, seed=None)).history.head
    to_n = mat_ne(head.nominal[POSITION_E])
    north = float(to_n[0] @ head.covariance[POSITION, POSITION] @ to_n[0])
    span = (int(head.stamps[T]) - T0) / SECOND - 1.0
    assert north == pytest.approx(SLOW * 4.0 * 2 * tau / (2 * tau + span), rel=0.12)


def of_type(fix_type: int) -> Array:
    found = row()
    found[gnss_position.TYPE_OF_FIX] = fix_type
    return found


def test_another_fix_type_has_another_error() -> None:
    """RTK float to fixed: whatever the error was, it is drawn anew; the position keeps what is known of it."""
    state = begun()
    gnss_error.note(state, SOURCE, of_type(5), PARAMS)
    before = state.copy()
    gnss_error.carry(state, SOURCE, of_type(5), PARAMS)
    np.testing.assert_array_equal(state.covariance, before.covariance)  # at one instant nothing changes
    gnss_error.carry(state, SOURCE, of_type(6), PARAMS)
    np.testing.assert_array_equal(state.nominal[GNSS_ERROR_E], 0.0)
    np.testing.assert_allclose(of_the_ground(state), STATIONARY_N, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(state.covariance[GNSS_ERROR, POSITION], 0.0)
    np.testing.assert_array_equal(state.covariance[POSITION, POSITION], before.covariance[POSITION, POSITION])


def test_what_stamps_are_off_by_lasts_along_the_track() -> None:
    params = make_parameters(config(gnss=GNSS | {"stamp_sigma_ms": 50.0}))
    state = begun()
    state.stamps[T_GNSS_ERROR] = NEVER
    gnss_error.carry(state, SOURCE, row(), params)
    along = mat_ne(state.nominal[POSITION_E]) @ state.nominal[VELOCITY_E] * 0.05
    np.testing.assert_allclose(of_the_ground(state), STATIONARY_N + SLOW * np.outer(along, along), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("offset_n", "moves"), [((0.3, 0.2, 60.0), "place"), ((50.0, 0.0, 0.3), "height")])
def test_height_and_place_are_gated_apart(offset_n: tuple[float, float, float], moves: str, compiled: bool) -> None:
    """A fix whose height is off by 60 m still corrects the place, and the other way round; the row tells of the place."""
    state = begun()
    state.covariance[:] = np.diag([1.0] * 3 + [1e-12] * (state.size - 3))
    to_n = mat_ne(state.nominal[POSITION_E])
    off = to_n.T @ np.array(offset_n)
    fix = Measurement(T0, "gps0.position", 1, T0, GnssPosition(*geodetic(state.nominal[POSITION_E] + off)))
    history = apply(config(gnss={"lever_arm_m": (0.0, 0.0, 0.0)}), state, [fix], compiled).history
    moved = to_n @ (history.head.nominal[POSITION_E] - state.nominal[POSITION_E])
    if moves == "place":
        assert moved[:2] == pytest.approx(np.array(offset_n[:2]) / 3.25, rel=1e-3)
        assert abs(moved[2]) < 0.01
        assert history.rows["outcome"][0] == Outcome.FUSED
        assert history.rows["ratio"][0] < 1
        assert to_n[2] @ history.head.covariance[POSITION, POSITION] @ to_n[2] == pytest.approx(1.0)  # nothing learnt
    else:
        assert abs(moved[0]) < 0.01
        assert moved[2] == pytest.approx(offset_n[2] / 10.0, rel=1e-3)
        assert history.rows["outcome"][0] == Outcome.REJECTED
        assert history.rows["ratio"][0] > 1
    np.testing.assert_allclose(history.rows["innovation"][0], offset_n, atol=1e-6)


def test_a_height_that_stays_off_is_believed_in_the_end() -> None:
    """The fixes' height jumps by 40 m for good: the place is never lost, and the height follows within a minute or so."""
    events = []
    for event in measurements(town(100.0)):
        payload = event.payload
        if isinstance(payload, GnssPosition) and event.t_ns > T0 + 20 * SECOND:
            payload = msgspec.structs.replace(payload, height=payload.height + 40.0)
        events.append(msgspec.structs.replace(event, payload=payload))
    fusion = fuse(config(), events)
    counts = fusion.history.counts[fusion.history.index["gps0.position"]]
    assert counts[Outcome.REJECTED] <= 0.02 * counts.sum()
    _, _, height = geodetic(fusion.history.head.nominal[POSITION_E])
    assert height == pytest.approx(MUNICH[2] + 40.0, abs=2.0)


def test_a_rover_has_centimetres_while_its_receiver_has_them() -> None:
    """Single, fixed, float, fixed again, each with an error of its own that stays: no transition is a fault, the position is
    as good as the fix soon after it, and never better than it says."""
    truth = town(80.0)
    rng = np.random.default_rng(1)
    spans = ((0.0, 3, 1.0), (30.0, 6, 0.01), (50.0, 5, 0.2), (65.0, 6, 0.01))  # from second, fix type, sigma
    off = {begin: sigma * rng.standard_normal(3) for begin, _, sigma in spans}
    events = []
    for event in measurements(truth):
        payload = event.payload
        if isinstance(payload, GnssPosition):
            second = (event.t_ns - T0) / SECOND
            begin, fix_type, sigma = next(span for span in reversed(spans) if second >= span[0])
            place = truth.position_e[truth.at(second)]
            error = off[begin] + 0.3 * sigma * rng.standard_normal(3)
            payload = GnssPosition(*geodetic(place + mat_ne(place).T @ error), None, None, fix_type)
        events.append(msgspec.structs.replace(event, payload=payload))
    fusion = Fusion(config(gnss={"position_correlation_s": 30.0}))
    looks = {20.0: 2.0, 34.0: 0.05, 49.0: 0.03, 64.0: 0.3, 69.0: 0.05, 79.0: 0.03}  # second: worst error [m]
    for event in events:
        fusion.fuse(event)
        second = (event.t_ns - T0) / SECOND
        if event.source == "imu0" and second in looks:
            head = fusion.history.head
            to_n = mat_ne(head.nominal[POSITION_E])
            error = (to_n @ (head.nominal[POSITION_E] - truth.position_e[truth.at(second)]))[:2]
            spread = (to_n @ head.covariance[POSITION, POSITION] @ to_n.T)[:2, :2]
            assert np.linalg.norm(error) < looks[second], second
            assert error @ np.linalg.solve(spread, error) < 13.8, second  # chi-square, 2 degrees, 99.9 %
    counts = fusion.history.counts[fusion.history.index["gps0.position"]]
    assert counts[Outcome.REJECTED] <= 3


def test_a_receiver_is_judged_by_its_whole_error() -> None:
    """d + e, with H P H' + Sigma - P_e: the innovation and its covariance of a fix less the antenna, as if e were new."""
    state, params = begun(), make_parameters(config(gnss=GNSS | {"stamp_sigma_ms": 50.0}))
    to_n = mat_ne(state.nominal[POSITION_E])
    along = to_n @ state.nominal[VELOCITY_E] * 0.05
    sigma = np.diag(STATIONARY_N) + SLOW * along**2
    own = np.diag(of_the_ground(state))
    innovation, spread = np.array([1.0, -2.0, 3.0]), np.full((3, 3), 0.5)
    gnss_error.with_whole_error(state, SOURCE, row(), params, innovation, spread)
    np.testing.assert_allclose(innovation, [1.0, -2.0, 3.0] + to_n @ state.nominal[GNSS_ERROR_E], rtol=1e-12)
    np.testing.assert_allclose(np.diag(spread), 0.5 + np.maximum(sigma - own, 0.0), rtol=1e-9)
    assert (spread[~np.eye(3, dtype=bool)] == 0.5).all()


def test_a_prior_that_is_forgotten() -> None:
    """The information form: P^-1 less Sigma^-1 at e, and P^-1 x the same, as Sigma is the variance of a measured e = 0."""
    state = begun()
    state.covariance[GNSS_ERROR] *= 0.1
    state.covariance[:, GNSS_ERROR] *= 0.1
    before, e = state.copy(), np.eye(state.size)[GNSS_ERROR]
    to_n = mat_ne(state.nominal[POSITION_E])
    sigma = gnss_error.KNOWN * to_n.T @ STATIONARY_N @ to_n
    gnss_error.forget_prior(state, SOURCE, row(), PARAMS)
    information = np.linalg.inv(before.covariance) - e.T @ np.linalg.inv(sigma) @ e
    expected = np.linalg.inv(information)
    np.testing.assert_allclose(state.covariance, expected, rtol=1e-5, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_array_equal(state.covariance, state.covariance.T)
    pulled = expected @ (e.T @ np.linalg.inv(sigma) @ before.nominal[GNSS_ERROR_E])
    np.testing.assert_allclose(difference(state, before)[GNSS_ERROR], pulled[GNSS_ERROR], rtol=1e-6)
    np.testing.assert_allclose(difference(state, before)[POSITION], pulled[POSITION], rtol=1e-6, atol=2e-9)


def test_without_a_correlation_time_there_is_no_prior() -> None:
    state, params, spread = begun(), make_parameters(config()), np.ones((3, 3))
    before, innovation = state.copy(), np.ones(3)
    gnss_error.with_whole_error(state, SOURCE, row(), params, innovation, spread)
    gnss_error.forget_prior(state, SOURCE, row(), params)
    assert (innovation == 1.0).all()
    assert (spread == 1.0).all()
    np.testing.assert_array_equal(state.numbers, before.numbers)
