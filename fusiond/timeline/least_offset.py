"""The least offset between two clocks, with drift, from offsets that latency only ever increases."""

from __future__ import annotations

from itertools import pairwise

from fusiond.units import SECOND

BILLION = 10**9  # a rate of one, in parts per billion
FIRST_BUCKET = SECOND // 4
LAST_BUCKET = 8 * SECOND
BUCKETS = 80  # a full window is 80 buckets of 8 s
MAX_DRIFT = 300_000  # parts per billion; a crystal drifts by at most 100 000
EXTRAPOLATION = 20  # a drift is used for this many times the span that it was learnt from


class OffsetFloor:
    """A line under the points (x, y) of a sliding window: y = constant + drift x + (noise >= 0), all in ns.

    The window is a sequence of buckets, and each keeps its lowest point. A young window has short buckets, which merge in
    pairs as it fills. When a bucket is complete, the line is laid along the edge of the points' lower convex hull at three
    quarters of the window: close enough to the present that extrapolation does not magnify the noise of the minima. In
    between, a point below the line lowers it at once. Amortised O(1) time, at most BUCKETS points.
    """

    __slots__ = ("_bucket", "_bucket_height", "_least", "_length", "_newest", "_origin", "_points", "_reach", "_start",
                 "slope")  # fmt: skip

    def __init__(self, x: int, y: int) -> None:
        self._points: list[tuple[int, int]] = []
        self._length = FIRST_BUCKET
        self._start = self._newest = self._origin = x
        self._bucket, self._bucket_height = (x, y), y
        self._least = y
        self._reach = 0  # ns after the origin, beyond which the drift is not extrapolated
        self.slope = 0  # ppb

    def _rise(self, x: int) -> int:
        span = x - self._origin
        return self.slope * (span if span < self._reach else self._reach) // BILLION

    def at(self, x: int) -> int:
        """The line's value at x; at its newest complete bucket if x is before that."""
        return self._least + self._rise(max(x, self._origin))

    def add(self, x: int, y: int) -> None:
        """Add a point. An x before the newest one counts as the newest."""
        if x < self._newest:
            x = self._newest
        self._newest = x
        complete = x - self._start >= self._length
        if complete:
            self._close(x)
        height = y - self._rise(x)
        if complete or height < self._bucket_height:
            self._bucket, self._bucket_height = (x, y), height
            self._least = min(self._least, height)

    def _close(self, x: int) -> None:
        points = self._points
        points.append(self._bucket)
        if len(points) > BUCKETS:
            if self._length < LAST_BUCKET:
                self._length *= 2
                pairs = zip(points[::2], points[1::2], strict=False)  # an odd last one is put back
                odd = points[len(points) & ~1 :]
                points[:] = [min(pair, key=lambda point: point[1] - self._rise(point[0])) for pair in pairs] + odd
            else:
                del points[0]
        self._start = x
        if len(points) > 1:
            (x0, y0), (x1, y1) = self._edge()
            self.slope = max(-MAX_DRIFT, min(MAX_DRIFT, (y1 - y0) * BILLION // (x1 - x0)))
        self._origin = points[-1][0]
        self._reach = EXTRAPOLATION * (self._origin - points[0][0])
        self._least = min(y - self._rise(x) for x, y in points)

    def _edge(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """The edge of the lower convex hull above three quarters of the window."""
        hull: list[tuple[int, int]] = []
        for x, y in self._points:
            while len(hull) > 1:
                (xa, ya), (xb, yb) = hull[-2:]
                if (xb - xa) * (y - ya) > (yb - ya) * (x - xa):
                    break
                hull.pop()
            hull.append((x, y))
        mark = (self._points[0][0] + 3 * self._points[-1][0]) // 4
        return next((a, b) for a, b in pairwise(hull) if b[0] >= mark)
