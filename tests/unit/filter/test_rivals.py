"""Rival hypotheses against closed forms: Bayes' rule, the mixture's moments, decisions by their costs; and whole drives in
which a receiver or the inertial sensor lies."""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from fusiond.estimator.fusion import Fusion
from fusiond.events import GnssPosition, ImuSample, Invalid, Measurement, Payload
from fusiond.filter import rivals
from fusiond.filter.measurement_update import difference, inject
from fusiond.filter.observations.model import Observation
from fusiond.filter.parameters import Parameters, make_parameters
from fusiond.filter.source_health import OUTAGE_NS, OUTLIER_VARIANCE, OUTLIERS, PRIOR
from fusiond.filter.state import (
    ALIVE,
    BIASED,
    COASTING,
    EXCLUDED,
    FIX_TYPE,
    GYRO_BIAS,
    INERTIAL_DOUBT,
    INERTIAL_ODDS,
    LED_OFF,
    LED_OFF_ODDS,
    MAIN_WEIGHT,
    NOMINAL,
    POSITION,
    POSITION_E,
    RESET_SOURCE,
    SUSPECT,
    T_LAST,
    FilterState,
    ResetReason,
    T,
)
from fusiond.maths.typed import Array
from fusiond.maths.wgs84 import ecef, mat_ne
from tests.conftest import needs_compiled
from tests.helpers.streams import SECOND, T0, Drive, config, measurements, reset_by, running_state, town
from tests.oracles.mixture import Mixture, collapse, log_normal

PARAMS = make_parameters(config())
PLACE, SPEED = PARAMS.sources.index("gps0.position"), PARAMS.sources.index("gps0.velocity")
Change = Callable[[Payload | Invalid, float], Payload | Invalid]  # by the seconds since the begin


def normal(off: Array, covariance: Array) -> float:
    """The normal density, up to (2 pi)^(-m/2)."""
    return math.exp(log_normal(off, covariance) + len(off) / 2 * math.log(2 * math.pi))


def spread_of(rng: np.random.Generator, m: int) -> tuple[Array, Array]:
    """A covariance (m, m), and the same in the room of (3, 3) that the filter has."""
    root, padded = rng.normal(size=(m, m)), np.full((3, 3), np.nan)
    padded[:m, :m] = root @ root.T
    return padded[:m, :m].copy(), padded


@pytest.mark.parametrize("m", [1, 2, 3])
def test_the_likelihood_is_the_normal_density_with_outliers(m: int) -> None:
    rng = np.random.default_rng(m)
    for scale in (0.1, 1.0, 5.0):
        spread, padded = spread_of(rng, m)
        variance, off = rng.uniform(0.1, 2.0, m), scale * rng.normal(size=m)
        s = spread + 3.0 * np.diag(variance)
        expected = (1 - OUTLIERS) * normal(off, s) + OUTLIERS * normal(off, OUTLIER_VARIANCE * s)
        assert rivals.likelihood(off, variance, 3.0, m, padded) == pytest.approx(expected, rel=1e-9)
    assert rivals.likelihood(off, -variance, 3.0, m, padded) == 0.0


@pytest.mark.parametrize("m", [1, 2, 3])
def test_what_is_unread_has_the_mean_likelihood(m: int) -> None:
    """exp of the mean of log N(d; 0, S) where d is N(0, S): exp(-m/2) / sqrt(det S)."""
    spread, padded = spread_of(np.random.default_rng(m), m)
    variance = np.linspace(0.5, 1.0, m)
    expected = math.exp(-m / 2) / math.sqrt(np.linalg.det(spread + np.diag(variance)))
    assert rivals.unread(variance, 1.0, m, padded) == pytest.approx(expected, rel=1e-9)


def contended(seed: int = 1, slots: tuple[int, ...] = (0, 1, 3)) -> FilterState:
    """A running state with rivals elsewhere, of random weights and covariances."""
    rng = np.random.default_rng(seed)
    state = running_state(rng)
    state.stamps[SUSPECT] = PLACE
    for slot in slots:
        rivals.open_slot(state, slot, float(rng.uniform(0.1, 2.0)))
        rival, other = state.hypothesis(slot), running_state(rng)
        rival.covariance[:] = other.covariance
        inject(rival, 0.1 * np.sqrt(np.diag(other.covariance)) * rng.normal(size=state.size))
    return state


def test_mixing_keeps_the_moments() -> None:
    state = contended()
    before = state.copy()
    alive = [before.hypothesis(slot) for slot in (0, 1, 3)]
    weights = np.array([before.auxiliary[MAIN_WEIGHT], *(before.bank[slot, 0] for slot in (0, 1, 3))])
    means = np.array([np.zeros(state.size), *(difference(rival, before) for rival in alive)])
    covariances = np.array([before.covariance, *(rival.covariance for rival in alive)])
    expected = collapse(Mixture(weights / weights.sum(), means, covariances))
    rivals.mix(state, rivals.MEAN)
    np.testing.assert_allclose(state.covariance, expected.covariance, rtol=1e-9, atol=1e-15)
    np.testing.assert_array_equal(state.covariance, state.covariance.T)
    np.testing.assert_allclose(difference(state, before), expected.mean, rtol=1e-6, atol=2e-9)  # of 6,400 km


def test_the_weights_sum_to_one() -> None:
    state = contended(2)
    shares = np.array([state.auxiliary[MAIN_WEIGHT], *state.bank[: rivals.RIVALS, 0]])
    rivals.decide(state, False, PARAMS)
    found = np.array([state.auxiliary[MAIN_WEIGHT], *state.bank[: rivals.RIVALS, 0]])
    np.testing.assert_allclose(found, shares / shares.sum(), rtol=1e-14)
    assert state.stamps[ALIVE] == 3


def test_a_reading_weighs_by_bayes_rule() -> None:
    state = contended(3)
    before = float(state.bank[0, 0])
    rivals.weigh(state, 0, 3.0, 1.5)
    assert state.bank[0, 0] == 2.0 * before
    rivals.weigh(state, 0, 0.0, 1.5)  # not to be judged
    assert state.bank[0, 0] == 2.0 * before


def test_there_are_at_most_four() -> None:
    state = contended(4, (0, 1, 2, 3))
    for slot in range(rivals.RIVALS):
        rivals.open_slot(state, slot, 0.5)  # it is there already
    assert state.stamps[ALIVE] == 4
    assert not state.bank[rivals.RIVALS :].any()
    rivals.close_slot(state, 1)
    rivals.close_slot(state, 1)
    assert state.stamps[ALIVE] == 3
    assert not state.bank[1].any()
    rivals.close_all(state)
    assert state.stamps[ALIVE] == 0
    assert not state.bank.any()


def test_none_begins_while_the_state_coasts() -> None:
    state = running_state(np.random.default_rng(1))
    state.auxiliary[COASTING] = 1.0
    rivals.suspect_motion(state, 1.0)
    rivals.open_slot(state, rivals.RECEIVER, 1.0)
    assert state.stamps[ALIVE] == 0
    assert not state.bank.any()


def test_a_rival_that_has_become_unlikely_is_given_up() -> None:
    state = contended(5)
    state.bank[rivals.RECEIVER, 0] = state.bank[rivals.WHEELS, 0] = 1e-9
    rivals.decide(state, False, PARAMS)
    assert state.stamps[ALIVE] == 1
    assert not state.bank[[rivals.RECEIVER, rivals.WHEELS]].any()


def test_the_rival_of_a_liar_leads() -> None:
    state = contended(6)
    state.memory[[PLACE, SPEED], EXCLUDED] = 0.0
    state.bank[rivals.RECEIVER, 0] = 1e9
    rival = state.hypothesis(rivals.RECEIVER)
    place, covariance = rival.nominal.copy(), rival.covariance.copy()
    rivals.decide(state, False, PARAMS)
    np.testing.assert_array_equal(state.nominal, place)
    np.testing.assert_array_equal(state.covariance, covariance)
    assert state.memory[[PLACE, SPEED], EXCLUDED].tolist() == [1.0, 1.0]
    assert state.memory[PLACE, NOMINAL] == PRIOR[BIASED - NOMINAL]  # until its readings say otherwise
    assert state.bank[rivals.RECEIVER, 0] == state.bank[rivals.WHEELS, 0] == 0


def test_positions_wait_for_a_velocity_that_lies_but_not_for_one_that_is_silent() -> None:
    state, near, far = running_state(np.random.default_rng(6)), np.array([1.0, -1.0, 0.0]), np.array([2.0, -1.0, 0.0])
    state.memory[[PLACE, SPEED], EXCLUDED] = 1.0
    assert rivals.fits_again(state, PLACE, near, 2, PARAMS)  # none was ever heard
    state.source_stamps[SPEED, T_LAST] = state.stamps[T] - OUTAGE_NS
    assert not rivals.fits_again(state, PLACE, near, 2, PARAMS)
    state.stamps[T] += 1
    assert rivals.fits_again(state, PLACE, near, 2, PARAMS)
    assert not rivals.fits_again(state, PLACE, far, 2, PARAMS)


@pytest.mark.parametrize(("fix_type", "wheel", "may"), [(3, False, True), (6, False, False), (6, True, True)])
def test_fixed_ambiguities_are_only_doubted_with_a_witness(fix_type: int, wheel: bool, may: bool) -> None:
    params, state = make_parameters(config(("rear_left",))), running_state(np.random.default_rng(6))
    receiver = params.sources.index("gps0.position")
    state.memory[receiver, FIX_TYPE] = fix_type
    if wheel:
        state.source_stamps[list(params.wheels), T_LAST] = state.stamps[T]
    assert rivals.may_lie(state, receiver, params) is may


def test_a_fix_that_is_not_led_off_speaks_for_its_receiver() -> None:
    """Three sigmas between where the velocity leads and where the fix is: exp(-9 / 2). Only the newest counts."""
    state, none, variance = contended(7, (rivals.RECEIVER,)), np.zeros((3, 3)), np.full(3, 0.25)
    begin = float(state.bank[rivals.RECEIVER, 0])
    state.auxiliary[LED_OFF], state.auxiliary[LED_OFF_ODDS] = 0.0, 1.0
    for _ in range(3):
        rivals.lead_off(state, SPEED, np.array([0.5, 0.0, 0.0]), 1.0, PARAMS)
    for _ in range(4):
        rivals.weigh_consistency(state, PLACE, np.zeros(3), none, variance)
    assert state.bank[rivals.RECEIVER, 0] == pytest.approx(begin * math.exp(-4.5), rel=1e-12)
    rivals.weigh_consistency(state, PLACE, np.array([3.0, 0.0, 0.0]), none, variance)  # the position goes along
    assert state.bank[rivals.RECEIVER, 0] == pytest.approx(begin, rel=1e-12)


def test_a_receiver_that_was_right_leads_back() -> None:
    state = contended(7, (rivals.RETURN,))
    state.memory[[PLACE, SPEED], EXCLUDED] = 1.0
    state.bank[rivals.RETURN, 0] = 1e9
    rivals.decide(state, False, PARAMS)
    assert not state.memory[:, EXCLUDED].any()
    assert state.stamps[RESET_SOURCE] == PLACE
    assert state.stamps[ALIVE] == 0


def leads(odds: float, **costs: float) -> bool:
    """Whether a rival with such odds, 100 m from the main state and 10 m wide, leads."""
    params: Parameters = make_parameters(config(filter=dict(costs)))
    state = running_state(np.random.default_rng(8))
    state.stamps[SUSPECT] = PLACE
    rivals.open_slot(state, rivals.RECEIVER, odds)
    rival = state.hypothesis(rivals.RECEIVER)
    rival.nominal[POSITION_E.start] += 100.0
    rival.covariance[POSITION, POSITION] = np.diag([100.0] * 3)
    rivals.decide(state, False, params)
    return bool(state.memory[PLACE, EXCLUDED])


def test_costs_change_the_decision() -> None:
    """At equal costs the odds that it takes are 10 by the ratio of the rival's sigma to the distance, sqrt(300) / 100."""
    needed = rivals.LEAD_BY_LOSS * math.sqrt(300.0) / 100.0
    equal = {"spoof_cost": 1.0, "dead_reckoning_cost": 1.0}
    assert not leads(0.99 * needed, **equal)
    assert leads(1.01 * needed, **equal)
    assert leads(0.2 * needed, spoof_cost=10.0, dead_reckoning_cost=1.0)
    assert not leads(2.0 * needed, spoof_cost=1.0, dead_reckoning_cost=10.0)


def test_the_odds_of_a_lie_follow_shiryaev() -> None:
    """What fits leaves them at the least; a rate that leaves the state far behind begins the rivals of the motion."""
    state = running_state(np.random.default_rng(9))
    seen = Observation(state.size)
    seen.m = 1
    seen.jacobian[0, GYRO_BIAS.start] = 1.0
    seen.variance[0] = 1e-6
    spread = np.zeros((3, 3))
    widened = 1e-6 + rivals.FIRST * rivals.LIE_RATE**2
    for off, begins in ((0.0, False), (0.004, False), (0.02, False), (0.02, True)):
        seen.innovation[0] = off
        fits = rivals.likelihood(seen.innovation, seen.variance, 1.0, 1, spread)
        lied = rivals.likelihood(seen.innovation, np.array([widened, 0.0, 0.0]), 1.0, 1, spread)
        expected = max(float(state.auxiliary[INERTIAL_ODDS]), rivals.LEAST_ODDS) * lied / fits
        rivals.watch_inertial(state, seen, 1.0, spread, fits)
        assert bool(expected >= rivals.BEGIN) is begins
        assert int(state.stamps[ALIVE]) == (2 if begins else 0)
        if not begins:
            assert state.auxiliary[INERTIAL_ODDS] == pytest.approx(expected, rel=1e-9)
    assert state.hypothesis(rivals.INERTIAL).nominal[INERTIAL_DOUBT] == 1.0
    assert state.bank[[rivals.INERTIAL, rivals.WHEELS], 0].tolist() == [rivals.BEGIN, rivals.BEGIN]


# --- Whole drives


def spoilt(truth: Drive, change: Change, seed: int = 1) -> list[Measurement]:
    """The measurements of a drive, as something changes them."""
    return [
        msgspec.structs.replace(event, payload=change(event.payload, (event.t_ns - T0) / SECOND))
        for event in measurements(truth, seed=seed)
    ]


def miss(fusion: Fusion, truth: Drive) -> float:
    """How far off the main state is, along the ground [m]."""
    head = fusion.history.head
    off = mat_ne(head.nominal[POSITION_E]) @ (head.nominal[POSITION_E] - truth.position_e[-1])
    return float(np.linalg.norm(off[:2]))


def north(payload: GnssPosition, metres: float) -> GnssPosition:
    return msgspec.structs.replace(payload, latitude=payload.latitude + metres / 6_371_000.0)


@needs_compiled
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_jump_is_not_followed_and_the_receiver_comes_back(seed: int) -> None:
    """100 m from 15 to 25 s: what is published is never pulled, and the fixes are fused again 5 s after it at the latest."""
    truth = town(30.0, rate=50.0)
    fusion, farthest, back = Fusion(config()), 0.0, 0

    def jump(payload: Payload | Invalid, t: float) -> Payload | Invalid:
        return north(payload, 100.0) if isinstance(payload, GnssPosition) and 15.0 <= t < 25.0 else payload

    for event in spoilt(truth, jump, seed):
        fusion.fuse(event)
        t = (event.t_ns - T0) / SECOND
        if event.source == "gps0.position" and t > 10.0:
            state = fusion.solution_at(event.t_ns).state
            assert state is not None
            place = truth.position_e[truth.at(t)]
            off = (mat_ne(place) @ (ecef(state.latitude, state.longitude, state.height) - place))[:2]
            farthest = max(farthest, float(np.linalg.norm(off)))
            spread = state.covariance[:2, :2] + 0.01 * np.eye(2)
            assert off @ np.linalg.solve(spread, off) < 16.0, t
            if 20.0 < t < 25.0:
                assert fusion.history.head.memory[PLACE, EXCLUDED] == 1.0
        if event.source == "gps0.position" and t > 28.0:
            back += int(fusion.history.head.memory[PLACE, EXCLUDED])
    assert farthest < 5.0
    assert back == 0


@needs_compiled
@pytest.mark.parametrize("rate", [0.5, 1.0, 2.0])
def test_a_spoof_that_pulls_away_is_found_out(rate: float) -> None:
    truth = town(32.0, rate=50.0)

    def pull(payload: Payload | Invalid, t: float) -> Payload | Invalid:
        pulled = rate * max(t - 12.0, 0.0)
        return north(payload, pulled) if isinstance(payload, GnssPosition) else payload

    fusion = Fusion(config())
    for event in spoilt(truth, pull):
        fusion.fuse(event)
    assert fusion.history.head.memory[PLACE, EXCLUDED] == 1.0
    assert fusion.health(T0 + 32 * SECOND)["gps0.position"].status == "biased"
    assert miss(fusion, truth) < 5.0


@needs_compiled
@pytest.mark.parametrize(("axis", "found"), [(0, True), (1, True), (2, False)])
def test_a_gyro_that_lies_is_found_out(axis: int, found: bool) -> None:
    """0.2 rad/s more on one axis for a second. The heading that this gives is put right before it does harm."""
    truth = town(25.0, rate=50.0)

    def turn(payload: Payload | Invalid, t: float) -> Payload | Invalid:
        if isinstance(payload, ImuSample) and 15.0 <= t < 16.0:
            rate = list(payload.angular_rate_b)
            rate[axis] += 0.2
            return msgspec.structs.replace(payload, angular_rate_b=tuple(rate))
        return payload

    fusion = Fusion(config())
    for event in spoilt(truth, turn):
        fusion.fuse(event)
    assert (reset_by(fusion)[1] is ResetReason.INERTIAL_LIED) is found
    assert not fusion.history.head.memory[:, EXCLUDED].any()
    assert miss(fusion, truth) < 3.0


@needs_compiled
@pytest.mark.parametrize("seed", range(1, 5))
def test_without_a_lie_there_is_no_rival(seed: int) -> None:
    truth = town(50.0, rate=50.0)
    fusion = Fusion(config())
    for event in measurements(truth, seed=seed):
        fusion.fuse(event)
        assert fusion.history.head.stamps[ALIVE] == 0
    assert miss(fusion, truth) < 2.0
