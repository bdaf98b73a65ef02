"""Quantiles of the latest latencies of one kind."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.messages.types import Quantiles
from fusiond.units import MILLISECOND

KEPT = 4096  # latencies kept: 10 s at 400 Hz


class RecentLatencies:
    """The latest few thousand latencies; written by one thread, read by any."""

    def __init__(self, kept: int = KEPT) -> None:
        self.count = 0  # number of all latencies so far
        self._sum_ns = 0  # and their sum
        self._ring: NDArray[np.int64] = np.zeros(kept, dtype=np.int64)

    def add(self, latency_ns: int) -> None:
        self._ring[self.count % len(self._ring)] = latency_ns
        self._sum_ns += latency_ns
        self.count += 1

    def report(self) -> Quantiles | None:
        """Their quantiles; None before the first."""
        kept = np.sort(self._ring[: self.count])
        if not len(kept):
            return None
        p50, p90, p99 = (float(kept[round(share * (len(kept) - 1))]) / MILLISECOND for share in (0.5, 0.9, 0.99))
        most, total = float(kept[-1]) / MILLISECOND, self._sum_ns / MILLISECOND
        return Quantiles(p50=p50, p90=p90, p99=p99, max=most, count=self.count, sum=total)
