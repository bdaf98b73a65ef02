"""Noise learnt from data: weights, variances, forgetting, bounds."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.oracles.adaptive import CrossMoments, InnovationNoise, fused, weights


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
        moments.add(math.sin(0.01 * k) + sigmas * rng.standard_normal(3))
    assert moments.variances() == pytest.approx(sigmas**2, rel=0.05)


def test_forgetting_follows_a_sensor_that_gets_worse() -> None:
    rng, moments = np.random.default_rng(8), CrossMoments(2, memory=500, minimum=0.1, maximum=3.0)
    assert moments.variances() == pytest.approx([0.1, 0.1])
    for k in range(8000):
        moments.add(np.array([1.0, 0.5 if k < 4000 else 1.5]) * rng.standard_normal(2))
    assert moments.variances() == pytest.approx([1.0, 2.25], rel=0.25)
    for _ in range(4000):
        moments.add(np.array([1.0, 9.0]) * rng.standard_normal(2))
    assert moments.variances()[1] == 3.0
    with pytest.raises(ValueError, match="two sensors"):
        CrossMoments(1)


@pytest.mark.parametrize("factor", [0.25, 4.0])
def test_noise_of_a_lone_sensor_from_its_innovations(factor: float) -> None:
    """C3: a random walk seen through noise of variance 1, which the filter assumes to be a quarter or four times that
    at first; then it uses what it learns."""
    rng, truth, mean, variance = np.random.default_rng(9), 0.0, 0.0, 1.0
    noise = InnovationNoise(np.array([factor]), np.array([0.01]), np.array([100.0]), memory=4000)
    for _ in range(20_000):
        truth += 0.1 * rng.standard_normal()
        variance += 0.01
        innovation = truth + rng.standard_normal() - mean
        noise.add(np.array([innovation]), np.array([variance]))
        gain = variance / (variance + float(noise.variance()[0]))
        mean, variance = mean + gain * innovation, (1 - gain) * variance
    assert noise.variance()[0] == pytest.approx(1.0, abs=0.08)


def test_learnt_noise_stays_in_its_bounds() -> None:
    noise = InnovationNoise(np.array([1.0, 1.0]), np.array([0.5, 0.5]), np.array([2.0, 2.0]), memory=10)
    for _ in range(100):
        noise.add(np.array([0.0, 50.0]), np.array([0.3, 0.3]))
    assert noise.variance() == pytest.approx([0.5, 2.0])
