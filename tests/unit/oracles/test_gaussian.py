"""The closed forms for Gaussians against what can be computed by hand."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.covariances import random_covariance
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
