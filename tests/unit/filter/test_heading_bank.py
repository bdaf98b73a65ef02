"""The bank of heading hypotheses: it finds the heading from every start, honestly, and both kernels agree on it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from msgspec.structs import replace

from fusiond.config.schema import Config
from fusiond.estimator.fusion import Fusion
from fusiond.estimator.solution import Mode
from fusiond.events import GnssPosition, GnssVelocity, ImuSample, Measurement, WheelSpeed
from fusiond.filter.heading_bank import collapse_if_close, fuse_measurement, normalise, weigh
from fusiond.filter.observations.model import VALUES, Observation
from fusiond.filter.parameters import make_parameters
from fusiond.filter.state import BLOWN, CHOOSING, HYPOTHESES, PHASE, RESETS, RUNNING, VELOCITY, FilterState, T
from fusiond.maths.wgs84 import geodetic, mat_ne
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


ARM = (0.5, 0.0, -0.2)  # m, of the antenna of a robot


def turning(heading: float) -> Drive:
    """A robot that stands for 3 s and then turns on the spot, once around in 8 s."""
    return drive(12.0, lambda t: 0 * t, lambda t: heading + 2 * math.pi * ramp(t, PULLS_AWAY_S, 8.0), rate=50.0)


def robot(sigma: float) -> Config:
    """With a wheel at either side, and a receiver of a sigma [m] that gives no velocity."""
    gnss = {"lever_arm_m": ARM, "position_sigma_m": sigma, "height_sigma_m": sigma, "use_velocity": False}
    whole = config(("left", "right"), gnss=gnss, wheel={"unsigned": False, "least_mps": 0.02})
    sides = {"left": (0.0, -0.3, 0.3), "right": (0.0, 0.3, 0.3)}
    return replace(whole, wheel={name: replace(whole.wheel[name], position_m=side) for name, side in sides.items()})


def on_the_spot(truth: Drive, sigma: float, seed: int) -> list[Measurement]:
    """What such a robot measures."""
    rng, events = np.random.default_rng(seed), []
    for event in measurements(truth, (), seed=seed):
        k = truth.at((event.t_ns - T0) / SECOND)
        if isinstance(event.payload, ImuSample):
            events.append(event)
            for sequence, (name, side) in enumerate((("left", -0.3), ("right", 0.3))):
                speed = -float(truth.rate_b[k][2]) * side
                reading = WheelSpeed(speed + 0.02 * rng.normal() if abs(speed) > 0.02 else 0.0)
                events.append(Measurement(event.t_ns + sequence + 1, name, event.sequence, event.t_receive_ns, reading))
        elif isinstance(event.payload, GnssPosition):
            off = truth.mat_eb[k] @ ARM + rng.normal(0.0, sigma, 3)
            fix = GnssPosition(*geodetic(truth.position_e[k] + off), sigma, sigma)
            events.append(Measurement(event.t_ns, event.source, event.sequence, event.t_receive_ns, fix))
    return events


@needs_compiled
@pytest.mark.parametrize("seed", range(5))
def test_turning_on_the_spot_tells_the_heading_by_an_antenna_off_centre(seed: int) -> None:
    truth = turning(1.0 + seed)
    error, sigma = yaw_error(fuse(robot(0.02), on_the_spot(truth, 0.02, seed), True), truth)
    assert abs(error) < 3 * sigma < math.radians(6.0)


@needs_compiled
def test_a_circle_below_the_noise_tells_nothing() -> None:
    """The antenna goes around half a metre, and fixes are off by 1.5 m: there is no state, rather than a wrong one."""
    fusion = fuse(robot(1.5), on_the_spot(turning(2.0), 1.5, 1), True)
    assert fusion.history.head.stamps[PHASE] == CHOOSING


@needs_compiled
def test_a_quiet_drive_is_no_standstill() -> None:
    """Without a wheel or a velocity a smooth road looks like rest: nothing that holds the vehicle still is to be used."""
    truth = drive(25.0, lambda t: 10.0 + 3.0 * ramp(t, 10.0, 10.0), lambda t: 0.5 + 0.3 * ramp(t, 12.0, 8.0), rate=50.0)
    smooth = [event for event in measurements(truth, (), seed=None) if not isinstance(event.payload, GnssVelocity)]
    fusion = fuse(config(()), smooth, True)
    error, _ = yaw_error(fusion, truth)
    assert abs(error) < math.radians(3.0)
    assert fusion.history.head.stamps[RESETS] == 0


def test_wheels_wait_for_the_velocity(compiled: bool) -> None:
    """At a guess of the velocity a wheel would tell of the heading what nobody knows: it weighs nothing, and changes
    nothing, until fixes have told it."""
    truth = departing(0.3, seconds=5.0)
    events = [event for event in measurements(truth) if not isinstance(event.payload, GnssVelocity | WheelSpeed)]
    fusion = fuse(config(), events, compiled)
    head, params = fusion.history.head, fusion.params
    assert head.stamps[PHASE] == CHOOSING
    source = params.sources.index("rear_left")
    values, parameter = np.array([4.0, 0.05**2, *[0.0] * (VALUES - 2)]), params.model_parameters[source]
    before = head.bank.copy()
    fuse_measurement(head, 0, params.models[source], values, parameter, 1.0, params)
    np.testing.assert_array_equal(head.bank, before)
    for i in range(HYPOTHESES):
        head.hypothesis(i).covariance[VELOCITY, :] = 0.0
        head.hypothesis(i).covariance[:, VELOCITY] = 0.0
    fuse_measurement(head, 0, params.models[source], values, parameter, 1.0, params)
    assert head.bank[0, 0] < before[0, 0]


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
