"""Learnt noise: weights of redundant sensors, variances from cross-moments, the variance of one sensor from innovations.

Sources: Xu and others, Multi-sensor adaptively weighted data fusion (cross-moments); Mehra, On the identification of
variances and adaptive Kalman filtering (1970), for innovations.
"""

from __future__ import annotations

import math

import numpy as np

from fusiond.maths.typed import Array


def weights(variances: Array) -> Array:
    """Weights (k,) of redundant sensors of `variances` (k,), all > 0: the inverse variances, made to sum to 1. No other
    unbiased weighting has less variance."""
    inverse = 1 / variances
    return np.asarray(inverse / inverse.sum())


def fused(values: Array, variances: Array) -> tuple[float, float]:
    """Weighted mean of redundant readings (k,) and its variance, 1 / sum(1 / s_j^2)."""
    return float(weights(variances) @ values), 1 / float((1 / variances).sum())


class CrossMoments:
    """Each sensor's variance from nothing but the readings of k >= 2 redundant sensors with independent errors: its own
    second moment less the mean of its cross-moments, s_i^2 = R_ii - R_i. The moments are means over all samples, or, with
    `memory` (a number of samples), ones that forget exponentially."""

    def __init__(self, sensors: int, minimum: float = 0.0, maximum: float = math.inf, memory: float = math.inf) -> None:
        """The variances are limited to `minimum` and `maximum`. ValueError for fewer than two sensors."""
        if sensors < 2:
            raise ValueError("cross-moments need two sensors or more")
        self.moments: Array = np.zeros((sensors, sensors))
        self.samples = 0
        self.minimum, self.maximum, self.memory = minimum, maximum, memory

    def add(self, readings: Array) -> None:
        """One reading of each sensor, (k,), of the same instant: R(k) = (k-1)/k R(k-1) + z_i z_j / k."""
        self.samples += 1
        share = max(1 / self.samples, 1 / self.memory)
        self.moments = (1 - share) * self.moments + share * np.outer(readings, readings)

    def variances(self) -> Array:
        """s_i^2 (k,), bounded."""
        own = np.diag(self.moments)
        across = (self.moments.sum(axis=1) - own) / (len(own) - 1)
        return np.asarray(np.clip(own - across, self.minimum, self.maximum))


class InnovationNoise:
    """A lone sensor's variance per axis from its innovations: R = mean(d d') - H P H', bounded, over a memory of `memory`
    samples; the first guess counts as `trust` of them."""

    def __init__(self, first: Array, minimum: Array, maximum: Array, memory: float = 100.0, trust: float = 1.0) -> None:
        """All (m,) variances."""
        self.raw: Array = first.copy()
        self.samples = trust
        self.minimum, self.maximum, self.memory = minimum, maximum, memory

    def add(self, innovation: Array, predicted: Array) -> None:
        """One innovation (m,) and the diagonal (m,) of H P H', the variance that the state gives it by itself. The bounds
        limit the result, not the mean: clipping before averaging would bias it."""
        self.samples += 1
        share = max(1 / self.samples, 1 / self.memory)
        self.raw = self.raw + share * (innovation * innovation - predicted - self.raw)

    def variance(self) -> Array:
        """R (m,), bounded."""
        return np.asarray(np.clip(self.raw, self.minimum, self.maximum))
