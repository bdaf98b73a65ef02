"""Whether a clock runs so much faster or slower than the host's that it is no clock of real time: that of a simulation."""

from __future__ import annotations

from collections import deque
from itertools import pairwise

from fusiond.timeline.least_offset import BILLION, MAX_DRIFT
from fusiond.units import SECOND

BUCKET = 9 * SECOND // 10  # a little less than the spacing of round trips
AGREEING = 10  # consecutive lowest points that each lie lower, or higher, than the one before by more than LIMIT allows
LIMIT = MAX_DRIFT + 500_000  # ppb: of a crystal, while NTP slews the host's clock (adjtimex does it by at most 500 ppm)
STRIDES = (1, 10)  # buckets to one such point: quick for large drifts, and slow for small ones
RISE = SECOND  # latency makes no offset rise steadily by more


class DriftWatch:
    """Judges points (x, y) = (receipt, receipt less stamp) [ns], or other offsets that latency only ever increases.

    The lowest points of consecutive spans of time move with the clock's drift, and up and down with the latency. No latency
    makes them fall steadily below all before them. A queue that fills makes them rise, but not for long by more than RISE.
    """

    def __init__(self) -> None:
        self.drift: int | None = None  # ppb by which the offset grows, while that is more than LIMIT
        self._lowest: deque[tuple[int, int]] = deque(maxlen=AGREEING * STRIDES[-1])
        self._start: int | None = None
        self._least = (0, 0)

    def add(self, x: int, y: int) -> None:
        """Add a point. `drift` changes when a bucket is complete."""
        if self._start is None or x - self._start >= BUCKET:
            if self._start is not None:
                self._lowest.append(self._least)
                self.drift = next(filter(None, map(self._judged, STRIDES)), None)
            self._start, self._least = x, (x, y)
        elif y < self._least[1]:
            self._least = x, y

    def _judged(self, stride: int) -> int | None:
        """The drift by the latest points, `stride` buckets to a point, if it is steady and beyond LIMIT."""
        lowest, count = list(self._lowest), AGREEING * stride
        if len(lowest) < count:
            return None
        latest = lowest[-count:]
        points = [min(latest[k : k + stride], key=lambda point: point[1]) for k in range(0, count, stride)]
        if any(b[0] <= a[0] for a, b in pairwise(points)):
            return None
        rates = [(b[1] - a[1]) * BILLION // (b[0] - a[0]) for a, b in pairwise(points)]
        (x0, y0), (x1, y1) = points[0], points[-1]
        falls = max(rates) < -LIMIT and all(y >= y0 for _, y in lowest[:-count])
        rises = stride == STRIDES[-1] and min(rates) > LIMIT and y1 - y0 > RISE
        return (y1 - y0) * BILLION // (x1 - x0) if falls or rises else None
