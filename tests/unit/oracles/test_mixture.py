"""The closed forms for mixtures against quadrature and what can be computed by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.helpers.covariances import random_covariance
from tests.oracles.gaussian import Gaussian
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


def quadrature(mixture: Mixture) -> tuple[np.ndarray, np.ndarray]:
    """Points and probabilities of a mixture of scalars."""
    x = np.linspace(-15, 20, 350_001)
    sigmas = np.sqrt(mixture.covariances[:, 0, 0])
    columns = (mixture.weights, mixture.means[:, 0], sigmas)
    parts = [w * np.exp(-(((x - m) / s) ** 2) / 2) / s for w, m, s in zip(*columns, strict=True)]
    density = np.sum(parts, axis=0) / math.sqrt(2 * math.pi)
    return x, density * (x[1] - x[0])


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
