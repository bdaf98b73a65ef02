"""Whether one configuration is worse than another over many drives: paired tests, and their joint verdict.

The figures of the same drive by both configurations are a pair. The signed-rank test (Wilcoxon, Biometrics Bulletin 1, 1945)
asks whether the logarithms of their ratios are shifted: it does not ask how they are distributed, and no single drive
decides. Of several figures and both directions the largest risk is held by Holm's steps (Scandinavian Journal of
Statistics 6, 1979).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from statistics import NormalDist
from typing import Literal, NamedTuple

import numpy as np

from fusiond.app.batch.row import Row

RISK = 0.01  # of calling a difference that is none, over all figures together
LEAST = 1e-9  # a smaller logarithm of a ratio is rounding: no difference
EXACT = 50  # pairs without ties up to which the distribution of the rank sum is counted out
HONEST_NEES = 2.0  # of two axes

Verdict = Literal["worse", "better", "no difference"]


class Figure(NamedTuple):
    """A figure of a row of which less is better, never negative."""

    name: str
    about: str
    unit: str
    of: Callable[[Row], float | None]


def _dishonesty(row: Row) -> float | None:
    """How far the claimed covariance is from the errors: 1 is honest, 2 is a NEES of twice or half what it should be."""
    if row.nees is None or row.nees <= 0:
        return None
    return math.exp(abs(math.log(row.nees / HONEST_NEES)))


FIGURES = (
    Figure("position_rmse_m", "horizontal position, RMSE", "m", lambda row: row.position_rmse_m),
    Figure("height_rmse_m", "height, RMSE", "m", lambda row: row.height_rmse_m),
    Figure("velocity_rmse_mps", "horizontal velocity, RMSE", "m/s", lambda row: row.velocity_rmse_mps),
    Figure("heading_rmse_deg", "heading, RMSE", "deg", lambda row: row.heading_rmse_deg),
    Figure("dishonesty", "NEES, factor from 2", "", _dishonesty),
    Figure("outage_68_percent", "outages, 68 % of the errors", "%", lambda row: row.outage_68_percent),
)


class Paired(NamedTuple):
    """One figure over all drives that have it by both configurations."""

    figure: str
    pairs: int
    better: int  # drives
    worse: int
    baseline: float | None  # median
    new: float | None
    change: float | None  # median of the ratio, less 1
    p_worse: float  # probability of such a shift to the worse, or a larger one, if there is none
    p_better: float
    verdict: Verdict


class Comparison(NamedTuple):
    """All figures, and the drives that only one of the configurations could do."""

    figures: tuple[Paired, ...]
    only_baseline: int  # ok by the baseline, not ok by the new one
    only_new: int
    p_fails: float  # probability of so many that only the baseline could do, if both are as good
    verdict: Verdict

    @property
    def is_worse(self) -> bool:
        """Whether the new configuration is significantly worse in any respect."""
        return self.verdict == "worse"


def signed_rank(differences: Sequence[float]) -> float:
    """The one-sided probability that the sum of the ranks of positive differences is so large, or larger, if they are
    symmetric about 0. Zeros are left out. Without ties and up to EXACT differences it is exact; else by the normal
    approximation with its corrections for ties and continuity."""
    values = np.array([one for one in differences if one != 0.0])
    count = len(values)
    if not count:
        return 1.0
    ranks, ties = _ranks(np.abs(values))
    positive = float(ranks[values > 0].sum())
    if count <= EXACT and not ties:
        return _exact(count, round(positive))
    mean = count * (count + 1) / 4
    variance = count * (count + 1) * (2 * count + 1) / 24 - ties / 48
    if variance <= 0:
        return 1.0
    return NormalDist().cdf((mean - positive + 0.5) / math.sqrt(variance))


def _ranks(sizes: np.ndarray) -> tuple[np.ndarray, float]:
    """Ranks from 1, equal sizes sharing their mean; and the sum of t^3 - t over groups of t equal ones."""
    _, where, counts = np.unique(sizes, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    return (last - (counts - 1) / 2)[where], float((counts**3.0 - counts).sum())


def _exact(count: int, positive: int) -> float:
    """The share of the 2^count signs of the ranks 1 to count whose positive sum is at least so large."""
    ways = [1] + [0] * (count * (count + 1) // 2)
    for rank in range(1, count + 1):
        for total in range(len(ways) - 1, rank - 1, -1):
            ways[total] += ways[total - rank]
    return float(sum(ways[positive:]) / (1 << count))


def binomial(successes: int, trials: int) -> float:
    """The probability of so many successes, or more, by even chances."""
    return sum(math.comb(trials, k) for k in range(successes, trials + 1)) / (1 << trials)


class Pairs:
    """Collects pairs of rows, a few numbers of each."""

    def __init__(self) -> None:
        self._values: dict[str, list[tuple[float, float]]] = {figure.name: [] for figure in FIGURES}
        self._only = {"baseline": 0, "new": 0}

    def add(self, baseline: Row, new: Row) -> None:
        """Add one drive."""
        fine = baseline.status == "ok", new.status == "ok"
        if fine == (True, True):
            for figure in FIGURES:
                old, other = figure.of(baseline), figure.of(new)
                if old is not None and other is not None:
                    self._values[figure.name].append((old, other))
        elif any(fine):
            self._only["baseline" if fine[0] else "new"] += 1

    def compared(self) -> Comparison:
        """The verdict over all that was added."""
        tests = {name: _tested(values) for name, values in self._values.items()}
        only_baseline, only_new = self._only["baseline"], self._only["new"]
        fails = binomial(only_baseline, only_baseline + only_new)
        gains = binomial(only_new, only_baseline + only_new)
        measured = [name for name, values in self._values.items() if values]
        significant = _holm(
            {(name, "worse"): tests[name][0] for name in measured}
            | {(name, "better"): tests[name][1] for name in measured}
            | ({("", "worse"): fails, ("", "better"): gains} if only_baseline + only_new else {})
        )
        figures = tuple(_paired(name, values, tests[name], significant) for name, values in self._values.items() if values)
        worse = any(direction == "worse" for _, direction in significant)
        verdict: Verdict = "worse" if worse else "better" if significant else "no difference"
        return Comparison(figures, only_baseline, only_new, fails, verdict)


def _logarithms(values: Sequence[tuple[float, float]]) -> list[float]:
    """Of the ratios new / baseline; 0 where they are the same but for rounding. If one of the two is 0, infinite."""
    found = []
    for old, new in values:
        if old > 0 and new > 0:
            ratio = math.log(new / old)
            found.append(ratio if abs(ratio) > LEAST else 0.0)
        else:
            found.append(0.0 if old == new else math.copysign(math.inf, new - old))
    return found


def _tested(values: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """The probabilities of a shift to the worse and to the better."""
    logarithms = _logarithms(values)
    return signed_rank(logarithms), signed_rank([-one for one in logarithms])


def _holm(probabilities: dict[tuple[str, str], float]) -> set[tuple[str, str]]:
    """Which of several tests are significant, so that the risk of any wrong call is RISK at most."""
    found = set()
    rising = sorted(probabilities.items(), key=lambda item: (item[1], item[0]))
    for number, (name, probability) in enumerate(rising):
        if probability > RISK / (len(rising) - number):
            break
        found.add(name)
    return found


def _paired(
    name: str, values: Sequence[tuple[float, float]], tested: tuple[float, float], significant: set[tuple[str, str]]
) -> Paired:
    logarithms = _logarithms(values)
    old, new = (float(np.median([value[side] for value in values])) for side in (0, 1))
    middle = float(np.median(logarithms))
    verdict: Verdict = (
        "worse" if (name, "worse") in significant else "better" if (name, "better") in significant else "no difference"
    )
    return Paired(
        figure=name,
        pairs=len(values),
        better=sum(one < 0 for one in logarithms),
        worse=sum(one > 0 for one in logarithms),
        baseline=old,
        new=new,
        change=math.expm1(middle) if math.isfinite(middle) else None,
        p_worse=tested[0],
        p_better=tested[1],
        verdict=verdict,
    )
