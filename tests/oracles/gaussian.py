"""Products of densities: Gaussians, independent or with an error in common, and uniform ones.

Sources: Koch, Tracking and Sensor Data Fusion (2014), chapter 3; Bar-Shalom, Li, Kirubarajan, Estimation with Applications
to Tracking and Navigation (2001), section 3.4.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fusiond.maths.typed import Array


class Gaussian(NamedTuple):
    """A normal density of n numbers."""

    mean: Array  # (n,)
    covariance: Array  # (n, n)


class Interval(NamedTuple):
    """A uniform density of one number."""

    centre: float
    half_width: float


def product_scalar(mean_x: float, variance_x: float, mean_z: float, variance_z: float) -> tuple[float, float]:
    """Mean and variance of the product of two normal densities of a scalar, normalised: the posterior of a prior and one
    measurement. By repetition it is recursive Bayes. The variances must not both be 0."""
    total = variance_x + variance_z
    return (variance_z * mean_x + variance_x * mean_z) / total, variance_x * variance_z / total


def product(x: Gaussian, z: Gaussian) -> Gaussian:
    """Product of two normal densities, normalised, by one inversion: C = Cz (Cx + Cz)^-1 Cx. Raises LinAlgError where
    Cx + Cz is singular."""
    share = np.linalg.solve(x.covariance + z.covariance, np.column_stack([x.covariance, x.mean - z.mean]))
    covariance = z.covariance @ share[:, :-1]
    return Gaussian(z.mean + z.covariance @ share[:, -1], (covariance + covariance.T) / 2)


def shared_covariance(variances: Array, shared_variance: float) -> Array:
    """Covariance (k, k) of k sensors' errors, independent ones of `variances` (k,) and one that all of them share:
    diag(s_i^2) + s_c^2 11'."""
    return np.diag(variances) + shared_variance


def best_mean(values: Array, covariance: Array) -> tuple[float, float]:
    """Best linear unbiased estimate of one number from k readings (k,) with errors of `covariance` (k, k), and its
    variance: 1'R^-1 z / 1'R^-1 1 and 1 / 1'R^-1 1 (Gauss and Markov)."""
    weights = np.linalg.solve(covariance, np.ones(len(values)))
    total = float(weights.sum())
    return float(weights @ values) / total, 1 / total


def quantum_variance(quantum: float) -> float:
    """Variance of rounding to whole multiples of `quantum`: that of a uniform density of this width."""
    return quantum * quantum / 12


def intersection(intervals: list[Interval]) -> Interval | None:
    """Product of uniform densities: the interval that all have in common; None where there is none, so that one of the
    readings lies. ValueError for an empty list."""
    low = max(interval.centre - interval.half_width for interval in intervals)
    high = min(interval.centre + interval.half_width for interval in intervals)
    return Interval((low + high) / 2, (high - low) / 2) if low <= high else None
