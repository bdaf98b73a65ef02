"""Running statistics against NumPy's."""

from __future__ import annotations

import numpy as np
import pytest

from fusiond.app.replay.statistics import Histogram, Mean


def test_histogram_quantiles_are_numpys_within_half_a_bin() -> None:
    values = np.random.default_rng(1).normal(2.0, 1.0, 5000)
    histogram = Histogram(0.01, 10.0)
    for value in values:
        histogram.add(float(value))
    for share in (0.01, 0.5, 0.95):
        expected = np.quantile(values, share, method="inverted_cdf")
        assert histogram.quantile(share) == pytest.approx(expected, abs=0.0051)
    distances = np.quantile(np.abs(values - 2.0), 0.95, method="inverted_cdf")
    assert histogram.quantile_of_distance(0.95, 2.0) == pytest.approx(distances, abs=0.0101)


def test_histogram_is_bounded_and_exact_at_its_ends() -> None:
    histogram = Histogram(1.0, 10.0)
    for value in (-1e9, 0.25, 1e9):
        histogram.add(value)
    assert (histogram.minimum, histogram.maximum, histogram.count) == (-1e9, 1e9, 3)
    assert histogram.quantile(1.0) == pytest.approx(1e9, rel=0.005)
    assert histogram.quantile(0.1) == pytest.approx(-1e9, rel=0.005)
    with pytest.raises(ValueError, match="no value"):
        Histogram(1.0, 10.0).quantile(0.5)


def test_quantiles_do_not_saturate_at_the_limit() -> None:
    """A replay that is kilometres off says by how many."""
    histogram, values = Histogram(1e-3, 1000.0), np.random.default_rng(3).uniform(-90_000.0, 300_000.0, 5000)
    for value in values:
        histogram.add(float(value))
    for share in (0.05, 0.5, 0.95):
        expected = np.quantile(values, share, method="inverted_cdf")
        assert histogram.quantile(share) == pytest.approx(expected, rel=0.006)


def test_the_limit_itself() -> None:
    for value in (-10.0, 10.0, 9.999, -9.999):
        histogram = Histogram(1.0, 10.0)
        histogram.add(value)
        assert histogram.quantile(0.5) == pytest.approx(value)


def test_mean_and_variance_are_numpys() -> None:
    values, mean = np.random.default_rng(2).normal(3.0, 0.5, 1000), Mean()
    for value in values.tolist():
        mean.add(value)
    assert mean.count == 1000
    assert (mean.value, mean.square) == pytest.approx((values.mean(), np.mean(values**2)))
    assert mean.variance == pytest.approx(values.var())
