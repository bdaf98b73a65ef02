"""The methods of tuning, on plain arrays: Hadamard deviation, structure functions, differences of readings, regressions.

None of them asks how likely the filter's one-step innovations are: that rewards what fits the next sample, and makes sigmas
dishonest over the seconds that matter.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fusiond.maths.typed import Array

BLOCKS = 8  # whose scatter gives an estimate's uncertainty
THIRD = 20.0  # squared sum of the coefficients of a third difference: 1, 3, 3, 1
LEAST_PAIRS = 20  # of a lag, for it to count
EDGE = 1.5  # a time that is within this factor of the shortest or longest one tried is not told


class Estimate(NamedTuple):
    """A value, its standard uncertainty, and why the data cannot tell it (empty: they can)."""

    value: float
    sigma: float
    untold: str = ""


def noise_density(values: Array, interval: float) -> Estimate:
    """White noise density [unit/sqrt(Hz)] of samples (N, k) every `interval` [s]: the largest of the axes, by the Hadamard
    deviation (IEEE 1139) at one interval. That is Allan's with a second difference, blind to what changes evenly: a vehicle
    that speeds up and turns."""
    if len(values) < 4 * BLOCKS:
        return Estimate(0.0, math.inf, f"{len(values)} samples are too few")
    second = np.diff(values, n=2, axis=0)
    parts = np.array([np.sqrt((part**2).mean(axis=0) / 6) for part in np.array_split(second, BLOCKS)])
    found = np.sqrt((parts**2).mean(axis=0)) * math.sqrt(interval)
    worst = int(np.argmax(found))
    spread = float(parts[:, worst].std() / math.sqrt(BLOCKS - 1)) * math.sqrt(interval)
    return Estimate(float(found[worst]), spread)


def white_sigma(values: Array) -> Estimate:
    """Sigma of the white noise of readings (N,) in even steps, by their third differences: what changes smoothly is gone."""
    if len(values) < 8 * BLOCKS:
        return Estimate(0.0, math.inf, f"{len(values)} readings are too few")
    third = np.diff(values, n=3)
    parts = np.array([math.sqrt(float((part**2).mean()) / THIRD) for part in np.array_split(third, BLOCKS)])
    return Estimate(float(np.sqrt((parts**2).mean())), float(parts.std() / math.sqrt(BLOCKS - 1)))


class Structure(NamedTuple):
    """A structure function: half the mean squared change of a series over each lag [s], and its relative uncertainty."""

    lags: Array
    values: Array
    relative: Array


def structure(t: Array, values: Array, shortest: float, longest: float, count: int = 16) -> Structure:
    """That of a series (N, k), averaged over its axes, at lags from the shortest to the longest [s]."""
    lags, found, relative = list[float](), list[float](), list[float]()
    step = float(np.median(np.diff(t)))
    for lag in np.unique(np.round(np.geomspace(shortest, longest, count) / step).astype(int)):
        seconds = lag * step
        later = np.searchsorted(t, t + seconds - step / 4)
        inside = later < len(t)
        pairs = np.flatnonzero(inside)[np.abs(t[later[inside]] - t[inside] - seconds) < step / 2]
        if lag < 1 or len(pairs) < LEAST_PAIRS:
            continue
        changes = values[later[pairs]] - values[pairs]
        lags.append(seconds)
        found.append(float((changes**2).mean()) / 2)
        independent = max(values.shape[1] * min(len(pairs), (t[-1] - t[0]) / seconds), 1.0)
        relative.append(math.sqrt(2 / independent))
    return Structure(np.array(lags), np.array(found), np.array(relative))


class SlowNoise(NamedTuple):
    """White noise of variance `white`, and noise of variance `slow` that lasts for `time` [s]: first-order Gauss-Markov."""

    white: float
    slow: float
    time: float


class SlowFit(NamedTuple):
    """The noise that fits a structure function best, the sigma of all of it together, and how long the slow part lasts."""

    noise: SlowNoise
    sigma: Estimate
    time: Estimate


def integrated(noise: SlowNoise, interval: float, lags: Array) -> Array:
    """The structure function (N,) of the integral of a noise, sampled every `interval` [s], at lags (N,) [s]: of velocity
    errors, in a path."""
    part = lags / noise.time if noise.time > 0 else lags
    lasting = noise.slow * noise.time**2 * (part - 1 + np.exp(-part)) if noise.time > 0 else np.zeros(len(lags))
    return np.asarray(lasting + noise.white * interval * lags / 2)


def fit_slow_noise(found: Structure, known: Array | None = None) -> SlowFit:
    """Fit w + s (1 - exp(-lag / T)) to a structure function, beside what is known of it (N,)."""
    if len(found.lags) < 5:
        nothing = Estimate(0.0, math.inf, f"{len(found.lags)} lags are too few")
        return SlowFit(SlowNoise(0.0, 0.0, 0.0), nothing, nothing)
    beside = np.zeros(len(found.lags)) if known is None else known
    times = np.geomspace(found.lags[0] / 3, 2 * found.lags[-1], 60)
    tried = [_fit_at(found, beside, time) for time in times.tolist()]
    misfits = np.array([misfit for misfit, _, _ in tried])
    best = int(np.argmin(misfits))
    misfit, white, slow = tried[best]
    if misfit == math.inf:
        hidden = Estimate(0.0, math.inf, "what drifts hides it")
        return SlowFit(SlowNoise(0.0, 0.0, 0.0), hidden, hidden)
    scale = max(misfit / max(len(found.lags) - 3, 1), 1.0)
    likely = np.flatnonzero(misfits < misfit + 4 * scale)  # two sigmas; neighbouring lags share their data
    time, low, high = float(times[best]), float(times[likely[0]]), float(times[likely[-1]])
    untold = ""
    if slow < 0.1 * (white + slow):
        untold = "nothing of it lasts"
    elif time < EDGE * times[0] or high > found.lags[-1] * EDGE or high / low > 6:
        untold = f"anything from {low:.2g} to {high:.2g} s fits"
    sigmas = np.sqrt([tried[i][1] + tried[i][2] for i in likely])
    sigma = math.sqrt(white + slow)
    spread = float(max(sigmas.max() - sigma, sigma - sigmas.min())) / 2 + sigma * float(found.relative.min()) / 2
    vague = "it cannot be told from what drifts" if spread >= sigma / 2 else ""
    noise = SlowNoise(white, slow, time)
    return SlowFit(noise, Estimate(sigma, spread, vague), Estimate(time, (high - low) / 4, untold))


def _fit_at(found: Structure, known: Array, time: float) -> tuple[float, float, float]:
    """Misfit and the two variances, none below 0, for one time: the best of all choices of which are not 0."""
    columns = np.stack([np.ones_like(found.lags), 1 - np.exp(-found.lags / time)], axis=1)
    weights = 1 / (found.relative * found.values)
    target = (found.values - known) * weights
    kept = math.inf, 0.0, 0.0
    for chosen in ((0,), (1,), (0, 1)):
        a = columns[:, chosen] * weights[:, None]
        solved, *_ = np.linalg.lstsq(a, target, rcond=None)
        misfit = float(((a @ solved - target) ** 2).sum())
        if (solved >= 0).all() and misfit < kept[0]:
            parts = dict(zip(chosen, solved.tolist(), strict=True))
            kept = misfit, parts.get(0, 0.0), parts.get(1, 0.0)
    return kept


def lag_of(t: Array, reading: Array, truth: Array, rate: Array, lasting: float) -> Estimate:
    """How late [s] readings (N, k) are behind the truth (N, k), which changes by `rate` (N, k) per second, by least squares;
    errors stay alike for `lasting` [s]."""
    off = truth - reading
    off = off - off.mean(axis=0)
    centred = rate - rate.mean(axis=0)
    power = float((centred**2).sum())
    if not power > 0:
        return Estimate(0.0, math.inf, "the speed never changed")
    value = float((centred * off).sum()) / power
    rest = off - value * centred
    step = float(np.median(np.diff(t)))
    alike = max(1.0, 2 * lasting / step)
    sigma = math.sqrt(float((rest**2).mean()) * alike / power)
    return Estimate(value, sigma)
