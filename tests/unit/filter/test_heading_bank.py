"""The bank of heading hypotheses: it finds the heading from every start, honestly, and both kernels agree on it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.estimator.fusion import Fusion
from fusiond.estimator.solution import Mode
from fusiond.events import GnssVelocity, Measurement
from fusiond.filter.heading_bank import collapse_if_close, normalise, weigh
from fusiond.filter.observations.model import Observation
from fusiond.filter.parameters import make_parameters
from fusiond.filter.state import BLOWN, CHOOSING, HYPOTHESES, PHASE, RUNNING, FilterState, T
from fusiond.maths.wgs84 import mat_ne
from tests.conftest import needs_compiled
from tests.helpers.streams import PULLS_AWAY_S, SECOND, T0, Drive, bits, config, drive, fuse, measurements, ramp


def departing(heading: float, speed: float = 6.0, seconds: float = 13.0) -> Drive:
    """Stands, pulls away after 3 s, forward or in reverse, and weaves a little."""
    return drive(
        seconds,
        lambda t: speed * ramp(t, PULLS_AWAY_S, 4.0),
        lambda t: heading + 0.2 * np.sin(0.5 * t) * ramp(t, PULLS_AWAY_S, 3.0),
        rate=50.0,
    )


def yaw_error(fusion: Fusion, truth: Drive) -> tuple[float, float]:
    """Error of the published yaw at the end of a drive, and its sigma [rad]."""
    estimate = fusion.solution_at(T0 + round(truth.seconds[-1] * SECOND)).state
    assert estimate is not None, "there is a state at the end"
    forward_n = mat_ne(truth.position_e[-1]) @ truth.mat_eb[-1][:, 0]
    off = estimate.euler()[2] - math.atan2(forward_n[1], forward_n[0])
    return (off + math.pi) % (2 * math.pi) - math.pi, estimate.sigma_yaw()


@needs_compiled
@pytest.mark.parametrize("start_deg", range(0, 360, 15))
def test_the_heading_is_found_within_ten_seconds(start_deg: int) -> None:
    truth = departing(math.radians(start_deg))
    fusion = fuse(config(), measurements(truth, seed=start_deg + 1), True)
    error, sigma = yaw_error(fusion, truth)
    assert abs(error) < math.radians(5.0)
    assert abs(error) < 3 * sigma


@needs_compiled
@pytest.mark.parametrize("seed", range(6))
def test_in_reverse_with_wheels_that_do_not_tell(seed: int) -> None:
    """Only the inertial sensor knows: what feels as braking is speeding up backwards."""
    truth = departing(1.0 + seed, speed=-3.0)
    error, sigma = yaw_error(fuse(config(), measurements(truth, seed=seed + 1), True), truth)
    assert abs(error) < math.radians(5.0)
    assert abs(error) < 3 * sigma


@pytest.mark.parametrize("column", [0, 1, -1], ids=["weight", "position", "variance"])
@pytest.mark.parametrize("whole", [False, True])
def test_hypotheses_that_are_not_finite_are_given_up(compiled: bool, whole: bool, column: int) -> None:
    """The others go on; where none is left the filter aligns anew. Neither publishes what is not finite."""
    truth = departing(2.0)
    fusion, poisoned = Fusion(config(), compiled), False
    head = fusion.history.head
    with np.errstate(invalid="ignore"):
        for event in measurements(truth):
            if not poisoned and head.stamps[PHASE] == CHOOSING and event.t_ns > T0 + SECOND:
                poisoned = True
                head.bank[:: 1 if whole else 4, column] = math.nan  # of each, or of every fourth
            fusion.fuse(event)
            state = fusion.solution_at(int(head.stamps[T])).state
            assert state is None or math.isfinite(sum(state.velocity_n) + state.covariance.sum())
    assert poisoned
    assert head.stamps[BLOWN] == whole
    assert head.stamps[PHASE] == RUNNING


def test_at_rest_it_waits_and_then_runs(compiled: bool) -> None:
    truth = departing(2.0, seconds=6.0)
    fusion, phases = Fusion(config(), compiled), []
    for event in measurements(truth):
        fusion.fuse(event)
        if not phases or phases[-1][1] != fusion.history.head.stamps[PHASE]:
            phases.append((float(fusion.history.head.stamps[T] - T0) / SECOND, int(fusion.history.head.stamps[PHASE])))
    assert [phase for _, phase in phases][-2:] == [CHOOSING, RUNNING]
    assert PULLS_AWAY_S < phases[-1][0] < PULLS_AWAY_S + 2.5
    assert fusion.solution_at(T0 + 2 * SECOND).mode is not Mode.LOST
    assert not fusion.history.head.bank.any()  # nothing of it is left


@needs_compiled
def test_both_kernels_agree_while_choosing() -> None:
    truth = departing(4.0, seconds=3.5)
    for until in (2.5, 3.5):
        events = [event for event in measurements(truth) if event.t_ns < T0 + until * SECOND]
        one, other = (fuse(config(), events, compiled).history.head for compiled in (True, False))
        assert one.stamps[PHASE] == other.stamps[PHASE] == CHOOSING
        np.testing.assert_array_equal(bits(one.numbers), bits(other.numbers))
        np.testing.assert_array_equal(one.whole, other.whole)


@needs_compiled
def test_one_wild_fix_decides_nothing() -> None:
    """A velocity that is off by 60 m/s while the vehicle stands fits no heading better than another."""
    events = measurements(departing(0.3, seconds=2.9))
    wild = next(i for i, event in enumerate(events) if event.source == "gps0.velocity" and event.t_ns > T0 + 2 * SECOND)
    event = events[wild]
    events[wild] = Measurement(event.t_ns, event.source, event.sequence, event.t_receive_ns, GnssVelocity(60.0, 0.0, 0.0))
    weights = fuse(config(), events, True).history.head.bank[:, 0]
    assert weights.max() < 0.3
    assert (weights > 0).sum() == 12


@pytest.mark.parametrize(("m", "off"), [(1, 0.3), (2, 1.5), (3, 40.0), (3, 1e4)])
def test_a_weight_takes_the_likelihood_with_a_share_of_outliers(m: int, off: float) -> None:
    """(1 - share) N(d; 0, S) + share N(d; 0, 100 S), but for (2 pi)^(m/2); the farthest innovations count as 1000 squared
    sigmas, so that no hypothesis vanishes by one."""
    rng = np.random.default_rng(m)
    state = FilterState(1)
    state.covariance[:] = np.diag(rng.uniform(0.5, 2.0, state.size))
    jacobian, variance, factor = rng.normal(size=(m, state.size)), rng.uniform(0.2, 1.0, m), 3.0
    innovation, spread = off * rng.normal(size=m), np.zeros((3, 3))
    spread[:m, :m] = jacobian @ state.covariance @ jacobian.T
    whole = spread[:m, :m] + factor * np.diag(variance)
    square = float(innovation @ np.linalg.solve(whole, innovation))
    near = math.exp(-square / 2)
    far = math.exp(-min(square, 1000.0) / 200) / 10.0**m
    state.bank[4, 0] = 0.25
    weigh(state, 4, Observation.of(innovation, jacobian, variance), factor, spread)
    expected = 0.25 * (0.99 * near + 0.01 * far) / math.sqrt(np.linalg.det(whole))
    assert state.bank[4, 0] == pytest.approx(expected, rel=1e-9)


def test_an_observation_that_is_none_weighs_nothing() -> None:
    state = FilterState(1)
    state.bank[0, 0] = 0.25
    for spread, variance in ((np.full((3, 3), math.nan), 1.0), (np.zeros((3, 3)), 0.0), (-np.eye(3), 0.5)):
        weigh(state, 0, Observation.of(np.ones(1), np.ones((1, state.size)), np.array([variance])), 1.0, spread)
        assert state.bank[0, 0] == 0.25


def test_a_bank_without_weight_does_not_settle() -> None:
    state = FilterState(1)
    state.stamps[PHASE] = CHOOSING
    for weight in (0.0, math.nan):
        state.bank[:, 0] = weight
        with np.errstate(invalid="ignore"):
            collapse_if_close(state, make_parameters(config()))
        assert state.stamps[PHASE] == CHOOSING


def test_weights_sum_to_one_and_the_unlikely_go() -> None:
    state = FilterState(1)
    state.bank[0, 0], state.bank[1, 0], state.bank[2, 0] = 3.0, 1.0, 1e-10
    normalise(state)
    assert state.bank[:, 0].sum() == pytest.approx(1.0, abs=1e-9)
    assert np.flatnonzero(state.bank[:, 0]).tolist() == [0, 1]
    assert len(state.bank) == HYPOTHESES
