"""Lines and lags are found with sigmas that hold, outliers or not."""

from __future__ import annotations

import numpy as np
import pytest

from fusiond.app.diagnosis.fits import fit, lag_between


@pytest.mark.parametrize("outliers", [0, 30])
def test_a_line_with_outliers(outliers: int) -> None:
    chance = np.random.default_rng(1)
    x = np.linspace(0, 20, 400)
    y = 3.6 * x - 1.5 + chance.normal(0, 0.3, 400)
    y[chance.choice(400, outliers, replace=False)] += 40.0
    found = fit([x, np.ones(400)], y)
    assert found is not None
    assert np.abs(found.values - (3.6, -1.5)).max() < 0.1
    assert found.rest == pytest.approx(0.3, rel=0.2)


def test_the_sigmas_hold_for_errors_that_last() -> None:
    """Of many lines the estimates scatter by their sigmas, where neighbouring errors are alike."""
    chance, off = np.random.default_rng(2), []
    x = np.linspace(0, 20, 400)
    for _ in range(200):
        noise = np.zeros(400)
        for i in range(1, 400):
            noise[i] = 0.8 * noise[i - 1] + chance.normal(0, 0.3)
        found = fit([x, np.ones(400)], 2 * x + noise)
        assert found is not None
        off.append((found.values[0] - 2) / found.sigmas[0])
    assert 0.6 < float(np.std(off)) < 1.5


def test_too_little_to_tell() -> None:
    assert fit([np.ones(5)], np.ones(5)) is None
    assert fit([np.ones(100), np.ones(100)], np.arange(100.0)) is None
    assert fit([np.full(100, np.nan)], np.ones(100)) is None


@pytest.mark.parametrize("lag", [-0.73, 0.0, 0.11, 1.2])
def test_a_lag(lag: float) -> None:
    chance = np.random.default_rng(3)
    t, t_other = np.arange(0, 60, 0.2), np.arange(-5, 65, 0.1)

    def speed(instants: np.ndarray) -> np.ndarray:
        return 10 + 3 * np.sin(instants / 2) + 2 * np.sin(instants / 3.3)

    found = lag_between(t, 1.1 * speed(t - lag) + chance.normal(0, 0.1, len(t)), t_other, speed(t_other))
    assert found is not None
    assert found.lag == pytest.approx(lag, abs=0.03)
    assert abs(found.lag - lag) < 4 * found.sigma


def test_signals_that_have_nothing_in_common_have_no_lag() -> None:
    chance, t = np.random.default_rng(4), np.arange(0, 60, 0.2)
    assert lag_between(t, chance.normal(size=len(t)), t, chance.normal(size=len(t))) is None
