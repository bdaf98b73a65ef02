"""The closed forms of tests.oracles against what can be computed by hand or by quadrature."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.oracles.adaptive import CrossMoments, InnovationNoise, fused, weights
from tests.oracles.decision import carried, missed, posterior, staying
from tests.oracles.gaussian import (
    Gaussian,
    Interval,
    best_mean,
    intersection,
    product,
    product_scalar,
    quantum_variance,
    shared_covariance,
)
from tests.oracles.mixture import (
    Mixture,
    clutter_update,
    collapse,
    estimate,
    log_densities,
    normalised,
    reduced,
    target_probability,
)

TWO = Mixture(np.array([0.3, 0.7]), np.array([[-2.0], [3.0]]), np.array([[[0.25]], [[4.0]]]))


def random_covariance(rng: np.random.Generator, n: int) -> np.ndarray:
    root = rng.standard_normal((n, n))
    return root @ root.T + 0.1 * np.eye(n)


def quadrature(mixture: Mixture) -> tuple[np.ndarray, np.ndarray]:
    """Points and probabilities of a mixture of scalars."""
    x = np.linspace(-15, 20, 350_001)
    sigmas = np.sqrt(mixture.covariances[:, 0, 0])
    columns = (mixture.weights, mixture.means[:, 0], sigmas)
    parts = [w * np.exp(-(((x - m) / s) ** 2) / 2) / s for w, m, s in zip(*columns, strict=True)]
    density = np.sum(parts, axis=0) / math.sqrt(2 * math.pi)
    return x, density * (x[1] - x[0])


# --- A: Gaussians


def test_recursive_bayes_averages_equal_measurements() -> None:
    """A1: after 20 measurements of variance s^2 the variance is s^2 / 20, the mean theirs."""
    readings = np.random.default_rng(1).normal(5.0, 2.0, 20)
    mean, variance = float(readings[0]), 4.0
    for reading in readings[1:]:
        mean, variance = product_scalar(mean, variance, float(reading), 4.0)
    assert variance == pytest.approx(4.0 / 20, rel=1e-13)
    assert mean == pytest.approx(readings.mean(), rel=1e-13)


def test_product_of_two_scalars() -> None:
    """A2."""
    assert product_scalar(0.0, 1.0, 1.0, 4.0) == pytest.approx((0.2, 0.8), rel=1e-15)


def test_product_of_two_vectors() -> None:
    """A3: as by three inversions, and sharper than either; A4: the order does not matter."""
    rng = np.random.default_rng(2)
    parts = [Gaussian(rng.standard_normal(3), random_covariance(rng, 3)) for _ in range(3)]
    x, z, y = parts
    found = product(x, z)
    expected = np.linalg.inv(np.linalg.inv(x.covariance) + np.linalg.inv(z.covariance))
    assert found.covariance == pytest.approx(expected, abs=1e-12)
    information = np.linalg.solve(x.covariance, x.mean) + np.linalg.solve(z.covariance, z.mean)
    assert found.mean == pytest.approx(expected @ information, abs=1e-12)
    assert np.linalg.det(found.covariance) < min(np.linalg.det(x.covariance), np.linalg.det(z.covariance))
    one, other = product(product(x, y), z), product(product(z, x), y)
    assert one.mean == pytest.approx(other.mean, abs=1e-12)
    assert one.covariance == pytest.approx(other.covariance, abs=1e-12)


def test_a_product_keeps_what_one_side_knows_exactly() -> None:
    """One inversion, of the sum, works where a covariance is singular."""
    found = product(Gaussian(np.array([1.0, 0.0]), np.diag([0.0, 1.0])), Gaussian(np.array([5.0, 3.0]), np.diag([1.0, 2.0])))
    assert found.mean == pytest.approx([1.0, 1.0])
    assert found.covariance == pytest.approx(np.diag([0.0, 2 / 3]))


def test_a_shared_error_bounds_what_fusion_can_reach() -> None:
    """A5: with a known common offset the readings average to nothing; with an unknown one no number of sensors gets below
    its variance."""
    values = np.array([0.55, 0.45]) - 0.5
    assert best_mean(values, shared_covariance(np.full(2, 0.01), 0.0))[0] == pytest.approx(0.0, abs=1e-15)
    for count in (1, 2, 10, 100):
        _, variance = best_mean(np.ones(count), shared_covariance(np.full(count, 0.3), 0.2))
        assert variance == pytest.approx(0.2 + 0.3 / count, rel=1e-12)
    unequal = shared_covariance(np.array([0.1, 0.4]), 0.2)
    mean, variance = best_mean(np.array([1.0, 2.0]), unequal)
    assert (mean, variance) == pytest.approx((1.2, 0.28), rel=1e-12)


def test_bounded_errors_intersect() -> None:
    """A6."""
    found = intersection([Interval(2.0, 0.8), Interval(2.9, 0.5)])
    assert found == pytest.approx((2.6, 0.2))
    assert intersection([Interval(2.0, 0.8), Interval(3.3, 0.5)]) == pytest.approx((2.8, 0.0), abs=1e-12)
    assert intersection([Interval(2.0, 0.8), Interval(3.3001, 0.5)]) is None


def test_variance_of_rounding() -> None:
    """A6: that of the rounding errors of readings spread over many steps."""
    truth = np.linspace(0, 1000, 1_000_003)
    assert np.var(np.rint(truth / 0.28) * 0.28 - truth) == pytest.approx(quantum_variance(0.28), rel=1e-3)


# --- A7, B6, D3, D4: mixtures


def test_three_losses_give_three_estimates() -> None:
    """A7, against quadrature."""
    x, probability = quadrature(TWO)
    assert estimate(TWO, "squared")[0] == pytest.approx(probability @ x, abs=1e-6)
    median = np.interp(0.5, np.cumsum(probability) - probability / 2, x)
    assert estimate(TWO, "absolute")[0] == pytest.approx(median, abs=1e-5)
    assert estimate(TWO, "zero-one")[0] == pytest.approx(x[np.argmax(probability)], abs=1e-4)
    assert len({round(float(estimate(TWO, loss)[0]), 1) for loss in ("squared", "absolute", "zero-one")}) == 3


def test_the_mode_of_a_vector_mixture_is_a_maximum() -> None:
    rng = np.random.default_rng(3)
    mixture = Mixture(
        np.array([0.5, 0.3, 0.2]), rng.normal(0, 3, (3, 2)), np.array([random_covariance(rng, 2) for _ in range(3)])
    )
    mode = estimate(mixture, "zero-one")
    top = np.logaddexp.reduce(log_densities(mixture, mode))
    around = [mode + 1e-3 * np.array([math.cos(a), math.sin(a)]) for a in np.linspace(0, 6, 12)]
    assert all(np.logaddexp.reduce(log_densities(mixture, point)) < top for point in [*around, *mixture.means])


def test_collapse_keeps_the_moments() -> None:
    """B6, against quadrature, and in two dimensions by hand."""
    x, probability = quadrature(TWO)
    mean = probability @ x
    found = collapse(TWO)
    assert found.mean[0] == pytest.approx(mean, abs=1e-6)
    assert found.covariance[0, 0] == pytest.approx(probability @ (x - mean) ** 2, abs=1e-5)
    apart = Mixture(np.array([0.5, 0.5]), np.array([[1.0, 2.0], [-1.0, -2.0]]), np.array([np.eye(2), np.eye(2)]))
    assert collapse(apart).covariance == pytest.approx(np.array([[2.0, 2.0], [2.0, 5.0]]))


def test_reduction_bounds_the_components_and_keeps_the_moments() -> None:
    """D4: merging alone leaves mean and covariance of the whole as they were; the near pair goes first."""
    rng = np.random.default_rng(4)
    raw = rng.uniform(0.1, 1.0, 8)
    means = rng.normal(0, 5, (8, 2))
    means[5] = means[2] + 0.01
    covariances = np.array([random_covariance(rng, 2) for _ in range(8)])
    covariances[5] = covariances[2]
    mixture = Mixture(raw / raw.sum(), means, covariances)
    seven, three = reduced(mixture, 7), reduced(mixture, 3)
    assert seven.weights[-1] == pytest.approx(mixture.weights[2] + mixture.weights[5])
    for found, count in ((seven, 7), (three, 3), (reduced(mixture, 1), 1)):
        assert len(found.weights) == count
        assert found.weights.sum() == pytest.approx(1.0, abs=1e-14)
        assert collapse(found).mean == pytest.approx(collapse(mixture).mean, abs=1e-12)
        assert collapse(found).covariance == pytest.approx(collapse(mixture).covariance, abs=1e-12)


def test_pruning_drops_the_light_and_never_the_heaviest() -> None:
    mixture = Mixture(np.array([0.001, 0.6, 0.399]), np.zeros((3, 1)), np.ones((3, 1, 1)))
    assert reduced(mixture, 5, least=0.01).weights == pytest.approx([0.6 / 0.999, 0.399 / 0.999])
    assert reduced(mixture, 5, least=0.9).weights == pytest.approx([1.0])


def test_weights_of_a_measurement_among_clutter() -> None:
    """D3, by hand: d = 1, S = 4, P_D = 0.9, rho = 0.05."""
    target = 0.9 * math.exp(-0.125) / math.sqrt(8 * math.pi)
    expected = target / (target + 0.1 * 0.05)
    assert target_probability(np.array([1.0]), np.array([[4.0]]), 0.9, 0.05) == pytest.approx(expected, rel=1e-14)
    with pytest.raises(ValueError, match="detection"):
        target_probability(np.array([1.0]), np.array([[4.0]]), 1.1, 0.05)


def test_the_clutter_update_is_the_mixture_of_prior_and_kalman_update() -> None:
    """D3: the Kalman update at P_D = 1 and rho = 0, the prediction for a far outlier, the mixture's moments between."""
    rng = np.random.default_rng(5)
    prior = Gaussian(rng.standard_normal(3), random_covariance(rng, 3))
    jacobian, noise = rng.standard_normal((2, 3)), np.diag([0.5, 0.8])
    innovation = np.array([0.7, -0.4])
    spread = jacobian @ prior.covariance @ jacobian.T + noise
    gain = prior.covariance @ jacobian.T @ np.linalg.inv(spread)
    kalman = Gaussian(prior.mean + gain @ innovation, prior.covariance - gain @ spread @ gain.T)
    found, sure = clutter_update(prior, (innovation, jacobian, noise), 1.0, 0.0)
    assert sure == 1.0
    assert found.mean == pytest.approx(kalman.mean, abs=1e-12)
    assert found.covariance == pytest.approx(kalman.covariance, abs=1e-12)
    far, sure = clutter_update(prior, (1e4 * innovation, jacobian, noise), 0.9, 1e-6)
    assert sure < 1e-12
    assert far.mean == pytest.approx(prior.mean, abs=1e-6)
    between, sure = clutter_update(prior, (innovation, jacobian, noise), 0.5, 0.02)
    assert 0.05 < sure < 0.95
    both = Mixture(np.array([1 - sure, sure]), np.array([prior.mean, kalman.mean]), np.array([prior[1], kalman[1]]))
    assert between.covariance == pytest.approx(collapse(both).covariance, abs=1e-12)


def test_likelihoods_beyond_the_range_of_numbers_still_compare() -> None:
    assert normalised(np.array([-2000.0, -2000.0 + math.log(3)])) == pytest.approx([0.25, 0.75])
    with pytest.raises(ValueError, match="no hypothesis"):
        normalised(np.array([-math.inf, -math.inf]))


# --- C: noise that is learnt


def test_weights_are_the_best_there_are() -> None:
    """C1: they sum to 1, and no other unbiased weighting has less variance."""
    variances, rng = np.array([0.5, 2.0, 1.0]), np.random.default_rng(6)
    best = weights(variances)
    assert best.sum() == pytest.approx(1.0, abs=1e-15)
    value, variance = fused(np.array([1.0, 2.0, 3.0]), variances)
    assert variance == pytest.approx(best @ (variances * best), rel=1e-14)
    assert (value, variance) == pytest.approx((6.0 / 3.5, 1 / 3.5))
    for other in rng.dirichlet([1, 1, 1], 200):
        assert other @ (variances * other) >= variance


def test_each_variance_is_found_from_the_data_alone() -> None:
    """C2: three sensors of a truth that varies, 20,000 samples, each within 5 %."""
    rng, sigmas = np.random.default_rng(7), np.array([0.5, 1.0, 2.0])
    moments = CrossMoments(3)
    for k in range(20_000):
        moments.take(math.sin(0.01 * k) + sigmas * rng.standard_normal(3))
    assert moments.variances() == pytest.approx(sigmas**2, rel=0.05)


def test_forgetting_follows_a_sensor_that_gets_worse() -> None:
    rng, moments = np.random.default_rng(8), CrossMoments(2, memory=500, least=0.1, most=3.0)
    assert moments.variances() == pytest.approx([0.1, 0.1])
    for k in range(8000):
        moments.take(np.array([1.0, 0.5 if k < 4000 else 1.5]) * rng.standard_normal(2))
    assert moments.variances() == pytest.approx([1.0, 2.25], rel=0.25)
    for _ in range(4000):
        moments.take(np.array([1.0, 9.0]) * rng.standard_normal(2))
    assert moments.variances()[1] == 3.0
    with pytest.raises(ValueError, match="two sensors"):
        CrossMoments(1)


@pytest.mark.parametrize("factor", [0.25, 4.0])
def test_noise_of_a_lone_sensor_from_its_innovations(factor: float) -> None:
    """C3: a random walk seen through noise of variance 1, the filter told a quarter or four times that; the filter uses
    what it learns."""
    rng, truth, mean, variance = np.random.default_rng(9), 0.0, 0.0, 1.0
    noise = InnovationNoise(np.array([factor]), np.array([0.01]), np.array([100.0]), memory=4000)
    for _ in range(20_000):
        truth += 0.1 * rng.standard_normal()
        variance += 0.01
        innovation = truth + rng.standard_normal() - mean
        noise.take(np.array([innovation]), np.array([variance]))
        gain = variance / (variance + float(noise.variance()[0]))
        mean, variance = mean + gain * innovation, (1 - gain) * variance
    assert noise.variance()[0] == pytest.approx(1.0, abs=0.08)


def test_learnt_noise_stays_in_its_bounds() -> None:
    noise = InnovationNoise(np.array([1.0, 1.0]), np.array([0.5, 0.5]), np.array([2.0, 2.0]), memory=10)
    for _ in range(100):
        noise.take(np.array([0.0, 50.0]), np.array([0.3, 0.3]))
    assert noise.variance() == pytest.approx([0.5, 2.0])


# --- D: decisions


def test_three_hypotheses_and_three_observations_by_hand() -> None:
    """D1: (1/2, 3/10, 1/5) with likelihoods (1/10, 1/2, 1/5), (1/4, 1/2, 1), (1/2, 1/5, 1/10):
    1/160, 3/200, 1/250, so 25, 60, 16 of 101."""
    prior = np.array([0.5, 0.3, 0.2])
    seen = np.array([[0.1, 0.5, 0.2], [0.25, 0.5, 1.0], [0.5, 0.2, 0.1]])
    assert posterior(prior, seen) == pytest.approx(np.array([25, 60, 16]) / 101, rel=1e-14)
    one_by_one = prior
    for likelihood in seen[::-1]:
        one_by_one = posterior(one_by_one, likelihood)
    assert one_by_one == pytest.approx(posterior(prior, seen), rel=1e-13)
    with pytest.raises(ValueError, match="no hypothesis"):
        posterior(np.array([1.0, 0.0]), np.array([0.0, 1.0]))


def test_a_missing_observation_is_evidence() -> None:
    """D2: alive gives it 9 times of 10, dead never; one miss makes 0.99 to 0.01 into 0.099 to 0.01."""
    after = missed(np.array([0.99, 0.01]), np.array([0.9, 0.0]))
    assert after == pytest.approx(np.array([0.099, 0.01]) / 0.109, rel=1e-13)
    assert missed(np.array([0.3, 0.7]), np.array([0.5, 0.5])) == pytest.approx([0.3, 0.7], abs=1e-15)


def test_a_hypothesis_that_may_come_back_stays_alive() -> None:
    change = staying(3, 0.02)
    assert change.sum(axis=1) == pytest.approx(np.ones(3))
    assert carried(np.array([1.0, 0.0, 0.0]), change) == pytest.approx([0.98, 0.01, 0.01])
    assert carried(np.full(3, 1 / 3), change) == pytest.approx(np.full(3, 1 / 3))
    with pytest.raises(ValueError, match="leave"):
        staying(3, 1.5)
