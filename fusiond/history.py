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

from fusiond.kernel import ROW, Outcome, Rows, step
from fusiond.measurements import Measurement
from fusiond.plan import IMU, Plan, nanoseconds
from fusiond.state import NEVER, T_IMU, FilterState, T

FIRST_CAPACITY = 4096  # rows


class History:
    """The events of the horizon and the filter state behind them. `counts` is (sources, outcomes), by the last word."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.horizon_ns = nanoseconds(plan.filter.horizon_s)
        self.snapshot_interval_ns = nanoseconds(plan.filter.snapshot_interval_s)
        self.index = {source: i for i, source in enumerate(plan.sources)}
        self.head = FilterState(len(plan.sources))
        self.counts: NDArray[np.int64] = np.zeros((len(plan.sources), len(Outcome)), dtype=np.int64)
        self.rerun = 0  # rows run again because of a late event
        self._table: Rows = np.zeros(FIRST_CAPACITY, dtype=ROW)
        self._begin = self._end = 0  # the live part of the table
        self._applied = 0  # rows of the live part that are in the head
        self._newest_imu_ns = self._newest_ns = NEVER
        # (number of rows applied, state); the first is the base, from before the first row of the table
        self._snapshots: list[tuple[int, FilterState]] = [(0, self.head.copy())]

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
        """Nothing before this instant can change any more."""
        return self.applied_ns - self.horizon_ns

    def offer(self, measurement: Measurement, values: tuple[float, ...]) -> Outcome:
        """Put one event where it belongs in time and bring the head up to date. Returns its outcome, for now."""
        source = self.index[measurement.source]
        t_ns = measurement.t_ns
        if t_ns < self.settled_ns:
            return self.count(source, Outcome.TOO_OLD)
        place = self._place(t_ns, source, measurement.sequence)
        if place is None:
            return self.count(source, Outcome.DUPLICATE)
        self._insert(place, measurement, source, values)
        is_imu = self.plan.models[source] == IMU
        self._newest_ns = max(self._newest_ns, t_ns)
        if is_imu:
            self._newest_imu_ns = max(self._newest_imu_ns, t_ns)
        self._rewind(self._first_changed(place, is_imu))
        self._run()
        outcome = Outcome(int(self.rows[place]["outcome"]))
        self._forget()
        return outcome

    def count(self, source: int, outcome: Outcome) -> Outcome:
        """Count an event that is not kept."""
        self.counts[source, outcome] += 1
        return outcome

    def settled(self) -> FilterState:
        """The state after the last event before the horizon: what no late event can change any more."""
        rows, limit = self.rows, self.settled_ns
        applied, snapshot = self._snapshots[0]
        state = snapshot.copy()
        scratch = rows.copy()
        for i in range(applied, self._applied):
            if rows[i]["t_ns"] >= limit:
                break
            step(state, scratch, i, self._following_imu(i), self.plan)
        return state

    def _place(self, t_ns: int, source: int, sequence: int) -> int | None:
        """Where an event goes, found from the newest backwards; None if its very key is there already."""
        rows, key = self.rows, (t_ns, source, sequence)
        i = len(rows)
        while i > 0:
            row = rows[i - 1]
            before = int(row["t_ns"]), int(row["source"]), int(row["sequence"])
            if before == key:
                return None
            if before < key:
                break
            i -= 1
        return i

    def _insert(self, place: int, measurement: Measurement, source: int, values: tuple[float, ...]) -> None:
        if self._end == len(self._table):
            live = self._end - self._begin
            capacity = max(FIRST_CAPACITY, 4 * live)
            table = np.zeros(capacity, dtype=ROW)
            table[:live] = self.rows
            self._table, self._begin, self._end = table, 0, live
        at = self._begin + place
        self._table[at + 1 : self._end + 1] = self._table[at : self._end]
        self._end += 1
        row = self._table[at]
        row["t_ns"], row["sequence"], row["t_receive_ns"] = measurement.t_ns, measurement.sequence, measurement.t_receive_ns
        row["source"], row["outcome"], row["ratio"] = source, Outcome.WAITING, 0.0
        row["values"] = 0.0
        row["values"][: len(values)] = values
        row["innovation"], row["variance"] = 0.0, 0.0
        self.counts[source, Outcome.WAITING] += 1
        if place < self._applied:  # for the moment it counts among the applied: the rewind takes it out
            self._applied += 1

    def _first_changed(self, place: int, is_imu: bool) -> int:
        if not is_imu:
            return place
        rows, models = self.rows, self.plan.models
        before = place
        while before > 0 and models[rows[before - 1]["source"]] != IMU:
            before -= 1
        return before

    def _rewind(self, first_changed: int) -> None:
        """Restore the head from the newest snapshot at or before the first changed row, if that row was applied."""
        if first_changed >= self._applied:
            return
        while self._snapshots[-1][0] > first_changed:
            self._snapshots.pop()
        applied, snapshot = self._snapshots[-1]
        self.head.copy_from(snapshot)
        self.rerun += self._applied - applied
        self._applied = applied

    def _run(self) -> None:
        """Apply the rows up to `applied_ns`, and take snapshots."""
        rows, limit, head = self.rows, self.applied_ns, self.head
        while self._applied < len(rows) and rows[self._applied]["t_ns"] <= limit:
            i = self._applied
            row = rows[i]
            before = row["outcome"]
            step(head, rows, i, self._following_imu(i), self.plan)
            if row["outcome"] != before:
                self.counts[row["source"], before] -= 1
                self.counts[row["source"], row["outcome"]] += 1
            self._applied = i + 1
            if self._may_snapshot(int(row["source"])):
                self._snapshots.append((i + 1, head.copy()))

    def _following_imu(self, i: int) -> int:
        rows, models = self.rows, self.plan.models
        while i < len(rows) and models[rows[i]["source"]] != IMU:
            i += 1
        return i

    def _may_snapshot(self, source: int) -> bool:
        """Whether the head is due for a snapshot and no IMU sample still to come can change it."""
        head, last = self.head.stamps, self._snapshots[-1][1].stamps
        if head[T] - last[T] < self.snapshot_interval_ns:
            return False
        return self.plan.models[source] == IMU or bool(head[T] - head[T_IMU] > self.plan.imu_gap_ns)

    def _forget(self) -> None:
        """Drop the rows and snapshots that no event inside the horizon can need."""
        base, rows, limit = 0, self.rows, self.settled_ns
        while base + 1 < len(self._snapshots):
            applied = self._snapshots[base + 1][0]
            if applied < len(rows) and rows[applied]["t_ns"] < limit:
                base += 1  # every row before `applied` is older than one that is older than the horizon
            else:
                break
        if base == 0:
            return
        gone = self._snapshots[base][0]
        self._begin += gone
        self._applied -= gone
        self._snapshots = [(applied - gone, state) for applied, state in self._snapshots[base:]]
