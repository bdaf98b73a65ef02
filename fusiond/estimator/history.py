"""Every event of the last `horizon` in order of (t_ns, source, sequence), with snapshots of the whole filter state.

Theory of operation. An event becomes a row of the event table, inserted in order. The rows are not run yet: that is done
when the head, the rows or the counts are read, for many events at once. The head state contains the rows [0, applied). If
an event is inserted among them, the snapshots that contain a changed row are dropped, the head is restored from the newest
one left, and the rows after it are run again. So head and outcomes are a function of the set of events alone: neither the
order of arrival nor the instants of reading matter.

Which rows does an event change? All rows after it. An IMU sample also changes the rows between it and the IMU sample
before it, because they interpolate between the two. Therefore a snapshot is taken only after an IMU row, or once the IMU
has been silent for longer than `imu_gap`: the filter coasts then, and no later sample changes what went before.

Which rows are run? Those up to the newest IMU sample. If the IMU has gone silent, also those older by `imu_gap` than the
newest event, so that the filter coasts on with its other sensors.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fusiond.events import Measurement
from fusiond.filter.kernel.interpreted import keep, make_kernel
from fusiond.filter.observations import IMU
from fusiond.filter.parameters import Parameters
from fusiond.filter.rows import ROW, Outcome, Rows
from fusiond.filter.state import NEVER, PHASE, RUNNING, FilterState
from fusiond.filter.step import begin_session, run_one

FIRST_ROWS = 4096
FIRST_SNAPSHOTS = 64
Archive = Callable[[Rows, FilterState], None]  # rows that no event can change any more, and the state after them

FORGET_EVERY = 256  # events; at most this many are run at once
FORGET_WHILE_STARTING = 8  # where an archive wants to know the state as soon as there is one


class History:
    """The events of the horizon and the filter state that they lead to."""

    def __init__(self, params: Parameters, compiled: bool | None = None) -> None:
        self.params = params
        self._compiled = compiled
        self.kernel = make_kernel(params, compiled)
        self.index = {source: i for i, source in enumerate(params.sources)}
        self.archive: Archive | None = None  # gets every row that is run, in order, before it is forgotten
        self.rerun = 0  # rows run again because of a late event
        self.applied_ns = NEVER  # events up to here are applied; it depends on the received stamps alone
        self.settled_ns = NEVER - params.horizon_ns  # the horizon: an older event is TOO_OLD
        self._head = FilterState(len(params.sources), params.size)
        self._counts: NDArray[np.int64] = np.zeros((len(params.sources), len(Outcome)), dtype=np.int64)
        # by source: an event makes the rows older than it by this due [ns]
        self._lags = [0 if model == IMU else params.imu_gap_ns for model in params.models]
        self._table: Rows = np.zeros(FIRST_ROWS, dtype=ROW)
        self._begin = self._end = 0  # the live part of the table
        self._applied = 0  # rows of the live part in the head; after a rewind, in the newest snapshot
        self._pending = self._rewound = False  # there are rows to run; the head must be restored first
        self._snapshots = Snapshots(self._head)
        self._attach()
        self._until_forgetting = FORGET_EVERY

    def next_session(self) -> History:
        """The history of a new session, on a time line that has stepped back: empty but for what the state keeps through an
        alignment, and the counts. This one stays as it is, for the receipts of its events."""
        following = History(self.params, self._compiled)
        following._head.copy_from(self.head)
        begin_session(following._head)
        following._snapshots = Snapshots(following._head)
        following._counts[:] = self.counts
        following.rerun, following.archive = self.rerun, self.archive
        following._attach()
        return following

    def _attach(self) -> None:
        kept = self._snapshots
        self.kernel.attach(self._head, self._table, self._counts, kept.numbers, kept.whole, kept.applied)

    @property
    def head(self) -> FilterState:
        """The state after every event up to `applied_ns`. Always the same object: read it again after an event."""
        self.apply_rows()
        return self._head

    @property
    def rows(self) -> Rows:
        """The live rows, oldest first."""
        self.apply_rows()
        return self._table[self._begin : self._end]

    @property
    def counts(self) -> NDArray[np.int64]:
        """Number of events (sources, outcomes), each with its latest outcome. Always the same array: read it again after an
        event."""
        self.apply_rows()
        return self._counts

    def offer(self, source: int, measurement: Measurement, values: tuple[float, ...]) -> Outcome | None:
        """Insert an event in order. Returns the reason if it is not kept, None if it is."""
        t_ns = measurement.t_ns
        if t_ns < self.settled_ns:
            return self.count(source, Outcome.TOO_OLD)
        if self._end == len(self._table):
            self._make_room()
        first_changed = self.kernel.offer(
            self._begin, self._end, t_ns, source, measurement.sequence, measurement.t_receive_ns, values
        )
        if first_changed < 0:
            return self.count(source, Outcome.DUPLICATE)
        self._end += 1
        self._pending = True
        if first_changed < self._applied:
            self._rewind(first_changed)
        reach_ns = t_ns - self._lags[source]
        if reach_ns > self.applied_ns:
            self.applied_ns, self.settled_ns = reach_ns, reach_ns - self.params.horizon_ns
        self._until_forgetting -= 1
        if not self._until_forgetting:
            self._forget()
        return None

    def count(self, source: int, outcome: Outcome) -> Outcome:
        """Count an event that is not kept."""
        self._counts[source, outcome] += 1
        return outcome

    def outcome(self, measurement: Measurement) -> Outcome:
        """The outcome of an event so far. LookupError if the event has been dropped."""
        source, sequence = self.index[measurement.source], measurement.sequence
        self.apply_rows()
        place = self.kernel.place(self._begin, self._end, measurement.t_ns, source, sequence)
        if place < 0:
            return Outcome(self._table["outcome"][self._begin + ~place])
        raise LookupError(f"no event of {measurement.source} at {measurement.t_ns} is kept")

    def settled(self) -> FilterState:
        """The newest snapshot that no later event can change: the state about one snapshot interval before the horizon."""
        self._forget()
        return self._snapshots.first()

    def finish(self) -> None:
        """Hand all that was run and is not yet forgotten to the archive: no event will come any more."""
        self._forget()
        if self.archive and self._applied:
            self.archive(self._table[self._begin : self._begin + self._applied], self._head.copy())

    def _rewind(self, first_changed: int) -> None:
        """Drop the snapshots that contain a changed row, so that the rows after the newest one left are run again."""
        before, self._applied = self._applied, self._snapshots.rewind(first_changed)
        self.rerun += before - self._applied
        self._rewound = True

    def apply_rows(self) -> None:
        """Run the rows up to `applied_ns`. Reading the head, the rows or the counts does this first."""
        if not self._pending:
            return
        kept, done = self._snapshots, False
        if self._rewound:
            self.kernel.restore(kept.end)
        self._pending = self._rewound = False
        while not done:  # the kernel stops when its memory is full, and at a row that it leaves to Python
            before = self._applied
            self._applied, kept.end, done = self.kernel.run(self._begin, self._end, before, self.applied_ns, kept.end)
            if done:
                return
            if kept.end == len(kept.applied):
                kept.make_room()
                self._attach()
            elif self._applied == before:
                rows = self._table[self._begin : self._end]
                self._applied = run_one(self._head, rows, before, self._counts, self.params)
                memory = (kept.numbers, kept.whole, kept.applied)
                kept.end = keep(self._head, rows, self._applied, self.params, memory, kept.end)

    def _make_room(self) -> None:
        """Move the live rows to the front of the table, or of a larger one if they fill half of it."""
        self._forget()
        live = self._end - self._begin
        table = self._table if 2 * live < len(self._table) else np.zeros(4 * live, dtype=ROW)
        table[:live] = self._table[self._begin : self._end]
        self._table, self._begin, self._end = table, 0, live
        self._attach()

    def _forget(self) -> None:
        """Drop the rows and snapshots that no event inside the horizon can need. The results do not depend on when."""
        self.apply_rows()
        starting = self.archive and self._snapshots.whole[self._snapshots.begin, PHASE] != RUNNING
        self._until_forgetting = FORGET_WHILE_STARTING if starting else FORGET_EVERY
        gone = self._snapshots.forget(self._table["t_ns"][self._begin : self._end], self.settled_ns)
        if self.archive and gone:
            self.archive(self._table[self._begin : self._begin + gone], self._snapshots.first())
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

    def rewind(self, first_changed: int) -> int:
        """Drop the newest snapshots that contain a changed row. Returns the number of rows in the newest one left."""
        while self.applied[self.end - 1] > first_changed:
            self.end -= 1
        return int(self.applied[self.end - 1])

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
        """Drop the oldest snapshots while the first row after the next one is older than the limit: all rows in that one
        are then older too. Returns how many rows can be dropped."""
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
