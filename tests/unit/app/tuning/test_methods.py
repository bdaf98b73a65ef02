"""The methods of tuning on series whose noise is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fusiond.app.tuning.methods import (
    SlowNoise,
    fit_slow_noise,
    integrated,
    lag_of,
    noise_density,
    structure,
    white_sigma,
)
from fusiond.app.tuning.spells import Score, is_better
from fusiond.maths.typed import Array

STEP = 0.2


def lasting(count: int, time: float, sigma: float, random: np.random.Generator) -> Array:
    """First-order Gauss-Markov noise (count, 2)."""
    kept = math.exp(-STEP / time)
    values = np.empty((count, 2))
    values[0] = sigma * random.normal(size=2)
    for k in range(1, count):
        values[k] = kept * values[k - 1] + sigma * math.sqrt(1 - kept * kept) * random.normal(size=2)
    return values


@pytest.mark.parametrize("seed", range(3))
def test_a_density_is_that_of_the_noise_whatever_the_vehicle_does(seed: int) -> None:
    random, t = np.random.default_rng(seed), np.arange(0, 60, 0.01)
    motion = np.stack([3 * np.sin(1.5 * t), 0.5 * t, 2 * np.cos(2.0 * t)], axis=1)
    white = random.normal(size=(len(t), 3)) * [0.1, 0.2, 0.15]
    found = noise_density(motion + white, 0.01)
    assert found.value == pytest.approx(0.2 * math.sqrt(0.01), rel=0.03) and not found.untold
    assert 0 < found.sigma < 0.05 * found.value


def test_white_noise_of_readings_whatever_the_speed_does() -> None:
    random, t = np.random.default_rng(1), np.arange(0, 100, 0.05)
    found = white_sigma(10 + 5 * np.sin(0.3 * t) + 0.05 * random.normal(size=len(t)))
    assert found.value == pytest.approx(0.05, abs=4 * found.sigma) and found.sigma < 0.003


def test_too_little_tells_nothing() -> None:
    assert noise_density(np.zeros((10, 3)), 0.01).untold == "10 samples are too few"
    assert white_sigma(np.zeros(20)).untold == "20 readings are too few"
    t = np.arange(0, 2, STEP)
    assert "too few" in fit_slow_noise(structure(t, np.zeros((len(t), 2)), 1.0, 40.0)).time.untold


@pytest.mark.parametrize(("time", "seed"), [(2.0, 1), (8.0, 2), (8.0, 3)])
def test_white_and_lasting_noise_are_told_apart(time: float, seed: int) -> None:
    random, count = np.random.default_rng(seed), 4000
    values = lasting(count, time, 1.0, random) + 0.5 * random.normal(size=(count, 2))
    t = STEP * np.arange(count)
    fit = fit_slow_noise(structure(t, values, 1.0, 40.0))
    assert not fit.time.untold and not fit.sigma.untold
    assert fit.time.value == pytest.approx(time, rel=0.35)
    assert fit.sigma.value == pytest.approx(math.hypot(1.0, 0.5), rel=0.15)


def test_white_noise_alone_does_not_last() -> None:
    t = STEP * np.arange(3000)
    fit = fit_slow_noise(structure(t, np.random.default_rng(4).normal(size=(3000, 2)), STEP, 20.0))
    assert fit.time.untold
    assert fit.sigma.value == pytest.approx(1.0, rel=0.1)


def test_what_lasts_for_longer_than_the_lags_is_not_told() -> None:
    t = STEP * np.arange(3000)
    fit = fit_slow_noise(structure(t, lasting(3000, 300.0, 1.0, np.random.default_rng(6)), 1.0, 40.0))
    assert "fits" in fit.time.untold


def test_what_the_velocity_errors_make_of_the_path_is_known() -> None:
    random, count = np.random.default_rng(7), 40_000
    velocity = lasting(count, 2.0, 0.15, random) + 0.1 * random.normal(size=(count, 2))
    found = structure(STEP * np.arange(count), np.cumsum(velocity, axis=0) * STEP, 1.0, 20.0)
    expected = integrated(SlowNoise(0.1**2, 0.15**2, 2.0), STEP, found.lags)
    np.testing.assert_allclose(found.values, expected, rtol=0.25)


def test_what_is_known_may_hide_the_rest() -> None:
    t = STEP * np.arange(3000)
    found = structure(t, np.random.default_rng(9).normal(size=(3000, 2)), 1.0, 40.0)
    fit = fit_slow_noise(found, found.values + found.lags)
    assert fit.sigma.untold == fit.time.untold == "what drifts hides it"


def test_gaps_have_no_lags() -> None:
    t = np.concatenate([np.arange(0, 50, STEP), np.arange(1000, 1050, STEP)])
    found = structure(t, np.zeros((len(t), 2)), 1.0, 100.0)
    assert found.lags.max() < 50


def test_a_delay_is_told_with_its_uncertainty() -> None:
    random, t = np.random.default_rng(8), STEP * np.arange(1500)
    speed, rate = 10 + 3 * np.sin(0.5 * t), 1.5 * np.cos(0.5 * t)
    reading = 10 + 3 * np.sin(0.5 * (t - 0.12)) + 0.05 * random.normal(size=len(t))
    found = lag_of(t, reading[:, None], speed[:, None], rate[:, None], 1.0)
    assert found.value == pytest.approx(0.12, abs=3 * found.sigma) and found.sigma < 0.01
    still = lag_of(t, reading[:, None], speed[:, None], np.zeros((len(t), 1)), 1.0)
    assert still.untold == "the speed never changed"


def test_better_is_more_than_chance() -> None:
    random = np.random.default_rng(3)
    same = random.normal(size=20)

    def found(each: Array) -> Score:
        return Score(spells=len(each), length_s=10.0, rmse_m=1.0, nees=2.0, each=each.tolist())

    assert is_better(found(same + 1.0 + 0.1 * random.normal(size=20)), found(same))
    assert not is_better(found(same), found(same))
    assert not is_better(found(same + np.where(np.arange(20) % 2, 5.0, -4.9)), found(same))
    assert is_better(found(same), found(same[:5]))
