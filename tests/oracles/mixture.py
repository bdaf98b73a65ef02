"""Gaussian mixtures: moments, the estimates of three loss functions, pruning and merging, the update among clutter.

Sources: Bar-Shalom, Li, Kirubarajan (2001), sections 1.4.16 and 11.6; Koch (2014), section 4.3; Runnalls, Kullback-Leibler
approach to Gaussian mixture reduction (2007); Carreira-Perpinan, Mode-finding for mixtures of Gaussians (2000).
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np

from fusiond.maths.typed import Array
from tests.oracles.gaussian import Gaussian

Loss = Literal["squared", "absolute", "zero-one"]
BISECTIONS = 80  # of the median: to the last bit
MODE_STEPS = 1000  # at most, of the search for a maximum
MODE_MOVED = 1e-10  # of a sigma: a smaller step ends the search


class Mixture(NamedTuple):
    """k weighted normal densities of n numbers; the weights sum to 1."""

    weights: Array  # (k,)
    means: Array  # (k, n)
    covariances: Array  # (k, n, n)


def collapse(mixture: Mixture) -> Gaussian:
    """The normal density with the mixture's own mean and covariance: the spread of the means adds to the covariances."""
    mean = mixture.weights @ mixture.means
    off = mixture.means - mean
    within = np.einsum("k,kij->ij", mixture.weights, mixture.covariances)
    return Gaussian(mean, within + np.einsum("k,ki,kj->ij", mixture.weights, off, off))


def estimate(mixture: Mixture, loss: Loss) -> Array:
    """The estimate (n,) of least expected loss: the mean for squared loss, the median of each number for absolute loss, the
    highest point of the density for 0-1 loss."""
    if loss == "squared":
        return collapse(mixture).mean
    if loss == "absolute":
        return np.array([_median(mixture, axis) for axis in range(mixture.means.shape[1])])
    return _mode(mixture)


def _median(mixture: Mixture, axis: int) -> float:
    """Where the distribution function of one number passes 1/2, by bisection."""
    means, sigmas = mixture.means[:, axis], np.sqrt(mixture.covariances[:, axis, axis])
    low, high = float(means.min()), float(means.max())
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        below = [math.erf((middle - m) / (s * math.sqrt(2))) for m, s in zip(means, sigmas, strict=True)]
        low, high = (middle, high) if mixture.weights @ np.array(below) < 0 else (low, middle)
    return (low + high) / 2


def log_densities(mixture: Mixture, x: Array) -> Array:
    """Logarithm (k,) of each weighted component's density at x (n,); -inf where its weight is 0."""
    found = np.full(len(mixture.weights), -math.inf)
    for i, (weight, mean, covariance) in enumerate(zip(*mixture, strict=True)):
        if weight > 0:
            found[i] = math.log(weight) + log_normal(x - mean, covariance)
    return found


def log_normal(off: Array, covariance: Array) -> float:
    """Logarithm of the normal density, `off` (n,) from its mean. Raises LinAlgError where it is singular."""
    lower = np.linalg.cholesky(covariance)
    white = np.linalg.solve(lower, off)
    return -float(white @ white) / 2 - float(np.log(np.diag(lower)).sum()) - len(off) / 2 * math.log(2 * math.pi)


def _mode(mixture: Mixture) -> Array:
    """The highest of the maxima that are found uphill from the components' means. Each step sets the gradient to nothing
    for the shares that the components have at the present point, so the density never falls."""
    precisions = np.linalg.inv(mixture.covariances)
    best: Array = mixture.means[0]
    highest = -math.inf
    for start in mixture.means:
        x = start
        for _ in range(MODE_STEPS):
            shares = normalised(log_densities(mixture, x))
            total = np.einsum("k,kij->ij", shares, precisions)
            pulled = np.einsum("k,kij,kj->i", shares, precisions, mixture.means)
            after = np.asarray(np.linalg.solve(total, pulled), np.float64)
            step = after - x
            x = after
            if float(step @ total @ step) < MODE_MOVED * MODE_MOVED:
                break
        height = float(np.logaddexp.reduce(log_densities(mixture, x)))
        if height > highest:
            best, highest = x, height
    return best


def normalised(logs: Array) -> Array:
    """Weights (k,) that sum to 1, of logarithms (k,) that share an unknown constant. ValueError where all are -inf."""
    most = float(logs.max())
    if not math.isfinite(most):
        raise ValueError("no hypothesis is left")
    weights = np.exp(logs - most)
    return np.asarray(weights / weights.sum())


def reduced(mixture: Mixture, most: int, least: float = 0.0) -> Mixture:
    """A mixture of at most `most` components with the same mean, but for what pruning takes: components lighter than
    `least` are dropped (never the heaviest), then those two merged by their moments that cost the least (Runnalls),
    again and again."""
    keep = (mixture.weights >= least) | (np.arange(len(mixture.weights)) == int(np.argmax(mixture.weights)))
    weights, means, covariances = (part[keep] for part in mixture)
    reduced_to = Mixture(weights / weights.sum(), means, covariances)
    while len(reduced_to.weights) > max(1, most):
        reduced_to = _merge_cheapest(reduced_to)
    return reduced_to


def _merge_cheapest(mixture: Mixture) -> Mixture:
    """Replace the two components whose merging loses least by one with their weight and moments."""
    count = len(mixture.weights)
    log_dets = np.linalg.slogdet(mixture.covariances)[1]
    best, cheapest = (0, 1), math.inf
    for i in range(count):
        for j in range(i + 1, count):
            weight, merged = _merged(mixture, [i, j])
            own = mixture.weights[i] * log_dets[i] + mixture.weights[j] * log_dets[j]
            cost = float(weight * np.linalg.slogdet(merged.covariance)[1] - own) / 2
            if cost < cheapest:
                best, cheapest = (i, j), cost
    weight, merged = _merged(mixture, list(best))
    rest = [k for k in range(count) if k not in best]
    return Mixture(
        np.append(mixture.weights[rest], weight),
        np.concatenate([mixture.means[rest], merged.mean[None]]),
        np.concatenate([mixture.covariances[rest], merged.covariance[None]]),
    )


def _merged(mixture: Mixture, pair: list[int]) -> tuple[float, Gaussian]:
    weight = float(mixture.weights[pair].sum())
    shares = mixture.weights[pair] / weight if weight > 0 else np.full(2, 0.5)
    return weight, collapse(Mixture(shares, mixture.means[pair], mixture.covariances[pair]))


def target_probability(innovation: Array, spread: Array, detection: float, clutter: float) -> float:
    """Probability that a measurement is the target's and not clutter: the weights are P_D N(d; 0, S) and (1 - P_D) rho,
    with d (m,) the innovation, S (m, m) its covariance, `detection` P_D, `clutter` rho the density of false returns, in
    the innovation's units to the power -m. ValueError unless 0 <= P_D <= 1 and rho >= 0."""
    if not (0 <= detection <= 1 and clutter >= 0):
        raise ValueError(f"detection {detection} must lie in [0, 1], clutter {clutter} must not be negative")
    target = detection * math.exp(log_normal(innovation, spread))
    false = (1 - detection) * clutter
    return target / (target + false) if target + false > 0 else 0.0


def clutter_update(
    prior: Gaussian, measured: tuple[Array, Array, Array], detection: float, clutter: float
) -> tuple[Gaussian, float]:
    """The update with a measurement that may be false: the mixture of the prior and of the Kalman update, collapsed by its
    moments, and the probability that the measurement was the target's.

    `measured` is the innovation (m,), its Jacobian (m, n) and the measurement's covariance (m, m).
    """
    innovation, jacobian, noise = measured
    across = prior.covariance @ jacobian.T
    spread = jacobian @ across + noise
    gain = np.linalg.solve(spread, across.T).T
    keep = np.eye(len(prior.mean)) - gain @ jacobian
    covariance = keep @ prior.covariance @ keep.T + gain @ noise @ gain.T
    sure = target_probability(innovation, spread, detection, clutter)
    both = Mixture(
        np.array([1 - sure, sure]),
        np.array([prior.mean, prior.mean + gain @ innovation]),
        np.array([prior.covariance, covariance]),
    )
    return collapse(both), sure
