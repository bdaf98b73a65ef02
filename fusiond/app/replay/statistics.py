"""Running statistics in constant memory: a histogram with quantiles, a mean with its variance."""

from __future__ import annotations

import math
from collections import defaultdict

GROWTH = 0.01  # of the width of a bin beyond the limit, as a share of its value


class Histogram:
    """Counts in bins of equal width up to a limit on either side of zero; beyond it, in bins that grow with the value.

    Quantiles are the middles of bins, so accurate to half a width, and beyond the limit to half a per cent; minimum and
    maximum are exact.
    """

    def __init__(self, step: float, limit: float) -> None:
        self._step, self._last = step, round(limit / step)
        self._bins: defaultdict[int, int] = defaultdict(int)
        self.count = 0
        self.minimum, self.maximum = math.inf, -math.inf

    def add(self, value: float, count: int = 1) -> None:
        """Count a value `count` times."""
        place = math.floor(value / self._step)
        if not -self._last <= place < self._last:
            beyond = math.floor(math.log(max(1.0, abs(value) / (self._last * self._step))) / GROWTH)
            place = self._last + beyond if place > 0 else -self._last - 1 - beyond
        self._bins[place] += count
        self.count += count
        if value < self.minimum:
            self.minimum = value
        if value > self.maximum:
            self.maximum = value

    def quantile(self, share: float) -> float:
        """The smallest value that at least this share of all values does not exceed."""
        return self._ranked(share, sorted((self._middle(place), count) for place, count in self._bins.items()))

    def quantile_of_distance(self, share: float, centre: float) -> float:
        """The same quantile of the distances from a centre."""
        distances = ((abs(self._middle(place) - centre), count) for place, count in self._bins.items())
        return self._ranked(share, sorted(distances))

    def _middle(self, place: int) -> float:
        beyond = place - self._last if place > 0 else -self._last - 1 - place
        middle = (place + 0.5) * self._step
        if beyond >= 0:
            middle = math.copysign(self._last * self._step * math.exp((beyond + 0.5) * GROWTH), place)
        return max(self.minimum, min(self.maximum, middle))

    def _ranked(self, share: float, bins: list[tuple[float, int]]) -> float:
        seen, wanted = 0, share * self.count
        for value, count in bins:
            seen += count
            if seen >= wanted:
                return value
        raise ValueError("no value was counted")


class Mean:
    """Mean and mean square of values, added one by one."""

    def __init__(self) -> None:
        self.count = 0
        self._sum = self._squares = 0.0

    def add(self, value: float) -> None:
        self.count += 1
        self._sum += value
        self._squares += value * value

    @property
    def value(self) -> float:
        return self._sum / self.count

    @property
    def square(self) -> float:
        return self._squares / self.count

    @property
    def variance(self) -> float:
        return max(0.0, self.square - self.value**2)
