"""A scenario across modules: the filter's decisions (source health, heading bank, clutter) and mixtures against the closed
forms of tests.oracles, which know nothing of the filter."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.config.schema import Wheel
from fusiond.events import WheelSpeed
from fusiond.filter import heading_bank as bank
from fusiond.filter import source_health as health
from fusiond.filter.measurement_update import CLUTTER_FIELD, detection, difference, inject, update
from fusiond.filter.observations import wheel_speed
from fusiond.filter.observations.model import SHARED, Observation
from fusiond.filter.parameters import make_parameters
from fusiond.filter.state import (
    ATTITUDE,
    BELIEF,
    CHOOSING,
    INTERVAL,
    MEMORY_SIZE,
    NEVER,
    PHASE,
    RUNNING,
    SOURCE_STAMPS_SIZE,
    T_LAST,
    FilterState,
)
from fusiond.maths.typed import Array
from tests.helpers.streams import SECOND, T0, config, running_state
from tests.oracles.adaptive import fused
from tests.oracles.decision import missed, posterior
from tests.oracles.gaussian import Gaussian, best_mean, quantum_variance, shared_covariance
from tests.oracles.mixture import Mixture, clutter_update, collapse


def test_health_is_bayes_rule_after_a_prior_that_time_has_blurred() -> None:
    """D1: ten looks at a source on two axes that is off by more and more; likelihoods as in THEORY D1, a bias followed by a
    scalar Kalman filter an axis and forgotten where a new one explains the innovation better."""
    memory, stamps = np.zeros(MEMORY_SIZE), np.full(SOURCE_STAMPS_SIZE, NEVER)
    health.begin(memory)
    held, bias, spread = np.array(health.PRIOR), np.zeros(2), health.FIRST_BIAS_VARIANCE

    def density(off: Array, variance: float) -> float:
        return math.exp(-float(off @ off) / (2 * variance)) / variance  # of two axes, but for 2 pi

    for number in range(10):
        whitened = np.array([0.4 * number, -0.1])
        if density(whitened, 1 + health.FIRST_BIAS_VARIANCE) > density(whitened - bias, 1 + spread):
            bias, spread = np.zeros(2), health.FIRST_BIAS_VARIANCE
        size = float(np.linalg.norm(bias))
        called = bias * (health.MIN_BIAS / size) if spread < 1 and 1e-9 < size < health.MIN_BIAS else bias
        models = density(whitened, 1.0), density(whitened, health.NOISY_VARIANCE), density(whitened - called, 1 + spread)
        outlier = density(whitened, health.OUTLIER_VARIANCE)
        likelihoods = [(1 - health.OUTLIERS) * model + health.OUTLIERS * outlier for model in models]
        likelihoods.append(outlier * health.OTHER_IF_FROZEN)
        gain = (spread + health.BIAS_WALK) / (spread + health.BIAS_WALK + 1)
        bias, spread = bias + gain * (whitened - bias), (1 - gain) * (spread + health.BIAS_WALK)
        blurred = 1 - math.exp(-(health.MEAN_STATUS_TIME if number == 0 else 0.2) / health.MEAN_STATUS_TIME)
        held = posterior(held + blurred * (np.array(health.PRIOR) - held), np.array(likelihoods))
        health.judge(memory, stamps, whitened, 2, False, T0 + number * SECOND // 5)
        np.testing.assert_allclose(memory[BELIEF], held, rtol=1e-12)
    assert memory[BELIEF].argmax() != 0


def test_silence_is_evidence_of_absence() -> None:
    """D2: each expected reading that does not come."""
    memory, stamps = np.zeros(MEMORY_SIZE), np.full(SOURCE_STAMPS_SIZE, T0)
    memory[INTERVAL] = 0.1
    held = np.array([1 - health.ABSENT, health.ABSENT])
    for misses in range(1, 6):
        held = missed(held, np.array([health.DETECTION, 0.0]))
        stamps[T_LAST] = T0
        found = health.belief(memory, stamps, T0 + misses * SECOND // 10 + 1000, T0)
        assert found.probabilities[-1] == pytest.approx(held[1], rel=1e-9)


def test_a_collapsed_bank_has_the_moments_of_its_mixture() -> None:
    """B6, in the error space about the likeliest hypothesis."""
    rng, settings = np.random.default_rng(4), make_parameters(config())
    state = running_state(rng)
    state.stamps[PHASE] = CHOOSING
    errors = rng.normal(0.0, 1e-3, (3, state.size))
    errors[0] = 0.0
    shares = np.array([0.6, 0.3, 0.1])
    spreads = []
    for i, error in enumerate(errors):
        hypothesis = state.hypothesis(i)
        hypothesis.nominal[:], hypothesis.covariance[:] = state.nominal, 1e-6 * state.covariance * (1 + i)
        inject(hypothesis, error)
        state.bank[i, 0] = shares[i]
        spreads.append(hypothesis.covariance.copy())
    begin = state.copy()
    bank.collapse_if_close(state, settings)
    assert state.stamps[PHASE] == RUNNING
    reference = collapse(Mixture(shares, errors, np.array(spreads)))
    np.testing.assert_allclose(difference(state, begin), reference.mean, atol=1e-8)
    np.testing.assert_allclose(state.covariance, reference.covariance, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("metres", [0.5, 6.0, 9.0, 12.0])
def test_a_fix_that_may_be_clutter(metres: float) -> None:
    """D3: the mixture of the state without the fix and with it. The attitude is certain, so that nothing turns along."""
    state = FilterState(1)
    state.covariance[:] = np.diag(np.linspace(1.0, 4.0, state.size))
    state.covariance[ATTITUDE] = 0.0
    jacobian = np.eye(3, state.size)
    innovation, variance, share = np.array([metres, 0.3, -0.2]), np.full(3, 2.0), 0.05
    spread = jacobian @ state.covariance @ jacobian.T + np.diag(variance)
    distance = float(innovation @ np.linalg.solve(spread, innovation))
    clutter = 1 / (CLUTTER_FIELD**3 * math.sqrt(np.linalg.det(spread)))  # uniform over a field of 100 sigmas an axis
    prior = Gaussian(np.zeros(state.size), state.covariance.copy())
    reference, probability = clutter_update(prior, (innovation, jacobian, np.diag(variance)), 1 - share, clutter)
    assert detection(distance, 3, share) == pytest.approx(probability, rel=1e-9)
    before = state.copy()
    update(state, Observation.of(innovation, jacobian, variance), 16.0, clutter=share)
    np.testing.assert_allclose(state.nominal[:6] - before.nominal[:6], reference.mean[:6], atol=1e-9)
    np.testing.assert_allclose(state.covariance, reference.covariance, atol=1e-9)


def test_wheels_that_share_an_error_are_worth_what_gauss_and_markov_allow() -> None:
    """A5: fused one by one, with variances grown for it, they are worth the best mean of all."""
    wheel = {"group": "axles", "shared_sigma_mps": 0.08, "sigma_mps": 0.1}
    settings = make_parameters(config(wheel=wheel))
    grown = [0.1**2 * settings.model_parameters[i, SHARED] for i in settings.wheels]
    assert len(grown) > 1
    alone = fused(np.zeros(len(grown)), np.array(grown))[1]
    covariance = shared_covariance(np.full(len(grown), 0.1**2), 0.08**2)
    assert alone == pytest.approx(best_mean(np.zeros(len(grown)), covariance)[1])


def test_redundant_wheels_are_weighted_by_their_variances() -> None:
    """C2: four readings of one speed, by the filter and by the formula."""
    state = FilterState(1)
    state.covariance[:] = 1e6 * np.eye(state.size)
    variances, values = np.array([0.01, 0.04, 0.09, 0.25]), np.array([1.0, 1.2, 0.7, 2.0])
    jacobian = np.zeros((1, state.size))
    jacobian[0, 3] = 1.0
    for value, variance in zip(values, variances, strict=True):
        update(state, Observation.of(np.array([value - state.nominal[3]]), jacobian, np.array([variance])), 1e9)
    mean, variance = fused(values, variances)
    assert state.nominal[3] == pytest.approx(mean, rel=1e-6)
    assert state.covariance[3, 3] == pytest.approx(variance, rel=1e-6)


def test_a_quantised_wheel_has_the_variance_of_rounding() -> None:
    """A6: what the filter is told of a wheel that rounds, against 60,000 rounded speeds."""
    rng, quantum = np.random.default_rng(6), 0.0625
    told = wheel_speed.values(WheelSpeed(10.0), Wheel(sigma_mps=1e-9, quantum_mps=quantum))[1]
    assert told == pytest.approx(quantum_variance(quantum))
    speeds = rng.uniform(0.0, 30.0, 60_000)
    assert np.var(np.round(speeds / quantum) * quantum - speeds) == pytest.approx(told, rel=0.02)
