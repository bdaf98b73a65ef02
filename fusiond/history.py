"""Every event of the last `horizon` in order of (t_ns, source, sequence), with snapshots of the whole filter state.

Theory of operation. The rows [0, applied) are in the head state; the rest wait for the IMU. An event is inserted where its
key belongs. If that is among the applied rows, the head is restored from the newest snapshot at or before the first row
that it changes, and the rows after are run again. So head and outcomes are a function of the set of events alone, whatever
the order of their arrival.

Which rows does an event change? All after it; and if it is an IMU sample, also those between it and the IMU sample before
it, because they interpolate between the two. Therefore a snapshot is taken only after an IMU row, or where the IMU has been
silent for so long that no later sample can change what went before.

Which rows are applied? Those up to the newest IMU sample; and if the IMU has gone silent, those older by `imu_gap` than the
newest event of all, so that the filter coasts on with its other sensors.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusiond.kernel import ROW, Outcome, Rows, keep, make_kernel, run_one
from fusiond.measurements import Measurement
from fusiond.plan import IMU, Plan
from fusiond.state import NEVER, FilterState

FIRST_ROWS = 4096
FIRST_SNAPSHOTS = 64
FORGET_EVERY = 256  # events
OUTCOMES = tuple(Outcome)
WAITING = int(Outcome.WAITING)


class History:
    """The events of the horizon and the filter state behind them. `counts` is (sources, outcomes), by the last word."""

    def __init__(self, plan: Plan, compiled: bool | None = None) -> None:
        self.plan = plan
        self.kernel = make_kernel(plan, compiled)
        self.index = {source: i for i, source in enumerate(plan.sources)}
        self.head = FilterState(len(plan.sources), plan.size)
        self.counts: NDArray[np.int64] = np.zeros((len(plan.sources), len(Outcome)), dtype=np.int64)
        self.rerun = 0  # rows run again because of a late event
        self._table: Rows = np.zeros(FIRST_ROWS, dtype=ROW)
        self._begin = self._end = 0  # the live part of the table
        self._applied = 0  # rows of the live part that are in the head
        self._newest_imu_ns = self._newest_ns = NEVER
        self._snapshots = Snapshots(self.head)
        self._attach()
        self._until_forgetting = FORGET_EVERY

    def _attach(self) -> None:
        kept = self._snapshots
        self.kernel.attach(self.head, self._table, self.counts, kept.numbers, kept.whole, kept.applied)

    @property
    def rows(self) -> Rows:
        """The live rows, oldest first."""
        return self._table[self._begin : self._end]

    @property
    def applied_ns(self) -> int:
        """Up to where events are applied: a function of the stamps received alone."""
        return max(self._newest_imu_ns, self._newest_ns - self.plan.imu_gap_ns)

    @property
    def settled_ns(self) -> int:
        """No event older than this is taken any more."""
        return self.applied_ns - self.plan.horizon_ns

    def offer(self, measurement: Measurement, values: tuple[float, ...]) -> Outcome:
        """Put one event where it belongs in time and bring the head up to date. Returns its outcome, for now."""
        t_ns, source = measurement.t_ns, self.index[measurement.source]
        if t_ns < self.settled_ns:
            return self.count(source, Outcome.TOO_OLD)
        if self._end == len(self._table):
            self._make_room()
        if t_ns > self._newest_ns:
            self._newest_ns = t_ns
        if self.plan.models[source] == IMU and t_ns > self._newest_imu_ns:
            self._newest_imu_ns = t_ns
        kept, limit = self._snapshots, self.applied_ns
        place, self._applied, kept.end, rerun, done = self.kernel.offer(
            self._begin,
            self._end,
            self._applied,
            kept.end,
            limit,
            t_ns,
            source,
            measurement.sequence,
            measurement.t_receive_ns,
            WAITING,
            values,
        )
        if place < 0:
            return self.count(source, Outcome.DUPLICATE)
        self._end += 1
        self.rerun += rerun
        if not done:
            self._run(limit)
        outcome: Outcome = OUTCOMES[self.kernel.outcome(self._begin + place)]
        self._until_forgetting -= 1
        if not self._until_forgetting:
            self._forget()
        return outcome

    def count(self, source: int, outcome: Outcome) -> Outcome:
        """Count an event that is not kept."""
        self.counts[source, outcome] += 1
        return outcome

    def settled(self) -> FilterState:
        """The newest snapshot that no event still to come can change: the state about a snapshot interval before the
        horizon."""
        self._forget()
        return self._snapshots.first()

    def _run(self, limit_ns: int) -> None:
        """Apply the rows up to `limit_ns`: what the kernel's loop left, for want of memory or as not its own."""
        kept, done = self._snapshots, False
        while not done:
            before = self._applied
            self._applied, kept.end, done = self.kernel.run(self._begin, self._end, before, limit_ns, kept.end)
            if done:
                return
            if kept.end == len(kept.applied):
                kept.make_room()
                self._attach()
            elif self._applied == before:
                self._applied = run_one(self.head, self.rows, before, self.counts, self.plan)
                memory = (kept.numbers, kept.whole, kept.applied)
                kept.end = keep(self.head, self.rows, self._applied, self.plan, memory, kept.end)

    def _make_room(self) -> None:
        """Move the live rows to the front of the table, or of a larger one if they fill half of it."""
        self._forget()
        live = self._end - self._begin
        table = self._table if 2 * live < len(self._table) else np.zeros(4 * live, dtype=ROW)
        table[:live] = self.rows
        self._table, self._begin, self._end = table, 0, live
        self._attach()

    def _forget(self) -> None:
        """Drop the rows and snapshots that no event inside the horizon can need. When this is done changes no result."""
        self._until_forgetting = FORGET_EVERY
        gone = self._snapshots.forget(self._table["t_ns"][self._begin : self._end], self.settled_ns)
        self._begin += gone
        self._applied -= gone


class Snapshots:
    """Copies of the filter state, oldest first, in preallocated memory: rows begin..end of three arrays.

    `applied` is the number of live rows in each. The first is the base: the state before the first live row.
    """

    def __init__(self, empty: FilterState) -> None:
        self._empty = empty.copy()
        self.numbers = np.zeros((FIRST_SNAPSHOTS, len(empty.numbers)))
        self.whole: NDArray[np.int64] = np.zeros((FIRST_SNAPSHOTS, len(empty.whole)), dtype=np.int64)
        self.applied: NDArray[np.int64] = np.zeros(FIRST_SNAPSHOTS, dtype=np.int64)
        self.numbers[0], self.whole[0] = empty.numbers, empty.whole
        self.begin, self.end = 0, 1

    def first(self) -> FilterState:
        """A copy of the base."""
        state = self._empty.copy()
        state.numbers[:], state.whole[:] = self.numbers[self.begin], self.whole[self.begin]
        return state

    def make_room(self) -> None:
        """Move the snapshots to the front of the memory, or of a larger one if they fill half of it."""
        live = slice(self.begin, self.end)
        count = self.end - self.begin
        if 2 * count < len(self.applied):
            numbers, whole, applied = self.numbers, self.whole, self.applied
        else:
            room = 4 * count
            numbers = np.zeros((room, self.numbers.shape[1]))
            whole, applied = np.zeros((room, self.whole.shape[1]), dtype=np.int64), np.zeros(room, dtype=np.int64)
        numbers[:count], whole[:count], applied[:count] = self.numbers[live], self.whole[live], self.applied[live]
        self.numbers, self.whole, self.applied = numbers, whole, applied
        self.begin, self.end = 0, count

    def forget(self, stamps: NDArray[np.int64], limit_ns: int) -> int:
        """Drop the oldest snapshots as long as the next one has an unapplied row older than the limit: every row that it
        has applied is then as old. Returns how many rows nobody needs any more."""
        base = self.begin
        while base + 1 < self.end:
            applied = self.applied[base + 1]
            if applied >= len(stamps) or stamps[applied] >= limit_ns:
                break
            base += 1
        gone = int(self.applied[base])
        self.begin = base
        if gone:
            self.applied[base : self.end] -= gone
        return gone
