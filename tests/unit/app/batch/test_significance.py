"""The paired tests against scipy's, and that the same is not called different nor the worse the same."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from fusiond.app.batch.row import Row
from fusiond.app.batch.significance import Comparison, Pairs, binomial, signed_rank


def row(**figures: float) -> Row:
    return Row(status="ok", fusiond="1", config="c", **figures)


FAILED = Row(status="failed", reason="is empty", fusiond="1", config="c")


@pytest.mark.parametrize("count", [5, 12, 50])
@pytest.mark.parametrize("shift", [-0.5, 0.0, 0.4])
def test_without_ties_the_probability_is_exact(count: int, shift: float) -> None:
    values = np.random.default_rng(count).normal(shift, 1.0, count)
    expected = stats.wilcoxon(values, alternative="greater", method="exact").pvalue
    assert signed_rank(values.tolist()) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(("count", "places"), [(30, 1), (400, 1), (1000, 9)])
def test_with_ties_or_many_it_is_the_normal_approximation(count: int, places: int) -> None:
    values = np.random.default_rng(count).normal(0.05, 1.0, count).round(places)
    expected = stats.wilcoxon(values, alternative="greater", method="approx", correction=True).pvalue
    assert signed_rank(values.tolist()) == pytest.approx(expected, rel=1e-9)


def test_nothing_differs_from_itself() -> None:
    assert signed_rank([]) == signed_rank([0.0] * 10) == 1.0


@pytest.mark.parametrize(("successes", "trials"), [(0, 0), (3, 3), (7, 9), (900, 1500)])
def test_the_chance_of_failures_is_the_binomial(successes: int, trials: int) -> None:
    expected = stats.binom.sf(successes - 1, trials, 0.5)
    assert binomial(successes, trials) == pytest.approx(expected, rel=1e-9)


def compared(drives: int, seed: int, factor: float = 1.0, noise: float = 0.1) -> Comparison:
    """Drives that differ much, and two configurations of which the new one has errors so many times as large."""
    random, pairs = np.random.default_rng(seed), Pairs()
    for base in np.exp(random.normal(0.0, 1.0, drives)):
        old, new = base * np.exp(random.normal(0.0, noise, (2, 4)))
        pairs.add(figures(old), figures(new * factor))
    return pairs.compared()


def figures(values: np.ndarray) -> Row:
    rmse, velocity, heading, nees = values.tolist()
    return row(position_rmse_m=rmse, velocity_rmse_mps=velocity, heading_rmse_deg=heading, nees=2.0 + nees)


def test_the_same_is_called_different_at_the_risk_that_is_told() -> None:
    called = sum(compared(40, seed).verdict != "no difference" for seed in range(400))
    assert called <= 9  # 4 expected; more than 9 once in a hundred


def test_a_small_loss_on_many_drives_is_called() -> None:
    assert sum(compared(40, seed, 1.15).is_worse for seed in range(50)) >= 48
    assert compared(40, 0, 0.85).verdict == "better"


def test_more_failures_are_worse_whatever_the_others_say() -> None:
    pairs = Pairs()
    for _ in range(10):
        pairs.add(row(position_rmse_m=1.0), FAILED)
        pairs.add(row(position_rmse_m=1.0), row(position_rmse_m=1.0))
        pairs.add(FAILED, FAILED)
    found = pairs.compared()
    assert (found.only_baseline, found.only_new, found.verdict) == (10, 0, "worse")
    assert found.p_fails == pytest.approx(2**-10)
    assert [(one.figure, one.pairs, one.verdict) for one in found.figures] == [("position_rmse_m", 10, "no difference")]


def test_claims_that_are_too_small_or_too_large_are_dishonest_alike() -> None:
    for nees in (6.0, 2.0 / 3.0):
        pairs = Pairs()
        for _ in range(12):
            pairs.add(row(nees=2.2), row(nees=nees))
        (one,) = pairs.compared().figures
        assert one.verdict == "worse" and one.new == pytest.approx(3.0) and one.change == pytest.approx(3.0 / 1.1 - 1)


def test_zeros_and_rounding_are_no_ratio() -> None:
    pairs = Pairs()
    for old, new in ((0.0, 0.0), (1.0, 1.0 + 1e-12), (0.0, 1.0)):
        pairs.add(row(height_rmse_m=old), row(height_rmse_m=new))
    (one,) = pairs.compared().figures
    assert (one.better, one.worse, one.change) == (0, 1, 0.0)
    assert math.isfinite(one.p_worse)
