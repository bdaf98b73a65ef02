"""Curves over time in bounded memory: neighbouring samples are merged so that no peak is lost."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fusiond.units import MILLISECOND, SECOND

CAPACITY = 1500  # spans kept, each with two rows at the most
BATCH = 4096  # rows that are merged together
LEAST_GAP_S = 1.0  # a shorter one is no gap of the curve
GAP_STEPS = 10.0  # median steps; a longer gap is one of the curve

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]


class Envelope:
    """Several quantities sampled together. While there are few samples each is kept; later the samples of a span of time are
    merged to the least and the greatest of each quantity. A quantity that is unknown is nan."""

    def __init__(self, columns: Sequence[str], capacity: int = CAPACITY) -> None:
        self.columns = tuple(columns)
        self._capacity, self._width_ns = capacity, MILLISECOND
        self._new: list[tuple[int, Sequence[float]]] = []
        self._first: Stamps = np.empty(0, np.int64)  # of each span, its first and its last sample
        self._last: Stamps = np.empty(0, np.int64)
        self._low: Array = np.empty((0, len(columns)))
        self._high: Array = np.empty((0, len(columns)))

    def add(self, since_ns: int, values: Sequence[float]) -> None:
        """Add a sample; those of a few seconds may come in any order."""
        self._new.append((since_ns, values))
        if len(self._new) == BATCH:
            self._merge()

    def __len__(self) -> int:
        self._merge()
        return len(self._first)

    def curves(self) -> dict[str, Array]:
        """Each quantity by its name (N,), and `t`, the seconds (N,). A span of several samples has two rows, with the least
        and the greatest values; a gap in time has a row of nan at each end."""
        self._merge()
        first, last = self._first / SECOND, self._last / SECOND
        gaps = np.zeros(len(first), dtype=bool)  # after a span
        if len(first) > 2:
            between = first[1:] - last[:-1]
            gaps[:-1] = between > max(LEAST_GAP_S, GAP_STEPS * float(np.median(between)))
        unknown = np.full_like(self._low, np.nan)
        t = np.stack([first, last, last, np.append(first[1:], last[-1:])], axis=1)
        values = np.stack([self._low, self._high, unknown, unknown], axis=1)
        keep = np.stack([np.ones_like(gaps), self._first != self._last, gaps, gaps], axis=1)
        t, values = t[keep], values[keep]
        return {"t": t, **{name: values[:, place] for place, name in enumerate(self.columns)}}

    def _merge(self) -> None:
        if not self._new:
            return
        t = np.array([since_ns for since_ns, _ in self._new], dtype=np.int64)
        values = np.array([row for _, row in self._new], dtype=float).reshape(len(t), len(self.columns))
        self._new.clear()
        self._first, self._last = np.concatenate([self._first, t]), np.concatenate([self._last, t])
        self._low, self._high = np.concatenate([self._low, values]), np.concatenate([self._high, values])
        order = np.argsort(self._first, kind="stable")
        self._take(order)
        while True:
            starts = np.flatnonzero(np.diff(self._first // self._width_ns, prepend=np.iinfo(np.int64).min))
            if len(starts) <= self._capacity:
                break
            self._width_ns *= 2
        self._first, self._last = self._first[starts], np.maximum.reduceat(self._last, starts)
        self._low, self._high = np.fmin.reduceat(self._low, starts), np.fmax.reduceat(self._high, starts)

    def _take(self, order: NDArray[np.intp]) -> None:
        self._first, self._last = self._first[order], self._last[order]
        self._low, self._high = self._low[order], self._high[order]


class Span:
    """A stretch of time with one value, and the latest note on it."""

    __slots__ = ("note", "start_ns", "stop_ns", "value")

    def __init__(self, start_ns: int, stop_ns: int, value: str, note: str) -> None:
        self.start_ns, self.stop_ns, self.value, self.note = start_ns, stop_ns, value, note


class Spans:
    """A value that holds for stretches of time, such as a mode. Beyond the capacity the shortest is given to the one
    before it."""

    def __init__(self, capacity: int = CAPACITY) -> None:
        self.items: list[Span] = []
        self.merged = 0
        self._capacity = capacity

    def add(self, since_ns: int, value: str, note: str = "") -> None:
        """The value at an instant, which holds until the next."""
        last = self.items[-1] if self.items else None
        if last:
            last.stop_ns = max(since_ns, last.stop_ns)
        if last and last.value == value:
            last.note = note or last.note
        else:
            self.items.append(Span(since_ns, since_ns, value, note))
            if len(self.items) > self._capacity:
                self._drop_shortest()

    def finish(self, since_ns: int) -> None:
        """The end of the last stretch."""
        if self.items:
            self.items[-1].stop_ns = max(since_ns, self.items[-1].stop_ns)

    def _drop_shortest(self) -> None:
        inner = range(1, len(self.items) - 1)
        shortest = min(inner, key=lambda place: self.items[place].stop_ns - self.items[place].start_ns)
        self.items[shortest - 1].stop_ns = self.items[shortest].stop_ns
        del self.items[shortest]
        self.merged += 1
