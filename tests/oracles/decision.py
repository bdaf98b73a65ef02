"""Decisions between m hypotheses by recursive Bayes, evidence that is missing included.

Sources: Koch (2014), sections 2.3 and 4.3; Bar-Shalom, Li, Kirubarajan (2001), section 11.6.2.
"""

from __future__ import annotations

import numpy as np

from fusiond.maths.typed import Array


def posterior(prior: Array, likelihoods: Array) -> Array:
    """P(A_i given B_1..B_n) (m,) of the prior (m,) and the likelihoods of one observation, (m,), or of n independent ones,
    (n, m). ValueError if no hypothesis allows what was observed."""
    found = prior.copy()
    for likelihood in np.atleast_2d(likelihoods):
        found = found * likelihood
        total = float(found.sum())
        if not total > 0:
            raise ValueError("no hypothesis allows the observation")
        found = found / total
    return np.asarray(found)


def missed(prior: Array, detection: Array) -> Array:
    """Posterior (m,) after an expected observation did not come: hypothesis i gives it with probability `detection` i, so
    the miss has likelihood 1 - P_D. ValueError if every hypothesis was sure to give it."""
    return posterior(prior, 1 - detection)


def carried(prior: Array, change: Array) -> Array:
    """The prior (m,) of the next observation where the truth may change in between: `change` (m, m) holds
    P(next is j given now is i) in row i. It keeps every reachable hypothesis alive."""
    return np.asarray(prior @ change)


def staying(count: int, leave: float) -> Array:
    """A `change` matrix (count, count): every hypothesis is left with probability `leave`, for the others with equal shares.
    ValueError unless 0 <= leave <= 1 and count >= 2."""
    if not (0 <= leave <= 1 and count >= 2):
        raise ValueError(f"leave {leave} must lie in [0, 1], count {count} must be 2 or more")
    change = np.full((count, count), leave / (count - 1))
    np.fill_diagonal(change, 1 - leave)
    return change
