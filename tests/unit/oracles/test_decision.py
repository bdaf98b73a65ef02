"""Decisions among hypotheses, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from tests.oracles.decision import carried, missed, posterior, staying


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
