"""Statistics that the filter and its judges share."""

from __future__ import annotations

import math

from fusiond.maths.portable import exp


def chi_square(probability: float, freedom: int) -> float:
    """The value that a chi-square variable of `freedom` degrees stays below with `probability` (bisection on its
    distribution function, Abramowitz and Stegun 26.4.6, in arithmetic that is the same on every machine)."""

    def distribution(x: float) -> float:
        term, k = (math.sqrt(2 * x / math.pi), 1) if freedom % 2 else (x / 2, 2)  # (x/2)^(k/2) / Gamma(k/2 + 1)
        total = 0.0
        while k <= freedom or term > 1e-17 * total:
            if k >= freedom:
                total += term
            k += 2
            term *= x / k
        return total * exp(-x / 2)

    low, high = 0.0, 1.0
    while distribution(high) < probability and high < 1000:
        high *= 2
    while low < (middle := (low + high) / 2) < high:
        low, high = (middle, high) if distribution(middle) < probability else (low, middle)
    return middle
